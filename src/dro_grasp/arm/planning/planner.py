"""From a robot and an object to a timed motion that grasps and lifts it.

Candidates, reachable, rehearsed, path, timed motion: each stage is a function that returns what it made.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.arm.planning.candidates import predicted
from dro_grasp.arm.planning.motion import CHOSEN, READY, WAITING, MotionPlan, PlanNotes, PlanScene, grasps_and_dropped
from dro_grasp.arm.planning.placing import Place, PlaceLike
from dro_grasp.arm.planning.reachability import Fault, Feasible, Postures, carried
from dro_grasp.arm.planning.task import PlanConfig, Task
from dro_grasp.arm.planning.trajectory import find_path, timed_stages
from dro_grasp.arm.planning.workcell import CARRIED
from dro_grasp.arm.robots.robot import JointsLike, Robot
from dro_grasp.devices import Stopwatch
from dro_grasp.errors import NoGraspError, OptionError, PlanError
from dro_grasp.extras import require_extra
from dro_grasp.frames import motion_fault
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import HOLD_COLUMNS, WEIGHT_COLUMN
from dro_grasp.grasps.forces import efforts_of, known, squeeze_efforts
from dro_grasp.kinds import checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.admission import violations
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.simulation.holding import expect_hold

ALIKE = 0.03  # Distance within which a grasp is like one that failed [m] (ours)
ALIKE_TURN = 0.5  # Angle within which it is [rad] (ours)


@checked
def plan(
    robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"] | None = None,
    obstacles: Sequence[ObjectModel] = (), predictor: GraspPredictor | None = None, config: PlanConfig | None = None,
    seed: int = 0, grasps: GraspBatch | Callable[[int], GraspBatch] | None = None,
    start: JointsLike | None = None,
    place: PlaceLike | None = None, avoid: Sequence[Float[np.ndarray, "4 4"]] = (),
) -> MotionPlan:
    """A motion that grasps the object and lifts it, and puts it down where that is asked for.

    Args:
        robot: Arm, hand and table. Without a table, the level plane below the object counts as one.
        obj: A mesh, or a camera's cloud.
        T_world_object: Where it stands [m]; its frame is the world's by default.
        obstacles: Further things, in the world's frame, that nothing may touch.
        predictor: Proposes grasps; the default weights if omitted.
        config: How to plan.
        seed: Of grasps, inverse kinematics and planner; where the planner's time suffices, the same seed gives the same plan.
        grasps: Complete grasps with scores, in the world's frame, instead of predicted ones; or what makes a batch from a seed.
        start: Where the arm's joints are when the motion begins [rad or m]; home by default. The hand is open.
        place: Where to put it, and let it go: x, y, z of the middle of its foot in the world [m], and a turn about the vertical
            [rad], any if that is left out; or "table" or the name of an obstacle, where a place is chosen. It stands there as
            it stands now, or as its mesh stands stably.
        avoid: Wrist poses in the world of grasps that failed [m]; those near them are not tried again.

    Raises:
        PlanError: The object or an obstacle collides with the robot at the start, the object lies below the table, the place is
            impossible, or no grasp can be carried out; the message counts what was dropped where.
        RobotError: The robot collides with the table, or with itself, at the start.
        OptionError: The extra `[arm]` is not installed, the pose is no rigid motion, the start is out of the joints' range, or
            the constraints leave nothing of the object.
    """
    require_extra("arm")
    T = np.eye(4) if T_world_object is None else T_world_object
    if (fault := motion_fault(torch.as_tensor(T).float())) is not None:
        raise OptionError(f"T_world_object is no pose of '{obj.name}' in metres; {fault}")
    wanted = None if place is None else Place.of(place)
    task = Task.of(robot, obj, T, obstacles, config or PlanConfig(), seed, start, wanted, avoid)
    task.check_start()
    tries = Tries(grasps is None)
    made = first_trusted(task, tries, grasps, predictor) or first_possible(task, tries)
    if made is not None:
        return made
    raise PlanError(tries.shortage if tries.shortage and not tries.made else (
        f"{grasps_and_dropped(tries.made, tries.counts)}, and none is left for '{obj.name}'; "
        f"{task.advice(tries.counts)}"))


@dataclass
class Tries:
    """What became of the grasps so far, by their number, in the order in which they were made."""

    predicted: bool = True  # By the predictor, and not given
    parts: list[GraspBatch] = field(default_factory=list)
    waiting: list[int] = field(default_factory=list)  # Not tried yet, in the order of trying
    ready: list[Feasible] = field(default_factory=list)
    """Left over from the last batch: they can be carried out, but were not trusted."""
    found: dict[int, Feasible] = field(default_factory=dict)  # Can be carried out
    share: dict[int, float] = field(default_factory=dict)  # Share of the rehearsals in which a grasp holds the object
    lost: list[Feasible] = field(default_factory=list)  # Can be carried out, but lose the object when rehearsed
    dropped: dict[int, str] = field(default_factory=dict)  # Why
    shortage: str = ""  # Why a batch had no grasp at all
    watch: Stopwatch = field(default_factory=lambda: Stopwatch("grasps", "reach", "rehearsal", "path", "timing", "hold"))

    @property
    def grasps(self) -> GraspBatch:
        """All that were made."""
        return GraspBatch.concatenate(self.parts)

    def wait(self, task: Task) -> None:
        """Let what is left over wait again, in the order of trying."""
        self.waiting += [goal.index for goal in self.taken()]
        if task.config.order == "random":
            np.random.default_rng(task.seed).shuffle(self.waiting)
        else:
            score = self.grasps.score.tolist()
            self.waiting.sort(key=lambda i: -score[i])

    def taken(self) -> list[Feasible]:
        """What is left over, which it is no longer."""
        taken, self.ready = self.ready, []
        return taken

    def likely(self, task: Task) -> list[bool]:
        """Which of all grasps are not doubtful; scores of others' grasps may mean anything."""
        config = task.config
        least = config.doubtful if config.least_confidence is None else config.least_confidence
        return (self.grasps.confidence >= least).tolist() if self.predicted else [True] * self.made

    @property
    def made(self) -> int:
        """How many there are."""
        return sum(len(part) for part in self.parts)

    @property
    def counts(self) -> dict[str, int]:
        """How many grasps were dropped, by reason."""
        return dict(Counter(self.dropped.values()))


