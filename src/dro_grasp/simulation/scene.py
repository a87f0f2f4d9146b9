"""One MuJoCo model for a hand and an object; it serves all grasps of the pair.

The hand's root is fixed at the origin; the object's free joint takes the inverse of a grasp's wrist pose.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.errors import HandError, ObjectError
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import table_planes
from dro_grasp.grasps.sources import require_pair
from dro_grasp.hands.description.compiling import collide
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.opening import open_side_by_side
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.protocols import Protocol, protocol as find_protocol

HULL_VERTICES = 64  # Most vertices of a colliding hull; more only cost time. Ours
EQUALITY_TIME = 0.01  # Time constant of joint couplings [s]: the smallest that MuJoCo allows at a time step of 5 ms
PREFIX = "hand/"  # Prefix of the hand's names in a scene


def hand_spec(hand: Hand, protocol: Protocol) -> mujoco.MjSpec:
    """The hand with the protocol's contacts, without a description's damping, springs and limits of effort."""
    assert hand.description is not None
    spec, unlimited = hand.description.spec(), mujoco.mjtLimited.mjLIMITED_FALSE
    _hold_joints(spec, hand)
    for mesh in spec.meshes:
        mesh.maxhullvert = HULL_VERTICES
    for geom in spec.geoms:
        let_touch(geom)
        geom.friction[:2] = [protocol.friction, protocol.torsional_friction]
        geom.solref, geom.solimp = [0.02, 1], [0.9, 0.95, 0.001, 0.5, 2]
    for equality in spec.equalities:
        equality.solref = [EQUALITY_TIME, 1]
    for joint in spec.joints:
        joint.armature, joint.frictionloss = protocol.armature / _lever(joint, protocol) ** 2, 0.0
        joint.damping[:], joint.stiffness[:] = 0.0, 0.0
        joint.actfrclimited = unlimited
        if joint.name not in hand.tree.joint_names:  # its own limits are in those of its leader
            joint.limited = unlimited
    return spec


def let_touch(geom: mujoco.MjsGeom) -> None:
    """Let a geom of a robot touch objects as all do, whatever its file says; one that is only drawn stays so."""
    # Of two geoms of the same priority, a contact takes the larger dimension: four with an object, the normal between
    # links. With friction there, the Newton solver of MuJoCo 4.0.0 diverges at times, and 1 % of the trials explode.
    geom.condim, geom.margin, geom.gap, geom.priority = 1, 0.0, 0.0, 0
    if (geom.contype or geom.conaffinity) and not (geom.contype | geom.conaffinity) & 1:
        geom.contype |= 1  # the bit of objects


def attach(scene: mujoco.MjSpec, part: mujoco.MjSpec, frame: mujoco.MjsFrame, prefix: str = PREFIX) -> None:
    """Fix the root of a hand, or of an arm, to a frame of the scene, whose options are those of all."""
    part.option, part.visual, part.memory = scene.option, scene.visual, scene.memory  # MuJoCo warns where they differ
    # Where some meshes live in memory, MuJoCo 4.0.0 puts the prefix into the file names of the others as well.
    on_disk = {prefix + mesh.name: mesh.file for mesh in part.meshes if mesh.file and mesh.file not in part.assets}
    scene.attach(part, prefix=prefix, frame=frame)
    for mesh in scene.meshes:
        mesh.file = on_disk.get(mesh.name, mesh.file)


def add_servos(scene: mujoco.MjSpec, hand: Hand, protocol: Protocol) -> None:
    """Position servos on the independent joints: all hands alike, or as strong as each is."""
    efforts = dict(zip(hand.tree.joint_names, find_efforts(hand).limit.tolist(), strict=True)) if protocol.effort else {}
    # They are added to the scene, not to the hand, whose description may set defaults for actuators.
    for joint in scene.joints:
        if joint.name.removeprefix(PREFIX) not in hand.tree.joint_names:
            continue
        lever = _lever(joint, protocol)
        name = joint.name.removeprefix(PREFIX)
        actuator = scene.add_actuator(name=name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=protocol.stiffness / lever**2, kv=protocol.damping / lever**2)
        limit = efforts.get(name, protocol.force_limit / lever)
        actuator.forcelimited, actuator.forcerange = True, [-limit, limit]


def _lever(joint: mujoco.MjsJoint, protocol: Protocol) -> float:
    """Lever arm that turns Nm/rad into N/m for sliding joints [m]; 1 for turning joints."""
    return protocol.lever if joint.type == mujoco.mjtJoint.mjJNT_SLIDE else 1.0


def _hold_joints(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Hold the joints above the palm: remove those that already have their value, tie the others to theirs."""
    assert hand.description is not None
    model = hand.description.model
    values = hand.tree.coupling @ hand.rest + hand.tree.offset
    held = (hand.tree.coupling.abs() @ (~hand.movable).float() > 0).tolist()
    for name, value, hold in zip(hand.tree.moving_names, values.tolist(), held, strict=True):
        if not hold:
            continue
        for equality in [e for e in spec.equalities if name in (e.name1, e.name2)]:
            spec.delete(equality)
        # Equalities count from the reference value, at which the model stands without the joint.
        offset = value - float(model.qpos0[model.joint(name).qposadr[0]])
        if abs(offset) < 1e-6:
            spec.delete(spec.joint(name))
        else:
            tie = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=name, objtype=mujoco.mjtObj.mjOBJ_JOINT)
            tie.data[0] = offset


