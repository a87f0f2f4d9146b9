"""Make one shard of a data set: synthesise candidates, close the hand on the object, keep what passes the trial."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache

from dro_grasp.datasets.engine.shards import Shard, notes_of
from dro_grasp.datasets.engine.yields import Yield
from dro_grasp.datasets.splits import split_of
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.duplicates import distinct
from dro_grasp.grasps.sources import with_sources
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimization.synthesis import SynthesisConfig, synthesize
from dro_grasp.simulation.trial import settle, simulate

LOOSE = "held by too few links"
"""Reason against grasps that pass the trial without enough contact."""


@dataclass(frozen=True)
class EngineConfig:
    """How a data set is made."""

    candidates: int = 256
    """Grasps synthesised for the first shard of a pair; later ones are as large as the pair's yield asks for."""
    least_candidates: int = 128
    """Smallest later shard."""
    largest_shard: int = 768
    """Largest later shard."""
    tried_share: float = 0.7
    """Share of them, lowest energy first, that are tried in simulation."""
    deepest: float = 0.01
    """Candidates that penetrate deeper than this by the signed distances are not tried [m]."""
    settle: bool = True
    """Take the labels after the hand has closed on the object in simulation, which drives out penetration."""
    farthest: float = 0.03
    """Candidates that the closing moves farther than this relative to the object are not tried [m]."""
    least_contacts: int = 2
    """Links that must touch the object after closing; with fewer, a success is a cage or luck."""
    barren_rounds: int = 3
    """A pair is given up after this many rounds without a single valid grasp."""
    most_candidates: int = 8192
    """A pair is given up after this many candidates."""
    most_crashes: int = 2
    """A pair is given up when workers died on it this often in a row."""
    shard_limit: float = 1800.0
    """A shard that takes longer is stopped, as if its worker had died [s]; preparing the object counts."""
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    """The optimiser."""


@dataclass(frozen=True)
class Job:
    """What all shards of a run share."""

    seed: int
    protocol: str
    config: EngineConfig
    scale: float = 1.0
    """Multiplies the coordinates of all objects."""


@dataclass(frozen=True)
class Task:
    """One shard to make."""

    shard: Shard
    candidates: int
    """Grasps to synthesise."""
    earlier: tuple[bytes, ...] = ()
    """The pair's shards so far, as files: what is in them counts as a duplicate."""


@dataclass(frozen=True)
class Made:
    """One shard, made."""

    shard: Shard
    payload: bytes
    """The shard's file."""
    result: Yield


def shard_seed(seed: int, shard: Shard) -> int:
    """A seed of its own for every shard, the same on every machine."""
    text = f"{seed}/{shard.hand}/{shard.object}/{shard.round}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:6], "big")


@lru_cache(maxsize=16)
def _hand(name: str) -> Hand:
    return load_hand(name)


@lru_cache(maxsize=16)
def _object(name: str, scale: float) -> ObjectModel:
    return load_object(name, scale=scale)


def make_shard(job: Job, task: Task) -> Made:
    """Synthesise and try one shard. Files go to and from it as bytes, so that it runs where the folder is not."""
    started = time.process_time()
    hand, obj = _hand(task.shard.hand), _object(task.shard.object, job.scale)
    _ = obj.distance_field, obj.parts
    prepared = time.process_time()
    earlier = [GraspBatch.load(io.BytesIO(payload)) for payload in task.earlier]
    grasps, result = valid_grasps(
        hand, obj, shard_seed(job.seed, task.shard), job.protocol, job.config, task.candidates,
        GraspBatch.concatenate(earlier) if earlier else None,
    )
    grasps = with_sources(grasps, task.shard.hand, task.shard.object, job.scale)
    grasps = grasps.replace(split=tuple(split_of(task.shard.hand, split) for split in grasps.split))
    result = dataclasses.replace(
        result, cpu_seconds=time.process_time() - prepared, preparation_seconds=prepared - started
    )
    return Made(task.shard, grasps.to_bytes(notes_of(result)), result)


def valid_grasps(
    hand: Hand,
    obj: ObjectModel,
    seed: int,
    protocol: str,
    config: EngineConfig,
    candidates: int | None = None,
    earlier: GraspBatch | None = None,
) -> tuple[GraspBatch, Yield]:
    """Candidates of one seed that pass the protocol, near-duplicates once, best energy first.

    Args:
        hand: The hand.
        obj: The object, with a mesh.
        seed: The same seed gives the same grasps.
        protocol: The trial.
        config: Sizes and thresholds.
        candidates: How many to synthesise; the config's number by default.
        earlier: Grasps of the pair that are there already.
    """
    count = candidates or config.candidates
    drawn = synthesize(hand, obj, count, seed, config.synthesis)
    ranked = drawn[0 : max(1, round(config.tried_share * count))]
    grasps = ranked[ranked.extra["depth"] < config.deepest]
    made = Yield(candidates=count, ranked_out=count - len(ranked), deep=len(ranked) - len(grasps))
    if config.settle and len(grasps):
        closed = settle(hand, obj, grasps, protocol, workers=1)
        shift = (hand.grasp_centres(closed.T_object_wrist) - hand.grasp_centres(grasps.T_object_wrist)).norm(dim=-1)
        made = dataclasses.replace(made, moved=int((shift >= config.farthest).sum()))
        grasps = closed[shift < config.farthest]
    trial = simulate(hand, obj, grasps, protocol, workers=1)
    tried = grasps.with_trial(trial)
    loose = trial.success & (trial.contacts < config.least_contacts)
    passed = tried[trial.success & ~loose]
    new = distinct(hand, passed, earlier=earlier)
    failures = Counter(failure.value for failure in trial.failure if failure)
    if loose.any():
        failures[LOOSE] += int(loose.sum())
    made = dataclasses.replace(
        made, failures=dict(failures), duplicates=int((~new).sum()), valid=int(new.sum())
    )
    return passed[new], made