def first_trusted(
    task: Task, tries: Tries, given: GraspBatch | Callable[[int], GraspBatch] | None, predictor: GraspPredictor | None
) -> MotionPlan | None:
    """The motion to a grasp that is trusted, as soon as one is known; None if the configuration allows no more grasps."""
    for grasps in candidates(task, tries, given, predictor):
        if grasps is not None:
            add(task, tries, grasps)
        for attempt in range(task.config.rounds if tries.made else 0):
            tries.wait(task)
            tries.ready = rehearsed(task, tries, reachable(task, tries))
            if not (goals := trusted(task, tries, whole=grasps is None)):
                break
            if (made := motion(task, tries, goals, task.seed + attempt)) is not None:
                return made
    return None


def first_possible(task: Task, tries: Tries) -> MotionPlan | None:
    """The motion to the best grasp that can be carried out, once no other will come; None if there is none."""
    for attempt in range(task.config.rounds if tries.made else 0):
        tries.wait(task)
        goals = rehearsed(task, tries, reachable(task, tries)) or best_lost(task, tries)
        if not goals:
            break
        if (made := motion(task, tries, goals, task.seed + attempt)) is not None:
            return made
    return None


def candidates(
    task: Task, tries: Tries, given: GraspBatch | Callable[[int], GraspBatch] | None, predictor: GraspPredictor | None
) -> Iterator[GraspBatch | None]:
    """Grasps in the world's frame as they become known, and None at the end of each batch that the configuration allows."""
    if isinstance(given, GraspBatch):
        yield from (given, None)
        return
    def asked(batch: int) -> Iterator[GraspBatch]:
        assert callable(given)
        yield given(task.seed_of(batch))

    make = predicted(task, predictor or GraspPredictor()) if given is None else asked
    for batch in range(task.config.batches):
        coming = make(batch)
        while True:
            with tries.watch("grasps"):
                try:
                    grasps = next(coming, None)
                except NoGraspError as error:  # another seed may find some
                    grasps, tries.shortage = None, str(error)
            yield grasps
            if grasps is None:
                break


