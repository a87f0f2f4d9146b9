"""Idle fingers close: each finger of a grasp that touches nothing moves alone until it meets the object, or rests.

A person holds with all fingers that reach, and bends the others beside them. Neither the network nor the descent of the
energy sees to that: the energy's few contacts choose the fingers that are near anyway. Differs from the paper, which leaves
idle fingers where the network puts them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.energy import terms as energies
from dro_grasp.energy.grasp_energy import GraspEnergy
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand


@dataclass(frozen=True)
class ClosingConfig:
    """When a finger is idle, and how far it closes (ours)."""

    idle: float = 0.003
    """A finger farther than this from the object is idle [m]."""
    contact: float = 0.001
    """Distance at which a closing finger stops [m]: the clearance that refined grasps keep."""
    steps: int = 24
    """Samples of a path from open to closed."""
    halvings: int = 5
    """Halvings of the interval between two samples that holds the contact."""
    openness: float = 0.9
    """Openness from which a finger closes that is bent too far to meet the object [share of its range]."""
    resting: tuple[float, ...] = (1.0, 0.7, 0.4)
    """Shares of the way to the bend of the fingers that hold, at the largest of which an idle finger has room to rest."""
    overlap: float = 0.001
    """Most that the self-penetration of a grasp may grow [m]."""
    batch_size: int = 64
    """Grasps treated at once."""


@torch.no_grad()
def close_idle_fingers(energy: GraspEnergy, grasps: GraspBatch, config: ClosingConfig | None = None) -> GraspBatch:
    """The grasps with their idle fingers on the object, where they reach it without meeting others.

    A finger bends from where it is; if it meets nothing, from its open posture, with all joints and then with the first alone.
    If it still meets nothing, it rests: bent as far as the fingers that hold, on average.
    Whatever belongs to the grasps before (pregrasp, squeeze, scores, energies, outcomes) is dropped.

    Args:
        energy: Of the grasps' hand on their object.
        grasps: Any grasps of the two.
        config: Distances and steps.
    """
    config = config or ClosingConfig()
    if not len(grasps):
        return grasps
    device = energy.centre.device
    parts = zip(grasps.T_object_wrist.split(config.batch_size), grasps.joints.split(config.batch_size), strict=True)
    ends = [_Closer(energy, T.to(device), config).close(q.to(device)) for T, q in parts]
    return grasps.moved_to(grasps.T_object_wrist, torch.cat(ends).cpu())


@dataclass(frozen=True)
class _Closer:
    """Hands that stay where they are while fingers move."""

    energy: GraspEnergy
    T: Float[Tensor, "n 4 4"]
    config: ClosingConfig

    def close(self, q: Float[Tensor, "n n_dof"]) -> Float[Tensor, "n n_dof"]:
        """Joints with idle fingers closed."""
        hand, config = self.energy.hand, self.config
        bends = bending(hand)
        idle = self.distances(q) > config.idle
        opened = torch.where(bends.any(0), hand.canonical_joints(config.openness), q)
        for start, moving in ((q, bends), (opened, bends), (opened, _first(hand, bends))):
            if not bool(idle.any()):
                break
            share, meets = self.first_contact(start, moving)
            for finger in (meets & idle).any(0).nonzero()[:, 0].tolist():
                own = bends[finger]
                new = torch.where(own, self.along(start, moving[finger], share[:, finger, None]), q)
                kept = meets[:, finger] & idle[:, finger] & (self.overlap(new) < self.overlap(q) + config.overlap)
                q = torch.where(kept[:, None], new, q)
                idle[:, finger] &= ~kept
        return self.rest(q, bends, idle)

    def rest(
        self, q: Float[Tensor, "n n_dof"], bends: Bool[Tensor, "n_tips n_dof"], idle: Bool[Tensor, "n n_tips"]
    ) -> Float[Tensor, "n n_dof"]:
        """Joints with the fingers that reach nothing bent as far as those that hold, or less where there is no room."""
        hand, config = self.energy.hand, self.config
        opened = torch.where(bends.any(0), hand.canonical_joints(1.0), q)
        shares = torch.stack([self.bent(q, own) for own in bends], 1)
        holding, resting = ~idle & bends.any(1), idle & bends.any(1)
        if hand.thumb is not None:
            holding[:, hand.thumb] = False  # it bends otherwise than the fingers that it opposes
        wanted = (shares * holding).sum(1) / holding.sum(1).clamp_min(1)
        for finger in resting.any(0).nonzero()[:, 0].tolist():
            waiting = resting[:, finger] & (wanted > shares[:, finger])
            for part in config.resting:
                if not bool(waiting.any()):
                    break
                share = torch.lerp(shares[:, finger], wanted, part)
                new = torch.where(bends[finger], self.along(opened, bends[finger], share[:, None]), q)
                clear = self.distances(new)[:, finger] > config.contact
                kept = waiting & clear & (self.overlap(new) < self.overlap(q) + config.overlap)
                q = torch.where(kept[:, None], new, q)
                waiting &= ~kept
        return q

    def bent(self, q: Float[Tensor, "n n_dof"], own: Bool[Tensor, " n_dof"]) -> Float[Tensor, " n"]:
        """How far a finger is bent: mean share of the way from open to closed of its joints."""
        hand = self.energy.hand
        opened = hand.canonical_joints(1.0)
        return ((q - opened) / (hand.closed_ends - opened))[:, own].sum(1) / own.sum().clamp_min(1)

    def along(
        self, start: Float[Tensor, "n n_dof"], moving: Bool[Tensor, " n_dof"], share: Float[Tensor, "n #n_dof"]
    ) -> Float[Tensor, "n n_dof"]:
        """Moving joints this share of the way from `start` to closed."""
        return torch.where(moving, start + share * (self.energy.hand.closed_ends - start), start)

    def first_contact(
        self, start: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n_tips n_dof"]
    ) -> tuple[Float[Tensor, "n n_tips"], Bool[Tensor, "n n_tips"]]:
        """The share of the way at which each finger meets the object, and whether it does; all close at once."""
        config, every = self.config, moving.any(0)
        shares = torch.linspace(0, 1, config.steps, device=start.device)
        path = [self.along(start, every, share.expand(len(start), 1)) for share in shares]
        near = torch.stack([self.distances(q) <= config.contact for q in path])
        first = near.float().argmax(0)
        meets = near.any(0) & (first > 0)  # a path that begins in the object meets nothing
        low, high = shares[(first - 1).clamp_min(0)], shares[first]
        owner = moving.float().argmax(0).expand(len(start), -1)  # the finger that each joint moves
        for _ in range(config.halvings):
            middle = (low + high) / 2
            inside = self.distances(self.along(start, every, middle.gather(1, owner))) <= config.contact
            high, low = torch.where(inside, middle, high), torch.where(inside, low, middle)
        return low, meets

    def distances(self, q: Float[Tensor, "n n_dof"]) -> Float[Tensor, "n n_tips"]:
        """Distance of each finger's nearest point to the object [m]."""
        return finger_distances(self.energy, self.T, q)

    def overlap(self, q: Float[Tensor, "n n_dof"]) -> Float[Tensor, " n"]:
        """Self-penetration [m]."""
        energy = self.energy
        centres = energy.ball.place(self.T[:, None] @ energy.hand.tree.forward(q))
        return energies.self_penetration(centres, energy.spheres.radii, energy.spheres.pairs).value.sum(-1)


