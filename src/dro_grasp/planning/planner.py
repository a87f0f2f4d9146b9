"""From a robot and an object to a timed motion that grasps and lifts it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError, PlanError
from dro_grasp.frames import motion_fault
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import checked
from dro_grasp.objects.scenery import load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pipeline.admission import BESIDE, NARROW, SPARED, TURNED, faults
from dro_grasp.pipeline.constraints import Constraints
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.planning.candidates import Directions, grasps_in_world
from dro_grasp.planning.clear_start import refuse_contacts_at_home
from dro_grasp.planning.collisions import OBSTACLE, CollisionChecker, open_hand
from dro_grasp.planning.extra import require_arm_extra
from dro_grasp.planning.few_joints import has_few_joints, reachable_directions
from dro_grasp.planning.motion import CHOSEN, READY, WAITING, MotionPlan, PlanNotes, PlanScene, grasps_and_dropped
from dro_grasp.planning.plan_config import PlanConfig
from dro_grasp.planning.reachability import Feasible, Postures, Reachability
from dro_grasp.planning.rehearsal import Rehearsal
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.scene_solids import scene_solid
from dro_grasp.planning.standing import moved, upright
from dro_grasp.planning.timed_stages import timed_stages
from dro_grasp.predictor import GraspPredictor
from dro_grasp.stopwatch import Stopwatch

BATCH_SEED = 7919
"""Between the seeds of batches of grasps (ours)."""
NO_PATH = "without a path"
"""The planner connects none of the goals, or a timed motion would touch something."""

LOSES = "losing the object when rehearsed"
"""The simulated hand does not lift the object as it is known."""


@checked
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
        obstacles: Further things, in the world's frame, that nothing may touch.
        predictor: Proposes grasps; the default weights if omitted.
        config: How to plan.
        seed: Of grasps, inverse kinematics and planner; where the planner's time suffices, the same seed gives the same plan.
        grasps: Complete grasps with scores, in the world's frame, instead of predicted ones.

    Raises:
        PlanError: The object or an obstacle collides with the robot at home, the object lies below the table, or no grasp can
            be carried out; the message counts what was dropped where.
        RobotError: The robot collides with the table at home.
        OptionError: The extra `[arm]` is not installed, the pose is no rigid motion, or the constraints leave nothing of the
            object.
    """
    require_arm_extra()
    T = np.eye(4) if T_world_object is None else T_world_object
    if (fault := motion_fault(torch.as_tensor(T).float())) is not None:
        raise OptionError(f"T_world_object is no pose of '{obj.name}' in metres; {fault}")
    task = _Task(robot, obj, T, obstacles, config or PlanConfig(), seed)
    task.check_start()
    batches = [grasps] if grasps is not None else task.predicted(predictor or GraspPredictor())
    count = 1 if grasps is not None else task.config.batches
    for number, batch in enumerate(batches, 1):
        task.add(batch)
        if (made := task.run(last=number == count)) is not None:
            return made
    raise PlanError(f"{grasps_and_dropped(len(task.grasps), task.dropped)}, and none is left for '{obj.name}'; {task.advice()}")


