"""Devices: those asked for must be there, records move whole, and every entry point computes on one what it does on the CPU."""

from __future__ import annotations

import dataclasses
import threading
from pathlib import Path

import pytest
import torch

from dro_grasp.devices import at_once, choose_device, cores, may_hold, on_device, require_device, side_by_side, where_any
from dro_grasp.errors import OptionError
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.grasp_energy import EnergyConfig, link_spheres
from dro_grasp.optimize.refinement import RefineConfig
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.predict.config import PredictorConfig, RescueConfig
from dro_grasp.predict.finish import FinishConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.optimiser import OptimiserConfig
from tests.helpers.claw import ball
from tests.helpers.toy_hand import toy_hand
from tests.helpers.weights import untrained_weights

NEARLY = {"atol": 1e-5, "rtol": 1e-4}


@pytest.mark.parametrize("there", [True, False])
def test_the_device_is_cuda_where_there_is_one(monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2 * there)
    assert choose_device("auto") == ("cuda" if there else "cpu")
    assert choose_device("cpu") == "cpu"
    if there:
        assert choose_device("cuda:1") == "cuda:1"
        with pytest.raises(OptionError, match=r"device is 'cuda:2'.*finds 2 such"):
            require_device("cuda:2")
    else:
        with pytest.raises(OptionError, match=r"device is 'cuda:1'.*finds no such.*use device='cpu'"):
            require_device("cuda:1")


def test_a_device_without_meaning_is_refused() -> None:
    with pytest.raises(OptionError, match=r"device is 'gpu'.*cpu, cuda, cuda:1 or mps"):
        require_device("gpu")


def test_records_move_with_what_is_in_them() -> None:
    hand = toy_hand()
    moved = hand.to("meta")
    assert {moved.link_points.device.type, moved.tree.origin.device.type, moved.opening_signs.device.type} == {"meta"}
    assert moved.tree.link_names == hand.tree.link_names
    assert hand.link_points.device.type == "cpu"
    assert hand.to("cpu") is hand
    spheres = on_device(link_spheres(hand), "meta")
    assert {spheres.centres.device.type, spheres.pairs.device.type} == {"meta"}


def test_synthesis_on_a_device_gives_the_grasps_of_the_cpu(device: str) -> None:
    config = SynthesisConfig(steps=4, batch_size=4)
    here = synthesize(toy_hand(), ball(), 6, config=config)
    there = synthesize(toy_hand(), ball(), 6, config=dataclasses.replace(config, device=device))
    assert there.joints.device.type == "cpu"
    torch.testing.assert_close(there.joints, here.joints, **NEARLY)
    torch.testing.assert_close(there.T_object_wrist, here.T_object_wrist, **NEARLY)


@pytest.mark.slow
def test_the_optimiser_s_predictions_on_a_device_are_those_of_the_cpu(
    device: str, tmp_path: Path
) -> None:
    """Those of the network: `test_predictor.py`."""
    config = PredictorConfig(
        optimiser=OptimiserConfig(synthesis=SynthesisConfig(steps=10)), rescue=RescueConfig(per_grasp=2),
        finish=FinishConfig(refine=RefineConfig(steps=10), settle=None))
    weights, obj = str(untrained_weights(tmp_path)), load_object("sphere")
    here, there = (
        GraspPredictor(weights, place, config).predict(toy_hand(), obj, 2, seed=3, source="optimiser")
        for place in ("cpu", device))
    assert there.joints.device.type == "cpu"
    for name in ("joints", "T_object_wrist", "pregrasp_joints", "squeeze_joints", "score"):
        torch.testing.assert_close(getattr(there, name), getattr(here, name), atol=1e-3, rtol=1e-3)


def test_parts_side_by_side_give_what_they_give_one_by_one_each_in_one_thread() -> None:
    before, seen, numbers = torch.get_num_threads(), [], torch.rand(7, 3, requires_grad=True)

    def work(part: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
        seen.append((threading.get_ident(), torch.get_num_threads(), torch.is_grad_enabled()))
        barrier.wait(5)
        return factor * part.sum()

    try:
        torch.set_num_threads(2)
        barrier = threading.Barrier(2)  # only two threads at once get past it
        with torch.no_grad():
            found = side_by_side(work, numbers[:6].split(1), torch.arange(6.0).split(1))
        assert torch.equal(torch.stack(found).flatten(), torch.arange(6.0) * numbers[:6].detach().sum(1))
        assert len({thread for thread, *_ in seen}) == 2
        assert {tuple(rest) for _, *rest in seen} == {(1, False)}
        barrier = threading.Barrier(1)
        assert side_by_side(work, numbers[:2].split(2), torch.ones(1).split(1))[0].requires_grad
        assert seen[-1] == (threading.get_ident(), 1, True)
        assert torch.get_num_threads() == 2
        with pytest.raises(ZeroDivisionError):
            side_by_side(lambda part: 1 / 0, numbers.split(1))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_cores_are_at_most_the_threads_that_are_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)))
    for wanted, expected in (("3", 3), ("16", 8), ("0", 8), ("many", 8), ("", 8)):
        monkeypatch.setenv("OMP_NUM_THREADS", wanted)
        assert cores() == expected


def test_batches_follow_the_device_and_its_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    assert at_once("cpu", 32, 1e6) == 32
    assert at_once("cpu", 32, 1e6, given=7) == 7
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (60 * 2**30, 80 * 2**30))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 5 * 2**30)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 1 * 2**30)
    assert at_once("cuda", 32, 2**20) == int(0.25 * 64 * 2**10)
    assert at_once("cuda", 32, 2**40) == 32
    assert at_once("cuda", 32, 1e6, given=7) == 7


def test_no_more_is_waited_for_than_the_cpu_s_own(device: str) -> None:
    mask = torch.tensor([False, True, True])
    assert where_any(mask).tolist() == [1, 2]
    assert where_any(mask.to(device)) == slice(None)
    assert not may_hold(torch.zeros(2, dtype=torch.bool))
    assert may_hold(torch.zeros(2, dtype=torch.bool).to(device))


@pytest.mark.parametrize("name", ["xpu", "nonsense"])
def test_a_device_that_nothing_runs_on_is_refused(name: str) -> None:
    with pytest.raises(OptionError, match=f"device is '{name}'; give cpu, cuda, cuda:1 or mps"):
        require_device(name)


def test_what_is_on_its_device_already_keeps_what_it_has_derived() -> None:
    obj = load_object("sphere")
    assert on_device(obj.distance_field, "cpu") is obj.distance_field
    assert on_device(obj.distance_field, "meta") is not obj.distance_field
    assert GraspProblem(toy_hand(), obj).energy(EnergyConfig()).field is obj.distance_field
