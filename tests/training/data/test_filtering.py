"""Filtering: several protocols, settling again, and runs that are killed and go on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch, distinct
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.simulation.protocols import changed
from dro_grasp.simulation.trial import simulate, simulate_many
from dro_grasp.training.data.collections import filtering
from dro_grasp.training.data.collections.bundling import make_bundle
from dro_grasp.training.data.collections.collection import PairGrasps, read_collection
from dro_grasp.training.data.collections.filtering import DUPLICATE, FilterConfig, filter_dataset, passing
from dro_grasp.training.data.engine import labels
from dro_grasp.training.data.engine.labels import RESTLESS
from dro_grasp.training.data.engine.schedule import require_settings
from dro_grasp.training.data.engine.shards import Shard, find_shards
from dro_grasp.training.data.engine.worker import LOOSE, EngineConfig, Job
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.one_object import valid_grasps

ROOT = Path(__file__).parents[3]


def kept_of(pairs: list[PairGrasps], *protocols: str, **options: bool) -> list[tuple[PairGrasps, GraspBatch]]:
    """Each pair, with what passes of it."""
    config, hand = FilterConfig(tuple(map(changed, protocols)), **options), loaded_hand("barrett")
    return [(pair, passing(hand, load_object(pair.object), pair.grasps, config)[0]) for pair in pairs]


def test_filter_keeps_what_passes_with_its_new_numbers(stored):
    pairs = list(read_collection(stored, only_successful=False))
    kept = kept_of(pairs, "strict")
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
    plain, closed = (kept_of(lazy, "dro", close_fingers=close) for close in (False, True))
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
    ((_, plain),) = kept_of(lazy[:1], "dro", close_fingers=True)
    ((_, marked),) = kept_of([pair], "dro", close_fingers=True)
    rows = [int((pair.grasps.T_object_wrist == T).all((1, 2)).nonzero()[0]) for T in marked.T_object_wrist]
    assert marked.extra["relabelled"].tolist() == [
        new or marks[row] is True for new, row in zip(plain.extra["relabelled"].tolist(), rows, strict=True)]


def test_closed_fingers_are_not_kept_where_one_link_alone_touches(lazy, monkeypatch):
    trials = []

    def stored(*given, **options):
        trials.append(simulate(*given, **options))
        return trials[-1]

    def few(*given, **options):
        found, = simulate_many(*given, **options)
        trials.append(replace(found, contact_links=tuple(names[:1] for names in found.contact_links)))
        return [trials[-1]]

    monkeypatch.setattr(filtering, "simulate", stored)
    monkeypatch.setattr(labels, "simulate_many", few)
    ((pair, kept),) = kept_of(lazy[:1], "dro", close_fingers=True)
    assert int((trials[1].success & (trials[1].contacts == 1)).sum()) > 1
    assert torch.equal(kept.joints, pair.grasps.joints[trials[0].success])


def test_what_stays_passes_each_protocol_and_says_so(stored):
    pairs, hand = list(read_collection(stored, only_successful=False)), loaded_hand("barrett")
    config = FilterConfig((changed("dro"), changed("strict"), changed("strict", friction=0.3)))
    left = 0
    for pair in pairs:
        obj, held = load_object(pair.object), torch.ones(len(pair.grasps), dtype=torch.bool)
        for rules in config.protocols:
            held &= simulate(hand, obj, pair.grasps, rules).success
        passed, failures, _ = passing(hand, obj, pair.grasps, config)
        assert torch.equal(passed.joints, pair.grasps.joints[held])
        assert set(passed.protocol) <= {"dro/1, strict/1, strict+friction0.3/1"}
        assert len(passed) + sum(failures.values()) == len(pair.grasps)
        # The numbers are those of the first trial.
        assert torch.equal(passed.displacement, simulate(hand, obj, passed, "dro").displacement.amax(-1))
        left += len(passed)
    assert 0 < left < 24


def test_the_robustness_of_a_protocol_that_perturbs_is_kept(stored):
    (pair,) = [pair for pair in read_collection(stored, only_successful=False) if pair.object == "can"]
    ((_, both),) = kept_of([pair], "dro", "robust")
    again = simulate(loaded_hand("barrett"), load_object("can"), both, "robust")
    assert len(both) > 0
    assert torch.equal(both.robustness, again.robustness)
    assert set(both.protocol) == {"dro/1, robust/1"}


def test_settled_labels_state_a_squeeze_and_hold_again(stored):
    """`carry` is tried anew on what is left, by the squeeze that it states; the rest is counted, whatever becomes of it."""
    hand, held = loaded_hand("barrett"), []
    for again in (False, True):
        config, number = FilterConfig((changed("carry"),), resettle=True, again=again), 0
        for pair in read_collection(stored, only_successful=False):
            passed, failures, remade = passing(hand, load_object(pair.object), pair.grasps, config)
            assert bool(simulate(hand, load_object(pair.object), passed, "carry").success.all())
            assert bool(passed.squeeze_joints.isfinite().all())
            assert not (passed.squeeze_joints == passed.joints).all(1).any()
            assert all(text.endswith(", settled") for text in passed.provenance)
            assert bool(distinct(hand, passed).all())
            assert len(passed) + sum(failures.values()) == len(pair.grasps)
            assert remade <= (len(passed) if again else 0)
            assert again or RESTLESS in failures
            assert passed.energy.isfinite().all()
            number += len(passed)
        held.append(number)
    assert 0 < held[0] <= held[1]


def test_a_label_is_held_by_two_links(stored, monkeypatch):
    honest = filtering.simulate

    def caged(*arguments, **options):
        trial = honest(*arguments, **options)
        return replace(trial, contact_links=tuple(links[:1] for links in trial.contact_links))

    (pair,) = [pair for pair in read_collection(stored, only_successful=False) if pair.object == "can"]
    config, hand, can = FilterConfig((changed("carry"),), resettle=True), loaded_hand("barrett"), load_object("can")
    usual, before, _ = passing(hand, can, pair.grasps, config)
    monkeypatch.setattr(filtering, "simulate", caged)
    kept, failures, _ = passing(hand, can, pair.grasps, config)
    assert len(kept) == before[LOOSE] == 0
    assert failures[LOOSE] >= len(usual) > 0


def test_what_comes_to_rest_in_one_place_stays_once(stored):
    (pair,) = [pair for pair in read_collection(stored, only_successful=False) if pair.object == "can"]
    config, hand, can = FilterConfig((changed("carry"),), resettle=True), loaded_hand("barrett"), load_object("can")
    once, _, _ = passing(hand, can, pair.grasps, config)
    both, failures, _ = passing(hand, can, GraspBatch.concatenate([pair.grasps, pair.grasps]), config)
    assert len(both) == len(once) > 0
    assert failures[DUPLICATE] >= len(once)


def test_a_killed_run_goes_on_and_ends_as_one_that_was_not(stored, tmp_path):
    """The parent is killed as soon as one pair is there; the pair's file is not written again."""
    words = ["dataset", "filter", str(stored), "--protocol", "carry", "--resettle", "--output"]
    process = subprocess.Popen([sys.executable, "-m", "dro_grasp", *words, str(tmp_path / "cut")], cwd=ROOT)
    while not list((tmp_path / "cut").glob("*/*/0*.parquet")):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = {shard: os.stat(shard.path(tmp_path / "cut")) for shard in find_shards(tmp_path / "cut")}
    # What is there can be read before the end.
    assert sum(len(pair.grasps) for pair in read_collection(tmp_path / "cut", only_successful=False)) >= 0
    assert main([*words, str(tmp_path / "cut")]) == 0
    assert main([*words, str(tmp_path / "whole")]) == 0
    for shard, stat in before.items():
        assert os.stat(shard.path(tmp_path / "cut")).st_mtime_ns == stat.st_mtime_ns
    for name in ("barrett.parquet", *(str(shard.path(Path())) for shard in find_shards(tmp_path / "whole"))):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_rerun_filters_what_is_missing_damaged_or_changed_alone(stored, tmp_path, monkeypatch):
    folder, config, done, lines = tmp_path / "kept", FilterConfig((changed("dro"),)), [], []

    def noted(settings: FilterConfig, task: filtering.FilterTask):
        done.append(task.shard.object)
        return original(settings, task)

    original = filtering.filter_pair
    monkeypatch.setattr(filtering, "filter_pair", noted)
    pairs = list(read_collection(stored, only_successful=False))
    report = filter_dataset(pairs, folder, config)
    assert sorted(done) == ["can", "sphere"]
    assert filter_dataset(pairs, folder, config) == report
    assert len(done) == 2
    Shard("barrett", "can", 0).path(folder).write_bytes(b"PAR1")
    assert filter_dataset(pairs, folder, config, say=lines.append) == report
    assert done[2:] == ["can"]
    assert "made again" in lines[0]
    fewer = [replace(pair, grasps=pair.grasps[:5]) if pair.object == "sphere" else pair for pair in pairs]
    assert [kept.grasps for kept in filter_dataset(fewer, folder, config).pairs] == [12, 5]
    assert done[3:] == ["sphere"]


