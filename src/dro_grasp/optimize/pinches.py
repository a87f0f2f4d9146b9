"""Pinches: two fingers on both sides of something thin or flat that lies on a table, found by random search.

The energy's descent starts palms above the object and knows surfaces to a few millimetres. Of a pencil or a card on a table
that leaves nothing: the fingertips have to arrive beside it, at the height of the table. Here opposed points of the object come
first; then hands are sought that put two pads there, stay above the table and out of the object. Ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import Rows, on_device
from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.geometry.se3 import apply, compose, roma, rotate
from dro_grasp.hands.anatomy import PALM
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize import terms as energies
from dro_grasp.optimize.contacts import ContactCandidates, ContactConfig, contact_candidates, tip_links
from dro_grasp.optimize.grasp_energy import TIP_HEIGHT, Evaluation, GraspEnergy
from dro_grasp.optimize.refinement import RefineConfig, descend_near
from dro_grasp.optimize.starts import Direction


@dataclass(frozen=True)
class PinchConfig(Checked):
    """How pinches are sought (ours)."""

    sides: int = 1500
    """Points of the object's surface that are paired."""
    upright: float = 0.6
    """Points whose normals are nearer to vertical than this cosine are drawn less often, as `flat_share` says."""
    flat_share: float = 0.05
    """Weight of such a point, against 1 of the others."""
    opposed: float = 0.85
    """Least cosine between a point's outward normal and the line away from its partner: half the friction of `carry` more."""
    below: float = 0.015
    """Height from which on there is room for a finger below a point [m]."""
    lever: float = 0.01
    """Distance from the centre of mass to the line of a pair at which it is drawn 1 / e as often [m], and which costs 1 /2."""
    pairs: int = 8
    """Pairs that are tried for each pinch that is wanted."""
    inner: float = 0.0
    """Least cosine between the normal of a tip's point and the direction to the grasp centre, for it to be a pad: tips touch
    what is thin with their ends, where other grasps have no contacts."""
    bent: float = 0.6
    """How far at most the other fingers are closed [share of the way from open]."""
    narrow: float = 0.08
    """Width at which a pair is drawn 1 / e as often as one without [m]: fingers are strongest near each other."""
    members: int = 8
    """Hands that are sought for each pair at first; twice as many each time that the better half of the pairs stays."""
    parents: int = 6
    """Of these, those that each round goes on from."""
    halvings: int = 2
    """How often that happens, after as many rounds each time."""
    ends: int = 3
    """Hands of each pair left that descend in the end."""
    rounds: int = 12
    """Rounds; their steps shrink from `first_step` to `last_step`."""
    first_step: float = 0.15
    """Standard deviation of a joint's first step [share of its range]."""
    last_step: float = 0.01
    """The same in the last round."""
    roll: float = 0.5
    """Standard deviation of the turn about the line of the pads in the first round [rad]."""
    repad: float = 0.15
    """Probability that a step moves a pad elsewhere."""
    tilt: float = math.radians(60.0)
    """Largest angle between the palm direction and the wanted one, where no other is asked for [rad]."""
    clear: float = 0.004
    """Height over the table that the hand keeps, tips that may touch it apart [m]."""
    gap: float = 0.001
    """How much farther apart than the object is wide the pads are [m]."""
    misfit: float = 0.003
    """Error of width, depth in the table, in the object, or in other fingers that costs 1 [m]."""
    turned: float = math.radians(10.0)
    """Angle beyond the largest that costs 1 [rad]."""
    table: float = 3.0
    """How much more the table counts."""
    points: int = 400
    """Surface points of the hand that it looks at."""
    facing: float = 20.0
    """Cost of a pad whose normal is at right angles to the line of the pads."""
    opening: float = 0.01
    """How far each pad moves away along the line in pregrasp [m]."""
    damping: float = 0.01
    """Damping of the joints' motion there [m]."""
    raising: float = 0.008
    """How far it moves up [m]: as they open, fingertips turn towards the table."""
    margin: float = 1.5
    """Multiple of the weight for which pads press: by friction, and by torsional friction where it turns the object."""
    friction: float = 0.5
    """Coefficient that this relies on."""
    torsional_friction: float = 0.005
    """The same of torsional friction [m]."""
    least: float = 3.0
    """Least force of a pad [N]."""
    most: float = 20.0
    """Largest force of a pad [N]."""
    stiffness: float = 3.0
    """Stiffness of the servos [Nm/rad]."""
    descent: RefineConfig = field(default_factory=lambda: RefineConfig(
        steps=80, farthest=0.05, largest_turn=math.radians(40.0), largest_bend=1.0))
    """The descent in the end."""


