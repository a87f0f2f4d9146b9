"""One thing after the other: look, choose, pick, drop into the bin, look again, until nothing is left on the table.

What is there is what the camera sees. From one look to the next, nothing is kept but where picks have failed. Ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from dro_grasp.arm.motion import PLACING, STAGES, MotionPlan, Trajectory
from dro_grasp.arm.placing import Place
from dro_grasp.arm.planner import PlanConfig, plan
from dro_grasp.arm.robot import Robot
from dro_grasp.arm.table_scene import pick_object, seen_on_table
from dro_grasp.arm.trajectory import find_path, smooth, still
from dro_grasp.arm.workcell import Workcell
from dro_grasp.errors import DroGraspError, ObjectError, OptionError, PlanError
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.grasps.hold import HoldCheck
from dro_grasp.kinds import Checked, checked
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.scenery import Scene, load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.predictor import GraspPredictor

SAME = 0.04  # Farthest that a thing may be from where a pick failed to count as the same [m] (ours)
HOME_SECONDS = 5.0  # Longest time for a path home [s] (ours)
WALL = 0.01  # Thickness of the bin's walls [m] (ours)
BESIDE = 0.03  # Distance from the bin within which what is seen counts as the bin [m] (ours): its walls are seen with noise
OPENING_SECONDS = 1.0  # Time in which a hand opens that holds nothing [s] (ours)


@dataclass(frozen=True)
class Bin(Checked):
    """An open box that stands on the table."""

    centre: tuple[float, float] = (0.30, 0.50)
    """Its middle in the world [m]."""
    size: tuple[float, float] = (0.36, 0.30)
    """Extent along x and y [m]."""
    height: float = 0.08
    """Height of its walls [m]."""

    def __post_init__(self) -> None:
        """Refuse what is no box: OptionError."""
        super().__post_init__()
        if not (min(self.size) > 2 * WALL and self.height > 0 and np.isfinite([*self.centre, *self.size, self.height]).all()):
            raise OptionError(f"the bin has size {self.size} and walls of {self.height} m; give metres above 0")

    def holds(self, points: Float[np.ndarray, "n 3"], around: float = 0.0) -> Bool[np.ndarray, " n"]:
        """Which points are above it, or at most so far beside it [m], as seen from above."""
        inside: Bool[np.ndarray, "n 2"] = np.abs(points[:, :2] - self.centre) < np.array(self.size) / 2 + around
        return inside[:, 0] & inside[:, 1]

    def walls(self, table: float) -> ObjectModel:
        """Its walls on a table of this height [m], in the world's frame."""
        (x, y), (dx, dy), z = self.centre, self.size, table + self.height / 2
        boxes = []
        for extents, place in (
            ((dx, WALL, self.height), (x, y - dy / 2, z)), ((dx, WALL, self.height), (x, y + dy / 2, z)),
            ((WALL, dy, self.height), (x - dx / 2, y, z)), ((WALL, dy, self.height), (x + dx / 2, y, z)),
        ):
            box = trimesh.creation.box(extents)
            box.apply_translation(place)
            boxes.append(box)
        parts = tuple((np.asarray(box.vertices, np.float64), np.asarray(box.faces, np.int64)) for box in boxes)
        corners, sides = (np.concatenate(own) for own in zip(*((v, f + 8 * i) for i, (v, f) in enumerate(parts)), strict=True))
        whole = trimesh.Trimesh(corners, sides)
        return mesh_object("bin", whole, origin="the bin", parts=parts)


@dataclass(frozen=True)
class ClearConfig(Checked):
    """How a table is cleared. Values are ours."""

    bin: Bin = field(default_factory=Bin)
    """Where everything goes."""
    tries: int = 3
    """Picks of a thing that may fail before it is given up."""
    most: int = 40
    """Largest number of picks."""
    drop: float = 0.02
    """Height above the bin's walls at which things are let go [m]."""
    plan: PlanConfig = field(default_factory=PlanConfig)
    """How motions are planned."""

    def __post_init__(self) -> None:
        """Refuse numbers below 1: OptionError."""
        super().__post_init__()
        for name in ("tries", "most"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} is {getattr(self, name)}; give at least 1")


