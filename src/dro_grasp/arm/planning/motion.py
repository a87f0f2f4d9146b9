"""A motion of arm and hand, from home to the lifted or placed object: in memory, as plan file, as controllers' trajectories."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline

from dro_grasp.arm.planning.placing import foot
from dro_grasp.arm.robots.drivers import Drivers
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.errors import OptionError, PlanError
from dro_grasp.files import UNTYPED, check_output, given_path, reading, replacing
from dro_grasp.grasps.columns import HOLD_COLUMNS, WEIGHT_COLUMN
from dro_grasp.grasps.export.writers import on_one_line, yaml_text
from dro_grasp.grasps.forces import forces_in_words
from dro_grasp.grasps.hold import HoldCheck, HoldExpectation, check_hold

STAGES = ("reach", "shape", "approach", "close", "lift")
"""The arm travels with the hand open; the hand takes the pregrasp; straight to the grasp; the hand closes; straight up."""
PLACING = ("carry", "lower", "release", "retreat")
"""What follows where the object is put somewhere: the arm carries it there; straight down; the hand opens; straight back."""
ALL_STAGES = (*STAGES, *PLACING)  # Those that a plan of a lift can have, in their order
SLIDING = ("reach", "shape", "approach", "press", "slide", "retreat", "look again")
"""Stages of a plan that pushes a flat thing: the arm travels with the hand open; the fingers point down; down beside the thing;
onto the table; straight to the edge; straight up; home, with the hand open, so that the camera sees what became of it."""
FORMAT = 3  # Version of plan files
READ = (2, FORMAT)  # Versions that are read: plans of the second put nothing anywhere
CHOSEN = "chosen"  # Fate of the grasp that the motion carries out
READY = "could be carried out too"  # Fate of grasps that were given to the planner beside it
WAITING = "not tried"  # Fate of grasps that were not looked at, since better ones sufficed
COLUMNS = ("time", "stage", "arm", "arm_velocity", "arm_acceleration", "hand", "hand_velocity", "hand_acceleration")
"""Arrays of a plan file."""
SCENE = ("points", "others", "T_world_wrist", "joints", "score")
"""Further arrays of it, what was planned for; their names begin with `scene_`."""
TINY = 1e-12  # Square of the way from grasp to squeeze below which there is none [rad^2 or m^2] (ours)
DIGITS = 6  # Decimals of joint values in trajectories: micrometres and microradians (ours)


@dataclass(frozen=True)
class Trajectory:
    """Joints over time, from rest to rest."""

    time: Float[np.ndarray, " k"]  # From zero [s]
    position: Float[np.ndarray, "k n"]  # [rad or m]
    velocity: Float[np.ndarray, "k n"]  # [rad/s or m/s]
    acceleration: Float[np.ndarray, "k n"]  # [rad/s^2 or m/s^2]

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.time[-1])

    def driven(self, drivers: Drivers) -> Trajectory:
        """The same as drivers count it."""
        return Trajectory(self.time, drivers.positions(self.position), drivers.rates(self.velocity),
                          drivers.rates(self.acceleration))


@dataclass(frozen=True)
class MotionPoint:
    """Where arm and hand should be at one time, as the drivers count it."""

    time: float  # Since the start [s]
    stage: str  # One of the plan's
    arm: Float[np.ndarray, " n_arm"]  # [rad or m, unless the robot file states other units]
    hand: Float[np.ndarray, " n_dof"]  # Likewise
    hand_effort: Float[np.ndarray, " n_dof"] | None = None  # [Nm or N]; None if the plan knows none


@dataclass(frozen=True)
class PlanNotes:
    """What a plan is for and how it came about; plain values."""

    robot: str
    object: str
    arm_joints: tuple[str, ...]
    hand_joints: tuple[str, ...]
    frame: str  # The frame that wrist poses are in: that of the robot's world
    table: float | None  # Height of the table that was planned for [m]
    grasps: int  # Grasps that there were to choose from
    dropped: dict[str, int]  # How many of them were dropped, by reason
    goals: int  # Grasps that were given to the planner at once
    chosen: int  # Index of the grasp in the batch, best score first
    score: float  # Its score
    T_world_wrist: list[list[float]]  # The wrist pose of the grasp [m], from which an arm with few joints may turn a little
    seed: int
    seconds: dict[str, float]  # Time spent on planning, by part [s]
    payload: float | None = None  # What the grasp carries [kg]; None if that is unknown
    squeeze_force: float | None = None  # Sum of the normal forces at the squeeze [N], likewise
    squeeze_torque: tuple[float, ...] | None = None
    """Efforts of the hand's independent joints at the squeeze [Nm or N], positive toward larger values; None if unknown."""
    place: list[list[float]] | None = None
    """Motion of the object, 4x4 in the world [m], from where it stood to where it is put; None if it is only lifted."""
    zeros: tuple[float, ...] | None = None
    """See `Drivers`, of arm and hand; None where drivers count as the description does."""
    scales: tuple[float, ...] | None = None
    """Likewise."""
    slide: list[list[float]] | None = None
    """Motion of the object, 4x4 in the world [m], where it is pushed to the table's edge, not grasped; None otherwise."""
    hold: dict[str, tuple[float, ...]] | None = None
    """Joints and efforts to expect after the lift, with the object in the hand and without, by the names in HOLD_COLUMNS, and
    the object's weight [N] as WEIGHT_COLUMN."""
    T_world_held: list[list[float]] | None = None
    """Where the wrist would have taken hold of an object that does not shift as the hand closes, to have it in the hand as it
    is, by the rehearsal [m]; None in plans without a place."""
    rehearsed: float | None = None
    """Share of its rehearsed lifts in which the grasp holds the object; None where nothing was rehearsed."""
    robot_file: str = ""
    """Name of a built-in robot, or the path of the robot's file; empty if unknown."""


