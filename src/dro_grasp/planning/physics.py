"""The robot at work in MuJoCo: gravity, position servos with the arm's real limits, and objects that may slip and fall."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull

from dro_grasp.geometry.rotations import roma
from dro_grasp.objects.ball_solid import solid_of
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.collisions import exclude_constant_contacts, open_hand
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.workcell import ARM, TABLE, arm_addresses, robot_spec, wxyz
from dro_grasp.simulation.hand_part import HULL_VERTICES, PREFIX, add_servos, joint_addresses, servo_joints
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.rollout import quiet
from dro_grasp.simulation.scene import add_object

LIFT_PROTOCOL = replace(PROTOCOLS["dro"], name="tabletop", timestep=0.002, force_limit=3.0, noslip=3)
"""Contacts and servos of the hand: friction 1, density 500 kg/m^3 and the servos' gains as in trials; at most 3 Nm (ours).

Without the solver against slip, held objects creep out of soft contacts; DexGraspBench has two of its iterations."""
TICK = 0.02
"""Time between targets of the servos [s] (ours)."""
STIFFNESS_PER_EFFORT = 40.0
"""Gain of an arm's servo for each Nm that it can exert [1/rad]: full torque at an error of 1.4 degrees (ours)."""
DAMPING_TIME = 0.03
"""Damping of an arm's servo over its stiffness [s] (ours); the wanted velocity is fed forward, so nothing lags behind."""
ARMATURE = 0.1
"""Inertia of the motors of an arm's joints [kg m^2]. Source: the usual value of models of such arms."""
ROLLING = 0.002
"""Rolling friction of the table, as of a cloth: balls come to rest [m] (ours)."""
ASIDE = 10.0
"""Where objects wait until they are placed, a metre apart [m]."""
MEMORY = 2**28
"""Memory for contacts [bytes]; what is not needed is never touched. Ours: by itself MuJoCo has room for some 300 contacts."""
SHAPE_GROUP = 4
"""Group of the geoms that only cameras see: the objects' true meshes."""
PART_GROUP = 3
"""Group of the convex parts, with which objects collide."""
FOOT = 0.004
"""What an estimated object has this near to its lowest point stands on the table [m] (ours)."""
BALL_BIT = 2
"""Bit of contacts of an estimated object's balls with the hand (ours)."""
HULL_BIT = 4
"""Bit of contacts of its convex hull with the table (ours)."""


def object_name(index: int) -> str:
    """Name of the body and of the free joint of one of the objects in a scene."""
    return f"object{index}-"


