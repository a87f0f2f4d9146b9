"""Grasps for the checks of the energy's gradient, in double precision; some are put next to one of its kinks on purpose.

The energy is made of smooth pieces. It bends where a contact crosses the surface, where a hand point reaches the depth at
which penetration counts, where two spheres begin to overlap and where a joint leaves its limits; it jumps by a little
where a point passes from one voxel of the distance field to the next.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dro_grasp.geometry.distance_field import DistanceField
from dro_grasp.geometry.se3 import roma
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.tree import KinematicTree
from dro_grasp.optimize.grasp_energy import GraspEnergy

SPACING = 0.004  # of the field [m]
HALF = (0.034, 0.027, 0.02)  # of the object [m]
ROUND = 0.008  # radius of its edges [m]
NEAR = (1e-9, 1e-6)  # how close to its kink a sample is put [m or rad]
GROUPS = ("anywhere", "surface", "voxel", "depth", "overlap", "limit")
PER_GROUP = (24, 8, 8, 8, 8, 8)


@dataclass(frozen=True)
class Samples:
    """Grasps, and the row range of each group of them."""

    T: Tensor
    q: Tensor
    contacts: Tensor

    def group(self, name: str) -> slice:
        """The rows that were put next to one kind of kink."""
        start = sum(PER_GROUP[: GROUPS.index(name)])
        return slice(start, start + PER_GROUP[GROUPS.index(name)])


def rounded_box() -> DistanceField:
    """A box: unlike a sphere it bends differently along each axis, and its normals miss the centre of mass."""
    axis = torch.arange(-0.08, 0.08 + 1e-9, SPACING, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    beyond = points.abs() - (torch.tensor(HALF, dtype=torch.float64) - ROUND)
    values = beyond.clamp_min(0).norm(dim=-1) + beyond.amax(-1).clamp_max(0) - ROUND
    return DistanceField.from_values(values, torch.full((3,), -0.08), SPACING)


def precise(hand: Hand) -> Hand:
    """The hand in double precision, with rotations and axes that are exact again after their single precision."""
    tree, origin = hand.tree, hand.tree.origin.double()
    origin[:, :3, :3] = roma.special_procrustes(origin[:, :3, :3])
    axis = tree.axis.double()
    axis = axis / axis.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    doubled = {k: v.double() for k, v in tree.fields().items() if isinstance(v, Tensor)} | {"origin": origin, "axis": axis}
    parts = {f.name: getattr(hand, f.name) for f in dataclasses.fields(hand)}
    floats = {k: v.double() for k, v in parts.items() if isinstance(v, Tensor) and v.is_floating_point()}
    return dataclasses.replace(hand, tree=KinematicTree(**(tree.fields() | doubled)), **floats)


def place(energy: GraspEnergy, samples: Samples) -> tuple[Tensor, Tensor]:
    """Contacts (n c 3) and penetrating hand points (n p 3) in the object's frame, by the plain way through the poses."""
    poses = samples.T[:, None] @ energy.hand.tree.forward(samples.q)
    candidates = energy.candidates
    chosen = poses[torch.arange(len(poses))[:, None], candidates.links[samples.contacts]]
    local = candidates.points[samples.contacts]
    return (chosen[..., :3, :3] @ local[..., None])[..., 0] + chosen[..., :3, 3], energy.body.place(poses)


def overlaps(energy: GraspEnergy, q: Tensor) -> Tensor:
    """Overlap of each pair of spheres, negative where they are apart (n k) [m]."""
    centres = energy.ball.place(energy.hand.tree.forward(q))
    first, second = energy.spheres.pairs.unbind(-1)
    radii = energy.spheres.radii
    return radii[first] + radii[second] - (centres[:, first] - centres[:, second]).norm(dim=-1)


def branches(energy: GraspEnergy, samples: Samples) -> Tensor:
    """What every choice in the energy comes to, (n k): the energy is smooth as long as no number of a row changes."""
    field, (contacts, body) = energy.field, place(energy, samples)
    inside = field.distances(body)[0] < energy.config.margin
    spheres = energy.ball.place(samples.T[:, None] @ energy.hand.tree.forward(samples.q))
    pierced = field.distances(spheres)[0] < energy.spheres.radii
    voxels = [((p - field.origin) / field.spacing).round() for p in (contacts, body, spheres)]
    rows = [
        field.normals(contacts).distance > 0, inside, pierced, overlaps(energy, samples.q) > 0,
        samples.q > energy.upper, samples.q < energy.lower,
        # Points outside say nothing, whichever voxel they are in.
        voxels[0].flatten(1), (voxels[1] * inside[..., None]).flatten(1), (voxels[2] * pierced[..., None]).flatten(1),
    ]
    return torch.cat([row.double() for row in rows], -1)


