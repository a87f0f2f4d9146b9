"""Pushes of flat things to the edge of their table, where they overhang and can be taken.

The fingertips point down, come down to the table behind the thing, and push it straight ahead in a row. Nothing is pressed
down: with the same friction above and below, a thing that is pressed to its table stays there. Ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from dro_grasp.arm.flat.grips import LEAST_OVERHANG, farthest_ahead, flat_grasps
from dro_grasp.arm.flat.postures import ACROSS, AHEAD, OVER, WorkingHand
from dro_grasp.arm.planning.motion import MotionPlan, PlanNotes, PlanScene
from dro_grasp.arm.planning.physics import FRICTION, Deviation, Rehearsal
from dro_grasp.arm.planning.reachability import Reachability, ReachConfig, WristSolver
from dro_grasp.arm.planning.trajectory import STEP, Pair, free_motion, joined, smooth, still
from dro_grasp.arm.planning.workcell import Workcell, moved
from dro_grasp.arm.robots.robot import Robot, Table
from dro_grasp.errors import PlanError
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel

AT_TABLE = ReachConfig(table_margin=-0.002, clearance=0.0, deepest=0.05)
"""How flat grips are approached (ours): their fingertips touch the table, and reach around what is known from above only."""


LOWEST = 0.004  # Height of the part of a fingertip that meets what is lower [m] (ours)
SHORTEST = 0.006  # Shorter pushes are none [m] (ours)
FURTHER = 0.02  # The same for what overhangs already: small ones would creep over the edge [m] (ours)
LEAVING = 0.002  # Distance from what was pushed that the arm keeps on its way home [m] (ours)
SEEN = 0.98  # Share of a thing that the camera sees at the edge, at least [1] (ours)


@dataclass(frozen=True)
class SlideConfig(Checked):
    """How flat things are pushed to an edge. Values are ours."""

    share: float = 0.42
    """Share of its extent by which a thing shall overhang: with less than half of it, it stays."""
    most: float = 0.07
    """Largest overhang that is wanted [m]."""
    balance: float = 0.01
    """Distance of its middle from the edge that is kept [m]."""
    turns: tuple[float, ...] = (0.0, 0.35, -0.35, 0.7, -0.7, 1.0, -1.0)
    """Directions of the push, from straight out [rad]."""
    long: float = 2.0
    """Ratio of its extents from which on a thing turns its long side to the row of fingers that push it."""
    turning: float = 0.1
    """How much farther a thing is rather pushed than a radian aside [m]."""
    above: float = 0.08
    """Height above the table from which the fingertips come down straight, and to which they leave [m]."""
    hover: float = 0.004
    """Height at which collisions are looked for [m]; the rest of the way down is short."""
    press: float = 0.001
    """Depth in the table that the fingertips aim at, so that they touch it [m]."""
    press_thin: float = 0.003
    """The same for what is thinner than `thin`: fingertips that press little slide over its edge [m]."""
    thin: float = 0.0015
    """Height of what is thin [m]."""
    further: float = 0.006
    """How much farther the fingers aim, since they give way [m]."""
    behind: float = 0.02
    """Distance from the thing at which they come down [m]."""
    speed: float = 0.1
    """Largest speed of the push [m/s]."""
    step: float = 0.01
    """Distance between the poses that are solved [m]."""
    seeds: int = 4
    """Starts of inverse kinematics."""
    grips: int = 40
    """Grasps at the edge of which the arm has to reach one, before a thing is pushed there."""
    path_seconds: float = 2.0
    """Longest processor time for a path to the thing, and for the way home [s]."""
    rehearsed: bool = True
    """Whether pushes after which it falls off the table, when they are simulated on what is known of it, are left out."""
    friction: float = FRICTION
    """Coefficient of friction between hand, thing and table, for that."""
    deviations: tuple[Deviation, ...] = (Deviation(), Deviation((0.004, 0.004), 0.8), Deviation((-0.004, -0.004), 0.8))
    """How the simulated pushes deviate from what is known."""
    reach: ReachConfig = field(default_factory=lambda: AT_TABLE)
    """How the thing is approached at the edge."""


@dataclass(frozen=True, eq=False)
class Push:
    """A straight push of a thing, as seen from above."""

    direction: Float[np.ndarray, "3"]  # Unit vector
    length: float  # How far the middle of the thing is pushed [m]
    motion: Float[np.ndarray, "4 4"]  # Of the thing in the world [m]


def pushes(
    points: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"], table: Table, config: SlideConfig
) -> list[Push]:
    """Pushes that bring a thing to overhang, by its points and its middle in the world [m]; the shortest first."""
    found = []
    for axis, sign, turn in ((axis, sign, turn) for axis in (0, 1) for sign in (1.0, -1.0) for turn in config.turns):
        normal = np.zeros(3)
        normal[axis] = sign
        direction = math.cos(turn) * normal + math.sin(turn) * np.cross((0, 0, 1), normal)
        T = _aligned(points, middle, direction, config.long)
        turned = points @ T[:3, :3].T + T[:3, 3]
        edge = sign * table.centre[axis] + table.size[axis] / 2
        out = turned @ normal
        wanted = min(config.share * float(np.ptp(out)), config.most, float(out.max() - middle @ normal) - config.balance)
        length = (edge + wanted - float(out.max())) / math.cos(turn)
        T[:3, 3] += length * direction
        ends = turned + length * direction
        aside = np.abs(ends[:, 1 - axis] - table.centre[1 - axis]) - table.size[1 - axis] / 2
        least = FURTHER if float((points @ normal).max()) - edge >= LEAST_OVERHANG else SHORTEST
        if wanted >= LEAST_OVERHANG and length > least and float(aside.max()) < -0.02:
            found.append((length + config.turning * abs(turn), Push(direction, length, T)))
    return [push for _, push in sorted(found, key=lambda each: each[0])]


def _aligned(
    points: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], long: float
) -> Float[np.ndarray, "4 4"]:
    """The least turn about the vertical after which a long thing lies across a direction; none of others."""
    spread, T = points[:, :2] - points[:, :2].mean(0), np.eye(4)
    axes = np.linalg.svd(spread, full_matrices=False)[2]
    extents = np.ptp(spread @ axes.T, axis=0)
    if extents[0] < long * extents[1]:
        return T
    across = np.array([-direction[1], direction[0]])
    across = across if across @ axes[0] > 0 else -across
    sine, cosine = float(axes[0, 0] * across[1] - axes[0, 1] * across[0]), float(axes[0] @ across)
    T[:2, :2] = [[cosine, -sine], [sine, cosine]]
    T[:3, 3] = middle - T[:3, :3] @ middle
    return T


def slide(
    robot: Robot, obj: ObjectModel, obstacles: Sequence[ObjectModel] = (), config: SlideConfig | None = None, seed: int = 0,
    start: Float[np.ndarray, " n_arm"] | None = None,
) -> MotionPlan:
    """A motion that pushes a flat thing to an edge of its table, where the arm reaches a grasp of what overhangs.

    Args:
        robot: With a table, whose centre and size say where its edges are.
        obj: The thing in the world's frame.
        obstacles: What is neither touched nor pushed.
        config: How to push.
        seed: Of inverse kinematics and planner.
        start: Where the arm's joints are [rad or m]; home by default.

    Raises:
        PlanError: No edge is within reach, or the thing would fall off the table.
        OptionError: The hand has no thumb and two fingers.
    """
    config, table = config or SlideConfig(), robot.table
    if table is None:
        raise PlanError(f"'{obj.name}' cannot be pushed to an edge: robot '{robot.name}' has no table; state its centre and "
                        "size in the robot file")
    pusher = _Pusher(robot, obj, obstacles, config, seed, robot.home if start is None else start)
    unseen = blocked = 0
    for push in pushes(np.asarray(obj.cloud, np.float64), obj.centre_of_mass, table, config):
        if not pusher.is_free(push):
            blocked += 1
            continue
        if not pusher.is_seen(push):
            unseen += 1
            continue
        if not pusher.can_take(push):
            continue
        for line in pusher.lines(push):
            if (made := pusher.motion(push, line)) is not None and pusher.is_safe(made):
                return made
    if pusher.unsafe:
        raise PlanError(f"'{obj.name}' lies flat, and falls off the table in all {pusher.unsafe} pushes to an edge that were "
                        "simulated; move it nearer to the robot, or to another edge")
    if unseen:
        raise PlanError(f"'{obj.name}' lies flat, and the arm reaches no edge of the table at which the camera would see it: "
                        f"{unseen} pushes end outside of its image; turn the camera so that it sees an edge beside the arm, "
                        "and correct its pose in the robot file")
    in_way = f", and things stand in the way of {blocked} pushes" if blocked else ""
    raise PlanError(f"'{obj.name}' lies flat, and the arm reaches no edge of the table to which it could be pushed{in_way}; "
                    f"move {'them away, or move ' if blocked else ''}it nearer to an edge that the robot reaches around, or "
                    "correct the table's centre and size in the robot file")


Line = tuple[Float[np.ndarray, "k n_arm"], Float[np.ndarray, "m n_arm"], Float[np.ndarray, "k n_arm"]]
"""Configurations from above the table down, along the push, and up again."""


class _Pusher:
    """Finds how the arm carries out pushes of one thing."""

    def __init__(
        self, robot: Robot, obj: ObjectModel, obstacles: Sequence[ObjectModel], config: SlideConfig, seed: int,
        start: Float[np.ndarray, " n_arm"],
    ) -> None:
        self.robot, self.obj, self.config, self.seed, self.start = robot, obj, config, seed, start
        self.obstacles = tuple(obstacles)
        self.cell = Workcell(robot, obstacles, obj)
        self.solver, self.random = WristSolver(self.cell), np.random.default_rng(seed)
        self.working = WorkingHand.of(robot.hand)
        self.pointing = self.working.pointing.double().numpy()
        self.points = np.asarray(obj.cloud, np.float64)
        tips = np.concatenate([self.working.tip(f, self.working.pointing).double().numpy() for f in self.working.fingers])
        # Round tips: what meets the thing is as low as it is.
        self.tips = tips[tips[:, AHEAD] > tips[:, AHEAD].max() - max(LOWEST, float(np.ptp(self.points[:, 2])))]
        self.ahead = farthest_ahead(self.working, self.working.pointing)
        self.unsafe = 0  # Pushes that were left out because the thing falls

    def is_free(self, push: Push) -> bool:
        """Whether nothing else is where the thing and the fingers come along."""
        across = np.cross((0, 0, 1), push.direction)
        ends = self.points @ push.motion[:3, :3].T + push.motion[:3, 3]
        half = max(float(np.ptp(np.concatenate([self.points, ends]) @ across)), float(np.ptp(self.tips[:, ACROSS]))) / 2 + 0.02
        middle, rear = float(self.obj.centre_of_mass @ across), float((self.points @ push.direction).min())
        front = float((ends @ push.direction).max()) + 0.01
        things = np.concatenate([np.zeros((0, 3)), *(thing.cloud for thing in self.obstacles)])
        along = things @ push.direction
        inside = (np.abs(things @ across - middle) < half) & (along > rear - self.config.behind - 0.03) & (along < front)
        return not inside.any()

    def is_seen(self, push: Push) -> bool:
        """Whether the robot's camera, if it has one, will see the thing at the edge: planning goes on from what it sees."""
        ends = self.points @ push.motion[:3, :3].T + push.motion[:3, 3]
        return self.robot.camera is None or float(self.robot.camera.frames(ends).mean()) > SEEN

    def can_take(self, push: Push) -> bool:
        """Whether the arm reaches a grasp of the thing where it will be."""
        assert self.robot.table is not None
        there = moved(self.obj, push.motion)
        if np.linalg.norm(there.centre_of_mass - self.robot.T_world_base[:3, 3]) > self.robot.longest_reach:
            return False
        grasps = flat_grasps(self.robot.hand, there, self.robot.table)
        reach = Reachability(Workcell(self.robot, self.obstacles, there), replace(self.config.reach, seeds=3), self.seed)
        hopeless = reach.hopeless(grasps)
        rows = [i for i in range(len(grasps)) if i not in hopeless]
        rows = rows[::max(1, len(rows) // self.config.grips)]
        return any(not isinstance(reach.ways(grasps, row), str) for row in rows)

    def lines(self, push: Push) -> Iterator[Line]:
        """Ways of the arm: with the backs of the fingers, or with their inner sides."""
        config, table = self.config, self.robot.table
        assert table is not None
        for side in (1.0, -1.0):
            down, over = np.array([0.0, 0.0, -1.0]), side * push.direction
            B = np.column_stack([down, over, np.cross(down, over)])
            T = np.eye(4)
            T[:3, :3] = B @ self.working.axes.double().numpy()
            across = B[:, ACROSS]
            front = float(self.tips[:, OVER].max()) if side > 0 else -float(self.tips[:, OVER].min())
            middle = float(self.tips[:, ACROSS].max() + self.tips[:, ACROSS].min()) / 2
            half = float(np.ptp(self.tips[:, ACROSS])) / 2
            lateral = float(self.obj.centre_of_mass @ across)
            rear, end = (_met(points, push.direction, points @ across - lateral, half) for points in (
                self.points, self.points @ push.motion[:3, :3].T + push.motion[:3, 3]))
            T[:3, 3] = (rear - config.behind - front) * push.direction + (lateral - middle) * across
            T[2, 3] = table.height + self.ahead + config.hover
            # A long thing has to turn on the way: fingers go to where its turned side will be.
            if (line := self._solved(T, (end - rear + config.behind + config.further) * push.direction)) is not None:
                yield line

    def _solved(self, T: Float[np.ndarray, "4 4"], way: Float[np.ndarray, "3"]) -> Line | None:
        """Configurations from above a wrist pose to where the push ends and up again, if there are any without collisions."""
        config, robot = self.config, self.robot
        ahead = _line(T, way, config.step)
        up = np.array([0.0, 0.0, config.above])
        seeds = [robot.home, *self.random.uniform(*robot.working_range, (config.seeds - 1, len(robot.home)))]
        for seed in seeds:
            q = self.solver.solve(T, [seed])
            if q is None or (hovering := self.solver.follow(ahead, q)) is None:
                continue
            before, after = (self.solver.follow(_line(pose, up, config.step), at)
                             for pose, at in ((ahead[0], hovering[0]), (ahead[-1], hovering[-1])))
            if before is None or after is None or not all(
                    self.cell.free(x, self.pointing, 0.0, touch=True) for x in (*before, *hovering, *after)):
                continue
            if not self.cell.free(before[-1], robot.open_hand, 0.0) or not self.cell.free(after[-1], robot.open_hand, 0.0):
                continue
            is_thin = float(np.ptp(self.points[:, 2])) < config.thin
            lowered = ahead.copy()
            lowered[:, 2, 3] -= config.hover + (config.press_thin if is_thin else config.press)
            pressed = self.solver.follow(lowered, hovering[0])
            if pressed is not None:
                return before[::-1].copy(), pressed, after
        return None

    def is_safe(self, made: MotionPlan) -> bool:
        """Whether the thing stays on the table when it is pushed so in simulation."""
        rows = slice(made.part("approach").start, made.part("retreat").stop)
        safe = not self.config.rehearsed or all(
            self._rehearsal.push(made.arm, made.hand, rows, deviation) for deviation in self.config.deviations)
        self.unsafe += not safe
        return safe

    @cached_property
    def _rehearsal(self) -> Rehearsal:
        return Rehearsal(self.cell, friction=self.config.friction)

    def motion(self, push: Push, line: Line) -> MotionPlan | None:
        """The timed stages; None if there is no way to the thing or home from it."""
        robot, cell, config = self.robot, self.cell, self.config
        down, pressed, up = line
        opened, home = robot.open_hand, robot.home
        limits = robot.velocity, robot.acceleration

        def pushed(q: Float[np.ndarray, " n_arm"], clearance: float, posture: Float[np.ndarray, " n_dof"] = opened) -> bool:
            return cell.free(q, posture, clearance, push.motion, touch=True)

        there = free_motion(
            robot, self.start, down[0], lambda q, kept: cell.free(q, opened, kept), config.path_seconds, self.seed)
        back = None if there is None else free_motion(robot, up[-1], home, pushed, config.path_seconds, self.seed, LEAVING)
        if there is None or back is None:
            return None
        fingers = robot.hand_velocity, robot.hand_acceleration
        shape = smooth(np.stack([opened, self.pointing]), *fingers, STEP)
        unshape = smooth(np.stack([self.pointing, opened]), *fingers, STEP)
        if not all(cell.free(down[0], posture, 0.0) for posture in shape.position) or not all(
                pushed(up[-1], 0.0, posture) for posture in unshape.position):
            return None
        arms = [there, smooth(down, *limits, 0.5), smooth(np.stack([down[-1], pressed[0]]), *limits, 0.3),
                smooth(pressed, *limits, (push.length + config.behind) / config.speed),
                smooth(np.concatenate([pressed[-1:], up]), *limits, 0.5), back]
        pairs: list[Pair] = [
            (arms[0], still(opened, arms[0])), (still(down[0], shape), shape),
            *((arm, still(self.pointing, arm)) for arm in arms[1:5]),
            (joined([still(up[-1], unshape), arms[5]]), joined([unshape, still(opened, arms[5])]))]
        lengths = [len(arm.time) - (i > 0) for i, (arm, _) in enumerate(pairs)]
        arm, hand = (joined([pair[k] for pair in pairs]) for k in (0, 1))
        return MotionPlan(self._notes(push, pressed[0]), self._scene(), np.repeat(np.arange(len(pairs)), lengths), arm, hand)

    def _notes(self, push: Push, first: Float[np.ndarray, " n_arm"]) -> PlanNotes:
        robot, drivers = self.robot, self.robot.drivers
        assert robot.table is not None
        return PlanNotes(
            robot.name, self.obj.name, robot.arm_joints, robot.hand_joints, "world", robot.table.height, 0, {}, 0, -1, 0.0,
            robot.T_world_wrist(first).tolist(), self.seed, {}, slide=push.motion.tolist(),
            zeros=None if drivers.are_usual else drivers.zeros, scales=None if drivers.are_usual else drivers.scales,
            robot_file=robot.source)

    def _scene(self) -> PlanScene:
        n = len(self.robot.hand_joints)
        others = np.concatenate([np.zeros((0, 3)), *(thing.cloud for thing in self.obstacles)])
        return PlanScene(self.points, others, np.zeros((0, 4, 4)), np.zeros((0, n)), np.zeros(0), ())


def _met(
    points: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "3"], aside: Float[np.ndarray, " n"], half: float
) -> float:
    """How far along a direction the first of the points is that a row of fingers meets [m]."""
    within = np.abs(aside) < half
    return float(((points[within] if within.any() else points) @ direction).min())


def _line(T: Float[np.ndarray, "4 4"], motion: Float[np.ndarray, "3"], step: float) -> Float[np.ndarray, "k 4 4"]:
    count = max(2, math.ceil(float(np.linalg.norm(motion)) / step) + 1)
    poses = np.tile(T, (count, 1, 1))
    poses[:, :3, 3] += np.linspace(0, 1, count)[:, None] * motion
    return poses
