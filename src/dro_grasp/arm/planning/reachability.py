"""Which grasps the arm can carry out: inverse kinematics, and configurations from the standoff to the end of the lift.

An arm with fewer than six joints brings its wrist to few poses: its palms face a few ways only, mostly in the plane of its
links. Grasps are asked for from there, and a wrist may be turned a little from what was asked. Ours.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.arm.planning.placing import Places
from dro_grasp.arm.planning.workcell import CARRIED, VOXEL, Workcell, arm_addresses
from dro_grasp.arm.robots.robot import Robot, Table
from dro_grasp.geometry.point_clouds import farthest_points
from dro_grasp.geometry.se3 import apply_to_cloud
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.optimize.grasp_energy import PRESSED

TURNED = 0.12  # Farthest that a wrist is turned about the grasp centre from what was asked [rad] (ours)
LOWERED = 0.08  # Height from which an object is lowered straight [m] (ours)
LEAST_OPEN = 0.5  # Least share of the way from grasp to pregrasp that the hand opens, where others stand in its way (ours)
PLACE_SEEDS = 4  # Starts of inverse kinematics at a place: the end of the lift, the grasp, home, and random ones (ours)
TILTED = 1e-3  # Deeper than a place allows that an object may be in a surface [m]: what inverse kinematics leaves open (ours)
SHIFTED = 0.002  # Least distance by which an object that shifts in the hand is put down otherwise [m] (ours)
ROTATED = 0.03  # Least rotation likewise, as the norm of a matrix's change: 1.2 degrees (ours)
STEEPEST = 0.2  # Sine of the angle above the horizontal up to which a palm may face upwards (ours): the table is below


class Fault(StrEnum):
    """Why a grasp cannot be carried out."""

    BELOW_TABLE = "below the table"
    HITS_OBJECT = "through the object on the way to it"  # the opened fingers would push it away
    HITS_OBSTACLE = "in an obstacle or through one on the way"
    OUT_OF_REACH = "out of reach"
    COLLIDES = "with the robot in collision"
    NO_LINE = "without a straight approach"
    NO_LIFT = "without a straight lift"
    NO_PLACE = "without a way to put it there"
    FAILED = "like one that failed before"
    LOSES = "losing the object when rehearsed"
    NO_PATH = "without a path"  # to any of the goals, or the timed motion would touch something


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
        """The same, but an arm that with its hand is shorter than 0.7 m approaches over 5 cm and lifts by 8 cm at most."""
        if robot.longest_reach >= 0.7:
            return self
        return replace(self, standoff=min(self.standoff, 0.05), lift=min(self.lift, 0.08))


@dataclass(frozen=True)
class Put:
    """How a lifted object is put down."""

    moved: Float[np.ndarray, "4 4"]  # Motion of the object from where it stood [m]
    lower: Float[np.ndarray, "k n_arm"]  # From above the place down to it [rad or m]
    retreat: Float[np.ndarray, "m n_arm"]  # From there back [rad or m]
    released: Float[np.ndarray, " n_dof"]  # The hand on its way back [rad or m]
    T_grasp: Float[np.ndarray, "4 4"]
    """Where the wrist was as it took hold of the object, or would have been, had the object not shifted in the hand [m]."""
    kept: float  # Distance that the object keeps from its surroundings while it is put down, negative within them [m]


@dataclass(frozen=True)
class Feasible:
    """A grasp with the arm's configurations for it."""

    index: int  # Of the grasp in its batch
    approach: Float[np.ndarray, "k n_arm"]  # From the standoff to the grasp [rad or m]
    lift: Float[np.ndarray, "m n_arm"]  # From the grasp upwards [rad or m]
    put: Put | None = None  # Where a place is asked for


