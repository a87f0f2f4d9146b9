"""A hand description, URDF or MJCF, or the part of it that is the hand, read once into a kinematic tree and link geometry.

MuJoCo reads the file, so kinematics and simulation agree on every link, limit and coupling.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote

import mujoco
import numpy as np
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import HandError
from dro_grasp.files import given_path
from dro_grasp.geometry.mesh_files import FETCH, is_pointer, trimesh
from dro_grasp.hands.description.compiling import Note, collide, compile_hand, compiled, guess_unit, mujoco_speaks_to, read_mesh
from dro_grasp.hands.description.dialects import MOST_UNKNOWN, drop_unknown
from dro_grasp.hands.description.inertials import lightened, mend_empty_inertials, mend_mjcf_inertials
from dro_grasp.hands.description.reduction import NO_LIMITS, keep_hand_only
from dro_grasp.hands.description.tree_reading import Coupling, LinkGeometry, read_couplings, read_geometry, read_tree
from dro_grasp.hands.description.urdf import CONTINUOUS, MOVING, in_any_case, prepare_urdf
from dro_grasp.hands.description.world_palm import with_palm_of_world
from dro_grasp.hands.description.xml_files import included_files, parse_xml
from dro_grasp.hands.kinematics.tree import KinematicTree

OPEN = "open"  # Name of the state or keyframe (ours; MoveIt's own examples use it)
CLOSED = "closed"  # Name of the one towards which joints close (ours)


def load_description(path: Path | str, link: str | None = None, *, arm: bool = False) -> Description:
    """Read a URDF or MJCF file, or the part of it that begins at a link; HandError: it cannot be used, or has no such link.

    Args:
        link: The link at which the hand begins; by default the file is the hand's, or the arm's.
        arm: Read the arm instead of the hand, up to this link. Its root stands still; a hand is free, so joints that move all
            of it are left out.
    """
    path = given_path(path)
    root = parse_xml(path)
    notes: list[Note] = []
    if root.tag == "robot":
        if link is not None:
            (arm_in_urdf if arm else part_of_urdf)(root, link, path)
        spec, files = _read_urdf(root, path, notes)
        srdf = path.with_suffix(".srdf")
        states = [read_state(srdf, name) if os.path.isfile(srdf) else {} for name in (OPEN, CLOSED)]
        known = {joint.get("name") for joint in root.iter("joint")}
        notes.extend(Note("warning", joint, f"is in the posture '{state}' of {srdf.name}, and no joint is called so; correct "
                          "the name") for state, posture in zip((OPEN, CLOSED), states, strict=True)
                     for joint in posture if joint not in known and link is None)
        files = (*files, srdf) if any(states) else files
    elif root.tag == "mujoco":
        spec, files = _read_mjcf(root, path, notes)
        if link is not None and arm:
            arm_in_mjcf(spec, link, path)
        elif link is not None:
            spec = part_of_mjcf(spec, link, path)
        with mujoco_speaks_to(notes, path):
            states = [read_key(spec, name) for name in (OPEN, CLOSED)]
        spec = spec if link is not None else with_palm_of_world(spec, path, notes)
    else:
        raise HandError(f"{path} starts with <{root.tag}>; expected a URDF (<robot>) or MJCF (<mujoco>) file")
    in_vain = {note.subject for note in notes if CONTINUOUS in note.text and not arm}
    notes.extend(note for note in keep_hand_only(spec, path, fixed_base=arm)
                 if not (note.text.startswith(NO_LIMITS) and note.subject in in_vain))
    model = compile_hand(spec, path, notes)
    if not arm:
        model = lightened(spec, model, path, notes)
    tree = read_tree(model, path, notes)
    return Description(path.resolve(), link, spec, model, tree, _digest(path, files, link), tuple(notes), *states)


@dataclass(frozen=True, eq=False)
class Description:
    """The content of a hand's file. Each body of the compiled model is a link; the first one is the root, at identity."""

    path: Path  # the file
    link: str | None  # the link at which the hand that was read begins, or at which the arm ends; None for the whole file
    _spec: mujoco.MjSpec
    model: mujoco.MjModel  # the hand alone, compiled
    tree: KinematicTree  # the kinematic tree, with couplings resolved
    sha256: str  # hash of the file, of the files it uses, and of the part's name
    notes: tuple[Note, ...]  # findings and repairs
    open_posture: Mapping[str, float]
    """The open posture that the file, or the SRDF beside it, states, by joint [rad or m]; empty if it states none."""
    closed_posture: Mapping[str, float]
    """Values towards which joints close, likewise."""

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
    def efforts(self) -> Float[np.ndarray, " n_dof"]:
        """Largest effort of each independent joint, as the file states it [Nm or N]; NaN where it states none."""
        stated = np.full(self.tree.n_dof, np.nan)
        for i, name in enumerate(self.tree.joint_names):
            joint = self.model.joint(name).id
            if self.model.jnt_actfrclimited[joint]:
                stated[i] = np.abs(self.model.jnt_actfrcrange[joint]).max()
        return stated

    @cached_property
    def masses(self) -> Float[np.ndarray, " n_links"]:
        """Mass of each link [kg]."""
        masses = np.zeros(self.tree.n_links)
        for body, link in self.link_of_body.items():
            masses[link] = self.model.body_mass[body]
        return masses


