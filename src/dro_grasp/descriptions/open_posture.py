"""The open posture that a hand's file states, if it does: the state `open` of an SRDF, or the keyframe `open` of an MJCF."""

from __future__ import annotations

from pathlib import Path

import mujoco

from dro_grasp.descriptions.xml_files import parse_xml
from dro_grasp.errors import HandError

OPEN = "open"
"""Name of the state or keyframe (ours; MoveIt's own examples use it)."""


def open_state(srdf: Path) -> dict[str, float]:
    """Joint values of every `<group_state name="open">` of an SRDF file [rad or m]; empty if it has none.

    Raises:
        HandError: The file is not valid XML, or a value is not a number.
    """
    stated = {}
    for state in parse_xml(srdf).iter("group_state"):
        for joint in state.iter("joint") if state.get("name") == OPEN else ():
            try:
                stated[joint.get("name", "")] = float(joint.get("value", ""))
            except ValueError as error:
                raise HandError(f"{srdf}: the state '{OPEN}' has value=\"{joint.get('value')}\" for joint "
                                f"'{joint.get('name')}'; expected one number") from error
    return stated


def open_key(spec: mujoco.MjSpec) -> dict[str, float]:
    """Joint values of the keyframe `open` of an MJCF [rad or m]; empty if it has none."""
    if not any(key.name == OPEN for key in spec.keys):
        return {}
    model = spec.copy().compile()
    values = model.key_qpos[model.key(OPEN).id]
    single = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    joints = [j for j in range(model.njnt) if int(model.jnt_type[j]) in single]
    return {model.joint(j).name: float(values[model.jnt_qposadr[j]]) for j in joints}
