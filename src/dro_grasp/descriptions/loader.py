"""A hand description, URDF or MJCF, read once into a kinematic tree and link geometry.

MuJoCo reads the file, so kinematics and simulation agree on every link, limit and coupling.
"""

from __future__ import annotations

import hashlib
import os
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from dro_grasp.descriptions.bounds import guess_unit
from dro_grasp.descriptions.compiling import compile_hand, mujoco_speaks_to
from dro_grasp.descriptions.couplings import Coupling
from dro_grasp.descriptions.link_geometry import LinkGeometry, read_geometry
from dro_grasp.descriptions.notes import Note
from dro_grasp.descriptions.open_posture import open_key, open_state
from dro_grasp.descriptions.part import arm_in_mjcf, arm_in_urdf, named, part_of_mjcf, part_of_urdf
from dro_grasp.descriptions.reduction import keep_hand_only
from dro_grasp.descriptions.tree_reading import contradicted_limits, read_couplings, read_tree
from dro_grasp.descriptions.urdf import prepare_urdf
from dro_grasp.descriptions.urdf_meshes import as_obj
from dro_grasp.descriptions.xml_files import included_files, parse_xml
from dro_grasp.errors import HandError
from dro_grasp.files import given_path
from dro_grasp.kinematics.tree import KinematicTree


def load_description(path: Path | str, link: str | None = None, *, arm: bool = False) -> Description:
    """Read a URDF or MJCF file, or the part of it that begins at a link.

    Args:
        path: The file.
        link: The link at which the hand begins; by default the file is the hand's, or the arm's.
        arm: Read the arm instead of the hand, up to this link. Its root stands still; a hand is free, so joints that move all
            of it are left out.

    Raises:
        HandError: The file cannot be used, or has no such link; the message gives the reason and a remedy.
    """
    path = given_path(path)
    root = parse_xml(path)
    notes: list[Note] = []
    if root.tag == "robot":
        if link is not None:
            (arm_in_urdf if arm else part_of_urdf)(root, link, path)
        spec, files = _read_urdf(root, path, notes)
        srdf = path.with_suffix(".srdf")
        stated = open_state(srdf) if os.path.isfile(srdf) else {}
        files = (*files, srdf) if stated else files
    elif root.tag == "mujoco":
        spec, files = _read_mjcf(root, path, notes)
        if link is not None and arm:
            arm_in_mjcf(spec, link, path)
        elif link is not None:
            spec = part_of_mjcf(spec, link, path)
        with mujoco_speaks_to(notes, path):
            stated = open_key(spec)
    else:
        raise HandError(f"{path} starts with <{root.tag}>; expected a URDF (<robot>) or MJCF (<mujoco>) file")
    notes.extend(keep_hand_only(spec, path, fixed_base=arm))
    model = compile_hand(spec, path, notes)
    tree = read_tree(model, read_couplings(model), path)
    notes.extend(contradicted_limits(model, tree))
    return Description(path.resolve(), link, spec, model, tree, _digest(path, files, link), tuple(notes), stated)


@dataclass(frozen=True, eq=False)
class Description:
    """The content of a hand's file. Each body of the compiled model is a link; the first one is the root, at identity."""

    path: Path
    """The file."""
    link: str | None
    """The link at which the hand that was read begins, or at which the arm ends; None for the whole file."""
    _spec: mujoco.MjSpec
    model: mujoco.MjModel
    """The hand alone, compiled."""
    tree: KinematicTree
    """The kinematic tree, with couplings resolved."""
    sha256: str
    """Hash of the file, of the files it uses, and of the part's name."""
    notes: tuple[Note, ...]
    """Findings and repairs."""
    open_posture: Mapping[str, float]
    """The open posture that the file, or the SRDF beside it, states, by joint [rad or m]; empty if it states none."""

    @property
    def name(self) -> str:
        """The file's stem, and the part of it."""
        return named(self.path.stem, self.link)

    @property
    def source(self) -> str:
        """The file, and the part of it."""
        return named(self.path, self.link)

    def spec(self) -> mujoco.MjSpec:
        """A new copy of the hand alone: without actuators, with couplings as joint equalities."""
        return self._spec.copy()

    @cached_property
    def couplings(self) -> tuple[Coupling, ...]:
        """Stated couplings between joints (URDF mimic, MJCF joint equalities and shared tendons)."""
        return read_couplings(self.model)

    @cached_property
    def link_of_body(self) -> dict[int, int]:
        """Index of the link that carries each body's geometry."""
        names = {name: i for i, name in enumerate(self.tree.link_names)}
        return {b: names[self.model.body(b).name] for b in range(1, self.model.nbody)}

    @cached_property
    def geometry(self) -> tuple[LinkGeometry, ...]:
        """All shapes of all links; a hand without any colliding shape collides with its visual ones."""
        return read_geometry(self.model, self.link_of_body)

    @cached_property
    def masses(self) -> Float[np.ndarray, " n_links"]:
        """Mass of each link [kg]."""
        masses = np.zeros(self.tree.n_links)
        for body, link in self.link_of_body.items():
            masses[link] = self.model.body_mass[body]
        return masses


def _read_urdf(root: ET.Element, path: Path, notes: list[Note]) -> tuple[mujoco.MjSpec, tuple[Path, ...]]:
    prepared = prepare_urdf(root, path)
    notes.extend(prepared.notes)
    assets = {name: as_obj(file) for name, file in prepared.converted.items()}
    with mujoco_speaks_to(notes, path):
        return mujoco.MjSpec.from_string(prepared.xml, assets=assets), prepared.mesh_files


def _read_mjcf(root: ET.Element, path: Path, notes: list[Note]) -> tuple[mujoco.MjSpec, tuple[Path, ...]]:
    included = included_files(root, path)
    if path.suffix.lower() != ".xml":
        raise HandError(f"{path} is MJCF, which MuJoCo reads only from files that end in .xml; rename it")
    with mujoco_speaks_to(notes, path):
        spec = mujoco.MjSpec.from_file(str(path))
    if not any("angle" in c.attrib for tree in (root, *map(parse_xml, included)) for c in tree.iter("compiler")):
        notes.extend(guess_unit(spec))
    folder, pictures = path.parent / (spec.meshdir or ""), path.parent / (spec.texturedir or "")
    meshes = {folder / mesh.file for mesh in spec.meshes if mesh.file}
    used = {*meshes, *(pictures / name for texture in spec.textures for name in (texture.file, *texture.cubefiles) if name)}
    missing = sorted(str(file) for file in used if not os.path.isfile(file))
    if missing:
        raise HandError(f"{path}: {len(missing)} files of meshes or textures are missing (first: {missing[0]}); put them "
                        "there or correct meshdir and texturedir")
    return spec, (*included, *meshes)


def _digest(path: Path, files: tuple[Path, ...], link: str | None) -> str:
    digest = hashlib.sha256(b"" if link is None else named("", link).encode())
    for file in (path, *sorted(set(files), key=os.fspath)):
        digest.update(file.read_bytes())
    return digest.hexdigest()
