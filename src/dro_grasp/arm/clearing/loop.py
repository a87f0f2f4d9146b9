"""One thing after the other: look, choose, pick, drop into the bin, look again, until nothing is left on the table.

What is there is what the camera sees. From one look to the next, nothing is kept but where picks have failed, and with which
grasps. A pick counts when the thing is no longer seen where it was. Ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from dro_grasp.arm.clearing.parts import parted
from dro_grasp.arm.clearing.picks import Memory, Outcome, Pick
from dro_grasp.arm.planning.motion import PLACING, STAGES, MotionPlan, Trajectory
from dro_grasp.arm.planning.placing import Place, beyond_reach
from dro_grasp.arm.planning.planner import plan
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.arm.planning.trajectory import SPACING, densified, free_motion, smooth, standing, still, timed_way
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.table_scene import PickedObject, pick_object, seen_on_table
from dro_grasp.errors import DroGraspError, OptionError, PlanError
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.grasps.hold import HoldCheck
from dro_grasp.kinds import Checked, checked, require_positive
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.scenery import Scene, load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.predictor import GraspPredictor

HOME_SECONDS = 5.0  # Longest processor time for a path home [s] (ours)
WALL = 0.01  # Thickness of the bin's walls [m] (ours)
BESIDE = 0.03  # Distance from the bin within which what is seen counts as the bin [m] (ours): its walls are seen with noise
WATCHED = 21  # How often joints are measured to see whether something slips (ours)
EVERY = 0.01  # Time between two of these [s] (ours)
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
            raise OptionError(f"the bin has centre {self.centre}, size {self.size} and walls of {self.height} m; give metres, "
                              "of size and walls above 0")

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
        require_positive(tries=self.tries, most=self.most)


@runtime_checkable
class Rig(Protocol):
    """A robot that can be told to move, and its camera: real, or simulated as `SimulatedRig`."""

    def look(self) -> Float[np.ndarray, "n 3"]:
        """What the camera sees, in its frame [m]; the arm is at home."""
        ...

    def move(self, arm: Trajectory, hand: Trajectory) -> None:
        """Follow trajectories of arm and hand with the same times, and come back when they have ended.

        Joints are the description's [rad or m], here and in `joints`, whatever `zeros`, `signs` and `units` the robot file
        states: `robot.drivers` takes both, arm before hand, to drivers' numbers and back.
        """
        ...

    def joints(self) -> tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_dof"]]:
        """Where arm and hand are [rad or m]."""
        ...


@dataclass(frozen=True)
class Cleared:
    """What became of a table."""

    picks: tuple[Pick, ...]
    """All picks, in their order."""
    left: tuple[Pick, ...]
    """What is left or out of sight: the last pick of each such thing, and why it was given up."""

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
        progress: Called after each pick, once the camera has looked again where something moved.
        judged: Called with each judgement of whether the hand holds something, when it is made.

    Raises:
        OptionError: The robot has no table or no camera, or does not reach the bin.
        RobotError: It collides where it stands.
        PlanError: The arm does not find its way home.
        ObjectError: The camera sees nothing, or nothing of the table.
    """
    config, predictor = config or ClearConfig(), predictor or GraspPredictor()
    robot.require_table()
    assert robot.table is not None
    above = (*config.bin.centre, robot.table.height + config.bin.height + config.drop)
    if far := beyond_reach(robot, np.array(above)):
        raise OptionError(f"where things are let go, above the bin's middle, {far}; put the bin nearer (bin=..., in the world "
                          "[m])")
    memory, picks, moved = Memory(config.tries), list[Pick](), None
    tell = progress or (lambda pick: None)
    while True:
        look = _look(robot, rig, config.bin)
        if moved is not None:
            picks[-1] = memory.see(moved, look.points, list(look.spots))
            tell(picks[-1])
            moved = None
        left = memory.left(list(look.spots))
        if not left or len(picks) >= config.most:
            return Cleared(tuple(picks), memory.given_up(list(look.spots)))
        for place in left:  # until something moves, and what was seen is no longer true
            made = _pick(robot, rig, look, place, predictor, config, seed + len(picks), judged, memory.wrists(place))
            picks.append(made.pick)
            if made.pick.stage not in ("see", "plan"):
                moved = made
                break
            memory.note(made)
            tell(made.pick)
            if len(picks) >= config.most:
                break


