"""Which grasps the arm can carry out: wrist poses and configurations from the standoff to the end of the lift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.geometry.se3 import apply_to_cloud
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.candidates import lowest_points
from dro_grasp.planning.collisions import CollisionChecker, open_hand
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.workcell import VOXEL

BELOW_TABLE = "below the table"
"""A finger, or the palm, would be in the table."""
HITS_OBJECT = "through the object on the way to it"
"""The opened fingers would push the object away."""
HITS_OBSTACLE = "in an obstacle or through one on the way"
"""The hand would meet an obstacle."""
OUT_OF_REACH = "out of reach"
"""Inverse kinematics finds no configuration."""
COLLIDES = "with the robot in collision"
"""The configurations found collide with table, obstacles or the robot itself."""
NO_LINE = "without a straight approach"
"""Between standoff and grasp."""
NO_LIFT = "without a straight lift"
"""The arm cannot raise the object so far, or hits something with it."""


SMALL_ARM = 0.7
"""Length of arm and hand below which an arm is small [m] (ours)."""
SMALL_STANDOFF = 0.05
"""Longest approach of a small arm [m] (ours)."""
SMALL_LIFT = 0.08
"""Highest lift of a small arm [m] (ours)."""


@dataclass(frozen=True)
class ReachConfig(Checked):
    """How grasps are approached and lifted. Values are ours."""

    standoff: float = 0.10
    """Length of the straight approach, along the palm direction [m]."""
    lift: float = 0.20
    """Height of the straight lift [m]."""
    step: float = 0.01
    """Distance between the poses that are solved on both [m]."""
    deepest: float = 0.008
    """How far opened fingers may pass through the object's estimated surface on the approach [m]."""
    obstacle_margin: float = 0.003
    """Distance that the hand's points keep from obstacles, or the cells of a cloud of them [m]."""
    table_margin: float = 0.002
    """Distance that the hand's points keep from the table [m]."""
    clearance: float = 0.001
    """Distance that the robot keeps from table and obstacles on approach and lift [m]."""
    seeds: int = 6
    """Starts of inverse kinematics: home, and random ones."""

    def within(self, robot: Robot) -> ReachConfig:
        """The same, but approach and lift of a small arm are shorter."""
        if robot.longest_reach >= SMALL_ARM:
            return self
        return replace(self, standoff=min(self.standoff, SMALL_STANDOFF), lift=min(self.lift, SMALL_LIFT))


@dataclass(frozen=True)
class Feasible:
    """A grasp with the arm's configurations for it."""

    index: int
    """Of the grasp in its batch."""
    approach: Float[np.ndarray, "k n_arm"]
    """From the standoff to the grasp [rad or m]."""
    lift: Float[np.ndarray, "m n_arm"]
    """From the grasp upwards [rad or m]."""


@dataclass(frozen=True)
class Postures:
    """Independent joints of the hand in one grasp [rad or m]."""

    opened: Float[np.ndarray, " n_dof"]
    """While the arm travels."""
    pregrasp: Float[np.ndarray, " n_dof"]
    grasp: Float[np.ndarray, " n_dof"]
    squeeze: Float[np.ndarray, " n_dof"]

    @staticmethod
    def of(robot: Robot, grasps: GraspBatch, index: int) -> Postures:
        """Those of one grasp of a complete batch."""
        rows = (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)
        return Postures(open_hand(robot), *(r[index].double().numpy() for r in rows))