def test_a_rerun_with_more_that_is_stopped_is_not_taken_for_whole(stored, tmp_path, monkeypatch):
    def stopped(*_: object):
        raise KeyboardInterrupt

    config, (first, second) = FilterConfig((changed("dro"),)), list(read_collection(stored, only_successful=False))
    filter_dataset([first], tmp_path, config)
    original = filtering.filter_pair
    second_too, twice = replace(second, object="another"), [original, stopped]
    monkeypatch.setattr(filtering, "filter_pair", lambda *given: twice.pop(0)(*given))
    with pytest.raises(KeyboardInterrupt):
        filter_dataset([first, second, second_too], tmp_path, config)
    read = {pair.object for pair in read_collection(tmp_path, only_successful=False)}
    assert read == {shard.object for shard in find_shards(tmp_path)} > {first.object}


def test_several_processes_make_the_same_files(stored, tmp_path):
    pairs, config = list(read_collection(stored, only_successful=False)), FilterConfig((changed("dro"),))
    reports = [filter_dataset(pairs, tmp_path / str(n), config, workers=n) for n in (1, 2)]
    assert reports[0] == reports[1]
    assert (tmp_path / "1" / "barrett.parquet").read_bytes() == (tmp_path / "2" / "barrett.parquet").read_bytes()


