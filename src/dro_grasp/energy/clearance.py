"""How far a hand is from its surroundings, and the energy of coming too near, while it opens, grasps and squeezes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.energy import terms as energies
from dro_grasp.energy.link_points import LinkPoints
from dro_grasp.energy.surroundings import Surroundings
from dro_grasp.grasps.controller_config import ControllerConfig
from dro_grasp.hands.hand import Hand


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
            ball: Centres of the spheres.
            radii: Their radii [m].
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
        """The term of n grasps.

        Args:
            T: Wrist poses [m].
            q: Joints [rad or m].
            poses: Poses of their links [m].
            pivot: Points about which the hands turn [m].
        """
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
