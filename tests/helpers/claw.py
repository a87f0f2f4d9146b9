"""Hands for physics tests, written as MJCF: four two-jointed fingers around a palm, and two jaws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.shape import ObjectModel

FINGER = """
<body name="proximal{i}" pos="{x:.6f} {y:.6f} 0.01" euler="0 0 {angle}">
  <joint name="base{i}" axis="0 -1 0" range="-34 80" damping="100" actuatorfrcrange="-0.001 0.001"/>
  <geom type="capsule" size="0.007" fromto="0 0 0 0 0 0.04" mass="0.02"/>
  <body name="distal{i}" pos="0 0 0.04">
    <joint name="knuckle{i}" axis="0 -1 0" range="0 92" frictionloss="1"/>
    <geom type="capsule" size="0.007" fromto="0 0 0.002 0 0 0.04" mass="0.02"/>
  </body>
</body>
"""

JAWS = """<mujoco model="jaws"><compiler autolimits="true"/><worldbody><body name="palm">
  <geom type="box" size="0.08 0.03 0.005" pos="0 0 -0.05" mass="0.2"/>
  <body name="left" pos="-0.02 0 0"><joint name="slide_left" type="slide" axis="1 0 0" range="-0.03 0.02"/>
    <geom type="box" size="0.005 0.03 0.03" pos="-0.005 0 0" mass="0.1"/></body>
  <body name="right" pos="0.02 0 0"><joint name="slide_right" type="slide" axis="-1 0 0" range="-0.03 0.02"/>
    <geom type="box" size="0.005 0.03 0.03" pos="0.005 0 0" mass="0.1"/></body>
</body></worldbody></mujoco>"""
"""Two parallel jaws, 4 cm apart at zero."""


def claw_xml(fingers: int = 4, radius: float = 0.042) -> str:
    """The description: damping, friction and effort limits in it must not matter."""
    bodies = "".join(
        FINGER.format(i=i, angle=360 * i / fingers, x=radius * np.cos(2 * np.pi * i / fingers),
                      y=radius * np.sin(2 * np.pi * i / fingers)) for i in range(fingers)
    )
    return f"""<mujoco model="claw"><compiler angle="degree" autolimits="true"/>
    <worldbody><body name="palm"><geom type="box" size="0.05 0.05 0.01" mass="0.2"/>{bodies}</body></worldbody>
    </mujoco>"""


def claw(folder: Path, fingers: int = 4) -> Hand:
    """The hand, loaded from a file in this folder."""
    file = folder / f"claw{fingers}.xml"
    file.write_text(claw_xml(fingers))
    return load_hand(file)


def ball(radius: float = 0.03, name: str = "ball") -> ObjectModel:
    """A sphere around the origin as one convex part, with the sphere's exact mass properties."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    cloud = (vertices / np.linalg.norm(vertices, axis=1, keepdims=True)).astype(np.float32)
    volume = 4 / 3 * np.pi * radius**3
    return ObjectModel(
        name=name, cloud=cloud * radius, cloud_normals=cloud, centre_of_mass=np.zeros(3), sha256=f"{name}{radius}",
        vertices=vertices, faces=faces, volume=volume, inertia=np.eye(3) * 0.4 * volume * radius**2,
        exact_parts=((vertices, faces),),
    )


def wrist_below(height: float, n: int = 1) -> torch.Tensor:
    """Wrist poses with the palm facing up towards an object this far above the palm's origin [m]."""
    T = torch.eye(4).repeat(n, 1, 1)
    T[:, 2, 3] = -height
    return T


def grasps_of(hand: Hand, obj: ObjectModel, T_object_wrist: torch.Tensor, joints: torch.Tensor) -> GraspBatch:
    """Grasps as a batch."""
    return GraspBatch.create(hand, obj, T_object_wrist, joints)


def power_grasp(hand: Hand, obj: ObjectModel, n: int = 1) -> GraspBatch:
    """Four fingers around a ball of 3 cm, each a little different from grasp to grasp."""
    joints = torch.tensor([[0.0, 0.6] * 4]) + 0.02 * torch.arange(n)[:, None]
    return grasps_of(hand, obj, wrist_below(0.042, n), joints)
