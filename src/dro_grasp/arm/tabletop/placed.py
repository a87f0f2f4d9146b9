"""Objects that a simulated robot puts down: where that is asked for, and how far off they then stand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.arm.planning.placing import AWAY, foot, off_table
from dro_grasp.arm.tabletop.attempts import Attempt
from dro_grasp.arm.tabletop.table_scene import PickedObject
from dro_grasp.arm.tabletop.table_setup import APART, Region

PLACED_WITHIN = 0.02  # Largest distance from its place of an object that is placed [m]. Source: the project's aim (ours)
PLACED_UPRIGHT = 15.0  # Largest tilt of it [degrees], likewise
FELL = 45.0  # Tilt from which on it is said to have fallen over [degrees] (ours)


def measured(result: Attempt, scene: LiftScene, start: Float[np.ndarray, "4 4"], made: MotionPlan) -> Attempt:
    """An attempt with the errors of the placed object, which stood somewhere at the start [m]."""
    wanted, found, centre = np.array(made.notes.place) @ start, scene.pose(0), scene.objects[0].centre_of_mass
    off = (found - wanted)[:3, :3] @ centre + (found - wanted)[:3, 3]
    turn = found[:3, :3] @ wanted[:3, :3].T
    tilt = math.degrees(math.acos(min(1.0, max(-1.0, turn[2, 2]))))
    return replace(
        result, place_error=float(np.linalg.norm(off)), place_tilt=tilt,
        place_turn=math.degrees(math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))


def place_fault(error: float, tilt: float) -> tuple[str, str]:
    """Where an attempt with a place ended, and why if the object does not stand there, so far off [m] and tilted [degrees]."""
    if tilt > FELL:
        return "place", f"the object fell over: it is tilted by {tilt:.0f} degrees"
    if tilt > PLACED_UPRIGHT:
        return "place", f"the object stands tilted by {tilt:.0f} degrees"
    return ("place", f"placed {100 * error:.1f} cm off") if error > PLACED_WITHIN else ("done", "")


def draw_place(
    scene: LiftScene, seen: PickedObject, region: Region, draw: np.random.Generator
) -> tuple[float, float, float]:
    """A random free place in the region, on the table, AWAY from where the object stands; the last one tried if none is."""
    table, obj, base = seen.robot.table, scene.objects[0], scene.robot.T_world_base[:2, 3]
    assert table is not None
    now = scene.pose(0)
    points = obj.cloud @ now[:3, :3].T + now[:3, 3]
    middle = foot(points)
    half = float(np.linalg.norm(points[:, :2] - middle[:2], axis=1).max())
    others = [o.cloud @ T[:3, :3].T + T[:3, 3] for i, o in enumerate(scene.objects[1:], 1) for T in [scene.pose(i)]]
    tree, spot = KDTree(np.concatenate(others)[:, :2]) if others else None, middle[:2]
    for _ in range(1000):
        spot = base + draw.uniform(region[:2], region[2:])
        clear = tree is None or tree.query(spot)[0] > half + APART
        if np.linalg.norm(spot - middle[:2]) > AWAY and clear and off_table(table, np.array([*spot, 0.0])) < -half:
            break
    return float(spot[0]), float(spot[1]), table.height