def test_a_pair_that_cannot_be_filtered_is_told_and_the_others_stay(stored, tmp_path, monkeypatch, capsys):
    def failing(settings: FilterConfig, task: filtering.FilterTask):
        if task.shard.object == "can":
            raise RuntimeError("no memory")
        return original(settings, task)

    original = filtering.filter_pair
    monkeypatch.setattr(filtering, "filter_pair", failing)
    assert main(["dataset", "filter", str(stored), "--output", str(tmp_path / "kept"), "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["failures"] == [{"hand": "barrett", "object": "can", "reason": "RuntimeError: no memory"}]
    assert set(GraspBatch.load(tmp_path / "kept" / "barrett.parquet").object) == {"sphere"}
    monkeypatch.undo()
    assert main(["dataset", "filter", str(stored), "--output", str(tmp_path / "kept")]) == 0
    assert set(GraspBatch.load(tmp_path / "kept" / "barrett.parquet").object) == {"can", "sphere"}


def test_folders_of_other_settings_or_commands_are_refused(stored, tmp_path):
    pairs = list(read_collection(stored, only_successful=False))
    filter_dataset(pairs, tmp_path, FilterConfig((changed("dro"),)))
    with pytest.raises(OptionError, match="begun with protocols"):
        filter_dataset(pairs, tmp_path, FilterConfig((changed("strict"),)))
    with pytest.raises(OptionError, match=r"begun with command filter, .*command synthesize"):
        require_settings(tmp_path, Job(0, EngineConfig()))
    other = tmp_path / "made"
    other.mkdir()
    Shard("a", "x", 0).save(stored.read_bytes(), other)
    with pytest.raises(OptionError, match="holds grasps of another command"):
        filter_dataset(pairs, other, FilterConfig((changed("dro"),)))
    with pytest.raises(OptionError, match="holds grasps of another command"):
        filter_dataset(pairs, stored.parent, FilterConfig((changed("dro"),)))
    with pytest.raises(OptionError, match="name one at least"):
        FilterConfig(())
    with pytest.raises(OptionError, match="resettle=True"):
        FilterConfig((changed("dro"),), again=True)
    with pytest.raises(OptionError, match="give at least 1"):
        filter_dataset(pairs, tmp_path, FilterConfig((changed("dro"),)), workers=0)


def test_filtered_grasps_make_a_bundle(stored, tmp_path):
    pairs = list(read_collection(stored, only_successful=False))
    report = filter_dataset(pairs, tmp_path / "kept", FilterConfig((changed("carry"),), resettle=True))
    # The can and the sphere are no training objects; a bundle takes them as a user's own.
    kept = GraspBatch.load(tmp_path / "kept" / "barrett.parquet")
    kept.replace(split=("",) * len(kept)).save(tmp_path / "own.parquet")
    bundle, left_out = make_bundle([tmp_path / "own.parquet"], tmp_path / "bundle.safetensors")
    assert bundle.n_grasps == sum(pair.kept for pair in report.pairs) > 0
    assert not left_out


def test_synthesis_asks_for_several_protocols_too():
    hand, can = loaded_hand("barrett"), load_object("can")
    config = EngineConfig(
        "carry", also=("strict",), resettle=True, candidates=48, synthesis=SynthesisConfig(steps=80, batch_size=48))
    grasps, made = valid_grasps(hand, can, 1, config)
    assert len(grasps) == made.valid > 0
    assert set(grasps.protocol) == {"carry/1, strict/1"}
    assert bool(grasps.squeeze_joints.isfinite().all())
    for rules in ("carry", "strict"):
        assert bool(simulate(hand, can, grasps, rules).success.all())
    assert made.failures[RESTLESS] > 0
    lost = made.ranked_out + made.deep + made.moved + sum(made.failures.values()) + made.duplicates
    assert lost + made.valid == made.candidates == 48


def test_command(stored, tmp_path, capsys):
    named = ["dataset", "filter", str(stored), "--protocol", "strict", "--output", str(tmp_path / "kept"), "--json"]
    assert main(named) == 0
    told = json.loads(capsys.readouterr().out)
    kept = GraspBatch.load(tmp_path / "kept" / "barrett.parquet")
    assert told["grasps"] == 24
    assert told["kept"] == len(kept) == sum(pair["kept"] for pair in told["pairs"])
    made, still = ([pair.made for pair in read_collection(path, only_successful=False)] for path in (stored, tmp_path / "kept"))
    assert still == made
    assert told["protocol"] == "strict/1"
    asked = ["--protocol", "dro", "--also", "strict", "dro", "--output", str(tmp_path / "both")]
    assert main(["dataset", "filter", str(stored), *asked]) == 0
    said = capsys.readouterr().out
    assert "protocol dro/1, strict/1" in said
    assert " left out: " in said
    assert len(GraspBatch.load(tmp_path / "both" / "barrett.parquet")) == len(kept)