def add(task: Task, tries: Tries, grasps: GraspBatch) -> None:
    """Let further grasps wait in order, but those that do not respect the constraints or are hopeless."""
    first = tries.made
    tries.parts.append(grasps)
    with tries.watch("reach"):
        if task.constraints != Constraints():  # table and obstacles are the arm's affair
            bare = replace(task.obj, table=None)
            problem = GraspProblem(task.robot.hand, bare, constraints=task.constraints.moved(np.linalg.inv(task.T)))
            for reason, wrong in violations(problem, task.at_object(grasps)).items():
                for row in wrong.nonzero()[:, 0].tolist():
                    tries.dropped.setdefault(first + row, reason)
        for row, reason in task.reach.hopeless(grasps).items():
            tries.dropped.setdefault(first + row, reason)
        for row in failed_before(grasps, task.avoid):
            tries.dropped.setdefault(first + row, Fault.FAILED)
    tries.waiting += [i for i in range(first, first + len(grasps)) if i not in tries.dropped]


def failed_before(grasps: GraspBatch, avoid: Sequence[Float[np.ndarray, "4 4"]]) -> list[int]:
    """Rows of grasps in the world whose wrists are near one of these poses."""
    T = grasps.T_object_wrist.double().numpy()
    near = np.zeros(len(T), bool)
    for other in avoid:
        cosine = (np.einsum("nij,ij->n", T[:, :3, :3], other[:3, :3]) - 1) / 2
        near |= (np.linalg.norm(T[:, :3, 3] - other[:3, 3], axis=1) < ALIKE) & (cosine > math.cos(ALIKE_TURN))
    return np.flatnonzero(near).tolist()


def reachable(task: Task, tries: Tries) -> Iterator[Feasible]:
    """The waiting grasps that the arm can carry out, one after the other."""
    grasps = tries.grasps
    while tries.waiting:
        number = tries.waiting.pop(0)
        with tries.watch("reach"):
            found = tries.found.get(number) or task.reach.ways(grasps, number)
        if isinstance(found, str):
            tries.dropped[number] = found
        else:
            tries.found[number] = found
            yield found


def rehearsed(task: Task, tries: Tries, found: Iterator[Feasible]) -> list[Feasible]:
    """Goals, those first that hold the object in most rehearsals; one that always does is enough."""
    goals, count, grasps = list[Feasible](), 0, tries.grasps
    while len(goals) < task.config.top and count < max(1, task.config.rehearsals) and (goal := next(found, None)):
        if task.rehearsal is not None and goal.index not in tries.share:
            count += 1
            with tries.watch("rehearsal"):
                done = task.rehearsal.rehearse(goal, Postures.of(task.robot, grasps, goal.index))
            tries.share[goal.index] = done.share
            if task.place is not None and not task.place.falls and done.T_world_wrist is not None:
                with tries.watch("reach"):
                    goal = tries.found[goal.index] = task.reach.put_as_held(goal, grasps, done.T_world_wrist)
        share = tries.share.get(goal.index)
        if share == 0:
            tries.lost.append(goal)
            tries.dropped[goal.index] = Fault.LOSES
            continue
        goals.append(goal)
        if share == 1:
            break
    return sorted(goals, key=lambda goal: -tries.share.get(goal.index, 0))


def best_lost(task: Task, tries: Tries) -> list[Feasible]:
    """The best of those that lose the object when rehearsed, but are no hopeless ones, taken from what is left."""
    score, likely = tries.grasps.score.tolist(), tries.likely(task)
    tries.lost = sorted((goal for goal in tries.lost if likely[goal.index]), key=lambda goal: -score[goal.index])
    goals, tries.lost = tries.lost[:task.config.top], tries.lost[task.config.top:]
    for goal in goals:
        del tries.dropped[goal.index]
    return goals


def trusted(task: Task, tries: Tries, whole: bool) -> list[Feasible]:
    """Goals for whose sake no further grasps are needed, within a batch or after the whole of it, taken from what is left."""
    config, score, likely = task.config, tries.grasps.score.tolist(), tries.likely(task)

    def enough(number: int) -> bool:
        if task.rehearsal is None:
            return config.order == "random" or score[number] >= config.trusted_score
        return tries.share[number] >= config.trusted_share if whole else tries.share[number] == 1 and likely[number]

    ready = tries.taken()
    tries.ready = [goal for goal in ready if not enough(goal.index)]
    return [goal for goal in ready if enough(goal.index)]