class _Look(NamedTuple):
    """What the camera sees outside the bin."""

    points: Float[np.ndarray, "n 3"]  # in the world [m]
    scene: Scene
    spots: dict[tuple[float, float], Float[np.ndarray, "3"]]
    """A point of each thing, by the middle of what was seen of it [m]; those that have most room come first."""


def _look(robot: Robot, rig: Rig, bin: Bin) -> _Look:
    """What is on the table now."""
    assert robot.camera is not None
    T, points = robot.camera.T_world_camera, rig.look()
    world = points @ T[:3, :3].T + T[:3, 3]
    outside = ~bin.holds(world, BESIDE)
    scene = seen_on_table(load_scene(points[outside], "thing", camera=robot.camera.as_seen()), robot)
    seen, labels = scene.points_seen(), scene.segments.labels
    places = np.array([seen[labels == k, :2].mean(0) for k in range(scene.segments.count)]).reshape(-1, 2)
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.diag(np.full(len(places), np.inf))
    order = (-apart.min(1, initial=np.inf)).argsort(kind="stable")
    return _Look(world[outside], scene, {(float(places[k, 0]), float(places[k, 1])): scene.spot(int(k)) for k in order})


def _pick(
    robot: Robot, rig: Rig, look: _Look, place: tuple[float, float], predictor: GraspPredictor,
    config: ClearConfig, seed: int, judged: Callable[[HoldCheck], None] | None, avoid: Sequence[Float[np.ndarray, "4 4"]],
) -> Outcome:
    """Pick the thing at a place and drop it into the bin; the arm is at home afterwards.

    Grasps near those to avoid are not tried again, and then, or where there is no plan for it all, its parts are.
    """
    try:
        seen = pick_object(look.scene, robot, look.spots[place])
    except DroGraspError as error:
        return Outcome(Pick(place, "see", str(error)))
    reasons = list[str]()
    for part in [*parted(seen), seen] if avoid else [seen, *parted(seen)]:
        try:
            made = _planned(part, predictor, config, seed, avoid)
        except DroGraspError as error:
            reasons.append(str(error))
            continue
        return _carry_out(robot, rig, part, place, made, config, judged)
    return Outcome(Pick(place, "plan", reasons[-1 if avoid else 0]))  # that of it all


def _planned(
    seen: PickedObject, predictor: GraspPredictor, config: ClearConfig, seed: int, avoid: Sequence[Float[np.ndarray, "4 4"]]
) -> MotionPlan:
    """A motion that drops a thing into the bin, or a PlanError."""
    assert seen.robot.table is not None
    (x, y), height = config.bin.centre, config.bin.height
    above = Place((x, y, seen.robot.table.height + height + config.drop), falls=height + config.drop)
    return plan(seen.robot, seen.obj, obstacles=[*seen.obstacles, config.bin.walls(seen.robot.table.height)],
                predictor=predictor, config=config.plan, seed=seed, place=above, avoid=avoid)


def _carry_out(
    robot: Robot, rig: Rig, seen: PickedObject, place: tuple[float, float], made: MotionPlan, config: ClearConfig,
    judged: Callable[[HoldCheck], None] | None,
) -> Outcome:
    """Follow a plan to the bin; what slips as it is lifted is put back, and what is lost is left where it fell.

    Joints that fit neither say nothing of the object: the arm goes on, and the camera sees what came of it.
    """
    assert seen.robot.table is not None
    around = [*seen.obstacles, config.bin.walls(seen.robot.table.height)]
    cloud = seen.obj.cloud if seen.obj.seen is None else seen.obj.seen
    pick = Pick(place, "done")
    for stages in (STAGES, PLACING[:1]):
        _follow(rig, made, stages)
        check = _judge(rig, made, stages[-1])
        if judged is not None:
            judged(check)
        if check.state == "empty" or (check.state == "slipping" and stages is STAGES):
            if check.state == "slipping":
                _follow(rig, made, ("lift",), back=True)
            _open(rig, robot)
            reached = "close" if check.state == "slipping" else stages[-1]
            _go_home(rig, Workcell(seen.robot, [*around, seen.obj]), made, reached)
            pick = Pick(place, stages[-1], f"the hand is {check.state}, by its joints")
            return Outcome(pick, cloud, np.array(made.notes.T_world_wrist))
    _follow(rig, made, PLACING[1:])  # what slips above the bin may do so
    _go_home(rig, Workcell(seen.robot, around), made, PLACING[-1])
    return Outcome(pick, cloud, np.array(made.notes.T_world_wrist))