class LiftScene:
    """Robot, table and objects, and the state that they are in."""

    def __init__(self, robot: Robot, objects: Sequence[ObjectModel]) -> None:
        """Build the scene, with the robot at home and the objects far away; the table is the robot's."""
        self.robot, self.objects = robot, tuple(objects)
        scene = robot_spec(robot, LIFT_PROTOCOL, robot.table)
        scene.memory = MEMORY
        for body in list(scene.bodies)[1:]:
            body.gravcomp = 1.0  # a robot's controller holds its own weight
        _add_arm_servos(scene, robot)
        add_servos(scene, robot.hand, LIFT_PROTOCOL)
        self._centres = [_add_thing(scene, obj, i) for i, obj in enumerate(objects)]
        if robot.table is not None:
            board = scene.geom(TABLE)
            board.condim, board.friction = 6, [LIFT_PROTOCOL.friction, 0.005, ROLLING]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            exclude_constant_contacts(scene, robot)
            self.model = scene.compile()
        self.data = mujoco.MjData(self.model)
        self._arm, (self._hand, moving) = arm_addresses(self.model, robot), joint_addresses(self.model, robot.hand)
        self._objects = [int(self.model.jnt_qposadr[self.model.joint(object_name(i)).id]) for i in range(len(objects))]
        names = [self.model.actuator(i).name for i in range(self.model.nu)]
        self._arm_servos = np.array([names.index(ARM + n) for n in robot.arm_joints])
        self._hand_servos, self._driven = servo_joints(self.model, robot.hand)
        tree = robot.hand.tree
        self._coupling, self._offset = (t.double().numpy()[moving] for t in (tree.coupling, tree.offset))
        self.begin(robot.home, open_hand(robot))

    def begin(self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"]) -> None:
        """Start anew with the robot at rest in a configuration, and the objects far away."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._arm], self.data.qpos[self._hand] = arm, self._coupling @ hand + self._offset
        self.command(arm, np.zeros_like(arm), hand)
        for i in range(len(self.objects)):
            self.place(i, np.array([[1, 0, 0, ASIDE + i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))

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

    def speed(self, index: int) -> float:
        """How fast an object moves, its rotation counted at 5 cm from its centre [m/s]."""
        start = int(self.model.jnt_dofadr[self.model.joint(object_name(index)).id])
        linear, angular = self.data.qvel[start:start + 3], self.data.qvel[start + 3:start + 6]
        return float(np.linalg.norm(linear) + 0.05 * np.linalg.norm(angular))

    def wrist(self) -> Float[np.ndarray, "4 4"]:
        """Where the hand's root link really is [m]."""
        body, T = self.data.body(PREFIX + self.robot.hand.wrist_link), np.eye(4)
        T[:3, :3], T[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return T

    def in_hand(self, index: int) -> Float[np.ndarray, "4 4"]:
        """Where an object really is in the frame of the hand's root link [m]."""
        return np.linalg.inv(self.wrist()) @ self.pose(index)

    def joints(self) -> tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_dof"]]:
        """Where arm and hand really are, in independent joints [rad or m]."""
        names = {self.model.joint(j).name: int(self.model.jnt_qposadr[j]) for j in range(self.model.njnt)}
        rest = self.robot.hand.rest.double().tolist()
        places = [names.get(PREFIX + n) for n in self.robot.hand_joints]
        hand = [rest[i] if place is None else self.data.qpos[place] for i, place in enumerate(places)]
        return self.data.qpos[self._arm].copy(), np.array(hand, float)

    def command(
        self, arm: Float[np.ndarray, " n_arm"], velocity: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"]
    ) -> None:
        """Set the targets of all servos; joints above the palm stay where they are held."""
        self.data.ctrl[self._arm_servos] = arm + DAMPING_TIME * velocity
        self.data.ctrl[self._hand_servos] = hand[self._driven]

    def advance(self, seconds: float, watch: Callable[[], None] | None = None, every: float = 0.02) -> None:
        """Let time pass; `watch` is called at intervals of `every` seconds."""
        steps, stride = round(seconds / self.model.opt.timestep), max(1, round(every / self.model.opt.timestep))
        with quiet():
            for done in range(0, steps, stride):
                mujoco.mj_step(self.model, self.data, min(stride, steps - done))
                if watch is not None:
                    watch()

    def touched(self, index: int) -> int:
        """How many links of the hand touch an object."""
        body = self.model.body(object_name(index)).id
        links = set()
        for a, b in self.model.geom_bodyid[self.data.contact.geom].reshape(-1, 2).tolist():
            if body in (a, b):
                other = self.model.body(a if b == body else b).name
                links |= {other} if other.startswith(PREFIX) else set()
        return len(links)


def _add_thing(scene: mujoco.MjSpec, obj: ObjectModel, index: int) -> Float[np.ndarray, "3"]:
    """An object that collides as its convex parts, and is seen as its mesh; a bare cloud collides as balls.

    Returns:
        Its centre of mass, at which its body's frame is [m].
    """
    if obj.is_cloud:
        return _add_estimate(scene, obj, index)
    assert obj.vertices is not None
    assert obj.faces is not None
    body = add_object(scene, obj, LIFT_PROTOCOL, object_name(index))
    for geom in body.geoms:
        geom.group = PART_GROUP
    shape = scene.add_mesh(
        name=f"shape{index}", uservert=(obj.vertices - obj.centre_of_mass).ravel(), userface=obj.faces.astype(np.int32).ravel())
    shape.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=shape.name, contype=0, conaffinity=0, group=SHAPE_GROUP, mass=0.0)
    return obj.centre_of_mass


def _add_estimate(scene: mujoco.MjSpec, obj: ObjectModel, index: int) -> Float[np.ndarray, "3"]:
    """A bare cloud: the hand touches its balls; its hull stands on the table with a flat foot, so that the object stays put."""
    solid, board = solid_of(obj), scene.geom(TABLE)
    body = add_object(scene, solid, LIFT_PROTOCOL, object_name(index))
    for ball in body.geoms:
        ball.contype = ball.conaffinity = BALL_BIT
    cloud, height = obj.cloud.astype(float), float(board.pos[2] + board.size[2])
    foot = cloud[cloud[:, 2] < cloud[:, 2].min() + FOOT] * (1, 1, 0) + (0, 0, height)
    corners = np.concatenate([cloud, foot]) - solid.centre_of_mass
    mesh = scene.add_mesh(name=f"hull{index}", uservert=corners[ConvexHull(corners).vertices].ravel())
    mesh.maxhullvert = HULL_VERTICES
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, condim=4, mass=0.0, contype=HULL_BIT, conaffinity=HULL_BIT,
        friction=[LIFT_PROTOCOL.friction, LIFT_PROTOCOL.torsional_friction, 1e-4])
    hand = [geom for geom in scene.geoms if geom.parent is not None and geom.parent.name.startswith(PREFIX) and geom.contype]
    for geom, bit in [*((geom, BALL_BIT) for geom in hand), (board, HULL_BIT)]:
        geom.contype, geom.conaffinity = geom.contype | bit, geom.conaffinity | bit
    return solid.centre_of_mass


def _add_arm_servos(scene: mujoco.MjSpec, robot: Robot) -> None:
    for name, effort in zip(robot.arm_joints, robot.effort.tolist(), strict=True):
        joint = scene.joint(ARM + name)
        joint.armature, joint.frictionloss = ARMATURE, 0.0
        joint.damping[:], joint.stiffness[:] = 0.0, 0.0
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        servo = scene.add_actuator(name=ARM + name, target=ARM + name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        stiffness = STIFFNESS_PER_EFFORT * effort
        servo.set_to_position(kp=stiffness, kv=DAMPING_TIME * stiffness)
        servo.forcelimited, servo.forcerange = True, [-effort, effort]
