"""Compile a hand, repairing what MuJoCo refuses in otherwise usable descriptions, without noise on the terminal."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco

from dro_grasp.errors import HandError
from dro_grasp.kinematics.notes import Note

LEAST_MASS, LEAST_INERTIA = 1e-4, 1e-8
"""What moving links without mass get [kg, kg m^2]."""
MOST_REPAIRS = 64
"""Attempts before compiling is given up."""


@contextmanager
def mujoco_speaks_to(notes: list[Note], path: Path) -> Iterator[None]:
    """Collect MuJoCo's warnings as notes; it would print them and write a log file into the working folder.

    Raises:
        HandError: MuJoCo refuses the description.
    """
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
    """The compiled model; repairs change the specification, so that simulation gets them too.

    Raises:
        HandError: MuJoCo refuses the description for a reason that cannot be repaired.
    """
    with mujoco_speaks_to(notes, path):
        for _ in range(MOST_REPAIRS):
            try:
                return spec.copy().compile()
            except ValueError as error:
                if not _repair(spec, str(error), notes):
                    raise
        return spec.copy().compile()


def _repair(spec: mujoco.MjSpec, message: str, notes: list[Note]) -> bool:
    """Change what a message complains of; False when there is nothing to change."""
    element = re.search(r"Element name '([^']*)'", message)
    mesh = next((m for m in spec.meshes if element and m.name == element.group(1)), None)
    if "volume is too small" in message and mesh is not None and mesh.inertia != mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        notes.append(Note("warning", mesh.name, "is a mesh without volume"))
        return True
    if "at least 4 vertices" in message and mesh is not None:
        for geom in [g for g in spec.geoms if g.meshname == mesh.name]:
            spec.delete(geom)
        notes.append(Note("warning", mesh.name, "is a mesh of fewer than 4 vertices, which encloses nothing; it is left out"))
        spec.delete(mesh)
        return True
    if "convex hull" in message and mesh is not None:
        touching = [g for g in spec.geoms if g.meshname == mesh.name and (g.contype or g.conaffinity)]
        for geom in touching:
            geom.contype = geom.conaffinity = 0
        if touching:
            notes.append(Note("warning", mesh.name, "is a flat mesh, which cannot collide; it is only drawn"))
        return bool(touching)
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
