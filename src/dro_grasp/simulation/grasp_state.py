"""What holds the object once the hand has closed: motion that is left, contacts, and what the weight then does. Ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import accumulate, pairwise
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.devices import Rows
from dro_grasp.geometry.contact_forces import GRAVITY, LEVER, friction_cone, nonnegative_least_squares
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.outcome import FORCES, LOST_DISTANCE
from dro_grasp.simulation.payload import PayloadConfig, Squeezes, payloads, servo_torques
from dro_grasp.simulation.piercing import pierced
from dro_grasp.simulation.pressure import NO_ANSWER, ContactForces, Pressing, contact_forces, hardest, pressing
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol
from dro_grasp.simulation.rollout import ObjectState, Pulls, Rollout, rollouts, rollouts_of_all
from dro_grasp.simulation.scene import TrialScene, scene_of
from dro_grasp.simulation.trial import held

CONTACTS = 16  # Most contacts of a grasp that are weighed, those that press hardest (ours)
PUSH = 5.0  # Acceleration of the object that the contacts are asked to answer, along each axis and against it [m/s^2] (ours)
FRICTION_SHARE = 0.5  # Share of the friction that the answer may use (ours)
CHANGE = 0.3  # Cost of doubling or dropping the force of a contact, beside an unanswered push of UNIT (ours)
UNIT = 10.0  # Acceleration of the object by which pushes and the forces of contacts are measured [m/s^2] (ours)
EDGES = 6  # Edges of a friction cone (ours)
RIDGE = 1e-4  # Weight of the squared forces in the solver (ours)
SMALLEST = 1e-3  # Weight of the squared forces beside the weight that they hold (ours)
PAIRS = ("unanswered", "gave")  # Fields of two columns
STEPS = 80  # Steps of the solver (ours)
EASINGS = 6  # Times that hands close to find out how hard they may squeeze (ours)
NEARLY = 0.9  # Share of the largest force of a link that they then use (ours)


@dataclass(frozen=True)
class GraspState(Rows):
    """How the object is held in n closed grasps."""

    shift: Float[Tensor, " n"]  # how far closing moved the object [m]
    turn: Float[Tensor, " n"]  # how far it turned the object [rad]
    speed: Float[Tensor, " n"]  # how fast the object still moves [m/s]
    spin: Float[Tensor, " n"]  # how fast it still turns [rad/s]
    pierced: Float[Tensor, " n"]  # how far a finger sticks through the object [m]
    contacts: Float[Tensor, " n"]  # number of contact points of hand and object
    links: Float[Tensor, " n"]  # number of links that touch the object
    pressure: Float[Tensor, " n"]  # sum of the normal forces [N]
    slip: Float[Tensor, " n"]  # largest ratio of tangential to normal force at a contact that bears; NO_ANSWER without one
    unanswered: Float[Tensor, "n 2"]
    """What is missing for contacts near their present forces to answer a push: for the worst direction, and on average."""
    gave: Float[Tensor, "n 2"]
    """How far closing and the weight move the object [m] and turn it [rad], whichever way it pulls; NaN where it was not
    tried."""


@dataclass(frozen=True)
class Pressed:
    """Hands that have closed, and how hard they squeeze for whatever mass."""

    grasps: GraspBatch
    """Where closing leaves hand and object, squeezing for the object's weight; without payloads."""
    squeezes: tuple[Squeezes, ...]
    """Of the same grasps in their order, in parts."""

    def payloads(self, rows: Bool[Tensor, " n"], config: PayloadConfig | None = None) -> Float[Tensor, " n"]:
        """Payloads of the grasps in these rows; NaN in the others, since payloads take time [kg]."""
        parts = []
        for squeezes, wanted in zip(self.squeezes, rows.split([len(s.joints) for s in self.squeezes]), strict=True):
            found, asked = torch.full((len(wanted),), torch.nan), squeezes.rows(wanted.to(squeezes.joints.device))
            still = asked.joints.new_zeros(len(asked.joints))
            found[wanted] = payloads(asked, still, still, config).cpu()
            parts.append(found)
        return torch.cat([torch.zeros(0), *parts])


@dataclass(frozen=True)
class Squeeze(Rows):
    """How hard n hands squeeze."""

    torque: Float[Tensor, "n n_dof"]  # what the servos exert [Nm or N]
    force: Float[Tensor, " n"]  # sum of the normal forces on the object [N]
    hardest: Float[Tensor, " n"]  # that of the link that presses hardest [N]