def near_kinks(energy: GraspEnergy, seed: int = 0) -> Samples:
    """Grasps around the object, a group of them anywhere and one group next to each kind of kink."""
    generator = torch.Generator().manual_seed(seed)
    n = sum(PER_GROUP)
    samples = _anywhere(energy, n, generator)
    q = samples.q.clone()
    here = {name: samples.group(name) for name in GROUPS}
    q[here["overlap"]] = _beginning_overlap(energy, PER_GROUP[GROUPS.index("overlap")], generator)
    rows = torch.arange(n)[here["limit"]]
    joint = torch.randint(q.shape[1], (len(rows),), generator=generator)
    limits = torch.where(rows % 2 == 0, energy.upper[joint], energy.lower[joint])
    q[rows, joint] = limits + _near(len(rows), generator)
    samples = dataclasses.replace(samples, q=q)
    samples = _shifted(samples, here["surface"], _to_surface(energy, samples, here["surface"], generator))
    samples = _shifted(samples, here["depth"], _to_depth(energy, samples, here["depth"], generator))
    return _shifted(samples, here["voxel"], _to_voxel(energy, samples, here["voxel"], generator))


def _anywhere(energy: GraspEnergy, n: int, generator: torch.Generator) -> Samples:
    hand, tree = energy.hand, energy.hand.tree
    q = tree.lower + (tree.upper - tree.lower) * torch.rand(n, tree.n_dof, dtype=torch.float64, generator=generator)
    quaternion = torch.randn(n, 4, dtype=torch.float64, generator=generator)
    T = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    T[:, :3, :3] = roma.unitquat_to_rotmat(quaternion / quaternion.norm(dim=-1, keepdim=True))
    shift = 0.015 * torch.randn(n, 3, dtype=torch.float64, generator=generator)  # [m]
    T[:, :3, 3] = shift - T[:, :3, :3] @ hand.grasp_centre_wrist
    return Samples(T, q, energy.candidates.draw(n, generator))


def _near(n: int, generator: torch.Generator) -> Tensor:
    """Small numbers of either sign, spread over the orders of magnitude of NEAR."""
    low, high = torch.tensor(NEAR, dtype=torch.float64).log()
    size = (low + (high - low) * torch.rand(n, dtype=torch.float64, generator=generator)).exp()
    return size * torch.where(torch.rand(n, generator=generator) < 0.5, -1.0, 1.0)


def _shifted(samples: Samples, rows: slice, shift: Tensor) -> Samples:
    T = samples.T.clone()
    T[rows, :3, 3] += shift
    return dataclasses.replace(samples, T=T)


def _slide(query: Callable[[Tensor], Any], points: Tensor, target: Tensor) -> Tensor:
    """The shift that brings each point to where the field has the target value: Newton's steps along the gradient."""
    start = points
    for _ in range(30):
        distance, gradient = query(points)
        # In the object's middle the gradient may vanish.
        points = points + ((target - distance) / gradient.square().sum(-1).clamp_min(0.1))[:, None] * gradient
    return points - start


def _to_surface(energy: GraspEnergy, samples: Samples, rows: slice, generator: torch.Generator) -> Tensor:
    contact = place(energy, samples)[0][rows, 0]
    return _slide(lambda p: energy.field.normals(p)[:2], contact, _near(len(contact), generator))


def _to_depth(energy: GraspEnergy, samples: Samples, rows: slice, generator: torch.Generator) -> Tensor:
    """The deepest point of the hand goes to where penetration begins, so that it alone is about to."""
    body = place(energy, samples)[1][rows]
    deepest = body[torch.arange(len(body)), energy.field.distances(body)[0].argmin(-1)]
    return _slide(energy.field.distances, deepest, energy.config.margin + _near(len(body), generator))


def _to_voxel(energy: GraspEnergy, samples: Samples, rows: slice, generator: torch.Generator) -> Tensor:
    """A contact goes to the border between two voxels, along one axis."""
    contact, field = place(energy, samples)[0][rows, 0], energy.field
    place_in_grid = (contact - field.origin) / field.spacing
    border = (place_in_grid.floor() + 0.5) * field.spacing + field.origin
    axis = torch.randint(3, (len(contact),), generator=generator)
    shift = border - contact + _near(len(contact), generator)[:, None]
    return shift * torch.eye(3, dtype=torch.float64)[axis]


def _beginning_overlap(energy: GraspEnergy, n: int, generator: torch.Generator) -> Tensor:
    """Joints at which the first two spheres touch, on the way from the open hand to one whose links overlap."""
    crossed = _anywhere(energy, 64 * n, generator).q
    crossed = crossed[(overlaps(energy, crossed) > 0).any(-1)][:n]
    opened = energy.hand.canonical_joints(0.9).to(crossed)
    low, high = torch.zeros(n, 1, dtype=torch.float64), torch.ones(n, 1, dtype=torch.float64)
    for _ in range(60):
        middle = (low + high) / 2
        touching = (overlaps(energy, opened + middle * (crossed - opened)) > 0).any(-1, keepdim=True)
        low, high = torch.where(touching, low, middle), torch.where(touching, middle, high)
    return opened + (low + _near(n, generator)[:, None]) * (crossed - opened)
