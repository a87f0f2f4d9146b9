"""Trials under other conditions, against scenes that are compiled with them, statics by hand, and single trials."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation import rollout as rollouts, trial as trials
from dro_grasp.simulation.conditions import Conditions, draw
from dro_grasp.simulation.contacts import count_fingers, measure_penetration
from dro_grasp.simulation.outcome import Failure, TrialResult, verdict
from dro_grasp.simulation.protocols import Perturbations, Protocol, protocol
from dro_grasp.simulation.rollout import Rollout
from dro_grasp.simulation.scene import cached_scene
from dro_grasp.simulation.trial import record, simulate
from tests.helpers.claw import JAWS, grasps_of, power_grasp, wrist_below

ROBUST = protocol("robust").perturbations
NUMBERS = ("success", "displacement", "rotation", "closing_shift", "closing_rotation", "penetration", "fingers_in_contact")


def perturbed(name: str = "strict", **changes: object) -> Protocol:
    return replace(protocol(name), perturbations=Perturbations(trials=8, needed=8, **changes))  # type: ignore[arg-type]


def varied(hand: Hand, obj: ObjectModel) -> GraspBatch:
    """Grasps that hold, a finger that pushes the object away, and hands that penetrate object or themselves."""
    poke = torch.tensor([[0.0, 0.0] + [-0.5, 0.0] * 3])
    target = poke.clone()
    target[0, :2] = torch.tensor([1.4, 0.0])
    return GraspBatch.concatenate([
        power_grasp(hand, obj, 2),
        grasps_of(hand, obj, wrist_below(0.031), torch.tensor([[0.0, 0.6] * 4])),
        grasps_of(hand, obj, wrist_below(0.045), poke).replace(pregrasp_joints=poke, squeeze_joints=target),
        grasps_of(hand, obj, wrist_below(0.3), torch.tensor([[1.3, 1.0] * 4])),
        grasps_of(hand, obj, wrist_below(0.3), torch.zeros(1, 8)),
    ])


def same(a: TrialResult, b: TrialResult, names: tuple[str, ...] = (*NUMBERS, "robustness", "shown")) -> None:
    for name in names:
        x, y = getattr(a, name).float(), getattr(b, name).float()
        assert torch.equal(x.nan_to_num(-1.0), y.nan_to_num(-1.0)), name
    assert a.failure == b.failure


def test_without_perturbation_all_trials_are_the_protocol_s(hand, obj):
    grasps = varied(hand, obj)
    single, repeated = simulate(hand, obj, grasps, "strict"), simulate(hand, obj, grasps, perturbed())
    same(single, repeated, NUMBERS)
    assert repeated.success.tolist() == [True, True, False, False, False, False]
    assert repeated.robustness.tolist() == [1, 1, 0, 0, 0, 0]
    assert repeated.shown.tolist() == [0] * 6
    assert single.robustness.isnan().all()
    assert repeated.reason[3] == "object pushed away while closing; held in 0 of 8 trials"


def test_conditions_in_a_shared_scene_are_those_of_a_scene_compiled_with_them(hand, obj):
    """All draws are of one value, so each further trial is a single trial with these numbers in its protocol."""
    strict = protocol("strict")
    compiled = replace(
        strict, friction=0.5 * strict.friction, torsional_friction=0.5 * strict.torsional_friction, mass_factor=1.7,
        stiffness=1.3 * strict.stiffness, damping=1.3 * strict.damping)
    rules = perturbed(friction=(0.5, 0.5), mass=(1.7, 1.7), gain=(1.3, 1.3))
    grasps = varied(hand, obj)[[0, 1, 3]]
    alone = simulate(hand, obj, grasps, compiled)
    assert not torch.equal(alone.displacement, simulate(hand, obj, grasps, "strict").displacement)
    scene = cached_scene(hand, obj, rules)
    closing = complete(hand, grasps, torch.zeros(3), rules.controller)
    conditions = draw(rules.perturbations, grasps).rows(slice(3 * len(grasps), 4 * len(grasps)))
    shared = trials.run_trial(Rollout(scene, closing, 1, conditions=conditions), measure_penetration(scene, grasps))
    torch.testing.assert_close(shared.displacement, alone.displacement, atol=1e-8, rtol=1e-5, equal_nan=True)
    torch.testing.assert_close(shared.rotation, alone.rotation, atol=1e-6, rtol=1e-5, equal_nan=True)
    torch.testing.assert_close(shared.closing_shift, alone.closing_shift, atol=1e-8, rtol=1e-5)


@pytest.fixture(scope="module")
def vice(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    file = tmp_path_factory.mktemp("vice") / "vice.xml"
    file.write_text(JAWS)
    return load_hand(file)


@pytest.mark.parametrize(("name", "holds", "slips"), [("friction", 0.8, 0.4), ("gain", 0.8, 0.4), ("mass", 1.25, 2.5)])
def test_a_vice_slips_where_its_friction_is_less_than_the_push(vice, name, holds, slips):
    """Two jaws that press with N hold a push F along them up to F = 2 mu N; here the factors' limit is 0.63, or 1/0.63."""
    import trimesh

    box = trimesh.creation.box((0.04, 0.04, 0.04))
    part = np.asarray(box.vertices), np.asarray(box.faces)
    cloud = np.asarray(box.vertices, np.float32)
    block = ObjectModel(
        "block", cloud, cloud / np.linalg.norm(cloud, axis=1, keepdims=True), np.zeros(3), "block", *part, 0.04**3,
        np.eye(3) * 0.04**5 / 6, exact_parts=(part,))
    per_metre, mass, beyond = 100.0, 0.3, 0.01
    press = per_metre * beyond
    rules = replace(
        protocol("dro"), mass=mass, force=0.63 * 2 * press / mass, stiffness=per_metre * 0.03**2, damping=10 * 0.03**2,
        torsional_friction=0.0, max_displacement=0.015)
    closed = torch.zeros(1, 2)
    grasps = grasps_of(vice, block, torch.eye(4)[None], closed)
    grasps = grasps.replace(pregrasp_joints=closed, squeeze_joints=closed + beyond)
    for factor, expected in ((holds, 1.0), (slips, 1 / 8)):
        asked = Perturbations(trials=8, needed=6, **{name: (factor, factor)})
        result = simulate(vice, block, grasps, replace(rules, perturbations=asked))
        assert result.robustness.tolist() == [expected], result.reason
        assert result.success.tolist() == [expected == 1]
    assert result.failure == (Failure.LOST,)
    assert result.shown.tolist() == [1]
    assert result.reason[0].startswith("lost under force")
    assert result.reason[0].endswith("; held in 1 of 8 trials")