def press(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    config: WeightConfig | None = None, workers: int | None = None, device: str = "cpu"
) -> GraspBatch:
    """The grasps where closing leaves hand and object, squeezing for the object's weight, with payloads.

    The squeeze is what holds the object still after closing, and in addition torques that press for its weight. A grasp whose
    closing is unsound, or loses the object, stays where it is. Arguments and errors are those of `simulate`.
    """
    config = config or WeightConfig()
    done = pressed_many(hand, [obj], [grasps], protocol, config=config, workers=workers, device=device)
    return done.grasps.replace(payload=done.payloads(torch.ones(len(grasps), dtype=torch.bool), config.payload))


def pressed_many(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    config: WeightConfig | None = None, workers: int | None = None, device: str = "cpu"
) -> Pressed:
    """As `press`, for several objects together on a device, with payloads only of what they are asked for.

    Their grasps come one batch after the other.
    """
    config, parts, squeezes = config or WeightConfig(), [batches[0][:0]], []
    scenes = [scene_of(hand, obj, grasps, protocol) for obj, grasps in zip(objects, batches, strict=True)]
    for part, rollout in rollouts_of_all(scenes, hand, batches, workers, device=device):
        closed = rollout.close()
        sound = torch.from_numpy(closed.stable & (closed.shift(rollout.start) < LOST_DISTANCE))
        joints, poses = held(part, rollout, sound)
        reached = torch.from_numpy(rollout.poses()[0]).to(joints)
        chosen = squeezes_of(hand, contact_forces(rollout), reached, part.squeeze_joints, config, rollout.place)
        targets = chosen.targets(torch.from_numpy(rollout.mass).to(chosen.joints)[:, None])[:, 0].cpu()
        squeezes.append(chosen)
        parts.append(part.replace(
            T_object_wrist=poses, joints=joints, squeeze_joints=torch.where(sound[:, None], targets, part.squeeze_joints)))
    found = GraspBatch.concatenate(parts)
    if math.isfinite(config.max_force):
        counts = [len(grasps) for grasps in batches]
        found = GraspBatch.concatenate([
            _gentle(scene, found[rows], NEARLY * config.max_force, workers, device)
            for scene, rows in zip(scenes, in_turn(counts), strict=True)])
    return Pressed(found, tuple(squeezes))


def in_turn(counts: Sequence[int]) -> list[slice]:
    """The rows of batches of these sizes that come one after the other."""
    ends = list(accumulate(counts, initial=0))
    return [slice(begin, end) for begin, end in pairwise(ends)]


def grasp_state(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    config: WeightConfig | None = None, workers: int | None = None, device: str = "cpu"
) -> tuple[GraspState, Squeeze]:
    """Close hands as a trial does, look at what holds the object then, and pull at it by its weight.

    Arguments and errors are those of `simulate`.
    """
    return grasp_state_many(hand, [obj], [grasps], protocol, config=config, workers=workers, device=device)


def grasp_state_many(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    config: WeightConfig | None = None, workers: int | None = None, device: str = "cpu"
) -> tuple[GraspState, Squeeze]:
    """The same for several objects, together on a device; their grasps come one batch after the other."""
    scenes = [scene_of(hand, obj, grasps, protocol) for obj, grasps in zip(objects, batches, strict=True)]
    none = {f.name: torch.zeros(0, 2) if f.name in PAIRS else torch.zeros(0) for f in fields(GraspState)}
    joints, config = batches[0].joints[:0], config or WeightConfig()
    parts, squeezes = [GraspState(**none)], [Squeeze(joints, joints.new_zeros(0), joints.new_zeros(0))]
    for part, rollout in rollouts_of_all(scenes, hand, batches, workers, device=device):
        closed, state, hardest = _observed(rollout)
        reached = torch.from_numpy(rollout.poses()[0]).to(part.joints)
        torque = servo_torques(hand, reached, part.squeeze_joints, rollout.scene.protocol)
        squeezes.append(Squeeze(torque, state.pressure, hardest))
        parts.append(replace(state, gave=_pulled(rollout, closed, config)))
    return join(parts), join(squeezes)


Held = TypeVar("Held", GraspState, Squeeze)
"""Either kind of rows."""


def join(parts: Sequence[Held]) -> Held:
    """States or squeezes of several batches, one after another."""
    return type(parts[0])(**{f.name: torch.cat([getattr(one, f.name) for one in parts]) for f in fields(parts[0])})


