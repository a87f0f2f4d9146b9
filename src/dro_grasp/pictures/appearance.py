"""Appearance of a grasp: posed link shapes, the object, colours and camera."""

from __future__ import annotations

import colorsys

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from dro_grasp.geometry.point_clouds import even_directions
from dro_grasp.geometry.rendering.rasterizer import OBJECT_COLOUR, Camera, Colour, Mesh, dots
from dro_grasp.hands.anatomy import PALM
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel

PREDICTED_COLOUR: Colour = (0.85, 0.20, 0.55)  # Pink of hand points predicted by the network
SOLVED_COLOUR: Colour = (0.15, 0.45, 0.85)  # Blue of hand points after the joint solver
CONTACT_COLOUR: Colour = (0.86, 0.10, 0.16)  # Red of contact marks
SUCCESS_COLOUR: Colour = (0.16, 0.60, 0.30)  # Green of grasps that passed their trial
WAITING_HEIGHT = 0.05  # Height of the grasp centre of a waiting hand above the object [m]
CELLS = 28  # Cells along each side of the coarse picture that rates a viewpoint
VIEWPOINTS = 96  # Viewpoints spread over the sphere
LOWEST_VIEW = -0.5  # Smallest height of a camera on the unit sphere, so that none points straight up
LOWEST_OVER_TABLE = 0.3  # The same where a table would hide the object from below (ours)
HIGHEST_VIEW = 0.85  # Largest height of a camera on the unit sphere, so that none points straight down


def link_colours(hand: Hand) -> list[Colour]:
    """One cool colour for each finger, grey for the palm."""
    hues = [0.62 - 0.17 * i / max(1, len(hand.fingers) - 1) for i in range(len(hand.fingers))]
    return [(0.58, 0.62, 0.69) if f == PALM else colorsys.hls_to_rgb(hues[f], 0.56, 0.48) for f in hand.finger_of_link.tolist()]


def success_colour(success: bool | None) -> Colour:
    """Green for success, red for failure, grey if not evaluated."""
    return (0.50, 0.50, 0.50) if success is None else SUCCESS_COLOUR if success else (0.80, 0.22, 0.20)


def link_shapes(hand: Hand) -> list[tuple[int, Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]]:
    """Link, vertices in the link's frame [m] and faces of every visual shape of a hand."""
    if hand.description is None:
        return []
    return [(g.link, g.vertices, g.faces) for g in hand.description.geometry if g.visual]


def hand_meshes(
    hand: Hand, joints: Float[Tensor, " n_dof"], T_object_wrist: Float[Tensor, "4 4"] | None = None, *, above_palm: bool = True
) -> list[Mesh]:
    """The posed hand in the object's frame, by default in that of its wrist; without a description, its surface points.

    With `above_palm`, links above the palm (a forearm, a stand) are drawn too.
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
    """The object's mesh, or the points of a bare cloud."""
    if obj.vertices is None or obj.faces is None:
        radius = 0.01 * float(np.linalg.norm(obj.extents))
        return [dots(obj.cloud[:: max(1, len(obj.cloud) // 3000)], OBJECT_COLOUR, radius)]
    return [Mesh(np.asarray(obj.vertices, float), np.asarray(obj.faces, np.int64), OBJECT_COLOUR)]


def waiting_pose(hand: Hand, obj: ObjectModel) -> Float[Tensor, "4 4"]:
    """Wrist pose of a hand that waits above an object, palm down [m]."""
    T = torch.eye(4)
    turn = Rotation.align_vectors(np.array([[0.0, 0.0, -1.0]]), hand.palm_direction_wrist[None].numpy())[0]
    T[:3, :3] = torch.from_numpy(turn.as_matrix())
    low, high = obj.cloud.min(0), obj.cloud.max(0)
    above = torch.tensor([*((low + high) / 2)[:2].tolist(), float(high[2]) + WAITING_HEIGHT])
    T[:3, 3] = above - T[:3, :3] @ hand.grasp_centre_wrist
    return T


def best_camera(
    hand: Hand, joints: Float[Tensor, " n_dof"], T_object_wrist: Float[Tensor, "4 4"], obj: ObjectModel, aspect: float = 4 / 3,
    from_above: bool = False,
) -> Camera:
    """The camera, out of many around a grasp, or above it, that shows most of the object and of the fingers."""
    of_hand = hand.points(joints, T_object_wrist).double().numpy()
    finger = (hand.finger_of_link[hand.link_index] != PALM).numpy()
    of_object = obj.cloud[:: max(1, len(obj.cloud) // 1024)].astype(float)
    points = np.concatenate([of_hand, of_object])
    owner = np.concatenate([finger.astype(int), np.full(len(of_object), 2)])
    lowest = LOWEST_OVER_TABLE if from_above else LOWEST_VIEW
    directions = [tuple(row) for row in even_directions(VIEWPOINTS).tolist() if lowest < row[2] < HIGHEST_VIEW]
    rated = [(_clarity(points, owner, direction), direction) for direction in directions]
    return Camera.around(points, max(rated)[1], field_of_view=0.5, aspect=aspect)


def _clarity(points: Float[np.ndarray, "n 3"], owner: Int[np.ndarray, " n"], direction: tuple[float, float, float]) -> float:
    """Number of cells of a coarse picture that show the object or the fingers; the scarcer of the two counts more.

    `owner` is 1 for points of fingers, 2 for points of the object, 0 for all others; the direction is that to the camera.
    """
    right, up, backward = Camera(direction, (0.0, 0.0, 0.0)).axes()
    size = float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-9
    x, y = (((points @ axis) - (points @ axis).min()) / size * CELLS for axis in (right, up))
    key, height = x.astype(int) * (CELLS + 1) + y.astype(int), points @ backward
    highest = np.full((CELLS + 1) ** 2, -np.inf)
    np.maximum.at(highest, key, height)
    shown = np.zeros(len(highest), int)
    nearest = height == highest[key]
    shown[key[nearest]] = owner[nearest]
    fingers, obj = int((shown == 1).sum()), int((shown == 2).sum())
    return 2 * min(fingers, obj) + max(fingers, obj)