@dataclass(frozen=True, eq=False)
class PlanScene:
    """What a motion was planned for, in the world: for pictures, and for checks by others."""

    points: Float[np.ndarray, "n 3"]  # Of the object [m]
    others: Float[np.ndarray, "m 3"]  # Of obstacles [m]
    T_world_wrist: Float[np.ndarray, "g 4 4"]  # Wrist poses of all grasps that there were [m]
    joints: Float[np.ndarray, "g n_dof"]  # Their joints [rad or m]
    score: Float[np.ndarray, " g"]  # Their scores
    fate: tuple[str, ...]  # CHOSEN, READY, WAITING, or why each was dropped


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """Arm and hand over time, from home to the lifted object, or to where the hand has left it."""

    notes: PlanNotes
    """What the plan is for, and how it came about."""
    scene: PlanScene
    """Object, obstacles and all grasps, in the world."""
    stage: Int[np.ndarray, " k"]
    """Index into `stages` of each sample."""
    arm: Trajectory
    """Time, position, velocity and acceleration of the arm's joints."""
    hand: Trajectory
    """The same of the hand's independent joints, at the same times."""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.arm.seconds

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of its stages, in their order."""
        return _stages(self.notes.place is not None, self.notes.slide is not None)

    @property
    def squeeze(self) -> Float[np.ndarray, " n_dof"]:
        """The hand's joints while it holds the object [rad or m]."""
        return self.hand.position[self.part("lift")][-1]

    def held_from(self, robot: Robot) -> Float[np.ndarray, "4 4"]:
        """Wrist pose relative to which the hand carries the object [m]: that of the grasp, or `T_world_held`."""
        told = self.notes.T_world_held
        return robot.T_world_wrist(self.arm.position[self.part("lift")][0]) if told is None else np.array(told)

    @property
    def drivers(self) -> tuple[Drivers, Drivers]:
        """How the drivers of the arm and of the hand count joints."""
        notes, count = self.notes, len(self.notes.arm_joints)
        both = Drivers.usual(count + len(notes.hand_joints))
        if notes.zeros is not None and notes.scales is not None:
            both = Drivers(notes.zeros, notes.scales)
        return both.part(slice(None, count)), both.part(slice(count, None))

    @property
    def hold(self) -> HoldExpectation | None:
        """Joints and efforts to expect after the lift, with the object in the hand and without; None in plans of before."""
        known = self.notes.hold
        if known is None:
            return None
        return HoldExpectation(*(np.array(known[name], float) for name in HOLD_COLUMNS),
                               weight=next(iter(known.get(WEIGHT_COLUMN, ())), None))

    def check_hold(
        self, measured_joints: ArrayLike, measured_efforts: ArrayLike | None = None, *, before: ArrayLike | None = None,
        watched: ArrayLike | None = None, seconds: float = 0.2, load: float | None = None, from_drivers: bool = False,
    ) -> HoldCheck:
        """Whether the hand holds the object, has lost it, or is losing it; see `dro_grasp.check_hold` for the arguments.

        Args:
            from_drivers: Measurements are as the robot's drivers count them, by `zeros`, `signs` and `units` of its file, and
                as files of trajectories state them. Without it they are those of the description [rad or m; Nm or N].

        Raises:
            OptionError: Measurements have another shape, or are not finite; a load is given, and the plan states no weight.
            PlanError: The plan was made before plans stated what to expect.
        """
        if (expected := self.hold) is None:
            raise PlanError("the plan does not state what joints to expect, as plans of before; plan again")
        if from_drivers:
            expected = self.drivers[1].holding(expected)
        return check_hold(
            expected, measured_joints, measured_efforts, before=before, watched=watched, seconds=seconds, load=load)

    def part(self, stage: str) -> slice:
        """Rows of a stage, after the last row of the stage before; that row alone for a stage without motion."""
        number = (SLIDING if self.notes.slide is not None else ALL_STAGES).index(stage)
        first, end = (int(np.searchsorted(self.stage, number, side)) for side in ("left", "right"))
        return slice(max(0, first - 1), end)

    @property
    def hand_effort(self) -> Float[np.ndarray, "k n_dof"] | None:
        """Efforts of the hand's joints at the same times [Nm or N]; None if those of the squeeze are unknown.

        They are zero until the hand is closed to the grasp, grow with its way from there to the squeeze, and then stay; where
        it releases the object, they shrink likewise.
        """
        if self.notes.squeeze_torque is None:
            return None
        grasp = self.scene.joints[self.notes.chosen].astype(np.float64)
        way = self.squeeze - grasp
        share = np.clip((self.hand.position - grasp) @ way / max(float(way @ way), TINY), 0, 1)
        closes, lifts, releases = (ALL_STAGES.index(name) for name in ("close", "lift", "release"))
        share[(self.stage < closes) | (self.stage > releases)] = 0
        share[(self.stage >= lifts) & (self.stage < releases)] = 1
        return share[:, None] * np.array(self.notes.squeeze_torque)

    def points(self, rate: float = 100.0) -> Iterator[MotionPoint]:
        """Targets at a rate [1/s], the last one included, as drivers count joints: for a loop that sends them to a robot.

        Between samples, joints follow cubic curves with the velocities of these, so that fast loops send no jumps of velocity.

        Raises:
            OptionError: The rate is not finite and above 0.
        """
        if not 0 < rate < math.inf:
            raise OptionError(f"rate is {rate}; give how many points a second has, such as 100")
        return self._points(rate)

    def _points(self, rate: float) -> Iterator[MotionPoint]:
        effort, (of_arm, of_hand) = self.hand_effort, self.drivers
        count = int(np.ceil(self.seconds * rate - 1e-9))
        times = np.array([*(i / rate for i in range(count)), self.seconds])
        arm, hand = (CubicHermiteSpline(part.time, part.position, part.velocity)(times) for part in (self.arm, self.hand))
        columns = [of_arm.positions(arm), of_hand.positions(hand)]
        if effort is not None:
            columns.append(of_hand.efforts(np.stack([np.interp(times, self.hand.time, c) for c in effort.T], 1)))
        rows = np.searchsorted(self.arm.time, times, side="left").clip(max=len(self.stage) - 1)
        for i, row in enumerate(rows):
            yield MotionPoint(float(times[i]), self.stages[int(self.stage[row])], *(column[i] for column in columns))

    def lines(self) -> list[str]:
        """The plan for people: what was dropped, what is done, how long it takes."""
        n = self.notes
        spans = ", ".join(f"{s} {np.ptp(self.arm.time[self.part(s)]):.1f} s" for s in self.stages)
        x, y, z = (row[3] for row in n.T_world_wrist[:3])
        if n.slide is not None:
            T, middle = np.array(n.slide), self.scene.points.mean(0)
            way = T[:3, :3] @ middle + T[:3, 3] - middle  # it may turn as well
            return [f"no grasp of it is trusted: it is pushed by {100 * np.hypot(*way[:2]):.0f} cm to the "
                    "table's edge; then look again, and plan again",
                    f"motion of {self.seconds:.1f} s: {spans}"]
        sure = "" if n.rehearsed is None else f", held in {100 * n.rehearsed:.0f} % of its rehearsed lifts"
        forces = f"; it {told}" if (told := forces_in_words(n.payload, n.squeeze_force)) else ""
        put = [] if n.place is None else [_place_in_words(np.array(n.place), self.scene.points)]
        return [
            grasps_and_dropped(n.grasps, n.dropped) + f"; {n.goals} given to the planner",
            f"grasp {n.chosen}, score {n.score:.2f}{sure}: wrist at ({x:.3f}, {y:.3f}, {z:.3f}) m in frame '{n.frame}'{forces}",
            *put,
            f"motion of {self.seconds:.1f} s: {spans}",
            "planned in " + f"{sum(n.seconds.values()):.2f} s: " + ", ".join(f"{k} {v:.2f} s" for k, v in n.seconds.items()),
        ]

    def save(self, path: Path | str) -> None:
        """Write a plan file (NPZ); it appears whole or not at all.

        Raises:
            OutputError: The path cannot be written.
        """
        header = json.dumps({"format_version": FORMAT, "stages": self.stages, "fate": self.scene.fate, **asdict(self.notes)})
        arrays = {"time": self.arm.time, "stage": self.stage}
        arrays |= {f"scene_{name}": getattr(self.scene, name).astype(np.float32) for name in SCENE}
        for name, part in (("arm", self.arm), ("hand", self.hand)):
            arrays |= {name: part.position, f"{name}_velocity": part.velocity, f"{name}_acceleration": part.acceleration}
        with replacing(check_output(path), "plan") as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, header=np.array(header), allow_pickle=False, **arrays)

    @staticmethod
    def load(path: Path | str) -> MotionPlan:
        """Read a plan file.

        Raises:
            PlanError: No such file, or a truncated or foreign one, or one of another version.
        """
        path = given_path(path)
        expected = reading(path, PlanError, "a plan file (.npz), as `dro-grasp plan` writes it", *UNTYPED)
        with expected, path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            header: dict[str, Any] = json.loads(str(file["header"]))
            stages = tuple(header.pop("stages", ()))
            if header.pop("format_version", None) not in READ or stages != _stages(
                    bool(header.get("place")), bool(header.get("slide"))):
                raise PlanError(f"{path} is a plan file of another version; plan again")
            time, stage, *rows = (file[name] for name in COLUMNS)
            scene = PlanScene(**{name: file[f"scene_{name}"] for name in SCENE}, fate=tuple(header.pop("fate", ())))
            lists = [name for name in ("squeeze_torque", "zeros", "scales") if header.get(name) is not None]
            for name in ("arm_joints", "hand_joints", *lists):
                header[name] = tuple(header[name])
            if (hold := header.get("hold")) is not None:
                header["hold"] = {name: tuple(row) for name, row in hold.items()}
            arm, hand = Trajectory(time, *rows[:3]), Trajectory(time, *rows[3:])
            return MotionPlan(PlanNotes(**header), scene, stage, arm, hand)


