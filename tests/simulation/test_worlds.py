"""Worlds on a device: what goes there and comes back, with MuJoCo in Warp's place; and Warp itself on the processor."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp import extras
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import TABLE
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.predict import settling
from dro_grasp.simulation import rollout as rollout_module, trial as trial_module, warp_worlds, worlds as worlds_module
from dro_grasp.simulation.grasp_state import WeightConfig, grasp_state, pressed_many, squeezes_of, unanswered
from dro_grasp.simulation.joint_model import joint_model
from dro_grasp.simulation.outcome import TrialResult
from dro_grasp.simulation.payload import PayloadConfig, given_way, payloads
from dro_grasp.simulation.pressure import contact_forces
from dro_grasp.simulation.protocols import CARRY, PROTOCOLS, Perturbations, Protocol, protocol
from dro_grasp.simulation.rollout import Rollout
from dro_grasp.simulation.scene import cached_scene
from dro_grasp.simulation.trial import simulate
from dro_grasp.simulation.warp_worlds import Room
from dro_grasp.simulation.worlds import STATE, WARP
from dro_grasp.training.data.engine import worker
from dro_grasp.training.data.engine.worker import EngineConfig, Wanted
from tests.helpers.claw import grasps_of, power_grasp, wrist_below
from tests.helpers.fake_device import fake_device
from tests.helpers.one_object import settle, weigh
from tests.helpers.steady_grasps import steady_grasps
from tests.helpers.warp_steps import State, Steps


@pytest.fixture(scope="module")
def grasps(hand: Hand, obj: ObjectModel) -> GraspBatch:
    """Grasps that hold, and one that does not."""
    made = GraspBatch.concatenate([
        power_grasp(hand, obj, 3), grasps_of(hand, obj, wrist_below(0.3), torch.tensor([[0.0, 0.6] * 4]))])
    return complete(hand, made, torch.as_tensor(obj.centre_of_mass))


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Steps]:
    pytest.importorskip("mujoco_warp")

    def install(*change: Callable[[State, np.ndarray], None]) -> Steps:
        made = Steps(*change)
        monkeypatch.setattr(warp_worlds, "_graphs", made)
        monkeypatch.setattr(rollout_module, "FEW", 0)
        return made

    return install


def same(a: TrialResult, b: TrialResult) -> None:
    for name in ("success", "displacement", "rotation", "closing_shift", "closing_rotation", "robustness"):
        x, y = getattr(a, name).float(), getattr(b, name).float()
        assert torch.equal(x.nan_to_num(-1.0), y.nan_to_num(-1.0)), name
    assert a.failure == b.failure


ROBUST = replace(protocol("robust"), perturbations=Perturbations(
    trials=4, needed=2, shift=0.003, friction=(0.5, 2.0), mass=(0.5, 2.0), gain=(0.5, 2.0)))
COARSE = replace(ROBUST, perturbations=replace(ROBUST.perturbations, coarse=3))


@pytest.mark.parametrize("rules", [*(protocol(name) for name in PROTOCOLS if name != "robust"), ROBUST, COARSE], ids=[
    *(name for name in PROTOCOLS if name != "robust"), "robust", "coarse"])
def test_trials_see_the_same_state_forces_masses_friction_and_gains_on_a_device(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, steps: Callable[..., Steps], rules: Protocol
) -> None:
    made = steps()
    found = simulate(hand, obj, grasps, rules, device="cuda", confirm=False)
    same(found, simulate(hand, obj, grasps, rules))
    assert made.calls
    assert len({joint.scenes for joint in made.joints}) == (2 if rules is COARSE else 1)
    assert rules is not ROBUST or {"geom_friction", "body_mass", "actuator_gainprm"} <= set(made.fields)


def test_a_table_is_there_on_a_device(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, steps: Callable[..., Steps]
) -> None:
    steps()
    assert obj.vertices is not None
    plane = torch.tensor([[0.0, 0.0, 1.0, float(obj.vertices[:, 2].min())]])
    laid = grasps.replace(extra={**grasps.extra, TABLE: plane.repeat(len(grasps), 1)})
    found = simulate(hand, obj, laid, device="cuda", confirm=False)
    same(found, simulate(hand, obj, laid))
    assert not torch.equal(found.closing_shift, simulate(hand, obj, grasps).closing_shift)


def test_settling_and_the_state_of_grasps_are_the_same_on_a_device(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, steps: Callable[..., Steps]
) -> None:
    steps()
    assert torch.equal(settle(hand, obj, grasps, device="cuda").joints, settle(hand, obj, grasps).joints)
    config = WeightConfig(max_force=4.0)
    a, b = (grasp_state(hand, obj, grasps, config=config, device=device)[0] for device in (WARP, "cpu"))
    assert torch.equal(a.gave, b.gave)
    assert bool(a.gave.isfinite().all())
    assert torch.equal(a.unanswered, b.unanswered)


def test_worlds_without_room_run_on_the_processor_and_the_others_stay_what_they_are(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, steps: Callable[..., Steps]
) -> None:
    def nonsense(state: State, missed: np.ndarray) -> None:
        missed[::2] = True
        state["qpos"][missed] += 1.0

    steps(nonsense)
    same(simulate(hand, obj, grasps, CARRY, device="cuda", confirm=False), simulate(hand, obj, grasps, CARRY))


@pytest.mark.parametrize("rules", [CARRY, protocol("dexgraspbench"), protocol("strict")], ids=lambda rules: rules.name)
def test_fewer_grasps_than_threads_are_pulled_in_all_directions_at_once_with_the_same_outcome(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, rules: Protocol
) -> None:
    same(simulate(hand, obj, grasps, rules, workers=9), simulate(hand, obj, grasps, rules, workers=1))
    known = grasps.replace(payload=torch.full((len(grasps),), 0.4))
    found = [weigh(hand, obj, known, rules, workers=workers) for workers in (9, 1)]
    assert torch.equal(*found)
    assert float(found[0].max()) > 0
    assert Rollout(cached_scene(hand, obj, rules), grasps, 9).spreads
    assert not Rollout(cached_scene(hand, obj, rules), grasps, len(grasps)).spreads
    assert not Rollout(cached_scene(hand, obj, rules), grasps, 9, stride=10).spreads


@pytest.mark.parametrize("rules", [CARRY, protocol("dexgraspbench"), protocol("strict")], ids=lambda rules: rules.name)
def test_a_grasp_that_fails_as_it_closes_is_judged_where_there_are_more_threads_than_grasps(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, rules: Protocol
) -> None:
    """Then no force is left to try, in any direction."""
    deep = grasps[0].replace(T_object_wrist=grasps[0].T_object_wrist + torch.tensor([0.0, 0.0, 0.03, 0.0])[:, None])
    found = [simulate(hand, obj, deep, rules, workers=workers) for workers in (9, 1)]
    same(*found)
    assert found[0].failure[0] is not None
    assert bool(found[0].displacement.isnan().all())
    heavy = grasps[0].replace(payload=torch.tensor([1e-3]))  # what is held after it is known to be
    assert torch.equal(*(weigh(hand, obj, heavy, rules, workers=workers) for workers in (9, 1)))


def test_rows_that_do_not_step_stay_as_they_are_and_what_exploded_steps_no_more(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, steps: Callable[..., Steps]
) -> None:
    def explode(state: State, missed: np.ndarray) -> None:
        state["qvel"][1] = np.nan if len(made.calls) == 1 else state["qvel"][1]

    made = steps(explode)
    rollout = Rollout(cached_scene(hand, obj, CARRY), grasps, 1, device="cuda")
    before = rollout.moment()
    rollout.pull(np.array([0, 2]), np.ones((2, 3)), 0.05)
    assert rollout.batch.unsound.tolist() == [False, False, True, False]
    after = rollout.moment()
    for name in STATE:
        np.testing.assert_array_equal(after[name][[1, 3]], before[name][[1, 3]])
        assert (after[name][0] != before[name][0]).any()
    closed = rollout.close()
    assert closed.stable.tolist() == [True, True, False, True]
    assert set(made.calls[1:]) == {3}


def test_the_processor_judges_what_holds_on_a_device(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, steps: Callable[..., Steps]
) -> None:
    steps(lambda state, missed: None)
    expected, start = simulate(hand, obj, grasps, CARRY), Rollout(cached_scene(hand, obj, CARRY), grasps, 1)

    def stand_still(state: State, missed: np.ndarray) -> None:
        state["qpos"][:], state["qvel"][:], state["qacc_warmstart"][:] = np.resize(start.qpos, state["qpos"].shape), 0.0, 0.0

    steps(stand_still)
    assert simulate(hand, obj, grasps, CARRY, device="cuda", confirm=False).success.sum() > expected.success.sum()
    confirmed = simulate(hand, obj, grasps, CARRY, device="cuda")
    assert torch.equal(confirmed.success, expected.success)
    rows = expected.success.nonzero()[:, 0]
    same(confirmed.rows(rows), expected.rows(rows))


def test_room_grows_for_contacts_at_once_and_for_constraints_where_many_worlds_lack_it() -> None:
    kinds = pytest.importorskip("mujoco_warp").OverflowType
    few, none = np.zeros(1000, int), np.zeros(1000, int)
    few[:5] = kinds.NEFC
    assert warp_worlds._larger(Room(), none) == warp_worlds._larger(Room(), few) == Room()
    few[:50] = kinds.NEFC
    assert warp_worlds._larger(Room(), few) == Room(rows=2 * Room().rows)
    assert warp_worlds._larger(Room(), none + kinds.NARROWPHASE) == Room(contacts=2 * Room().contacts)
    large = Room(warp_worlds.LARGEST_ROOM, warp_worlds.LARGEST_ROOM)
    assert warp_worlds._larger(large, none + kinds.CCD) == large


def test_graphs_are_of_few_sizes(hand: Hand, obj: ObjectModel) -> None:
    graphs = warp_worlds._Graphs(joint_model((cached_scene(hand, obj, CARRY),)), "cuda", ())
    assert [graphs.number(n) for n in (1000, 300, 1024, 256, 200, 3, 128, 2049)] == [1024, 1024, 1024, 256, 256, 128, 128, 4096]
    graphs = warp_worlds._Graphs(joint_model((cached_scene(hand, obj, CARRY),)), "cpu", ())
    assert [graphs.number(n) for n in (2, 1, 12)] == [2, 2, 16]  # the processor takes as long as there are worlds


def test_a_device_without_the_extra_says_what_to_install(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate(hand, obj, grasps, device="cuda")  # they are few
    monkeypatch.setattr(rollout_module, "FEW", 0)
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "mujoco_warp" else object())
    warp_worlds._modules.cache_clear()
    with pytest.raises(OptionError, match=r"mujoco_warp.*dro-grasp\[gpu\]"):
        simulate(hand, obj, grasps, device="cuda")


def test_payloads_and_answers_are_the_same_on_a_device(hand: Hand, obj: ObjectModel, grasps: GraspBatch, device: str) -> None:
    rollout = Rollout(cached_scene(hand, obj, CARRY), grasps, 1)
    rollout.close()
    contacts, joints = contact_forces(rollout), torch.from_numpy(rollout.poses()[0]).float()
    mass = torch.as_tensor(rollout.mass).float()
    found = []
    for place in ("cpu", device):
        chosen = squeezes_of(hand, contacts, joints, grasps.squeeze_joints, WeightConfig(), place)
        still = chosen.joints.new_zeros(len(grasps))
        targets = chosen.targets(mass.to(place)[:, None])
        moved, turned = given_way(chosen, still.new_tensor([0.01, 0.1]), PayloadConfig())
        answers = unanswered(contacts, mass.to(place), 0.2)
        found.append([x.cpu() for x in (payloads(chosen, still, still), targets, moved, turned, answers)])
    assert all(float(x.abs().max()) > 0 for x in found[0][1:])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-3, atol=1e-5)


def test_kernels_lie_in_the_folder_of_their_version(tmp_path: Path) -> None:
    """Also where another thread asks for Warp while it starts: what lies elsewhere is an older version's to Warp."""
    pytest.importorskip("mujoco_warp")
    code = ("from dro_grasp.simulation.warp_worlds import _modules; warp = _modules()[0]; warp.init(); "
            "_modules.cache_clear(); print(_modules()[0].config.kernel_cache_dir, warp.config.version, end='')")
    environment = {**os.environ, "DRO_GRASP_CACHE": str(tmp_path)}
    environment.pop("WARP_CACHE_PATH", None)
    printed = subprocess.run([sys.executable, "-c", code], env=environment, text=True, stdout=subprocess.PIPE, check=True)
    folder, version = printed.stdout.splitlines()[-1].split()
    assert Path(folder) == tmp_path / "kernels" / version


