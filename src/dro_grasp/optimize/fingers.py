"""Fingers close on an object that they do not touch, and stand clear of a surface that is an estimate.

A person holds with all fingers that reach, and bends the others beside them. Neither the network nor the descent of the
energy sees to that: the energy's few contacts choose the fingers that are near anyway. Differs from the paper, which leaves
idle fingers where the network puts them.

A camera sees one side of an object. The other side is a guess that errs by some millimetres, and by more the farther it is from
what was seen. Fingers that rest on the guess end up inside the object, so each opens until it leaves room. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.optimize import terms as energies
from dro_grasp.optimize.grasp_energy import GraspEnergy


@dataclass(frozen=True)
class ClosingConfig(Checked):
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
    rest_shares: tuple[float, ...] = (1.0, 0.7, 0.4)
    """Shares of the way to the bend of the fingers that hold; an idle finger rests at the first at which it has room."""
    overlap: float = 0.001
    """Largest growth of a grasp's self-penetration [m]."""
    batch_size: int = 64
    """Grasps closed at once."""


@torch.no_grad()
def close_idle_fingers(energy: GraspEnergy, grasps: GraspBatch, config: ClosingConfig | None = None) -> GraspBatch:
    """The grasps with their idle fingers on the object, where they reach it without meeting others.

    A finger bends from where it is; if it meets nothing, from its open posture, with all joints and then with the first alone.
    Of a finger that touches the object, the joints bend that move none of its touching links. What still meets nothing rests:
    bent as far as the fingers that hold, on average.
    Whatever belongs to the grasps before (pregrasp, squeeze, scores, energies, outcomes) is dropped.
    """
    config = config or ClosingConfig()
    if not len(grasps):
        return grasps
    device = energy.centre.device
    parts = zip(grasps.T_object_wrist.split(config.batch_size), grasps.joints.split(config.batch_size), strict=True)
    bends = bending(energy.hand)
    ends = [_Closer(energy, bends, T.to(device), config).close(q.to(device)) for T, q in parts]
    return grasps.with_poses(grasps.T_object_wrist, torch.cat(ends).cpu())


