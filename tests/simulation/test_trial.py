from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp.arm.planning.workcell import moved
from dro_grasp.errors import GraspFileError, ObjectError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import ControllerConfig
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import evaluate
from dro_grasp.simulation import rollout as rollouts
from dro_grasp.simulation.grasp_state import grasp_state
from dro_grasp.simulation.outcome import LOST_DISTANCE, Failure
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, protocol
from dro_grasp.simulation.trial import TrialResult, after_closing, record, simulate
from tests.helpers.claw import claw, grasps_of, power_grasp, wrist_below
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.one_object import settle


def same(a: TrialResult, b: TrialResult) -> None:
    for name in ("success", "displacement", "rotation", "closing_shift", "contacts", "penetration"):
        assert torch.equal(getattr(a, name).nan_to_num(-1.0), getattr(b, name).nan_to_num(-1.0)), name
    assert (a.failure, a.reason) == (b.failure, b.reason)


@pytest.mark.parametrize("name", ["dro", "strict", "robust", "dro_static", "dexgraspbench"])
def test_power_grasp_holds_a_ball(hand, obj, name):
    grasps = power_grasp(hand, obj, 3)
    if name == "dro_static":
        # Standing still holds only what it presses on already.
        grasps = settle(hand, obj, grasps)
        squeezed = grasps.joints + torch.tensor([0.0, 0.15] * 4)
        grasps = grasps.replace(joints=squeezed)
    result = simulate(hand, obj, grasps, name)
    assert result.success.all()
    assert result.failure == (None,) * 3
    assert result.reason == ("",) * 3
    assert (result.displacement[:, -1] < 0.02).all()
    assert (result.contacts >= 3).all()
    assert result.protocol == f"{name}/1"


def test_outcomes_do_not_depend_on_where_the_objects_frame_is(hand, obj):
    grasps = power_grasp(hand, obj, 3)
    spread = torch.tensor([[0.0, 0.0, 0.0], [0.012, 0.0, 0.0], [0.0, 0.02, 0.008]])  # the last ones turn the ball, or lose it
    T = grasps.T_object_wrist.clone()
    T[:, :3, 3] += spread
    there = np.eye(4)
    there[:3, 3] = (1.5, -2.0, 0.7)
    far, T_far = moved(obj, there), T.clone()
    T_far[:, :3, 3] += torch.from_numpy(there[:3, 3]).float()
    near, away = (simulate(hand, o, grasps_of(hand, o, pose, grasps.joints), "dro") for o, pose in ((obj, T), (far, T_far)))
    assert near.success.tolist() == away.success.tolist()
    torch.testing.assert_close(near.displacement, away.displacement, atol=5e-5, rtol=0, equal_nan=True)
    torch.testing.assert_close(near.rotation, away.rotation, atol=2e-3, rtol=0, equal_nan=True)
    close, remote = (grasp_state(hand, o, grasps_of(hand, o, pose, grasps.joints))[0] for o, pose in ((obj, T), (far, T_far)))
    torch.testing.assert_close(close.speed, remote.speed, atol=5e-4, rtol=0)


def test_held_grasps_are_where_the_recorded_trial_has_them_after_closing(hand, obj):
    grasps = power_grasp(hand, obj, 2)
    grasps = grasps.with_trial(simulate(hand, obj, grasps))
    closed, rules = after_closing(hand, obj, grasps), protocol(DEFAULT_PROTOCOL)
    assert closed.success.tolist() == grasps.success.tolist()
    assert closed.protocol == grasps.protocol
    assert (closed.joints - grasps.joints).abs().max() > 0.01
    stride = 10
    end = round(rules.closing_time / rules.timestep) // stride
    for i in range(2):
        poses, joints = record(hand, obj, grasps, i, stride=stride)
        torch.testing.assert_close(closed.joints[i], joints[end], atol=1e-5, rtol=0)
        torch.testing.assert_close(closed.T_object_wrist[i], torch.linalg.inv(poses[end]), atol=1e-5, rtol=0)
    assert len(after_closing(hand, obj, grasps[:0])) == 0