class Reachability:
    """Goes through grasps of one object, and counts why it drops them."""

    def __init__(
        self, robot: Robot, checker: CollisionChecker, obj: ObjectModel, obstacles: Sequence[ObjectModel], table: float | None,
        config: ReachConfig, seed: int,
    ) -> None:
        """Prepare the solver; `table` is the height of the table [m], the object stands where the checker has it."""
        from dro_grasp.planning.inverse_kinematics import WristSolver

        self.robot, self.checker, self.obj, self.table, self.config = robot, checker, obj, table, config.within(robot)
        self.solver, self.random = WristSolver(robot), np.random.default_rng(seed)
        self.reasons: dict[int, str] = {}
        """Why grasps were dropped, by their number."""
        clouds = [thing.cloud for thing in obstacles if thing.is_cloud]
        self._cloud = KDTree(np.concatenate(clouds)) if clouds else None
        self._fields = [thing.distance_field for thing in obstacles if not thing.is_cloud]

    def promising(self, grasps: GraspBatch, first: int = 0) -> list[int]:
        """Numbers of the grasps that are worth inverse kinematics: geometry of the hand alone decides.

        Args:
            grasps: Complete grasps in the world.
            first: Number of the first of them.
        """
        hand, T = self.robot.hand, grasps.T_object_wrist
        way = torch.linspace(0, self.config.standoff, 5)
        line = T[:, None].repeat(1, len(way), 1, 1)
        line[..., :3, 3] -= way[:, None] * hand.palm_directions(T)[:, None]
        points = hand.points(grasps.pregrasp_joints[:, None].expand(-1, len(way), -1), line).flatten(1, 2)
        T_object_world = torch.from_numpy(np.linalg.inv(self.checker.T_world_target)).to(T)
        depth = -self.obj.distance_field.distances(apply_to_cloud(T_object_world.expand(len(T), 4, 4), points))[0].amin(-1)
        tests = [(HITS_OBSTACLE, self._obstacle_distance(points) < self.config.obstacle_margin),
                 (HITS_OBJECT, depth > self.config.deepest)]
        if self.table is not None:
            tests.insert(0, (BELOW_TABLE, lowest_points(hand, grasps) <= self.table + self.config.table_margin))
        for reason, failed in tests:
            for row in failed.nonzero()[:, 0].tolist():
                self.reasons.setdefault(first + row, reason)
        return [first + row for row in range(len(grasps)) if first + row not in self.reasons]

    def _obstacle_distance(self, points: Float[Tensor, "n k 3"]) -> Float[Tensor, " n"]:
        """Distance of the nearest of some points to the obstacles [m]."""
        nearest = torch.full(points.shape[:1], torch.inf)
        for field in self._fields:
            nearest = torch.minimum(nearest, field.distances(points)[0].amin(-1))
        if self._cloud is not None:
            apart = self._cloud.query(points.double().numpy(), distance_upper_bound=VOXEL)[0].min(-1)
            nearest = torch.minimum(nearest, torch.from_numpy(apart).to(nearest) - VOXEL / 2)
        return nearest

    def feasible(self, grasps: GraspBatch, index: int) -> Feasible | None:
        """One grasp with configurations from standoff to lift; None, with the reason noted, if there are none."""
        postures = Postures.of(self.robot, grasps, index)
        T = grasps.T_object_wrist[index].double().numpy()
        ahead = self.robot.hand.palm_directions(grasps.T_object_wrist[index:index + 1])[0].double().numpy()
        back, up = self._line(T, -self.config.standoff * ahead), self._line(T, np.array([0, 0, self.config.lift]))
        reasons = [OUT_OF_REACH]
        lower, upper = self.solver.lower, self.solver.upper
        for seed in [self.robot.home, *self.random.uniform(lower, upper, (self.config.seeds - 1, len(lower)))]:
            q = self.solver.solve(T, [seed])
            if q is None:
                continue
            outcome = self._ways(q, back, up, postures)
            if not isinstance(outcome, str):
                return Feasible(index, *outcome)
            reasons.append(outcome)
        order = (OUT_OF_REACH, COLLIDES, NO_LINE, NO_LIFT)
        self.reasons[index] = max(reasons, key=order.index)
        return None

    def _ways(
        self, q: Float[np.ndarray, " n_arm"], back: Float[np.ndarray, "k 4 4"], up: Float[np.ndarray, "m 4 4"], hand: Postures
    ) -> tuple[Float[np.ndarray, "k n_arm"], Float[np.ndarray, "m n_arm"]] | str:
        """Approach and lift through one configuration of the grasp, or why there are none."""
        free, clearance = self.checker.free, self.config.clearance
        if not all(free(q, posture, clearance, touch=True) for posture in (hand.pregrasp, hand.grasp, hand.squeeze)):
            return COLLIDES
        retreat = self.solver.follow(back, q)
        if retreat is None or not all(free(x, hand.pregrasp, clearance, touch=True) for x in retreat):
            return NO_LINE
        shapes = np.linspace(0, 1, 5)[:, None] * (hand.pregrasp - hand.opened) + hand.opened
        if not free(retreat[-1], hand.opened) or not all(free(retreat[-1], shape, clearance) for shape in shapes):
            return NO_LINE
        raised = self.solver.follow(up, q)
        if raised is None or not all(
                free(x, hand.squeeze, clearance, carried(up[i], up[0]), touch=True) for i, x in enumerate(raised)):
            return NO_LIFT
        return retreat[::-1].copy(), raised

    def _line(self, T: Float[np.ndarray, "4 4"], motion: Float[np.ndarray, "3"]) -> Float[np.ndarray, "k 4 4"]:
        count = max(2, round(float(np.linalg.norm(motion)) / self.config.step) + 1)
        poses = np.tile(T, (count, 1, 1))
        poses[:, :3, 3] += np.linspace(0, 1, count)[:, None] * motion
        return poses


def carried(T_world_wrist: Float[np.ndarray, "4 4"], T_at_grasp: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Motion of an object that the hand took hold of at one pose, and has at another."""
    return T_world_wrist @ np.linalg.inv(T_at_grasp)

