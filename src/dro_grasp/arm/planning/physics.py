"""The robot at work in MuJoCo: gravity, position servos with the arm's real limits, objects that may slip and fall; rehearsals.

A score is that of a floating object that is pushed in six directions. On a table fingers come from above, push the object into
it or tip it over, and then lift it: a rehearsal sees that. It needs no more than the planner has: a camera's cloud with its
estimated side will do. Ours.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull

from dro_grasp.arm.planning.motion import Trajectory
from dro_grasp.arm.planning.reachability import Feasible, Postures
from dro_grasp.arm.planning.workcell import ARM, TABLE, RobotJoints, Workcell, add_solids, moved, robot_spec, wxyz
from dro_grasp.arm.robots.robot import Robot, Table
from dro_grasp.errors import OptionError
from dro_grasp.geometry.cache import content_hash
from dro_grasp.geometry.se3 import roma
from dro_grasp.objects.shape import ObjectModel, solid_of
from dro_grasp.simulation.outcome import FEWEST_LINKS
from dro_grasp.simulation.protocols import PROTOCOLS, Protocol
from dro_grasp.simulation.quiet import quiet
from dro_grasp.simulation.scene import HULL_VERTICES, PREFIX, add_object, add_servos, servo_joints

LIFT_PROTOCOL = replace(PROTOCOLS["dro"], name="tabletop", timestep=0.002, force_limit=3.0, noslip=3)
"""Contacts and servos of the hand: density 500 kg/m^3 and the servos' gains as in trials; at most 3 Nm (ours).

Without the solver against slip, held objects creep out of soft contacts; DexGraspBench has two of its iterations."""
FRICTION = 0.5
"""Coefficient of friction between hand, object and table [1] (ours), as in `carry`; it is 1 in `LIFT_PROTOCOL`."""
TICK = 0.02  # Time between targets of the servos [s] (ours)
DAMPING_TIME = 0.03
"""Damping of an arm's servo over its stiffness [s] (ours); the wanted velocity is fed forward, so nothing lags behind."""
MEMORY = 2**28
"""Memory for contacts [bytes]; what is not needed is never touched. Ours: by itself MuJoCo has room for some 300 contacts."""
FIXTURES = "fixtures"  # Name of the body of things that do not move
SHAPE_GROUP = 4  # Group of the geoms that only cameras see: the objects' true meshes
BALL_BIT = 2  # Bit of contacts of an estimated object's balls with the hand (ours)
HULL_BIT = 4  # Bit of contacts of its convex hull with the table (ours)
STEADY = 0.005 * np.array([(1, 1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 0)])
"""Corners of the least foot of an estimated object, about what is below its centre of mass [m] (ours)."""
FALLEN = 0.02  # Depth from which on what was pushed fell off the table [m] (ours)
TIPPING_SECONDS = 0.5  # What tips over an edge takes its time [s] (ours)


@dataclass(frozen=True)
class Deviation:
    """What is different from what the planner thinks."""

    shift: tuple[float, float] = (0.0, 0.0)  # The object stands elsewhere on the table [m]
    friction: float = 1.0  # Factor of the friction
    weight: float = 1.0  # Factor of the object's weight
    unseen: float = 0.0  # What a camera did not see of the object lies this much farther out than is guessed [m]


DEVIATIONS = (Deviation(), Deviation((0.008, 0.0), 0.8, 1.3), Deviation((-0.004, 0.007), 0.8, 1.3),
              Deviation((-0.004, -0.007), 0.8, 1.3), Deviation(unseen=0.01), Deviation(unseen=-0.01))
"""How the rehearsals of one grasp deviate: not at all, then shifted, slippery and heavy, then with another unseen side.

Ours: on training objects, half of these shifts let two of 25 grasps pass that lose the true object, and these let none. Of
grasps that pass all shifts 226 of 235 held the true object; of those that pass all six, 158 of 159.
"""


def check_friction(friction: float) -> None:
    """Refuse what is no coefficient of friction: OptionError."""
    if not 0 < friction < math.inf:
        raise OptionError(f"friction is {friction}; give a coefficient above 0, such as {FRICTION}")


def object_name(index: int) -> str:
    """Name of the body and of the free joint of one of the objects in a scene."""
    return f"object{index}-"