@dataclass(frozen=True)
class Pairs(Rows):
    """Opposed points of an object."""

    middle: Float[Tensor, "n 3"]  # halfway between the two [m]
    axis: Float[Tensor, "n 3"]  # unit vector from the first to the second
    width: Float[Tensor, " n"]  # distance between them [m]
    lever: Float[Tensor, " n"]  # distance from the object's centre of mass to the line through them [m]


def opposed_pairs(
    obj: ObjectModel, table: Float[Tensor, "4"], widest: float, count: int, config: PinchConfig, generator: torch.Generator
) -> Pairs | None:
    """Random pairs of surface points that face away from each other, no farther apart than `widest` [m]; None without any.

    Pairs near the centre of mass are drawn more often. `table` is an upward unit normal and a height [m]; where a finger has no
    room below, pairs lie side by side.
    """
    up = table[:3]
    points, normals = _sides(obj, up, config, generator)
    apart = points[None] - points[:, None]
    width = apart.norm(dim=-1)
    axis = apart / width.clamp_min(1e-9)[..., None]
    outward = -(axis * normals[:, None]).sum(-1), (axis * normals[None]).sum(-1)
    opposed = (outward[0] > config.opposed) & (outward[1] > config.opposed) & (width < widest)
    height = points @ up - table[3]
    opposed &= ((axis @ up).abs() < config.upright) | (torch.minimum(height[:, None], height) > config.below)
    first, second = opposed.nonzero().T
    if not len(first):
        return None
    middle, axis, width = (points[first] + points[second]) / 2, axis[first, second], width[first, second]
    offset = middle - torch.as_tensor(obj.centre_of_mass).to(middle)
    lever = torch.linalg.cross(offset, axis).norm(dim=-1)
    likely = torch.exp(-(lever - lever.min()) / config.lever)
    # Of thin things most pairs are of the wide faces or skew: each band of widths gets an equal part.
    band = (width / widest * 8).long()
    likely = likely / torch.bincount(band, likely, minlength=9)[band].clamp_min(1e-12) * torch.exp(-width / config.narrow)
    chosen = torch.multinomial(likely, count, replacement=True, generator=generator)
    return Pairs(middle[chosen], axis[chosen], width[chosen], lever[chosen])