def _read_urdf(root: ET.Element, path: Path, notes: list[Note]) -> tuple[mujoco.MjSpec, tuple[Path, ...]]:
    xml, files, converted = prepare_urdf(root, path, notes)
    assets = {name: _as_obj(file, notes) for name, file in converted.items()}
    with mujoco_speaks_to(notes, path):
        try:
            return mujoco.MjSpec.from_string(xml, assets=assets), tuple(files)
        except ValueError as error:
            raise ValueError(_owned(str(error), xml)) from error


def _owned(message: str, xml: str) -> str:
    """What MuJoCo says of a line of XML that is in no file, said of the link or joint that it belongs to."""
    if (line := re.search(r", line (\d+)", message)) is None:
        return message
    before = "\n".join(xml.splitlines()[: int(line[1])])
    owners = re.findall(r'<(link|joint)\b[^>]*\bname="([^"]*)"', before)
    return message.replace(line[0], f" of {owners[-1][0]} '{owners[-1][1]}'" if owners else "")


def _as_obj(file: Path, notes: list[Note]) -> bytes:
    """A mesh in any format trimesh reads, as OBJ text in metres."""
    return trimesh.exchange.obj.export_obj(read_mesh(file, notes), include_normals=False, include_texture=False).encode()


def _read_mjcf(root: ET.Element, path: Path, notes: list[Note]) -> tuple[mujoco.MjSpec, tuple[Path, ...]]:
    path, included = _with_included(root, path)
    if path.suffix.lower() != ".xml":
        raise HandError(f"{path} is MJCF, which MuJoCo reads only from files that end in .xml; rename it")
    trees = {path: root, **{file: parse_xml(file) for file in included}}
    spec = _spec_of(trees, path, notes)
    mend_empty_inertials(spec, notes)
    if not any("angle" in c.attrib for tree in trees.values() for c in tree.iter("compiler")):
        notes.extend(guess_unit(spec))
    _drop_textures(spec)
    _find_meshes(spec, path, notes)
    meshes = {path.parent / (spec.meshdir or "") / mesh.file for mesh in spec.meshes if mesh.file}
    if pointers := sorted(str(file) for file in meshes if os.path.isfile(file) and is_pointer(file)):
        raise HandError(f"{path}: {len(pointers)} files of meshes are pointers of Git LFS (first: {pointers[0]}); {FETCH}")
    missing = sorted(str(file) for file in meshes if not os.path.isfile(file))
    if missing:
        raise HandError(f"{path}: {len(missing)} files of meshes are missing (first: {missing[0]}); put them there or correct "
                        "meshdir")
    for mesh in spec.meshes:  # a part of the file knows no meshdir
        mesh.file = mesh.file and str((path.parent / (spec.meshdir or "") / mesh.file).absolute())
    return spec, (*included, *meshes)


def _with_included(root: ET.Element, path: Path) -> tuple[Path, tuple[Path, ...]]:
    """An MJCF and the files that it includes; where it is a link and they lie beside its target, the target."""
    try:
        return path, included_files(root, path)
    except HandError:
        if not path.is_symlink():
            raise
        return path.resolve(), included_files(root, path.resolve())


def _drop_textures(spec: mujoco.MjSpec) -> None:
    """Delete, in place, textures, which nothing here draws: their files need not be there."""
    for texture in list(spec.textures):
        spec.delete(texture)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)


def _find_meshes(spec: mujoco.MjSpec, path: Path, notes: list[Note]) -> None:
    """Point meshes, in place, to files that lie beside a link's target or are spelled in another case."""
    folder = spec.meshdir or ""
    for mesh in spec.meshes:
        if not mesh.file or os.path.isfile(path.parent / folder / mesh.file):
            continue
        likely = [parent / folder / unquote(mesh.file) for parent in (path.parent, path.resolve().parent)]
        file = next(filter(None, map(in_any_case, likely)), None)
        if file is not None:
            notes.append(Note("warning", mesh.file, f"was not found, and {file.resolve()} is taken for it"))
            mesh.file = str(file.resolve())