def _gentle(scene: TrialScene, grasps: GraspBatch, most: float, workers: int | None, device: str) -> GraspBatch:
    """The grasps with squeezes as near to the grasp as it takes for no link to press harder than `most` after closing [N]."""
    firm, low, high = grasps.squeeze_joints, torch.zeros(len(grasps)), torch.ones(len(grasps))

    def eased(share: Float[Tensor, " n"]) -> GraspBatch:
        return grasps.replace(squeeze_joints=grasps.joints + share[:, None] * (firm - grasps.joints))

    share = high
    for _ in range(EASINGS):
        fits = []
        for _, rollout in rollouts(scene, scene.hand, eased(share), workers, device=device):
            rollout.close()
            fits += [c.hardest_link <= most for c in contact_forces(rollout)]
        fit = torch.tensor(fits, dtype=torch.bool)
        low, high = torch.where(fit, share, low), torch.where(fit, high, share)
        if bool((low == 1).all()):
            break
        share = (low + high) / 2
    return eased(low)


def _pulled(rollout: Rollout, closed: ObjectState, config: WeightConfig) -> Float[Tensor, "n 2"]:
    """How far closing and pulls together move and turn the object, until it gives way; what closing moves so far is lost."""
    if config.pull == 0:
        return torch.full((rollout.size, 2), torch.nan)
    rules = rollout.scene.protocol
    farthest, largest = min(rules.max_displacement, LOST_DISTANCE), rules.max_rotation
    alive = closed.stable & (closed.shift(rollout.start) < farthest) & (closed.turn(rollout.start) < largest)
    pulls = Pulls(
        config.pull * GRAVITY, config.pulling, reset=True, from_start=True, farthest=farthest, largest_turn=largest)
    moved, turned, _ = rollout.push(closed, alive, pulls)
    gave = np.stack([np.nan_to_num(moved, nan=LOST_DISTANCE).max(1), np.nan_to_num(turned, nan=np.pi).max(1)], 1)
    return torch.from_numpy(gave).float()


def _observed(rollout: Rollout) -> tuple[ObjectState, GraspState, Float[Tensor, " n"]]:
    """The object after closing, what holds it, and the normal force of the link that presses hardest [N]."""
    scene, closed = rollout.scene, rollout.close()
    first = int(scene.model.body_dofadr[scene.object_body])
    velocity = np.nan_to_num(np.array(rollout.batch.bind("qvel"))[:, first:first + 6])
    found = contact_forces(rollout)
    columns = {
        "shift": closed.shift(rollout.start), "turn": closed.turn(rollout.start),
        "speed": np.linalg.norm(velocity[:, :3], axis=1), "spin": np.linalg.norm(velocity[:, 3:], axis=1),
        "pierced": np.concatenate([pierced(own, rollout.qpos[rows]) for own, rows in rollout.parts()]),
        "contacts": [len(c.pressure) for c in found], "links": [c.links for c in found],
        "pressure": [c.pressure.sum() for c in found], "slip": [c.slip for c in found],
    }
    friction = FRICTION_SHARE * scene.protocol.friction
    values = {name: torch.as_tensor(np.array(column), dtype=torch.float32) for name, column in columns.items()}
    missing = unanswered(found, torch.as_tensor(rollout.mass, dtype=torch.float32).to(rollout.place), friction).cpu()
    state = GraspState(**values, unanswered=missing, gave=torch.full_like(missing, torch.nan))
    return closed, state, torch.tensor([c.hardest_link for c in found], dtype=torch.float32)


@dataclass(frozen=True)
class WeightConfig(Checked):
    """How hard fingers press for the object's weight (ours)."""

    margin: float = 1.5
    """Multiple of the weight that is held whichever way gravity pulls; 0 squeezes light and heavy things alike."""
    friction: float = 0.5
    """Coefficient of friction that the forces rely on."""
    contacts: int = 12
    """Most contacts of a grasp that count, those that press hardest."""
    edges: int = 6
    """Edges of a friction cone."""
    iterations: int = 100
    """Steps of the solver."""
    max_force: float = math.inf
    """Largest normal force of the contacts of a link [N]; the hand squeezes less where it is exceeded."""
    missing: float = 0.3
    """Share of the weight that may stay without answer; where more does, pressing harder only ejects the object."""
    stiffness: float = 3.0
    """Stiffness of the servos [Nm/rad]; a squeeze is the torque over it."""
    pull: float = 1.0
    """Multiple of the weight that then pulls along six directions; 0 does not try."""
    pulling: float = 0.2
    """Time of each pull [s]; what is not held falls 20 cm in it."""
    payload: PayloadConfig = field(default_factory=PayloadConfig)
    """How payloads are predicted."""


