"""Pictures of grasps and of hands, alone or on one sheet, drawn without a browser, OpenGL or system packages."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from dro_grasp.devices import cores
from dro_grasp.errors import OptionError, OutputError
from dro_grasp.files import replacing
from dro_grasp.geometry.rendering.rasterizer import Camera, dots, render
from dro_grasp.grasps.batch import GraspBatch, percent
from dro_grasp.grasps.forces import forces_in_words, known
from dro_grasp.grasps.sources import require_pair
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked, checked, require_positive
from dro_grasp.objects.shape import ObjectModel, solid_of
from dro_grasp.pictures.appearance import CONTACT_COLOUR, best_camera, hand_meshes, object_meshes, success_colour
from dro_grasp.simulation import trial
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS

TILE = (320, 280)  # Width and height of the picture of one grasp [pixels]
MAX_SIDE = 4096  # Largest width and height of one picture [pixels]
PIXELS_AT_ONCE = 2048 * 2048  # Pixels that are drawn side by side (ours): bounds the memory
CONTACT_DISTANCE = 0.002  # Hand points closer than this to the object's surface count as contacts [m]
CONTACT_RADIUS = 0.0022  # Radius of a contact mark [m]
CAPTION = 26  # Height of the caption under each picture [pixels]
HEADER = 44  # Height of the title of a sheet [pixels]
INK = (40, 44, 52)  # Colour of text (red, green, blue, to 255)
FAINT = (120, 126, 136)  # Colour of captions of grasps that were not evaluated (red, green, blue, to 255)
HAND_TILE = (300, 280)  # Width and height of the picture of one hand [pixels]
OPENNESS = 0.7  # Share of the way from closed to open at which hands are drawn (ours)


@dataclass(frozen=True)
class PictureStyle(Checked):
    """How a grasp is drawn."""

    size: tuple[int, int] = TILE
    """Width and height [pixels]."""
    opacity: float = 1.0
    """Opacity of the object; below 1 the hand shows through it."""
    contacts: bool = False
    """Mark contacts in red, hidden ones too."""
    posture: Literal["held", "grasp"] = "held"
    """Hand and object after the hand has closed in a trial, or the grasp itself, which closing starts from; `draw_grasp` draws
    the joints and poses that it is given."""

    def __post_init__(self) -> None:
        """Refuse sizes and opacities out of range: OptionError."""
        super().__post_init__()
        if not (min(self.size) >= 1 and max(self.size) <= MAX_SIDE):
            raise OptionError(f"size is {self.size}; give a width and a height of 1 to {MAX_SIDE} pixels (size=...)")
        if not 0 <= self.opacity <= 1:
            raise OptionError(f"opacity is {self.opacity}; give a number from 0 to 1 (opacity=...)")


Tile = tuple[UInt8[np.ndarray, "height width 3"], str, bool | None]
"""A picture, its caption, and the trial outcome that gives its colour."""


@checked
def draw_grasps(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, path: Path | str, count: int = 16, columns: int = 4,
    style: PictureStyle | None = None,
) -> None:
    """Write a PNG with pictures of the first `count` grasps, `columns` side by side, captioned with score and trial outcome.

    They are drawn as they hold the object after closing, a bare cloud as the balls that stand for it, unless the style asks for
    the grasps themselves or the hand came without its description. Links above the hand's palm are not drawn.

    Raises:
        OptionError: `count` or `columns` is not positive.
        OutputError: The file cannot be written, or there is no grasp.
    """
    require_pair(hand, obj)
    require_positive(count=count, columns=columns)
    closed = ", drawn after closing" if shows_held(hand, style) else ""
    _save(_tiles(hand, obj, grasps[:count], style), heading(hand, obj, grasps) + closed, path, columns)


def draw_sheet(
    hand: Hand, pairs: Sequence[tuple[ObjectModel, GraspBatch]], path: Path | str, columns: int = 4,
    style: PictureStyle | None = None,
) -> None:
    """Write a PNG with pictures of all given grasps, of one object or several, as `draw_grasps` draws them.

    Raises:
        OptionError: `columns` is not positive.
        OutputError: The file cannot be written, or there is no grasp.
    """
    count = max(1, sum(len(grasps) for _, grasps in pairs))
    require_positive(count=count, columns=columns)
    if len(pairs) == 1:
        (obj, grasps), = pairs
        return draw_grasps(hand, obj, grasps, path, count, columns, style)
    tiles = [(tile, f"{obj.name}   {text}", passed) for obj, grasps in pairs
             for tile, text, passed in _tiles(hand, obj, grasps, style)]
    together = GraspBatch.concatenate([grasps for _, grasps in pairs])
    _save(tiles, f"{hand.name} on {len(pairs)} objects: {_told(together)}", path, columns)


def _tiles(hand: Hand, obj: ObjectModel, grasps: GraspBatch, style: PictureStyle | None) -> list[Tile]:
    """Captioned pictures of grasps of one object."""
    drawn = after_closing(hand, obj, grasps) if shows_held(hand, style) else grasps
    width, height = (style or PictureStyle()).size
    with ThreadPoolExecutor(max(1, min(cores(), PIXELS_AT_ONCE // (width * height)))) as threads:
        tiles = threads.map(lambda i: draw_grasp(hand, obj, drawn, i, style), range(len(grasps)))
        return [(tile, *caption(grasps, i)) for i, tile in enumerate(tiles)]


def _save(tiles: list[Tile], title: str, path: Path | str, columns: int, outcomes: bool = True) -> None:
    if not tiles:
        raise OutputError(f"no {'grasp' if outcomes else 'hand'} to draw into {path}; ask for at least one")
    pictures, captions = [tile[0] for tile in tiles], [tile[1:] for tile in tiles]
    with replacing(path, "picture") as temporary:
        contact_sheet(pictures, captions, title, columns, outcomes).save(temporary, format="PNG")


def shows_held(hand: Hand, style: PictureStyle | None) -> bool:
    """Whether grasps are drawn after closing, which needs the hand's description."""
    return (style or PictureStyle()).posture == "held" and hand.description is not None