def joint_addresses(model: mujoco.MjModel, hand: Hand) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Addresses in qpos, and indices into the tree's moving joints, of the hand's joints in a scene."""
    names = {model.joint(j).name: int(model.jnt_qposadr[j]) for j in range(model.njnt)}
    pairs = [(names[PREFIX + n], i) for i, n in enumerate(hand.tree.moving_names) if PREFIX + n in names]
    return np.array([a for a, _ in pairs], int), np.array([i for _, i in pairs], int)


def servo_joints(model: mujoco.MjModel, hand: Hand) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Indices of the hand's servos among the actuators of a scene, and of the independent joints that they drive.

    Joints above the palm that were removed, since they are held, have none.
    """
    joints = {name: i for i, name in enumerate(hand.tree.joint_names)}
    pairs = [(i, joints[name]) for i in range(model.nu) if (name := model.actuator(i).name) in joints]
    return np.array([a for a, _ in pairs], int), np.array([i for _, i in pairs], int)


SOLVER_ITERATIONS = 20
"""Most iterations of the contact solver. Ours: trials usually need two, and a hundred give the same verdicts."""
FAR_AWAY = (0.0, 0.0, 5.0)  # Place of the object until a grasp is written [m]. Ours
MEMORY = 64 << 20  # Of the contacts of a simulation [bytes]. Ours: 340 with balls of a cloud overflow 15 MiB, MuJoCo's default
TABLE_AWAY = (0.0, 0.0, -10.0)  # Place of a table while there is none [m]. Ours
OBJECT_GROUP = 1  # Group of the object's geoms, and of nothing else, by which rays find them
CACHED_SCENES = 64  # Scenes that `cached_scene` keeps. Ours: those of many objects under two protocols; 8 MB each of Shadow