def finger_distances(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]
) -> Float[Tensor, "n n_tips"]:
    """Signed distance of each finger's nearest surface point to the object, for wrist poses and joints on its device [m]."""
    return least_by_finger(energy, energy.field.distances(body_points(energy, T, q))[0])


def body_points(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]
) -> Float[Tensor, "n p 3"]:
    """The hand's surface points, for wrist poses and joints on the energy's device [m]."""
    return energy.body.place(T[:, None] @ energy.hand.tree.forward(q))


def least_by_finger(energy: GraspEnergy, values: Float[Tensor, "n p"]) -> Float[Tensor, "n n_tips"]:
    """The least value of each finger's points, of one for each of `body_points`."""
    hand = energy.hand
    finger = hand.finger_of_link[energy.body.members.argmax(-1)]
    return torch.stack([torch.where(finger == index, values, torch.inf).amin(-1) for index in range(len(hand.fingers))], -1)


def finger_joints(hand: Hand) -> Bool[Tensor, "n_tips n_dof"]:
    """The joints that move each finger, alone or with others."""
    return torch.stack([hand.tree.moves[list(finger.links)].any(0) for finger in hand.fingers])


def bending(hand: Hand) -> Bool[Tensor, "n_tips n_dof"]:
    """The joints that bend each finger and no other."""
    moves = finger_joints(hand)
    return moves & (moves.sum(0) == 1) & hand.movable & ~hand.abduction


def _first(hand: Hand, bends: Bool[Tensor, "n_tips n_dof"]) -> Bool[Tensor, "n_tips n_dof"]:
    """The joint of each finger that is nearest to the palm."""
    moved = torch.where(bends, hand.tree.moves.sum(0), 0)
    first = torch.zeros_like(bends)
    return first.scatter(1, moved.argmax(1, keepdim=True), True) & bends
