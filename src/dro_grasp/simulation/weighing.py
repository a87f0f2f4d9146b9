"""Weigh grasps: the largest mass that a closed hand holds in simulation while it squeezes for it.

A trial for each of many masses would take too long. Here the hand closes once, and the object is pulled as each of a few masses
would, for a fifth of the time of a trial. How fast it moves then tells what it would still move. Ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.grasp_state import WeightConfig, squeezes_of
from dro_grasp.simulation.outcome import FORCES
from dro_grasp.simulation.payload import Squeezes
from dro_grasp.simulation.pressure import contact_forces
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol, protocol as find_protocol
from dro_grasp.simulation.rollout import Moment, ObjectState, Rollout, rollouts_of_all
from dro_grasp.simulation.scene import scene_of

LESS = 0.95  # Share of a mass that gave way, which its grasp may still carry (ours)
NOT_HELD = 1e3  # Share of what an object may move that one has used whose simulation is unsound (ours)


@dataclass(frozen=True)
class WeighingConfig(Checked):
    """How grasps are weighed (ours)."""

    rounds: int = 4
    """Masses that are tried."""
    beyond: float = 1.5
    """The first of them, as a multiple of the predicted payload: it shows which directions are the worst."""
    step: float = 1.7
    """Factor between two masses, until one is held and one is not; then their geometric mean is tried."""
    pressing: float = 0.05
    """Time in which the hand takes to the squeeze for a mass [s]."""
    pulling: float = 0.2
    """Time of each pull [s]."""
    going_on: float = 0.2
    """Time for which the object would go on as fast as in the second half of a pull [s]."""


def weigh_many(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    weight: WeightConfig | None = None, config: WeighingConfig | None = None, workers: int | None = None, device: str = "cpu",
) -> list[Float[Tensor, " n"]]:
    """Payloads of grasps that state one, weighed in simulation [kg]; several objects together on a device.

    Each hand closes with its squeeze, which is made for the object's mass. Errors are those of `simulate`.

    Args:
        hand: The hand of the grasps.
        objects: Their objects.
        batches: Grasps of each with payloads, from which the search begins; NaN stays NaN.
        protocol: Physics, and how far the object may move.
        weight: How grasps squeeze for a mass.
        config: How they are weighed.
        workers: Threads; all cores by default.
        device: As of `simulate`.
    """
    weight, config = weight or WeightConfig(), config or WeighingConfig()
    scenes = [scene_of(hand, obj, grasps, protocol) for obj, grasps in zip(objects, batches, strict=True)]
    found = torch.cat([grasps.payload for grasps in batches])
    rows, begin = found.isfinite().nonzero()[:, 0], 0
    some = [grasps[grasps.payload.isfinite().nonzero()[:, 0]] for grasps in batches]
    for part, rollout in rollouts_of_all(scenes, hand, some, workers, device=device):
        rollout.close()
        joints = torch.from_numpy(rollout.poses()[0]).to(part.joints)
        chosen = squeezes_of(hand, contact_forces(rollout), joints, part.squeeze_joints, weight, rollout.place)
        made_for = torch.from_numpy(rollout.mass).to(joints)
        found[rows[begin:begin + len(part)]] = weighed(rollout, chosen, part.payload, weight, config, made_for)
        begin += len(part)
    return list(found.split([len(grasps) for grasps in batches]))


def observed(
    payload: Float[Tensor, " n"], gave: Float[Tensor, "n 2"], mass: float, protocol: str | Protocol = DEFAULT_PROTOCOL
) -> Float[Tensor, " n"]:
    """Payloads that agree with what a mass did [kg]: what held it carries at least as much, and what gave way less.

    Args:
        payload: Payloads [kg].
        gave: How far the mass moved [m] and turned [rad] the object; NaN where that was not tried.
        mass: The mass that pulled [kg].
        protocol: How far an object may move.
    """
    rules = find_protocol(protocol)
    held = (gave[:, 0] < rules.max_displacement) & (gave[:, 1] < rules.max_rotation)
    clamped = torch.where(held, payload.clamp_min(mass), payload.clamp_max(LESS * mass))
    return torch.where(gave.isnan().any(1), payload, clamped)


def weighed(
    rollout: Rollout, chosen: Squeezes, guess: Float[Tensor, " n"], weight: WeightConfig | None = None,
    config: WeighingConfig | None = None, made_for: Float[Tensor, " n"] | float = 0.0,
) -> Float[Tensor, " n"]:
    """The largest mass that each closed hand holds along each of FORCES [kg]; 0 where none is.

    Args:
        rollout: Closed hands; they are closed again afterwards.
        chosen: How they squeeze in addition for a mass.
        guess: Mass that is tried first [kg].
        weight: Bounds of payloads.
        config: Which masses are tried, and how.
        made_for: Mass for which the base of `chosen` squeezes already [kg].
    """
    bounds, config, closed = (weight or WeightConfig()).payload, config or WeighingConfig(), rollout.moment()
    own = rollout.mass.copy()
    least, most = math.log(bounds.least), math.log(bounds.most)
    at = (config.beyond * guess.double()).clamp(bounds.least, bounds.most).log().numpy()
    low, high, tried = np.full(len(at), -np.inf), np.full(len(at), np.inf), _Tried.nothing(len(at))
    for _ in range(config.rounds):
        mass = np.exp(at)
        added = (torch.from_numpy(mass).to(guess) - made_for).to(chosen.joints)
        targets = chosen.targets(added[:, None])[:, 0].cpu().numpy()
        rollout.make_heavy(mass)  # a light object would move at once where a heavy one has hardly begun to
        rollout.go_back(closed)
        rollout.press(targets[:, rollout.scene.actuated], config.pressing)
        held = _pull(rollout, mass, tried, np.isinf(high), config)
        low, high = np.where(held, np.maximum(low, at), low), np.where(held, high, np.minimum(high, at))
        at = _next(low, high, config.step).clip(least, most)
    rollout.make_heavy(own)
    rollout.go_back(closed)
    none = np.isinf(low) & (high <= least + math.log(config.step))
    found = np.where(none, 0.0, np.exp(_next(low, high, math.sqrt(config.step)).clip(least, most)))
    return torch.from_numpy(found).to(guess)


def _next(low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], step: float) -> Float[np.ndarray, " n"]:
    """Between a logarithm that is held and one that is not; a step beyond where one of them is not known."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isinf(high), low + math.log(step), np.where(np.isinf(low), high - math.log(step), (low + high) / 2))


