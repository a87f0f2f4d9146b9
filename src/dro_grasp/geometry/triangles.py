"""Measures of closed triangle meshes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def enclosed_volume(triangles: Float[np.ndarray, "n 3 3"]) -> float:
    """Signed volume inside a closed surface, by the divergence theorem [m^3]; negative if the faces are turned inward.

    Args:
        triangles: Corners [m], counter-clockwise from outside.
    """
    a, b, c = triangles.transpose(1, 0, 2)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)
