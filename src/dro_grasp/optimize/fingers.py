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
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.devices import at_once, may_hold, where_any
from dro_grasp.graphs import repeat
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
    batch_size: int | None = None
    """Grasps closed at once; None takes what suits the device."""


ON_CPU = 64  # Grasps closed or opened at once on a CPU (ours, timed)
EACH = 2e6  # Memory of a grasp: the surface points of all samples of its fingers' paths [bytes] (ours, counted)


@torch.no_grad()
def close_idle_fingers(energy: GraspEnergy, grasps: GraspBatch, config: ClosingConfig | None = None) -> GraspBatch:
    """The grasps with their idle fingers on the object, where they reach it without meeting others.

    A finger bends from where it is; if it meets nothing, from its open posture, with all joints and then with the first alone.
    Of a finger that touches the object, the joints bend that move none of its touching links. What still meets nothing rests:
    bent as far as the fingers that hold, on average.
    Whatever belongs to the grasps before (pregrasp, squeeze, scores, energies, outcomes) is dropped.
    """
    if not len(grasps):
        return grasps
    device = energy.device
    ends = closed_fingers(energy, grasps.T_object_wrist.to(device), grasps.joints.to(device), config or ClosingConfig())
    return grasps.with_poses(grasps.T_object_wrist, ends.cpu())


@torch.no_grad()
def closed_fingers(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: ClosingConfig
) -> Float[Tensor, "n n_dof"]:
    """The same for wrist poses and joints on the energy's device, where they stay."""
    size, bends = at_once(energy.device, ON_CPU, EACH, config.batch_size), bending(energy.hand)
    samples = at_once(energy.device, 1, EACH * min(size, len(q)) / config.steps, config.batch_size and config.steps)
    parts = [slice(start, start + size) for start in range(0, len(q), size)]
    return torch.cat([_Closer(energy.rows(part), bends, T[part], config, samples).close(q[part]) for part in parts])


@dataclass(frozen=True)
class _Closer:
    """Hands that stay where they are while fingers move.

    Joints that move are given for each grasp and finger; no joint is of two fingers.
    """

    energy: GraspEnergy
    bends: Bool[Tensor, "n_tips n_dof"]
    T: Float[Tensor, "n 4 4"]
    config: ClosingConfig
    samples: int  # of a path, which are computed at once

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
        rows = where_any(waiting.any(1))
        if isinstance(rows, Tensor) and not len(rows):
            return q, waiting
        some, now, still = replace(self, energy=self.energy.rows(rows), T=self.T[rows]), q[rows], waiting[rows]
        start, moving = start[rows], moving[rows]
        share, meets = some.first_contact(start, moving)
        moves = meets & still

        def step(
            state: tuple[Float[Tensor, "n n_dof"], Float[Tensor, " n"], Bool[Tensor, "n n_tips"]], finger: Int[Tensor, "1"]
        ) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, " n"], Bool[Tensor, "n n_tips"]]:
            now, overlap, still = state
            tried = moves.index_select(1, finger)[:, 0]
            if not may_hold(tried):
                return state
            closed = some.along(start, moving.index_select(1, finger)[:, 0], share.index_select(1, finger))
            new = torch.where(some.bends.index_select(0, finger), closed, now)
            now, overlap, kept = some.moved_apart(now, new, overlap, tried)
            return now, overlap, still & ~(kept[:, None] & some.own(finger))

        now, _, still = repeat(step, (now, some.overlap(now), still), len(self.bends))
        if isinstance(rows, Tensor):
            now, still = q.index_put((rows,), now), waiting.index_put((rows,), still)
        return now, still

    def rest(
        self, q: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_tips n_dof"], waiting: Bool[Tensor, "n n_tips"],
        active: Bool[Tensor, "n n_tips"],
    ) -> Float[Tensor, "n n_dof"]:
        """Joints with what reaches nothing bent as far as the fingers that hold, or less where there is no room."""
        hand, config, bends = self.energy.hand, self.config, self.bends
        opened = torch.where(bends.any(0), hand.canonical_joints(1.0), q)
        active = active & bends.any(1)
        if hand.thumb is not None:
            active = active & ~self.own(hand.thumb)  # it bends otherwise than the fingers that it opposes
        wanted = (self.bent(q, bends) * active).sum(1) / active.sum(1).clamp_min(1)
        shares, counted = self.bent(q, moving), self.moved(moving)
        waiting = waiting & moving.any(-1) & (wanted[:, None] > shares)
        parts, count = q.new_tensor(config.rest_shares), len(config.rest_shares)

        def step(
            state: tuple[Float[Tensor, "n n_dof"], Float[Tensor, " n"], Bool[Tensor, "n n_tips"]], number: Int[Tensor, "1"]
        ) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, " n"], Bool[Tensor, "n n_tips"]]:
            q, overlap, waiting = state
            finger, part = number // count, parts.index_select(0, number % count)
            tried = waiting.index_select(1, finger)[:, 0]
            if not may_hold(tried):
                return state
            moved = moving.index_select(1, finger)[:, 0]
            share = torch.lerp(shares.index_select(1, finger), wanted[:, None], part)
            new = torch.where(moved, self.along(opened, moved, share), q)
            clear = self.gaps(new, counted.index_select(1, finger))[:, 0] > config.contact
            q, overlap, kept = self.moved_apart(q, new, overlap, tried & clear)
            return q, overlap, waiting & ~(kept[:, None] & self.own(finger))

        return repeat(step, (q, self.overlap(q), waiting), count * len(bends))[0]

    def own(self, finger: int | Int[Tensor, "1"]) -> Bool[Tensor, " n_tips"]:
        """Which of the fingers is this one."""
        return torch.arange(len(self.bends), device=self.bends.device) == finger

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
        self, start: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_dof"], share: Float[Tensor, "*s #n #n_dof"]
    ) -> Float[Tensor, "*s n n_dof"]:
        """Moving joints this share of the way from `start` to closed."""
        return torch.where(moving, start + share * (self.energy.hand.closed_ends - start), start)

    def first_contact(
        self, start: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_tips n_dof"]
    ) -> tuple[Float[Tensor, "n n_tips"], Bool[Tensor, "n n_tips"]]:
        """The share of the way at which what moves of each finger meets the object, and whether it does; all close at once."""
        config, every = self.config, moving.any(1)
        shares = torch.linspace(0, 1, config.steps, device=start.device)
        counted = self.moved(moving)
        near = torch.cat([
            self.along_path(start, every, some, counted) <= config.contact for some in shares.split(self.samples)])
        first = near.float().argmax(0)
        meets = near.any(0) & (first > 0)  # a path that begins in the object meets nothing
        low, high = shares[(first - 1).clamp_min(0)], shares[first]
        owner = moving.float().argmax(1)  # the finger that each joint moves

        def step(
            ends: tuple[Float[Tensor, "n n_tips"], Float[Tensor, "n n_tips"]], number: Int[Tensor, "1"]
        ) -> tuple[Float[Tensor, "n n_tips"], Float[Tensor, "n n_tips"]]:
            low, high = ends
            middle = (low + high) / 2
            inside = self.gaps(self.along(start, every, middle.gather(1, owner)), counted) <= config.contact
            return torch.where(inside, low, middle), torch.where(inside, middle, high)

        return repeat(step, (low, high), config.halvings)[0], meets

    def along_path(
        self, start: Float[Tensor, "n n_dof"], moving: Bool[Tensor, "n n_dof"], shares: Float[Tensor, " s"],
        counted: Bool[Tensor, "n n_tips p"],
    ) -> Float[Tensor, "s n n_tips"]:
        """Gaps of fingers at several shares of their way."""
        path = self.along(start, moving, shares[:, None, None]).transpose(0, 1)  # n s n_dof
        distance = self.energy.field.distances(body_points(self.energy, self.T, path))[0]
        return torch.where(counted[:, None], distance[:, :, None], torch.inf).amin(-1).transpose(0, 1)

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

    def moved_apart(
        self, q: Float[Tensor, "n n_dof"], new: Float[Tensor, "n n_dof"], overlap: Float[Tensor, " n"],
        wanted: Bool[Tensor, " n"],
    ) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
        """New joints where they are wanted and self-penetration grows no more than it may, how much it is then, and where."""
        after = self.overlap(new)
        kept = wanted & (after < overlap + self.config.overlap)
        return torch.where(kept[:, None], new, q), torch.where(kept, after, overlap), kept

    def overlap(self, q: Float[Tensor, "n n_dof"]) -> Float[Tensor, " n"]:
        """Self-penetration [m]."""
        energy = self.energy
        centres = energy.ball.place(self.T[:, None] @ energy.hand.tree.forward(q))
        return energies.self_penetration(centres, energy.pairs).value.sum(-1)