@runtime_checkable
class Rig(Protocol):
    """A robot that can be told to move, and its camera: real, or simulated as `SimulatedRig`."""

    def look(self) -> Float[np.ndarray, "n 3"]:
        """What the camera sees, in its frame [m]; the arm is at home."""
        ...

    def move(self, arm: Trajectory, hand: Trajectory) -> None:
        """Follow trajectories of arm and hand with the same times, and come back when they have ended."""
        ...

    def joints(self) -> tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_dof"]]:
        """Where arm and hand are [rad or m]."""
        ...


@dataclass(frozen=True)
class Pick:
    """What became of one pick."""

    place: tuple[float, float]
    """Where the thing stood [m]."""
    stage: str
    """Where it ended: see, plan, lift, carry, or done."""
    reason: str = ""
    """Why it failed."""


@dataclass(frozen=True)
class Cleared:
    """What became of a table."""

    picks: tuple[Pick, ...]
    """All picks, in their order."""
    left: tuple[Pick, ...]
    """The last pick of each thing that was given up."""

    @property
    def done(self) -> int:
        """How many picks have ended in the bin, as far as the robot knows."""
        return sum(pick.stage == "done" for pick in self.picks)


@checked
def clear_table(
    robot: Robot, rig: Rig, predictor: GraspPredictor | None = None, config: ClearConfig | None = None, seed: int = 0,
    progress: Callable[[Pick], None] | None = None, judged: Callable[[HoldCheck], None] | None = None,
) -> Cleared:
    """Pick what stands on the table, one thing after the other, and drop it into the bin.

    Args:
        robot: With a table and a camera, at home with its hand open.
        rig: Moves and sees.
        predictor: Proposes grasps; the default weights if omitted.
        config: Where the bin is, and how often is tried.
        seed: Of all plans.
        progress: Called after each pick.
        judged: Called with each judgement of whether the hand holds something, when it is made.

    Raises:
        RobotError: The robot has no table or no camera, or collides where it stands.
        PlanError: The arm does not find its way home.
    """
    config, predictor = config or ClearConfig(), predictor or GraspPredictor()
    if robot.table is None or robot.camera is None:
        raise OptionError(f"robot '{robot.name}' has no {'table' if robot.table is None else 'camera'}; state it in the robot "
                          "file: what is to be cleared has to be seen on one")
    picks, failed = list[Pick](), list[Pick]()
    while len(picks) < config.most:
        scene, things = _things(robot, rig, config.bin)
        left = sorted((thing for thing in things if len(_near(failed, thing.place)) < config.tries),
                      key=lambda thing: len(_near(failed, thing.place)))  # the rest of the order is that of things
        if not left:
            return Cleared(tuple(picks), tuple(_near(failed, thing.place)[-1] for thing in things))
        assert scene is not None  # where something is left
        for thing in left:  # until something moves, and what was seen is no longer true
            pick = _pick(robot, rig, scene, thing, predictor, config, seed + len(picks), judged)
            picks.append(pick)
            failed += [pick] if pick.reason else []
            if progress is not None:
                progress(pick)
            if pick.stage not in ("see", "plan") or len(picks) == config.most:
                break
    return Cleared(tuple(picks), tuple(failed))


class _Thing(NamedTuple):
    """What stands on the table."""

    place: tuple[float, float]  # the middle of what was seen of it [m]
    spot: Float[np.ndarray, "3"]  # a point of it [m]


