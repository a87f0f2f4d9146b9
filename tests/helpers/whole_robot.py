"""Robots that are more than a hand: a torso with two arms in URDF, an arm in MJCF, each arm with a claw of two fingers."""

from __future__ import annotations

from itertools import pairwise

from tests.helpers.claw_urdf import LIMIT, joint, link

PALM = '<box size="0.08 0.08 0.02"/>'
ARM = '<box size="0.05 0.05 0.05"/>'


def two_arms(torso: str = "") -> str:
    """A torso with a claw on either arm; more may stand in it."""
    return f'<robot name="robot">{link("torso", ARM)}{_arm("left")}{_arm("right")}{torso}</robot>'


def _arm(side: str) -> str:
    names = ("torso", *(f"{side}_{part}" for part in ("shoulder", "elbow", "palm")))
    links = "".join(link(name, PALM if name.endswith("palm") else ARM) for name in names[1:])
    joints = "".join(joint(f"{child}_joint", parent, child, "0 0.02 0.3") for parent, child in pairwise(names))
    follows = f'<mimic joint="{side}_a" multiplier="0.9"/>{LIMIT}'
    return (links + link(f"{side}_one") + link(f"{side}_other") + joints
            + joint(f"{side}_a", f"{side}_palm", f"{side}_one", "-0.035 0 0.04")
            + joint(f"{side}_b", f"{side}_palm", f"{side}_other", "0.035 0 0.04", "0 -1 0", follows))


def arm_with_claw() -> str:
    """An arm in degrees whose claw has a coupling, a tendon, a class, a keyframe, a turned root and a mesh beside it."""
    finger = '<geom type="box" size=".006 .006 .03" pos="0 0 .03"/>'
    return f"""<mujoco><compiler angle="degree" autolimits="true"/>
<default><default class="finger"><joint axis="0 1 0" range="0 80" armature=".001"/></default></default>
<asset><mesh name="arm" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>
<worldbody><body name="base"><geom type="mesh" mesh="arm"/>
<body name="forearm" pos="0 0 .4"><joint name="elbow" axis="1 0 0" range="-90 90"/><geom type="mesh" mesh="arm"/>
<body name="palm" pos="0 .05 .3" euler="0 90 0"><joint name="wrist" axis="0 0 1" range="-90 90"/>
<geom type="box" size=".04 .04 .01"/>
<body name="one" pos="-.035 0 .01"><joint name="a" class="finger"/>{finger}</body>
<body name="other" pos=".035 0 .01" euler="0 0 180"><joint name="b" class="finger"/>{finger}</body>
</body></body></body></worldbody>
<equality><joint joint1="b" joint2="a" polycoef="0 .9 0 0 0"/></equality>
<tendon><fixed name="grip"><joint joint="a" coef="1"/></fixed></tendon>
<actuator><position joint="elbow"/><position tendon="grip"/></actuator>
<keyframe><key name="open" qpos="30 10 5 4.5"/></keyframe></mujoco>"""