def _judge(rig: Rig, made: MotionPlan, stage: str) -> HoldCheck:
    """Whether the hand holds something at the end of a stage, by its joints as they are and as they move."""
    row, rows = made.part(stage).stop - 1, [rig.joints()[1]]
    for _ in range(WATCHED - 1):
        rig.move(standing(made.arm.position[row], EVERY), standing(made.hand.position[row], EVERY))
        rows.append(rig.joints()[1])
    return made.check_hold(rows[-1], watched=np.stack(rows), seconds=EVERY * (WATCHED - 1))


def _follow(rig: Rig, made: MotionPlan, stages: Sequence[str], back: bool = False) -> None:
    """Follow some stages of a plan, which follow each other, or go back along them."""
    rows = slice(made.part(stages[0]).start, made.part(stages[-1]).stop)
    arm, hand = (Trajectory(part.time[rows] - part.time[rows][0], part.position[rows], part.velocity[rows],
                            part.acceleration[rows]) for part in (made.arm, made.hand))
    rig.move(*(_reversed(arm), _reversed(hand)) if back else (arm, hand))


def _reversed(way: Trajectory) -> Trajectory:
    return Trajectory(way.time[-1] - way.time[::-1], way.position[::-1], -way.velocity[::-1], way.acceleration[::-1])


def _open(rig: Rig, robot: Robot) -> None:
    """Open the hand where the arm is."""
    arm, hand = rig.joints()
    way = smooth(np.stack([hand, robot.open_hand]), robot.hand_velocity, robot.hand_acceleration, OPENING_SECONDS)
    rig.move(still(arm, way), way)


def _go_home(rig: Rig, cell: Workcell, made: MotionPlan, reached: str) -> None:
    """Bring the arm home with the hand open, clear of what was seen, where it can; else nearly the way that it came.

    The arm is where a stage of the plan that it followed ends.

    Raises:
        PlanError: Neither way is free.
    """
    robot = cell.robot
    arm, opened = rig.joints()[0], robot.open_hand
    cells = (cell, Workcell(robot))  # what it touches where it is may be noise, or may give way
    for around in cells:
        def free(q: Float[np.ndarray, " n_arm"], kept: float, around: Workcell = around) -> bool:
            return around.free(q, opened, kept)

        if (way := free_motion(robot, arm, robot.home, free, HOME_SECONDS, 0)) is not None:
            rig.move(way, still(opened, way))
            return
    for around in cells:
        def clear(way: Trajectory, around: Workcell = around) -> bool:
            rows = [around.free(q, opened, 0.0) for q in way.position]
            return any(rows) and all(rows[rows.index(True):])  # but for what it touches where it is

        if (way := timed_way(_back(made, reached), robot.velocity, robot.acceleration, clear)) is not None:
            rig.move(way, still(opened, way))
            return
    met = ", ".join(f"{contact.first} and {contact.second}" for contact in cell.contacts(arm, opened)[:3])
    raise PlanError(f"the arm does not find its way home{f': {met} touch' if met else ''}; bring it home, and clear again")


def _back(made: MotionPlan, reached: str) -> Float[np.ndarray, "k n_arm"]:
    """Waypoints from the end of a stage back home; after the lift, over the object's place instead of down to it."""
    rows, whole = made.arm.position, made.part(reached).stop
    if reached == "close":
        return rows[:whole][::-1]
    over = np.stack([rows[made.part("lift").stop - 1], rows[made.part("reach").stop - 1]])
    return np.concatenate([rows[made.part("lift").stop - 1:whole][::-1], densified(over, SPACING),
                           rows[:made.part("reach").stop][::-1]])