def squeezes_of(
    hand: Hand, contacts: list[ContactForces], joints: Float[Tensor, "n n_dof"], base: Float[Tensor, "n n_dof"],
    config: WeightConfig, device: torch.device | str = "cpu",
) -> Squeezes:
    """How closed hands squeeze for a mass: towards the base, and by the torques that hold its weight; on a device."""
    hand, joints, base = hand.to(device), joints.to(device), base.to(device)
    touch = pressing(hand, contacts, joints, max(config.contacts, config.payload.contacts))
    force = weight_forces(touch.hardest(config.contacts), joints.new_ones(len(contacts)), config)
    force = torch.nn.functional.pad(force, (0, 0, 0, touch.on.shape[1] - force.shape[1]))
    torques = torch.einsum("nkc,nkcd->nd", force, touch.jacobian)
    normal = (force * touch.normal).sum(-1)
    return Squeezes(hand, joints, base, torques, normal, touch, config.stiffness, config.max_force)


def weight_forces(touch: Pressing, mass: Float[Tensor, " n"], config: WeightConfig) -> Float[Tensor, "n k 3"]:
    """Forces with which contacts press for the weight along each axis and against it [N].

    For each way of gravity, the least forces within the friction cones that balance the weight; their mean balances itself,
    and each contact presses in it for its share of whichever weight there is. Where contacts cannot hold it, nothing is added.
    """
    n, k = touch.on.shape
    if config.margin == 0 or n == 0:
        return torch.zeros_like(touch.normal)
    cone = friction_cone(touch.normal, config.friction, config.edges) * touch.on[..., None, None]
    wrench = torch.cat([cone, torch.linalg.cross(touch.arm[..., None, :].expand_as(cone) / LEVER, cone)], -1).flatten(1, 2).mT
    pulls = torch.as_tensor(FORCES).to(mass)
    goal = torch.cat([-pulls, torch.zeros_like(pulls)], -1).mT.expand(n, 6, len(pulls))
    amounts = nonnegative_least_squares(wrench, goal, SMALLEST, config.iterations)
    able = (wrench @ amounts - goal).norm(dim=1).amax(1) < config.missing
    mean = amounts.mean(-1).unflatten(1, (k, config.edges))
    return (config.margin * GRAVITY * mass * able)[:, None, None] * (mean[..., None] * cone).sum(-2)


def unanswered(contacts: list[ContactForces], mass: Float[Tensor, " n"], friction: float) -> Float[Tensor, "n 2"]:
    """What is missing for the contacts to answer pushes: for the worst of six directions, and on average."""
    # Each contact may change its force within its friction cone; a change relative to its present pressure costs as much as a
    # share of the push that stays unanswered.
    n, most = len(contacts), min(CONTACTS, max((len(c.pressure) for c in contacts), default=0)) or 1
    normal, arm, _, _, pressure, _ = hardest(contacts, most)
    normal, arm, pressure = (torch.from_numpy(table).to(mass) for table in (normal, arm, pressure))
    on = (pressure > 0).float()
    cone = friction_cone(normal, friction, EDGES)
    scale = (pressure / (UNIT * mass[:, None]))[..., None, None]
    wrench = torch.cat([cone, torch.linalg.cross(arm[..., None, :].expand_as(cone) / LEVER, cone)], -1) * scale
    same = CHANGE * torch.eye(most).to(mass).repeat_interleave(EDGES, 1) * on.repeat_interleave(EDGES, 1)[:, None]
    matrix = torch.cat([wrench.flatten(1, 2).mT, same], 1)
    push = torch.as_tensor(FORCES).to(mass) * PUSH / UNIT
    answer = torch.cat([-push, torch.zeros_like(push)], 1).mT.expand(n, 6, 6)
    goal = torch.cat([answer, (CHANGE * on)[..., None].expand(n, most, 6)], 1)
    x = nonnegative_least_squares(matrix, goal, RIDGE, STEPS)
    missing = (matrix @ x - goal).norm(dim=1).clamp_max(NO_ANSWER)
    missing[on.sum(1) == 0] = NO_ANSWER
    return torch.stack([missing.amax(1), missing.mean(1)], 1)
