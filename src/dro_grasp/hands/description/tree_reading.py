"""From a compiled model to a kinematic tree, joints that follow others, and the shapes of links."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int

from dro_grasp.errors import HandError
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.point_clouds import enclosed_volume
from dro_grasp.hands.description.compiling import TURNS, Note
from dro_grasp.hands.kinematics.tree import FIXED, PRISMATIC, REVOLUTE, KinematicTree

BEYOND = 0.02  # Least motion beyond a follower's own limits that is told [rad or m] (ours)
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


def read_tree(model: mujoco.MjModel, path: Path, notes: list[Note]) -> KinematicTree:
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
    joint_names = tuple(model.joint(j).name for j in range(model.njnt))
    free, coupling, offset = resolve_couplings(read_couplings(model), joint_names, path)
    lower, upper = _limits(model, free, coupling, offset)
    as_tensor = lambda a: torch.tensor(np.asarray(a), dtype=torch.float32)  # noqa: E731
    tree = KinematicTree(
        link_names=tuple(names), joint_names=tuple(joint_names[j] for j in free), moving_names=joint_names,
        parent=tuple(parent), link_joint=tuple(link_joint), kind=tuple(kind), origin=as_tensor(np.stack(origin)),
        axis=as_tensor(np.stack(axis)), anchor=as_tensor(np.stack(anchor)), lower=as_tensor(lower),
        upper=as_tensor(upper), coupling=as_tensor(coupling), offset=as_tensor(offset),
    )
    notes.extend(_contradicted_limits(model, tree))
    return tree


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


def _contradicted_limits(model: mujoco.MjModel, tree: KinematicTree) -> list[Note]:
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


@dataclass(frozen=True)
class Coupling:
    """follower = multiplier * leader + offset."""

    follower: int  # index of the following joint
    leader: int  # index of the leading joint; -1 if the follower is held at the offset
    multiplier: float  # motion of the follower per motion of the leader
    offset: float  # value of the follower while the leader is at zero [rad or m]


def resolve_couplings(
    couplings: tuple[Coupling, ...], names: Sequence[str], path: Path
) -> tuple[list[int], Float[np.ndarray, "n_joints n_dof"], Float[np.ndarray, " n_joints"]]:
    """Free joints, coupling and offset: joints = coupling @ free ones + offset; HandError: cycles, none free, absurd speeds."""
    n_joints, rule = len(names), {c.follower: c for c in couplings}
    free = [j for j in range(n_joints) if j not in rule]
    coupling, offset = np.zeros((n_joints, len(free))), np.zeros(n_joints)
    for joint in range(n_joints):
        factor, shift, current, seen = 1.0, 0.0, joint, [joint]
        while current in rule:
            step = rule[current]
            shift += factor * step.offset
            factor *= step.multiplier
            current = step.leader
            if current in seen:
                chain = " -> ".join(names[j] for j in [*seen, current])
                raise HandError(f"{path}: joints follow each other in a cycle ({chain}); one of them must be free")
            if current < 0:
                break
            seen.append(current)
        offset[joint] = shift
        if current >= 0:
            coupling[joint, free.index(current)] = factor
        if not (abs(factor) <= TURNS and abs(shift) <= TURNS):
            raise HandError(f"{path}: joint '{names[joint]}' follows at {factor:g} times its leader, from {shift:g}; expected "
                            f"at most {TURNS:g}")
    if not free:
        raise HandError(f"{path}: every joint follows another or is held; expected at least one that moves by itself")
    return free, coupling, offset


@dataclass(frozen=True)
class LinkGeometry:
    """One shape of one link."""

    link: int  # index of the link in the kinematic tree
    vertices: Float[np.ndarray, "n 3"]  # in the link frame [m]
    faces: Int[np.ndarray, "m 3"]  # vertex indices, counter-clockwise from outside
    collides: bool  # whether it collides in MuJoCo; the mesh of a colliding shape is its convex hull, which MuJoCo uses
    visual: bool  # whether it is drawn
    fill: float  # share of that hull which its mesh fills; 1 where it is no closed mesh that collides


def read_geometry(model: mujoco.MjModel, link_of_body: dict[int, int]) -> tuple[LinkGeometry, ...]:
    """All shapes of a compiled model whose bodies are links, given the link index by body index."""
    visual_bodies = {int(model.geom_bodyid[g]) for g in range(model.ngeom) if not _collides(model, g)}
    shapes = []
    for g in range(model.ngeom):
        body = int(model.geom_bodyid[g])
        if body not in link_of_body:
            continue
        collides = _collides(model, g)
        drawn = _mesh_of(model, g)
        if drawn is None:
            continue
        meshed = collides and int(model.geom_type[g]) == mujoco.mjtGeom.mjGEOM_MESH
        mesh = trimesh.convex.convex_hull(drawn) if meshed else drawn
        rotation, position = quaternion_matrix(model.geom_quat[g]), model.geom_pos[g]
        vertices = np.asarray(mesh.vertices) @ rotation.T + position
        visual = not collides or body not in visual_bodies
        shapes.append(LinkGeometry(link_of_body[body], vertices, np.asarray(mesh.faces), collides, visual, _fill(drawn, mesh)))
    return tuple(shapes)


def _collides(model: mujoco.MjModel, g: int) -> bool:
    return bool(model.geom_contype[g] or model.geom_conaffinity[g])


def _fill(mesh: trimesh.Trimesh, hull: trimesh.Trimesh) -> float:
    """Share of its hull's volume that a mesh fills, up to 1; 1 of an open one, which has none."""
    inside, whole = (abs(enclosed_volume(each.vertices[each.faces])) for each in (mesh, hull))
    return inside / whole if inside < whole and mesh.is_watertight else 1.0


def _mesh_of(model: mujoco.MjModel, g: int) -> trimesh.Trimesh | None:
    """The geom as triangles in its own frame; None for planes and height fields."""
    kind, size = int(model.geom_type[g]), model.geom_size[g]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        i = int(model.geom_dataid[g])
        vertices = model.mesh_vert[model.mesh_vertadr[i] :][: model.mesh_vertnum[i]]
        faces = model.mesh_face[model.mesh_faceadr[i] :][: model.mesh_facenum[i]]
        return trimesh.Trimesh(vertices, faces, process=False)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=(16, 16))
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return trimesh.creation.icosphere(subdivisions=2).apply_scale(size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    return None
