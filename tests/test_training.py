"""Training and pretraining on a tiny bundle: progress, resumption after a kill, refusals, BatchNorm, reports."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import nn

from dro_grasp.datasets.bundle import Bundle
from dro_grasp.errors import OptionError, OutputError, TrainingError
from dro_grasp.models.network import DistanceNetwork, NetworkConfig
from dro_grasp.training import batch_statistics, loop, pretraining
from dro_grasp.training.config import AugmentationConfig, LossConfig, MotionConfig, PretrainConfig, ScheduleConfig, TrainConfig
from dro_grasp.training.loop import train
from dro_grasp.training.pretraining import contrastive_step, matching_rank, pretrain, pretrain_motion
from dro_grasp.training.processes import Processes
from dro_grasp.training.runs import CHECKPOINT, LOG, Run, learning_rate_share
from dro_grasp.training.samples import SampleSource
from tests.tiny_bundle import TINY, tiny_bundle

SCHEDULE = ScheduleConfig(
    steps=10, warmup_steps=3, learning_rate=3e-3, average_decay=0.9, checkpoint_seconds=0, log_every=2
)
SHARDED = dataclasses.replace(SCHEDULE, shards=2)
STAGES = ["train", "pretrain"]
ROOT = Path(__file__).parents[1]
SHARED = """
import sys
from pathlib import Path
from dro_grasp.datasets.bundle import load_bundle
from tests.test_training import SHARDED, run_stage
bundle = load_bundle(Path(sys.argv[1]) / "bundle.safetensors")
run_stage("pretrain", bundle, Path(sys.argv[1]) / "before", SHARDED)
run_stage("train", bundle, Path(sys.argv[1]) / "shared", SHARDED)
"""
# Dies at step 6: after the log line and before its checkpoint, or with the checkpoint half written.
KILLED = """
import os, signal, sys
from pathlib import Path
import torch
from dro_grasp.datasets.bundle import load_bundle
from tests.test_training import run_stage
stage, moment, folder = sys.argv[1], sys.argv[2], Path(sys.argv[3])
whole_save = torch.save
def die():
    os.kill(os.getpid(), signal.SIGKILL)
def report(run, means):
    if run.step == 6:
        if moment == "before":
            die()
        torch.save = half_save
def half_save(state, file):
    whole_save(state["step"], file)
    die()
