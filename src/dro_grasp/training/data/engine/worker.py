"""The work of shards: synthesize candidates, close the hand on the object, keep those that pass the trial.

On a device, which takes as long for few, those of several objects of a hand are made together.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import torch

from dro_grasp.devices import on_accelerator
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch, distinct
from dro_grasp.grasps.columns import DEPTH
from dro_grasp.grasps.sources import with_sources
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.grasp_energy import GraspEnergy
from dro_grasp.optimize.synthesis import Lot, SynthesisConfig, synthesize_all
from dro_grasp.simulation.outcome import FEWEST_LINKS
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, protocol
from dro_grasp.simulation.trial import hand_shift, settle_many, simulate_many
from dro_grasp.training.data.bundle.training_file import split_of
from dro_grasp.training.data.engine.labels import RESTLESS, also_passing, at_rest, closed_where_they_hold
from dro_grasp.training.data.engine.shards import Failed, Shard, Yield, failure_of, notes_of

ON_DEVICE = {"candidates": 512, "min_candidates": 256, "max_candidates": 1024, "candidate_budget": 65536, "together": 8}
"""Sizes of shards whose candidates are made on a device, which takes as long for few: 4,096 of a hand at once (ours)."""
AGREEMENT = 0.9
"""Share of a device's passes that the processor must agree with; with less, it judges them all (ours: 98 % was measured)."""
LOOSE = "held by too few links"  # Reason that counts grasps which pass the trial without enough contact