def test_a_grasp_that_throws_the_object_away_is_not_drawn_without_it(hand, obj):
    wild = replace(protocol("dro"), name="wild", stiffness=3e4, damping=0.0, force_limit=1e4)
    grasps = power_grasp(hand, obj, 2)
    assert simulate(hand, obj, grasps, wild).closing_shift.nan_to_num(math.inf).min() > LOST_DISTANCE
    assert torch.equal(after_closing(hand, obj, grasps, wild).joints, grasps.joints)


def test_hand_30_cm_away_scores_nothing(hand, obj):
    result = simulate(hand, obj, grasps_of(hand, obj, wrist_below(0.3, 2), torch.zeros(2, 8)), "dro")
    assert not result.success.any()
    assert result.failure == (Failure.NO_CONTACT,) * 2
    assert result.reason == ("no contact after closing",) * 2
    assert result.contacts.tolist() == [0, 0]


def test_a_free_object_falls_by_half_a_t_squared(hand, obj):
    """Under force F for t seconds an object of mass m moves F t^2 / 2m, here in the object's own frame."""
    rules = replace(protocol("dro"), force=0.16)
    T = wrist_below(0.6)
    T[0, :3, :3] = torch.tensor([[0.0, -1, 0], [0.6, 0, -0.8], [0.8, 0, 0.6]])
    result = simulate(hand, obj, grasps_of(hand, obj, T, torch.zeros(1, 8)), rules)
    # Semi-implicit steps add a t dt / 2.
    expected = 0.5 * 0.16 * 1.0 * (1 + rules.timestep)
    assert result.displacement[0, 0] == pytest.approx(expected, rel=1e-3)
    # It then coasts at a t while pushed along +y: a t^2 to the side of the 3/2 a t^2 forwards.
    assert result.displacement[0, 1] == pytest.approx(0.16 * math.hypot(1.5, 0.5), rel=1e-2)
    assert torch.equal(result.displacement[0, 2:], result.displacement[0, 1].expand(4))  # given up
    poses, _ = record(hand, obj, grasps_of(hand, obj, T, torch.zeros(1, 8)), 0, rules, stride=200)
    moved = T[0, :3, :3] @ (poses[2, :3, 3] - poses[1, :3, 3])
    np.testing.assert_allclose(moved, [expected, 0, 0], atol=1e-5)


def test_dexgraspbench_pushes_each_way_anew(hand, obj):
    """Every force moves a free object by F t^2 / 2m from where it was, whatever the object's own mass."""
    rules = replace(protocol("dexgraspbench"), force=0.02)
    result = simulate(hand, obj, grasps_of(hand, obj, wrist_below(0.6), torch.zeros(1, 8)), rules)
    expected = 0.5 * 0.02 * rules.force_time**2 * (1 + rules.timestep / rules.force_time)
    torch.testing.assert_close(result.displacement[0], torch.full((6,), expected), rtol=1e-3, atol=0)
    assert result.success.tolist() == [True]  # 4 cm are less than 5
    lost = simulate(hand, obj, grasps_of(hand, obj, wrist_below(0.6), torch.zeros(1, 8)), "dexgraspbench")
    assert lost.reason == ("no contact after closing",)


def test_dexgraspbench_limits_rotation_and_the_worst_of_all_forces(hand, obj):
    grasps = power_grasp(hand, obj, 2)
    rules = protocol("dexgraspbench")
    turned = simulate(hand, obj, grasps, rules).rotation.amax(1)
    one_of_six = replace(rules, max_rotation=float(turned.max()) * 0.99)
    again = simulate(hand, obj, grasps, one_of_six)
    assert again.success.tolist() == (turned < one_of_six.max_rotation).tolist()
    most = int(turned.argmax())
    assert again.failure[most] is Failure.TURNED
    assert again.reason[most] == f"turned by {math.degrees(turned[most]):.0f} degrees"