def some_grasps(hand: Hand, obj: ObjectModel, n: int) -> GraspBatch:
    generator = torch.Generator().manual_seed(3)
    T = wrist_below(0.042, n)
    T[:, :3, 3] += 0.01 * torch.randn(n, 3, generator=generator)
    return grasps_of(hand, obj, T, torch.rand(n, 8, generator=generator))


def test_draws_lie_in_their_ranges_evenly(hand, obj):
    n, k = 200, ROBUST.trials - 1
    drawn = draw(ROBUST, some_grasps(hand, obj, n))
    for name in ("friction", "mass", "gain"):
        low, high = getattr(ROBUST, name)
        share = np.log(getattr(drawn, name).reshape(k, n) / low) / math.log(high / low)
        assert ((share >= 0) & (share <= 1)).all()
        # Each grasp has one value in every seventh of the range; which trial gets which is random.
        np.testing.assert_array_equal(np.sort((share * k).astype(int), 0), np.arange(k)[:, None].repeat(n, 1))
        np.testing.assert_allclose(share.mean(1), 0.5, atol=4 * math.sqrt(1 / 12 / n))
    assert abs(np.corrcoef(drawn.friction, drawn.mass)[0, 1]) < 4 / math.sqrt(k * n)
    for name in ("shift", "turn"):
        values = getattr(drawn, name)
        np.testing.assert_allclose(np.linalg.norm(values, axis=1), getattr(ROBUST, name))
        np.testing.assert_allclose(values.mean(0), 0, atol=4 * getattr(ROBUST, name) / math.sqrt(3 * k * n))