def body_points(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n *s n_dof"]
) -> Float[Tensor, "n *s p 3"]:
    """The hand's surface points, for wrist poses and joints, or several for each pose, on the energy's device [m]."""
    poses = T.view(len(T), *[1] * (q.ndim - 1), 4, 4) @ energy.hand.tree.forward(q)
    return energy.body.place(poses.flatten(0, -4)).unflatten(0, q.shape[:-1])


def least_by_finger(energy: GraspEnergy, values: Float[Tensor, "n p"]) -> Float[Tensor, "n n_tips"]:
    """The least value of each finger's points, of one for each of `body_points`."""
    hand = energy.hand
    finger = hand.finger_of_link[energy.body.members.argmax(-1)]
    own = finger == torch.arange(len(hand.fingers), device=finger.device)[:, None]
    return torch.where(own, values[:, None], torch.inf).amin(-1)


def bending(hand: Hand) -> Bool[Tensor, "n_tips n_dof"]:
    """The joints that bend each finger and no other."""
    moves = hand.finger_joints
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
    batch_size: int | None = None
    """Grasps opened at once; None takes what suits the device."""


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
    parts = grasps.in_parts(at_once(energy.device, ON_CPU, EACH, config.batch_size))
    return grasps.replace(joints=torch.cat([_eased(energy, part, tree, config) for part in parts]))


@torch.no_grad()
def missing_clearance(
    energy: GraspEnergy, grasps: GraspBatch, seen: Float[np.ndarray, "m 3"] | None = None, config: EasingConfig | None = None
) -> Float[Tensor, " n"]:
    """How much less room the opened hands leave than fingers should, where it is least, palm included [m]; 0 for none."""
    config, device = config or EasingConfig(), energy.device
    lacking, tree = [torch.zeros(0)], None if seen is None else KDTree(seen)
    for part in grasps.in_parts(at_once(device, ON_CPU, EACH, config.batch_size)):
        _, spare = _clearance(energy, part.T_object_wrist.to(device), part.pregrasp_joints.to(device), tree, config)
        lacking.append((-spare).amax(-1).clamp_min(0).cpu())
    return torch.cat(lacking)


def _eased(energy: GraspEnergy, grasps: GraspBatch, seen: KDTree | None, config: EasingConfig) -> Float[Tensor, "n n_dof"]:
    device, hand = energy.device, energy.hand
    T, q, opened = (x.to(device) for x in (grasps.T_object_wrist, grasps.joints, grasps.pregrasp_joints))
    moved = hand.finger_joints
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
