"""Compile a hand: repair what MuJoCo refuses, refuse numbers that no hand has, and print nothing on the terminal."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float

from dro_grasp.errors import HandError
from dro_grasp.files import reading
from dro_grasp.geometry.mesh_files import open_mesh, trimesh

LEAST_MASS = 1e-4  # Mass of moving links that state none, or a negative one [kg] (ours)
LEAST_INERTIA = 1e-8  # Inertia of moving links that state none [kg m^2] (ours)
MAX_JOINTS = 100  # Most joints that move (ours); a humanoid with two hands has some 80
MAX_LENGTH = 10.0  # Largest coordinate, size or travel of a slide [m] (ours)
MAX_TURN = 25.0
"""Largest limit of a joint that turns [rad] (ours): four turns; no finger, wrist or arm makes more than two either way. In
degrees, the limits of a finger are beyond it."""
LEAST_TURN = 0.1
"""Range of a hand's widest turning joint below which its limits look like radians that were read as degrees [rad] (ours)."""
TURNS = 1e4  # Largest reference angle [rad], and largest ratio or offset of a coupling (ours)
HEAVIEST = 1e4  # Largest mass [kg] and inertia [kg m^2] (ours)
NUMBERS = (
    ("link", "body_pos", "origin", MAX_LENGTH), ("link", "body_quat", "rotation", 2.0),
    ("vertex", "mesh_vert", "vertex", MAX_LENGTH), ("shape", "geom_pos", "origin", MAX_LENGTH),
    ("shape", "geom_quat", "rotation", 2.0), ("shape", "geom_size", "size", MAX_LENGTH),
    ("joint", "jnt_pos", "anchor", MAX_LENGTH),
    ("link", "body_ipos", "centre of mass", MAX_LENGTH), ("link", "body_mass", "mass", HEAVIEST),
    ("link", "body_inertia", "inertia", HEAVIEST), ("joint", "jnt_axis", "axis", 2.0),
    ("joint", "jnt_range", "limits", MAX_TURN), ("joint", "qpos0", "reference", TURNS),
    ("joint", "qpos_spring", "spring's reference", TURNS), ("joint", "jnt_stiffness", "stiffness", 1e9),
    ("site", "site_pos", "place", MAX_LENGTH), ("coupling", "eq_data", "coefficients", TURNS),
)
"""Numbers of a compiled model: the kind of their owner, the array, what it means, and the largest value. Lengths come before
masses, which MuJoCo derives from them where a file states none, and vertices before the origins of shapes, to which it adds
the middle of their mesh."""
UNITS = {"millimetres": 0.001, "centimetres": 0.01}  # Units that hands have in place of metres [m]
HAND = 0.15  # Usual length of fingers and of a hand [m] (ours)
PART = 0.05  # Usual extent of a mesh of a hand [m] (ours)


def likely_unit(size: float, usual: float) -> tuple[str, float]:
    """The unit, and its length [m], in which something measures so much that usually has so many metres."""
    return min(UNITS.items(), key=lambda unit: abs(math.log(size * unit[1] / usual)))


@contextmanager
def mujoco_speaks_to(notes: list[Note], path: Path) -> Iterator[None]:
    """Collect MuJoCo's warnings as notes; MuJoCo itself prints them and writes a log file into the working folder."""
    before: Callable[[str], None] | None = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: notes.append(Note("warning", path.name, text.strip())))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except ValueError as error:
        lines = [line.strip() for line in str(error).strip().splitlines()]
        raise HandError(f"{path} cannot be read: {'; '.join(filter(None, lines))}") from error
    finally:
        mujoco.set_mju_user_warning(before)


def compile_hand(spec: mujoco.MjSpec, path: Path, notes: list[Note]) -> mujoco.MjModel:
    """The compiled model, after repairs of the specification; HandError: MuJoCo refuses it, or a number is absurd."""
    for body in list(spec.bodies)[1:]:
        if body.mass < 0:  # MuJoCo may raise it to its least without a word
            notes.append(Note("warning", body.name, f"states a mass of {body.mass:g} kg; taken as {LEAST_MASS:g} kg"))
            body.mass = LEAST_MASS
    with mujoco_speaks_to(notes, path):
        model = compiled(spec, notes)
        if _drop_giants(spec, model, notes):
            model = compiled(spec, notes)
    _check_numbers(model, path)
    notes.extend(_limit_notes(model))
    return model


def compiled(spec: mujoco.MjSpec, notes: list[Note]) -> mujoco.MjModel:
    """The model of a specification, in which what MuJoCo refuses is repaired."""
    for _ in range(64):  # repairs, after which it fails
        try:
            return spec.copy().compile()
        except ValueError as error:
            if not _repair(spec, str(error), notes):
                raise
    return spec.copy().compile()