def _sides(
    obj: ObjectModel, up: Float[Tensor, "3"], config: PinchConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 3"]]:
    """Random surface points and their normals, mostly of faces that stand upright."""
    if obj.vertices is None or obj.faces is None:
        points, normals = (torch.from_numpy(np.asarray(x, np.float32)) for x in (obj.cloud, obj.cloud_normals))
        chosen = torch.multinomial(_standing(normals, up, config), config.sides, replacement=True, generator=generator)
        return points[chosen], normals[chosen]
    corners = torch.from_numpy(np.asarray(obj.vertices, np.float32)[np.asarray(obj.faces)])
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = across.norm(dim=-1)
    normals = across / area.clamp_min(1e-12)[:, None]
    chosen = torch.multinomial(area * _standing(normals, up, config), config.sides, replacement=True, generator=generator)
    share = torch.rand(config.sides, 2, generator=generator)
    share = torch.where(share.sum(1, keepdim=True) > 1, 1 - share, share)
    corner = corners[chosen]
    return corner[:, 0] + (share[..., None] * (corner[:, 1:] - corner[:, :1])).sum(1), normals[chosen]


def _standing(
    normals: Float[Tensor, "k 3"], up: Float[Tensor, "3"], config: PinchConfig
) -> Float[Tensor, " k"]:
    return torch.where((normals @ up).abs() > config.upright, config.flat_share, 1.0)


@dataclass(frozen=True)
class Pinch(Rows):
    """n hands, each with two pads on a pair of points."""

    q: Float[Tensor, "n n_dof"]
    roll: Float[Tensor, " n"]  # turn about the line of the pads [rad]
    pads: Int[Tensor, "n 2"]  # contact candidates of the energy: the first is on the thumb, if there is one


@dataclass(frozen=True)
class Pinched(Rows):
    """n pinches that were found."""

    T: Float[Tensor, "n 4 4"]  # T_object_wrist [m]
    joints: Float[Tensor, "n n_dof"]
    pregrasp: Float[Tensor, "n n_dof"]
    squeeze: Float[Tensor, "n n_dof"]
    cost: Float[Tensor, " n"]


class PinchSearch:
    """Seeks hands that pinch at given pairs, on the energy's table."""

    def __init__(
        self, energy: GraspEnergy, mass: float, direction: Direction | None, max_tilt: float | None,
        config: PinchConfig | None = None,
    ) -> None:
        """The object's mass [kg], the palm direction, and the largest angle from it [rad]."""
        self.config = config or PinchConfig()
        energy = energy.touching(pads_of(energy, self.config.inner))
        self.energy, self.hand, self.mass = energy, energy.hand, mass
        self.tilt = self.config.tilt if max_tilt is None else max_tilt
        self.wanted = None
        if direction is not None:
            self.wanted = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float32), dim=0)
        link = energy.body.members.argmax(-1)
        assert energy.workspace.surroundings is not None
        self.surroundings = energy.workspace.surroundings
        touching = self.surroundings.touch_plane & torch.isin(link, torch.tensor(tip_links(self.hand)))
        self.clear = torch.where(touching, TIP_HEIGHT, self.config.clear)
        self.partners = partners(energy)

    def widest(self, generator: torch.Generator) -> float:
        """How wide things may be that the hand pinches [m]: as of most random hands whose pads face each other roughly."""
        hands = self._first(self.config.sides, generator)
        still = torch.zeros(len(hands.roll), 3)
        pairs = Pairs(still, still + torch.tensor([1.0, 0.0, 0.0]), still[:, 0], still[:, 0])
        width, misaligned = self._placed(hands, pairs)[2].unbind(1)
        return float(width[misaligned < 1].quantile(0.95)) if bool((misaligned < 1).any()) else float(width.max())

    def search(
        self, pairs: Pairs, generator: torch.Generator
    ) -> Pinched:
        """The best hands, one for each pair that stays."""
        config, n, members = self.config, len(pairs.width), self.config.members
        pairs = pairs.rows(torch.arange(n).repeat_interleave(members))
        now = self._first(len(pairs.width), generator)
        cost = self._cost(now, pairs)
        for step in range(config.rounds):
            if step and step * (config.halvings + 1) % config.rounds < config.halvings + 1 and n > 1:
                kept = cost.reshape(n, members).amin(1).topk(n // 2, largest=False).indices
                rows = (members * kept[:, None] + torch.arange(members).repeat(2)).flatten()
                now, cost, pairs, n, members = now.rows(rows), cost[rows], pairs.rows(rows), n // 2, 2 * members
            chosen = _best(cost, n, config.parents)
            chosen = chosen.repeat(1, -(-members // chosen.shape[1]))[:, :members].flatten()
            new = self._stepped(now.rows(chosen), 1 - step / max(1, config.rounds - 1), generator)
            new_cost = self._cost(new, pairs)
            better = new_cost < cost[chosen]
            now, cost = new.where(better, now.rows(chosen)), torch.where(better, new_cost, cost[chosen])
        best = _best(cost, n, config.ends)
        now, pairs = now.rows(best.flatten()), pairs.rows(best.flatten())
        T, q, cost = self._descended(self._placed(now, pairs)[0], now, pairs)
        end = best.shape[1] * torch.arange(n) + cost.reshape(best.shape).argmin(1)
        return self._closing(T[end], q[end], now.pads[end], pairs.rows(end), cost[end])

    def _closing(
        self, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], pads: Int[Tensor, "n 2"], pairs: Pairs,
        cost: Float[Tensor, " n"],
    ) -> Pinched:
        """Pinches that open along their line and up, and press along it as hard as the weight asks."""
        hand, config, candidates = self.hand, self.config, self.energy.candidates
        poses = T[:, None] @ hand.tree.forward(q)
        links = candidates.links[pads]
        points = apply(poses[torch.arange(len(T))[:, None], links], candidates.points[pads])
        jacobian = torch.stack([hand.tree.point_jacobian(*each) for each in zip(poses, points, links, strict=True)])
        jacobian = (jacobian * (hand.movable & ~hand.abduction) * hand.tree.joint_unit).flatten(1, 2)  # scaled joints
        towards = torch.stack([pairs.axis, -pairs.axis], 1).flatten(1)
        assert self.surroundings.plane is not None
        outwards = config.raising * self.surroundings.plane[:3].repeat(2) - config.opening * towards
        weight = config.margin * GRAVITY * self.mass
        force = (weight * (1 / config.friction + pairs.lever / config.torsional_friction) / 2).clamp(config.least, config.most)
        gram = jacobian @ jacobian.mT + config.damping**2 * torch.eye(6)
        apart = (jacobian.mT @ torch.linalg.solve(gram, outwards)[..., None])[..., 0]
        press = force[:, None] / config.stiffness * (jacobian.mT @ towards[..., None])[..., 0]
        lower, upper = torch.minimum(hand.tree.lower, q), torch.maximum(hand.tree.upper, q)
        pregrasp, squeeze = ((q + step * hand.tree.joint_unit).clamp(lower, upper) for step in (apart, press))
        return Pinched(T, q, pregrasp, squeeze, cost)

    def _descended(
        self, T: Float[Tensor, "n 4 4"], hands: Pinch, pairs: Pairs
    ) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"], Float[Tensor, " n"]]:
        """Hands after a descent, and what it could not mend."""
        energy = PinchEnergy(self.energy, hands.pads, pairs, self.config)
        T, q = descend_near(energy, T, hands.q, self.config.descent)
        tilt = pairs.lever / self.config.lever / 2
        if self.wanted is not None:
            cosine = (self.hand.palm_directions(T) @ self.wanted).clamp(-1, 1)
            tilt = tilt + (torch.acos(cosine) - self.tilt).clamp_min(0) / self.config.turned
        return T, q, energy(T, q, hands.pads).total + tilt

    def _first(self, n: int, generator: torch.Generator) -> Pinch:
        """Hands with any pads of two fingers, which are closed by any share with some noise; the others are rather open."""
        hand, span = self.hand, self.hand.upper - self.hand.lower
        pair = self.partners[torch.randint(len(self.partners), (n,), generator=generator)]
        pads = torch.stack([torch.multinomial(pair[:, k], 1, generator=generator)[:, 0] for k in range(2)], 1)
        share, moving = torch.rand(n, 1, generator=generator), self._moving(pads)
        share = torch.where(moving, share, 1 - self.config.bent * torch.rand(n, 1, generator=generator))
        q = share * hand.canonical_joints(1.0) + (1 - share) * hand.canonical_joints(0.0)
        noise = 2 * self.config.first_step * span * torch.randn(q.shape, generator=generator)
        return Pinch(self._within(q + moving * noise), 2 * math.pi * torch.rand(n, generator=generator), pads)

    def _stepped(self, now: Pinch, share: float, generator: torch.Generator) -> Pinch:
        """The same hands after a random step; `share` falls from 1 to 0."""
        config, hand, n = self.config, self.hand, len(now.roll)
        size = config.last_step + share * (config.first_step - config.last_step)
        kept = (torch.rand(now.q.shape, generator=generator) < 0.5) | ~self._moving(now.pads)
        step = size * (hand.upper - hand.lower) * torch.randn(now.q.shape, generator=generator)
        q = self._within(torch.where(kept, now.q, now.q + step))
        roll = now.roll + config.roll * size / config.first_step * torch.randn(n, generator=generator)
        finger = self.energy.candidates.fingers
        own = torch.stack([(finger == finger[now.pads[:, k], None]) * self.partners.sum((0, 1)) for k in range(2)], 1)
        fresh = torch.stack([torch.multinomial(own[:, k].clamp_min(1e-12), 1, generator=generator)[:, 0] for k in range(2)], 1)
        pads = torch.where(torch.rand(n, 2, generator=generator) < config.repad, fresh, now.pads)
        return Pinch(q, roll, pads)

    def _moving(self, pads: Int[Tensor, "n 2"]) -> Bool[Tensor, "n n_dof"]:
        """The joints that move the pads."""
        return self.hand.tree.moves[self.energy.candidates.links[pads]].any(1)

    def _within(self, q: Float[Tensor, "n n_dof"]) -> Float[Tensor, "n n_dof"]:
        return torch.where(self.hand.movable, q.clamp(self.hand.lower, self.hand.upper), self.hand.rest)

    def _placed(
        self, hands: Pinch, pairs: Pairs
    ) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_links 4 4"], Float[Tensor, "n 2"]]:
        """Wrist poses that put the pads on both sides, poses of links, and width [m] and misalignment of the pads."""
        energy, tree = self.energy, self.hand.tree
        poses, rows = tree.forward(hands.q), torch.arange(len(hands.roll))[:, None]
        at = poses[rows, energy.candidates.links[hands.pads]]
        points = (at[..., :3, :3] @ energy.candidates.points[hands.pads][..., None])[..., 0] + at[..., :3, 3]
        normals = rotate(at[..., :3, :3], energy.candidates.normals[hands.pads])
        apart = points[:, 1] - points[:, 0]
        width = apart.norm(dim=-1)
        axis = apart / width.clamp_min(1e-6)[:, None]
        misaligned = 2 - (normals[:, 0] * axis).sum(-1) + (normals[:, 1] * axis).sum(-1)
        turn = roma.rotvec_to_rotmat(hands.roll[:, None] * pairs.axis) @ _taking(axis, pairs.axis)
        T = compose(turn, pairs.middle - rotate(turn, points.mean(1)))
        return T, T[:, None] @ poses, torch.stack([width, misaligned], 1)

    def _cost(self, hands: Pinch, pairs: Pairs) -> Float[Tensor, " n"]:
        """What speaks against each hand."""
        config, energy, hand = self.config, self.energy, self.hand
        T, poses, fit = self._placed(hands, pairs)
        misfit = (fit[:, 0] - pairs.width - config.gap).abs()
        cost = pairs.lever / config.lever / 2 + config.facing * fit[:, 1] + misfit / config.misfit
        body = energy.body.place(poses)
        above = self.surroundings.distances(body)[0] - self.clear
        cost = cost + config.table * (-above.amin(-1)).clamp_min(0) / config.misfit
        cost = cost + (-energy.field.distances(body)[0].amin(-1)).clamp_min(0) / config.misfit
        spheres = energy.ball.place(poses)
        own = energies.self_penetration(spheres, energy.pairs).value.sum(-1)
        cost = cost + own / config.misfit
        if self.wanted is not None:
            cosine = (hand.palm_directions(T) @ self.wanted).clamp(-1, 1)
            cost = cost + (torch.acos(cosine) - self.tilt).clamp_min(0) / config.turned
        return cost


def _best(cost: Float[Tensor, " m"], n: int, count: int) -> Int[Tensor, "n count"]:
    """Rows of the best of the hands of each of n pairs."""
    order = cost.reshape(n, -1).argsort(1)[:, :count]
    return order + len(cost) // n * torch.arange(n)[:, None]


class PinchEnergy:
    """The energy of hands that hold their pads on given pairs, as a descent takes it: other contacts count for nothing."""

    def __init__(self, energy: GraspEnergy, pads: Int[Tensor, "n 2"], pairs: Pairs, config: PinchConfig) -> None:
        weight = 1 / config.misfit
        self.base = energy.weighted(replace(
            energy.config, force_closure=0.0, distance=0.0, alignment=0.0, penetration=weight, self_penetration=weight,
            clearance=config.table * weight, hand_points=config.points, clearance_points=config.points))
        assert self.base.clearance is not None
        # Where a pinch opens and presses is not where other grasps do.
        self.base.clearance.postures = []
        self.hand, self.pads, self.config, self.axis = energy.hand, pads, config, pairs.axis
        half = (pairs.axis * (pairs.width + config.gap)[:, None]) / 2
        self.goal = torch.stack([pairs.middle - half, pairs.middle + half], 1)
        self.pivot = energy.pivot

    def of_nearest(self, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], reach: float) -> Evaluation:
        """With the pads, wherever they are."""
        return self(T, q, self.pads)

    def __call__(self, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], pads: Int[Tensor, "n 2"]) -> Evaluation:
        """The energy and its gradient."""
        base, config, candidates = self.base(T, q, pads), self.config, self.base.candidates
        poses = T[:, None] @ self.hand.tree.forward(q)
        links, rows = candidates.links[pads], torch.arange(len(T))[:, None]
        at = poses[rows, links]
        points, normals = apply(at, candidates.points[pads]), rotate(at[..., :3, :3], candidates.normals[pads])
        offset = points - self.goal
        distance = (offset.square().sum(-1, keepdim=True) + SMOOTH**2).sqrt()
        towards = config.facing * torch.stack([-self.axis, self.axis], 1)
        apart, facing = distance.sum((1, 2)) / config.misfit, 2 * config.facing + (towards * normals).sum((1, 2))
        by_point = offset / distance / config.misfit
        moment = torch.linalg.cross(points, by_point, dim=-1) + torch.linalg.cross(normals, towards, dim=-1)
        members = self.base.one_hot[links].transpose(-1, -2)
        wrenches = members @ torch.cat([by_point, moment], -1)
        by_pose, by_joint = energies.joint_gradient(self.hand.tree, poses, wrenches, self.pivot(T))
        terms = base.terms.index_add(1, torch.tensor([1, 4]), torch.stack([apart, facing], 1))
        return Evaluation(terms, base.clearance, base.by_pose + by_pose,
                          base.by_joint + by_joint * self.hand.movable.to(q.dtype), base.pivot)


