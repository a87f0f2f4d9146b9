"""Pictures of triangle meshes without OpenGL: a depth-buffered software renderer for any machine with NumPy."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, Num, UInt8

Colour = tuple[float, float, float]  # Red, green, blue between 0 and 1
OBJECT_COLOUR: Colour = (0.95, 0.62, 0.28)  # Orange of objects that are grasped
NEAR = 1e-3  # Triangles closer to the camera than this are not drawn [m] (ours)
ROWS_AT_ONCE = 200_000  # Rows of pixels, of all triangles, that are drawn together (ours): bounds the memory
SAMPLES_AT_ONCE = 500_000  # Samples that are shaded together (ours); likewise


@dataclass(frozen=True)
class Mesh:
    """Triangles of one colour."""

    vertices: Num[np.ndarray, "n 3"]  # world coordinates [m]
    faces: Int[np.ndarray, "m 3"]  # vertex indices
    colour: Colour  # before shading


SIDES = 12  # Of an arrow


def arrow(start: Num[np.ndarray, "3"], end: Num[np.ndarray, "3"], colour: Colour, radius: float = 0.002) -> Mesh:
    """A shaft with a head, from `start` to `end` [m]."""
    along = np.asarray(end, float) - np.asarray(start, float)
    length = float(np.linalg.norm(along))
    head = min(5 * radius, 0.5 * length)
    profile = [(0, 0.0), (0, radius), (length - head, radius), (length - head, 2.5 * radius), (length, 0.0)]
    forward = along / max(length, 1e-12)
    side = unit(np.cross(forward, np.eye(3)[np.abs(forward).argmin()]))
    other = np.cross(forward, side)
    angles = np.arange(SIDES) * 2 * np.pi / SIDES
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * other
    vertices = np.concatenate([np.asarray(start) + z * forward + r * ring for z, r in profile])
    i = np.arange(SIDES)
    j = (i + 1) % SIDES
    # Two triangles per side between each ring of the profile and the next.
    quads = [np.stack([[a * SIDES + i, a * SIDES + j, a * SIDES + j + SIDES],
                       [a * SIDES + i, a * SIDES + j + SIDES, a * SIDES + i + SIDES]]).transpose(0, 2, 1).reshape(-1, 3)
             for a in range(len(profile) - 1)]
    return Mesh(vertices, np.concatenate(quads), colour)


def dots(points: Num[np.ndarray, "n 3"], colour: Colour, radius: float = 0.0015) -> Mesh:
    """Small octahedra at points [m]."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * radius
    one = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    vertices = (np.asarray(points, float)[:, None] + corners).reshape(-1, 3)
    return Mesh(vertices, (one + 6 * np.arange(len(points))[:, None, None]).reshape(-1, 3), colour)


def corner_normals(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], crease: float
) -> Float[np.ndarray, "m 3 3"]:
    """Unit normals at the corners of faces: smooth, but flat where the cosine between face and vertex is below `crease`."""
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