@pytest.mark.slow
@pytest.mark.parametrize("rules", [protocol("strict"), CARRY, ROBUST], ids=lambda rules: rules.name)
def test_warp_judges_grasps_of_a_hand_as_mujoco_does(rules: Protocol) -> None:
    """On the processor, where kernels compile for minutes the first time."""
    pytest.importorskip("mujoco_warp")
    hand, obj = load_hand("gripper3"), load_object("cube")
    grasps = settle(hand, obj, _around(hand, obj))
    expected = simulate(hand, obj, grasps, rules)
    found = simulate(hand, obj, grasps, rules, device=WARP, confirm=False)
    assert 0 < int(expected.success.sum()) < len(grasps)
    assert torch.equal(found.success, expected.success)
    held = expected.success
    torch.testing.assert_close(found.closing_shift[held], expected.closing_shift[held], rtol=0.05, atol=2e-4)


def _around(hand: Hand, obj: ObjectModel) -> GraspBatch:
    """A few grasps that the optimiser makes, and the first of them too far away to hold."""
    from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize

    made = synthesize(hand, obj, 4, 0, SynthesisConfig(steps=60))
    away = made.T_object_wrist[:1].clone()
    away[:, :3, 3] *= 3
    return GraspBatch.concatenate([made, made[:1].replace(T_object_wrist=away)])


