"""Pictures of hands, side by side on one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from dro_grasp.errors import OutputError
from dro_grasp.files import replacing
from dro_grasp.hands.hand import Hand
from dro_grasp.rendering.rasterizer import Camera, render
from dro_grasp.viewer.appearance import hand_meshes
from dro_grasp.viewer.pictures import contact_sheet

TILE = (300, 280)
"""Width and height of the picture of one hand [pixels]."""
OPENNESS = 0.7
"""Share of the way from closed to open at which hands are drawn (ours)."""


def draw_hands(hands: Sequence[Hand], captions: Sequence[str], path: Path | str, title: str, columns: int = 6) -> None:
    """Write a PNG with a picture of each hand, seen from in front of its palm.

    Args:
        hands: At least one.
        captions: One for each.
        path: PNG to write.
        title: Above the pictures.
        columns: Pictures side by side.

    Raises:
        OutputError: There is no hand, or the file cannot be written.
    """
    if not hands:
        raise OutputError(f"no hand to draw into {path}; give at least one")
    sheet = contact_sheet([draw_hand(hand) for hand in hands], [(caption, None) for caption in captions], title, columns,
                          outcomes=False)
    with replacing(path, "picture") as temporary:
        sheet.save(temporary, format="PNG")


def draw_hand(hand: Hand) -> UInt8[np.ndarray, "height width 3"]:
    """The picture of one hand, almost open."""
    joints = hand.canonical_joints(OPENNESS)
    with torch.no_grad():
        meshes = hand_meshes(hand, joints, above_palm=False)
    points = np.concatenate([mesh.vertices for mesh in meshes])
    return render(meshes, Camera.around(points, *_view(hand), aspect=TILE[0] / TILE[1]), *TILE)


def _view(hand: Hand) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Direction to the camera and direction that points up: along the fingers, or out of a palm from which they stand up."""
    front = hand.palm_direction_wrist.double().numpy()
    x, y, _ = hand.palm_axes_wrist.double().numpy().T
    origins = hand.tree.forward(hand.canonical_joints(1.0))[:, :3, 3].double().numpy()
    fingers = np.mean([origins[finger.tip] - origins[finger.chain[0]] for finger in hand.fingers], 0)
    away = fingers @ front > 0.7 * np.linalg.norm(fingers)
    towards, up = (y + 0.45 * front + 0.5 * x, front) if away else (front + 0.7 * y + 0.25 * x, x)
    return tuple(towards.tolist()), tuple(up.tolist())
