"""Grasps of flat things where they overhang the edge of their table: thumb below and fingers above, or the other way round.

From above, fingertips do not get hold of what lies flat. A round tip of radius r on the table meets an edge at height h where
its surface faces down by asin(1 - h / r): with friction 0.5 it holds nothing up to 0.55 r, 7 mm for a tip of 13 mm. At the
table's edge both faces are free. Whether the arm reaches a grasp, and whether it holds, is found out as for all others. Ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.arm.flat.postures import AHEAD, FlatGrip, WorkingHand, flat_grips, pressing
from dro_grasp.arm.flat.things import overhang
from dro_grasp.arm.robots.robot import Table
from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel

LEAST_OVERHANG = 0.015  # Overhang from which on a thing can be taken there [m] (ours)
BEYOND_EDGE = 0.005  # Distance from the edge that is kept by what is lower than the table's top [m] (ours)
YAWS = (0.0, 0.35, -0.35, 0.7, -0.7, 1.0, -1.0)  # Turns of the palm about the vertical, from straight ahead [rad] (ours)
SHIFTS = (0.0, 0.015, -0.015)  # Ways along the edge from the middle of the overhang [m] (ours)
FROM_PALM = 0.008  # Distance between the palm and what is taken [m] (ours)
PRESSES = 7.0
"""Multiple of the weight with which thumb and fingers press (ours): what is held at one end turns about the fingers."""
LEAST_FORCE = 8.0  # Least such force [N] (ours)
MOST_FORCE = 25.0  # Largest such force [N] (ours)
TILTED = 0.3  # Cost of a radian between the palm and the edge (ours)

Grip = tuple[float, Float[np.ndarray, "4 4"], FlatGrip, torch.Tensor]  # Cost, T_world_wrist [m], the hand, and its squeeze


def flat_grasps(hand: Hand, obj: ObjectModel, table: Table, seed: int = 0) -> GraspBatch:
    """Grasps of a flat thing, complete and with scores, the most convenient first; none where it does not overhang.

    Args:
        hand: With a thumb and two other fingers.
        obj: The thing in the world's frame.
        table: What it lies on.
        seed: Recorded.

    Raises:
        OptionError: The hand has other fingers.
    """
    working = WorkingHand.of(hand)
    points, force = np.asarray(obj.cloud, np.float64), float(np.clip(PRESSES * GRAVITY * obj.mass, LEAST_FORCE, MOST_FORCE))
    grips: list[Grip] = []
    if overhangs(points, table):
        grips = sorted(_at_edge(working, points[overhang(points, table) > 0], table, force), key=lambda grip: grip[0])
    if not grips:
        return GraspBatch.none(hand, obj)
    cost, T, hands, squeeze = zip(*grips, strict=True)
    return GraspBatch.create(
        hand, obj, np.stack(T), torch.stack([grip.grasp for grip in hands]), squeeze_joints=torch.stack(squeeze),
        pregrasp_joints=torch.stack([grip.pregrasp for grip in hands]), score=-torch.tensor(cost) / 10, seed=seed,
        provenance="flat grips")


def overhangs(points: Float[np.ndarray, "n 3"], table: Table) -> bool:
    """Whether a thing with points in the world [m] overhangs its table far enough to be taken there."""
    return float(overhang(points, table).max()) >= LEAST_OVERHANG


def edge_normal(points: Float[np.ndarray, "n 3"], table: Table) -> Float[np.ndarray, "3"]:
    """Outward direction of the table's edge that points are beyond the farthest."""
    off = (np.abs(points[:, :2] - table.centre) - np.array(table.size) / 2)
    row, axis = np.unravel_index(off.argmax(), off.shape)
    normal = np.zeros(3)
    normal[axis] = np.sign(points[row, axis] - table.centre[axis])
    return normal


def _at_edge(
    working: WorkingHand, over: Float[np.ndarray, "m 3"], table: Table, force: float
) -> Iterator[Grip]:
    """Palms that face the table from beyond its edge, thumb below and fingers above, or the other way round."""
    normal, up = edge_normal(over, table), np.array([0.0, 0.0, 1.0])
    along = np.cross(up, normal)
    axis = int(np.abs(normal).argmax())
    edge = float(normal[axis] * table.centre[axis] + table.size[axis] / 2)
    top, farthest = float(np.quantile(over[:, 2], 0.95)), float((over @ normal).max())
    middle = float(over @ along @ np.ones(len(over)) / len(over))
    for grip, flipped in product(flat_grips(working, max(0.001, top - table.height)), (False, True)):
        # What is above stays, since it would meet the table without the thing; what is below presses.
        squeeze = pressing(working, grip.grasp, _lower(working, flipped), force)
        place = working.points(torch.stack([grip.pregrasp, grip.grasp, squeeze])).flatten(0, 1).double().numpy()
        palm = float((working.hand.palm_centre_wrist @ working.axes.T)[AHEAD])
        for yaw, shift in product(YAWS, SHIFTS):
            ahead = -(math.cos(yaw) * normal + math.sin(yaw) * along)
            over_direction = -up if flipped else up
            B = np.column_stack([ahead, over_direction, np.cross(ahead, over_direction)])
            level = table.height + grip.face if flipped else top - grip.face
            T = _pose(working, B, up * level)
            world = place @ B.T
            world[:, 2] += level
            low = world[world[:, 2] < table.height]
            out = edge + BEYOND_EDGE - float((low @ normal).min(initial=np.inf)) if len(low) else edge - palm
            # As deep as the edge allows, but with the thing clear of the palm.
            out = max(out, farthest + FROM_PALM + palm * float(-ahead @ normal))
            side = middle + shift - float(B @ _below(working, grip, flipped) @ along)
            T[:3, 3] += out * normal + side * along
            yield grip.cost + TILTED * 10 * abs(yaw) + 50 * abs(shift) + (1.0 if flipped else 0.0), T, grip, squeeze


def _below(working: WorkingHand, grip: FlatGrip, flipped: bool) -> Float[np.ndarray, "3"]:
    """Middle of what presses from below, in the hand's coordinates [m]: the thumb's tip, or the other tips."""
    return np.mean([working.tip(f, grip.grasp).mean(0).double().numpy() for f in _lower(working, flipped)], axis=0)


def _lower(working: WorkingHand, flipped: bool) -> tuple[int, ...]:
    """Which fingers are below what is taken."""
    assert working.hand.thumb is not None
    return working.fingers if flipped else (working.hand.thumb,)


def farthest_ahead(working: WorkingHand, q: Float[torch.Tensor, " n_dof"]) -> float:
    """How far ahead of the wrist the colliding shapes of a hand are in a posture [m]."""
    hand = working.hand
    assert hand.description is not None
    poses = hand.tree.forward(q).double().numpy()
    ahead = working.axes[AHEAD].double().numpy()
    return max(float(((s.vertices @ poses[s.link, :3, :3].T + poses[s.link, :3, 3]) @ ahead).max())
               for s in hand.description.geometry if s.collides)


def _pose(
    working: WorkingHand, B: Float[np.ndarray, "3 3"], place: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """T_world_wrist with the axes of the hand at work as the columns of B [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = B @ working.axes.double().numpy(), place
    return T