@dataclass(frozen=True)
class Postures:
    """Independent joints of the hand in one grasp [rad or m]."""

    opened: Float[np.ndarray, " n_dof"]  # While the arm travels
    pregrasp: Float[np.ndarray, " n_dof"]
    grasp: Float[np.ndarray, " n_dof"]
    squeeze: Float[np.ndarray, " n_dof"]

    @staticmethod
    def of(robot: Robot, grasps: GraspBatch, index: int) -> Postures:
        """Those of one grasp of a complete batch."""
        rows = (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)
        return Postures(robot.open_hand, *(r[index].double().numpy() for r in rows))

    @property
    def closing(self) -> Float[np.ndarray, "3 n_dof"]:
        """While the hand closes: pregrasp, grasp, squeeze."""
        return np.stack([self.pregrasp, self.grasp, self.squeeze])


class Reachability:
    """Finds out how the arm carries out grasps of a workcell's object, or why it does not."""

    def __init__(self, cell: Workcell, config: ReachConfig, seed: int, places: Places | None = None) -> None:
        """Prepare the solver, whose random starts follow from the seed; with places, a grasp has to reach one of them."""
        self.cell, self.config, self.places = cell, config.within(cell.robot), places
        self.solver, self.random = WristSolver(cell), np.random.default_rng(seed)
        clouds = [thing.cloud for thing in cell.obstacles if thing.is_cloud]
        self._cloud = KDTree(np.concatenate(clouds)) if clouds else None
        self._fields = [thing.distance_field for thing in cell.obstacles if not thing.is_cloud]

    def hopeless(self, grasps: GraspBatch) -> dict[int, str]:
        """Rows of complete grasps in the world that need no inverse kinematics, and why: geometry of the hand alone decides."""
        hand, T, cell = self.cell.robot.hand, grasps.T_object_wrist, self.cell
        assert cell.target is not None
        way = torch.linspace(0, self.config.standoff, 5)
        line = T[:, None].repeat(1, len(way), 1, 1)
        line[..., :3, 3] -= way[:, None] * hand.palm_directions(T)[:, None]
        points = hand.points(grasps.pregrasp_joints[:, None].expand(-1, len(way), -1), line).flatten(1, 2)
        T_object_world = torch.from_numpy(np.linalg.inv(cell.T_world_target)).to(T)
        depth = -cell.target.distance_field.distances(apply_to_cloud(T_object_world.expand(len(T), 4, 4), points))[0].amin(-1)
        tests = [(Fault.HITS_OBSTACLE, self._obstacle_distance(points) < self.config.obstacle_margin),
                 (Fault.HITS_OBJECT, depth > self.config.deepest)]
        if (table := cell.robot.table) is not None:
            tests.insert(0, (Fault.BELOW_TABLE, lowest_points(hand, grasps, table) <= table.height + self.config.table_margin))
        found: dict[int, str] = {}
        for reason, failed in tests:
            for row in failed.nonzero()[:, 0].tolist():
                found.setdefault(row, reason)
        return found

    def _obstacle_distance(self, points: Float[Tensor, "n k 3"]) -> Float[Tensor, " n"]:
        """Distance of the nearest of some points to the obstacles [m]."""
        nearest = torch.full(points.shape[:1], torch.inf)
        for field in self._fields:
            nearest = torch.minimum(nearest, field.distances(points)[0].amin(-1))
        if self._cloud is not None:
            apart = self._cloud.query(points.double().numpy(), distance_upper_bound=VOXEL)[0].min(-1)
            nearest = torch.minimum(nearest, torch.from_numpy(apart).to(nearest) - VOXEL / 2)
        return nearest

    def ways(self, grasps: GraspBatch, index: int) -> Feasible | str:
        """One grasp with configurations from standoff to lift, and to a place if there are any; or why there are none."""
        robot = self.cell.robot
        T = grasps.T_object_wrist[index].double().numpy()
        ahead = robot.hand.palm_directions(grasps.T_object_wrist[index:index + 1])[0].double().numpy()
        back, up = self._line(T, -self.config.standoff * ahead), self._line(T, np.array([0, 0, self.config.lift]))
        postures, (lower, upper) = Postures.of(robot, grasps, index), robot.working_range
        reasons: list[str] = [Fault.OUT_OF_REACH]
        for seed in [robot.home, *self.random.uniform(lower, upper, (self.config.seeds - 1, len(lower)))]:
            q = self.solver.solve(T, [seed])
            if q is None:
                continue
            outcome = self._through(q, back, up, postures)
            if not isinstance(outcome, str):
                found = Feasible(index, *outcome)
                if self.places is None:
                    return found
                put = self._way_to_place(found, robot.T_world_wrist(found.approach[-1]), T[:3, :3].T @ ahead, postures)
                return Fault.NO_PLACE if put is None else replace(found, put=put)
            reasons.append(outcome)
        return max(reasons, key=(Fault.OUT_OF_REACH, Fault.COLLIDES, Fault.NO_LINE, Fault.NO_LIFT).index)

    def _through(
        self, q: Float[np.ndarray, " n_arm"], back: Float[np.ndarray, "k 4 4"], up: Float[np.ndarray, "m 4 4"], hand: Postures
    ) -> tuple[Float[np.ndarray, "k n_arm"], Float[np.ndarray, "m n_arm"]] | str:
        """Approach and lift through one configuration of the grasp, or why there are none."""
        free, clearance = self.cell.free, self.config.clearance
        closed = all(free(q, posture, clearance, touch=True) for posture in (hand.pregrasp, hand.grasp))
        if not closed or not free(q, hand.squeeze, clearance, touch=True, aimed=True):
            return Fault.COLLIDES
        retreat = self.solver.follow(back, q)
        if retreat is None or not all(free(x, hand.pregrasp, clearance, touch=True) for x in retreat):
            return Fault.NO_LINE
        shapes = np.linspace(0, 1, 5)[:, None] * (hand.pregrasp - hand.opened) + hand.opened
        if not free(retreat[-1], hand.opened) or not all(free(retreat[-1], shape, clearance) for shape in shapes):
            return Fault.NO_LINE
        raised = self.solver.follow(up, q)
        if raised is None or not all(
                free(x, hand.squeeze, clearance, carried(up[i], up[0]), touch=True, aimed=True) for i, x in enumerate(raised)):
            return Fault.NO_LIFT
        return retreat[::-1].copy(), raised

    def put_as_held(self, found: Feasible, grasps: GraspBatch, T_grasp: Float[np.ndarray, "4 4"]) -> Feasible:
        """The same grasp, with the object put down as it is in the hand once that has closed; as before if there is no way.

        Args:
            found: With a way to a place.
            grasps: Its batch.
            T_grasp: Where the wrist would have been, had the object not shifted [m], from a rehearsal.
        """
        assert found.put is not None
        shift = np.linalg.inv(found.put.T_grasp) @ T_grasp
        if np.linalg.norm(shift[:3, 3]) < SHIFTED and np.linalg.norm(shift[:3, :3] - np.eye(3)) < ROTATED:
            return found
        T = grasps.T_object_wrist[found.index:found.index + 1]
        ahead = (T[0, :3, :3].T @ self.cell.robot.hand.palm_directions(T)[0]).double().numpy()
        put = self._way_to_place(found, T_grasp, ahead, Postures.of(self.cell.robot, grasps, found.index))
        return found if put is None else replace(found, put=put)

    def _way_to_place(
        self, found: Feasible, T_grasp: Float[np.ndarray, "4 4"], ahead: Float[np.ndarray, "3"], hand: Postures
    ) -> Put | None:
        """A way to put the object down at the first place that there is one to; `ahead` is the palm's, in the wrist's frame."""
        assert self.places is not None
        robot, (lower, upper) = self.cell.robot, self.cell.robot.working_range
        draws = self.random.uniform(lower, upper, (PLACE_SEEDS - 3, len(lower)))
        for moved in self.places.motions:
            turned = moved[:3, :3] @ T_grasp[:3, :3] @ ahead
            for seed in [found.lift[-1], found.approach[-1], robot.home, *draws]:
                q = self.solver.solve(moved @ T_grasp, [seed])
                if q is not None and (put := self._put(q, T_grasp, turned, hand)) is not None:
                    return put
        return None

    def _put(
        self, q: Float[np.ndarray, " n_arm"], T_grasp: Float[np.ndarray, "4 4"], ahead: Float[np.ndarray, "3"], hand: Postures
    ) -> Put | None:
        """How the object is put down with the arm in a configuration [rad or m], if there is a way."""
        free, clearance, robot, places = self.cell.free, self.config.clearance, self.cell.robot, self.places
        assert places is not None
        T, kept = robot.T_world_wrist(q), -places.allowed - TILTED
        moved = carried(T, T_grasp)
        if not free(q, hand.squeeze, clearance, moved, touch=True, kept=kept, aimed=True):
            return None
        height = min(LOWERED, self.config.lift)
        up, back = self._line(T, np.array([0, 0, height])), self._line(T, -self.config.standoff * ahead)
        raised = self.solver.follow(up, q)
        if raised is None or not free(raised[-1], hand.squeeze, moved=carried(up[-1], T_grasp), touch=True, kept=CARRIED):
            return None
        if not all(free(x, hand.squeeze, clearance, carried(up[i], T_grasp), touch=True, kept=kept, aimed=True)
                   for i, x in enumerate(raised)):
            return None
        released = self._released(q, moved, hand, kept)
        if released is None or (retreat := self.solver.follow(back, q)) is None:
            return None
        opening = np.linspace(0, 1, 5)[:, None] * (hand.opened - released) + released
        gone = all(free(x, released, clearance, moved, touch=True, kept=kept) for x in retreat) and all(
            free(retreat[-1], shape, clearance, moved, kept=kept) for shape in opening)
        return Put(moved, raised[::-1].copy(), retreat, released, T_grasp, kept) if gone else None

    def _released(
        self, q: Float[np.ndarray, " n_arm"], moved: Float[np.ndarray, "4 4"], hand: Postures, kept: float
    ) -> Float[np.ndarray, " n_dof"] | None:
        """The hand opened towards the pregrasp as far as it is free [rad or m]; None if that is less than LEAST_OPEN."""
        released, shares = None, np.linspace(0, 1, 9)
        for share in shares:
            posture = hand.grasp + share * (hand.pregrasp - hand.grasp)
            if not self.cell.free(q, posture, self.config.clearance, moved, touch=True, kept=kept):
                break
            if share >= LEAST_OPEN:
                released = posture
        return released

    def _line(self, T: Float[np.ndarray, "4 4"], motion: Float[np.ndarray, "3"]) -> Float[np.ndarray, "k 4 4"]:
        count = max(2, round(float(np.linalg.norm(motion)) / self.config.step) + 1)
        poses = np.tile(T, (count, 1, 1))
        poses[:, :3, 3] += np.linspace(0, 1, count)[:, None] * motion
        return poses