def _drop_giants(spec: mujoco.MjSpec, model: mujoco.MjModel, notes: list[Note]) -> bool:
    """Leave out meshes larger than any hand where all links that have them have other shapes, which then collide.

    In published files these are collision meshes in millimetres beside visual ones in metres. True if any were left out.
    """
    sizes = {model.mesh(m).name: float(np.ptp(model.mesh_vert[start : start + count], axis=0).max())
             for m, (start, count) in enumerate(zip(model.mesh_vertadr, model.mesh_vertnum, strict=True))}
    giants = {name for name, size in sizes.items() if size > MAX_LENGTH}
    bodies = [body for body in list(spec.bodies)[1:] if giants & {geom.meshname for geom in body.geoms}]
    if not all(any(geom.meshname not in giants for geom in body.geoms) for body in bodies):
        return False
    for body in bodies:
        for geom in [geom for geom in body.geoms if geom.meshname in giants]:
            spec.delete(geom)
        if not any(geom.contype or geom.conaffinity for geom in body.geoms):
            for geom in body.geoms:
                geom.contype = geom.conaffinity = 1
    if bodies:
        notes.append(Note("warning", ", ".join(body.name for body in bodies), f"meshes of up to {max(sizes.values()):.0f} m, "
                          "perhaps in millimetres, are left out, and other shapes collide instead; state the meshes' scale"))
    for mesh in [mesh for mesh in spec.meshes if mesh.name in giants]:
        spec.delete(mesh)
    return bool(bodies)


def _repair(spec: mujoco.MjSpec, message: str, notes: list[Note]) -> bool:
    """Repair the fault that a message names; False if there is nothing to repair."""
    element = re.search(r"Element name '([^']*)'", message)
    mesh = next((m for m in spec.meshes if element and m.name == element.group(1)), None)
    if "volume is too small" in message and mesh is not None and mesh.inertia != mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        notes.append(Note("warning", mesh.name, "is a mesh without volume"))
        return True
    if "at least 4 vertices" in message and mesh is not None:
        shapes = [g for g in spec.geoms if g.meshname == mesh.name]
        for link in dict.fromkeys(g.parent.name for g in shapes):
            notes.append(Note("warning", link, f"has the mesh '{mesh.name}' of fewer than 4 vertices, which encloses nothing; "
                              "it is left out"))
        for geom in shapes:
            spec.delete(geom)
        spec.delete(mesh)
        return True
    if "convex hull" in message and mesh is not None:
        colliding = [g for g in spec.geoms if g.meshname == mesh.name and (g.contype or g.conaffinity)]
        for geom in colliding:
            geom.contype = geom.conaffinity = 0
        if colliding:
            notes.append(Note("warning", mesh.name, "is a flat mesh, which cannot collide; it is only drawn"))
        return bool(colliding)
    if "decoder" in message or "mesh_facenormal" in message:  # which does not say of which OBJ
        refused = [mesh] if mesh is not None else [m for m in spec.meshes if m.file.lower().endswith(".obj")]
        return any([_convert(mesh, notes) for mesh in refused])
    compiler = spec.compiler
    if "inertia of moving bodies" in message and compiler.boundmass < LEAST_MASS:
        compiler.boundmass, compiler.boundinertia = LEAST_MASS, LEAST_INERTIA
        notes.append(Note("warning", "mass", f"some moving links have none; taken as {LEAST_MASS:g} kg"))
        return True
    if "A + B >= C" in message and not compiler.balanceinertia:
        compiler.balanceinertia = True
        notes.append(Note("warning", "inertia", "some links have impossible inertias, which are balanced"))
        return True
    return False


def _convert(mesh: mujoco.MjsMesh, notes: list[Note]) -> bool:
    """Give a mesh, in place, the vertices and faces that trimesh reads from its file; False if there are none."""
    found = read_mesh(file, notes) if (file := Path(mesh.file)).is_file() else None
    if not isinstance(found, trimesh.Trimesh) or not len(found.faces):
        return False
    mesh.file, mesh.uservert, mesh.userface = "", np.asarray(found.vertices).ravel(), np.asarray(found.faces).ravel()
    return True


def _check_numbers(model: mujoco.MjModel, path: Path) -> None:
    """Refuse numbers of a compiled hand that are not finite, or beyond all that a hand has; name their owner."""
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE):
        if np.abs(model.jnt_range[j]).max() > MAX_LENGTH:
            raise HandError(f"{path}: the limits of joint '{model.joint(j).name}' are {_told(model.jnt_range[j])} m; expected "
                            f"at most {MAX_LENGTH:g} m; this looks like millimetres: scale the file by 0.001")
    # MuJoCo divides an axis by its length, which overflows.
    for j in np.flatnonzero(~(np.linalg.norm(model.jnt_axis, axis=1) > 0.5)):
        raise HandError(f"{path}: the axis of joint '{model.joint(j).name}' is beyond all numbers; expected a direction, "
                        "such as 0 0 1")
    for kind, array, what, largest in NUMBERS:
        values = np.asarray(getattr(model, array), float)
        values = values[:, None] if values.ndim == 1 else values[:, :4]
        bad = np.flatnonzero(~(np.abs(values) <= largest).all(1))
        if len(bad):
            raise HandError(f"{path}: the {what} of {_owner(model, kind, int(bad[0]))} is {_told(values[bad[0]])}; expected "
                            f"finite numbers of at most {largest:g}, in metres, radians and kilograms"
                            f"{_hint(what, values[bad[0]], largest)}")