@dataclass(frozen=True, eq=False)
class TrialScene:
    """A compiled hand and object, and where to write a grasp."""

    model: mujoco.MjModel
    """The whole scene: the hand's bodies, joints and geoms with PREFIX before their names, the servos, and the body
    and free joint `object`."""
    hand: Hand
    obj: ObjectModel
    protocol: Protocol
    table: bool = False
    """Whether there is a table, the body `table`, which is TABLE_AWAY until a grasp is written."""
    closings: dict[bytes, dict[str, Float[np.ndarray, " k"]]] = field(default_factory=dict, repr=False)
    """Where hands that closed in this scene ended, by how they began; see `Rollout.close`."""

    @cached_property
    def object_body(self) -> int:
        """Body index of the object."""
        return self.model.body("object").id

    @cached_property
    def object_qpos(self) -> slice:
        """Place in qpos of the object's centre of mass and quaternion WXYZ."""
        start = int(self.model.jnt_qposadr[self.model.joint("object").id])
        return slice(start, start + 7)

    @cached_property
    def hand_qpos(self) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """Addresses in qpos, and indices into the tree's moving joints, of the simulated joints."""
        return joint_addresses(self.model, self.hand)

    @cached_property
    def actuated(self) -> Int[np.ndarray, " n_servos"]:
        """Index into the independent joints of each actuator."""
        return servo_joints(self.model, self.hand)[1]

    def qpos(self, T_object_wrist: Float[Tensor, "n 4 4"], joints: Float[Tensor, "n n_dof"]) -> Float[np.ndarray, "n nq"]:
        """Configurations of the hand at these joints and the object at its pose in the wrist frame."""
        n = len(joints)
        q = np.tile(self.model.qpos0, (n, 1))
        addresses, moving = self.hand_qpos
        tree = self.hand.tree
        q[:, addresses] = (joints @ tree.coupling.T + tree.offset).numpy()[:, moving]
        T_wrist_object = torch.linalg.inv(T_object_wrist.double())
        rotation = torch.as_tensor(roma.special_procrustes(T_wrist_object[:, :3, :3]))
        quaternion = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(rotation))
        centre = T_wrist_object[:, :3, 3] + rotation @ torch.from_numpy(self.obj.centre_of_mass).double()
        q[:, self.object_qpos] = torch.cat([centre, quaternion], -1).numpy()
        return q


@dataclass(frozen=True)
class SceneKey:
    """The pair and protocol of a scene; equal keys, by hashes of all that is simulated and by protocol, have the same scene."""

    hand_sha256: str
    solid_sha256: str
    protocol: Protocol
    table: bool
    hand: Hand = field(compare=False)
    obj: ObjectModel = field(compare=False)


def cached_scene(hand: Hand, obj: ObjectModel, protocol: Protocol, table: bool = False) -> TrialScene:
    """The scene of a pair; the process keeps the last few, least recently used first to go. Errors as below."""
    require_simulable(hand, obj)
    return _build_once(SceneKey(hand.sha256, obj.solid_sha256, protocol, table, hand, obj))


@lru_cache(maxsize=CACHED_SCENES)
def _build_once(key: SceneKey) -> TrialScene:
    return build_scene(key.hand, key.obj, key.protocol, key.table)


def scene_of(hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol) -> TrialScene:
    """The scene in which the grasps are simulated; errors are those of `simulate`."""
    require_pair(hand, obj)
    grasps.require_hand(hand)
    return cached_scene(hand, obj, find_protocol(protocol), table_planes(grasps) is not None)


def require_simulable(hand: Hand, obj: ObjectModel) -> None:
    """Refuse a cloud without balls that stand for it (ObjectError), and a hand without its description (HandError)."""
    if obj.is_cloud and obj.balls is None:
        raise ObjectError(f"object '{obj.name}' is a bare point cloud; a trial needs a mesh (object=...); or make no trial")
    if hand.description is None:
        raise HandError(f"hand '{hand.name}' carries no description; load it by name or file to simulate it")


def build_scene(hand: Hand, obj: ObjectModel, protocol: Protocol, table: bool = False) -> TrialScene:
    """Put a hand and an object, and perhaps a table, into one model; errors are those of `require_simulable`."""
    require_simulable(hand, obj)
    model = compiled(hand, protocol, table, lambda scene: add_object(scene, obj, protocol))
    return TrialScene(model, hand, obj, protocol, table)


def compiled(
    hand: Hand, protocol: Protocol, table: bool, add: Callable[[mujoco.MjSpec], mujoco.MjsBody]
) -> mujoco.MjModel:
    """The model of a hand, of the body `object` that is added, and perhaps of a table."""
    scene = _empty_scene(protocol)
    attach(scene, hand_spec(hand, protocol), scene.worldbody.add_frame())
    add_servos(scene, hand, protocol)
    add(scene)
    if table:
        _add_table(scene, protocol)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # They depend on the hand, and on whether there is a table, which stands still as the hand's root does.
        for first, second in hand.kept(("resting contacts", table), lambda: _resting_contacts(scene, hand)):
            scene.add_exclude(bodyname1=first, bodyname2=second)
        model = scene.compile()
    model.geom_group[:] = np.where(model.geom_bodyid == model.body("object").id, OBJECT_GROUP, 0)
    return model


