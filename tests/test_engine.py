"""The data engine: order, resumption, failures that stay with their pair, and one real run."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import pytest
import torch

from dro_grasp.datasets import engine, production
from dro_grasp.datasets.engine import EngineConfig, PairState, synthesize_dataset
from dro_grasp.datasets.production import Job, shard_seed
from dro_grasp.datasets.records import Shard, find_shards, read_pairs
from dro_grasp.errors import HandError, OptionError, OutputError
from dro_grasp.grasps.synthesis import SynthesisConfig
from tests.test_records import grasps


@pytest.fixture
def made(monkeypatch) -> list[Shard]:
    """Replace the work by five grasps a shard, done in a thread; returns the shards in the order they were made."""
    order: list[Shard] = []

    def make(job: Job, shard: Shard) -> int:
        order.append(shard)
        if shard.hand == "broken":
            raise HandError("no hand is called 'broken'")
        if shard.hand == "deadly":
            raise BrokenProcessPool("a child process terminated abruptly")
        count = 0 if shard.object == "barren" else 5
        shard.save(grasps(count, shard.hand, shard.object), job.folder)
        return count

    monkeypatch.setattr(engine, "make_shard", make)
    monkeypatch.setattr(engine, "_pool", lambda workers: ThreadPoolExecutor(workers))
    return order


def quiet(_: str) -> None:
    """Progress that nobody reads."""


def test_every_pair_gets_its_first_shard_before_any_gets_its_second(made, tmp_path):
    report = synthesize_dataset(["a", "b"], ["x", "y", "z"], 12, tmp_path, workers=1, progress=quiet)
    assert [s.round for s in made] == [0] * 6 + [1] * 6 + [2] * 6
    assert report.grasps == report.added == 90
    assert report.shards == 18
    assert not report.failures


def test_a_rerun_does_only_what_is_missing(made, tmp_path):
    synthesize_dataset(["a"], ["x", "y"], 10, tmp_path, workers=1, progress=quiet)
    Shard("a", "y", 1).path(tmp_path).unlink()
    made.clear()
    report = synthesize_dataset(["a"], ["x", "y"], 10, tmp_path, workers=1, progress=quiet)
    assert made == [Shard("a", "y", 1)]
    assert (report.grasps, report.added) == (20, 5)


def test_a_damaged_shard_is_made_again(made, tmp_path):
    synthesize_dataset(["a"], ["x"], 10, tmp_path, workers=1, progress=quiet)
    Shard("a", "x", 0).path(tmp_path).write_bytes(b"PAR1")
    made.clear()
    synthesize_dataset(["a"], ["x"], 5, tmp_path, workers=1, progress=quiet)
    assert made == [Shard("a", "x", 0)]


@pytest.mark.parametrize("hand", ["broken", "deadly"])
def test_a_failing_pair_is_reported_and_the_others_go_on(made, tmp_path, hand):
    lines: list[str] = []
    report = synthesize_dataset([hand, "good"], ["x"], 10, tmp_path, workers=2, progress=lines.append)
    assert report.grasps == 10
    assert set(report.failures) == {(hand, "x")}
    assert {s.hand for s in find_shards(tmp_path)} == {"good"}
    assert sum(s.hand == hand for s in made) == (1 if hand == "broken" else 2)
    assert lines


def test_a_barren_pair_is_given_up(made, tmp_path):
    report = synthesize_dataset(["a"], ["barren", "x"], 10, tmp_path, workers=1, progress=quiet)
    assert "no valid grasp" in report.failures["a", "barren"]
    assert sum(s.object == "barren" for s in made) == EngineConfig().barren_rounds
    made.clear()
    synthesize_dataset(["a"], ["barren", "x"], 10, tmp_path, workers=1, progress=quiet)
    assert made == []


def test_the_next_pair_is_idle_and_has_the_fewest_rounds():
    states = {("a", "x"): PairState(rounds=2), ("a", "y"): PairState(rounds=1), ("a", "z"): PairState(rounds=0)}
    assert engine.next_pair(states, {("a", "z")}, 10, EngineConfig()) == ("a", "y")
    states["a", "y"].grasps = 10
    assert engine.next_pair(states, {("a", "z")}, 10, EngineConfig()) == ("a", "x")


def test_shards_have_seeds_of_their_own():
    shards = [Shard(h, o, r) for h in "ab" for o in "xy" for r in range(3)]
    seeds = {shard_seed(seed, shard) for seed in (0, 1) for shard in shards}
    assert len(seeds) == 24
    assert shard_seed(0, Shard("a", "x", 0)) == shard_seed(0, Shard("a", "x", 0))
    assert max(seeds) < 2**63


def test_impossible_requests_are_refused_before_the_work(made, tmp_path):
    with pytest.raises(OptionError):
        synthesize_dataset(["a"], ["x"], 0, tmp_path)
    with pytest.raises(OutputError, match="create it first"):
        synthesize_dataset(["a"], ["x"], 1, tmp_path / "no" / "folder")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        synthesize_dataset(["a"], ["x"], 1, tmp_path / "file")
    assert made == []


def test_a_real_shard_holds_valid_grasps_and_repeats(tmp_path):
    synthesis = SynthesisConfig(steps=100, batch_size=32)
    config = EngineConfig(candidates=32, tried_share=0.5, synthesis=synthesis)
    job = Job(tmp_path, 0, "strict", config)
    count = production.make_shard(job, Shard("barrett", "can", 0))
    (pair, found), = read_pairs(tmp_path)
    assert pair == ("barrett", "can")
    assert len(found) == count > 0
    assert found.success is not None
    assert found.success.all()
    assert found.penetration is not None
    assert found.penetration.max() < 0.005  # [m]
    assert set(found.split) == {"train"}
    hand, obj = production._hand("barrett"), production._object("can")
    again = production.valid_grasps(hand, obj, shard_seed(0, Shard("barrett", "can", 0)), "strict", config)
    torch.testing.assert_close(again.joints, found.joints)


@pytest.mark.slow
def test_real_processes(tmp_path):
    config = EngineConfig(candidates=32, tried_share=0.5, synthesis=SynthesisConfig(steps=100, batch_size=32))
    report = synthesize_dataset(["barrett", "none"], ["can"], 4, tmp_path, 2, config=config, progress=quiet)
    assert report.grasps >= 4
    assert set(report.failures) == {("none", "can")}