def guess_unit(spec: mujoco.MjSpec) -> list[Note]:
    """Take the angles of an MJCF file that states no unit as radians, in place, if no joint would turn as degrees."""
    turns = [joint.range[1] - joint.range[0] for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE]
    if not (spec.compiler.degree and 0 < max(turns, default=0.0) < math.degrees(LEAST_TURN)):
        return []
    spec.compiler.degree = False
    return [Note("warning", "limits", f"no joint would turn by more than {max(turns):.2g} degrees, MJCF's unit where none is "
                 'stated; taken as radians: state <compiler angle="radian"/>')]


def _limit_notes(model: mujoco.MjModel) -> list[Note]:
    """A question if no joint of a hand turns by more than a few degrees."""
    turns = np.ptp(model.jnt_range[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE], axis=1)
    if not 0 < turns.max(initial=0.0) < LEAST_TURN:
        return []
    return [Note("warning", "limits", f"no joint turns by more than {turns.max():.2g} rad; if the limits are radians, say so: "
                 'without <compiler angle="radian"/> MJCF has degrees')]


def _hint(what: str, values: Float[np.ndarray, " n"], largest: float) -> str:
    """What numbers beyond all bounds may be, if they are finite."""
    if not np.isfinite(values).all():
        return ""
    if what in {"mass", "inertia"}:
        return "; if the file does not state it, its shapes are in another unit than metres: scale the file, or only its meshes"
    if what == "limits":
        return "; this looks like degrees: write radians, or leave the limits out where a joint has none"
    if what == "vertex":
        unit, scale = likely_unit(float(np.abs(values).max()), PART)
        return f'; this looks like {unit}: state scale="{scale:g} {scale:g} {scale:g}" where the file names the mesh'
    return "; this looks like millimetres: scale the file by 0.001" if largest == MAX_LENGTH else ""


def _owner(model: mujoco.MjModel, kind: str, index: int) -> str:
    """The element that an entry of an array belongs to, in words."""
    if kind == "shape":
        return f"a shape of link '{model.body(int(model.geom_bodyid[index])).name}'"
    if kind == "coupling":
        of_joint, first = model.eq_type[index] == mujoco.mjtEq.mjEQ_JOINT, int(model.eq_obj1id[index])
        return f"the coupling of joint '{model.joint(first).name}'" if of_joint else f"the tie number {index}"
    if kind == "vertex":
        return f"mesh '{model.mesh(int(np.searchsorted(model.mesh_vertadr, index, 'right')) - 1).name}'"
    named = {"link": model.body, "site": model.site, "joint": model.joint}[kind]
    return f"{kind} '{named(index).name}'"


def _told(values: Float[np.ndarray, " n"]) -> str:
    return " ".join(f"{x:g}" for x in values)


@dataclass(frozen=True)
class Note:
    """One thing that loading derived, repaired or found wrong."""

    level: Literal["info", "warning", "error"]
    subject: str  # the link, joint or file concerned
    text: str


def in_lines(notes: Iterable[Note]) -> list[str]:
    """Notes for people; those of one level in the same words are one line."""
    alike: dict[tuple[str, str], list[str]] = {}
    for note in notes:
        alike.setdefault((note.level, note.text), []).append(note.subject)
    return [f"{level}: {', '.join(subjects)}: {text}" for (level, text), subjects in alike.items()]


def read_mesh(file: Path, notes: list[Note]) -> trimesh.Geometry:
    """A mesh in any format trimesh reads, in metres; another unit that the file states is noted."""
    # trimesh alone is called here, and its many readers raise whatever they stumble over.
    with reading(f"mesh {file}", HandError, "STL, OBJ, GLB, DAE or PLY, whole", Exception):
        loaded = open_mesh(file)
        unit = trimesh.units.unit_conversion(loaded.units, "meters") if loaded.units else 1.0
        mesh = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
        if not math.isclose(unit, 1.0):
            mesh.apply_scale(unit)
            told = Note("info", file.name, f"states that its unit is {unit:g} m, and is taken so")
            notes.extend([] if told in notes else [told])
        return mesh


def collide(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Find the contacts at the joint values of `data.qpos`, without any step of time, forces or velocities."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
