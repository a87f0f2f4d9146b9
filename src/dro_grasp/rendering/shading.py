"""Light and finish: Blinn-Phong shading and outlines at depth steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dro_grasp.rendering.meshes import unit


@dataclass(frozen=True)
class Style:
    """Light and finish of a picture. Values are ours."""

    ambient: float = 0.44
    """Share of the colour that needs no light."""
    diffuse: float = 0.64
    """Share of the colour that grows with the cosine between normal and light."""
    specular: float = 0.16
    """Strength of the gloss."""
    shininess: float = 24.0
    """Exponent of the gloss: larger makes it smaller."""
    crease: float = 0.85
    """Faces whose normal has a smaller cosine to the vertex normal keep a sharp edge."""
    outline: float = 4.0
    """Darkening at depth steps, which separates fingers from the background."""
    outline_scale: float = 0.02
    """Depth step that is darkened fully [m]."""
    light: tuple[float, float, float] = (-0.45, 0.65, 0.75)
    """Direction towards the light: right, up and backward of the picture."""


def shade(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "n 3"], style: Style
) -> Float[np.ndarray, "n 3"]:
    """Blinn-Phong shading from both sides, because files disagree about which side is out.

    Args:
        points: In the camera's axes [m].
        normals: Likewise, of any length.
    """
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    view = -points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    normals = np.where((normals * view).sum(1, keepdims=True) < 0, -normals, normals)
    light = unit(np.asarray(style.light, float))
    facing = (normals @ light).clip(0)
    middle = view + light
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    gloss = (normals * middle).sum(1).clip(0) ** style.shininess
    return colours * (style.ambient + style.diffuse * facing)[:, None] + style.specular * gloss[:, None]


def outlines(depth: Float[np.ndarray, "h w"], radius: int, style: Style) -> Float[np.ndarray, "h w"]:
    """Factor on the colour of each pixel that darkens what lies behind its neighbours: eye-dome lighting.

    Args:
        depth: Depth of each pixel [m], infinite where nothing is drawn.
        radius: Distance of the eight neighbours [pixels].
    """
    padded = np.pad(depth, radius, mode="edge")
    h, w = depth.shape
    total = np.zeros((h, w), np.float32)
    shifts = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if (dx, dy) != (0, 0)]
    own = np.where(np.isfinite(depth), depth, 1e6)
    for dx, dy in shifts:
        other = padded[radius * (1 + dy) : radius * (1 + dy) + h, radius * (1 + dx) : radius * (1 + dx) + w]
        nearer = (own - np.where(np.isfinite(other), other, 1e6)) / style.outline_scale
        total += nearer.clip(0, 1)
    factor = np.exp(-style.outline * total / len(shifts) / 4)
    return np.where(np.isfinite(depth), factor, np.maximum(factor, 0.55))
