"""A hand description, URDF or MJCF, read once into a kinematic tree and link geometry.

MuJoCo does the reading, so that kinematics and simulation agree on every link, limit and coupling.
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
import torch

from dro_grasp.errors import HandError
from dro_grasp.kinematics.couplings import Coupling, resolve_couplings
from dro_grasp.kinematics.link_geometry import LinkGeometry, read_geometry
from dro_grasp.kinematics.tree import FIXED, PRISMATIC, REVOLUTE, KinematicTree
from dro_grasp.kinematics.urdf import Note, parse_xml, prepare_urdf

CONTINUOUS_LIMIT = math.pi
"""Limits given to joints that state none [rad]."""


def load_description(path: Path | str) -> Description:
    """Read a URDF or MJCF file.

    Raises:
        HandError: The file cannot be used; the message says why and what to do.
    """
    path = Path(path).expanduser()
    root = parse_xml(path)
    if root.tag == "robot":
        spec, notes, files = _read_urdf(root, path)
    elif root.tag == "mujoco":
        spec, notes, files = _read_mjcf(path)
    else:
        raise HandError(f"{path} starts with <{root.tag}>; expected a URDF (<robot>) or MJCF (<mujoco>) file")
    hand_notes = _keep_hand_only(spec, path)
    description = Description(path.resolve(), spec, _digest(path, files), (*notes, *hand_notes))
    _ = description.tree  # so that what is wrong is said now
    return description


@dataclass(frozen=True, eq=False)
class Description:
    """What a file says of a hand. Bodies of the compiled model are links, the first one the root at identity."""

    path: Path
    """The file."""
    _spec: mujoco.MjSpec
    sha256: str
    """Hash of the file and of the meshes it uses."""
    loading_notes: tuple[Note, ...]
    """What loading found or repaired."""

    @property
    def name(self) -> str:
        """The file's stem."""
        return self.path.stem

    def spec(self) -> mujoco.MjSpec:
        """A fresh copy of the hand alone, without actuators, its couplings as joint equalities."""
        return self._spec.copy()

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The hand alone, compiled."""
        return _compile(self._spec, self.path)

    @cached_property
    def _bodies(self) -> tuple[int, ...]:
        """Bodies in the order of links before bodies with several joints are split."""
        return tuple(range(1, self.model.nbody))

    @cached_property
    def couplings(self) -> tuple[Coupling, ...]:
        """Stated couplings between joints (URDF mimic, MJCF joint equalities)."""
        model = self.model
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

    @cached_property
    def tree(self) -> KinematicTree:
        """The kinematic tree, couplings resolved."""
        return _read_tree(self.model, self.couplings, self.path)

    @cached_property
    def notes(self) -> tuple[Note, ...]:
        """Everything found while loading and deriving."""
        return (*self.loading_notes, *_limit_notes(self.model))

    @cached_property
    def link_of_body(self) -> dict[int, int]:
        """Index of the link that carries each body's geometry."""
        names = {name: i for i, name in enumerate(self.tree.link_names)}
        return {b: names[self.model.body(b).name] for b in self._bodies}

    @cached_property
    def geometry(self) -> tuple[LinkGeometry, ...]:
        """All shapes of all links; a hand without any colliding shape collides with its visual ones."""
        return read_geometry(self.model, self.link_of_body)

    @cached_property
    def masses(self) -> np.ndarray:
        """Mass of each link (n_links) [kg]."""
        masses = np.zeros(self.tree.n_links)
        for body, link in self.link_of_body.items():
            masses[link] = self.model.body_mass[body]
        return masses


def _read_urdf(root: ET.Element, path: Path) -> tuple[mujoco.MjSpec, tuple[Note, ...], tuple[Path, ...]]:
    prepared = prepare_urdf(root, path)
    assets = {name: _as_obj(file) for name, file in prepared.converted.items()}
    xml = prepared.xml
    for name in prepared.converted:
        xml = xml.replace(f'filename="{name}"', f'filename="{_stand_in(name)}"')
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            spec = mujoco.MjSpec.from_string(xml, assets={_stand_in(n): data for n, data in assets.items()})
    except ValueError as error:
        raise HandError(f"{path} cannot be read as a URDF: {_first_line(error)}") from error
    return spec, prepared.notes, prepared.mesh_files


def _stand_in(name: str) -> str:
    return hashlib.sha256(name.encode()).hexdigest()[:16] + ".obj"


def _as_obj(file: Path) -> bytes:
    """A mesh in any format trimesh reads, as OBJ text."""
    import trimesh

    mesh = trimesh.load_mesh(file)
    return trimesh.exchange.obj.export_obj(mesh, include_normals=False, include_texture=False).encode()


def _read_mjcf(path: Path) -> tuple[mujoco.MjSpec, tuple[Note, ...], tuple[Path, ...]]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise HandError(f"{path} cannot be read as MJCF: {_first_line(error)}. Check that every <include> and mesh "
                        "file exists; a model that needs a sibling's defaults is loaded through its scene file") from error
    folder = path.parent / (spec.meshdir or "")
    files = tuple(f for f in sorted({folder / mesh.file for mesh in spec.meshes if mesh.file}) if f.is_file())
    return spec, (), files


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]