SMOOTH = 0.0005  # Distance within which the pull on a pad fades [m] (ours)


def _taking(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """A rotation that takes each unit vector a to its b."""
    # Two half turns: one about the middle of the two vectors brings a to b, and one about b leaves it there.
    middle = a + b
    half = torch.nn.functional.normalize(torch.where(middle.norm(dim=-1, keepdim=True) > 1e-4, middle, _across(b)), dim=-1)

    def half_turn(axis: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
        return 2 * axis[:, :, None] * axis[:, None] - torch.eye(3).to(axis)

    return half_turn(b) @ half_turn(half)


def _across(v: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Some vector at right angles to each."""
    return torch.linalg.cross(v, torch.eye(3).to(v)[v.abs().argmin(-1)])


def pads_of(energy: GraspEnergy, inner: float) -> ContactCandidates:
    """The energy's contact candidates, and all points of fingertips that face the grasp centre when half closed."""
    hand, given = energy.source, contact_candidates(energy.source)
    points, normals = hand.points_and_normals(hand.canonical_joints(1 - ContactConfig().closing))
    towards = torch.nn.functional.normalize(hand.grasp_centre_wrist - points, dim=-1)
    facing = torch.isin(hand.link_index, torch.tensor(tip_links(hand))) & ((normals * towards).sum(-1) > inner)
    known = (hand.link_points[:, None] == given.points).all(-1) & (hand.link_index[:, None] == given.links)
    kept = (facing | known.any(1)).nonzero()[:, 0]
    finger = hand.finger_of_link[hand.link_index]
    weight = torch.where(facing[kept], 1.0, (known[kept] * given.slot_weights.sum(0)).sum(1))
    found = ContactCandidates(
        hand.link_points[kept], hand.link_normals[kept], hand.link_index[kept], finger[kept], weight[None], (PALM,), hand.thumb)
    return on_device(found, energy.device)


def partners(energy: GraspEnergy) -> Float[Tensor, "k 2 n_candidates"]:
    """Pairs of fingers that can pinch, as weights of their contact candidates: thumb and finger, or any two.

    A single finger pinches against the palm.
    """
    candidates = energy.candidates
    on_tip = torch.isin(candidates.links, torch.tensor(tip_links(energy.source)))
    lone = ~torch.isin(candidates.fingers, candidates.fingers[on_tip])  # of the palm, and of fingers without pads on their tips
    weight = candidates.slot_weights.sum(0) * (on_tip | lone)
    own = {finger: weight * (candidates.fingers == finger) for finger in candidates.fingers.unique().tolist()}
    fingers = [finger for finger in own if finger != PALM]
    if len(fingers) < 2:
        return torch.stack([torch.stack([own[first], own[second]]) for first in fingers for second in own])
    thumb = candidates.thumb if candidates.thumb in fingers else None
    firsts = fingers if thumb is None else [thumb]
    return torch.stack([torch.stack([own[a], own[b]]) for a in firsts for b in fingers if a != b])

