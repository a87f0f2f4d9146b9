"""Pictures of triangle meshes without OpenGL: a depth-buffered software renderer for any machine with NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

NEAR = 1e-3
"""Triangles closer to the camera than this are not drawn [m]."""
PAIRS_AT_ONCE = 4_000_000
"""Triangle and pixel pairs that are tested together; bounds the memory."""
WHITE = (1.0, 1.0, 1.0)

Colour = tuple[float, float, float]
"""Red, green, blue between 0 and 1."""


@dataclass(frozen=True)
class Mesh:
    """Triangles of one colour."""

    vertices: Float[np.ndarray, "n 3"]
    """World coordinates [m]."""
    faces: Int[np.ndarray, "m 3"]
    """Vertex indices."""
    colour: Colour
    """Before shading."""


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from."""

    position: tuple[float, float, float]
    """[m]"""
    target: tuple[float, float, float]
    """The point in the middle of the picture [m]."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points up in the picture."""
    field_of_view: float = 0.6
    """Angle between the upper and lower edges [rad]."""

    @staticmethod
    def around(
        points: Float[np.ndarray, "n 3"],
        direction: tuple[float, float, float],
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        field_of_view: float = 0.6,
        aspect: float = 4 / 3,
        margin: float = 0.06,
    ) -> Camera:
        """The nearest camera that sees all points from `direction` (from the points towards the camera).

        Args:
            points: What must be in the picture [m].
            direction: Towards the camera.
            up: Direction that points up in the picture.
            field_of_view: Angle between the upper and lower edges [rad].
            aspect: Width of the picture over its height.
            margin: Share of the picture that stays free at each edge.
        """
        axes = Camera(direction, (0.0, 0.0, 0.0), up).axes()
        seen = points.astype(float) @ axes.T
        centre = (seen.min(0) + seen.max(0)) / 2
        seen = seen - centre
        half = np.tan(field_of_view / 2) * (1 - 2 * margin)
        distance = float((np.abs(seen[:, :2]) / (half * aspect, half) + seen[:, 2:]).max()) + 10 * NEAR
        target = centre @ axes
        position = target + distance * axes[2]
        return Camera(tuple(position.tolist()), tuple(target.tolist()), up, field_of_view)

    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Right, up and backward of the picture in world coordinates, as rows."""
        backward = _unit(np.subtract(self.position, self.target))
        up = np.asarray(self.up, float)
        if np.linalg.norm(np.cross(up, backward)) < 1e-6 * np.linalg.norm(up):
            up = np.eye(3)[np.abs(backward).argmin()]
        right = _unit(np.cross(up, backward))
        return np.stack([right, np.cross(backward, right), backward])


@dataclass(frozen=True)
class Style:
    """Light and finish of a picture."""

    ambient: float = 0.44
    diffuse: float = 0.64
    specular: float = 0.16
    shininess: float = 24.0
    crease: float = 0.85
    """Faces whose normal has a smaller cosine to the vertex normal keep a sharp edge."""
    outline: float = 4.0
    """Darkening of depth steps, which separates fingers from what lies behind."""
    outline_scale: float = 0.02
    """Depth step that is darkened fully [m]."""
    light: tuple[float, float, float] = (-0.45, 0.65, 0.75)
    """Direction towards the light: right, up and backward of the picture."""


def render(
    meshes: Sequence[Mesh | tuple[np.ndarray, np.ndarray, Colour]],
    camera: Camera,
    width: int = 640,
    height: int = 480,
    *,
    background: Colour = WHITE,
    oversampling: int = 2,
    style: Style | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw meshes with perspective, smooth shading and soft outlines.

    Args:
        meshes: What to draw: `Mesh`, or (vertices, faces, colour).
        camera: From where.
        width: Of the picture [pixels].
        height: Of the picture [pixels].
        background: Colour where there is nothing.
        oversampling: Samples per pixel and axis; 2 smooths the edges.
        style: Light and finish.
    """
    style = style or Style()
    items = [m if isinstance(m, Mesh) else Mesh(*m) for m in meshes]
    w, h = width * oversampling, height * oversampling
    corners, normals, colours = _gather(items, camera, style)
    picture = np.broadcast_to(np.asarray(background, np.float32), (h * w, 3)).copy()
    depth = np.full(h * w, np.inf, np.float32)
    screen, keep = _project(corners, camera, w, h)
    for part in _chunks(screen, keep, w, h):
        _draw(part, screen, corners, normals, colours, picture, depth, w, h, style)
    picture = picture.reshape(h, w, 3)
    picture *= _outlines(depth.reshape(h, w), oversampling, style)[..., None]
    picture = picture.reshape(height, oversampling, width, oversampling, 3).mean((1, 3))
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def arrow(
    start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"], colour: Colour, radius: float = 0.002, sides: int = 12
) -> Mesh:
    """A shaft with a head, from `start` to `end` [m]."""
    along = np.asarray(end, float) - np.asarray(start, float)
    length = float(np.linalg.norm(along))
    head = min(5 * radius, 0.5 * length)
    profile = [(0, 0.0), (0, radius), (length - head, radius), (length - head, 2.5 * radius), (length, 0.0)]
    forward = along / max(length, 1e-12)
    side = _unit(np.cross(forward, np.eye(3)[np.abs(forward).argmin()]))
    other = np.cross(forward, side)
    angles = np.arange(sides) * 2 * np.pi / sides
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * other
    vertices = np.concatenate([np.asarray(start) + z * forward + r * ring for z, r in profile])
    i = np.arange(sides)
    j = (i + 1) % sides
    quads = [np.stack([[a * sides + i, a * sides + j, a * sides + j + sides],
                       [a * sides + i, a * sides + j + sides, a * sides + i + sides]]).transpose(0, 2, 1).reshape(-1, 3)
             for a in range(len(profile) - 1)]
    return Mesh(vertices, np.concatenate(quads), colour)


