"""Read description files as XML. What no hand has is refused: MuJoCo would run out of time, memory or stack on it."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import defusedxml
import defusedxml.ElementTree

from dro_grasp.errors import HandError
from dro_grasp.files import command
from dro_grasp.geometry.mesh_files import FETCH, is_pointer

DEEPEST = 100  # Most elements within each other, and most links one below the other (ours); the deepest hand known to us has 30
MAX_ELEMENTS = 50_000  # Most elements of one file (ours)
MAX_LINKS = 1_000  # Most links, after repetitions (ours); a tactile hand with a frame for every taxel has some 500
MAX_BYTES = 20_000_000  # Largest description [bytes] (ours)
MAX_PIXELS = 10_000  # Most pixels of a generated texture along each side (ours)
MAX_DIVISIONS = 200.0  # Most divisions of a generated mesh in each direction (ours); 10,000 would take a minute and 7 GB
UNUSED = {"composite", "flexcomp", "flex", "hfield", "skin", "plugin"}
"""Elements of MJCF that no rigid hand has, and that can grow without limit (ours)."""
NAMES = {"name", "link", "joint", "filename", "file", "mesh", "material", "class"}
"""Attributes in which words stand, where a hand is read even if a template left its expressions there (ours)."""


def parse_xml(path: Path) -> ET.Element:
    """Parse a description; HandError: it is missing, no XML, declares entities, or is larger or deeper than any hand's."""
    if path.is_dir():
        raise HandError(f"{path} is a folder; give the URDF or MJCF file inside it")
    if not path.is_file():
        raise HandError(f"no hand description at {path}; give an existing .urdf or .xml file, or a name that "
                        "`dro-grasp hands` lists")
    if path.stat().st_size > MAX_BYTES:
        raise HandError(f"{path} has {path.stat().st_size / 1e6:.0f} MB; expected a robot hand of at most "
                        f"{MAX_BYTES / 1e6:.0f}")
    if is_pointer(path):
        raise HandError(f"{path} is a pointer of Git LFS, not the hand; {FETCH}")
    try:
        root = defusedxml.ElementTree.parse(path, forbid_dtd=False).getroot()
    except defusedxml.DefusedXmlException as error:
        raise HandError(f"{path} declares XML entities ({type(error).__name__}), which are refused because they can "
                        "exhaust memory or read other files; remove its <!ENTITY ...> lines") from error
    except (ET.ParseError, UnicodeError) as error:
        if "unbound prefix" in str(error) and b"<xacro:" in path.read_bytes():
            raise HandError(f"{path} is a xacro template without xmlns:xacro; {_expanding(path)}") from error
        raise HandError(f"{path} is not valid XML ({error}); expected a URDF (<robot>) or MJCF (<mujoco>) file") from error
    except (OSError, ValueError, LookupError) as error:
        raise HandError(f"{path} cannot be read ({error}); expected a URDF (<robot>) or MJCF (<mujoco>) file") from error
    assert root is not None  # an empty file is no XML
    _check_elements(root, path)
    if any("xacro" in str(element.tag).rpartition("}")[0] for element in root.iter()):  # files spell its namespace in many ways
        raise HandError(f"{path} is a xacro template; {_expanding(path)}")
    _refuse_expressions(root, path)
    return root


def _expanding(path: Path) -> str:
    return f"expand it first: {command('xacro', path, '-o', path.with_name('expanded.urdf'))}"


def _refuse_expressions(root: ET.Element, path: Path) -> None:
    """Refuse expressions of a template where numbers stand; names may look like them, and so may what nobody reads."""
    for part in root:
        for element in part.iter() if part.tag in {"link", "joint", "group_state"} or root.tag == "mujoco" else ():
            for attribute, value in element.attrib.items():
                if "${" in value and attribute not in NAMES:
                    raise HandError(f"{path}: <{element.tag}> of {part.tag} '{part.get('name', '')}' has "
                                    f"{attribute}=\"{value[:60]}\", an expression of xacro; {_expanding(path)}")


def included_files(root: ET.Element, path: Path) -> tuple[Path, ...]:
    """Every file that an MJCF includes or attaches, directly or not; HandError: one is missing, or contains itself."""
    found: dict[Path, Path] = {}
    waiting: list[tuple[ET.Element, Path, tuple[Path, ...]]] = [(root, path, (path.resolve(),))]
    while waiting:
        element, including, above = waiting.pop()
        for include in [*element.iter("include"), *element.iter("model")]:
            name = include.get("file", "")
            # MuJoCo resolves includes relative to the main file, at any depth.
            file = next((f for f in (path.parent / name, including.parent / name) if os.path.isfile(f)), None)
            if file is None:
                raise HandError(f"{including} includes '{name}', which does not exist in {path.parent}; put it there or "
                                f"remove the <{include.tag}>")
            if include.tag == "model" and file.resolve() in above:
                raise HandError(f"{including} attaches '{name}', which contains {including.name} itself; remove the <model>")
            if file.resolve() not in found:
                found[file.resolve()] = file
                waiting.append((parse_xml(file), file, (*above, file.resolve())))
    return tuple(found.values())


def _check_elements(root: ET.Element, path: Path) -> None:
    waiting, elements, links = [(root, 1, 1.0)], 0, 0.0
    while waiting:
        element, depth, times = waiting.pop()
        elements += 1
        links += times * (element.tag in {"body", "link"})
        if depth > DEEPEST or elements > MAX_ELEMENTS or links > MAX_LINKS:
            raise HandError(f"{path} has more than {DEEPEST} elements within each other, {MAX_LINKS} links, or "
                            f"{MAX_ELEMENTS} elements; expected a robot hand, leave out what is not part of it")
        if element.tag in UNUSED and root.tag == "mujoco":  # in a URDF these belong to simulators, and nobody here reads them
            raise HandError(f"{path} has <{element.tag}>, which is no part of a rigid hand; remove it")
        if element.tag == "texture" and max(_largest(element, "width"), _largest(element, "height")) > MAX_PIXELS:
            raise HandError(f"{path} has a <texture> wider or higher than {MAX_PIXELS} pixels; remove it")
        if element.tag == "mesh" and "builtin" in element.attrib and not _largest(element, "params") <= MAX_DIVISIONS:
            raise HandError(f"{path} has a built-in <mesh> of params=\"{element.get('params', '')[:40]}\"; expected numbers "
                            f"of at most {MAX_DIVISIONS:g}; divide it less, or give a file")
        times *= max(1.0, _largest(element, "count")) if element.tag == "replicate" else 1
        waiting.extend((child, depth + 1, times) for child in element)


def _largest(element: ET.Element, attribute: str) -> float:
    """The largest number in an attribute; 0 where there is none, which is left to MuJoCo."""
    try:
        return max(map(float, element.get(attribute, "").split()), default=0.0)
    except ValueError:
        return 0.0
