"""A hand of three two-jointed fingers around a square palm, made of boxes, without any file."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from dro_grasp.hands.anatomy import find_fingers, rigid_groups
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.tree import FIXED, REVOLUTE, KinematicTree

PALM = (0.06, 0.06, 0.02)
LINK = (0.014, 0.014, 0.04)


def box_points(size: tuple[float, float, float], per_axis: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A grid of points and outward normals on a box centred at the origin."""
    half, points, normals = torch.tensor(size) / 2, [], []
    ticks = torch.linspace(-0.9, 0.9, per_axis)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            a, b = torch.meshgrid(ticks, ticks, indexing="ij")
            face = torch.zeros(per_axis**2, 3)
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = sign, a.flatten(), b.flatten()
            normal = torch.zeros(per_axis**2, 3)
            normal[:, axis] = sign
            points.append(face * half)
            normals.append(normal)
    return torch.cat(points), torch.cat(normals)


def toy_tree(dtype: torch.dtype) -> KinematicTree:
    """Palm, and for each finger a proximal and a distal link that bend towards the palm's axis."""
    names, parents, origins, axes = ["palm"], [-1], [torch.eye(4)], [torch.zeros(3)]
    for finger in range(3):
        angle = 2 * math.pi * finger / 3
        base = torch.eye(4)
        base[:3, :3] = torch.tensor([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0],
                                     [0, 0, 1]])
        base[:3, 3] = base[:3, :3] @ torch.tensor([0.04, 0.0, 0.01])
        knuckle = torch.eye(4)
        knuckle[2, 3] = LINK[2]
        for name, parent, origin in (("proximal", 0, base), ("distal", len(names), knuckle)):
            names.append(f"{name}{finger}")
            parents.append(parent)
            origins.append(origin)
            axes.append(torch.tensor([0.0, -1.0, 0.0]))
    n = len(names)
    return KinematicTree(
        link_names=tuple(names), joint_names=tuple(f"joint_{x}" for x in names[1:]),
        moving_names=tuple(f"joint_{x}" for x in names[1:]), parent=tuple(parents),
        link_joint=(-1, *range(n - 1)), kind=(FIXED, *[REVOLUTE] * (n - 1)), origin=torch.stack(origins).to(dtype),
        axis=torch.stack(axes).to(dtype), anchor=torch.zeros(n, 3, dtype=dtype),
        lower=torch.full((n - 1,), -0.5, dtype=dtype), upper=torch.full((n - 1,), 1.4, dtype=dtype),
        coupling=torch.eye(n - 1, dtype=dtype), offset=torch.zeros(n - 1, dtype=dtype),
    )


def toy_hand(dtype: torch.dtype = torch.float32) -> Hand:
    """The hand, in single or double precision."""
    tree = toy_tree(dtype)
    points, normals, index = [], [], []
    for link in range(tree.n_links):
        local, normal = box_points(PALM if link == 0 else LINK, 4)
        points.append(local + torch.tensor([0.0, 0.0, 0.0 if link == 0 else LINK[2] / 2]))
        normals.append(normal)
        index.append(torch.full((len(local),), link))
    dof = tree.n_dof
    return Hand(
        name="toy", tree=tree, link_points=torch.cat(points).to(dtype), link_normals=torch.cat(normals).to(dtype),
        link_index=torch.cat(index), fingers=find_fingers(tree, (2, 4, 6), 0),
        rigid_group=rigid_groups(tree), tip_offsets=torch.tensor([[0.0, 0.0, 0.04]] * 3).to(dtype),
        palm=0, palm_centre=torch.tensor([0.0, 0.0, 0.01]).to(dtype),
        palm_direction=torch.tensor([0.0, 0.0, 1.0]).to(dtype), grasp_centre=torch.tensor([0.0, 0.0, 0.045]).to(dtype),
        opening_signs=torch.full((dof,), -1.0).to(dtype), open_ends=tree.lower, movable=torch.ones(dof, dtype=torch.bool),
        rest=torch.zeros(dof).to(dtype), abduction=torch.zeros(dof, dtype=torch.bool),
        contact_links=tuple(range(tree.n_links)), sha256="toy",
    )


def coupled_hand() -> Hand:
    """The toy hand with two independent joints: one bends every finger at the palm, the other every knuckle."""
    own = toy_hand()
    tree = replace(
        own.tree, joint_names=("bases", "knuckles"), coupling=torch.eye(2).repeat(3, 1), lower=own.tree.lower[:2],
        upper=own.tree.upper[:2])
    per_joint = ("opening_signs", "open_ends", "movable", "rest", "abduction")
    return replace(own, tree=tree, **{name: getattr(own, name)[:2] for name in per_joint})
