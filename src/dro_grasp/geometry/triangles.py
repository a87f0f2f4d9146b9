"""Measures of closed triangle meshes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def enclosed_volume(triangles: Float[np.ndarray, "n 3 3"]) -> float:
    """Signed volume inside a closed surface [m^3], by the divergence theorem; positive if corners run counter-clockwise."""
    a, b, c = triangles.transpose(1, 0, 2)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)
