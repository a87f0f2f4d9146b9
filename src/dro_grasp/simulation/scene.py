"""One MuJoCo model for a hand and an object; it serves all grasps of the pair.

The hand's root is fixed at the origin; the object's free joint takes the inverse of a grasp's wrist pose.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.errors import HandError, ObjectError
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import require_pair
from dro_grasp.hands.description.compiling import collide
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.opening import open_side_by_side
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.hand_part import HULL_VERTICES, add_servos, attach, hand_spec, joint_addresses, servo_joints
from dro_grasp.simulation.protocols import Protocol, protocol as find_protocol

SOLVER_ITERATIONS = 20
"""Most iterations of the contact solver. Ours: trials usually need two, and a hundred give the same verdicts."""
FAR_AWAY = (0.0, 0.0, 5.0)  # Place of the object until a grasp is written [m]. Ours
CACHED_SCENES = 8  # Scenes that `cached_scene` keeps. Ours: a viewer or a benchmark returns to a few pairs and protocols


@dataclass(frozen=True, eq=False)
class TrialScene:
    """A compiled hand and object, and where to write a grasp."""

    model: mujoco.MjModel
    """The whole scene: the hand's bodies, joints and geoms with PREFIX before their names, the servos, and the body
    and free joint `object`."""
    hand: Hand
    obj: ObjectModel
    protocol: Protocol

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
    hand: Hand = field(compare=False)
    obj: ObjectModel = field(compare=False)


def cached_scene(hand: Hand, obj: ObjectModel, protocol: Protocol) -> TrialScene:
    """The scene of a pair; the process keeps the last few, least recently used first to go. Errors as below."""
    require_simulable(hand, obj)
    return _build_once(SceneKey(hand.sha256, obj.solid_sha256, protocol, hand, obj))


@lru_cache(maxsize=CACHED_SCENES)
def _build_once(key: SceneKey) -> TrialScene:
    return build_scene(key.hand, key.obj, key.protocol)


def scene_of(hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol) -> TrialScene:
    """The scene in which the grasps are simulated; errors are those of `simulate`."""
    require_pair(hand, obj)
    grasps.require_hand(hand)
    return cached_scene(hand, obj, find_protocol(protocol))


def require_simulable(hand: Hand, obj: ObjectModel) -> None:
    """Refuse a hand or an object that no trial can have.

    Raises:
        ObjectError: The object is a bare point cloud, without balls that stand for it.
        HandError: The hand came without its description.
    """
    if obj.is_cloud and obj.balls is None:
        raise ObjectError(f"object '{obj.name}' is a bare point cloud; a trial needs a mesh (--object); or use --protocol none")
    if hand.description is None:
        raise HandError(f"hand '{hand.name}' carries no description; load it by name or file to simulate it")


def build_scene(hand: Hand, obj: ObjectModel, protocol: Protocol) -> TrialScene:
    """Put a hand and an object into one model; errors are those of `require_simulable`."""
    require_simulable(hand, obj)
    scene = _empty_scene(protocol)
    attach(scene, hand_spec(hand, protocol), scene.worldbody.add_frame())
    add_servos(scene, hand, protocol)
    add_object(scene, obj, protocol)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _exclude_resting_contacts(scene, hand)
        return TrialScene(scene.compile(), hand, obj, protocol)


def _empty_scene(protocol: Protocol) -> mujoco.MjSpec:
    scene = mujoco.MjSpec()
    option = scene.option
    option.timestep, option.impratio, option.gravity = protocol.timestep, protocol.impratio, [0, 0, 0]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # The sparse Newton solver of MuJoCo 4.0.0 can be wrong.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations, option.noslip_iterations = SOLVER_ITERATIONS, protocol.noslip
    return scene


def add_object(scene: mujoco.MjSpec, obj: ObjectModel, protocol: Protocol, name: str = "object") -> mujoco.MjsBody:
    """The object as its convex parts, or as its balls, with its mass and inertia; body and free joint have the name.

    The body's frame is at the centre of mass: MuJoCo integrates its origin, which errs where a body turns about another point.
    """
    body = scene.worldbody.add_body(name=name, pos=FAR_AWAY)
    middle = obj.centre_of_mass
    body.add_freejoint(name=name)
    touch = {"condim": 4, "mass": 0.0, "friction": [protocol.friction, protocol.torsional_friction, 1e-4]}
    if obj.balls is not None:
        for centre, radius in zip((obj.balls.centres.numpy() - middle).tolist(), obj.balls.radii.tolist(), strict=True):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=centre, **touch)
    for i, (vertices, faces) in enumerate(obj.parts if obj.balls is None else ()):
        mesh = scene.add_mesh(name=f"{name}{i}", uservert=(np.asarray(vertices, float) - middle).ravel(),
                              userface=np.asarray(faces, np.int32).ravel())
        mesh.maxhullvert = HULL_VERTICES
        # A part's own inertia plays no role, and thin parts would be refused for it.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, **touch)
    mass = object_mass(obj, protocol)
    inertia = obj.inertia / obj.volume * mass
    body.explicitinertial, body.mass, body.ipos = True, mass, [0, 0, 0]
    body.fullinertia = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    return body


def object_mass(obj: ObjectModel, protocol: Protocol) -> float:
    """Mass of an object under a protocol [kg]."""
    return protocol.mass_factor * (obj.mass if protocol.mass is None else protocol.mass)


def _exclude_resting_contacts(scene: mujoco.MjSpec, hand: Hand) -> None:
    """Exclude contacts of links that touch in the open hand, fingers side by side, and of each link with its parent.

    Fingers that cross must collide. MuJoCo's own parent-child filter ignores static parents.
    """
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
    for first, second in sorted(p for p in pairs if p[0] != p[1] and "object" not in p):
        scene.add_exclude(bodyname1=first, bodyname2=second)


def _named(model: mujoco.MjModel, a: int, b: int) -> tuple[str, str]:
    first, second = sorted((model.body(a).name, model.body(b).name))
    return first, second
