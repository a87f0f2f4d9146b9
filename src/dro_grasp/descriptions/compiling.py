"""Compile a hand: repair usable descriptions that MuJoCo refuses, and print nothing on the terminal."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco

from dro_grasp.descriptions.bounds import check_numbers, limit_notes
from dro_grasp.descriptions.notes import Note
from dro_grasp.errors import HandError

LEAST_MASS = 1e-4
"""Mass of moving links that state none, or a negative one [kg] (ours)."""
LEAST_INERTIA = 1e-8
"""Inertia of moving links that state none [kg m^2] (ours)."""
MOST_REPAIRS = 64
"""Number of repairs after which compiling fails (ours)."""


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
        raise HandError(f"{path} cannot be read: {one_line(error)}") from error
    finally:
        mujoco.set_mju_user_warning(before)


def one_line(error: Exception) -> str:
    """A message of MuJoCo on one line."""
    return "; ".join(line.strip() for line in str(error).strip().splitlines() if line.strip())


def compile_hand(spec: mujoco.MjSpec, path: Path, notes: list[Note]) -> mujoco.MjModel:
    """The compiled model. Repairs change the specification, so simulation gets them too.

    Raises:
        HandError: MuJoCo refuses the description for a reason that cannot be repaired, or a number is absurd.
    """
    with mujoco_speaks_to(notes, path):
        _settle_masses(spec, notes)
        model = _compile(spec, notes)
    check_numbers(model, path)
    notes.extend(limit_notes(model))
    return model


def _settle_masses(spec: mujoco.MjSpec, notes: list[Note]) -> None:
    """Take the least mass where a link states a negative one, which MuJoCo may raise to its least without a word."""
    for body in list(spec.bodies)[1:]:
        if body.mass < 0:
            notes.append(Note("warning", body.name, f"states a mass of {body.mass:g} kg; taken as {LEAST_MASS:g} kg"))
            body.mass = LEAST_MASS


def _compile(spec: mujoco.MjSpec, notes: list[Note]) -> mujoco.MjModel:
    for _ in range(MOST_REPAIRS):
        try:
            return spec.copy().compile()
        except ValueError as error:
            if not _repair(spec, str(error), notes):
                raise
    return spec.copy().compile()


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