def test_draws_belong_to_the_grasp_alone(hand, obj, tmp_path):
    grasps = some_grasps(hand, obj, 6)
    drawn = draw(ROBUST, grasps)
    grasps.save(tmp_path / "grasps.parquet")
    back = GraspBatch.load(tmp_path / "grasps.parquet")[[4, 2]]
    again = draw(ROBUST, back)
    for name in ("shift", "friction", "mass", "gain"):
        values = getattr(drawn, name).reshape(7, 6, -1)
        np.testing.assert_array_equal(getattr(again, name).reshape(7, 2, -1), values[:, [4, 2]])
        assert not np.allclose(values[:, 0], values[:, 1])
    # Another machine rounds the last bits otherwise.
    near = draw(ROBUST, grasps.replace(joints=grasps.joints + 1e-7, T_object_wrist=grasps.T_object_wrist * (1 + 1e-7)))
    np.testing.assert_array_equal(near.mass, drawn.mass)


def test_a_displaced_object_is_moved_and_turned_about_its_centre_of_mass(hand, obj):
    grasps, centre = some_grasps(hand, obj, 3), np.array([0.01, -0.02, 0.03])
    generator = np.random.default_rng(0)
    shift, turn = generator.normal(size=(2, 3, 3))
    one = np.ones(3)
    moved = Conditions(shift, turn, one, one, one).displaced(grasps, centre)
    point = generator.normal(size=3)
    for i in range(3):
        before, after = (torch.linalg.inv(g.T_object_wrist[i].double()).numpy() for g in (grasps, moved))
        there = Rotation.from_rotvec(turn[i]).apply(point - centre) + centre + shift[i]
        expected = before[:3, :3] @ there + before[:3, 3]
        np.testing.assert_allclose(after[:3, :3] @ point + after[:3, 3], expected, atol=1e-6)
    assert torch.equal(moved.joints, grasps.joints)


def test_result_depends_neither_on_workers_nor_on_company(hand, obj, monkeypatch):
    grasps = GraspBatch.concatenate([varied(hand, obj), power_grasp(hand, obj, 3)[2]])
    first = simulate(hand, obj, grasps, "robust", workers=1)
    assert first.protocol == "robust/1"
    assert 0 < int(first.success.sum()) < len(grasps)
    same(first, simulate(hand, obj, grasps, "robust", workers=2))
    monkeypatch.setattr(rollouts, "CHUNK", 2)
    order = torch.tensor([5, 0, 6, 3, 1])
    same(first.rows(order), simulate(hand, obj, grasps[order], "robust", workers=2))


def test_the_verdict_of_several_trials(hand, obj):
    """Two grasps, four trials each, of which three are needed."""
    names = [(True, True), (False, True), (True, False), (True, False)]
    grasps = varied(hand, obj)[[0, 3]]
    single = simulate(hand, obj, grasps, "strict")
    rounds = []
    for i, held in enumerate(names):
        reason = tuple("" if h else f"slipped by {i} mm" for h in held)
        failure = tuple(None if h else Failure.SLIPPED for h in held)
        rounds.append(replace(single, success=torch.tensor(held), closing_shift=torch.full((2,), float(i)), reason=reason,
                              failure=failure))
    result = verdict(TrialResult.join(rounds, "mine/1"), count=4, needed=3)
    assert result.success.tolist() == [True, False]
    assert result.robustness.tolist() == [0.75, 0.5]
    assert result.shown.tolist() == [0, 2]
    assert result.closing_shift.tolist() == [0.0, 2.0]
    assert result.reason == ("", "slipped by 2 mm; held in 2 of 4 trials")
    assert result.failure == (None, Failure.SLIPPED)


