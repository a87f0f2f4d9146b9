"""The work of one shard: synthesize candidates, close the hand on the object, keep those that pass the trial."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import math
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache

import torch

from dro_grasp.devices import on_accelerator
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch, distinct
from dro_grasp.grasps.columns import DEPTH, RELABELLED
from dro_grasp.grasps.sources import with_sources
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.fingers import close_idle_fingers
from dro_grasp.optimize.grasp_energy import EnergyConfig, GraspEnergy
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol, protocol
from dro_grasp.simulation.trial import hand_shift, settle, simulate
from dro_grasp.training.data.bundle.training_file import split_of
from dro_grasp.training.data.engine.labels import RESTLESS, also_passing, at_rest
from dro_grasp.training.data.engine.shards import Shard, Yield, notes_of

ON_DEVICE = {"candidates": 2048, "min_candidates": 1024, "max_candidates": 4096, "candidate_budget": 65536}
"""Sizes of shards whose candidates are made on a device, which takes as long for few (ours)."""
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
    """Candidates of a pair's first shard; the size of later shards follows the pair's yield."""
    min_candidates: int = 128
    """Smallest later shard."""
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
    min_contact_links: int = 2
    """Links that must touch the object after closing; with fewer, a success is a cage or luck (ours)."""
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
    confirm: float = 1.0
    """Share of what passes on a device that the processor judges again; the device's verdict stands for the rest, unless the
    processor lets less than AGREEMENT of the share pass."""
    shard_seconds: float = 1800.0
    """A shard that takes longer is stopped, as if its worker had died [s]; this includes preparing the object."""
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    """The optimiser."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.shard[0] <= self.shard[1]:
            raise OptionError(f"shard is {self.shard[0]}/{self.shard[1]}; give a part from 1 on, and of how many, such as 3/16")
        if not 0 < self.confirm <= 1:
            raise OptionError(f"confirm is {self.confirm}; give the share that the processor judges again, above 0 and up to 1")

    @property
    def threads(self) -> int | None:
        """Threads of simulations: one; all that this process may use where a device makes the candidates."""
        return None if on_accelerator(self.synthesis.device) else 1

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


def make_shard(job: Job, task: Task) -> FinishedShard:
    """Make one shard. Files come and go as bytes, so that it runs on machines without the folder."""
    started = time.process_time()
    hand, obj = _hand(task.shard.hand), _object(task.shard.object, scale=job.config.scale)
    _ = obj.distance_field, obj.parts
    prepared = time.process_time()
    earlier = [GraspBatch.load(io.BytesIO(payload)) for payload in task.earlier]
    grasps, result = valid_grasps(
        hand, obj, shard_seed(job.seed, task.shard), job.config, task.candidates,
        GraspBatch.concatenate(earlier) if earlier else None)
    grasps = with_sources(grasps, task.shard.hand, task.shard.object, job.config.scale)
    grasps = grasps.replace(split=tuple(split_of(task.shard.hand, split) for split in grasps.split))
    result = dataclasses.replace(result, cpu_seconds=time.process_time() - prepared, preparation_seconds=prepared - started)
    return FinishedShard(task.shard, grasps.to_bytes(notes_of(result)), result)


def valid_grasps(
    hand: Hand, obj: ObjectModel, seed: int, config: EngineConfig, candidates: int | None = None,
    earlier: GraspBatch | None = None,
) -> tuple[GraspBatch, Yield]:
    """Candidates of one seed that pass the protocol, best energy first, without near-duplicates of them and of earlier ones."""
    count = candidates or config.candidates
    drawn = synthesize(hand, obj, count, seed, config.synthesis)
    ranked = drawn[0 : max(1, round(config.trial_share * count))]
    grasps = ranked[ranked.extra[DEPTH] < config.max_penetration]
    made = Yield(candidates=count, ranked_out=count - len(ranked), deep=len(ranked) - len(grasps))
    if config.settle and not config.resettle and len(grasps):
        closed = settle(hand, obj, grasps, config.protocol, workers=config.threads, device=config.synthesis.device)
        shift = hand_shift(hand, grasps, closed)
        made = dataclasses.replace(made, moved=int((shift >= config.max_shift).sum()))
        grasps = closed[shift < config.max_shift]
    passed, failures = _passing(hand, obj, grasps, config)
    new = distinct(hand, passed, earlier=earlier)
    valid, refuted, judged = _judged(hand, obj, passed[new], config, seed)
    return valid, dataclasses.replace(
        made, failures=dict(failures + refuted), duplicates=int((~new).sum()), judged=judged, valid=len(valid))