class WristSolver:
    """Solves for one robot, to half a millimetre; it knows no obstacles.

    An arm with few joints brings the grasp centre to its place, and turns the wrist as nearly as it can.
    """

    def __init__(self, cell: Workcell) -> None:
        """Aim with the frame of the cell's arm."""
        import mink

        few = cell.robot.has_few_joints
        self._T_wrist_aim = cell.robot.T_wrist_aim
        self._turned = TURNED if few else 2e-3  # largest error of the wrist's rotation [rad] (ours)
        self.model, self.addresses = cell.arm, arm_addresses(cell.arm, cell.robot)
        self.lower, self.upper = cell.robot.working_range
        self._configuration = mink.Configuration(self.model)
        # Weight of a radian against that of a metre (ours); arms that cannot reach every rotation are exact in position.
        cost = 0.01 if few else 0.3
        self._task = mink.FrameTask("wrist", "site", position_cost=1.0, orientation_cost=cost, lm_damping=1e-4)
        self._limit = mink.ConfigurationLimit(self.model)

    def solve(
        self, T_world_wrist: Float[np.ndarray, "4 4"], seeds: Iterable[Float[np.ndarray, " n_arm"]],
        iterations: int = 25,
    ) -> Float[np.ndarray, " n_arm"] | None:
        """The configuration with a wrist pose [m] that the first successful seed [rad or m] leads to; None if none does."""
        import mink

        self._task.set_target(mink.SE3.from_matrix(T_world_wrist @ self._T_wrist_aim))
        for seed in seeds:
            q = np.zeros(self.model.nq)
            q[self.addresses] = np.clip(seed, self.lower, self.upper)
            self._configuration.update(q)
            for _ in range(iterations):
                if self._arrived():
                    break
                try:
                    velocity = mink.solve_ik(
                        self._configuration, [self._task], 1.0, "daqp", damping=1e-6, limits=[self._limit])
                except mink.NoSolutionFound:
                    break
                self._configuration.integrate_inplace(velocity, 1.0)
            if self._arrived():
                return np.clip(self._configuration.q[self.addresses], self.lower, self.upper)
        return None

    def follow(
        self, poses: Float[np.ndarray, "k 4 4"], start: Float[np.ndarray, " n_arm"]
    ) -> Float[np.ndarray, "k n_arm"] | None:
        """Configurations along a line of neighbouring poses, without a jump; None if there are none."""
        found = []
        for T in poses:
            q = self.solve(T, [start], 10)
            if q is None or float(np.abs(q - start).max()) > 0.25:  # beyond, the arm flips over (ours)
                return None
            found.append(q)
            start = q
        return np.stack(found)

    def _arrived(self) -> bool:
        error = self._task.compute_error(self._configuration)
        return bool(np.linalg.norm(error[:3]) < 5e-4 and np.linalg.norm(error[3:]) < self._turned)