def dots(points: Float[np.ndarray, "n 3"], colour: Colour, radius: float = 0.0015) -> Mesh:
    """Small octahedra at points [m]."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * radius
    one = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    vertices = (np.asarray(points, float)[:, None] + corners).reshape(-1, 3)
    return Mesh(vertices, (one + 6 * np.arange(len(points))[:, None, None]).reshape(-1, 3), colour)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / max(float(np.linalg.norm(v)), 1e-12)


def _gather(
    meshes: list[Mesh], camera: Camera, style: Style
) -> tuple[Float[np.ndarray, "f 3 3"], Float[np.ndarray, "f 3 3"], Float[np.ndarray, "f 3"]]:
    """Corners and corner normals of all triangles in camera axes, and their colours."""
    axes = camera.axes()
    corners, normals, colours = [np.zeros((0, 3, 3))], [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    for mesh in meshes:
        vertices = (np.asarray(mesh.vertices, float) - camera.position) @ axes.T
        faces = np.asarray(mesh.faces, np.int64)
        corners.append(vertices[faces])
        normals.append(corner_normals(vertices, faces, style.crease))
        colours.append(np.broadcast_to(np.asarray(mesh.colour, float), (len(faces), 3)))
    return np.concatenate(corners), np.concatenate(normals), np.concatenate(colours)


def corner_normals(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], crease: float
) -> Float[np.ndarray, "m 3 3"]:
    """Normals for smooth shading that keep sharp edges sharp."""
    triangle = vertices[faces]
    face = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    # Files repeat a vertex for every face that uses it: vertices at the same place share their normal.
    _, place = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    place = place.reshape(-1)
    total = np.zeros((place.max(initial=-1) + 1, 3))
    for k in range(3):
        np.add.at(total, place[faces[:, k]], face)
    flat = face / np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-20)
    smooth = total[place[faces]]
    smooth = smooth / np.maximum(np.linalg.norm(smooth, axis=2, keepdims=True), 1e-20)
    sharp = (smooth * flat[:, None]).sum(2, keepdims=True) < crease
    return np.where(sharp, flat[:, None], smooth)


def _project(
    corners: Float[np.ndarray, "f 3 3"], camera: Camera, w: int, h: int
) -> tuple[Float[np.ndarray, "f 3 3"], Bool[np.ndarray, " f"]]:
    """Pixel coordinates with inverse depth of the corners, and which triangles lie before the camera."""
    depth = -corners[..., 2]
    keep = np.asarray((depth > NEAR).all(1))
    focal = h / 2 / np.tan(camera.field_of_view / 2)
    inverse = 1 / np.maximum(depth, NEAR)
    x = w / 2 + focal * corners[..., 0] * inverse
    y = h / 2 - focal * corners[..., 1] * inverse
    return np.stack([x, y, inverse], -1), keep


def _chunks(screen: np.ndarray, keep: np.ndarray, w: int, h: int) -> list[np.ndarray]:
    """Indices of the visible triangles with their pixel boxes, in groups of bounded size: rows (i, x0, y0, nx, ny)."""
    low = np.ceil(screen[..., :2].min(1) - 0.5).clip(0, (w, h)).astype(np.int64)
    high = np.floor(screen[..., :2].max(1) - 0.5).clip(-1, (w - 1, h - 1)).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    area = size.prod(1) * keep
    index = area.nonzero()[0]
    boxes = np.concatenate([index[:, None], low[index], size[index]], 1)
    groups = np.cumsum(area[index]) // PAIRS_AT_ONCE
    return [boxes[groups == g] for g in np.unique(groups)]


def _draw(
    boxes: np.ndarray, screen: np.ndarray, corners: np.ndarray, normals: np.ndarray, colours: np.ndarray,
    picture: np.ndarray, depth: np.ndarray, w: int, h: int, style: Style,
) -> None:
    """Test every pixel of every box, keep the nearest hits, and shade them into the picture."""
    counts = boxes[:, 3] * boxes[:, 4]
    owner = np.repeat(np.arange(len(boxes)), counts)
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    x = boxes[owner, 1] + within % boxes[owner, 3]
    y = boxes[owner, 2] + within // boxes[owner, 3]
    face = boxes[owner, 0]
    share, inside = _barycentric(screen, face, x + 0.5, y + 0.5)
    face, share, pixel = face[inside], share[inside], (y * w + x)[inside]
    inverse = screen[face, :, 2] * share
    distance = (1 / inverse.sum(1)).astype(np.float32)
    np.minimum.at(depth, pixel, distance)
    nearest = distance <= depth[pixel]
    face, pixel = face[nearest], pixel[nearest]
    share = inverse[nearest] * distance[nearest, None]
    picture[pixel] = _shade(
        (corners[face] * share[..., None]).sum(1), (normals[face] * share[..., None]).sum(1), colours[face], style
    )


def _barycentric(
    screen: np.ndarray, face: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates of pixel centres in the picture, and whether they lie inside."""
    a, b, c = (screen[:, k, :2] for k in range(3))
    twice = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    scale = np.where(np.abs(twice) > 1e-12, 1 / np.where(twice == 0, 1, twice), 0)
    u = ((b[face, 0] - x) * (c[face, 1] - y) - (c[face, 0] - x) * (b[face, 1] - y)) * scale[face]
    v = ((c[face, 0] - x) * (a[face, 1] - y) - (a[face, 0] - x) * (c[face, 1] - y)) * scale[face]
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (scale[face] != 0)
    return np.stack([u, v, 1 - u - v], 1), inside