@dataclass(frozen=True)
class _Closer:
    """Hands that stay where they are while fingers move.

    Joints that move are given for each grasp and finger; no joint is of two fingers.
    """

    energy: GraspEnergy
    bends: Bool[Tensor, "n_tips n_dof"]
    T: Float[Tensor, "n 4 4"]
    config: ClosingConfig

    def close(self, q: Float[Tensor, "n n_dof"]) -> Float[Tensor, "n n_dof"]:
        """Joints with idle fingers closed, and the outer links of the others wrapped around the object."""
        hand, config, bends = self.energy.hand, self.config, self.bends
        bend, first = (joints.expand(len(q), -1, -1) for joints in (bends, _first(hand, bends)))
        opened = torch.where(bends.any(0), hand.canonical_joints(config.openness), q)
        idle = least_by_finger(self.energy, self.distances(q)) > config.idle
        for start, moving in ((q, bend), (opened, bend), (opened, first)):
            q, idle = self.contact(q, start, moving, idle)
        active = ~idle
        outer = self.outer(q, bend)
        hanging = active & outer.any(-1) & (self.gaps(q, self.moved(outer)) > config.idle)
        q, hanging = self.contact(q, q, outer, hanging)
        moving = torch.where(idle[..., None], bend, outer)
        return self.rest(q, moving, idle | hanging, active)

    def contact(
        self, q: Float[Tensor, "n n_dof"], start: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_tips n_dof"],
        waiting: Bool[Tensor, "n n_tips"],
    ) -> tuple[Float[Tensor, "n n_dof"], Bool[Tensor, "n n_tips"]]:
        """Joints with those waiting fingers on the object that meet it on their way from `start`, and which still wait."""
        rows = waiting.any(1)
        if not bool(rows.any()):
            return q, waiting
        some, now, still = replace(self, T=self.T[rows]), q[rows], waiting[rows]
        start, moving = start[rows], moving[rows]
        share, meets = some.first_contact(start, moving)
        for finger in (meets & still).any(0).nonzero()[:, 0].tolist():
            new = torch.where(self.bends[finger], self.along(start, moving[:, finger], share[:, finger, None]), now)
            kept = (meets & still)[:, finger] & some.keeps_apart(new, now)
            now = torch.where(kept[:, None], new, now)
            still[:, finger] &= ~kept
        return q.index_put((rows,), now), waiting.index_put((rows,), still)

    def rest(
        self, q: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_tips n_dof"], waiting: Bool[Tensor, "n n_tips"],
        active: Bool[Tensor, "n n_tips"],
    ) -> Float[Tensor, "n n_dof"]:
        """Joints with what reaches nothing bent as far as the fingers that hold, or less where there is no room."""
        hand, config, bends = self.energy.hand, self.config, self.bends
        opened = torch.where(bends.any(0), hand.canonical_joints(1.0), q)
        active = active & bends.any(1)
        if hand.thumb is not None:
            active[:, hand.thumb] = False  # it bends otherwise than the fingers that it opposes
        wanted = (self.bent(q, bends) * active).sum(1) / active.sum(1).clamp_min(1)
        shares, counted = self.bent(q, moving), self.moved(moving)
        waiting = waiting & moving.any(-1) & (wanted[:, None] > shares)
        for finger in waiting.any(0).nonzero()[:, 0].tolist():
            for part in config.rest_shares:
                if not bool(waiting[:, finger].any()):
                    break
                share = torch.lerp(shares[:, finger], wanted, part)
                new = torch.where(moving[:, finger], self.along(opened, moving[:, finger], share[:, None]), q)
                kept = waiting[:, finger] & (self.gaps(new, counted)[:, finger] > config.contact) & self.keeps_apart(new, q)
                q = torch.where(kept[:, None], new, q)
                waiting[:, finger] &= ~kept
        return q

    def outer(self, q: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_tips n_dof"]) -> Bool[Tensor, "n n_tips n_dof"]:
        """Those of the joints that move no link of their finger that touches the object."""
        touches = (self.distances(q) <= self.config.idle).float() @ self.energy.body.members  # points of each link
        return moving & (touches @ self.energy.hand.tree.moves.float() == 0)[:, None]

    def bent(self, q: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "*n n_tips n_dof"]) -> Float[Tensor, "n n_tips"]:
        """How far fingers are bent: mean share of the way from open to closed of the joints that move."""
        opened = self.energy.hand.canonical_joints(1.0)
        share = (q - opened) / (self.energy.hand.closed_ends - opened)
        return torch.where(moving, share[:, None], 0).sum(-1) / moving.sum(-1).clamp_min(1)

    def along(
        self, start: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_dof"], share: Float[Tensor, "n #n_dof"]
    ) -> Float[Tensor, "n n_dof"]:
        """Moving joints this share of the way from `start` to closed."""
        return torch.where(moving, start + share * (self.energy.hand.closed_ends - start), start)

    def first_contact(
        self, start: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_tips n_dof"]
    ) -> tuple[Float[Tensor, "n n_tips"], Bool[Tensor, "n n_tips"]]:
        """The share of the way at which what moves of each finger meets the object, and whether it does; all close at once."""
        config, every = self.config, moving.any(1)
        shares = torch.linspace(0, 1, config.steps, device=start.device)
        path = [self.along(start, every, share.expand(len(start), 1)) for share in shares]
        counted = self.moved(moving)
        near = torch.stack([self.gaps(q, counted) <= config.contact for q in path])
        first = near.float().argmax(0)
        meets = near.any(0) & (first > 0)  # a path that begins in the object meets nothing
        low, high = shares[(first - 1).clamp_min(0)], shares[first]
        owner = moving.float().argmax(1)  # the finger that each joint moves
        for _ in range(config.halvings):
            middle = (low + high) / 2
            inside = self.gaps(self.along(start, every, middle.gather(1, owner)), counted) <= config.contact
            high, low = torch.where(inside, middle, high), torch.where(inside, low, middle)
        return low, meets

    def moved(self, moving: Bool[Tensor, "n n_tips n_dof"]) -> Bool[Tensor, "n n_tips p"]:
        """Those of each finger's surface points that its joints move."""
        hand, member = self.energy.hand, self.energy.body.members.argmax(-1)
        own = hand.finger_of_link[member] == torch.arange(len(hand.fingers), device=member.device)[:, None]
        return own & (moving.float() @ hand.tree.moves.float().mT > 0)[..., member]

    def gaps(self, q: Float[Tensor, "n n_dof"], counted: Bool[Tensor, "n n_tips p"]) -> Float[Tensor, "n n_tips"]:
        """Distance to the object of the nearest of some of each finger's points; inf for none [m]."""
        return torch.where(counted, self.distances(q)[:, None], torch.inf).amin(-1)

    def distances(self, q: Float[Tensor, "n n_dof"]) -> Float[Tensor, "n p"]:
        """Signed distance of the hand's surface points to the object [m]."""
        return self.energy.field.distances(body_points(self.energy, self.T, q))[0]

    def keeps_apart(self, new: Float[Tensor, "n n_dof"], q: Float[Tensor, "n n_dof"]) -> Bool[Tensor, " n"]:
        """Whether self-penetration grows no more than it may from `q` to `new`."""
        return self.overlap(new) < self.overlap(q) + self.config.overlap

    def overlap(self, q: Float[Tensor, "n n_dof"]) -> Float[Tensor, " n"]:
        """Self-penetration [m]."""
        energy = self.energy
        centres = energy.ball.place(self.T[:, None] @ energy.hand.tree.forward(q))
        return energies.self_penetration(centres, energy.spheres.radii, energy.spheres.pairs).value.sum(-1)


