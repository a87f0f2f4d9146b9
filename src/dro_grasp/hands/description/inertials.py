"""Masses and inertias that no link has. A hand's masses decide nothing about its grasps, so what is wrong is left out.

MuJoCo then takes what the link's shapes have at the density of water.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from dro_grasp.hands.description.compiling import Note, compile_hand

HEAVY = 5.0  # Mass from which on a link's density is looked at [kg] (ours); the heaviest forearm of a hand known to us has 4.5
DENSEST = 20.0  # Density, as a multiple of water's, that no link exceeds (ours); gold has 19.3
WIDEST_MASS = 1.0
"""Radius at which a link's mass would have to be for its inertia, beyond which that is in another unit [m] (ours)."""
ORDER = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")  # Attributes of a URDF's inertia, in the order of MuJoCo's `fullinertia`
SHAPED = "is taken from its shapes"  # End of a note


def mend_urdf_inertials(root: ET.Element, notes: list[Note]) -> None:
    """Leave out inertials of a URDF, in place, that are incomplete or impossible."""
    balanced = []
    for link in root.findall("link"):
        stated = link.findall("inertial")
        faults = [_fault_of_urdf(inertial) for inertial in stated]
        for inertial, fault in zip(stated, faults, strict=True):
            if fault or len(stated) > 1:
                link.remove(inertial)
        told = next((fault for fault in faults if fault), "there are several" if len(stated) > 1 else "")
        if told and (told != NO_MASS or link.find("collision") is not None or link.find("visual") is not None):
            notes.append(Note("warning", link.get("name", ""), f"has an <inertial> that is left out, as {told}; its mass "
                              f"{SHAPED}"))
        if not told and stated and _sides_missing(_full(stated[0].find("inertia"))):
            balanced.append(link.get("name", ""))
    if balanced:
        notes.append(Note("info", balanced[0], "has an inertia that no body has, which is balanced" + (
            f"; so have {len(balanced) - 1} more links" if len(balanced) > 1 else "")))


def mend_mjcf_inertials(root: ET.Element, notes: list[Note]) -> bool:
    """Leave out inertials of an MJCF, in place, with which MuJoCo does not read the file at all; whether there are any."""
    found = False
    for body in root.iter("body"):
        for inertial in body.findall("inertial"):
            if fault := _fault_of_mjcf(inertial.attrib):
                found = True
                body.remove(inertial)
                notes.append(Note("warning", body.get("name", "inertial"), f"has an <inertial> that is left out, as {fault}; "
                                  f"its mass {SHAPED}"))
    return found


def lightened(spec: mujoco.MjSpec, model: mujoco.MjModel, path: Path, notes: list[Note]) -> mujoco.MjModel:
    """The compiled model without links that are denser than any metal, or whose inertia is none of their mass."""
    mass, inertia = model.body_mass, model.body_inertia.max(1)
    wide = inertia > mass * WIDEST_MASS**2
    doubted = [b for b in range(1, model.nbody) if wide[b] or mass[b] > HEAVY]
    if not doubted:
        return model
    by_shape = spec.copy()
    for b in doubted:
        _take_from_shapes(by_shape.body(model.body(b).name))
    of_shapes = compile_hand(by_shape, path, [])
    wrong = [b for b in doubted if wide[b] or mass[b] > DENSEST * of_shapes.body_mass[b]]
    for b in wrong:
        name, too_much = model.body(b).name, "more than its shapes would weigh in gold"
        stated = f"an inertia of {inertia[b]:.3g} kg m^2" if wide[b] else too_much
        _take_from_shapes(spec.body(name))
        notes.append(Note("warning", name, f"states a mass of {mass[b]:.3g} kg, {stated}; both are taken from its shapes"))
    return compile_hand(spec, path, []) if wrong else model


def mend_empty_inertials(spec: mujoco.MjSpec, notes: list[Note]) -> None:
    """Leave out inertials of links with shapes, in place, whose mass is zero or whose inertia is none at all."""
    for body in list(spec.bodies)[1:]:
        stated = body.explicitinertial and len(body.geoms) and math.isnan(body.fullinertia[0])
        if stated and body.mass >= 0 and not (body.mass > 0 and (np.asarray(body.inertia) > 0).all()):
            _take_from_shapes(body)
            notes.append(Note("warning", body.name or "inertial", "has an <inertial> that is left out, as its mass or inertia "
                              f"is not above zero; its mass {SHAPED}"))


def _take_from_shapes(body: mujoco.MjsBody) -> None:
    body.explicitinertial, body.mass, body.ipos = False, 0.0, [math.nan] * 3  # so MuJoCo marks that none is stated
    for geom in body.geoms:
        geom.mass = math.nan


NO_MASS = "its mass is not above zero"  # What is wrong with an inertial, in words


def _fault_of_urdf(inertial: ET.Element) -> str:
    """What is wrong with an inertial, in words; empty if nothing is."""
    mass, inertia, origin = (inertial.find(tag) for tag in ("mass", "inertia", "origin"))
    if mass is None or "value" not in mass.attrib:
        return "it states no mass"
    if (weighs := _numbers(mass.attrib, "value", 1)) is None:
        return "its mass is no number"
    if inertia is None:
        return "it states no inertia"
    at = origin is None or all(_numbers(origin.attrib, key, 3) for key in ("xyz", "rpy") if key in origin.attrib)
    full = _full(inertia)
    if full is None or not at:
        return "it is incomplete or has words for numbers"
    if weighs[0] == 0:  # a negative one is noted when the hand is compiled
        return NO_MASS
    return _impossible(full)


def _fault_of_mjcf(stated: Mapping[str, str]) -> str:
    missing = [key for key in ("mass", "pos") if key not in stated]
    if missing:
        return f"it states no {missing[0]}"
    lengths = {"mass": 1, "pos": 3, "diaginertia": 3, "fullinertia": 6}
    read = {key: _numbers(stated, key, length) for key, length in lengths.items() if key in stated}
    if any(values is None for values in read.values()):
        return "it is incomplete or has words for numbers"
    if {"diaginertia", "fullinertia"} <= read.keys():
        return "it states two inertias"
    full = read.get("fullinertia")
    return _impossible(full) if full else ""


def _full(inertia: ET.Element | None) -> list[float] | None:
    """The six numbers of an inertia in a URDF; None if some are missing or are none."""
    found = [] if inertia is None else [_numbers(inertia.attrib, key, 1) for key in ORDER]
    return [value[0] for value in found if value] if found and all(found) else None


def _moments(full: list[float]) -> Float[np.ndarray, "3"]:
    xx, yy, zz, xy, xz, yz = full
    return np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _impossible(full: list[float]) -> str:
    return "its inertia has a negative eigenvalue" if any(full) and _moments(full)[0] <= 0 else ""


def _sides_missing(full: list[float] | None) -> bool:
    """Whether the largest moment is more than the other two together, which no body's is."""
    if full is None:
        return False
    low, middle, high = _moments(full)
    return bool(high > (low + middle) * (1 + 1e-6))


def _numbers(stated: Mapping[str, str], key: str, length: int) -> list[float] | None:
    """This many finite numbers of an attribute; None if it has others."""
    try:
        values = [float(x) for x in stated.get(key, "").split()]
    except ValueError:
        return None
    return values if len(values) == length and all(map(math.isfinite, values)) else None
