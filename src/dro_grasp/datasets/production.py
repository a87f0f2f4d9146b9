"""Make one shard of a data set: synthesise candidates, close the hand on the object, keep what passes the trial."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from dro_grasp.datasets.records import Shard
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.duplicates import distinct
from dro_grasp.grasps.synthesis import SynthesisConfig, synthesize
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.library import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.trial import settle, simulate


@dataclass(frozen=True)
class EngineConfig:
    """How a data set is made."""

    candidates: int = 256
    """Grasps synthesised for a shard."""
    tried_share: float = 0.34
    """Share of them, lowest energy first, that are tried in simulation."""
    deepest: float = 0.01
    """Candidates that penetrate deeper than this by the signed distances are not tried [m]."""
    settle: bool = True
    """Take the labels after the hand has closed on the object in simulation, which drives out penetration."""
    farthest: float = 0.03
    """Candidates that the closing moves farther than this relative to the object are not tried [m]."""
    barren_rounds: int = 3
    """A pair is given up after this many rounds without a single valid grasp."""
    most_rounds: int = 200
    """A pair is given up after this many rounds."""
    keep_failures: bool = False
    """Store grasps that failed their trial as well."""
    synthesis: SynthesisConfig = field(default_factory=SynthesisConfig)
    """The optimiser."""


@dataclass(frozen=True)
class Job:
    """What all shards of a run share."""

    folder: Path
    seed: int
    protocol: str
    config: EngineConfig


def shard_seed(seed: int, shard: Shard) -> int:
    """A seed of its own for every shard, the same on every machine."""
    text = f"{seed}/{shard.hand}/{shard.object}/{shard.round}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:6], "big")


@lru_cache(maxsize=16)
def _hand(name: str) -> Hand:
    return load_hand(name)


@lru_cache(maxsize=4)
def _object(name: str) -> ObjectModel:
    return load_object(name)


def make_shard(job: Job, shard: Shard) -> int:
    """Synthesise, try and store one shard; returns the number of grasps stored."""
    hand, obj = _hand(shard.hand), _object(shard.object)
    grasps = valid_grasps(hand, obj, shard_seed(job.seed, shard), job.protocol, job.config)
    shard.save(grasps, job.folder)
    return len(grasps)


def valid_grasps(hand: Hand, obj: ObjectModel, seed: int, protocol: str, config: EngineConfig) -> GraspBatch:
    """Candidates of one seed that pass the protocol, near-duplicates once, best energy first."""
    grasps = synthesize(hand, obj, config.candidates, seed, config.synthesis)
    grasps = select(grasps, config)
    if not len(grasps):
        return grasps
    if config.settle:
        closed = settle(hand, obj, grasps, protocol, workers=1)
        grasps = closed[(_grasp_centres(hand, closed) - _grasp_centres(hand, grasps)).norm(dim=-1) < config.farthest]
        if not len(grasps):
            return grasps
    tried = grasps.with_trial(simulate(hand, obj, grasps, protocol, workers=1))
    if config.keep_failures or tried.success is None:
        return tried
    passed = tried[tried.success]
    return passed[distinct(hand, passed)]


def _grasp_centres(hand: Hand, grasps: GraspBatch) -> Float[Tensor, "n 3"]:
    T = grasps.T_object_wrist
    return T[:, :3, :3] @ hand.grasp_centre_wrist + T[:, :3, 3]


def select(grasps: GraspBatch, config: EngineConfig) -> GraspBatch:
    """The candidates worth a trial: lowest energy, not deep inside the object."""
    best = grasps[0 : max(1, round(config.tried_share * len(grasps)))]
    depth = best.extra.get("depth")
    return best if depth is None else best[depth < config.deepest]
