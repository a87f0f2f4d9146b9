"""Trying stored grasps again: agreement, filtering, and refusal of what has changed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.simulation.protocols import changed
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.collections import checking, collection
from dro_grasp.training.data.collections.checking import check, keep_passing, stored_protocol
from dro_grasp.training.data.collections.collection import PairGrasps, read_collection
from dro_grasp.training.data.engine import worker
from tests.helpers.loaded_hands import loaded_hand


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of evaluated grasps of two objects, successes and failures."""
    hand, batches = loaded_hand("barrett"), []
    path = tmp_path_factory.mktemp("stored") / "barrett.parquet"
    for name in ("can", "sphere"):
        obj = load_object(name)
        grasps = synthesize(hand, obj, 12, 0, SynthesisConfig(steps=80, batch_size=12))
        grasps.save(path)
        grasps = GraspBatch.load(path)  # files round rotations, and a grasp on the edge could tip over
        batches.append(grasps.with_trial(simulate(hand, obj, grasps, "dro")))
    GraspBatch.concatenate(batches).save(path)
    return path


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


def test_heavier_objects_and_slippery_hands_are_harder(stored):
    pairs = list(read_collection(stored, only_successful=False))
    base = check(pairs, 1000, changed("dro")).succeeded
    assert check(pairs, 1000, changed("dro", friction=0.05)).succeeded < base
    assert check(pairs, 1000, changed("dro", mass_factor=100)).succeeded < base
    assert changed("strict", mass_factor=2).label == "strict+mass_factor=2/1"
    for wrong in ({"friction": 0.0}, {"mass_factor": -1.0}):
        with pytest.raises(OptionError, match="between 0 and"):
            changed("dro", **wrong)


def test_filter_keeps_what_passes_with_its_new_numbers(stored):
    pairs = list(read_collection(stored, only_successful=False))
    kept = keep_passing(pairs, changed("strict"))
    for pair, passed in kept:
        again = simulate(loaded_hand("barrett"), load_object(pair.object), pair.grasps, "strict")
        assert torch.equal(passed.joints, pair.grasps.joints[again.success])
        assert set(passed.protocol or ()) <= {"strict/1"}
    assert 0 < sum(len(passed) for _, passed in kept) < 24


@pytest.fixture(scope="module")
def lazy(stored: Path) -> list[PairGrasps]:
    """The grasps that held, with one finger opened, and the others."""
    hand, grasps = loaded_hand("barrett"), GraspBatch.load(stored)
    joints = grasps.joints.clone()
    bends = hand.tree.moves[list(hand.fingers[0].links)].any(0) & ~hand.abduction
    joints[:, bends] = hand.open_ends[bends]
    joints = torch.where(grasps.success[:, None], joints, grasps.joints)
    opened = grasps.with_poses(grasps.T_object_wrist, joints)
    opened.save(stored.with_name("lazy.parquet"))
    return list(read_collection(stored.with_name("lazy.parquet"), only_successful=False))


def test_fingers_are_closed_where_the_grasp_holds_and_touches_with_more(lazy):
    hand = loaded_hand("barrett")
    plain, closed = (keep_passing(lazy, changed("dro"), close_fingers=close) for close in (False, True))
    gained = 0
    for (pair, before), (_, after) in zip(plain, closed, strict=True):
        again = simulate(hand, load_object(pair.object), after, "dro")
        assert bool(again.success.all())
        assert torch.equal(again.fingers_in_contact.float(), after.fingers_in_contact)
        # The wrist stays, so it tells which grasp is which.
        had, has = (dict(zip(g.T_object_wrist[:, 0, 3].tolist(), g.fingers_in_contact.tolist(), strict=True))
                    for g in (before, after))
        assert had.keys() <= has.keys()
        assert all(has[key] >= count for key, count in had.items())
        # `relabelled` marks the ones that another posture replaced; their energies are still those of the first.
        own = {key: row for row, key in enumerate(pair.grasps.T_object_wrist[:, 0, 3].tolist())}
        stored = pair.grasps[[own[key] for key in after.T_object_wrist[:, 0, 3].tolist()]]
        assert torch.equal(after.extra["relabelled"], (after.joints != stored.joints).any(1))
        assert torch.equal(after.energy.nan_to_num(), stored.energy.nan_to_num())
        gained += sum(count > had.get(key, 0) for key, count in has.items())
    assert gained > 1