def _stages(places: bool, slides: bool) -> tuple[str, ...]:
    return SLIDING if slides else ALL_STAGES if places else STAGES


def _place_in_words(T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> str:
    """Where a motion puts an object, and by how much it turns it about the vertical."""
    x, y, z = T[:3, :3] @ foot(points) + T[:3, 3]
    return f"put at ({x:.3f}, {y:.3f}, {z:.3f}) m, turned by {math.degrees(math.atan2(T[1, 0], T[0, 0])):.0f} degrees"


def grasps_and_dropped(grasps: int, dropped: dict[str, int]) -> str:
    """How many grasps were dropped, and why."""
    reasons = ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count)
    return f"{grasps} grasps: {reasons or 'none dropped'}"


def trajectory_yaml(plan: MotionPlan, efforts: bool = False) -> str:
    """One trajectory_msgs/JointTrajectory each for arm and hand, with the same times. Source: ROS 2 common_interfaces.

    Where the efforts of the squeeze are known, a sensor_msgs/JointState `squeeze` states them beside its joints. `held` and
    `empty` state what to expect after the lift, with the object in the hand and without.

    Args:
        plan: What is written.
        efforts: Write efforts into the hand's points, too, if they are known: for controllers with an effort interface, which
            add them to what they command. A joint_trajectory_controller without one refuses them.
    """
    notes, times = plan.notes, {name: round(float(plan.arm.time[plan.part(name)][-1]), DIGITS) for name in plan.stages}
    (of_arm, of_hand), effort = plan.drivers, plan.hand_effort if efforts else None
    messages = {"arm": _message(notes.frame, notes.arm_joints, plan.arm.driven(of_arm)),
                "hand": _message(notes.frame, notes.hand_joints, plan.hand.driven(of_hand),
                                 None if effort is None else of_hand.efforts(effort))}
    told, hold = forces_in_words(notes.payload, notes.squeeze_force), plan.hold
    if notes.squeeze_torque is not None:
        messages["squeeze"] = {
            "header": _header(notes.frame), "name": list(notes.hand_joints), "velocity": [],
            "position": _plain(of_hand.positions(plan.squeeze)),
            "effort": _plain(of_hand.efforts(np.array(notes.squeeze_torque)))}
    if hold is not None:
        for name, (joints, forces) in of_hand.holding(hold).ends.items():
            messages[name] = {"header": _header(notes.frame), "name": list(notes.hand_joints), "velocity": [],
                              "position": _plain(joints), "effort": _plain(forces)}
    units = "rad or m" if notes.scales is None else "the drivers' numbers (zeros, signs and units of the robot file)"
    does = "pushes" if notes.slide is not None else "lifts" if notes.place is None else "lifts and places"
    title = on_one_line(f"Robot '{notes.robot}' {does} object '{notes.object}'.")
    return (f"# {title} Joints in {units}, efforts in Nm or N, time in s.\n"
            + (f"# The grasp {told}.\n" if told else "")
            + (f"# The object should weigh {hold.weight:.3g} N.\n" if hold is not None and hold.weight is not None else "")
            + f"# The wrist pose of the grasp is in frame '{notes.frame}'. Stages end at (s): {times}\n{yaml_text(messages)}")


