"""The measures that benchmarks define themselves."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import ttest_rel

from dro_grasp.network.presets import PRESETS
from dro_grasp.objects.catalogue import load_object
from dro_grasp.training import loop, pretraining
from dro_grasp.training.data.bundle.training_file import write_bundle
from dro_grasp.training.data.collections.importing import read_foreign
from lab.benchmarks import agreement, dexgraspbench, dexgraspbench_official
from lab.studies import directions, matching_rank, paper_form
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import SEMIAXES, TINY, ellipsoid, made_up_grasps
from tests.helpers.toy_hand import toy_hand


def test_counterparts_lie_on_the_same_part_of_the_hand() -> None:
    counterparts = matching_rank.counterparts
    hand, other = loaded_hand("allegro"), loaded_hand("leaphand")
    assert torch.equal(counterparts(hand, hand), torch.arange(hand.n_points))
    index = counterparts(hand, other)
    on_palm, lands_on_palm = hand.link_index == hand.palm, other.link_index[index] == other.palm
    assert float(lands_on_palm[on_palm].float().mean()) > 0.6
    tips = torch.isin(hand.link_index, torch.tensor(hand.tips))
    assert float(lands_on_palm[tips].float().mean()) < 0.1


def test_palm_angles_are_scipys() -> None:
    palm_angles, hand = directions.palm_angles, toy_hand()
    grasps = made_up_grasps(hand, count=15)
    requested = np.array([1.0, 2.0, -2.0])
    turned = Rotation.from_matrix(grasps.T_object_wrist[:, :3, :3].numpy()).apply(hand.palm_direction_wrist.numpy())
    np.testing.assert_allclose(palm_angles(hand, grasps, (1.0, 2.0, -2.0)), np.arccos(turned @ requested / 3), atol=1e-5)
    twice = dataclasses.replace(grasps[[0]], T_object_wrist=torch.eye(4)[None])
    opposite = tuple((-hand.palm_direction_wrist).tolist())
    assert float(palm_angles(hand, twice, opposite)) == pytest.approx(math.pi, abs=1e-5)


def test_the_gain_by_pretraining_is_scipys_paired_interval() -> None:
    rates = torch.rand(2, 3, generator=torch.Generator().manual_seed(0)).tolist()
    pretrained, plain = (
        [{"seed": seed, "rows": [{"stage": "raw", "success": {"dro/1": (other, 0, 1)}} for other in (0.5, rate)]}
         for seed, rate in enumerate(row)] for row in rates)
    interval = ttest_rel(*rates).confidence_interval()
    expected = 50 * (interval.low + interval.high), 50 * (interval.high - interval.low)
    (told,) = paper_form.gains(list(reversed(pretrained)), plain)
    assert f"under dro/1, raw: {expected[0]:+.1f} +- {expected[1]:.1f} points" in told
    (alone,) = paper_form.gains(pretrained[:1], plain)
    assert f"{100 * (rates[0][0] - rates[1][0]):+.1f} points (one seed)" in alone
    assert paper_form.gains([], plain) == paper_form.gains(pretrained[:1], plain[1:]) == []


def test_kappa_is_zero_for_a_judge_who_guesses_and_one_for_the_same_judge() -> None:
    """Against counts: kappa is (p - e) / (1 - e), of the table of both judges."""
    generator = torch.Generator().manual_seed(0)
    one = torch.rand(20000, generator=generator) < 0.7
    guess, noise = torch.rand(20000, generator=generator) < 0.7, torch.rand(20000, generator=generator) < 0.1
    assert agreement.kappa(one, one) == 1.0
    assert abs(agreement.kappa(one, guess)) < 0.03
    other = one ^ noise
    table = np.histogram2d(one.numpy().astype(int), other.numpy().astype(int), bins=2)[0] / len(one)
    chance = float((table.sum(1) * table.sum(0)).sum())
    assert agreement.kappa(one, other) == pytest.approx((np.trace(table) - chance) / (1 - chance))
    assert agreement.kappa(torch.ones(4, dtype=torch.bool), torch.ones(4, dtype=torch.bool)) == 1.0


def test_outcomes_are_compared_with_those_of_the_protocol_itself(capsys: pytest.CaptureFixture[str]) -> None:
    agreement.main("--hands gripper3 --objects can --num 3 --protocols carry --workers 1 --json".split())
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["setting"] for row in rows] == ["its own", *agreement.CHANGES]
    assert (rows[0]["same"], rows[0]["kappa"]) == (3, 1.0)
    assert all(abs(row["held"] - rows[0]["held"]) <= 3 - row["same"] for row in rows)


@pytest.mark.slow
def test_the_papers_form_is_trained_and_measured_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = loaded_hand("gripper3")
    monkeypatch.setitem(PRESETS, "paper-slim", dataclasses.replace(TINY, frame="object"))
    grasps = [made_up_grasps(hand, name) for name in SEMIAXES]
    write_bundle(tmp_path / "bundle.safetensors", [hand], {k: ellipsoid(v) for k, v in SEMIAXES.items()}, grasps)
    command = ["--bundle", str(tmp_path / "bundle.safetensors"), "--validation", str(tmp_path / "bundle.safetensors"),
               "--output", str(tmp_path / "out"), "--hands", "gripper3", "--objects", "sphere", "--num", "1", "--steps", "2",
               "--pretraining-steps", "2", "--seeds", "0"]
    for stage in (loop, pretraining):
        monkeypatch.setattr(stage, "recalibrate", lambda *_: None)
    paper_form.main(command)
    told = capsys.readouterr().out
    assert "pretraining adds under strict/1, refined, ranked:" in told
    assert "z carries" in told
    monkeypatch.setattr(paper_form, "train", None)
    monkeypatch.setattr(paper_form, "benchmark", None)
    for weights in (tmp_path / "out").glob("*.safetensors"):
        weights.unlink()  # results alone are enough
    paper_form.main([*command, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert [(r["row"], r["seed"], len(r["rows"])) for name in ("pretrained", "not pretrained") for r in found[name]] == [
        ("pretrained", 0, 3), ("not pretrained", 0, 3)]


def test_grasps_go_to_dexgraspbench_as_its_own_come_from_it(tmp_path: Path) -> None:
    hand = loaded_hand("shadowhand")
    grasps = made_up_grasps(hand, count=3)
    closed = grasps.replace(pregrasp_joints=0.8 * grasps.joints, squeeze_joints=1.1 * grasps.joints)
    back = []
    for i, entry in enumerate(dexgraspbench_official.entries(hand, closed, "some/object", 0.1)):
        np.save(tmp_path / f"{i}.npy", np.array(entry, dtype=object), allow_pickle=True)
        back += read_foreign(tmp_path / f"{i}.npy", "dexgraspbench")
    made = dexgraspbench.as_batch(hand, load_object("sphere"), back)
    assert [grasp.scale for grasp in back] == [0.1] * 3
    assert torch.allclose(made.T_object_wrist, closed.T_object_wrist, atol=1e-6)
    for posture in ("joints", "pregrasp_joints", "squeeze_joints"):
        assert torch.allclose(getattr(made, posture), getattr(closed, posture), atol=1e-6)
