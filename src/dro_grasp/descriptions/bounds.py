"""How large a hand's description may be, before MuJoCo reads it, and which numbers it may hold, after.

What is beyond these bounds is a mistake or an attack: MuJoCo and the kinematics would run out of time, memory or stack on it.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from dro_grasp.descriptions.notes import Note
from dro_grasp.errors import HandError

DEEPEST = 100
"""Most elements within each other, and most links one below the other (ours); the deepest hand known to us has 30."""
MOST_ELEMENTS = 50_000
"""Most elements of one file (ours)."""
MOST_LINKS = 1_000
"""Most links, after repetitions (ours); a tactile hand with a frame for every taxel has some 500."""
MOST_JOINTS = 100
"""Most joints that move (ours); a humanoid with two hands has some 80."""
MOST_BYTES = 20_000_000
"""Largest description [bytes] (ours)."""
MOST_PIXELS = 10_000
"""Most pixels of a generated texture along each side (ours)."""
MOST_DIVISIONS = 200.0
"""Most divisions of a generated mesh in each direction (ours); 10,000 would take a minute and 7 GB."""
UNUSED = {"composite", "flexcomp", "flex", "hfield", "skin", "plugin"}
"""Elements of MJCF that no rigid hand has, and that can grow without limit (ours)."""
LONGEST = 10.0
"""Largest coordinate, size or travel of a slide [m] (ours)."""
MOST_TURN = 25.0
"""Largest limit of a joint that turns [rad] (ours): four turns; no finger, wrist or arm makes more than two either way. In
degrees, the limits of a finger are beyond it."""
LEAST_TURN = 0.1
"""Range of a hand's widest turning joint below which its limits look like radians that were read as degrees [rad] (ours)."""
TURNS = 1e4
"""Largest reference angle [rad], and largest ratio or offset of a coupling (ours)."""
STIFFEST = 1e9
"""Largest stiffness of a joint [Nm/rad or N/m] (ours)."""
HEAVIEST = 1e4
"""Largest mass [kg] and inertia [kg m^2] (ours)."""
NUMBERS = (
    ("link", "body_pos", "origin", LONGEST), ("link", "body_quat", "rotation", 2.0),
    ("shape", "geom_pos", "origin", LONGEST), ("shape", "geom_quat", "rotation", 2.0), ("shape", "geom_size", "size", LONGEST),
    ("vertex", "mesh_vert", "vertex", LONGEST), ("joint", "jnt_pos", "anchor", LONGEST),
    ("link", "body_ipos", "centre of mass", LONGEST), ("link", "body_mass", "mass", HEAVIEST),
    ("link", "body_inertia", "inertia", HEAVIEST), ("joint", "jnt_axis", "axis", 2.0),
    ("joint", "jnt_range", "limits", MOST_TURN), ("joint", "qpos0", "reference", TURNS),
    ("joint", "qpos_spring", "spring's reference", TURNS), ("joint", "jnt_stiffness", "stiffness", STIFFEST),
    ("coupling", "eq_data", "coefficients", TURNS),
)
"""Numbers of a compiled model: the kind of their owner, the array, what it means, and the largest value. Lengths come before
masses, which MuJoCo derives from them where a file states none."""


def check_elements(root: ET.Element, path: Path) -> None:
    """Refuse a file of too many elements or links, too deep ones, or elements that can grow without limit.

    Raises:
        HandError: As said.
    """
    waiting, elements, links = [(root, 1, 1)], 0, 0
    while waiting:
        element, depth, times = waiting.pop()
        elements += 1
        links += times * (element.tag in {"body", "link"})
        if depth > DEEPEST or elements > MOST_ELEMENTS or links > MOST_LINKS:
            raise HandError(f"{path} has more than {DEEPEST} elements within each other, {MOST_LINKS} links, or "
                            f"{MOST_ELEMENTS} elements; expected a robot hand, leave out what is not part of it")
        if element.tag in UNUSED and root.tag == "mujoco":  # in a URDF these belong to simulators, and nobody here reads them
            raise HandError(f"{path} has <{element.tag}>, which is no part of a rigid hand; remove it")
        if element.tag == "texture" and max(_whole(element, "width"), _whole(element, "height")) > MOST_PIXELS:
            raise HandError(f"{path} has a <texture> wider or higher than {MOST_PIXELS} pixels; remove it")
        if element.tag == "mesh" and "builtin" in element.attrib and not _largest(element, "params") <= MOST_DIVISIONS:
            raise HandError(f"{path} has a built-in <mesh> of params=\"{element.get('params', '')[:40]}\"; expected numbers "
                            f"of at most {MOST_DIVISIONS:g}; divide it less, or give a file")
        times *= max(1, _whole(element, "count")) if element.tag == "replicate" else 1
        waiting.extend((child, depth + 1, times) for child in element)


def _whole(element: ET.Element, attribute: str) -> int:
    """A whole number in an attribute; 0 where there is none, which is left to MuJoCo."""
    try:
        return int(element.get(attribute, "0"))
    except ValueError:
        return 0


def _largest(element: ET.Element, attribute: str) -> float:
    """The largest number in an attribute; 0 where there is none, which is left to MuJoCo."""
    try:
        return max(map(float, element.get(attribute, "").split()), default=0.0)
    except ValueError:
        return 0.0


def check_numbers(model: mujoco.MjModel, path: Path) -> None:
    """Refuse numbers of a compiled hand that are not finite, or beyond all that a hand has; name their owner.

    Raises:
        HandError: As said.
    """
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE):
        if np.abs(model.jnt_range[j]).max() > LONGEST:
            raise HandError(f"{path}: the limits of joint '{model.joint(j).name}' are {_told(model.jnt_range[j])} m; expected "
                            f"at most {LONGEST:g} m; this looks like millimetres: scale the file by 0.001")
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


def limit_notes(model: mujoco.MjModel) -> list[Note]:
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
        return "; if the file does not state it, its shapes are in another unit than metres: scale the file"
    if what == "limits":
        return "; this looks like degrees: write radians, or leave the limits out where a joint has none"
    return "; this looks like millimetres: scale the file by 0.001" if largest == LONGEST else ""


def _owner(model: mujoco.MjModel, kind: str, index: int) -> str:
    """The element that an entry of an array belongs to, in words."""
    if kind == "shape":
        return f"a shape of link '{model.body(int(model.geom_bodyid[index])).name}'"
    if kind == "coupling":
        of_joint, first = model.eq_type[index] == mujoco.mjtEq.mjEQ_JOINT, int(model.eq_obj1id[index])
        return f"the coupling of joint '{model.joint(first).name}'" if of_joint else f"the tie number {index}"
    if kind == "vertex":
        return f"mesh '{model.mesh(int(np.searchsorted(model.mesh_vertadr, index, 'right')) - 1).name}'"
    return f"{kind} '{(model.body if kind == 'link' else model.joint)(index).name}'"


def _told(values: Float[np.ndarray, " n"]) -> str:
    return " ".join(f"{x:g}" for x in values)