@dataclass(frozen=True)
class _Tried:
    """What is known of each direction, for n grasps; it is written to."""

    used: Float[np.ndarray, "n 6"]  # share of what the object may move that it used last
    held: Float[np.ndarray, "n 6"]  # largest mass that was held [kg]

    @staticmethod
    def nothing(n: int) -> _Tried:
        return _Tried(np.zeros((n, len(FORCES))), np.zeros((n, len(FORCES))))


def _pull(
    rollout: Rollout, mass: Float[np.ndarray, " n"], tried: _Tried, thorough: Bool[np.ndarray, " n"], config: WeighingConfig
) -> Bool[np.ndarray, " n"]:
    """Which masses are held whichever way they pull.

    What was held in a direction is not tried there with less. The first mass that is not held is tried in all directions, so
    that few are left; after it the worst come first, and the first failure ends the round.
    """
    begin, held = rollout.moment(), np.ones(len(mass), bool)
    order = np.argsort(-tried.used, 1, kind="stable")
    ahead = _all_used(rollout, mass, tried, begin, config) if rollout.spreads else None
    for k in range(order.shape[1]):
        axis = order[:, k]
        known = tried.held[np.arange(len(mass)), axis] >= mass
        rows = np.flatnonzero((held | thorough) & ~known)
        if not len(rows):
            continue
        if ahead is not None:
            used = ahead[rows, axis[rows]]
        else:
            force = GRAVITY * mass[rows, None] * FORCES[axis[rows]]
            used = _used(rollout, rows, config, lambda some, now, rows=rows, force=force: (
                rollout.pull(rows[some], force[some], config.pulling / 2, begin if now is None else None), begin))
        tried.used[rows, axis[rows]] = used
        tried.held[rows, axis[rows]] = np.where(used < 1, mass[rows], tried.held[rows, axis[rows]])
        held[rows] &= used < 1
    return held


def _all_used(
    rollout: Rollout, mass: Float[np.ndarray, " n"], tried: _Tried, begin: Moment, config: WeighingConfig
) -> Float[np.ndarray, "n 6"]:
    """What each mass uses in each direction, found at once; NaN where it is known to be held."""
    rows, axis = np.nonzero(tried.held < mass[:, None])
    force, used = GRAVITY * mass[rows, None] * FORCES[axis], np.full(tried.held.shape, np.nan)
    used[rows, axis] = _used(rollout, rows, config, lambda some, now: rollout.pulled(
        rows[some], force[some], config.pulling / 2,
        {name: values[rows[some]] if now is None else values[some] for name, values in (now or begin).items()}))
    return used


Pull = Callable[[Int[np.ndarray, " k"], Moment | None], tuple[ObjectState, Moment]]
"""Pulls for half of the time at some of the trials, from the closed hands or from a moment; what comes of it."""


def _used(rollout: Rollout, rows: Int[np.ndarray, " k"], config: WeighingConfig, pull: Pull) -> Float[np.ndarray, " k"]:
    """Share of what the protocol lets an object move that a force uses."""
    start = rollout.start.rows(rows)
    half, moment = pull(np.arange(len(rows)), None)
    used = _share(rollout, half, half.shift(start), half.turn(start))
    going = np.flatnonzero(used < 1)  # what has gone too far already is not pulled on
    if not len(going):
        return used
    before, now = half.rows(going), pull(going, moment)[0]
    share, start = config.going_on / (config.pulling / 2), start.rows(going)
    moved, turned = (
        after + share * np.maximum(after - then, 0)
        for then, after in ((before.shift(start), now.shift(start)), (before.turn(start), now.turn(start))))
    used[going] = _share(rollout, now, moved, turned)
    return used


def _share(
    rollout: Rollout, state: ObjectState, moved: Float[np.ndarray, " k"], turned: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Share of what the protocol lets an object move [m] and turn [rad]; NOT_HELD where the simulation is unsound."""
    rules = rollout.scene.protocol
    used = np.maximum(moved / rules.max_displacement, turned / rules.max_rotation)
    return np.where(state.stable & np.isfinite(used), used, NOT_HELD)