def test_marks_of_an_earlier_closing_stay(lazy):
    """Of grasps that were merged with others, which never were closed, and of which nobody knows."""
    marks = [None, True] * (len(lazy[0].grasps) // 2)
    pair = replace(lazy[0], grasps=lazy[0].grasps.replace(extra={"relabelled": marks}))
    ((_, plain),) = keep_passing(lazy[:1], changed("dro"), close_fingers=True)
    ((_, marked),) = keep_passing([pair], changed("dro"), close_fingers=True)
    rows = [int((pair.grasps.T_object_wrist == T).all((1, 2)).nonzero()[0]) for T in marked.T_object_wrist]
    assert marked.extra["relabelled"].tolist() == [
        new or marks[row] is True for new, row in zip(plain.extra["relabelled"].tolist(), rows, strict=True)]


def test_closed_fingers_are_not_kept_where_one_link_alone_touches(lazy, monkeypatch):
    trials = []

    def few(hand, obj, grasps, rules, **options):
        found = simulate(hand, obj, grasps, rules, **options)
        if trials:  # the first is that of the grasps as they are stored
            found = replace(found, contact_links=tuple(names[:1] for names in found.contact_links))
        trials.append(found)
        return found

    for module in (checking, worker):
        monkeypatch.setattr(module, "simulate", few)
    ((pair, kept),) = keep_passing(lazy[:1], changed("dro"), close_fingers=True)
    assert int((trials[1].success & (trials[1].contacts == 1)).sum()) > 1
    assert torch.equal(kept.joints, pair.grasps.joints[trials[0].success])


def test_commands(stored, tmp_path, capsys):
    assert main(["dataset", "check", str(stored), "--sample", "12", "--protocol", "dro", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["evaluated"], told["agreed"], told["protocol"]) == (12, 12, "dro/1")
    assert told["interval_95"][0] < 1.0
    assert main(["dataset", "check", str(stored), "--sample", "5", "--protocol", "dro"]) == 0
    assert "100.0%" in capsys.readouterr().out
    assert main(["dataset", "filter", str(stored), "--output", str(tmp_path / "kept"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    kept = GraspBatch.load(tmp_path / "kept" / "barrett.parquet")
    assert told["grasps"] == 24
    assert told["kept"] == len(kept) == sum(pair["kept"] for pair in told["pairs"])
    made, still = ([pair.made for pair in read_collection(path, only_successful=False)] for path in (stored, tmp_path / "kept"))
    assert still == made
    assert main(["dataset", "check", str(tmp_path / "none")]) == 2
    assert "no grasps at" in capsys.readouterr().err


def test_a_changed_hand_is_refused(stored, tmp_path):
    GraspBatch.load(stored).replace(hand_sha256="0123456789abcdef").save(tmp_path / "old.parquet")
    with pytest.raises(GraspFileError, match="another version of hand 'barrett'"):
        check(read_collection(tmp_path / "old.parquet"), 5, changed("dro"))


@pytest.mark.parametrize("again", [check, keep_passing], ids=["check", "filter"])
def test_a_changed_object_is_refused_before_any_trial(stored, tmp_path, monkeypatch, again):
    def none(*_):
        raise AssertionError("a trial")

    monkeypatch.setattr(checking, "simulate", none)
    grasps = GraspBatch.load(stored)
    last = tuple("0123456789abcdef" if name == grasps.object[-1] else sha
                 for name, sha in zip(grasps.object, grasps.object_sha256, strict=True))
    grasps.replace(object_sha256=last).save(tmp_path / "old.parquet")
    pairs = read_collection(tmp_path / "old.parquet", only_successful=False)
    with pytest.raises(GraspFileError, match=f"another version of object '{grasps.object[-1]}'"):
        again(pairs, *([24] if again is check else []), changed("dro"))


@pytest.mark.parametrize("command", ["filter", "check"])
def test_two_hands_of_one_name_are_refused_before_any_trial(stored, tmp_path, capsys, monkeypatch, command):
    def none(*_):
        raise AssertionError("a trial")

    monkeypatch.setattr(checking, "simulate", none)
    monkeypatch.setattr(collection, "hand_of", none)
    GraspBatch.load(stored).replace(hand_sha256="0123456789abcdef").save(tmp_path / "other.parquet")
    output = tmp_path / "kept"
    more = ["--output", str(output)] if command == "filter" else []
    assert main(["dataset", command, str(stored), str(tmp_path / "other.parquet"), *more]) == 2
    said = capsys.readouterr().err
    for words in (f"in {stored} ", f"in {tmp_path / 'other.parquet'} ", "hash 0123456789ab", "Rename one file and make its"):
        assert words in said
    assert not any(output.glob("*"))