def _keep_hand_only(spec: mujoco.MjSpec, path: Path) -> tuple[Note, ...]:
    """Reduce a file to the hand: its largest articulated body tree, root at identity, nothing that acts or films."""
    notes = []
    roots = spec.worldbody.bodies
    if not roots:
        raise HandError(f"{path} has no body; expected a hand with moving joints")
    moving = {id(r): [j for j in _all_joints(r) if j.type != mujoco.mjtJoint.mjJNT_FREE] for r in roots}
    hand = max(roots, key=lambda r: len(moving[id(r)]))
    if not moving[id(hand)]:
        raise HandError(f"{path} has no moving joint; a hand needs at least one revolute or prismatic joint")
    _couple_tendons(spec, notes)
    for kind in (spec.actuators, spec.sensors, spec.keys, spec.excludes, spec.pairs, spec.tendons, spec.cameras,
                 spec.lights):
        for item in list(kind):
            spec.delete(item)
    for geom in list(spec.worldbody.geoms):
        spec.delete(geom)
    for body in list(roots):
        if body.name != hand.name:
            notes.append(Note("info", body.name, "is not part of the hand and is left out"))
            spec.delete(body)
    hand.pos, hand.quat = [0, 0, 0], [1, 0, 0, 0]
    for joint in list(hand.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    _check_joints(spec, path)
    _let_visuals_collide(spec, notes)
    return tuple(notes)


def _all_joints(body: mujoco.MjsBody) -> list[mujoco.MjsJoint]:
    return [*body.joints, *(j for child in body.bodies for j in _all_joints(child))]


def _couple_tendons(spec: mujoco.MjSpec, notes: list[Note]) -> None:
    """One actuated fixed tendon over several joints: they move together, each by the same tendon length."""
    driven = {a.target for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_TENDON}
    for tendon in spec.tendons:
        if tendon.name not in driven:
            continue
        wraps = [w for w in tendon.path if w.type == mujoco.mjtWrap.mjWRAP_JOINT]
        if len(wraps) < 2:
            continue
        first = wraps[0]
        for other in wraps[1:]:
            equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=other.target.name, name2=first.target.name,
                                         objtype=mujoco.mjtObj.mjOBJ_JOINT)
            equality.data[:2] = [0.0, first.coef / other.coef]
            notes.append(Note("info", other.target.name, f"shares tendon '{tendon.name}' with "
                              f"'{first.target.name}' and moves with it"))


def _check_joints(spec: mujoco.MjSpec, path: Path) -> None:
    """Give unlimited joints limits; refuse ball joints."""
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_BALL:
            raise HandError(f"{path}: joint '{joint.name}' is a ball joint; expected hinges and slides (use three hinges)")
        limited = joint.limited == mujoco.mjtLimited.mjLIMITED_TRUE or (
            joint.limited == mujoco.mjtLimited.mjLIMITED_AUTO and joint.range[0] < joint.range[1])
        if not limited:
            joint.range = [-CONTINUOUS_LIMIT, CONTINUOUS_LIMIT]
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            joint.userdata = [1.0]


def _let_visuals_collide(spec: mujoco.MjSpec, notes: list[Note]) -> None:
    """Links without any colliding shape collide with their visual ones, if no other link collides either."""
    if any(g.contype or g.conaffinity for g in spec.geoms):
        return
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 1
    notes.append(Note("warning", "collision", "the description has no collision geometry; its visual shapes collide"))


def _compile(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return spec.copy().compile()
    except ValueError as error:
        raise HandError(f"{path} cannot be compiled: {_first_line(error)}") from error


def _read_tree(model: mujoco.MjModel, couplings: tuple[Coupling, ...], path: Path) -> KinematicTree:
    """Links from bodies; a body with several joints becomes a chain of links, the last one carrying its geometry."""
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
                T[:3, :3] = _quaternion_matrix(model.body_quat[b])
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


def _minus_reference(model: mujoco.MjModel, j: int) -> np.ndarray:
    """The motion that takes a joint from its reference value (MJCF `ref`) back to zero."""
    T = np.eye(4)
    if j < 0 or model.qpos0[model.jnt_qposadr[j]] == 0:
        return T
    x, axis, anchor = -float(model.qpos0[model.jnt_qposadr[j]]), model.jnt_axis[j], model.jnt_pos[j]
    if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
        T[:3, 3] = x * axis
        return T
    quaternion = np.concatenate([[math.cos(x / 2)], math.sin(x / 2) * axis])
    T[:3, :3] = _quaternion_matrix(quaternion)
    T[:3, 3] = anchor - T[:3, :3] @ anchor
    return T


def _limits(model: mujoco.MjModel, free: list[int], coupling: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the free joints, narrowed so that their followers stay within their own."""
    lower, upper = model.jnt_range[free, 0].copy(), model.jnt_range[free, 1].copy()
    for joint in range(model.njnt):
        if joint in free:
            continue
        for column, c in enumerate(coupling[joint]):
            if abs(c) < 1e-9:
                continue
            ends = sorted((model.jnt_range[joint] - offset[joint]) / c)
            narrowed = max(lower[column], ends[0]), min(upper[column], ends[1])
            if narrowed[1] - narrowed[0] > 0.2 * (upper[column] - lower[column]):
                lower[column], upper[column] = narrowed
    return lower, upper


def _limit_notes(model: mujoco.MjModel) -> tuple[Note, ...]:
    wide = [j for j in range(model.njnt) if np.allclose(model.jnt_range[j], [-CONTINUOUS_LIMIT, CONTINUOUS_LIMIT])]
    return tuple(Note("warning", model.joint(j).name, f"states no limits; taken as +-{CONTINUOUS_LIMIT:.2f}") for j in wide)


def _quaternion_matrix(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, float))
    return matrix.reshape(3, 3)


def _digest(path: Path, files: tuple[Path, ...]) -> str:
    digest = hashlib.sha256()
    for file in (path, *sorted(set(files), key=os.fspath)):
        digest.update(file.read_bytes())
    return digest.hexdigest()
