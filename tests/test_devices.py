"""Devices: those asked for must be there, records move whole, and every entry point computes on one what it does on the CPU."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import pytest
import torch

from dro_grasp.devices import choose_device, on_device, require_device
from dro_grasp.energy.grasp_energy import link_spheres
from dro_grasp.errors import OptionError
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimization.synthesis import SynthesisConfig, synthesize
from dro_grasp.predictor import GraspPredictor
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
        with pytest.raises(OptionError, match=r"device is 'cuda:1'.*finds no such.*use --device cpu"):
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


def test_the_optimiser_s_predictions_on_a_device_are_those_of_the_cpu(
    device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of the network: `test_predictor.py`."""
    monkeypatch.setattr("dro_grasp.predictor.OPTIMISED_PER_GRASP", 2)
    monkeypatch.setattr("dro_grasp.pipeline.stages.SynthesisConfig", functools.partial(SynthesisConfig, steps=10))
    weights, obj = str(untrained_weights(tmp_path)), load_object("sphere")
    here, there = (
        GraspPredictor(weights, device=place).predict(toy_hand(), obj, 2, seed=3, method="optimise")
        for place in ("cpu", device))
    assert there.joints.device.type == "cpu"
    for name in ("joints", "T_object_wrist", "pregrasp_joints", "squeeze_joints", "score"):
        torch.testing.assert_close(getattr(there, name), getattr(here, name), atol=1e-3, rtol=1e-3)