def test_the_record_is_of_the_trial_that_is_shown(hand, obj):
    """One finger pushes the ball away as the protocol says, but not wherever the ball stands: one such trial is enough."""
    rules = replace(protocol("robust"), perturbations=replace(ROBUST, needed=1))
    grasps = varied(hand, obj)[[3, 0]]
    result = simulate(hand, obj, grasps, rules)
    assert not simulate(hand, obj, grasps, "strict").success[0]
    assert result.success.all()
    assert result.shown[0] > 0
    assert result.shown[1] == 0
    for index, shift in ((0, ROBUST.shift), (1, 0.0)):
        poses, _ = record(hand, obj, grasps, index, rules, stride=200)
        expected = torch.linalg.inv(grasps.T_object_wrist[index])
        assert float((poses[0, :3, 3] - expected[:3, 3]).norm()) == pytest.approx(shift, abs=1e-6)
        moved = (poses[2:, :3, 3] - poses[1, :3, 3]).norm(dim=-1)
        torch.testing.assert_close(moved, result.displacement[index], atol=1e-6, rtol=0)


def test_fingers_in_contact_are_those_that_own_a_contact_link(hand, obj):
    links = [[], ["palm"], ["distal0", "palm", "proximal0"], ["distal3", "proximal1"]]
    assert count_fingers(hand, links).tolist() == [0, 0, 1, 2]
    result = simulate(hand, obj, varied(hand, obj), "dro")
    expected = [len({name[-1] for name in links if name != "palm"}) for links in result.contact_links]
    assert result.fingers_in_contact.tolist() == expected
    assert {0, 2} <= set(expected)


def test_outcome_in_a_file_and_files_without_it(hand, obj, tmp_path):
    grasps = varied(hand, obj)[[0, 2, 5]]
    tried = grasps.with_trial(simulate(hand, obj, grasps, "robust"))
    tried.save(tmp_path / "tried.parquet")
    loaded = GraspBatch.load(tmp_path / "tried.parquet")
    assert torch.equal(loaded.robustness, tried.robustness)
    assert loaded.protocol == ("robust/1",) * 3
    assert loaded.fingers_in_contact.tolist() == tried.fingers_in_contact.tolist() == [2, 2, 0]
    single = grasps.with_trial(simulate(hand, obj, grasps, "strict"))
    assert single.robustness.isnan().all()
    assert single.fingers_in_contact.tolist() == [2, 2, 0]
    assert single.without_trial().fingers_in_contact.isnan().all()
    import pyarrow.parquet as pq

    old = pq.read_table(tmp_path / "tried.parquet").drop_columns(["robustness", "fingers_in_contact"])
    pq.write_table(old, tmp_path / "old.parquet")
    before = GraspBatch.load(tmp_path / "old.parquet")
    assert before.robustness.isnan().all()
    assert before.fingers_in_contact.isnan().all()
    assert before.success.tolist() == tried.success.tolist()


@pytest.mark.parametrize("wrong", [
    {"trials": 0}, {"trials": 2, "needed": 3}, {"trials": 2, "coarse": 2}, {"friction": (0.0, 1.0)}, {"mass": (2.0, 1.0)}])
def test_impossible_perturbations_are_refused(wrong):
    with pytest.raises(OptionError):
        Perturbations(**wrong)


@pytest.mark.assets
def test_stored_grasps_hold_mostly_but_not_always(assets_folder: Path):
    from dro_grasp.grasps.sources import hand_of, object_of

    stored = GraspBatch.load(Path(__file__).parents[2] / "data/grasps/assets-barrett_multidex.parquet")
    grasps = next(batch for name, batch in stored.by_object() if name == "contactdb+apple")[:8]
    result = simulate(hand_of(grasps, None), object_of(grasps, None, 1.0), grasps, "robust")
    assert 0.5 < float(result.robustness.mean()) < 1, Counter(result.reason)
