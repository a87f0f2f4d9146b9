"""Where a hand may be and where it may touch: its surroundings, a place to hold, and the energy of leaving them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.devices import on_device
from dro_grasp.geometry.distance_field import Balls, DistanceField
from dro_grasp.grasps.controller_config import ControllerConfig
from dro_grasp.hands.hand import Hand
from dro_grasp.optimize import terms as energies
from dro_grasp.optimize.contacts import LinkPoints
from dro_grasp.optimize.terms import PointTerm


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Signed distances to whatever is nearest, negative inside."""

    plane: Float[Tensor, "4"] | None = None  # upward unit normal of a plane, and its height along the normal [m]
    obstacles: DistanceField | None = None  # signed distances of other things
    spared: Balls | None = None  # places where the hand is not wanted

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """Normal of the plane."""
        return None if self.plane is None else self.plane[:3]

    @property
    def parts(self) -> dict[str, Surroundings]:
        """The same one by one: plane, obstacles, spared."""
        return {name: Surroundings(**{name: part}) for name in ("plane", "obstacles", "spared")
                if (part := getattr(self, name)) is not None}

    def distances(self, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient, as of a `DistanceField`."""
        distance, gradient = torch.full_like(points[..., 0], torch.inf), torch.zeros_like(points)
        if self.plane is not None:
            distance, gradient = points @ self.plane[:3] - self.plane[3], self.plane[:3].expand_as(points)
        for part in (self.obstacles, self.spared):
            if part is not None:
                other, slope = part.distances(points)
                nearer = other < distance
                distance = torch.where(nearer, other, distance)
                gradient = torch.where(nearer[..., None], slope, gradient)
        return distance, gradient

    def lift(self, points: Float[Tensor, "*b p 3"], clear: float) -> Float[Tensor, "*b 3"]:
        """The shift up the plane's normal that brings points this far above it [m]; none where they are already."""
        if self.plane is None:
            return torch.zeros_like(points[..., 0, :])
        lowest = (points @ self.plane[:3]).amin(-1) - self.plane[3]
        return (clear - lowest).clamp_min(0)[..., None] * self.plane[:3]

    def to(self, device: torch.device | str) -> Surroundings:
        """The same on another device."""
        plane = None if self.plane is None else self.plane.to(device)
        obstacles = None if self.obstacles is None else on_device(self.obstacles, device)
        return Surroundings(plane, obstacles, None if self.spared is None else on_device(self.spared, device))


@dataclass(frozen=True)
class Touching:
    """A place on an object, as balls, in which all contacts are to be."""

    place: Balls
    clear: float  # distance that the hand keeps from the object elsewhere [m]

    def beside(self, points: Float[Tensor, "*b p 3"]) -> Bool[Tensor, "*b p"]:
        """Which points are outside the place."""
        return self.place.distances(points)[0] > 0

    def pull(self, contacts: Float[Tensor, "*b c 3"]) -> PointTerm:
        """Distance of each contact to the place [m]; zero inside."""
        distance, gradient = self.place.distances(contacts)
        outside = (distance > 0).to(distance.dtype)
        return PointTerm(distance * outside, gradient * outside[..., None])

    def push(
        self, points: Float[Tensor, "*b p 3"], distance: Float[Tensor, "*b p"], gradient: Float[Tensor, "*b p 3"]
    ) -> PointTerm:
        """How much nearer than `clear` each hand point outside the place is to the object [m], by its signed distance [m]."""
        near = (self.beside(points) & (distance < self.clear)).to(distance.dtype)
        return PointTerm((self.clear - distance) * near, -gradient * near[..., None])


class ClearanceTerm(NamedTuple):
    """The weighted term with its gradient."""

    value: Float[Tensor, "n 1"]
    by_pose: Float[Tensor, "n 6"]
    by_joint: Float[Tensor, "n n_dof"]


class Clearance:
    """Keeps surface points, and the spheres that fill the links, out of the surroundings."""

    def __init__(
        self, hand: Hand, surroundings: Surroundings, body: LinkPoints, ball: LinkPoints, radii: Float[Tensor, " s"],
        clear: float, weight: float,
    ) -> None:
        """All on the device of the evaluations.

        Args:
            body: Surface points.
            ball: Centres of the spheres, whose radii follow [m].
            clear: Distance to keep [m].
            weight: Of the summed penetration [1/m].
        """
        self.hand, self.surroundings, self.weight, self.clear = hand, surroundings, weight, clear
        # Of a plane, the spheres know nothing that surface points do not know; other things may be thin or small.
        filled = surroundings.obstacles is not None or surroundings.spared is not None
        self.parts = ((body, torch.zeros_like(body.layout[0])), (ball, radii))[: 1 + filled]
        config, moving = ControllerConfig(), hand.movable & ~hand.abduction
        self.postures = [
            (end, torch.where(moving, share, 0.0).to(end))
            for end, share in ((hand.open_ends, config.outer), (hand.closed_ends, config.inner))]
        """Pregrasp and squeeze: where each joint moves to from the grasp, and how much of the way."""

    def __call__(
        self, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], poses: Float[Tensor, "n n_links 4 4"],
        pivot: Float[Tensor, "n 3"],
    ) -> ClearanceTerm:
        """The term of n grasps, from wrist poses, joints, poses of links, and the points about which hands turn [m]."""
        tree, n = self.hand.tree, len(q)
        joints = torch.cat([q + share * (end - q) for end, share in self.postures])
        follow = torch.cat([torch.ones_like(q), *((1 - share).expand_as(q) for _, share in self.postures)])
        poses = torch.cat([poses, T.repeat(len(self.postures), 1, 1)[:, None] @ tree.forward(joints)])
        depth, wrenches = poses.new_zeros(len(poses)), poses.new_zeros(*poses.shape[:2], 6)
        for points, radii in self.parts:
            placed = points.place(poses)
            distance, gradient = self.surroundings.distances(placed)
            inside = energies.penetration(distance - radii - self.clear, gradient)
            depth = depth + inside.value.sum(-1)
            wrenches = wrenches + energies.link_wrenches(placed, self.weight * inside.by_point, points.members)
        by_pose, by_joint = energies.joint_gradient(tree, poses, wrenches, pivot.repeat(len(follow) // n, 1))
        value, by_pose, by_joint = (
            x.unflatten(0, (-1, n)).sum(0) for x in (self.weight * depth[:, None], by_pose, by_joint * follow))
        return ClearanceTerm(value, by_pose, by_joint)

    def distance(
        self, T: Float[Tensor, "*n 4 4"], q: Float[Tensor, "*n n_dof"], surroundings: Surroundings | None = None
    ) -> Float[Tensor, "*n"]:
        """Least distance of hands to the surroundings, or to others [m]."""
        poses = (T[..., None, :, :] @ self.hand.tree.forward(q)).flatten(0, -4)
        around = surroundings or self.surroundings
        nearest = [(around.distances(points.place(poses))[0] - radii).amin(-1) for points, radii in self.parts]
        return torch.stack(nearest).amin(0).reshape(q.shape[:-1])
