"""A hand as a part of scenes: its contacts, its servos, and what holds the joints above its palm."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Int

from dro_grasp.hands.hand import Hand
from dro_grasp.simulation.protocols import Protocol

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
    """Let a geom of a robot touch objects as all do, whatever its file says of its contacts; one that is only drawn stays so.

    Of two geoms of the same priority, a contact takes the larger dimension: four with an object, the normal between links.
    With friction there, the Newton solver of MuJoCo 4.0.0 diverges at times, and 1 % of the trials explode.
    """
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
    """Position servos on the independent joints, all hands alike.

    They are added to the scene, not to the hand, whose description may set defaults for actuators.
    """
    for joint in scene.joints:
        if joint.name.removeprefix(PREFIX) not in hand.tree.joint_names:
            continue
        lever = _lever(joint, protocol)
        name = joint.name.removeprefix(PREFIX)
        actuator = scene.add_actuator(name=name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=protocol.stiffness / lever**2, kv=protocol.damping / lever**2)
        limit = protocol.force_limit / lever
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