def _things(robot: Robot, rig: Rig, bin: Bin) -> tuple[Scene | None, list[_Thing]]:
    """What the camera sees outside the bin, and the things there, those first that have most room."""
    assert robot.camera is not None
    T, points = robot.camera.T_world_camera, rig.look()
    points = points[~bin.holds(points @ T[:3, :3].T + T[:3, 3], BESIDE)]
    try:
        scene = seen_on_table(load_scene(points, "thing", camera=robot.camera.as_seen()), robot)
    except ObjectError:
        return None, []
    world, labels = scene.points_seen(), scene.segments.labels
    places = np.array([world[labels == k, :2].mean(0) for k in range(scene.segments.count)]).reshape(-1, 2)
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.diag(np.full(len(places), np.inf))
    order = (-apart.min(1, initial=np.inf)).argsort(kind="stable")
    return scene, [_Thing((float(places[k, 0]), float(places[k, 1])), scene.spot(int(k))) for k in order]


def _near(picks: Sequence[Pick], place: tuple[float, float]) -> list[Pick]:
    return [pick for pick in picks if np.hypot(pick.place[0] - place[0], pick.place[1] - place[1]) < SAME]


def _pick(
    robot: Robot, rig: Rig, scene: Scene, thing: _Thing, predictor: GraspPredictor,
    config: ClearConfig, seed: int, judged: Callable[[HoldCheck], None] | None,
) -> Pick:
    """Pick the thing at a place and drop it into the bin; the arm is at home afterwards."""
    place = thing.place
    try:
        seen = pick_object(scene, robot, thing.spot)
    except DroGraspError as error:
        return Pick(place, "see", str(error))
    assert seen.robot.table is not None
    around = [*seen.obstacles, config.bin.walls(seen.robot.table.height)]
    x, y = config.bin.centre
    above = Place((x, y, seen.robot.table.height + config.bin.height + config.drop), falls=config.bin.height + config.drop)
    try:
        made = plan(seen.robot, seen.obj, obstacles=around, predictor=predictor, config=config.plan, seed=seed, place=above)
    except DroGraspError as error:
        return Pick(place, "plan", str(error))
    for stages, stage in ((STAGES, "lift"), (PLACING[:1], "carry")):
        _follow(rig, made, stages)
        check = made.check_hold(rig.joints()[1])
        if judged is not None:
            judged(check)
        if check.state != "held":
            _open(rig, robot)
            _go_home(rig, Workcell(seen.robot, [*around, seen.obj]))
            return Pick(place, stage, f"the hand is {check.state}, by its joints")
    _follow(rig, made, PLACING[1:])
    _go_home(rig, Workcell(seen.robot, around))
    return Pick(place, "done")


def _follow(rig: Rig, made: MotionPlan, stages: Sequence[str]) -> None:
    """Follow some stages of a plan, which follow each other."""
    rows = slice(made.part(stages[0]).start, made.part(stages[-1]).stop)
    arm, hand = (Trajectory(part.time[rows] - part.time[rows][0], part.position[rows], part.velocity[rows],
                            part.acceleration[rows]) for part in (made.arm, made.hand))
    rig.move(arm, hand)


def _open(rig: Rig, robot: Robot) -> None:
    """Open the hand where the arm is."""
    arm, hand = rig.joints()
    n = len(hand)
    way = smooth(np.stack([hand, robot.open_hand]), np.full(n, robot.hand_velocity), np.full(n, robot.hand_acceleration),
                 OPENING_SECONDS)
    rig.move(still(arm, way), way)


def _go_home(rig: Rig, cell: Workcell) -> None:
    """Bring the arm home, clear of what was seen, with the hand open.

    Raises:
        PlanError: There is no path.
    """
    robot = cell.robot
    arm, opened = rig.joints()[0], robot.open_hand
    found = find_path(arm, robot.home[None], lambda q: cell.free(q, opened), *robot.working_range, HOME_SECONDS, 0)
    if found is None:
        met = ", ".join(f"{contact.first} and {contact.second}" for contact in cell.contacts(arm, opened)[:3])
        raise PlanError(f"the arm does not find its way home{f': {met} touch' if met else ''}; bring it home, and clear again")
    way = smooth(found[0], robot.velocity, robot.acceleration)
    rig.move(way, still(opened, way))
