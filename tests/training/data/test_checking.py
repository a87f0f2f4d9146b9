"""Trying stored grasps again: agreement, and refusal of what has changed."""

from __future__ import annotations

import json

import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.compare.stages import BenchmarkConfig
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.simulation.protocols import changed
from dro_grasp.training.data.collections import checking, collection, filtering
from dro_grasp.training.data.collections.checking import check, stored_protocol
from dro_grasp.training.data.collections.collection import read_collection
from dro_grasp.training.data.collections.filtering import FilterConfig, filter_dataset
from dro_grasp.training.onboarding import OnboardingConfig


def test_the_same_trial_agrees_and_a_lie_is_found(stored, tmp_path):
    pairs = list(read_collection(stored, only_successful=False))
    found = check(pairs, 1000, changed("dro"))
    grasps = GraspBatch.load(stored)
    assert found.evaluated == found.agreed == 24
    assert found.succeeded == int(grasps.success.sum())
    assert found.hands == {"barrett": (24, found.succeeded)}
    assert not found.reasons
    failures = int((~grasps.success).sum())
    assert failures > 0
    grasps.replace(success=torch.ones(24, dtype=torch.bool)).save(tmp_path / "lie.parquet")
    lie = check(read_collection(tmp_path / "lie.parquet"), 1000, changed("dro"))
    assert lie.evaluated - lie.agreed == failures == lie.reasons.total()


def test_what_the_data_state_is_what_is_checked_unless_another_protocol_is_named(stored, tmp_path, capsys):
    grasps = GraspBatch.load(stored)
    untried, mixed = tmp_path / "untried.parquet", tmp_path / "mixed.parquet"
    grasps.without_trial().save(untried)
    half = len(grasps) // 2
    grasps.replace(protocol=("dro/1",) * half + ("strict/1",) * (len(grasps) - half)).save(mixed)
    assert main(["dataset", "check", str(stored), "--sample", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["protocol"] == "dro/1"
    assert stored_protocol(read_collection(untried, only_successful=False)) == "carry"
    assert main(["dataset", "check", str(mixed), "--sample", "3"]) == 2
    assert "states outcomes under dro/1, strict/1; say which protocol to check: --protocol" in capsys.readouterr().err
    assert main(["dataset", "check", str(mixed), "--sample", "3", "--protocol", "strict", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["protocol"] == "strict/1"


def test_a_sample_is_a_sample_and_repeats(stored):
    pairs = list(read_collection(stored))
    one, again, other = (check(pairs, 6, changed("dro"), seed) for seed in (1, 1, 2))
    assert one.evaluated == other.evaluated == 6
    assert one == again
    with pytest.raises(OptionError, match="at least one"):
        check(pairs, 0, changed("dro"))
    with pytest.raises(GraspFileError, match="nothing to check"):
        check([], 5, changed("dro"))


def test_grasps_without_a_trial_are_no_failures(stored, tmp_path):
    grasps = GraspBatch.load(stored)
    GraspBatch.concatenate([grasps[:4], grasps[4:].without_trial()]).save(tmp_path / "some.parquet")
    found = check(read_collection(tmp_path / "some.parquet", only_successful=False), 1000, changed("dro"))
    assert found.evaluated == found.agreed == 4
    grasps.without_trial().save(tmp_path / "none.parquet")
    with pytest.raises(GraspFileError, match=r"no grasp that has had a trial; there is .*`dro-grasp evaluate`"):
        check(read_collection(tmp_path / "none.parquet", only_successful=False), 5, changed("dro"))


@pytest.mark.parametrize("seed", [-1, 10**20])
def test_seeds_out_of_range_are_refused(stored, seed):
    for wrong in (lambda: check(read_collection(stored), 1, changed("dro"), seed), lambda: BenchmarkConfig(seed=seed),
                  lambda: OnboardingConfig(seed=seed)):
        with pytest.raises(OptionError, match=f"seed is {seed}; give an integer from 0"):
            wrong()


def test_heavier_objects_and_slippery_hands_are_harder(stored):
    pairs = list(read_collection(stored, only_successful=False))
    base = check(pairs, 1000, changed("dro")).succeeded
    assert check(pairs, 1000, changed("dro", friction=0.05)).succeeded < base
    assert check(pairs, 1000, changed("dro", mass_factor=100)).succeeded < base
    assert changed("strict", mass_factor=2).label == "strict+mass_factor=2/1"
    for wrong in ({"friction": 0.0}, {"mass_factor": -1.0}):
        with pytest.raises(OptionError, match="between 0 and"):
            changed("dro", **wrong)


def test_commands(stored, tmp_path, capsys):
    assert main(["dataset", "check", str(stored), "--sample", "12", "--protocol", "dro", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["evaluated"], told["agreed"], told["protocol"]) == (12, 12, "dro/1")
    assert told["interval_95"][0] < 1.0
    assert main(["dataset", "check", str(stored), "--sample", "5", "--protocol", "dro"]) == 0
    assert "100.0%" in capsys.readouterr().out
    assert main(["dataset", "check", str(tmp_path / "none")]) == 2
    assert "no grasps at" in capsys.readouterr().err


def test_a_changed_hand_is_refused(stored, tmp_path):
    GraspBatch.load(stored).replace(hand_sha256="0123456789abcdef").save(tmp_path / "old.parquet")
    with pytest.raises(GraspFileError, match="another version of hand 'barrett'"):
        check(read_collection(tmp_path / "old.parquet"), 5, changed("dro"))


@pytest.mark.parametrize("again", ["check", "filter"])
def test_a_changed_object_is_refused_before_any_trial(stored, tmp_path, monkeypatch, again):
    def none(*_):
        raise AssertionError("a trial")

    for module in (checking, filtering):
        monkeypatch.setattr(module, "simulate", none)
    grasps = GraspBatch.load(stored)
    last = tuple("0123456789abcdef" if name == grasps.object[-1] else sha
                 for name, sha in zip(grasps.object, grasps.object_sha256, strict=True))
    grasps.replace(object_sha256=last).save(tmp_path / "old.parquet")
    pairs = read_collection(tmp_path / "old.parquet", only_successful=False)
    work = {"check": lambda: check(pairs, 24, changed("dro")),
            "filter": lambda: filter_dataset(pairs, tmp_path / "kept", FilterConfig((changed("dro"),)))}
    with pytest.raises(GraspFileError, match=f"another version of object '{grasps.object[-1]}'"):
        work[again]()
    assert not (tmp_path / "kept").exists()


@pytest.mark.parametrize("command", ["filter", "check"])
def test_two_hands_of_one_name_are_refused_before_any_trial(stored, tmp_path, capsys, monkeypatch, command):
    def none(*_):
        raise AssertionError("a trial")

    for module in (checking, filtering):
        monkeypatch.setattr(module, "simulate", none)
    monkeypatch.setattr(collection, "hand_of", none)
    GraspBatch.load(stored).replace(hand_sha256="0123456789abcdef").save(tmp_path / "other.parquet")
    output = tmp_path / "kept"
    more = ["--output", str(output)] if command == "filter" else []
    assert main(["dataset", command, str(stored), str(tmp_path / "other.parquet"), *more]) == 2
    said = capsys.readouterr().err
    for words in (f"in {stored} ", f"in {tmp_path / 'other.parquet'} ", "hash 0123456789ab", "Rename one file and make its"):
        assert words in said
    assert not any(output.glob("*"))