def motion(task: Task, tries: Tries, goals: list[Feasible], seed: int) -> MotionPlan | None:
    """The motion to the best goal, or else to the first that a path leads to; None, with the reason noted, if there is none."""
    left, config, robot, opened = list(goals), task.config, task.robot, task.robot.open_hand
    for best in [True, *[False] * len(goals)]:
        asked, seconds = (left[:1], config.best_seconds) if best else (left, config.planner_seconds)
        standoffs = np.array([goal.approach[0] for goal in asked])
        with tries.watch("path"):
            path = find_path(task.start, standoffs, lambda q: task.cell.free(q, opened), *robot.working_range, seconds,
                             seed) if asked else None
        if path is not None:
            waypoints, reached = path
            goal = left.pop(reached)
            postures = Postures.of(robot, tries.grasps, goal.index)
            with tries.watch("path"):
                carry = None if goal.put is None else carry_path(task, goal, postures, seed)
            with tries.watch("timing"):
                made = timed_stages(
                    task.cell, waypoints, goal, postures, config.closing_seconds, config.grip_seconds, carry,
                ) if goal.put is None or carry is not None else None
            if made is not None:
                with tries.watch("hold"):
                    expected = expect_hold(robot.hand, task.obj, task.at_object(tries.grasps[[goal.index]]))
                notes, scene = _described(task, tries, goal, goals, left, expected)
                return MotionPlan(notes, scene, *made)
            tries.dropped[goal.index] = Fault.NO_PATH
        elif not best:
            break
    tries.dropped |= dict.fromkeys((goal.index for goal in left), Fault.NO_PATH)
    return None


def carry_path(task: Task, goal: Feasible, hand: Postures, seed: int) -> Float[np.ndarray, "k n_arm"] | None:
    """Waypoints with the object in the hand, from the end of the lift to above its place; None if none is found."""
    robot, cell = task.robot, task.cell
    assert goal.put is not None
    T_grasp = goal.put.T_grasp

    def free(q: Float[np.ndarray, " n_arm"]) -> bool:
        return cell.free(q, hand.squeeze, moved=carried(robot.T_world_wrist(q), T_grasp), touch=True, kept=CARRIED)

    if not free(goal.lift[-1]):
        return None
    found = find_path(goal.lift[-1], goal.put.lower[:1], free, *robot.working_range, task.config.planner_seconds, seed)
    return None if found is None else found[0]


def _described(
    task: Task, tries: Tries, goal: Feasible, goals: list[Feasible], left: list[Feasible], expected: GraspBatch
) -> tuple[PlanNotes, PlanScene]:
    """What a motion to the chosen goal was planned for, and how it came about."""
    chosen = goal.index
    robot, obj, T, grasps, ready = task.robot, task.obj, task.T, tries.grasps, {goal.index for goal in left}
    clouds = [np.zeros((0, 3), np.float32), *(thing.cloud for thing in task.cell.obstacles)]
    wrists = grasps.T_object_wrist.double().numpy()
    fate = (CHOSEN if i == chosen else READY if i in ready else tries.dropped.get(i, WAITING) for i in range(len(grasps)))
    effort = efforts_of(squeeze_efforts(grasps, robot.hand), chosen)
    notes = PlanNotes(
        robot.name, obj.name, robot.arm_joints, robot.hand_joints, "world", task.height, len(grasps), tries.counts, len(goals),
        chosen, float(grasps.score[chosen]), wrists[chosen].tolist(), task.seed, tries.watch.seconds,
        known(grasps.payload[chosen]), known(grasps.squeeze_force[chosen]),
        None if effort is None else tuple(effort.double().tolist()), None if goal.put is None else goal.put.moved.tolist(),
        zeros=None if robot.drivers.are_usual else robot.drivers.zeros,
        scales=None if robot.drivers.are_usual else robot.drivers.scales,
        hold={name: tuple(expected.extra[name][0].double().reshape(-1).tolist()) for name in (*HOLD_COLUMNS, WEIGHT_COLUMN)},
        T_world_held=None if goal.put is None else goal.put.T_grasp.tolist(), rehearsed=tries.share.get(chosen),
        robot_file=robot.source)
    scene = PlanScene(
        obj.cloud @ T[:3, :3].T + T[:3, 3], np.concatenate(clouds), wrists, grasps.joints.double().numpy(),
        grasps.score.double().numpy(), tuple(fate))
    return notes, scene