class LiftScene:
    """Robot, table and objects, and the state that they are in."""

    def __init__(
        self, cell: Workcell, objects: Sequence[ObjectModel], fixtures: Sequence[ObjectModel] = (), friction: float = FRICTION,
    ) -> None:
        """Build the scene of the cell's robot and table, with the robot at home and the objects far away.

        Fixtures stand where they are, in the world's frame; they are not among the objects.
        """
        robot = self.robot = cell.robot
        self.objects, self.fixtures = tuple(objects), tuple(fixtures)
        protocol = replace(  # a slippery pad turns easily too
            LIFT_PROTOCOL, friction=friction, torsional_friction=friction * LIFT_PROTOCOL.torsional_friction)
        scene = robot_spec(robot, protocol, robot.table)
        scene.memory = MEMORY
        for body in list(scene.bodies)[1:]:
            body.gravcomp = 1.0  # a robot's controller holds its own weight
        _add_arm_servos(scene, robot)
        add_servos(scene, robot.hand, protocol)
        if fixtures:
            add_solids(scene, scene.worldbody.add_body(name=FIXTURES), fixtures)
        self._centres = [_add_thing(scene, protocol, obj, i) for i, obj in enumerate(objects)]
        if robot.table is not None:
            board = scene.geom(TABLE)
            # It rolls as on a cloth, so that balls come to rest (ours).
            board.condim, board.friction = 6, [friction, 0.005, 0.002]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.model = cell.compiled(scene)
        self.data, self._joints = mujoco.MjData(self.model), RobotJoints(self.model, robot)
        self._objects = [int(self.model.jnt_qposadr[self.model.joint(object_name(i)).id]) for i in range(len(objects))]
        names = [self.model.actuator(i).name for i in range(self.model.nu)]
        self._arm_servos = np.array([names.index(ARM + n) for n in robot.arm_joints])
        self._hand_servos, self._driven = servo_joints(self.model, robot.hand)
        self._gravity, self._friction = self.model.opt.gravity.copy(), self.model.geom_friction.copy()
        self.begin(robot.home, robot.open_hand)

    def deviate(self, friction: float = 1.0, weight: float = 1.0) -> None:
        """Multiply friction and weight of all that is there, from what they were at first."""
        self.model.opt.gravity[:], self.model.geom_friction[:] = weight * self._gravity, friction * self._friction

    def begin(self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"]) -> None:
        """Start anew with the robot at rest in a configuration, and the objects far away."""
        mujoco.mj_resetData(self.model, self.data)
        self._joints.set(self.data, arm, hand)
        self.command(arm, np.zeros_like(arm), hand)
        for i in range(len(self.objects)):
            self.place(i, np.array([[1, 0, 0, 10.0 + i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))

    def place(self, index: int, T_world_object: Float[np.ndarray, "4 4"]) -> None:
        """Put an object somewhere, at rest."""
        start, R = self._objects[index], T_world_object[:3, :3]
        self.data.qpos[start:start + 7] = [*(T_world_object[:3, 3] + R @ self._centres[index]), *wxyz(R)]
        velocity = int(self.model.jnt_dofadr[self.model.joint(object_name(index)).id])
        self.data.qvel[velocity:velocity + 6] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def pose(self, index: int) -> Float[np.ndarray, "4 4"]:
        """Where an object is [m]."""
        start = self._objects[index]
        T = np.eye(4)
        quaternion = torch.from_numpy(self.data.qpos[start + 3:start + 7].copy())
        T[:3, :3] = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(quaternion / quaternion.norm())).numpy()
        T[:3, 3] = self.data.qpos[start:start + 3] - T[:3, :3] @ self._centres[index]
        return T

    def centre(self, index: int) -> Float[np.ndarray, "3"]:
        """Where an object's centre of mass is [m]: the origin of its frame may be anywhere, and sways as it turns."""
        return self.data.body(object_name(index)).xpos.copy()

    def speed(self, index: int) -> float:
        """How fast an object moves, its rotation counted at 5 cm from its centre [m/s]."""
        start = int(self.model.jnt_dofadr[self.model.joint(object_name(index)).id])
        linear, angular = self.data.qvel[start:start + 3], self.data.qvel[start + 3:start + 6]
        return float(np.linalg.norm(linear) + 0.05 * np.linalg.norm(angular))

    def in_hand(self, index: int) -> Float[np.ndarray, "4 4"]:
        """Where an object really is in the frame of the hand's root link [m]."""
        return np.linalg.inv(self._T_world_root()) @ self.pose(index)

    def centre_in_hand(self, index: int) -> Float[np.ndarray, "3"]:
        """Where its centre of mass is in that frame [m]."""
        T_world_root = self._T_world_root()
        return T_world_root[:3, :3].T @ (self.centre(index) - T_world_root[:3, 3])

    def _T_world_root(self) -> Float[np.ndarray, "4 4"]:
        body, T = self.data.body(PREFIX + self.robot.hand.wrist_link), np.eye(4)
        T[:3, :3], T[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return T

    def joints(self) -> tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_dof"]]:
        """Where arm and hand really are, in independent joints [rad or m]."""
        names = {self.model.joint(j).name: int(self.model.jnt_qposadr[j]) for j in range(self.model.njnt)}
        rest = self.robot.hand.rest.double().tolist()
        places = [names.get(PREFIX + n) for n in self.robot.hand_joints]
        hand = [rest[i] if place is None else self.data.qpos[place] for i, place in enumerate(places)]
        return self.data.qpos[self._joints.arm].copy(), np.array(hand, float)

    def command(
        self, arm: Float[np.ndarray, " n_arm"], velocity: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"]
    ) -> None:
        """Set the targets of all servos; joints above the palm stay where they are held."""
        self.data.ctrl[self._arm_servos] = arm + DAMPING_TIME * velocity
        self.data.ctrl[self._hand_servos] = hand[self._driven]

    def advance(self, seconds: float, watch: Callable[[], None] | None = None) -> None:
        """Let time pass; `watch` is called once a tick."""
        steps, stride = round(seconds / self.model.opt.timestep), max(1, round(TICK / self.model.opt.timestep))
        with quiet():
            for done in range(0, steps, stride):
                mujoco.mj_step(self.model, self.data, min(stride, steps - done))
                if watch is not None:
                    watch()

    def follow(self, arm: Trajectory, hand: Trajectory, rows: slice, watch: Callable[[], None] | None = None) -> None:
        """Let the servos follow some rows of trajectories with the same times; `watch` is called once a tick."""
        ends = ((arm.time[rows] - arm.time[rows.start]) / self.model.opt.timestep).round()  # each in whole steps from the start
        for i, steps in enumerate(np.diff(ends), rows.start + 1):
            self.command(arm.position[i], arm.velocity[i], hand.position[i])
            self.advance(steps * self.model.opt.timestep, watch)

    def touched(self, index: int) -> int:
        """How many links of the hand touch an object."""
        body = self.model.body(object_name(index)).id
        pairs = self.model.geom_bodyid[self.data.contact.geom].reshape(-1, 2)
        touching = {int(other) for other in pairs[(pairs == body).any(1)].ravel()}
        return sum(self.model.body(other).name.startswith(PREFIX) for other in touching)


def _add_thing(scene: mujoco.MjSpec, protocol: Protocol, obj: ObjectModel, index: int) -> Float[np.ndarray, "3"]:
    """An object that collides as its convex parts, and is seen as its mesh; a bare cloud collides as balls.

    Returns:
        Its centre of mass, at which its body's frame is [m].
    """
    if obj.is_cloud:
        return _add_estimate(scene, protocol, obj, index)
    assert obj.vertices is not None
    assert obj.faces is not None
    body = add_object(scene, obj, protocol, object_name(index))
    for geom in body.geoms:
        geom.group = 3  # cameras do not see the parts
    shape = scene.add_mesh(
        name=f"shape{index}", uservert=(obj.vertices - obj.centre_of_mass).ravel(), userface=obj.faces.astype(np.int32).ravel())
    shape.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=shape.name, contype=0, conaffinity=0, group=SHAPE_GROUP, mass=0.0)
    return obj.centre_of_mass


def _add_estimate(scene: mujoco.MjSpec, protocol: Protocol, obj: ObjectModel, index: int) -> Float[np.ndarray, "3"]:
    """A bare cloud: the hand touches its balls; its hull stands on the table with a flat foot, so that the object stays put.

    What is at rest has its centre of mass above its foot, however little of the underside was seen.
    """
    solid, board = solid_of(obj), scene.geom(TABLE)
    body = add_object(scene, solid, protocol, object_name(index))
    for ball in body.geoms:
        ball.contype = ball.conaffinity = BALL_BIT
    cloud, height = obj.cloud.astype(float), float(board.pos[2] + board.size[2])
    low, below = cloud[cloud[:, 2] < cloud[:, 2].min() + 0.004], solid.centre_of_mass + STEADY  # within 4 mm of it (ours)
    corners = np.concatenate([cloud, np.concatenate([low, below]) * (1, 1, 0) + (0, 0, height)]) - solid.centre_of_mass
    mesh = scene.add_mesh(name=f"hull{index}", uservert=corners[ConvexHull(corners).vertices].ravel())
    mesh.maxhullvert = HULL_VERTICES
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, condim=4, mass=0.0, contype=HULL_BIT, conaffinity=HULL_BIT,
        friction=[protocol.friction, protocol.torsional_friction, 1e-4])
    hand = [geom for geom in scene.geoms if geom.parent is not None and geom.parent.name.startswith(PREFIX) and geom.contype]
    for geom, bit in [*((geom, BALL_BIT) for geom in hand), (board, HULL_BIT)]:
        geom.contype, geom.conaffinity = geom.contype | bit, geom.conaffinity | bit
    return solid.centre_of_mass


def _add_arm_servos(scene: mujoco.MjSpec, robot: Robot) -> None:
    for name, effort in zip(robot.arm_joints, robot.effort.tolist(), strict=True):
        joint = scene.joint(ARM + name)
        # The inertia of motors [kg m^2] is the usual one of models of such arms.
        joint.armature, joint.frictionloss = 0.1, 0.0
        joint.damping[:], joint.stiffness[:] = 0.0, 0.0
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        servo = scene.add_actuator(name=ARM + name, target=ARM + name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        stiffness = 40.0 * effort  # [1/rad]: full torque at an error of 1.4 degrees (ours)
        servo.set_to_position(kp=stiffness, kv=DAMPING_TIME * stiffness)
        servo.forcelimited, servo.forcerange = True, [-effort, effort]


@dataclass(frozen=True, eq=False)
class Rehearsed:
    """What became of one grasp."""

    share: float  # Of the rehearsals in which the object is held
    T_world_wrist: Float[np.ndarray, "4 4"] | None
    """Where the wrist would be, did the object stay in place while it shifts in the hand [m]; None where it was lost."""


class Rehearsal:
    """Lifts one object again and again."""

    def __init__(
        self, cell: Workcell, deviations: Sequence[Deviation] = DEVIATIONS, few_contacts: int = 100, friction: float = FRICTION,
    ) -> None:
        """Build the scene of robot, table and object, which are all there; obstacles are left out.

        Up to `few_contacts` the solver against slip runs: its time grows with their square, and hands that hold have some 20.
        """
        obj, self.T_world_object = cell.target, cell.T_world_target
        assert obj is not None
        if obj.is_cloud and not np.array_equal(self.T_world_object, np.eye(4)):  # what stands on a table has its foot there
            obj, self.T_world_object = moved(obj, self.T_world_object), np.eye(4)
        first, *further = deviations  # where nothing is guessed, there is nothing farther out
        self.deviations = [first, *(other for other in further if obj.seen is not None or not other.unseen)]
        self.few_contacts = few_contacts
        self._cell, self._obj, self._scenes, self._contact_friction = cell, obj, dict[float, LiftScene](), friction

    def scene(self, deviation: Deviation) -> LiftScene:
        """Where this takes place, as it was left."""
        unseen = deviation.unseen if self._obj.seen is not None else 0.0
        if unseen not in self._scenes:
            obj = guessed_farther(self._obj, unseen, self._cell.robot.table) if unseen else self._obj
            made = self._scenes[unseen] = LiftScene(self._cell, [obj], friction=self._contact_friction)
            made.model.opt.timestep = 0.004  # [s] (ours)
        return self._scenes[unseen]

    def rehearse(self, goal: Feasible, hand: Postures) -> Rehearsed:
        """All rehearsals of one grasp; one that drops the object where it is thought to be is the last."""
        if (T_wrist_object := self.grip(goal, hand, self.deviations[0])) is None:
            return Rehearsed(0.0, None)
        held = 1 + sum(self.grip(goal, hand, deviation) is not None for deviation in self.deviations[1:])
        return Rehearsed(held / len(self.deviations), self.T_world_object @ np.linalg.inv(T_wrist_object))

    def grip(self, goal: Feasible, hand: Postures, deviation: Deviation) -> Float[np.ndarray, "4 4"] | None:
        """Approach over 3 cm, close, lift by 8 cm and hold, once: where the object is in the wrist's frame [m]; None if lost.

        The hand closes as in trials; other numbers are ours.
        """
        scene, start = self._begin(deviation)
        approach = self._within(goal.approach[::-1], 0.03)[::-1]
        scene.begin(approach[0], hand.pregrasp)
        scene.place(0, start)
        low = scene.centre(0)[2]
        self._follow(scene, approach, hand.pregrasp[None], 0.3)
        self._follow(scene, approach[-1:], hand.closing, 1.0)
        self._follow(scene, approach[-1:], hand.squeeze[None], 0.3)
        if scene.touched(0) < FEWEST_LINKS:
            return None
        rows = self._within(goal.lift, 0.08)
        self._follow(scene, rows, hand.squeeze[None], 0.7)
        risen, grip = scene.centre(0)[2] - low, scene.centre_in_hand(0)
        if risen < self._lengths(rows)[-1] / 2:
            return None
        self._follow(scene, rows[-1:], hand.squeeze[None], 0.3)
        slip = np.linalg.norm(scene.centre_in_hand(0) - grip)
        return scene.in_hand(0) if slip < 0.02 and scene.touched(0) >= FEWEST_LINKS else None

    def push(self, arm: Trajectory, hand: Trajectory, rows: slice, deviation: Deviation) -> bool:
        """Whether the object stays on the table while the robot follows some rows of trajectories with the same times."""
        scene, start = self._begin(deviation)
        scene.model.opt.noslip_iterations = 0
        scene.begin(arm.position[rows.start], hand.position[rows.start])
        scene.place(0, start)
        height = scene.centre(0)[2]
        scene.follow(arm, hand, rows)
        scene.advance(TIPPING_SECONDS)
        return bool(scene.centre(0)[2] > height - FALLEN)

    def _begin(self, deviation: Deviation) -> tuple[LiftScene, Float[np.ndarray, "4 4"]]:
        """The scene that deviates so, and where the object begins in it."""
        scene, start = self.scene(deviation), self.T_world_object.copy()
        scene.deviate(deviation.friction, deviation.weight)
        start[:2, 3] += deviation.shift
        return scene, start

    def _within(self, rows: Float[np.ndarray, "k n_arm"], length: float) -> Float[np.ndarray, "m n_arm"]:
        """The first configurations of a straight line, and one step of it at least."""
        return rows[:1 + max(1, int(np.abs(self._lengths(rows) - length).argmin()))]

    def _lengths(self, rows: Float[np.ndarray, "k n_arm"]) -> Float[np.ndarray, " k"]:
        """How far the wrist of each configuration is from that of the first [m]."""
        places = self._cell.robot.T_world_wrist(rows)[:, :3, 3]
        return np.linalg.norm(places - places[0], axis=1)

    def _follow(
        self, scene: LiftScene, arm: Float[np.ndarray, "k n_arm"], hand: Float[np.ndarray, "m n_dof"], seconds: float
    ) -> None:
        """Let the servos follow waypoints, from rest to rest."""
        count = round(seconds / TICK)
        for i in range(1, count + 1):
            x = i / count
            along, rate = x * x * (3 - 2 * x), 6 * x * (1 - x) / seconds
            q, velocity = _at(arm, along)
            scene.command(q, rate * velocity, _at(hand, along)[0])
            few = scene.data.ncon <= self.few_contacts
            scene.model.opt.noslip_iterations = LIFT_PROTOCOL.noslip if few else 0
            scene.advance(TICK)


def guessed_farther(obj: ObjectModel, distance: float, table: Table | None) -> ObjectModel:
    """A bare cloud whose guessed points lie farther out, as far as its table leaves room.

    Args:
        obj: The cloud, with normals out of it.
        distance: How much farther; negative is farther in [m].
        table: What it stands on, in the world, whose frame the cloud's is.
    """
    cloud = obj.cloud + distance * obj.guessed[:, None] * obj.cloud_normals
    if table is not None:
        cloud[:, 2] = np.maximum(cloud[:, 2], min(table.height, float(obj.cloud[:, 2].min())))
    cloud = cloud.astype(np.float32)
    return replace(obj, cloud=cloud, sha256=content_hash(cloud), balls=None)


def _at(rows: Float[np.ndarray, "k n"], along: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Place on a line through waypoints, 0 to 1, and its derivative by that."""
    if len(rows) == 1:
        return rows[0], np.zeros_like(rows[0])
    place = along * (len(rows) - 1)
    i = min(int(place), len(rows) - 2)
    step = rows[i + 1] - rows[i]
    return rows[i] + (place - i) * step, step * (len(rows) - 1)