def trajectory_csv(plan: MotionPlan) -> str:
    """One row for each sample: time, stage, and the target of every joint, arm before hand, then known efforts of the hand."""
    text, effort, (of_arm, of_hand) = io.StringIO(), plan.hand_effort, plan.drivers
    table = csv.writer(text, lineterminator="\n")
    joints = [f"arm/{n}" for n in plan.notes.arm_joints] + [f"hand/{n}" for n in plan.notes.hand_joints]
    columns = [of_arm.positions(plan.arm.position), of_hand.positions(plan.hand.position)]
    if effort is not None:
        joints += [f"effort/{n}" for n in plan.notes.hand_joints]
        columns.append(of_hand.efforts(effort))
    table.writerow(["time", "stage", *joints])
    for i, time in enumerate(plan.arm.time.tolist()):
        values = _plain(np.concatenate([column[i] for column in columns]))
        table.writerow([round(time, DIGITS), plan.stages[int(plan.stage[i])], *values])
    return text.getvalue()


def _message(
    frame: str, names: tuple[str, ...], part: Trajectory, effort: Float[np.ndarray, "k n"] | None = None
) -> dict[str, object]:
    points = []
    for i, time in enumerate(part.time.tolist()):
        second, nanosecond = divmod(round(time * 1e9), 10**9)
        points.append({
            "positions": _plain(part.position[i]), "velocities": _plain(part.velocity[i]),
            "accelerations": _plain(part.acceleration[i]), "effort": [] if effort is None else _plain(effort[i]),
            "time_from_start": {"sec": second, "nanosec": nanosecond}})
    return {"header": _header(frame), "joint_names": list(names), "points": points}


def _header(frame: str) -> dict[str, object]:
    return {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame}


def _plain(values: Float[np.ndarray, " n"]) -> list[float]:
    return np.round(values, DIGITS).tolist()
