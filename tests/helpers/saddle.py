"""An open sheet that faces no side."""

from __future__ import annotations

import numpy as np
import trimesh


def saddle() -> trimesh.Trimesh:
    """A bent sheet of 10 x 10 cm."""
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 12), np.linspace(-0.05, 0.05, 12), indexing="ij")
    corner = (np.arange(11)[:, None] * 12 + np.arange(11)).ravel()
    faces = np.concatenate([corner[:, None] + (0, 12, 13), corner[:, None] + (0, 13, 1)])
    return trimesh.Trimesh(np.stack([x, y, 4 * x * y], -1).reshape(-1, 3), faces)