def _shade(points: np.ndarray, normals: np.ndarray, colours: np.ndarray, style: Style) -> np.ndarray:
    """Blinn-Phong shading from both sides, since files disagree about which side is out."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    view = -points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    normals = np.where((normals * view).sum(1, keepdims=True) < 0, -normals, normals)
    light = _unit(np.asarray(style.light, float))
    facing = (normals @ light).clip(0)
    middle = view + light
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    gloss = (normals * middle).sum(1).clip(0) ** style.shininess
    return colours * (style.ambient + style.diffuse * facing)[:, None] + style.specular * gloss[:, None]


def _outlines(depth: np.ndarray, radius: int, style: Style) -> np.ndarray:
    """Darkening where something lies clearly behind: the usual eye-dome lighting."""
    padded = np.pad(depth, radius, mode="edge")
    h, w = depth.shape
    total = np.zeros((h, w), np.float32)
    shifts = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if (dx, dy) != (0, 0)]
    own = np.where(np.isfinite(depth), depth, 1e6)
    for dx, dy in shifts:
        other = padded[radius * (1 + dy) : radius * (1 + dy) + h, radius * (1 + dx) : radius * (1 + dx) + w]
        nearer = (own - np.where(np.isfinite(other), other, 1e6)) / style.outline_scale
        total += nearer.clip(0, 1)
    shade = np.exp(-style.outline * total / len(shifts) / 4)
    return np.where(np.isfinite(depth), shade, np.maximum(shade, 0.55))