def test_a_gradual_protocol_leads_the_hand_through_the_grasp(hand, obj):
    grasps = grasps_of(hand, obj, wrist_below(0.6), torch.full((1, 8), 0.1)).replace(
        pregrasp_joints=torch.zeros(1, 8), squeeze_joints=torch.full((1, 8), 0.2))
    _, joints = record(hand, obj, grasps, 0, "dexgraspbench", stride=10)
    assert joints[0] == pytest.approx(torch.zeros(8))
    assert float(joints[10].mean()) == pytest.approx(0.1, abs=0.02)
    assert float(joints[20].mean()) == pytest.approx(0.2, abs=0.03)


def test_one_finger_pushes_the_object_away(hand, obj):
    joints = torch.tensor([[0.0, 0.0] + [-0.5, 0.0] * 3])
    grasps = grasps_of(hand, obj, wrist_below(0.045), joints)
    target = joints.clone()
    target[0, :2] = torch.tensor([1.4, 0.0])
    grasps = grasps.replace(pregrasp_joints=joints, squeeze_joints=target)
    result = simulate(hand, obj, grasps, "strict")
    assert result.failure == (Failure.PUSHED_AWAY,)
    assert result.reason == ("object pushed away while closing",)
    assert result.displacement.isnan().all()
    # The other fingers stop it: what `dro` asks for is met.
    lenient = simulate(hand, obj, grasps, "dro")
    assert lenient.closing_shift[0] > 0.02
    assert lenient.success.all()


def test_strict_refuses_what_penetrates(hand, obj):
    deep = grasps_of(hand, obj, wrist_below(0.031), torch.tensor([[0.0, 0.6] * 4]))
    crossed = grasps_of(hand, obj, wrist_below(0.3), torch.tensor([[1.3, 1.0] * 4]))
    result = simulate(hand, obj, GraspBatch.concatenate([deep, crossed]), "strict")
    assert result.failure == (Failure.PENETRATION, Failure.SELF_PENETRATION)
    assert result.reason[0] == f"hand penetrates object by {result.penetration[0] * 1e3:.0f} mm"
    assert result.reason[1] == f"hand penetrates itself by {result.self_penetration[1] * 1e3:.0f} mm"


