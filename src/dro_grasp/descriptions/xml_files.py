"""Read description files as XML, and refuse entities, which can read other files or exhaust memory."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import defusedxml
import defusedxml.ElementTree

from dro_grasp.descriptions.bounds import MOST_BYTES, check_elements
from dro_grasp.errors import HandError
from dro_grasp.files import command

XACRO = "{http://www.ros.org/wiki/xacro}"
"""Namespace of xacro's tags, as ElementTree spells it."""


def parse_xml(path: Path) -> ET.Element:
    """Parse a description; entities are refused.

    Raises:
        HandError: The file is missing, is not XML, declares entities, or is larger or deeper than any hand's.
    """
    if path.is_dir():
        raise HandError(f"{path} is a folder; give the URDF or MJCF file inside it")
    if not path.is_file():
        raise HandError(f"no hand description at {path}; give an existing .urdf or .xml file, or a name that "
                        "`dro-grasp hands` lists")
    if path.stat().st_size > MOST_BYTES:
        raise HandError(f"{path} has {path.stat().st_size / 1e6:.0f} MB; expected a robot hand of at most "
                        f"{MOST_BYTES / 1e6:.0f}")
    try:
        root = defusedxml.ElementTree.parse(path, forbid_dtd=False).getroot()
    except defusedxml.DefusedXmlException as error:
        raise HandError(f"{path} declares XML entities ({type(error).__name__}), which are refused because they can "
                        "exhaust memory or read other files; remove its <!ENTITY ...> lines") from error
    except (ET.ParseError, UnicodeError) as error:
        raise HandError(f"{path} is not valid XML ({error}); expected a URDF (<robot>) or MJCF (<mujoco>) file") from error
    except (OSError, ValueError, LookupError) as error:
        raise HandError(f"{path} cannot be read ({error}); expected a URDF (<robot>) or MJCF (<mujoco>) file") from error
    if root is None:
        raise HandError(f"{path} is an empty XML file; expected a URDF (<robot>) or MJCF (<mujoco>) file")
    check_elements(root, path)
    if any(isinstance(element.tag, str) and element.tag.startswith(XACRO) for element in root.iter()):
        expanded = path.with_name("expanded.urdf")
        raise HandError(f"{path} is a xacro template; expand it first: {command('xacro', path, '-o', expanded)}")
    return root


def included_files(root: ET.Element, path: Path) -> tuple[Path, ...]:
    """Every file that an MJCF includes, or takes as a model to attach, directly or through others.

    Raises:
        HandError: A file is missing, or a model contains itself, on which MuJoCo dies.
    """
    found: dict[Path, None] = {}
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
                found[file.resolve()] = None
                waiting.append((parse_xml(file), file, (*above, file.resolve())))
    return tuple(found)