def _empty_scene(protocol: Protocol) -> mujoco.MjSpec:
    scene = mujoco.MjSpec()
    scene.memory = MEMORY
    option = scene.option
    option.timestep, option.impratio, option.gravity = protocol.timestep, protocol.impratio, [0, 0, 0]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # The sparse Newton solver of MuJoCo 4.0.0 can be wrong.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations, option.noslip_iterations = SOLVER_ITERATIONS, protocol.noslip
    return scene


def add_object(scene: mujoco.MjSpec, obj: ObjectModel, protocol: Protocol, name: str = "object") -> mujoco.MjsBody:
    """The object as its convex parts, or as its balls, with its mass and inertia; body and free joint have the name."""
    # The body's frame is at the centre of mass: MuJoCo integrates its origin, which errs where a body turns about another
    # point.
    body = scene.worldbody.add_body(name=name, pos=FAR_AWAY)
    body.add_freejoint(name=name)
    if obj.balls is not None:
        centres = obj.balls.centres.numpy() - obj.centre_of_mass
        for centre, radius in zip(centres.tolist(), obj.balls.radii.tolist(), strict=True):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=centre, **touching(protocol))
    else:
        for mesh in add_parts(scene, obj, name):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, **touching(protocol))
    mass = object_mass(obj, protocol)
    inertia = obj.inertia / obj.volume * mass
    body.explicitinertial, body.mass, body.ipos = True, mass, [0, 0, 0]
    body.fullinertia = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    return body


def add_parts(scene: mujoco.MjSpec, obj: ObjectModel, name: str) -> list[str]:
    """Meshes of an object's convex parts, about its centre of mass; their names begin with the given one."""
    names = []
    for i, (vertices, faces) in enumerate(obj.parts):
        mesh = scene.add_mesh(name=f"{name}{i}", uservert=(np.asarray(vertices, float) - obj.centre_of_mass).ravel(),
                              userface=np.asarray(faces, np.int32).ravel())
        mesh.maxhullvert = HULL_VERTICES
        # A part's own inertia plays no role, and thin parts would be refused for it.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        names.append(mesh.name)
    return names


def touching(protocol: Protocol) -> dict[str, Any]:
    """How each shape of an object touches."""
    return {"condim": 4, "mass": 0.0, "friction": [protocol.friction, protocol.torsional_friction, 1e-4]}


def _add_table(scene: mujoco.MjSpec, protocol: Protocol) -> None:
    """A plane that each trial places for itself. The object rubs on it, and the hand slides, as it does on itself."""
    body = scene.worldbody.add_body(name="table", mocap=True, pos=TABLE_AWAY)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], condim=1, mass=0.0,
                  friction=[protocol.friction, protocol.torsional_friction, 1e-4])


def object_mass(obj: ObjectModel, protocol: Protocol) -> float:
    """Mass of an object under a protocol [kg]."""
    return protocol.mass_factor * (obj.mass if protocol.mass is None else protocol.mass)


def _resting_contacts(scene: mujoco.MjSpec, hand: Hand) -> list[tuple[str, str]]:
    """Links that touch in the open hand, fingers side by side, and each link with its parent: they do not collide."""
    # Fingers that cross must collide. MuJoCo's own parent-child filter ignores static parents.
    model = scene.compile()
    data = mujoco.MjData(model)
    addresses, moving = joint_addresses(model, hand)
    pairs: set[tuple[str, str]] = set()
    for openness in (0.75, 1.0):
        q = open_side_by_side(hand, openness)
        data.qpos[addresses] = (hand.tree.coupling @ q + hand.tree.offset).numpy()[moving]
        collide(model, data)
        pairs |= {_named(model, *map(int, model.geom_bodyid[geoms])) for geoms in data.contact.geom}
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        if parent > 0 and model.body_weldid[parent] == 0:
            pairs |= {_named(model, body, other) for other in range(1, model.nbody) if model.body_weldid[other] == 0}
    return sorted(p for p in pairs if p[0] != p[1] and "object" not in p)


def _named(model: mujoco.MjModel, a: int, b: int) -> tuple[str, str]:
    first, second = sorted((model.body(a).name, model.body(b).name))
    return first, second