def _passing(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, config: EngineConfig
) -> tuple[GraspBatch, Counter[str]]:
    """The grasps that pass all protocols with enough contact where candidates are made, and why the others fail."""
    restless, device = 0, config.synthesis.device
    if config.resettle and len(grasps):
        grasps, stable = at_rest(hand, obj, grasps, config.close_fingers, device)
        restless, grasps = int((~stable).sum()), grasps[stable]
    passed, failures = _tried(hand, obj, grasps, config, device, config.close_fingers and not config.resettle)
    return passed, failures + Counter({RESTLESS: restless})


def _tried(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, config: EngineConfig, device: str, close_fingers: bool = False
) -> tuple[GraspBatch, Counter[str]]:
    """The grasps that pass trials on a device with enough contact, and why the others fail; idle fingers may close between."""
    trial = simulate(hand, obj, grasps, config.protocol, workers=config.threads, device=device, confirm=False)
    loose = trial.success & (trial.contacts < config.min_contact_links)
    passed = grasps.with_trial(trial)[trial.success & ~loose]
    if close_fingers and len(passed):
        passed = closed_where_it_holds(
            hand, obj, passed, config.protocol, config.min_contact_links, config.threads, device)
    failures = Counter(failure.value for failure in trial.failure if failure)
    passed, later = also_passing(hand, obj, passed, [protocol(name) for name in config.also], config.threads, device)
    return passed, failures + Counter({LOOSE: int(loose.sum())}) + later


def _judged(
    hand: Hand, obj: ObjectModel, valid: GraspBatch, config: EngineConfig, seed: int
) -> tuple[GraspBatch, Counter[str], int]:
    """Valid grasps without those that the processor refutes, why it does, and how many it judged: a share drawn at random."""
    if not on_accelerator(config.synthesis.device) or not len(valid):
        return valid, Counter(), 0
    order = torch.randperm(len(valid), generator=torch.Generator().manual_seed(seed))
    count = math.ceil(config.confirm * len(valid))
    held, refuted = _tried(hand, obj, valid[order[:count]], config, "cpu")
    others = valid[order[count:]]
    if len(held) < AGREEMENT * count:
        others, more = _tried(hand, obj, others, config, "cpu")
        refuted, count = refuted + more, len(valid)
    kept = GraspBatch.concatenate([held, others])
    return kept[kept.energy.argsort(stable=True)], refuted, count


def closed_where_it_holds(
    hand: Hand, obj: ObjectModel, evaluated: GraspBatch, protocol: str | Protocol,
    min_links: int = EngineConfig.min_contact_links, workers: int | None = None, device: str = "cpu",
) -> GraspBatch:
    """Grasps after a trial of the protocol; with idle fingers closed where these pass too, no fewer touch, and enough links.

    Column `relabelled` marks them. A device's verdict is not confirmed here. Energies stay those by which grasps were chosen.
    """
    known = evaluated.extra.get(RELABELLED, [None] * len(evaluated))
    relabelled = torch.tensor([bool(mark) for mark in known], dtype=torch.bool)
    energy = GraspEnergy.of_object(hand, obj, EnergyConfig(hand_points=hand.n_points), device=device)
    closed = close_idle_fingers(energy, evaluated).replace(energy=evaluated.energy, extra=evaluated.extra)
    rows = (closed.joints != evaluated.joints).any(1).nonzero()[:, 0]
    if not len(rows):
        return evaluated.replace(extra=evaluated.extra | {RELABELLED: relabelled})
    trial = simulate(hand, obj, closed[rows], protocol, workers=workers, device=device, confirm=False)
    better = trial.success & (trial.contacts >= min_links)
    better &= trial.fingers_in_contact >= evaluated.fingers_in_contact[rows]
    order = torch.arange(len(evaluated))
    order[rows[better]] = len(evaluated) + better.nonzero()[:, 0]
    chosen = GraspBatch.concatenate([evaluated, closed[rows].with_trial(trial)])[order]
    relabelled = relabelled | (order >= len(evaluated))
    return chosen.replace(extra=chosen.extra | {RELABELLED: relabelled})