@dataclass(frozen=True)
class EngineConfig(Checked):
    """Settings of a data set's production."""

    protocol: str = DEFAULT_PROTOCOL
    """Trial that grasps must pass."""
    scale: float = 1.0
    """Multiplies the coordinates of all objects."""
    seconds: float | None = None
    """No new shard starts after this time [s]; those in flight are finished. None for no limit."""
    candidates: int = 256
    """Most candidates of a pair's first shard; the size of later shards follows the pair's yield."""
    min_candidates: int = 64
    """Smallest shard."""
    max_candidates: int = 768
    """Largest later shard."""
    trial_share: float = 0.7
    """Share of the candidates, lowest energy first, that may get a trial."""
    max_penetration: float = 0.01
    """Candidates that penetrate deeper by the signed distances get no trial [m]."""
    settle: bool = True
    """Take the labels after the hand has closed on the object in simulation, which drives out penetration."""
    max_shift: float = 0.03
    """Candidates that closing moves farther relative to the object get no trial [m]."""
    min_contact_links: int = FEWEST_LINKS
    """Links that must touch the object after closing."""
    close_fingers: bool = True
    """Close the idle fingers of valid grasps onto the object, where the grasp then passes as well with no fewer fingers."""
    also: tuple[str, ...] = ()
    """Protocols that grasps must pass too, in this order."""
    resettle: bool = False
    """Settle as `generate` does, so that grasps squeeze for the object's weight."""
    max_barren_rounds: int = 3
    """A pair is given up after this many rounds in a row without a valid grasp."""
    candidate_budget: int = 8192
    """A pair is given up after this many candidates."""
    max_crashes: int = 2
    """A pair is given up after this many deaths of workers in a row."""
    shard: tuple[int, int] = (1, 1)
    """Which part of the pairs this run fills, and of how many: (3, 16) is the third of sixteen, as `--shard 3/16`. Runs of all
    parts may fill one folder at the same time, and together make the same grasps as one run."""
    together: int = 1
    """Objects of a hand whose shards are made together. Where fewer are left, shards are larger, as many times."""
    confirm: float = 1.0
    """Share of what passes on a device that the processor judges again; the device's verdict stands for the rest, unless the
    processor lets less than AGREEMENT of the share pass."""
    shard_seconds: float = 1800.0
    """A shard that takes longer is stopped, as if its worker had died [s]; this includes preparing the object. Shards that are
    made together may take as many times as long."""
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    """The optimiser."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.shard[0] <= self.shard[1]:
            raise OptionError(f"shard is {self.shard[0]}/{self.shard[1]}; give a part from 1 on, and of how many, such as 3/16")
        if self.together < 1:
            raise OptionError(f"together is {self.together}; give how many objects of a hand are worked on together, at "
                              "least 1")
        if not 0 < self.confirm <= 1:
            raise OptionError(f"confirm is {self.confirm}; give the share that the processor judges again, above 0 and up to 1")

    @property
    def threads(self) -> int | None:
        """Threads of simulations: one; all that this process may use where a device makes the candidates."""
        return None if on_accelerator(self.synthesis.device) else 1

    @property
    def limit(self) -> float:
        """Longest time for what is made together [s]."""
        return self.shard_seconds * self.together

    def suited(self) -> EngineConfig:
        """With shards as large as suits the device."""
        return dataclasses.replace(self, **ON_DEVICE) if on_accelerator(self.synthesis.device) else self


@dataclass(frozen=True)
class Job:
    """Settings that all shards of a run share."""

    seed: int
    config: EngineConfig


@dataclass(frozen=True)
class Task:
    """One shard to make."""

    shard: Shard
    candidates: int
    earlier: tuple[bytes, ...] = ()  # the pair's shards so far, as files; a grasp close to one of theirs is a duplicate


@dataclass(frozen=True)
class FinishedShard:
    """The outcome of one task."""

    shard: Shard
    payload: bytes  # the shard's file
    result: Yield


def shard_seed(seed: int, shard: Shard) -> int:
    """A seed of its own for every shard, the same on every machine."""
    text = f"{seed}/{shard.hand}/{shard.object}/{shard.round}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:6], "big")


_hand = lru_cache(maxsize=16)(load_hand)
_object = lru_cache(maxsize=16)(load_object)


def make_shards(job: Job, tasks: Sequence[Task]) -> list[FinishedShard | Failed]:
    """Make shards of one hand. Files come and go as bytes, so that it runs on machines without the folder.

    What fails is made again alone, so that its error costs the others nothing.
    """
    try:
        return [*_made(job, tasks)]
    except Exception as error:  # a fault of ours too: `failure_of` names it
        if len(tasks) == 1:
            return [failure_of(error)]
        return [done for task in tasks for done in make_shards(job, [task])]


def _made(job: Job, tasks: Sequence[Task]) -> list[FinishedShard]:
    """The same together; the time that they take counts for each in equal parts."""
    started, config = time.process_time(), job.config
    hand, wanted = _hand(tasks[0].shard.hand), []
    for task in tasks:
        obj = _object(task.shard.object, scale=config.scale)
        _ = obj.distance_field, obj.parts
        earlier = [GraspBatch.load(io.BytesIO(payload)) for payload in task.earlier]
        wanted.append(Wanted(
            obj, shard_seed(job.seed, task.shard), task.candidates, GraspBatch.concatenate(earlier) if earlier else None))
    prepared = time.process_time()
    made = valid_grasps_of_all(hand, wanted, config)
    preparation, spent = (prepared - started) / len(tasks), (time.process_time() - prepared) / len(tasks)
    done = []
    for task, (grasps, result) in zip(tasks, made, strict=True):
        grasps = with_sources(grasps, task.shard.hand, task.shard.object, config.scale)
        grasps = grasps.replace(split=tuple(split_of(task.shard.hand, split) for split in grasps.split))
        result = dataclasses.replace(result, cpu_seconds=spent, preparation_seconds=preparation)
        done.append(FinishedShard(task.shard, grasps.to_bytes(notes_of(result)), result))
    return done


class Wanted(NamedTuple):
    """Grasps that are wanted of an object."""

    obj: ObjectModel
    seed: int
    candidates: int
    earlier: GraspBatch | None = None  # A grasp close to one of these is a duplicate


def valid_grasps_of_all(hand: Hand, wanted: Sequence[Wanted], config: EngineConfig) -> list[tuple[GraspBatch, Yield]]:
    """Candidates that pass the protocol, best energy first, without near-duplicates of them and of earlier ones.

    Several objects are computed together where a device makes the candidates.
    """
    objects, (batches, made) = [one.obj for one in wanted], _drawn(hand, wanted, config)
    if config.settle and not config.resettle:
        batches, made = _closed(hand, objects, batches, made, config)
    found = []
    passed = _passing(hand, objects, batches, config)
    for one, result, (kept, failures) in zip(wanted, made, passed, strict=True):
        new = distinct(hand, kept, earlier=one.earlier)
        begin = time.perf_counter()
        valid, refuted, judged = _judged(hand, one, kept[new], config)
        found.append((valid, dataclasses.replace(
            result, failures=dict(failures + refuted), duplicates=int((~new).sum()), judged=judged, valid=len(valid),
            judging_seconds=time.perf_counter() - begin if judged else 0.0)))
    return found


def _drawn(
    hand: Hand, wanted: Sequence[Wanted], config: EngineConfig
) -> tuple[list[GraspBatch], list[Yield]]:
    """Candidates that get a trial."""
    own = config.synthesis
    energies = [GraspEnergy.of_object(hand, one.obj, own.energy, own.contacts, own.device) for one in wanted]
    lots = [Lot(energy, one.obj, one.candidates, one.seed, own) for energy, one in zip(energies, wanted, strict=True)]
    batches, made = [], []
    for one, drawn in zip(wanted, synthesize_all(lots), strict=True):
        ranked = drawn[0 : max(1, round(config.trial_share * one.candidates))]
        batches.append(ranked[ranked.extra[DEPTH] < config.max_penetration])
        made.append(Yield(
            candidates=one.candidates, ranked_out=one.candidates - len(ranked), deep=len(ranked) - len(batches[-1])))
    return batches, made


def _closed(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], made: Sequence[Yield], config: EngineConfig
) -> tuple[list[GraspBatch], list[Yield]]:
    """Candidates where closing leaves them, without those that it moves too far."""
    closed = settle_many(
        hand, objects, batches, config.protocol, workers=config.threads, device=config.synthesis.device)
    near = [hand_shift(hand, *each) < config.max_shift for each in zip(batches, closed, strict=True)]
    return ([own[rows] for own, rows in zip(closed, near, strict=True)],
            [dataclasses.replace(own, moved=int((~rows).sum())) for own, rows in zip(made, near, strict=True)])


def _passing(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], config: EngineConfig
) -> list[tuple[GraspBatch, Counter[str]]]:
    """The grasps of each object that pass all protocols with enough contact where candidates are made, and why others fail."""
    device = config.synthesis.device
    if not config.resettle:
        return _tried(hand, objects, batches, config, device, config.close_fingers)
    rested = at_rest(hand, objects, batches, config.close_fingers, device)
    tried = _tried(hand, objects, [grasps[stable] for grasps, stable in rested], config, device)
    return [(passed, failures + Counter({RESTLESS: int((~stable).sum())}))
            for (passed, failures), (_, stable) in zip(tried, rested, strict=True)]


def _tried(
    hand: Hand, objects: Sequence[ObjectModel], batches: Sequence[GraspBatch], config: EngineConfig, device: str,
    close_fingers: bool = False,
) -> list[tuple[GraspBatch, Counter[str]]]:
    """The grasps that pass trials on a device with enough contact, and why others fail; idle fingers may close between."""
    trials = simulate_many(
        hand, objects, batches, config.protocol, workers=config.threads, device=device, confirm=False)
    passed, failures = [], []
    for grasps, trial in zip(batches, trials, strict=True):
        loose = trial.success & (trial.contacts < config.min_contact_links)
        passed.append(grasps.with_trial(trial)[trial.success & ~loose])
        failures.append(Counter(failure.value for failure in trial.failure if failure) + Counter({LOOSE: int(loose.sum())}))
    if close_fingers:
        passed = closed_where_they_hold(
            hand, objects, passed, config.protocol, config.min_contact_links, config.threads, device)
    later = also_passing(hand, objects, passed, [protocol(name) for name in config.also], config.threads, device)
    return [(kept, first + more) for first, (kept, more) in zip(failures, later, strict=True)]


def _judged(hand: Hand, one: Wanted, valid: GraspBatch, config: EngineConfig) -> tuple[GraspBatch, Counter[str], int]:
    """Valid grasps without those that the processor refutes, why it does, and how many it judged: a share drawn at random."""
    if not on_accelerator(config.synthesis.device) or not len(valid):
        return valid, Counter(), 0
    order = torch.randperm(len(valid), generator=torch.Generator().manual_seed(one.seed))
    count = math.ceil(config.confirm * len(valid))
    (held, refuted), = _tried(hand, [one.obj], [valid[order[:count]]], config, "cpu")
    others = valid[order[count:]]
    if len(held) < AGREEMENT * count:
        (others, more), = _tried(hand, [one.obj], [others], config, "cpu")
        refuted, count = refuted + more, len(valid)
    kept = GraspBatch.concatenate([held, others])
    return kept[kept.energy.argsort(stable=True)], refuted, count