def body_points(energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]) -> Float[Tensor, "n p 3"]:
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


@dataclass(frozen=True)
class EasingConfig(Checked):
    """How much room fingers leave (ours)."""

    clearance: float = 0.004  # distance from which on a finger stands clear [m]: 6 mm cost a little where the cloud is whole
    unseen: float = 0.015
    """The same at most, where the surface is a guess: as far as it is from the nearest point that was seen [m]."""
    steps: int = 11  # samples of the way from the grasp to the pregrasp
    batch_size: int = 64


@torch.no_grad()
def ease_fingers(
    energy: GraspEnergy, grasps: GraspBatch, seen: Float[np.ndarray, "m 3"] | None = None, config: EasingConfig | None = None
) -> GraspBatch:
    """The grasps with fingers clear of the object, as far as their pregrasps open; wrist, pregrasp and squeeze stay.

    `seen` are points of the object that were seen, where the rest is a guess [m].
    """
    config, tree = config or EasingConfig(), None if seen is None else KDTree(seen)
    if not len(grasps):
        return grasps
    return grasps.replace(joints=torch.cat([_eased(energy, part, tree, config) for part in grasps.in_parts(config.batch_size)]))


@torch.no_grad()
def missing_clearance(
    energy: GraspEnergy, grasps: GraspBatch, seen: Float[np.ndarray, "m 3"] | None = None, config: EasingConfig | None = None
) -> Float[Tensor, " n"]:
    """How much less room the opened hands leave than fingers should, where it is least, palm included [m]; 0 for none."""
    config, device = config or EasingConfig(), energy.centre.device
    lacking, tree = [torch.zeros(0)], None if seen is None else KDTree(seen)
    for part in grasps.in_parts(config.batch_size):
        _, spare = _clearance(energy, part.T_object_wrist.to(device), part.pregrasp_joints.to(device), tree, config)
        lacking.append((-spare).amax(-1).clamp_min(0).cpu())
    return torch.cat(lacking)


def _eased(energy: GraspEnergy, grasps: GraspBatch, seen: KDTree | None, config: EasingConfig) -> Float[Tensor, "n n_dof"]:
    device, hand = energy.centre.device, energy.hand
    T, q, opened = (x.to(device) for x in (grasps.T_object_wrist, grasps.joints, grasps.pregrasp_joints))
    moved = finger_joints(hand)
    bends = moved.any(0) & hand.movable & ~hand.abduction
    stays = ~(hand.tree.moves & bends).any(-1)[energy.body.members.argmax(-1)]
    shares = torch.linspace(0, 1, config.steps, device=device)
    gaps, spares = [], []
    for share in shares:
        distance, spare = _clearance(energy, T, torch.where(bends, q + share * (opened - q), q), seen, config)
        gaps.append(least_by_finger(energy, distance.masked_fill(stays, torch.inf)))
        spares.append(least_by_finger(energy, spare.masked_fill(stays, torch.inf)))
    gap, spare = torch.stack(gaps), torch.stack(spares)
    # The first share at which a finger is clear; else the one at which it is clearest, of those as far from the surface itself
    # as they have to be at least. Fingers that share a joint open alike.
    spare = torch.where(gap >= gap.amax(0).clamp_max(config.clearance), spare, -torch.inf)
    first = torch.where((spare >= 0).any(0), (spare >= 0).float().argmax(0), spare.argmax(0))
    share = torch.where(moved, shares[first][..., None], 0).amax(1)
    return torch.where(bends, q + share * (opened - q), q).cpu()


def _clearance(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], seen: KDTree | None, config: EasingConfig
) -> tuple[Float[Tensor, "n p"], Float[Tensor, "n p"]]:
    """Distance of each of the hand's surface points to the object, and how much more room it leaves than it should [m]."""
    points = body_points(energy, T, q)
    distance = energy.field.distances(points)[0]
    if seen is None:
        return distance, distance - config.clearance
    # The surface there is as much of a guess as it is farther away than what was seen.
    away = torch.from_numpy(seen.query(points.flatten(0, 1).cpu().numpy())[0]).to(distance).view_as(distance)
    guessed = away - distance.clamp_min(0)
    return distance, distance - guessed.clamp(config.clearance, max(config.clearance, config.unseen))