@pytest.mark.gpu
def test_a_gpu_judges_as_the_processor_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout_module, "FEW", 0)
    hand, obj = load_hand("gripper3"), load_object("cube")
    grasps = settle(hand, obj, _around(hand, obj))
    found = simulate(hand, obj, grasps, "strict", device="cuda", confirm=False)
    assert torch.equal(found.success, simulate(hand, obj, grasps, "strict").success)
    pressed_many(hand, [obj], [grasps], device="cuda")


@pytest.mark.parametrize(("share", "seed", "kept", "judged"), [(1.0, 0, 3, 4), (0.5, 1, 3, 4), (0.5, 0, 4, 2)])
def test_the_processor_judges_a_share_of_what_a_device_lets_pass_and_all_where_it_refutes(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, share: float, seed: int, kept: int, judged: int
) -> None:
    config = EngineConfig("carry", confirm=share, synthesis=SynthesisConfig(device="cuda"))
    valid, refuted, count = worker._judged(
        hand, Wanted(obj, seed, 4), grasps.replace(energy=torch.arange(4.0)), config)
    assert (len(valid), count) == (kept, judged)
    assert sum(refuted.values()) == 4 - kept
    assert torch.equal(valid.energy, torch.arange(float(kept)))


def test_without_a_device_nothing_is_judged_twice(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> None:
    valid, refuted, count = worker._judged(hand, Wanted(obj, 0, 4), grasps, EngineConfig("carry"))
    assert (valid, refuted, count) == (grasps, {}, 0)


@pytest.mark.parametrize("resettle", [False, True])
def test_a_shard_made_on_a_device_is_that_of_the_processor(
    steps: Callable[..., Steps], monkeypatch: pytest.MonkeyPatch, resettle: bool
) -> None:
    """From candidates to confirmed grasps of two objects, with a strict device for PyTorch and MuJoCo in Warp's place.

    What settles is stored, since settling carries small differences far. It has no solver of residual slip on a device, and
    here on the processor neither.
    """
    if resettle:
        steady = {grasps.object[0]: grasps[grasps.energy.argsort()] for grasps in steady_grasps()}
        monkeypatch.setattr(worker, "synthesize_all", lambda lots: [steady[lot.obj.name] for lot in lots])
        monkeypatch.setattr(settling, "physics", lambda config, device: replace(protocol(config.protocol), noslip=0))
    made, hand, cube, can = steps(), load_hand("gripper3"), load_object("cube"), load_object("can")
    config = EngineConfig("strict", also=("dro",), candidates=24, resettle=resettle, confirm=0.5, synthesis=SynthesisConfig(
        steps=60, batch_size=24, at_once=48))
    wanted = [Wanted(cube, 0, 24), Wanted(can, 1, 24)]
    processor = [worker.valid_grasps_of_all(hand, [one], config)[0] for one in wanted]
    assert not made.calls
    for module in (worlds_module, rollout_module, trial_module):
        monkeypatch.setattr(module, "on_processor", lambda device: device == "cpu")
    with fake_device() as device:
        own = replace(config, synthesis=replace(config.synthesis, device=device))
        together = worker.valid_grasps_of_all(hand, wanted, own)
    assert max(len(joint.scenes) for joint in made.joints) == 2
    for (found, told), (expected, known) in zip(together, processor, strict=True):
        assert len(found) == told.valid == known.valid > 1
        assert told.judged == -(-told.valid // 2)
        assert known.judged == 0
        assert told.failures == known.failures
        torch.testing.assert_close(found.energy, expected.energy, rtol=1e-3, atol=1e-4)
        for name in ("T_object_wrist", "joints"):
            torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=0.0, atol=1e-4)
        assert found.protocol == expected.protocol
