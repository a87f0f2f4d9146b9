"""From a compiled model to a kinematic tree."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.descriptions.couplings import Coupling, resolve_couplings
from dro_grasp.descriptions.notes import Note
from dro_grasp.kinematics.tree import FIXED, PRISMATIC, REVOLUTE, KinematicTree

BEYOND = 0.02
"""Least motion beyond a follower's own limits that is told [rad or m] (ours)."""
NARROWEST = 0.2
"""Share of a leading joint's range that its followers' limits must leave; narrower limits count as mistakes (ours)."""


def read_couplings(model: mujoco.MjModel) -> tuple[Coupling, ...]:
    """Joint equalities of a model, as functions of joint values."""
    found = []
    for e in range(model.neq):
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT:
            continue
        follower, leader = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        offset, multiplier = float(model.eq_data[e, 0]), float(model.eq_data[e, 1])
        # MuJoCo's polynomial acts on displacements from the reference configuration.
        offset += float(model.qpos0[model.jnt_qposadr[follower]])
        if leader >= 0:
            offset -= multiplier * float(model.qpos0[model.jnt_qposadr[leader]])
        found.append(Coupling(follower, leader, multiplier if leader >= 0 else 0.0, offset))
    return tuple(found)


def read_tree(model: mujoco.MjModel, couplings: tuple[Coupling, ...], path: Path) -> KinematicTree:
    """Links from bodies; a body with several joints becomes a chain of links, the last of which carries its geometry."""
    names, parent, link_joint, kind, origin, axis, anchor = [], [], [], [], [], [], []
    link_of_body: dict[int, int] = {}
    for b in range(1, model.nbody):
        joints = list(range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])) or [-1]
        for order, j in enumerate(joints):
            last = order == len(joints) - 1
            names.append(model.body(b).name if last else f"{model.body(b).name}/{order + 1}")
            above = link_of_body.get(int(model.body_parentid[b]), -1) if order == 0 else len(names) - 2
            parent.append(above)
            T = np.eye(4)
            if order == 0 and b > 1:
                T[:3, :3] = quaternion_matrix(model.body_quat[b])
                T[:3, 3] = model.body_pos[b]
            link_joint.append(j)
            slide = j >= 0 and model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
            kind.append(FIXED if j < 0 else PRISMATIC if slide else REVOLUTE)
            axis.append(np.zeros(3) if j < 0 else model.jnt_axis[j])
            anchor.append(np.zeros(3) if j < 0 or slide else model.jnt_pos[j])
            origin.append(T @ _minus_reference(model, j))
        link_of_body[b] = len(names) - 1
    free, coupling, offset = resolve_couplings(couplings, model.njnt, [model.joint(j).name for j in range(model.njnt)], path)
    lower, upper = _limits(model, free, coupling, offset)
    as_tensor = lambda a: torch.tensor(np.asarray(a), dtype=torch.float32)  # noqa: E731
    joint_names = tuple(model.joint(j).name for j in range(model.njnt))
    return KinematicTree(
        link_names=tuple(names), joint_names=tuple(joint_names[j] for j in free), moving_names=joint_names,
        parent=tuple(parent), link_joint=tuple(link_joint), kind=tuple(kind), origin=as_tensor(np.stack(origin)),
        axis=as_tensor(np.stack(axis)), anchor=as_tensor(np.stack(anchor)), lower=as_tensor(lower),
        upper=as_tensor(upper), coupling=as_tensor(coupling), offset=as_tensor(offset),
    )


def _minus_reference(model: mujoco.MjModel, j: int) -> Float[np.ndarray, "4 4"]:
    """The motion that takes a joint from its reference value (MJCF `ref`) back to zero."""
    T = np.eye(4)
    if j < 0 or model.qpos0[model.jnt_qposadr[j]] == 0:
        return T
    x, axis, anchor = -float(model.qpos0[model.jnt_qposadr[j]]), model.jnt_axis[j], model.jnt_pos[j]
    if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
        T[:3, 3] = x * axis
        return T
    quaternion = np.concatenate([[math.cos(x / 2)], math.sin(x / 2) * axis])
    T[:3, :3] = quaternion_matrix(quaternion)
    T[:3, 3] = anchor - T[:3, :3] @ anchor
    return T


def _limits(
    model: mujoco.MjModel, free: list[int], coupling: Float[np.ndarray, "n_joints n_dof"],
    offset: Float[np.ndarray, " n_joints"],
) -> tuple[Float[np.ndarray, " n_dof"], Float[np.ndarray, " n_dof"]]:
    """Limits of the free joints [rad or m], narrowed so that their followers stay within their own limits."""
    lower, upper = model.jnt_range[free, 0].copy(), model.jnt_range[free, 1].copy()
    for joint in range(model.njnt):
        if joint in free:
            continue
        for column, c in enumerate(coupling[joint]):
            if abs(c) < 1e-9:
                continue
            ends = sorted((model.jnt_range[joint] - offset[joint]) / c)
            narrowed = max(lower[column], ends[0]), min(upper[column], ends[1])
            if narrowed[1] - narrowed[0] > NARROWEST * (upper[column] - lower[column]):
                lower[column], upper[column] = narrowed
    return lower, upper


def contradicted_limits(model: mujoco.MjModel, tree: KinematicTree) -> list[Note]:
    """Followers whose leaders take them beyond their own limits, which are ignored then."""
    notes = []
    ends = (tree.lower, tree.upper)
    reached = np.sort(np.stack([(tree.coupling @ end + tree.offset).double().numpy() for end in ends]), 0)
    for joint, name in enumerate(tree.moving_names):
        beyond = max(model.jnt_range[joint, 0] - reached[0, joint], reached[1, joint] - model.jnt_range[joint, 1])
        if beyond > BEYOND:
            limits, way = (f"{low:.3g} to {high:.3g}" for low, high in (model.jnt_range[joint], reached[:, joint]))
            notes.append(Note("warning", name, f"has limits of {limits}, but what it follows takes it through {way}; they are "
                              "ignored"))
    return notes


def quaternion_matrix(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of a unit quaternion WXYZ."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, float))
    return matrix.reshape(3, 3)