def test_an_unstable_trial_fails(hand, obj, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    wild = replace(protocol("dro"), stiffness=1e9, damping=0.0, force_limit=1e15, armature=1e-9)
    result = simulate(hand, obj, power_grasp(hand, obj, 2), wild)
    assert not result.success.any()
    assert result.failure == (Failure.UNSTABLE,) * 2
    assert result.reason == ("simulation unstable",) * 2
    assert result.displacement.isnan().all()
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


def test_weak_fingers_lose_a_pulled_ball(hand, obj):
    weak = replace(protocol("dro"), force_limit=0.005, force=20.0)
    grasps = settle(hand, obj, power_grasp(hand, obj))
    result = simulate(hand, obj, grasps.replace(pregrasp_joints=grasps.joints), weak)
    assert result.contacts[0] > 0
    assert result.failure == (Failure.LOST,)
    assert result.reason == ("lost under force +x",)
    slipping = replace(protocol("dro"), max_displacement=1e-9)
    slipped = simulate(hand, obj, grasps, slipping)
    assert slipped.failure == (Failure.SLIPPED,)
    assert slipped.reason == (f"slipped by {slipped.displacement[0, -1] * 1e3:.0f} mm",)


def test_result_depends_neither_on_workers_nor_on_company(hand, obj, monkeypatch):
    grasps = power_grasp(hand, obj, 5)
    first = simulate(hand, obj, grasps, "dro", workers=1)
    same(first, simulate(hand, obj, grasps, "dro", workers=3))
    same(first, simulate(hand, obj, grasps, "dro", workers=1))
    monkeypatch.setattr(rollouts, "CHUNK", 2)
    same(first, simulate(hand, obj, grasps, "dro", workers=2))


def test_stated_joints_come_before_the_controller_s(hand, obj):
    grasps = power_grasp(hand, obj)
    held = grasps.replace(pregrasp_joints=grasps.joints, squeeze_joints=grasps.joints)
    still = replace(protocol("dro"), controller=ControllerConfig(outer=0.0, inner=0.0))
    same(simulate(hand, obj, held, "dro"), simulate(hand, obj, grasps, still))
    unopened = replace(protocol("dro"), controller=ControllerConfig(outer=0.0))
    same(simulate(hand, obj, held.without("squeeze_joints"), "dro"), simulate(hand, obj, grasps, unopened))


@pytest.mark.parametrize("name", ["dro", "dexgraspbench"])
def test_the_controller_fills_single_rows(hand, obj, name):
    """A file without pregrasps joined with one that states them gives the verdicts of each alone."""
    bare = power_grasp(hand, obj, 2)
    stated = bare.replace(pregrasp_joints=bare.joints - 0.02, squeeze_joints=bare.joints + 0.1)
    joined = simulate(hand, obj, GraspBatch.concatenate([bare, stated]), name)
    same(joined.rows(torch.arange(2)), simulate(hand, obj, bare, name))
    same(joined.rows(torch.arange(2, 4)), simulate(hand, obj, stated, name))
    assert joined.success.all()


def test_settled_labels_touch_without_penetrating(hand, obj):
    loose = power_grasp(hand, obj, 2).replace(joints=torch.tensor([[0.0, 0.4] * 4, [0.05, 0.7] * 4]))
    known = loose.replace(score=torch.ones(2), energy=torch.ones(2), extra={"depth": torch.ones(2)})
    settled = settle(hand, obj, known.with_trial(simulate(hand, obj, loose, "dro")))
    for gone in (settled.squeeze_joints, settled.score, settled.displacement):
        assert gone.isnan().all()
    assert not settled.evaluated.any()
    assert settled.energy.tolist() == settled.extra["depth"].tolist() == [1, 1], "those before settling"
    assert (settled.joints >= hand.tree.lower).all()
    distance = hand.points(settled.joints, settled.T_object_wrist).norm(dim=-1) - 0.03
    # Contacts are soft: the squeeze presses fingers into so light a ball by millimetres.
    assert (distance.amin(1).abs() < protocol("strict").max_penetration).all()
    assert simulate(hand, obj, settled, "strict").success.all()


@pytest.mark.parametrize("stride", [20, 200, 37])
@pytest.mark.parametrize("name", ["dro", "dexgraspbench"])
def test_the_recorded_run_is_the_judged_one(hand, obj, name, stride):
    """Same motion to the last bit, however often a frame is taken, also where frames do not divide the phases."""
    grasps = power_grasp(hand, obj, 2)
    judged, rules = simulate(hand, obj, grasps, name), protocol(name)
    poses, joints = record(hand, obj, grasps, 1, name, stride=stride)
    phases = [10] * 20 if rules.gradual else [200]
    frames = 1 + sum(math.ceil(steps / stride) for steps in phases)
    each = math.ceil(round(rules.force_time / rules.timestep) / stride)
    assert joints.shape == (frames + 6 * each, 8)
    torch.testing.assert_close(poses[0], torch.linalg.inv(grasps.T_object_wrist[1]), atol=1e-6, rtol=0)
    origin = poses[0 if rules.reset else frames - 1, :3, 3]
    ends = (poses[frames - 1 + each :: each, :3, 3] - origin).norm(dim=-1)
    torch.testing.assert_close(ends, judged.displacement[1], atol=1e-7, rtol=0)  # frames are float32
    assert len(ends) == 6


def test_a_record_ends_where_the_trial_ends(hand, obj):
    away = grasps_of(hand, obj, wrist_below(0.6), torch.zeros(1, 8))
    assert len(record(hand, obj, away, 0, "dexgraspbench", stride=500)[0]) == 1 + 20 + 1  # lost under the first force
    deep = grasps_of(hand, obj, wrist_below(0.031), torch.tensor([[0.0, 0.6] * 4]))
    assert len(record(hand, obj, deep, 0, "strict", stride=200)[0]) == 2  # no forces


def test_outcome_in_a_batch_and_its_file(hand, obj, tmp_path):
    grasps = GraspBatch.concatenate([power_grasp(hand, obj), grasps_of(hand, obj, wrist_below(0.3), torch.zeros(1, 8))])
    tried = grasps.with_trial(simulate(hand, obj, grasps, "dro"))
    tried.save(tmp_path / "tried.parquet")
    loaded = GraspBatch.load(tmp_path / "tried.parquet")
    assert loaded.success.tolist() == [True, False]
    assert loaded.protocol == ("dro/1", "dro/1")
    assert list(loaded.extra["reason"]) == ["", "no contact after closing"]
    assert list(loaded.extra["failure"]) == [None, "NO_CONTACT"]
    assert len(loaded.extra["contact_links"][0]) >= 3
    assert set(loaded.extra["contact_links"][0]) <= set(hand.tree.link_names)
    assert loaded.extra["contact_links"][1] == []


def test_progress_and_empty_batches(hand, obj, monkeypatch):
    monkeypatch.setattr(rollouts, "CHUNK", 2)
    seen: list[tuple[int, int]] = []
    simulate(hand, obj, power_grasp(hand, obj, 3), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(2, 3), (3, 3)]
    nothing = power_grasp(hand, obj)[torch.zeros(1, dtype=torch.bool)]
    assert len(simulate(hand, obj, nothing).success) == 0
    assert len(settle(hand, obj, nothing)) == 0


def test_grasps_of_another_hand_are_refused(hand, obj, tmp_path):
    other = claw(tmp_path, fingers=3)
    with pytest.raises(GraspFileError, match="Load the hand that the grasps name"):
        simulate(other, obj, power_grasp(hand, obj))


@pytest.mark.assets
@pytest.mark.parametrize("name", ["barrett_multidex", "allegro_left", "shadowhand"])
def test_synthesized_grasps_of_the_paper_hands_hold(name: str, assets_folder: Path):
    from dro_grasp.objects.catalogue import load_object
    from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize

    hand, can = loaded_hand(f"assets/{name}"), load_object("can")
    grasps = synthesize(hand, can, 48, config=SynthesisConfig(steps=100))[0:16]
    result = simulate(hand, can, grasps, "dro")
    assert result.success.float().mean() >= 0.5, Counter(result.reason)
    T = grasps.T_object_wrist.clone()
    T[:, :3, 3] += 0.3 * T[:, :3, 3] / T[:, :3, 3].norm(dim=-1, keepdim=True)
    assert not simulate(hand, can, grasps.replace(T_object_wrist=T), "dro").success.any()


def test_another_object_than_theirs_is_refused_unless_it_is_meant(hand: Hand, obj: ObjectModel) -> None:
    other = replace(obj, name="other", sha256="0" * 64)
    grasps = GraspBatch.create(hand, other, torch.eye(4)[None], hand.canonical_joints()[None])
    for rules in ("dro", "strict"):
        with pytest.raises(ObjectError, match=rf"are for object 'other', and '{obj.name}' is another one.*another=True"):
            simulate(hand, obj, grasps, rules)
        with pytest.raises(ObjectError, match="another one"):
            evaluate(GraspProblem(hand, obj), grasps, rules)
    assert len(simulate(hand, obj, grasps, "dro", another=True).success) == 1
    renamed, changed = replace(obj, name="renamed"), replace(obj, sha256="1" * 64)
    for same in (renamed, changed):
        own = GraspBatch.create(hand, same, torch.eye(4)[None], hand.canonical_joints()[None])
        assert len(simulate(hand, obj, own, "dro").success) == 1