run_stage(stage, load_bundle(folder / "bundle.safetensors"), folder / "killed", report=report)
"""


def quiet(run: Run, means: dict[str, float]) -> None:
    """A report that nobody reads."""


def run_stage(
    stage: str, bundle: Bundle, folder: Path, schedule: ScheduleConfig = SCHEDULE,
    report: Callable[[Run, dict[str, float]], None] = quiet, network: NetworkConfig = TINY,
) -> DistanceNetwork:
    if stage == "pretrain":
        return pretrain(bundle, network, PretrainConfig(schedule, hands_per_step=1), folder, report)
    return train(bundle, network, TrainConfig(schedule, hands_per_step=1, columns=24), folder, report=report)


def curve(folder: Path) -> list[dict[str, float]]:
    """The log without times."""
    lines = [json.loads(line) for line in (folder / LOG).read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "seconds"} for line in lines]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("training")


@pytest.fixture(scope="module")
def bundle(home: Path) -> Bundle:
    return tiny_bundle(home / "bundle.safetensors")


@pytest.fixture(scope="module")
def results(home: Path, bundle: Bundle) -> dict[str, DistanceNetwork]:
    """What uninterrupted runs of both stages return."""
    return {stage: run_stage(stage, bundle, home / stage) for stage in STAGES}


@pytest.fixture(scope="module")
def finished(home: Path, results: dict[str, DistanceNetwork]) -> dict[str, Path]:
    """The folders of these runs."""
    return {stage: home / stage for stage in results}


def test_losses_go_down_and_the_encoder_learns_to_match(bundle: Bundle, tmp_path: Path) -> None:
    schedule = dataclasses.replace(SCHEDULE, steps=50, log_every=10)
    learnt = run_stage("pretrain", bundle, tmp_path / "pre", schedule)
    assert curve(tmp_path / "pre")[-1]["total"] < 0.6 * curve(tmp_path / "pre")[0]["total"]
    source = SampleSource(bundle, TINY, AugmentationConfig())
    rank = matching_rank(learnt.hand_encoder, source, 16, torch.Generator().manual_seed(0))["toy"]
    assert rank < 0.3 * TINY.n_hand / 2, "chance is half the number of points"
    run_stage("train", bundle, tmp_path / "main", schedule)
    first, last = curve(tmp_path / "main")[0], curve(tmp_path / "main")[-1]
    assert last["total"] < first["total"]
    assert last["distance"] < 0.9 * first["distance"]


@pytest.mark.parametrize(("stage", "moment"), [("train", "before"), ("pretrain", "during")])
def test_a_killed_run_goes_on_to_the_same_curve(
    home: Path, bundle: Bundle, finished: dict[str, Path], results: dict[str, DistanceNetwork], tmp_path: Path, stage: str,
    moment: str,
) -> None:
    (tmp_path / "bundle.safetensors").symlink_to(home / "bundle.safetensors")
    dead = subprocess.run([sys.executable, "-c", KILLED, stage, moment, str(tmp_path)], capture_output=True, text=True)
    assert dead.returncode == -signal.SIGKILL, dead.stderr
    folder = tmp_path / "killed"
    assert [line["step"] for line in curve(folder)] == [2, 4, 6]
    assert torch.load(folder / CHECKPOINT, weights_only=True)["step"] == 4
    with (folder / LOG).open("a") as file:
        file.write('{"step": 7, "to')
    resumed = run_stage(stage, bundle, folder)
    expected = curve(finished[stage])
    assert [line["step"] for line in expected] == [2, 4, 6, 8, 10]
    assert curve(folder) == [pytest.approx(line, rel=1e-5, abs=1e-8) for line in expected]
    assert {p.name for p in folder.iterdir()} == {CHECKPOINT, LOG}
    for ours, theirs in zip(resumed.state_dict().values(), results[stage].state_dict().values(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_a_run_killed_before_its_first_checkpoint_begins_a_new_log(bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / LOG).write_text('{"step": 2, "total": 7.0}\n{"st')
    run_stage("pretrain", bundle, tmp_path / "run", dataclasses.replace(SCHEDULE, steps=4))
    assert [line["step"] for line in curve(tmp_path / "run")] == [2, 4]
    assert curve(tmp_path / "run")[0]["total"] != 7.0


def test_a_loss_that_is_not_finite_stops_and_leaves_a_sound_checkpoint(
    bundle: Bundle, finished: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, honest = [], loop.placement_loss

    def poisoned(*values: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return honest(*values) * (math.nan if len(calls) == 6 else 1)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "placement_loss", poisoned)
        with pytest.raises(TrainingError, match=r"^placement is not finite at step 5"):
            run_stage("train", bundle, tmp_path / "run")
    state = torch.load(tmp_path / "run" / CHECKPOINT, weights_only=True)
    assert state["step"] == 4
    assert all(bool(v.isfinite().all()) for v in state["model"].values())
    run_stage("train", bundle, tmp_path / "run")
    assert curve(tmp_path / "run") == [pytest.approx(line, rel=1e-5, abs=1e-8) for line in curve(finished["train"])]


def test_a_gradient_that_is_not_finite_stops(tmp_path: Path) -> None:
    model = nn.Linear(1, 1)
    run = Run(tmp_path / "run", model, SCHEDULE, torch.Generator())
    before = copy.deepcopy(model.state_dict())
    with pytest.raises(TrainingError, match=r"^gradient is not finite at step 0"):
        run.train(lambda: {"total": (model.weight * 0).sqrt().sum()}, quiet)
    assert all(torch.equal(before[k], v) for k, v in model.state_dict().items())


def damage(path: Path, how: str) -> None:
    whole = path.read_bytes()
    if how == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "foreign":
        torch.save([1, 2, 3], path)
    else:
        state = torch.load(path, weights_only=True)
        torch.save({k: v for k, v in state.items() if k != "optimiser"}, path)


@pytest.mark.parametrize("how", ["truncated", "empty", "foreign", "incomplete"])
def test_a_damaged_checkpoint_is_refused(bundle: Bundle, finished: dict[str, Path], tmp_path: Path, how: str) -> None:
    (tmp_path / "run").mkdir()
    path = tmp_path / "run" / CHECKPOINT
    path.write_bytes((finished["train"] / CHECKPOINT).read_bytes())
    damage(path, how)
    with pytest.raises(TrainingError, match=r"checkpoint\.pt does not fit this training"):
        run_stage("train", bundle, tmp_path / "run")


def test_a_checkpoint_of_another_training_is_refused(bundle: Bundle, finished: dict[str, Path]) -> None:
    with pytest.raises(TrainingError, match="a run with steps 10, 12 was asked for"):
        run_stage("train", bundle, finished["train"], dataclasses.replace(SCHEDULE, steps=12))
    with pytest.raises(TrainingError, match="does not fit this training"):
        run_stage("train", bundle, finished["train"], network=dataclasses.replace(TINY, width=20))
    with pytest.raises(TrainingError, match="does not fit this training"):
        run_stage("train", bundle, finished["pretrain"])


@pytest.mark.parametrize(
    ("name", "value"),
    [("steps", 0), ("steps", -5), ("minutes", 0.0), ("learning_rate", math.nan), ("log_every", 0), ("shards", 0)],
)
def test_an_impossible_schedule_is_refused(bundle: Bundle, tmp_path: Path, name: str, value: float) -> None:
    with pytest.raises(OptionError, match=f"{name} is {value}"):
        run_stage("train", bundle, tmp_path / "run", dataclasses.replace(SCHEDULE, **{name: value}))
    assert not (tmp_path / "run").exists()


def test_a_folder_that_cannot_be_made_is_refused_before_the_work(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def working(*_: object) -> None:
        raise AssertionError("the work began")

    monkeypatch.setattr(loop, "step_losses", working)
    monkeypatch.setattr(pretraining, "contrastive_step", working)
    (tmp_path / "file").write_text("")
    for stage in STAGES:
        with pytest.raises(OutputError, match="create"):
            run_stage(stage, bundle, tmp_path / "none" / "run")
        with pytest.raises(OutputError, match="file"):
            run_stage(stage, bundle, tmp_path / "file")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("file", [LOG, f"{CHECKPOINT}.part"])
def test_a_full_disk_is_told_and_leaves_the_old_checkpoint(tmp_path: Path, file: str) -> None:
    model = nn.Linear(1, 1)
    run = Run(tmp_path / "run", model, SCHEDULE, torch.Generator())
    run.save()
    before = (run.folder / CHECKPOINT).read_bytes()
    (run.folder / file).symlink_to("/dev/full")
    with pytest.raises(OutputError, match="cannot write into"):
        run.train(lambda: {"total": model.weight.square().sum()}, quiet)
    assert (run.folder / CHECKPOINT).read_bytes() == before


def test_a_frozen_encoder_stays_as_it_was(bundle: Bundle, tmp_path: Path) -> None:
    pretrained = run_stage("pretrain", bundle, tmp_path / "pre")
    before = copy.deepcopy(pretrained.hand_encoder.state_dict())
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)
    frozen = train(bundle, TINY, config, tmp_path / "frozen", pretrained, quiet).hand_encoder.state_dict()
    assert any("running_mean" in name for name in before)
    assert all(torch.equal(before[name], value) for name, value in frozen.items())
    free = train(
        bundle, TINY, dataclasses.replace(config, freeze_hand_encoder=False), tmp_path / "free", pretrained, quiet
    ).hand_encoder.state_dict()
    assert all("tracked" in name or not torch.equal(before[name], value) for name, value in free.items())


def test_fine_tuning_goes_on_from_given_weights(
    bundle: Bundle, results: dict[str, DistanceNetwork], finished: dict[str, Path], tmp_path: Path
) -> None:
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)
    tuned = train(bundle, TINY, config, tmp_path / "run", initial=results["train"], report=quiet)
    assert curve(tmp_path / "run")[0]["distance"] < curve(finished["train"])[0]["distance"]
    before, after = (m.hand_encoder.state_dict() for m in (results["train"], tuned))
    assert all(torch.equal(before[name], value) for name, value in after.items()), "the hand encoder is kept"
    wider = DistanceNetwork(dataclasses.replace(TINY, latent=6))
    fresh = loop.take_over(wider, results["train"])
    assert "head.first.weight" in fresh
    assert "place.weight" not in fresh
    assert torch.equal(wider.place.weight, results["train"].place.weight)


def test_recalibration_measures_what_the_weights_make_of_the_data(bundle: Bundle) -> None:
    torch.manual_seed(0)
    encoder, source = DistanceNetwork(TINY).hand_encoder.train(), SampleSource(bundle, TINY, AugmentationConfig())
    frozen = nn.BatchNorm1d(3).eval()
    norm, momentum, inputs = encoder.final.norm, encoder.final.norm.momentum, []
    generator = torch.Generator().manual_seed(0)
    norm.register_forward_pre_hook(lambda _, given: inputs.append(given[0]))
    for parameter in encoder.parameters():
        nn.init.normal_(parameter)
    encoder.add_module("frozen", frozen)
    batch_statistics.recalibrate(
        encoder, lambda: contrastive_step(encoder, source, PretrainConfig(hands_per_step=1), generator), batches=5
    )
    assert len(inputs) == 5
    torch.testing.assert_close(norm.running_mean, torch.stack([x.mean(0) for x in inputs]).mean(0))
    torch.testing.assert_close(norm.running_var, torch.stack([x.var(0) for x in inputs]).mean(0))
    assert norm.momentum == momentum
    assert frozen.num_batches_tracked == 0


@pytest.mark.parametrize("stage", STAGES)
def test_statistics_returned_belong_to_the_weights_returned(bundle: Bundle, tmp_path: Path, stage: str) -> None:
    model = run_stage(stage, bundle, tmp_path / "run")
    assert not any(m.training for m in model.modules())
    norm = model.hand_encoder.final.norm
    inputs: list[torch.Tensor] = []
    norm.register_forward_pre_hook(lambda _, given: inputs.append(given[0].detach()))
    source, generator = SampleSource(bundle, TINY, AugmentationConfig()), torch.Generator().manual_seed(5)
    for _ in range(20):
        if stage == "pretrain":
            contrastive_step(model.hand_encoder, source, PretrainConfig(hands_per_step=1), generator)
        else:
            hand = source.draw("toy", 4, generator).placed
            model.hand_encoder(hand - hand.mean(1, keepdim=True))
    x = torch.cat(inputs)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert float(((x.mean(0) - norm.running_mean) / x.std(0)).abs().max()) < 0.05
    assert float((x.var(0) / norm.running_var).log().abs().max()) < 0.1


def test_the_average_is_the_moving_average_of_the_weights(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model, weights = nn.Linear(2, 1), []
    run = Run(tmp_path / "run", model, SCHEDULE, torch.Generator())

    def losses() -> dict[str, torch.Tensor]:
        weights.append(model.weight.detach().clone())
        return {"total": model(torch.ones(1, 2)).square().sum()}

    run.train(losses, quiet)
    expected = weights[1]
    for value in [*weights[2:], model.weight.detach()]:
        expected = 0.9 * expected + 0.1 * value
    torch.testing.assert_close(run.average.module.weight.detach(), expected)
    assert not torch.allclose(expected, model.weight)


def test_a_time_limit_ends_the_schedule(bundle: Bundle, tmp_path: Path) -> None:
    limited = dataclasses.replace(SCHEDULE, steps=10**6, minutes=1e-9)
    run_stage("train", bundle, tmp_path / "run", limited)
    assert [line["step"] for line in curve(tmp_path / "run")] == [1]
    assert torch.load(tmp_path / "run" / CHECKPOINT, weights_only=True)["step"] == 1


def test_learning_rate_warms_up_and_falls_to_zero() -> None:
    schedule = ScheduleConfig(steps=1000, warmup_steps=10)
    shares = [learning_rate_share(step, step / 1000, schedule) for step in range(1001)]
    assert shares[0] == pytest.approx(0.1)
    assert shares[500] == pytest.approx(0.5)
    assert shares[1000] == pytest.approx(0, abs=1e-12)
    assert shares[10:] == sorted(shares[10:], reverse=True)
    assert learning_rate_share(20, 0.5, schedule) == pytest.approx(0.5), "time may be further on than steps"


@pytest.mark.parametrize("form", ["batch_mean", "official"])
def test_total_is_the_weighted_sum(bundle: Bundle, form: str) -> None:
    torch.manual_seed(0)
    source, generator = SampleSource(bundle, TINY, AugmentationConfig(partial=0.5)), torch.Generator().manual_seed(0)
    weights = LossConfig(2.0, 3.0, 5.0, 7.0, form, divergence_warmup=0.5, free_bits=0.1, placement=11.0)
    model, groups = DistanceNetwork(TINY), [source.draw("toy", 3, generator)]
    for progress, share in ((0.0, 0.0), (0.1, 0.2), (0.5, 1.0), (0.9, 1.0)):
        values = loop.step_losses(model, groups, TrainConfig(losses=weights, columns=24), progress)
        found = {name: float(value.detach()) for name, value in values.items()}
        expected = sum(getattr(weights, n) * v for n, v in found.items() if n not in {"total", "nats", "divergence"})
        assert found["total"] == pytest.approx(expected + share * weights.divergence * found["divergence"])
        assert found["nats"] > 0


def test_a_learned_prior_learns(bundle: Bundle) -> None:
    torch.manual_seed(0)
    network = dataclasses.replace(TINY, prior="learned", latent_form="motion")
    source, generator = SampleSource(bundle, network, AugmentationConfig()), torch.Generator().manual_seed(0)
    model = DistanceNetwork(network)
    loop.step_losses(model, [source.draw("toy", 3, generator)], TrainConfig(columns=24))["total"].backward()
    assert model.prior.last.weight.grad.abs().max() > 0
    assert model.motion.last.weight.grad.abs().max() > 0


def test_a_motion_is_learned_before_objects_are_seen(bundle: Bundle, tmp_path: Path) -> None:
    network = dataclasses.replace(TINY, prior="flow", latent_form="motion", latent=8)
    fresh = DistanceNetwork(network)
    encoder = copy.deepcopy(fresh.hand_encoder.state_dict())
    schedule = dataclasses.replace(SCHEDULE, steps=200, log_every=10)
    learnt = pretrain_motion(fresh, bundle, MotionConfig(schedule, hands_per_step=1), tmp_path / "motion", quiet)
    lines = curve(tmp_path / "motion")
    assert lines[-1]["distance"] < 0.6 * lines[0]["distance"]
    assert all(torch.equal(encoder[k], v) for k, v in learnt.hand_encoder.state_dict().items())
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)
    train(bundle, network, config, tmp_path / "fresh", report=quiet)
    train(bundle, network, config, tmp_path / "taken", learnt, quiet)
    assert curve(tmp_path / "taken")[0]["motion"] < 0.7 * curve(tmp_path / "fresh")[0]["motion"]
    with pytest.raises(TrainingError, match="latent_form is 'kernel'"):
        pretrain_motion(DistanceNetwork(TINY), bundle, MotionConfig(schedule), tmp_path / "none", quiet)


def test_two_processes_descend_the_curve_of_one(home: Path, bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "bundle.safetensors").symlink_to(home / "bundle.safetensors")
    (tmp_path / "shared.py").write_text(SHARED)
    subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", tmp_path / "shared.py",
         str(tmp_path)],
        check=True, capture_output=True, text=True, timeout=120,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"})
    alone = run_stage("train", bundle, tmp_path / "alone", SHARDED)
    assert [line["step"] for line in curve(tmp_path / "shared")] == [2, 4, 6, 8, 10]
    assert curve(tmp_path / "shared") == [pytest.approx(line, rel=1e-4, abs=1e-7) for line in curve(tmp_path / "alone")]
    shared = torch.load(tmp_path / "shared" / CHECKPOINT, weights_only=True)["model"]
    whole = torch.load(tmp_path / "alone" / CHECKPOINT, weights_only=True)["model"]
    for name in alone.state_dict():
        if "running" not in name and "tracked" not in name:  # those of training are each process's own
            torch.testing.assert_close(shared[name], whole[name], rtol=1e-4, atol=1e-5)
    run_stage("pretrain", bundle, tmp_path / "alone before", SHARDED)
    assert curve(tmp_path / "before") == [pytest.approx(x, rel=1e-4) for x in curve(tmp_path / "alone before")]
    run_stage("train", bundle, tmp_path / "other", SCHEDULE)
    assert curve(tmp_path / "other")[0] != pytest.approx(curve(tmp_path / "alone")[0], rel=1e-4), "two shards see more"


def test_shards_that_cannot_be_shared_out_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"3 shards .* 2 processes; give a multiple of 2"):
        Run(tmp_path / "run", nn.Linear(1, 1), dataclasses.replace(SCHEDULE, shards=3), torch.Generator(), Processes(0, 2))


def test_tensorboard_gets_the_log_where_it_is_installed(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    schedule = dataclasses.replace(SCHEDULE, steps=4, tensorboard=True)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    run_stage("pretrain", bundle, tmp_path / "without", schedule)
    written: list[tuple[str, float, int]] = []

    class SummaryWriter:
        def __init__(self, folder: str) -> None:
            assert Path(folder) == tmp_path / "with"

        def add_scalar(self, name: str, value: float, step: int) -> None:
            written.append((name, value, step))

        def close(self) -> None:
            written.append(("closed", 0.0, 0))

    module = ModuleType("torch.utils.tensorboard")
    module.__dict__["SummaryWriter"] = SummaryWriter
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    run_stage("pretrain", bundle, tmp_path / "with", schedule)
    log = curve(tmp_path / "with")
    assert log == curve(tmp_path / "without")
    assert written == [*(("total", line["total"], line["step"]) for line in log), ("closed", 0.0, 0)]
