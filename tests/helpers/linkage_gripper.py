"""A gripper whose two fingers are four-bar linkages with a spring, closed by `connect`, as MJCF has them."""

from __future__ import annotations

from pathlib import Path

PIN = "0 .018 -.005"
"""Where a coupler is pinned to its finger, in the finger's frame [m]."""


def linkage_xml() -> str:
    """The description: a driver and a sprung rocker in the palm, a coupler on the driver, a finger with a pad on the rocker."""
    return f"""<mujoco><compiler angle="radian" autolimits="true"/>
<default><joint axis="1 0 0" solreflimit=".005 1" solimplimit=".95 .99 .001" armature="1e-4" damping=".01"/></default>
<worldbody><body name="palm"><geom type="box" size=".03 .04 .025" pos="0 0 .025"/>{_side('right')}{_side('left')}</body>
</worldbody>
<tendon><fixed name="both"><joint joint="right_driver" coef=".5"/><joint joint="left_driver" coef=".5"/></fixed></tendon>
<equality><connect anchor="{PIN}" body1="right_finger" body2="right_coupler" solref=".005 1"/>
<connect anchor="{PIN}" body1="left_finger" body2="left_coupler" solref=".005 1"/>
<joint joint1="right_driver" joint2="left_driver" solref=".005 1"/></equality>
<actuator><position name="grip" tendon="both" kp="100" kv="10"/></actuator></mujoco>"""


def write_linkage(path: Path) -> Path:
    """Write the description and return its path."""
    path.write_text(linkage_xml())
    return path


def _side(name: str) -> str:
    turned = 'quat="0 0 0 1"' if name == "left" else ""
    sign = -1 if name == "left" else 1
    return f"""
<body name="{name}_driver" pos="0 {sign * 0.03} .05" {turned}><joint name="{name}_driver" range="0 .8"/>
  <geom type="capsule" fromto="0 0 0 0 .03 0" size=".005" mass=".01"/>
  <body name="{name}_coupler" pos="0 .03 0"><joint name="{name}_coupler" range="-1.5 0"/>
    <geom type="capsule" fromto="0 0 0 0 .005 .05" size=".005" mass=".01"/></body></body>
<body name="{name}_rocker" pos="0 {sign * 0.012} .06" {turned}>
  <joint name="{name}_rocker" range="-.3 .9" stiffness=".05" springref="2.5"/>
  <geom type="capsule" fromto="0 0 0 0 .035 .045" size=".005" mass=".01"/>
  <body name="{name}_finger" pos="0 .035 .045"><joint name="{name}_finger" range="-.9 .9"/>
    <geom type="capsule" fromto="0 0 0 {PIN}" size=".005" mass=".01"/>
    <body name="{name}_pad" pos="0 0 .03"><geom type="box" size=".01 .004 .025" mass=".01"/></body></body></body>"""