def after_closing(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> GraspBatch:
    """The grasps as they hold the object after closing, each under the protocol of its trial; balls stand for a bare cloud."""
    solid = solid_of(obj)
    names = [protocol_name(label) for label in grasps.protocol]
    joints, poses = grasps.joints.clone(), grasps.T_object_wrist.clone()
    for name in set(names):
        rows = torch.tensor([i for i, own in enumerate(names) if own == name])
        closed = trial.after_closing(hand, solid, grasps[rows], name)
        joints[rows], poses[rows] = closed.joints, closed.T_object_wrist
    return grasps.replace(joints=joints, T_object_wrist=poses)


def protocol_name(label: str) -> str:
    """Name of the protocol of a trial's label, such as `strict/1`; the default one where there was no trial of a known one."""
    name = re.split("[+/]", label)[0]
    return name if name in PROTOCOLS else DEFAULT_PROTOCOL


def draw_grasp(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, index: int, style: PictureStyle | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture of one grasp, from the viewpoint that shows most of object and fingers."""
    style = style or PictureStyle()
    joints, T = grasps.joints[index].float(), grasps.T_object_wrist[index].float()
    with torch.no_grad():
        fingers = hand_meshes(hand, joints, T, above_palm=False)
        camera = best_camera(hand, joints, T, obj, aspect=style.size[0] / style.size[1])
        contacts = contact_points(hand, obj, joints, T) if style.contacts else np.zeros((0, 3))
    # Of a picture this large nobody sees single pixels, and smooth edges would take four times the memory.
    oversampling = 2 if style.size[0] * style.size[1] <= PIXELS_AT_ONCE else 1
    whole = render([*object_meshes(obj), *fingers], camera, *style.size, oversampling=oversampling)
    if style.opacity < 1:
        behind = render(fingers, camera, *style.size, oversampling=oversampling)
        whole = (style.opacity * whole + (1 - style.opacity) * behind + 0.5).astype(np.uint8)
    if len(contacts):
        marks = render([dots(contacts, CONTACT_COLOUR, CONTACT_RADIUS)], camera, *style.size, oversampling=oversampling)
        whole = np.where((marks < 250).any(-1, keepdims=True), marks, whole)
    return whole


def contact_points(
    hand: Hand, obj: ObjectModel, joints: Float[Tensor, " n_dof"], T_object_wrist: Float[Tensor, "4 4"]
) -> Float[np.ndarray, "k 3"]:
    """Points of the posed hand in contact with the object [m]."""
    points = hand.points(joints, T_object_wrist)
    return points[obj.distance_field.distances(points)[0].abs() < CONTACT_DISTANCE].double().numpy()


def draw_hands(hands: Sequence[Hand], captions: Sequence[str], path: Path | str, title: str) -> None:
    """Write a PNG with a captioned picture of each hand, six side by side, seen from in front of its palm.

    Raises:
        OutputError: There is no hand, or the file cannot be written.
    """
    tiles: list[Tile] = [(draw_hand(hand), text, None) for hand, text in zip(hands, captions, strict=True)]
    _save(tiles, title, path, columns=6, outcomes=False)


def draw_hand(hand: Hand) -> UInt8[np.ndarray, "height width 3"]:
    """The picture of one hand, almost open."""
    with torch.no_grad():
        meshes = hand_meshes(hand, hand.canonical_joints(OPENNESS), above_palm=False)
    points = np.concatenate([mesh.vertices for mesh in meshes])
    return render(meshes, Camera.around(points, *_view(hand), aspect=HAND_TILE[0] / HAND_TILE[1]), *HAND_TILE)


def _view(hand: Hand) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Direction to the camera and direction that points up: along the fingers, or out of a palm from which they stand up."""
    front = hand.palm_direction_wrist.double().numpy()
    x, y, _ = hand.palm_axes_wrist.double().numpy().T
    origins = hand.tree.forward(hand.canonical_joints(1.0))[:, :3, 3].double().numpy()
    fingers = np.mean([origins[finger.tip] - origins[finger.chain[0]] for finger in hand.fingers], 0)
    away = fingers @ front > 0.7 * np.linalg.norm(fingers)
    towards, up = (y + 0.45 * front + 0.5 * x, front) if away else (front + 0.7 * y + 0.25 * x, x)
    return tuple(towards.tolist()), tuple(up.tolist())


def heading(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> str:
    """Title of a sheet."""
    return f"{hand.name} on {obj.name}: {_told(grasps)}"


def _told(grasps: GraspBatch) -> str:
    """Number and outcome of grasps."""
    text = f"{len(grasps)} grasp" + "s" * (len(grasps) != 1)
    if not bool(grasps.evaluated.any()):
        return text
    protocols = sorted({p for p in grasps.protocol if p})
    of = int(grasps.evaluated.sum()) + grasps.out_of - len(grasps)
    return f"{text}, {int(grasps.success.sum())} of {of} succeeded ({', '.join(protocols)})"


def outcome(grasps: GraspBatch, index: int) -> bool | None:
    """Whether a grasp passed its trial; None if it was not evaluated."""
    return bool(grasps.success[index]) if bool(grasps.evaluated[index]) else None


def caption(grasps: GraspBatch, index: int) -> tuple[str, bool | None]:
    """The caption of a picture, and the trial outcome that gives its colour."""
    words = {True: "success", False: "failed", None: "not evaluated"}[outcome(grasps, index)]
    confidence, energy = percent(float(grasps.confidence[index])), float(grasps.energy[index])
    numbers = "" if confidence is None else f"   confidence {confidence}"
    numbers += f"   energy {energy:.2f}" if math.isfinite(energy) else ""
    numbers += f"   {told}" if (told := forces_in_words(known(grasps.payload[index]), None)) else ""
    return f"{index}   {words}{numbers}", outcome(grasps, index)


def contact_sheet(
    tiles: list[UInt8[np.ndarray, "height width 3"]], captions: Sequence[tuple[str, bool | None]], title: str,
    columns: int = 4, outcomes: bool = True,
) -> Image.Image:
    """A grid of captioned pictures under a title, as wide as captions need; these tell outcomes in colour, if there are any."""
    height, width = tiles[0].shape[:2]
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    font, large = ImageFont.load_default(14), ImageFont.load_default(18)
    left = 34 if outcomes else 16
    cell = max(width, left + math.ceil(max(font.getlength(text) for text, _ in captions)) + 8)
    wide = max(columns * cell, math.ceil(large.getlength(title)) + 32)
    sheet = Image.new("RGB", (wide, HEADER + rows * (height + CAPTION)), (255, 255, 255))
    pen = ImageDraw.Draw(sheet)
    pen.text((16, 12), title, fill=INK, font=large)
    for i, (tile, (text, passed)) in enumerate(zip(tiles, captions, strict=True)):
        x, y = (i % columns) * cell, HEADER + (i // columns) * (height + CAPTION)
        sheet.paste(Image.fromarray(tile), (x + (cell - width) // 2, y))
        if outcomes:
            red, green, blue = (int(255 * c) for c in success_colour(passed))
            pen.ellipse((x + 16, y + height + 5, x + 26, y + height + 15), fill=(red, green, blue))
        pen.text((x + left, y + height + 1), text, fill=INK if passed is not None else FAINT, font=font)
    return sheet
