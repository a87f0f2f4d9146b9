"""Words of MJCF that this version of MuJoCo does not know. What says nothing about a hand is left out and noted."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator

import mujoco

from dro_grasp.hands.description.compiling import Note

MOST_UNKNOWN = 64  # Words that are left out before a file is refused (ours); files of MuJoCo 1 have some five
UNKNOWN = re.compile(r"unrecognized (attribute: '(?P<attribute>[^']*)'|element)\s*Element '(?P<element>[^']*)'")
"""How MuJoCo refuses a word."""
SAYS_NOTHING = {"option", "flag", "compiler", "size", "statistic", "visual", "global", "quality", "headlight", "map", "scale",
                "rgba", "camera", "light", "material", "texture", "custom", "sensor", "geom", "site", "general", "motor",
                "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion"}
"""Elements of which an unknown attribute may be left out (ours): settings, looks and actuators. Of bodies, joints, meshes and
couplings it may be a misspelled word that says what the hand is."""
SAY_NOTHING_WITHIN = {"option", "visual", "sensor", "custom"}
"""Sections of which an unknown element may be left out (ours)."""


def drop_unknown(message: str, trees: Iterable[ET.Element], notes: list[Note]) -> bool:
    """Leave out, in place, the word that MuJoCo refuses; False if it is something else, or may say what the hand is."""
    found = UNKNOWN.search(message)
    if found is None:
        return False
    attribute, tag = found["attribute"], found["element"]
    dropped = [word for tree in trees
               for word in (_elements(tree, tag) if attribute is None else _attribute(tree, tag, attribute))]
    notes.extend(Note("warning", tag, f"has {word}, which MuJoCo {mujoco.__version__} does not know; it is left out")
                 for word in dict.fromkeys(dropped))
    return bool(dropped)


def _attribute(tree: ET.Element, tag: str, attribute: str) -> Iterator[str]:
    """Remove an attribute from all elements of a name; yields it with its value."""
    for element in tree.iter(tag) if tag in SAYS_NOTHING else ():
        if attribute in element.attrib:
            yield f'{attribute}="{element.attrib.pop(attribute)[:40]}"'


def _elements(tree: ET.Element, tag: str) -> Iterator[str]:
    """Remove all elements of a name that stand in sections that say nothing; yields them."""
    for parent in [element for name in SAY_NOTHING_WITHIN for element in tree.iter(name)]:
        for element in parent.findall(tag):
            parent.remove(element)
            yield f"<{tag}> in <{parent.tag}>"