def _spec_of(trees: Mapping[Path, ET.Element], path: Path, notes: list[Note]) -> mujoco.MjSpec:
    """What MuJoCo reads from a file and those that it includes, mended in memory where MuJoCo would not read them."""
    mended = any([mend_mjcf_inertials(tree, notes) for tree in trees.values()])
    with mujoco_speaks_to(notes, path):
        for _ in range(MOST_UNKNOWN):
            try:
                spec = _spec_in_memory(trees, path) if mended else mujoco.MjSpec.from_file(str(path))
                break
            except ValueError as error:
                if not drop_unknown(str(error), trees.values(), notes):
                    raise
                mended = True
        else:
            spec = _spec_in_memory(trees, path)
    return spec


def _spec_in_memory(trees: Mapping[Path, ET.Element], path: Path) -> mujoco.MjSpec:
    """The specification of a file and those that it includes as they are in memory; meshes are pointed to their files."""
    text, *more = (ET.tostring(tree) for tree in trees.values())
    names = [os.path.relpath(file, path.parent) for file in trees if file != path]
    spec = mujoco.MjSpec.from_string(text.decode(), include=dict(zip(names, more, strict=True)))
    spec.modelfiledir = str(path.parent)
    for mesh in spec.meshes:
        beside = path.parent / mesh.file  # where the file of an included one lies, in its own folder
        if mesh.file and beside.is_file() and not (path.parent / (spec.meshdir or "") / mesh.file).is_file():
            mesh.file = str(beside)
    return spec


def _digest(path: Path, files: tuple[Path, ...], link: str | None) -> str:
    digest = hashlib.sha256(b"" if link is None else named("", link).encode())
    # The same order wherever the folder lies, links or not.
    within = {os.path.relpath(file, path.parent): file for file in files}
    for file in (path, *(within[name] for name in sorted(within))):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def read_state(srdf: Path, name: str) -> dict[str, float]:
    """Joints in every `<group_state>` of this name in an SRDF [rad or m]; HandError: it is no XML, or a value is no number."""
    stated = {}
    for state in parse_xml(srdf).iter("group_state"):
        for joint in state.iter("joint") if state.get("name") == name else ():
            try:
                stated[joint.get("name", "")] = float(joint.get("value", ""))
            except ValueError as error:
                raise HandError(f"{srdf}: the state '{name}' has value=\"{joint.get('value')}\" for joint "
                                f"'{joint.get('name')}'; expected one number") from error
    return stated


def read_key(spec: mujoco.MjSpec, name: str) -> dict[str, float]:
    """Joint values of the keyframe of this name in an MJCF [rad or m]; empty if it has none, or states controls alone."""
    if not any(key.name == name and (len(key.qpos) or not len(key.ctrl)) for key in spec.keys):
        return {}
    model = compiled(spec.copy(), [])
    values = model.key_qpos[model.key(name).id]
    single = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    joints = [j for j in range(model.njnt) if int(model.jnt_type[j]) in single]
    return {model.joint(j).name: float(values[model.jnt_qposadr[j]]) for j in joints}


