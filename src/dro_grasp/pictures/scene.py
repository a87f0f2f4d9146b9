"""A picture of a scene before anything is grasped: what was taken for the object, for tables and walls, and for obstacles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from dro_grasp.files import replacing
from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.geometry.rendering.rasterizer import OBJECT_COLOUR, Camera, Colour, Mesh, arrow, dots, render
from dro_grasp.kinds import checked
from dro_grasp.objects.perception.choosing import Chosen
from dro_grasp.objects.perception.segmentation import NOTHING, SPECK
from dro_grasp.objects.scenery import FoundObject, Scene

PANEL = (640, 520)  # Width and height of each half [pixels]
LEGEND = 40  # Height of the line below them [pixels]
MOST_DOTS = 9000  # Points that are drawn (ours)
STRUCTURE_COLOUR: Colour = (0.78, 0.80, 0.83)  # Grey of tables, boards and walls
OBSTACLE_COLOUR: Colour = (0.30, 0.50, 0.78)  # Blue of what is avoided
STRAY_COLOUR: Colour = (0.55, 0.30, 0.60)  # Purple of scattered points, which count as nothing
CAMERA_COLOUR: Colour = (0.80, 0.15, 0.15)  # Red of the camera's place and direction
AROUND = 0.7  # Points farther than this from the object are not drawn [m] (ours)
ASIDE = 0.9  # Angle between the camera's view and the one from aside [rad] (ours)
LEGENDS = (("the object", OBJECT_COLOUR), ("tables, boards, walls", STRUCTURE_COLOUR), ("obstacles", OBSTACLE_COLOUR),
           ("scattered: left out", STRAY_COLOUR), ("the camera", CAMERA_COLOUR))
"""What the colours mean."""


@checked
def draw_scene(scene: Scene, found: FoundObject | Chosen | None, path: Path | str) -> None:
    """Write a PNG of a scene in colours: as the camera saw it, and from aside with the camera's place.

    `found` is the object that is meant; None draws tables, walls and things alone.

    Raises:
        ObjectError: The scene is a mesh.
        OutputError: The file cannot be written.
    """
    chosen = found.chosen if isinstance(found, FoundObject) else found
    groups = _groups(scene, chosen)
    points = np.concatenate([points for points, _ in groups])
    assert scene.sight is not None
    eye = scene.sight.T[:3, 3] if scene.sight.from_camera else points.mean(0) + np.array([0.0, -1.0, 1.0])
    up = upward(scene)
    meshes = [dots(points, colour, _radius(points)) for points, colour in groups if len(points)]
    towards = eye - points.mean(0)
    turned = _turned(towards, up)
    mark = [_camera_mark(scene)] if scene.sight.from_camera else []
    halves = [
        _half(meshes, points, towards, up),
        _half([*meshes, *mark], np.concatenate([points, eye[None]]) if mark else points, turned, up)]
    sheet = Image.new("RGB", (2 * PANEL[0], PANEL[1] + LEGEND), "white")
    for k, half in enumerate(halves):
        sheet.paste(Image.fromarray(half), (k * PANEL[0], 0))
    _write_legend(sheet)
    with replacing(path, "picture") as temporary:
        sheet.save(temporary, format="PNG")


def _groups(scene: Scene, chosen: Chosen | None) -> list[tuple[Float[np.ndarray, "n 3"], Colour]]:
    """Points near the object, or near any thing, by colour [m]."""
    labels, sight = scene.segments.labels, scene.sight
    assert sight is not None
    world, mine = sight.world(), np.zeros(len(labels), bool)
    avoided = labels >= 0 if chosen is None else np.isin(np.arange(len(labels)), chosen.others)
    if chosen is not None:
        mine[chosen.own] = True
    wanted = mine if mine.any() else labels >= 0
    middle = world[wanted].mean(0) if wanted.any() else np.median(world, axis=0)
    near = np.linalg.norm(world - middle, axis=1) < AROUND
    stray = (labels == NOTHING) | ((labels == SPECK) & ~avoided)
    things = avoided & ((labels >= 0) | (labels == SPECK))
    walls = ~mine & ~stray & ~things
    found = []
    for kept, colour in ((mine, OBJECT_COLOUR), (walls, STRUCTURE_COLOUR), (things, OBSTACLE_COLOUR),
                         (stray & ~mine, STRAY_COLOUR)):
        own = world[kept & near]
        if len(own):
            own = own[one_per_cell(own, 0.005)]
            own = own[:: max(1, len(own) // MOST_DOTS)]
        found.append((own, colour))
    return found


def _radius(points: Float[np.ndarray, "n 3"]) -> float:
    return 0.003 if len(points) < MOST_DOTS // 2 else 0.004


def upward(scene: Scene) -> tuple[float, float, float]:
    """Upward direction of the picture: that of the largest plane, or of the frame."""
    assert scene.sight is not None
    if not scene.segments.planes:
        return 0.0, 0.0, 1.0
    normals = [scene.sight.T[:3, :3] @ plane[:3] for plane in scene.segments.planes]
    level = next((n for n in normals if n[2] > 0.9), normals[0])
    return float(level[0]), float(level[1]), float(level[2])


def _turned(towards: Float[np.ndarray, "3"], up: tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    """The direction to the camera, turned aside and a little higher."""
    axis = np.asarray(up)
    flat = towards - towards @ axis * axis
    side = np.cross(axis, flat)
    if np.linalg.norm(flat) < 0.2 * np.linalg.norm(towards):
        flat = side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()]) * np.linalg.norm(towards)
    return np.cos(ASIDE) * flat + np.sin(ASIDE) * side + 0.5 * np.linalg.norm(towards) * axis


def _half(
    meshes: list[Mesh], points: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "3"], up: tuple[float, float, float]
) -> UInt8[np.ndarray, "h w 3"]:
    x, y, z = direction.tolist()
    camera = Camera.around(points, (x, y, z), up, field_of_view=0.5, aspect=PANEL[0] / PANEL[1], margin=0.03)
    return render(meshes, camera, *PANEL)


def _camera_mark(scene: Scene) -> Mesh:
    """An arrow from the camera's place along its view."""
    assert scene.sight is not None
    T = scene.sight.T
    return arrow(T[:3, 3], T[:3, 3] + 0.15 * T[:3, 2], CAMERA_COLOUR, radius=0.006)


def _write_legend(sheet: Image.Image) -> None:
    draw, font, x = ImageDraw.Draw(sheet), ImageFont.load_default(15), 16
    y = PANEL[1] + 11
    for text, colour in LEGENDS:
        draw.rectangle((x, y + 2, x + 14, y + 16), fill=tuple(int(255 * c) for c in colour))
        draw.text((x + 22, y), text, fill=(40, 44, 52), font=font)
        x += int(font.getlength(text)) + 60