def reachable_directions(robot: Robot, place: Float[np.ndarray, "3"], seed: int = 0) -> Float[Tensor, "k 3"]:
    """Eight palm directions with which the arm brings its grasp centre nearly to a place [m], spread evenly."""
    arm = np.random.default_rng(seed).uniform(*robot.working_range, (50_000, len(robot.home)))
    T = torch.from_numpy(robot.T_world_wrist(arm)).float()
    away = (robot.hand.grasp_centres(T) - torch.from_numpy(place).float()).norm(dim=-1)
    directions = robot.hand.palm_directions(T)
    away = torch.where(directions[:, 2] < STEEPEST, away, torch.inf)
    near = directions[away.topk(64, largest=False).indices]
    return near[farthest_points(near, 8)]


def lowest_points(hand: Hand, grasps: GraspBatch, table: Table) -> Float[Tensor, " n"]:
    """Height of the hand's lowest point over the table in pregrasp, grasp and squeeze of complete grasps in the world [m].

    In squeeze it counts as PRESSED higher: that is where joints aim, and the table stops them.
    """
    postures = (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)
    points = torch.stack([hand.points(q, grasps.T_object_wrist) for q in postures], 1)
    points[:, 2, :, 2] += PRESSED
    points = points.flatten(1, 2)
    over = ((points[..., :2] - torch.tensor(table.centre)).abs() < torch.tensor(table.size) / 2).all(-1)
    return torch.where(over, points[..., 2], torch.inf).amin(-1)


def carried(T_world_wrist: Float[np.ndarray, "4 4"], T_at_grasp: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Motion of an object that the hand took hold of at one pose, and has at another."""
    return T_world_wrist @ np.linalg.inv(T_at_grasp)

