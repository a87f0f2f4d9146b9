"""Network and training on a device that is not the CPU: nothing is left behind, and the numbers are those of the CPU."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dro_grasp.geometry.multilateration import thin_rows
from dro_grasp.network.network import untrained_network
from dro_grasp.network.placement import PROPORTIONS
from dro_grasp.training import loop, samples
from dro_grasp.training.config import MotionConfig, PlacementConfig, ScheduleConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle, write_bundle
from dro_grasp.training.loop import train, train_placement
from dro_grasp.training.pretraining import pretrain_motion
from tests.helpers.fake_device import fake_device
from tests.helpers.recorded_work import record
from tests.helpers.tiny_bundle import TINY, ellipsoid, made_up_grasps
from tests.helpers.toy_hand import toy_hand
from tests.helpers.training_stages import SCHEDULE, STAGES, curve, quiet, run_stage

PAPER = dataclasses.replace(TINY, frame="object")
SHORT = dataclasses.replace(SCHEDULE, steps=2, log_every=1, recalibration=2)


@pytest.mark.parametrize("network", [TINY, PAPER], ids=["ours", "paper"])
@torch.no_grad()
def test_a_network_predicts_where_it_is_with_random_numbers_of_the_cpu(network, device: str) -> None:
    def predicted(where: str) -> list[torch.Tensor]:
        model, generator = untrained_network(network, seed=0).to(where).eval(), torch.Generator().manual_seed(1)
        hand, obj = (torch.randn(3, n, 3, generator=generator).to(where) * 0.05 for n in (TINY.n_hand, TINY.n_object))
        axes = network.axes(torch.eye(3).to(where)).expand(6, 3, 3)
        distances = model.predict(hand, obj, model.sample_latent(3, generator))
        found = [distances, *model.sample_placements(obj[0], axes, 4, generator, torch.zeros(PROPORTIONS, device=where))]
        assert {value.device.type for value in found} == {torch.device(where).type}
        return [value.cpu() for value in found]

    for ours, theirs in zip(predicted(device), predicted("cpu"), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_descends_on_a_device(stage: str, device: str, bundle: Bundle, tmp_path: Path) -> None:
    there = run_stage(stage, bundle, tmp_path / "there", dataclasses.replace(SHORT, device=device))
    assert {value.device.type for value in there.state_dict().values()} == {"cpu"}
    run_stage(stage, bundle, tmp_path / "here", SHORT)
    assert [line["step"] for line in curve(tmp_path / "there")] == [1, 2]
    assert all(math.isfinite(value) for line in curve(tmp_path / "there") for value in line.values())
    if device != "cuda":  # whose random numbers are its own
        assert curve(tmp_path / "there") == [pytest.approx(line, rel=1e-4) for line in curve(tmp_path / "here")]


def test_a_motion_and_fine_tuning_descend_on_a_device(device: str, bundle: Bundle, tmp_path: Path) -> None:
    schedule = dataclasses.replace(SHORT, device=device)
    moving = pretrain_motion(
        untrained_network(TINY, seed=0), bundle, MotionConfig(schedule, hands_per_step=1), tmp_path / "motion", quiet)
    config = TrainConfig(schedule, hands_per_step=1, columns=24)
    tuned = train(bundle, TINY, config, tmp_path / "run", report=quiet, initial=moving)
    assert {value.device.type for value in [*moving.state_dict().values(), *tuned.state_dict().values()]} == {"cpu"}
    assert all(torch.isfinite(value).all() for value in tuned.state_dict().values())


def leaf(path: Path) -> Bundle:
    """A bundle of a round object and one that is thin, more or less, by what of it is drawn."""
    clouds = {"ball": ellipsoid((0.03, 0.03, 0.03)), "leaf": ellipsoid((0.05, 0.04, 0.0095))}
    return write_bundle(path, [toy_hand()], clouds, [made_up_grasps(toy_hand(), name, seed=i) for i, name in enumerate(clouds)])


def run(stage: str, bundle: Bundle, folder: Path, schedule: ScheduleConfig) -> list[dict[str, float]]:
    """The curve of a stage of training."""
    if stage in STAGES:
        run_stage(stage, bundle, folder, schedule)
    elif stage == "motion":
        pretrain_motion(untrained_network(TINY, 0), bundle, MotionConfig(schedule, hands_per_step=1), folder, quiet)
    else:
        train_placement(bundle, TINY, PlacementConfig(schedule, hands_per_step=1), folder, untrained_network(TINY, 0), quiet)
    return curve(folder)


@pytest.mark.parametrize(("stage", "shards"), [("train", 1), ("train", 2), ("pretrain", 2), ("motion", 1), ("placement", 1)])
def test_steps_that_a_gpu_records_give_the_same_curve(
    stage: str, shards: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle = leaf(tmp_path / "bundle.safetensors")
    with fake_device() as device:
        schedule = dataclasses.replace(SCHEDULE, steps=6, log_every=1, recalibration=2, shards=shards, device=device)
        expected = run(stage, bundle, tmp_path / "launched", schedule)
        seen = record(monkeypatch)
        found = run(stage, bundle, tmp_path / "recorded", schedule)
    assert seen == {"recorded": 1, "repeated": 6 * shards - 1}
    assert found == expected


def test_a_step_with_more_thin_clouds_than_there_is_room_for_is_launched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle = leaf(tmp_path / "bundle.safetensors")
    rooms: list[int] = []

    def thin(anchors: Tensor, room: int) -> Tensor:
        rooms.append(room)
        return thin_rows(anchors, room if len(rooms) % 2 else 0)

    monkeypatch.setattr(samples, "thin_rows", thin)
    with fake_device() as device:
        schedule = dataclasses.replace(SCHEDULE, steps=6, log_every=1, recalibration=2, device=device)
        seen = record(monkeypatch)
        found = run("train", bundle, tmp_path / "recorded", schedule)
    assert set(rooms) == {4}
    assert seen["repeated"] < 5
    assert found == [pytest.approx(line, rel=1e-4) for line in run("train", bundle, tmp_path / "here", dataclasses.replace(
        schedule, device="cpu"))]


@pytest.mark.parametrize("stage", ["train", "placement"])
def test_what_a_gpu_will_not_record_is_launched(
    stage: str, bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = run(stage, bundle, tmp_path / "here", SHORT)
    losses = loop.placement_losses
    monkeypatch.setattr(loop, "placement_losses", lambda *given: {**(found := losses(*given)), "read": torch.full(
        (), float(found["total"].detach()), device=given[1].obj.device)})
    with fake_device() as device:
        seen = record(monkeypatch)
        found = run(stage, bundle, tmp_path / "there", dataclasses.replace(SHORT, device=device))
    assert [key.split(":")[0] for key in seen] == ["refused"]
    assert [{name: line[name] for name in plain[0]} for line in found] == [pytest.approx(line, rel=1e-4) for line in plain]
