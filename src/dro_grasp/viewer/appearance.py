"""What there is to see of a grasp: posed link shapes, the object, colours, and where to look from."""

from __future__ import annotations

import colorsys
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.rendering.rasterizer import Camera, Colour, Mesh, dots

OBJECT_COLOUR: Colour = (0.95, 0.62, 0.28)
PALM_COLOUR: Colour = (0.58, 0.62, 0.69)
PREDICTED_COLOUR: Colour = (0.85, 0.20, 0.55)
SOLVED_COLOUR: Colour = (0.15, 0.45, 0.85)
SUCCESS_COLOUR: Colour = (0.16, 0.60, 0.30)
FAILURE_COLOUR: Colour = (0.80, 0.22, 0.20)
UNTRIED_COLOUR: Colour = (0.50, 0.50, 0.50)

CELLS = 28
"""Cells along each side of the coarse picture that rates a viewpoint."""
VIEWPOINTS = 48
"""Viewpoints that are rated."""
LOWEST_VIEW, HIGHEST_VIEW = -0.5, 0.85
"""Cameras stay between these heights on the unit sphere: neither straight from below nor from above."""


def finger_of_link(hand: Hand) -> list[int]:
    """The finger that each link belongs to, counted from 0; -1 for the palm and what lies above it."""
    finger, count = [-1] * hand.tree.n_links, 0
    for link, parent in enumerate(hand.tree.parent):
        if parent == hand.palm:
            # A palm may carry fixed links (covers, sensors): only branches with a moving joint are fingers.
            finger[link], count = count, count + 1
        elif parent >= 0:
            finger[link] = finger[parent]
    moving = {finger[link] for link, joint in enumerate(hand.tree.link_joint) if joint >= 0}
    order = {f: i for i, f in enumerate(sorted(moving - {-1}))}
    return [order.get(f, -1) for f in finger]


def link_colours(hand: Hand) -> list[Colour]:
    """One cool colour for each finger, grey for the palm."""
    fingers = finger_of_link(hand)
    count = max(fingers, default=-1) + 1
    hues = [0.62 - 0.17 * i / max(1, count - 1) for i in range(count)]
    return [PALM_COLOUR if f < 0 else colorsys.hls_to_rgb(hues[f], 0.56, 0.48) for f in fingers]


def success_colour(success: bool | None) -> Colour:
    """Green, red, or grey for a grasp that was not tried."""
    return UNTRIED_COLOUR if success is None else SUCCESS_COLOUR if success else FAILURE_COLOUR


def link_shapes(hand: Hand) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Link, vertices (n 3) in its frame [m] and faces (m 3) of every visible shape of a hand."""
    if hand.description is None:
        return []
    return [(g.link, g.vertices, g.faces) for g in hand.description.geometry if g.visual]


def hand_meshes(
    hand: Hand, joints: Float[Tensor, " n_dof"], T_object_wrist: Float[Tensor, "4 4"] | None = None,
    *, above_palm: bool = True,
) -> list[Mesh]:
    """The posed hand in the object's frame; its surface points where there is no description.

    Args:
        hand: The hand.
        joints: Independent joints [rad or m].
        T_object_wrist: Wrist pose; none draws the hand in its own root frame.
        above_palm: Whether links above the palm (a forearm, a stand) are drawn.
    """
    T = torch.eye(4) if T_object_wrist is None else T_object_wrist
    shapes = link_shapes(hand)
    if not shapes:
        return [dots(hand.points(joints, T).double().numpy(), SOLVED_COLOUR)]
    poses = (T @ hand.tree.forward(joints)).double().numpy()
    colours = link_colours(hand)
    return [
        Mesh(v @ poses[i, :3, :3].T + poses[i, :3, 3], f, colours[i])
        for i, v, f in shapes if above_palm or bool(hand.tree.descends[i, hand.palm])
    ]


def object_meshes(obj: ObjectModel) -> list[Mesh]:
    """The object, or the points of a bare cloud."""
    if obj.vertices is None or obj.faces is None:
        radius = 0.01 * float(np.linalg.norm(obj.extents))
        return [dots(obj.cloud[:: max(1, len(obj.cloud) // 3000)], OBJECT_COLOUR, radius)]
    return [Mesh(np.asarray(obj.vertices, float), np.asarray(obj.faces, np.int64), OBJECT_COLOUR)]


def best_camera(
    hand: Hand, joints: Float[Tensor, " n_dof"], T_object_wrist: Float[Tensor, "4 4"], obj: ObjectModel,
    aspect: float = 4 / 3,
) -> Camera:
    """The viewpoint, out of many around a grasp, from which most of the object and of the fingers can be told apart."""
    of_hand = hand.points(joints, T_object_wrist).double().numpy()
    finger = np.asarray(finger_of_link(hand))[hand.link_index.numpy()] >= 0
    of_object = obj.cloud[:: max(1, len(obj.cloud) // 1024)].astype(float)
    points = np.concatenate([of_hand, of_object])
    owner = np.concatenate([finger.astype(int), np.full(len(of_object), 2)])
    rated = [(_clarity(points, owner, direction), direction) for direction in _directions()]
    return Camera.around(points, max(rated)[1], field_of_view=0.5, aspect=aspect)


@lru_cache(maxsize=1)
def _directions() -> tuple[tuple[float, float, float], ...]:
    """Evenly spread viewpoints (Fibonacci sphere), none straight from below or above."""
    i = np.arange(2 * VIEWPOINTS) + 0.5
    z = 1 - i / VIEWPOINTS
    angle = np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z**2)
    rows = zip((r * np.cos(angle)).tolist(), (r * np.sin(angle)).tolist(), z.tolist(), strict=True)
    return tuple(row for row in rows if LOWEST_VIEW < row[2] < HIGHEST_VIEW)


def _clarity(points: np.ndarray, owner: np.ndarray, direction: tuple[float, float, float]) -> float:
    """Cells of a coarse picture that show the object (2) and the fingers (1); the scarcer of the two counts more."""
    right, up, backward = Camera(direction, (0.0, 0.0, 0.0)).axes()
    size = float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-9
    x, y = (((points @ axis) - (points @ axis).min()) / size * CELLS for axis in (right, up))
    key = x.astype(int) * (CELLS + 1) + y.astype(int)
    order = np.lexsort((-(points @ backward), key))
    _, first = np.unique(key[order], return_index=True)
    nearest = owner[order][first]
    fingers, obj = int((nearest == 1).sum()), int((nearest == 2).sum())
    return 2 * min(fingers, obj) + max(fingers, obj)
