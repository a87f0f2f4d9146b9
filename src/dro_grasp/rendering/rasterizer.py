"""Pictures of triangle meshes without OpenGL: a depth-buffered software renderer for any machine with NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dro_grasp.rendering.camera import Camera
from dro_grasp.rendering.meshes import Colour, Mesh, corner_normals, unit

PAIRS_AT_ONCE = 4_000_000
"""Pairs of triangle and pixel that are tested together (ours): bounds the memory."""
WHITE = (1.0, 1.0, 1.0)
"""Default background: red, green, blue."""


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


@dataclass(frozen=True)
class _Triangles:
    """All triangles of a picture, three corners each."""

    corners: Float[np.ndarray, "f 3 3"]
    """Positions in the camera's axes [m]."""
    normals: Float[np.ndarray, "f 3 3"]
    """Unit normals in the camera's axes."""
    colours: Float[np.ndarray, "f 3"]
    screen: Float[np.ndarray, "f 3 3"]
    """Pixel coordinates, and inverse depth [1/m]."""
    visible: Bool[np.ndarray, " f"]
    """Whether the triangle lies before the camera."""


@dataclass(frozen=True)
class _Canvas:
    """The samples of a picture, row by row; filled in place."""

    width: int
    height: int
    colours: Float[np.ndarray, "samples 3"]
    depth: Float[np.ndarray, " samples"]
    """Depth of the nearest triangle [m]."""

    @staticmethod
    def empty(width: int, height: int, background: Colour) -> _Canvas:
        """A canvas with nothing drawn on it."""
        colours = np.broadcast_to(np.asarray(background, np.float32), (height * width, 3)).copy()
        return _Canvas(width, height, colours, np.full(height * width, np.inf, np.float32))


def render(
    meshes: Sequence[Mesh], camera: Camera, width: int = 640, height: int = 480, *, background: Colour = WHITE,
    oversampling: int = 2, style: Style | None = None,
) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Draw meshes with perspective, smooth shading and soft outlines, on a picture of `width` times `height` pixels.

    Args:
        oversampling: Samples per pixel and axis; 2 smooths the edges.
    """
    style = style or Style()
    canvas = _Canvas.empty(width * oversampling, height * oversampling, background)
    triangles = _gather(meshes, camera, canvas, style)
    for boxes in _pixel_boxes(triangles, canvas):
        _draw(boxes, triangles, canvas, style)
    picture = canvas.colours.reshape(canvas.height, canvas.width, 3)
    picture *= outlines(canvas.depth.reshape(canvas.height, canvas.width), oversampling, style)[..., None]
    picture = picture.reshape(height, oversampling, width, oversampling, 3).mean((1, 3))
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def _gather(meshes: Sequence[Mesh], camera: Camera, canvas: _Canvas, style: Style) -> _Triangles:
    """The triangles of all meshes, as the camera sees them."""
    axes = camera.axes()
    corners, normals, colours = [np.zeros((0, 3, 3))], [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    for mesh in meshes:
        vertices = (np.asarray(mesh.vertices, float) - camera.position) @ axes.T
        faces = np.asarray(mesh.faces, np.int64)
        corners.append(vertices[faces])
        normals.append(corner_normals(vertices, faces, style.crease))
        colours.append(np.broadcast_to(np.asarray(mesh.colour, float), (len(faces), 3)))
    together = np.concatenate(corners)
    screen, visible = camera.project(together, canvas.width, canvas.height)
    return _Triangles(together, np.concatenate(normals), np.concatenate(colours), screen, visible)


def _pixel_boxes(triangles: _Triangles, canvas: _Canvas) -> list[Int[np.ndarray, "_ 5"]]:
    """Bounding boxes of the visible triangles in the picture, in groups of bounded size: rows (triangle, x, y, nx, ny)."""
    flat, w, h = triangles.screen[..., :2], canvas.width, canvas.height
    low = np.ceil(flat.min(1) - 0.5).clip(0, (w, h)).astype(np.int64)
    high = np.floor(flat.max(1) - 0.5).clip(-1, (w - 1, h - 1)).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    area = size.prod(1) * triangles.visible
    index = area.nonzero()[0]
    boxes = np.concatenate([index[:, None], low[index], size[index]], 1)
    groups = np.cumsum(area[index]) // PAIRS_AT_ONCE
    return [boxes[groups == g] for g in np.unique(groups)]


def _draw(boxes: Int[np.ndarray, "boxes 5"], triangles: _Triangles, canvas: _Canvas, style: Style) -> None:
    """Test every pixel of every box, keep the nearest hits, and shade them onto the canvas."""
    # One row per pair of box and pixel: `within` counts the pixels of a box from 0.
    counts = boxes[:, 3] * boxes[:, 4]
    owner = np.repeat(np.arange(len(boxes)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    x = boxes[owner, 1] + within % boxes[owner, 3]
    y = boxes[owner, 2] + within // boxes[owner, 3]
    face = boxes[owner, 0]
    share, inside = _barycentric(triangles.screen, face, x + 0.5, y + 0.5)
    face, share, pixel = face[inside], share[inside], (y * canvas.width + x)[inside]
    # Inverse depth, not depth, is linear in the picture: interpolate it, and correct the shares for perspective.
    inverse = triangles.screen[face, :, 2] * share
    distance = (1 / inverse.sum(1)).astype(np.float32)
    np.minimum.at(canvas.depth, pixel, distance)
    nearest = distance <= canvas.depth[pixel]
    face, pixel = face[nearest], pixel[nearest]
    share = inverse[nearest] * distance[nearest, None]
    points, normals = ((of[face] * share[..., None]).sum(1) for of in (triangles.corners, triangles.normals))
    canvas.colours[pixel] = shade(points, normals, triangles.colours[face], style)


def _barycentric(
    screen: Float[np.ndarray, "f 3 3"], face: Int[np.ndarray, " pairs"],
    x: Float[np.ndarray, " pairs"], y: Float[np.ndarray, " pairs"],
) -> tuple[Float[np.ndarray, "pairs 3"], Bool[np.ndarray, " pairs"]]:
    """Barycentric coordinates of pixel centres in their triangles' pictures, and whether they lie inside."""
    a, b, c = (screen[:, k, :2] for k in range(3))
    twice = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    scale = np.where(np.abs(twice) > 1e-12, 1 / np.where(twice == 0, 1, twice), 0)
    u = ((b[face, 0] - x) * (c[face, 1] - y) - (c[face, 0] - x) * (b[face, 1] - y)) * scale[face]
    v = ((c[face, 0] - x) * (a[face, 1] - y) - (a[face, 0] - x) * (c[face, 1] - y)) * scale[face]
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (scale[face] != 0)
    return np.stack([u, v, 1 - u - v], 1), inside


def shade(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "n 3"], style: Style
) -> Float[np.ndarray, "n 3"]:
    """Blinn-Phong shading from both sides, because files disagree about which side is out, in the camera's axes [m]."""
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