def unit(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The vector at length 1; zero stays zero."""
    return v / max(float(np.linalg.norm(v)), 1e-12)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    position: tuple[float, float, float]  # optical centre [m]
    target: tuple[float, float, float]  # the point in the middle of the picture [m]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # direction that points up in the picture
    field_of_view: float = 0.6  # angle between the upper and lower edges [rad]

    @staticmethod
    def around(
        points: Num[np.ndarray, "n 3"], direction: tuple[float, float, float], up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        field_of_view: float = 0.6, aspect: float = 4 / 3, margin: float = 0.06,
    ) -> Camera:
        """The nearest camera in a direction, from the points [m] towards it, that has all of them in its picture.

        `aspect` is the picture's width over its height, `margin` the share that stays free at each edge.
        """
        axes = Camera(direction, (0.0, 0.0, 0.0), up).axes()
        turned = points.astype(float) @ axes.T
        centre = (turned.min(0) + turned.max(0)) / 2
        turned = turned - centre
        half = np.tan(field_of_view / 2) * (1 - 2 * margin)
        distance = float((np.abs(turned[:, :2]) / (half * aspect, half) + turned[:, 2:]).max()) + 10 * NEAR
        target = centre @ axes
        position = target + distance * axes[2]
        return Camera(tuple(position.tolist()), tuple(target.tolist()), up, field_of_view)

    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Right, up and backward of the picture in world coordinates, as rows."""
        backward = unit(np.subtract(self.position, self.target))
        up = np.asarray(self.up, float)
        if np.linalg.norm(np.cross(up, backward)) < 1e-6 * np.linalg.norm(up):
            up = np.eye(3)[np.abs(backward).argmin()]
        right = unit(np.cross(up, backward))
        return np.stack([right, np.cross(backward, right), backward])

    def project(
        self, corners: Float[np.ndarray, "f 3 3"], width: int, height: int
    ) -> tuple[Float[np.ndarray, "f 3 3"], Bool[np.ndarray, " f"]]:
        """Pixel coordinates and inverse depth [1/m] of triangle corners, and which triangles lie before the camera.

        Corners are in the camera's axes [m], width and height those of the picture [pixels].
        """
        depth = -corners[..., 2]
        visible = np.asarray((depth > NEAR).all(1))
        focal = height / 2 / np.tan(self.field_of_view / 2)
        inverse = 1 / np.maximum(depth, NEAR)
        x = width / 2 + focal * corners[..., 0] * inverse
        y = height / 2 - focal * corners[..., 1] * inverse
        return np.stack([x, y, inverse], -1), visible


@dataclass(frozen=True)
class Style:
    """Light and finish of a picture. Values are ours."""

    ambient: float = 0.44  # share of the colour that needs no light
    diffuse: float = 0.64  # share of the colour that grows with the cosine between normal and light
    specular: float = 0.16  # strength of the gloss
    shininess: float = 24.0  # exponent of the gloss: larger makes it smaller
    crease: float = 0.85  # faces whose normal has a smaller cosine to the vertex normal keep a sharp edge
    outline: float = 4.0  # darkening at depth steps, which separates fingers from the background
    outline_scale: float = 0.02  # depth step that is darkened fully [m]
    light: tuple[float, float, float] = (-0.45, 0.65, 0.75)
    """Direction towards the light: right, up and backward of the picture."""


@dataclass(frozen=True)
class _Triangles:
    """All triangles of a picture, three corners each."""

    corners: Float[np.ndarray, "f 3 3"]  # positions in the camera's axes [m]
    normals: Float[np.ndarray, "f 3 3"]  # unit normals in the camera's axes
    colours: Float[np.ndarray, "f 3"]
    screen: Float[np.ndarray, "f 3 3"]  # pixel coordinates, and inverse depth [1/m]
    visible: Bool[np.ndarray, " f"]  # whether the triangle lies before the camera

    @cached_property
    def shares(self) -> Float[np.ndarray, "3 3 f"]:
        """Coefficients (of x, of y, constant) of each corner's barycentric coordinate; negative for slivers."""
        x, y = self.screen[..., 0].T, self.screen[..., 1].T
        (x1, y1), (x2, y2) = ((x[order], y[order]) for order in ([1, 2, 0], [2, 0, 1]))
        twice = np.stack([y1 - y2, x2 - x1, x1 * y2 - x2 * y1])
        area = twice[2].sum(0)
        drawn = np.abs(area) > 1e-9  # twice the area [pixels^2] (ours)
        return np.where(drawn, twice / np.where(drawn, area, 1.0), np.array([0.0, 0.0, -1.0])[:, None, None])

    @cached_property
    def depths(self) -> Float[np.ndarray, "3 f"]:
        """Coefficients (of x, of y, constant) of the inverse depth over the picture, where it is linear."""
        return np.einsum("ckf,fk->cf", self.shares, self.screen[..., 2])


@dataclass(frozen=True)
class _Canvas:
    """The samples of a picture, row by row; filled in place."""

    width: int
    height: int
    inverse: Float[np.ndarray, " samples"]  # inverse depth of the nearest triangle [1/m]; 0 where there is none
    face: Int[np.ndarray, " samples"]  # that triangle, where there is one


def render(
    meshes: Sequence[Mesh], camera: Camera, width: int = 640, height: int = 480, *, oversampling: int = 2,
    style: Style | None = None,
) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Draw meshes with perspective, smooth shading and soft outlines, on white; `oversampling` samples a pixel and axis."""
    style = style or Style()
    samples = width * height * oversampling**2
    canvas = _Canvas(width * oversampling, height * oversampling, np.zeros(samples), np.zeros(samples, np.int64))
    triangles = _gather(meshes, camera, canvas, style)
    rows = _rows(triangles, canvas)
    for start in range(0, len(rows), ROWS_AT_ONCE):
        _draw(rows[start : start + ROWS_AT_ONCE], triangles, canvas)
    picture = _shaded(triangles, canvas, style).reshape(canvas.height, canvas.width, 3)
    with np.errstate(divide="ignore"):
        depth = (1 / canvas.inverse).astype(np.float32)
    picture *= outlines(depth.reshape(canvas.height, canvas.width), oversampling, style)[..., None]
    steps = range(oversampling)
    mean = np.zeros((height, width, 3), np.float32)
    for i, j in itertools.product(steps, steps):
        mean += picture[i::oversampling, j::oversampling] / oversampling**2
    return (mean.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def _gather(meshes: Sequence[Mesh], camera: Camera, canvas: _Canvas, style: Style) -> _Triangles:
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


def _rows(triangles: _Triangles, canvas: _Canvas) -> Int[np.ndarray, "_ 2"]:
    """The rows of pixels that each visible triangle may cover: (triangle, y)."""
    y = triangles.screen[..., 1]
    low = np.ceil(y.min(1) - 0.5).clip(0, canvas.height).astype(np.int64)
    high = np.floor(y.max(1) - 0.5).clip(-1, canvas.height - 1).astype(np.int64)
    face, within = _runs(np.where(triangles.visible, high - low + 1, 0))
    return np.stack([face, low[face] + within], 1)


def _runs(counts: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " total"], Int[np.ndarray, " total"]]:
    """For each of `counts[i]` entries of every i, one i after the other: i, and its place among them from 0."""
    counts = np.maximum(counts, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]


def _draw(rows: Int[np.ndarray, "rows 2"], triangles: _Triangles, canvas: _Canvas) -> None:
    """Find the span of pixels of every row that its triangle covers, and keep the nearest triangles."""
    face, y = rows.T
    # A pixel is inside where its three barycentric coordinates, linear in x along a row, are not negative.
    slope, of_y, constant = triangles.shares[..., face]
    start = of_y * (y + 0.5) + constant
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = -start / slope
    left = np.where(slope > 0, crossing, np.where((slope == 0) & (start < 0), np.inf, -np.inf)).max(0)
    right = np.where(slope < 0, crossing, np.inf).min(0)
    first = np.ceil(left - 0.5).clip(0, canvas.width).astype(np.int64)
    last = np.floor(right - 0.5).clip(-1, canvas.width - 1).astype(np.int64)
    row, within = _runs(last - first + 1)
    x = first[row] + within
    of_x, of_y, constant = triangles.depths[:, face]
    inverse = of_x[row] * (x + 0.5) + (of_y * (y + 0.5) + constant)[row]
    pixel = (y * canvas.width)[row] + x
    np.maximum.at(canvas.inverse, pixel, inverse)
    nearest = inverse >= canvas.inverse[pixel]
    canvas.face[pixel[nearest]] = face[row[nearest]]


def _shaded(triangles: _Triangles, canvas: _Canvas, style: Style) -> Float[np.ndarray, "samples 3"]:
    colours = np.ones((len(canvas.face), 3), np.float32)
    shares = triangles.shares
    corners, normals_of, colours_of = (
        values.astype(np.float32) for values in (triangles.corners, triangles.normals, triangles.colours))
    drawn = canvas.inverse.nonzero()[0]
    for start in range(0, len(drawn), SAMPLES_AT_ONCE):
        pixel = drawn[start : start + SAMPLES_AT_ONCE]
        face, inverse = canvas.face[pixel], canvas.inverse[pixel]
        y, x = np.divmod(pixel, canvas.width)
        of_x, of_y, constant = shares[..., face]
        share = (of_x * (x + 0.5) + of_y * (y + 0.5) + constant) * triangles.screen[..., 2].T[:, face] / inverse
        points, normals = (
            np.einsum("kp,pkc->pc", share.astype(np.float32), of[face]) for of in (corners, normals_of))
        colours[pixel] = shade(points, normals, colours_of[face], style)
    return colours


def shade(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "n 3"], style: Style
) -> Float[np.ndarray, "n 3"]:
    """Blinn-Phong shading from both sides, because files disagree about which side is out, in the camera's axes [m]."""
    normals, view = _units(normals), _units(-points)
    facing_back = np.einsum("nk,nk->n", normals, view) < 0
    normals = np.where(facing_back[:, None], -normals, normals)
    light = unit(np.asarray(style.light, float)).astype(points.dtype)
    facing = (normals @ light).clip(0)
    gloss = np.einsum("nk,nk->n", normals, _units(view + light)).clip(0) ** style.shininess
    return colours * (style.ambient + style.diffuse * facing)[:, None] + style.specular * gloss[:, None]


def _units(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The vectors at length 1; zero stays zero."""
    return vectors / np.sqrt(np.einsum("nk,nk->n", vectors, vectors)).clip(1e-12)[:, None]


def outlines(depth: Float[np.ndarray, "h w"], radius: int, style: Style) -> Float[np.ndarray, "h w"]:
    """Factor on the colour of each pixel that darkens what lies behind its neighbours `radius` pixels away; depths in [m]."""
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