def self_penetration(description: Description, q: Float[Tensor, " n_dof"]) -> dict[tuple[str, str], float]:
    """Depth [m] by the names of each two links that penetrate each other at these joints; neighbours in the tree may."""
    model, tree = description.model, description.tree
    data = mujoco.MjData(model)
    angles = (tree.coupling @ q.double().to(tree.coupling) + tree.offset).tolist()
    for name, angle in zip(tree.moving_names, angles, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    collide(model, data)
    depths: dict[tuple[str, str], float] = {}
    for contact in data.contact:
        first, second = sorted(int(model.geom_bodyid[g]) for g in contact.geom)
        if contact.dist < 0 and first not in (second, int(model.body_parentid[second])):
            pair = model.body(first).name, model.body(second).name
            depths[pair] = max(depths.get(pair, 0.0), -float(contact.dist))
    return depths


MARK = "#"
"""What stands between a file and the link at which a hand begins in it."""


def named(file: object, link: str | None) -> str:
    """A file, or the part of it that begins at a link, as users write it."""
    return str(file) if link is None else f"{file}{MARK}{link}"


def split_part(name: str) -> tuple[str, str | None]:
    """What a user wrote of a hand, and the link at which it begins, if that was written behind it."""
    if MARK not in name or given_path(name).exists():
        return name, None
    file, _, link = name.rpartition(MARK)
    return file, link


def part_of_urdf(root: ET.Element, link: str, path: Path) -> None:
    """Keep, in place, a link of a URDF and what hangs on it."""
    ends = _ends(root)
    kept = _below(ends, link)
    _require(link, [element.get("name", "") for element in root.findall("link")], path)
    _require_fingers(link, {below: (above, joint.get("type") in MOVING) for joint, (above, below) in ends.items()}, path)
    for joint, (above, below) in ends.items():
        if above not in kept or below == link:
            root.remove(joint)
    for element in root.findall("link"):
        if element.get("name", "") not in kept:
            root.remove(element)


def arm_in_urdf(root: ET.Element, link: str, path: Path) -> None:
    """Keep, in place, all of a URDF but a hand; of the link at which it begins, a frame. Only joints that move it move."""
    _require(link, [element.get("name", "") for element in root.findall("link")], path)
    ends = _ends(root)
    hand, carriers = _below(ends, link), {link}
    while grown := {above for above, below in ends.values() if below in carriers} - carriers:
        carriers |= grown
    for joint, (above, below) in ends.items():
        if above in hand:
            root.remove(joint)
        elif below not in carriers:
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    for element in root.findall("link"):
        if element.get("name") == link:
            element[:] = [child for child in element if child.tag not in {"visual", "collision", "inertial"}]
        elif element.get("name") in hand:
            root.remove(element)


def arm_in_mjcf(spec: mujoco.MjSpec, link: str, path: Path) -> None:
    """The same of an MJCF, in place; its keyframes are lost."""
    _require(link, [body.name for body in list(spec.bodies)[1:]], path)
    hand = spec.body(link)
    for item in [*hand.bodies, *hand.geoms, *spec.keys]:
        spec.delete(item)
    hand.explicitinertial, carriers, above = False, {link}, hand.parent
    while above is not None and above.name != "world":
        carriers.add(above.name)
        above = above.parent
    for joint in list(spec.joints):
        if joint.parent.name not in carriers:
            spec.delete(joint)


def part_of_mjcf(spec: mujoco.MjSpec, link: str, path: Path) -> mujoco.MjSpec:
    """A body of an MJCF and what hangs on it, with the couplings, tendons, actuators and keyframes of its joints."""
    bodies = list(spec.bodies)[1:]
    _require(link, [body.name for body in bodies], path)
    _require_fingers(link, {body.name: (body.parent.name, bool(body.joints)) for body in bodies
                             if body.parent.name != "world"}, path)
    part = mujoco.MjSpec()
    part.compiler.degree = spec.compiler.degree
    with mujoco_speaks_to([], path):  # of its options, all of which the protocol sets
        part.worldbody.add_frame().attach_body(spec.body(link), "", "")
    shown = {geom.meshname for geom in part.geoms}
    for mesh in list(part.meshes):
        if mesh.name not in shown:
            part.delete(mesh)
    return part


def _ends(root: ET.Element) -> dict[ET.Element, tuple[str, str]]:
    """Parent and child link of every joint of a URDF."""
    link_of = lambda end: "" if end is None else end.get("link", "")  # noqa: E731
    return {joint: (link_of(joint.find("parent")), link_of(joint.find("child"))) for joint in root.findall("joint")}


def _below(ends: Mapping[ET.Element, tuple[str, str]], link: str) -> set[str]:
    """A link and all links that hang on it."""
    found = {link}
    while grown := {below for above, below in ends.values() if above in found} - found:
        found |= grown
    return found


def _require_fingers(link: str, tree: Mapping[str, tuple[str, bool]], path: Path) -> None:
    """Refuse a link on which nothing moves, by a HandError that names the one above it on which something does.

    Args:
        link: The link at which the hand should begin.
        tree: For each link but the root, its parent and whether it moves against it.
        path: The file.
    """
    def carries(top: str) -> bool:
        found = {top}
        while grown := {below for below, (above, _) in tree.items() if above in found} - found:
            found |= grown
        return any(tree[below][1] for below in found - {top})

    if carries(link):
        return
    above = link
    for _ in tree:  # as often as there are links; a cycle is reported when the tree is built
        if above in tree and not tree[above][1] and not carries(above):
            above = tree[above][0]
    hint = f"; the fingers hang on '{above}', which carries it: give {named(path.name, above)}" if carries(above) else \
        ", so no hand begins there; give the link that the fingers hang on"
    raise HandError(f"{path}: nothing that hangs on link '{link}' moves{hint}")


def _require(link: str, links: Sequence[str], path: Path) -> None:
    if link and link in links:
        return
    near = difflib.get_close_matches(link, links, n=3)
    hint = f"perhaps {' or '.join(near)}" if near else f"it has {', '.join(links[:12])}{', ...' if len(links) > 12 else ''}"
    raise HandError(f"{path} has no link '{link}', at which a hand could begin; {hint}")