class _Task:
    """One object to lift."""

    def __init__(
        self, robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"], obstacles: Sequence[ObjectModel],
        config: PlanConfig, seed: int,
    ) -> None:
        self.robot, self.config, self.seed = robot, config, seed
        self.obj, self.T_world_object = upright(obj, T_world_object)
        avoid, self.constraints = config.constraints.avoid, replace(config.constraints, avoid=None)
        base, reach = robot.T_world_base[:3, 3], robot.full_reach + float(np.linalg.norm(np.ptp(self.obj.cloud, axis=0)))
        obstacles = [*obstacles, *(scene_solid(avoid, base, reach) if avoid is not None else ())]
        self.obstacles = obstacles
        self.watch = Stopwatch("grasps", "reach", "rehearsal", "path", "timing")
        self.checker = CollisionChecker(robot, robot.table, obstacles, self.obj, self.T_world_object)
        self.height = None if robot.table is None else robot.table.height
        self.reach = Reachability(robot, self.checker, self.obj, obstacles, self.height, config.reach, seed)
        self.opened, self.parts = open_hand(robot), list[GraspBatch]()
        self.waiting: list[int] = []
        """Numbers of grasps that were not tried yet, in the order of trying."""
        self.known: dict[int, Feasible] = {}
        self.goals: list[Feasible] = []
        """Grasps that can be carried out and were not tried yet, the best first."""
        self.share: dict[int, float] = {}
        """Share of the rehearsals of a grasp in which it holds the object."""
        self.lost: list[Feasible] = []
        """Grasps that can be carried out, but lose the object when rehearsed."""
        rehearsed = config.rehearsals > 0 and config.order == "score" and robot.table is not None
        self.rehearsal = Rehearsal(robot, self.obj, self.T_world_object) if rehearsed else None

    @property
    def grasps(self) -> GraspBatch:
        """All that were made so far, numbered in this order."""
        return GraspBatch.concatenate(self.parts)

    @property
    def dropped(self) -> dict[str, int]:
        """How many grasps were dropped, by reason."""
        return dict(Counter(self.reach.reasons.values()))

    def check_start(self) -> None:
        """Refuse robot and object that are in each other's way from the start, and constraints that leave nothing to grasp."""
        if self.config.constraints != Constraints():
            self.config.constraints.require_fit(moved(self.obj, self.T_world_object))
        top = float((self.obj.cloud @ self.T_world_object[2, :3]).max() + self.T_world_object[2, 3])
        if self.height is not None and top <= self.height:
            raise PlanError(f"object '{self.obj.name}' ends at z = {top:.3f} m, below the table at {self.height:.3f} m; give "
                            "the object in the robot's world frame (--camera, --pose), or correct `table` in the robot file")
        if self._distance() > self.robot.longest_reach:
            raise PlanError(f"object '{self.obj.name}' stands {self._distance():.2f} m from the base, farther than the arm and "
                            f"hand are long ({self.robot.longest_reach:.2f} m); give its place in the robot's world frame [m]")
        refuse_contacts_at_home(self.checker, self.obj, self.obstacles)

    def wanted(self) -> Constraints:
        """What grasps have to respect, in the world's frame: constraints, table and obstacles."""
        clouds = [thing.cloud for thing in self.obstacles]
        scene = load_scene(np.concatenate(clouds), OBSTACLE) if clouds else None
        return replace(self.constraints, table=self.height, avoid=scene)

    def predicted(self, predictor: GraspPredictor) -> Iterator[GraspBatch]:
        """Batch after batch of grasps in the world's frame, as many as the configuration allows."""
        directions = self.directions()
        for batch in range(self.config.batches):
            with self.watch("grasps"):
                grasps = grasps_in_world(
                    predictor, self.robot.hand, self.obj, self.T_world_object, self.config.num, self.wanted(),
                    directions, self.seed + batch * BATCH_SEED)
            yield grasps

    def directions(self) -> Directions | Float[Tensor, "k 3"]:
        """Palm directions to ask for: those that an arm with few joints can reach, or as configured."""
        if self.config.directions != "all" or self.constraints.direction is not None or not has_few_joints(self.robot):
            return self.config.directions
        middle = self.T_world_object[:3, :3] @ self.obj.cloud.mean(0) + self.T_world_object[:3, 3]
        return reachable_directions(self.robot, middle, self.seed)

    def add(self, grasps: GraspBatch) -> None:
        """Further grasps to choose from."""
        first = sum(len(part) for part in self.parts)
        self.parts.append(grasps)
        with self.watch("reach"):
            self._drop_forbidden(grasps, first)
            self.waiting += self.reach.promising(grasps, first) + [goal.index for goal in self.goals]
        self.known, self.goals = {goal.index: goal for goal in self.goals}, []
        if self.config.order == "random":
            np.random.default_rng(self.seed).shuffle(self.waiting)
        else:
            score = self.grasps.score.tolist()
            self.waiting.sort(key=lambda i: -score[i])

    def _drop_forbidden(self, grasps: GraspBatch, first: int) -> None:
        """Drop those that do not respect the constraints; table and obstacles are the arm's affair."""
        if self.constraints == Constraints():
            return
        T = np.linalg.inv(self.T_world_object)
        problem = GraspProblem(self.robot.hand, self.obj, constraints=self.constraints.moved(T))
        there = grasps.replace(T_object_wrist=torch.from_numpy(T).float() @ grasps.T_object_wrist)
        for reason, wrong in faults(problem, there).items():
            for row in wrong.nonzero()[:, 0].tolist():
                self.reach.reasons.setdefault(first + row, reason)

    def run(self, last: bool) -> MotionPlan | None:
        """The plan for the best grasps that work; None if none does, or is trusted and these are not the last ones."""
        grasps = self.grasps
        for attempt in range(self.config.rounds):
            self._find_goals(grasps)
            if last and not self.goals:
                self._resort_to_lost()
            if not self.goals or not (last or self._trusted(grasps)):
                break
            if (made := self._move(grasps, attempt)) is not None:
                return made
        return None

    def _find_goals(self, grasps: GraspBatch) -> None:
        """Fill up the goals, and put those first that hold the object in most rehearsals; one that always does is enough."""
        rehearsed = 0
        while self.waiting and len(self.goals) < self.config.top and rehearsed < max(1, self.config.rehearsals):
            number = self.waiting.pop(0)
            with self.watch("reach"):
                found = self.known.get(number) or self.reach.feasible(grasps, number)
            if found is None:
                continue
            if self.rehearsal is not None and number not in self.share:
                rehearsed += 1
                with self.watch("rehearsal"):
                    self.share[number] = self.rehearsal.share(found, Postures.of(self.robot, grasps, number))
            if self.share.get(number) == 0:
                self.lost.append(found)
                self.reach.reasons[number] = LOSES
                continue
            self.goals.append(found)
            if self.share.get(number) == 1:
                break
        self.goals.sort(key=lambda goal: -self.share.get(goal.index, 0))

    def _resort_to_lost(self) -> None:
        """Take the best of those that lose the object when rehearsed: the object may be other than it is thought to be."""
        score = self.grasps.score.tolist()
        self.lost.sort(key=lambda goal: -score[goal.index])
        self.goals, self.lost = self.lost[:self.config.top], self.lost[self.config.top:]
        for goal in self.goals:
            del self.reach.reasons[goal.index]

    def _trusted(self, grasps: GraspBatch) -> bool:
        best = self.goals[0].index
        if self.rehearsal is not None:
            return self.share[best] >= self.config.trusted_share
        return self.config.order == "random" or float(grasps.score[best]) >= self.config.trusted_score

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
                    postures = Postures.of(self.robot, grasps, chosen.index)
                    made = timed_stages(self.robot, self.checker, path.waypoints, chosen, postures, self.config)
                if made is not None:
                    scene = self._scene(grasps, chosen.index, goals)
                    return MotionPlan(self._notes(grasps, chosen.index, count), scene, made.stage, made.arm, made.hand)
                self.reach.reasons[chosen.index] = NO_PATH
            elif not best:
                break
            best = False
        self.reach.reasons |= dict.fromkeys((g.index for g in goals), NO_PATH)
        return None

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
        """What to change, by the reason for which most grasps were dropped."""
        reason = max(self.dropped, key=lambda r: self.dropped[r], default="")
        if reason in (TURNED, SPARED, BESIDE, NARROW):
            return f"most grasps are {reason}; relax cone, hold, spare or opening, or ask for more grasps (--num)"
        return (f"the object stands {self._distance():.2f} m from the base, and most grasps are {reason}; move the object, ask "
                "for more grasps (--num), or for other palm directions (--directions)")
