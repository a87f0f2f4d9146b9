"""A plan as URDF, with masses and inertias of its solids."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence

import numpy as np

from dro_grasp.hands.procedural.plan import HandPlan, Segment, Solid, joint_name, link_name

EFFORT = 2.0
"""Stated torque limit of every joint [Nm] (ours); trials use their protocol's."""
VELOCITY = 6.0
"""Stated speed limit of every joint [rad/s] (ours)."""
DECIMALS = 6
"""Decimals of lengths [m] and angles [rad]."""


def write_urdf(plan: HandPlan, name: str) -> str:
    """The URDF of a plan: the palm is the root link, visual and collision shapes are the same."""
    robot = ET.Element("robot", name=name)
    robot.append(ET.Comment(f" Procedural: {plan.family}, side {plan.side}, thumb {plan.thumb}, palm {plan.palm_shape}. "))
    _add_link(robot, "palm", plan.palm, plan.density)
    for finger in plan.fingers:
        parent, before = "palm", ""
        for number, segment in enumerate(finger.segments):
            link, joint = link_name(finger, number), joint_name(finger, number)
            _add_link(robot, link, segment.solids, plan.density)
            _add_joint(robot, joint, (parent, link), segment, before)
            parent, before = link, joint
    ET.indent(robot)
    return f'<?xml version="1.0"?>\n{ET.tostring(robot, encoding="unicode")}\n'


def _add_link(robot: ET.Element, name: str, solids: Sequence[Solid], density: float) -> None:
    link = ET.SubElement(robot, "link", name=name)
    _add_inertial(link, solids, density)
    for kind in ("visual", "collision"):
        for solid in solids:
            shape = ET.SubElement(link, kind)
            ET.SubElement(shape, "origin", xyz=_text(solid.position), rpy=_text(solid.rpy))
            geometry = ET.SubElement(shape, "geometry")
            if solid.kind == "box":
                ET.SubElement(geometry, "box", size=_text(solid.size))
            elif solid.kind == "cylinder":
                ET.SubElement(geometry, "cylinder", radius=_text(solid.size[:1]), length=_text(solid.size[1:]))
            else:
                ET.SubElement(geometry, "sphere", radius=_text(solid.size))


def _add_inertial(link: ET.Element, solids: Sequence[Solid], density: float) -> None:
    """Mass, centre and inertia of the solids together; where two overlap, the overlap counts twice."""
    masses = np.array([density * solid.volume for solid in solids])
    middles = np.array([solid.position for solid in solids])
    centre = masses @ middles / masses.sum()
    inertia = np.zeros((3, 3))
    for mass, solid, offset in zip(masses, solids, middles - centre, strict=True):
        inertia += mass * (solid.inertia() + offset @ offset * np.eye(3) - np.outer(offset, offset))
    element = ET.SubElement(link, "inertial")
    ET.SubElement(element, "origin", xyz=_text(centre))
    ET.SubElement(element, "mass", value=f"{masses.sum():.6g}")
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    ET.SubElement(element, "inertia", {key: f"{inertia[place]:.6g}" for key, place in names.items()})


def _add_joint(robot: ET.Element, name: str, links: tuple[str, str], segment: Segment, before: str) -> None:
    """The joint between two links (parent, child); a follower follows the joint named by `before`."""
    joint = ET.SubElement(robot, "joint", name=name, type="revolute")
    ET.SubElement(joint, "parent", link=links[0])
    ET.SubElement(joint, "child", link=links[1])
    ET.SubElement(joint, "origin", xyz=_text(segment.position), rpy=_text(segment.rpy))
    ET.SubElement(joint, "axis", xyz=_text(segment.axis))
    limits = {"lower": _text([segment.lower]), "upper": _text([segment.upper])}
    ET.SubElement(joint, "limit", {**limits, "effort": f"{EFFORT:g}", "velocity": f"{VELOCITY:g}"})
    if segment.follows is not None:
        ET.SubElement(joint, "mimic", joint=before, multiplier=_text([segment.follows]))


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{round(float(x), DECIMALS) + 0.0:g}" for x in values)
