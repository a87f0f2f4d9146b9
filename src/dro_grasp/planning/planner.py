"""From a robot and an object to a timed motion that grasps and lifts it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from dro_grasp.devices import Stopwatch
from dro_grasp.errors import OptionError, PlanError, RobotError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.candidates import Around, Directions, grasps_in_world
from dro_grasp.planning.collisions import TARGET, CollisionChecker, open_hand
from dro_grasp.planning.extra import require_arm_extra
from dro_grasp.planning.motion import CHOSEN, READY, STAGES, WAITING, MotionPlan, PlanNotes, PlanScene, dropped_in_words
from dro_grasp.planning.reachability import Feasible, Postures, Reachability, ReachConfig, carried
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.standing import upright
from dro_grasp.planning.timing import Trajectory, cornered, joined, smooth, standing
from dro_grasp.predictor import GraspPredictor

BATCH_SEED = 7919
"""Between the seeds of batches of grasps (ours)."""
NO_PATH = "without a path"
"""The planner connects none of the goals, or a timed motion would touch something."""
TRAVEL_CLEARANCE = 0.001
"""Distance that the timed motion keeps while it travels, off the straight edges that were planned [m] (ours)."""


@dataclass(frozen=True)
class PlanConfig:
    """How a motion is planned. Values without a source are ours."""

    num: int = 64
    """Grasps to choose from."""
    top: int = 5
    """Reachable grasps of best score that are given to the planner at once. Source: paper, real-robot experiment."""
    directions: Directions = "all"
    """Palm directions: `paper`, from above to the right side, or `all` that a table leaves room for."""
    order: Literal["score", "random"] = "score"
    """Which reachable grasps are taken: the best by score, or any, as a control."""
    rounds: int = 3
    """How often the planner is asked, each time with the next `top` grasps."""
    trusted_score: float = 1.0
    """Log-odds of holding that the best grasp that can be carried out should have."""
    batches: int = 3
    """How often at most `num` grasps are made, while none of them has that, or none works."""
    best_seconds: float = 1.0
    """Longest time for a path to the best grasp alone, which is tried before all goals are given at once [s]."""
    planner_seconds: float = 3.0
    """Longest time for one path to several goals [s]."""
    closing_seconds: float = 1.0
    """Least time in which the hand closes [s]. Source: as in trials."""
    grip_seconds: float = 0.5
    """How long the hand presses before the arm lifts [s]."""
    reach: ReachConfig = field(default_factory=ReachConfig)
    """Approach and lift."""

    def __post_init__(self) -> None:
        """Refuse what cannot be done.

        Raises:
            OptionError: A number is not positive.
        """
        for name in ("num", "top", "rounds", "batches", "planner_seconds"):
            if getattr(self, name) <= 0:
                raise OptionError(f"{name} is {getattr(self, name)}; give a number above 0")


def plan(
    robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"] | None = None,
    obstacles: Sequence[ObjectModel] = (), predictor: GraspPredictor | None = None, config: PlanConfig | None = None,
    seed: int = 0, grasps: GraspBatch | None = None,
) -> MotionPlan:
    """A motion that grasps the object and lifts it.

    Args:
        robot: Arm, hand and table.
        obj: A mesh, or a camera's cloud.
        T_world_object: Where it stands [m]; its frame is the world's by default.
        obstacles: Further things, in the world's frame.
        predictor: Proposes grasps; the default weights if omitted.
        config: How to plan.
        seed: Of grasps, inverse kinematics and planner; where the planner's time suffices, the same seed gives the same plan.
        grasps: Complete grasps with scores, in the world's frame, instead of predicted ones.

    Raises:
        PlanError: The object collides with the robot, lies below the table, or no grasp can be carried out; the message
            counts what was dropped where.
        RobotError: The robot collides at home.
        OptionError: The extra `[arm]` is not installed.
    """
    require_arm_extra()
    task = _Task(robot, obj, np.eye(4) if T_world_object is None else T_world_object, obstacles, config or PlanConfig(), seed)
    task.check_start()
    predictor = predictor or GraspPredictor() if grasps is None else None
    batches = task.config.batches if predictor is not None else 1
    for batch in range(batches):
        if predictor is not None:
            with task.watch("grasps"):
                grasps = grasps_in_world(
                    predictor, robot.hand, task.obj, task.T_world_object, task.config.num, task.config.directions,
                    Around(task.height, obstacles), seed + batch * BATCH_SEED)
        assert grasps is not None
        task.add(grasps)
        if (made := task.run(last=batch == batches - 1)) is not None:
            return made
    raise PlanError(f"{dropped_in_words(len(task.grasps), task.dropped)}, and none is left for '{obj.name}'; {task.advice()}")


class _Task:
    """One object to lift."""

    def __init__(
        self, robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"], obstacles: Sequence[ObjectModel],
        config: PlanConfig, seed: int,
    ) -> None:
        self.robot, self.obstacles, self.config, self.seed = robot, obstacles, config, seed
        self.obj, self.T_world_object = upright(obj, T_world_object)
        self.watch = Stopwatch("grasps", "reach", "path", "timing")
        self.checker = CollisionChecker(robot, robot.table, obstacles, self.obj, self.T_world_object)
        self.height = None if robot.table is None else robot.table.height
        self.reach = Reachability(robot, self.checker, self.obj, obstacles, self.height, config.reach, seed)
        self.opened, self.parts = open_hand(robot), list[GraspBatch]()
        self.waiting: list[int] = []
        """Numbers of grasps that were not tried yet, in the order of trying."""
        self.known: dict[int, Feasible] = {}
        self.goals: list[Feasible] = []
        """Grasps that can be carried out and were not tried yet, in the same order."""

    @property
    def grasps(self) -> GraspBatch:
        """All that were made so far, numbered in this order."""
        return GraspBatch.concatenate(self.parts)

    @property
    def dropped(self) -> dict[str, int]:
        """How many grasps were dropped, by reason."""
        return dict(Counter(self.reach.reasons.values()))

    def check_start(self) -> None:
        """Refuse a robot or an object that stands in the way of each other from the start."""
        top = float((self.obj.cloud @ self.T_world_object[2, :3]).max() + self.T_world_object[2, 3])
        if self.height is not None and top <= self.height:
            raise PlanError(f"object '{self.obj.name}' ends at z = {top:.3f} m, below the table at {self.height:.3f} m; give "
                            "the object in the robot's world frame (--camera, --pose), or correct `table` in the robot file")
        if self._distance() > self.robot.longest_reach:
            raise PlanError(f"object '{self.obj.name}' stands {self._distance():.2f} m from the base, farther than the arm and "
                            f"hand are long ({self.robot.longest_reach:.2f} m); give its place in the robot's world frame [m]")
        for contact in self.checker.contacts(self.robot.home, self.opened):
            if TARGET in (contact.first, contact.second):
                other = contact.first if contact.second == TARGET else contact.second
                raise PlanError(f"object '{self.obj.name}' collides with {other} while the robot is at home; give its place in "
                                "the robot's world frame, or another home")
            raise RobotError(f"robot '{self.robot.name}' collides at home: {contact.first} and {contact.second}, by "
                             f"{-1e3 * contact.distance:.1f} mm; `dro-grasp robot check` shows it")

    def add(self, grasps: GraspBatch) -> None:
        """Further grasps to choose from."""
        first = sum(len(part) for part in self.parts)
        self.parts.append(grasps)
        with self.watch("reach"):
            self.waiting += self.reach.promising(grasps, first) + [goal.index for goal in self.goals]
        self.known, self.goals = {goal.index: goal for goal in self.goals}, []
        if self.config.order == "random":
            np.random.default_rng(self.seed).shuffle(self.waiting)
        else:
            score = self.grasps.score.tolist()
            self.waiting.sort(key=lambda i: -score[i])

    def run(self, last: bool) -> MotionPlan | None:
        """The plan for the best grasps that work; None if none does, or is trusted and these are not the last ones."""
        grasps = self.grasps
        for attempt in range(self.config.rounds):
            with self.watch("reach"):
                self._find_goals(grasps)
            if not self.goals or not (last or self._trusted(grasps)):
                break
            if (made := self._move(grasps, attempt)) is not None:
                return made
        return None

    def _find_goals(self, grasps: GraspBatch) -> None:
        while self.waiting and len(self.goals) < self.config.top:
            number = self.waiting.pop(0)
            if (found := self.known.get(number) or self.reach.feasible(grasps, number)) is not None:
                self.goals.append(found)

    def _trusted(self, grasps: GraspBatch) -> bool:
        return self.config.order == "random" or float(grasps.score[self.goals[0].index]) >= self.config.trusted_score

    def _move(self, grasps: GraspBatch, attempt: int) -> MotionPlan | None:
        """The motion to the best goal, or to the first that a path leads to; None, with the reason noted, if there is none."""
        from dro_grasp.planning.paths import find_path

        goals, self.goals = self.goals, []
        count, (lower, upper), best = len(goals), self.robot.working_range, True
        while goals:
            asked = goals[:1] if best else goals
            with self.watch("path"):
                path = find_path(self.robot.home, np.stack([g.approach[0] for g in asked]),
                                 lambda q: self.checker.free(q, self.opened), lower, upper,
                                 self.config.best_seconds if best else self.config.planner_seconds, self.seed + attempt)
            if path is not None:
                chosen = goals.pop(path.goal)
                with self.watch("timing"):
                    made = self._timed(path.waypoints, chosen, Postures.of(self.robot, grasps, chosen.index))
                if made is not None:
                    scene = self._scene(grasps, chosen.index, goals)
                    return MotionPlan(self._notes(grasps, chosen.index, count), scene, *made)
                self.reach.reasons[chosen.index] = NO_PATH
            elif not best:
                break
            best = False
        self.reach.reasons |= dict.fromkeys((g.index for g in goals), NO_PATH)
        return None

    def _timed(
        self, waypoints: Float[np.ndarray, "k n_arm"], goal: Feasible, hand: Postures
    ) -> tuple[Int[np.ndarray, " m"], Trajectory, Trajectory] | None:
        """Stage of each sample, arm and hand; None if the timed motion touches something."""
        robot = self.robot
        limits = robot.velocity, robot.acceleration
        n = len(hand.grasp)
        fingers = np.full(n, robot.hand_velocity), np.full(n, robot.hand_acceleration)
        reach = smooth(waypoints, *limits)
        if not self._free(reach.position, hand.opened):
            reach = cornered(waypoints, *limits)
        standoff, grasp = goal.approach[0], goal.approach[-1]
        shape = smooth(_between(hand.opened, hand.pregrasp), *fingers)
        close = smooth(np.concatenate([_between(hand.pregrasp, hand.grasp), _between(hand.grasp, hand.squeeze)]), *fingers,
                       self.config.closing_seconds)
        close = joined([close, standing(hand.squeeze, self.config.grip_seconds)])
        approach, lift = smooth(goal.approach, *limits), smooth(goal.lift, *limits)
        start = robot.T_world_wrist(grasp)
        free = self._free(reach.position, hand.opened) and all(
            self.checker.free(standoff, posture, 0.0) for posture in shape.position) and all(
            self.checker.free(q, hand.pregrasp, 0.0, touch=True) for q in approach.position) and all(
            self.checker.free(grasp, posture, 0.0, touch=True) for posture in close.position) and all(
            self.checker.free(q, hand.squeeze, 0.0, carried(robot.T_world_wrist(q), start), touch=True) for q in lift.position)
        if not free:
            return None
        arms = [reach, _still(standoff, shape), approach, _still(grasp, close), lift]
        hands = [_still(hand.opened, reach), shape, _still(hand.pregrasp, approach), close, _still(hand.squeeze, lift)]
        lengths = [len(part.time) - (i > 0) for i, part in enumerate(arms)]
        return np.repeat(np.arange(len(STAGES)), lengths), joined(arms), joined(hands)

    def _free(self, positions: Float[np.ndarray, "k n_arm"], hand: Float[np.ndarray, " n_dof"]) -> bool:
        return all(self.checker.free(q, hand, TRAVEL_CLEARANCE) for q in positions)

    def _notes(self, grasps: GraspBatch, index: int, goals: int) -> PlanNotes:
        return PlanNotes(
            self.robot.name, self.obj.name, self.robot.arm_joints, self.robot.hand_joints, "world", self.height, len(grasps),
            self.dropped, goals, index, float(grasps.score[index]), grasps.T_object_wrist[index].double().tolist(),
            self.seed, self.watch.seconds)

    def _scene(self, grasps: GraspBatch, index: int, goals: list[Feasible]) -> PlanScene:
        T, clouds = self.T_world_object, [np.zeros((0, 3), np.float32), *(thing.cloud for thing in self.obstacles)]
        ready = {goal.index for goal in goals}
        fate = (CHOSEN if i == index else READY if i in ready else self.reach.reasons.get(i, WAITING)
                for i in range(len(grasps)))
        return PlanScene(
            self.obj.cloud @ T[:3, :3].T + T[:3, 3], np.concatenate(clouds), grasps.T_object_wrist.double().numpy(),
            grasps.joints.double().numpy(), grasps.score.double().numpy(), tuple(fate))

    def _distance(self) -> float:
        """From the arm's base to the object's middle, along the ground [m]."""
        middle = self.T_world_object[:2, :3] @ self.obj.cloud.mean(0) + self.T_world_object[:2, 3]
        return float(np.linalg.norm(middle - self.robot.T_world_base[:2, 3]))

    def advice(self) -> str:
        reason = max(self.dropped, key=lambda r: self.dropped[r], default="")
        return (f"the object stands {self._distance():.2f} m from the base, and most grasps are {reason}; move the object, ask "
                "for more grasps (--num), or for other palm directions (--directions)")


def _between(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"], count: int = 8) -> Float[np.ndarray, "k n"]:
    """Evenly spaced postures from one to another."""
    return a + np.linspace(0, 1, count)[:, None] * (b - a)


def _still(q: Float[np.ndarray, " n"], other: Trajectory) -> Trajectory:
    """No motion at the times of another trajectory."""
    return replace(standing(q, 0.0), time=other.time, **{
        name: np.tile(row, (len(other.time), 1))
        for name, row in (("position", q), ("velocity", np.zeros_like(q)), ("acceleration", np.zeros_like(q)))})
