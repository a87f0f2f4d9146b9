"""Runs of training: resumption after a kill, refusals, full disks, several processes, the learning rate, TensorBoard."""

from __future__ import annotations

import copy
import dataclasses
import errno
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import nn

from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError, OutputError, TrainingError
from dro_grasp.network.network import DistanceNetwork, untrained_network
from dro_grasp.training import loop, losses, pretraining, runs
from dro_grasp.training.config import AugmentationConfig, LossConfig, ScheduleConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.data.engine.shards import LOCK, sole_run
from dro_grasp.training.runs import (
    CHECKPOINT,
    LOG,
    RunFolder,
    RunProgress,
    TrainingRun,
    check_schedule,
    console_report,
    how_long,
    learning_rate_share,
    run_plan,
)
from dro_grasp.training.samples import SampleSource
from tests.helpers.tiny_bundle import TINY
from tests.helpers.training_stages import SCHEDULE, SHARDED, STAGES, curve, quiet, run_stage

ROOT = Path(__file__).parents[2]
SHARED = """
import sys
from pathlib import Path
from dro_grasp.training.data.bundle.training_file import load_bundle
from tests.helpers.training_stages import SHARDED, run_stage
bundle = load_bundle(Path(sys.argv[1]) / "bundle.safetensors")
run_stage("pretrain", bundle, Path(sys.argv[1]) / "before", SHARDED)
run_stage("train", bundle, Path(sys.argv[1]) / "shared", SHARDED)
"""
# Dies at step 6: after the log line and before its checkpoint, or with the checkpoint half written.
KILLED = """
import os, signal, sys
from pathlib import Path
import torch
from dro_grasp.training.data.bundle.training_file import load_bundle
from tests.helpers.training_stages import run_stage
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


@pytest.mark.slow
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
    assert {p.name for p in folder.iterdir()} - {LOCK} == {CHECKPOINT, LOG}
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
    calls, honest = [], losses.placement_loss

    def poisoned(*values: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return honest(*values) * (math.nan if len(calls) == 6 else 1)

    with monkeypatch.context() as patch:
        patch.setattr(losses, "placement_loss", poisoned)
        with pytest.raises(TrainingError, match=r"^placement is not finite at step 5"):
            run_stage("train", bundle, tmp_path / "run")
    state = torch.load(tmp_path / "run" / CHECKPOINT, weights_only=True)
    assert state["step"] == 4
    assert all(bool(v.isfinite().all()) for v in state["model"].values())
    run_stage("train", bundle, tmp_path / "run")
    assert curve(tmp_path / "run") == [pytest.approx(line, rel=1e-5, abs=1e-8) for line in curve(finished["train"])]


def test_a_gradient_that_is_not_finite_stops(tmp_path: Path) -> None:
    model = nn.Linear(1, 1)
    run = TrainingRun(tmp_path / "run", model, SCHEDULE, torch.Generator())
    assert not (tmp_path / "run").exists(), "nothing is made before training starts"
    before = copy.deepcopy(model.state_dict())
    with pytest.raises(TrainingError, match=r"^gradient is not finite at step 0"):
        run.train(lambda: {"total": (model.weight * 0).sqrt().sum()}, quiet)
    assert all(torch.equal(before[k], v) for k, v in model.state_dict().items())


def test_a_run_folder_in_the_home_folder_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    model = nn.Linear(1, 1)
    run = TrainingRun(Path("~/run"), model, dataclasses.replace(SCHEDULE, steps=1), torch.Generator())
    run.train(lambda: {"total": model(torch.ones(1)).square().sum()}, quiet)
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
    assert how_long(Path("~/run"))["steps"] == 1
    assert (tmp_path / "home" / "run" / CHECKPOINT).is_file()


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
def test_a_damaged_checkpoint_is_set_aside_and_the_run_begins_anew(
    finished: dict[str, Path], tmp_path: Path, how: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    path = tmp_path / "run" / CHECKPOINT
    path.write_bytes((finished["train"] / CHECKPOINT).read_bytes())
    damage(path, how)
    folder = RunFolder(tmp_path / "run")
    assert folder.read_checkpoint({"steps": 10}) is None
    assert f"{path} is damaged" in (told := capsys.readouterr().err)
    assert "set aside as checkpoint.pt.damaged, its log beside it; the training begins anew" in told
    assert not path.exists()
    assert path.with_name("checkpoint.pt.damaged").exists()
    assert folder.read_checkpoint({"steps": 10}) is None
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("error", [
    OSError(errno.EIO, "Input/output error"), PermissionError(errno.EACCES, "Permission denied"), MemoryError(),
    RuntimeError("[enforce fail at alloc_cpu.cpp:117] . DefaultCPUAllocator: can't allocate memory")])
def test_a_checkpoint_that_cannot_be_read_now_is_left_alone(
    finished: dict[str, Path], tmp_path: Path, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    for file in (CHECKPOINT, LOG):
        (tmp_path / file).write_bytes((finished["train"] / file).read_bytes())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def fail(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(torch, "load", fail)
        patch.setattr(Path, "read_bytes", fail if isinstance(error, OSError) else Path.read_bytes)
        with pytest.raises(TrainingError, match=r"checkpoint\.pt cannot be read .*nothing was changed"):
            RunFolder(tmp_path).read_checkpoint({"steps": 10})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_fault_of_ours_is_no_damage(finished: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / CHECKPOINT).write_bytes((finished["train"] / CHECKPOINT).read_bytes())

    def fail(*_: object, **__: object) -> None:
        raise NameError("no_such_name")

    monkeypatch.setattr(torch, "load", fail)
    with pytest.raises(NameError):
        RunFolder(tmp_path).read_checkpoint({"steps": 10})
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]


def test_what_is_set_aside_is_never_lost(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    for number in (1, 2, 3):
        (tmp_path / CHECKPOINT).write_text(f"checkpoint {number}")
        folder.append_to_log({"step": 9000 + number})
        assert folder.read_checkpoint({}) is None
        folder.cut_log(0)
    for number, ending in ((1, ".damaged"), (2, ".damaged.2"), (3, ".damaged.3")):
        assert (tmp_path / f"{CHECKPOINT}{ending}").read_text() == f"checkpoint {number}"
        assert json.loads((tmp_path / f"{LOG}{ending}").read_text()) == {"step": 9000 + number}
    assert not (tmp_path / LOG).exists()


def test_a_finished_run_with_other_settings_data_or_weights_is_refused(
    bundle: Bundle, finished: dict[str, Path], results: dict[str, DistanceNetwork]
) -> None:
    """It would make no step, and give the weights of before for those that were asked for."""
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)
    fewer = {name: dataclasses.replace(g, joints=g.joints + 0.01) for name, g in bundle.grasps.items()}
    other = Bundle(bundle.hands, bundle.objects, fewer)
    cases: list[tuple[str, Bundle, TrainConfig, DistanceNetwork | None]] = [
        ("losses.divergence", bundle, dataclasses.replace(config, losses=LossConfig(divergence=0.1)), None),
        ("augmentation.partial", bundle, dataclasses.replace(config, augmentation=AugmentationConfig(partial=0.5)), None),
        ("warmup_steps", bundle, dataclasses.replace(config, schedule=dataclasses.replace(SCHEDULE, warmup_steps=4)), None),
        ("bundle", other, config, None),
        ("pretrained", bundle, config, results["pretrain"]),
    ]
    for name, data, asked, given in cases:
        with pytest.raises(TrainingError, match=rf"belongs to a run with {name} .* was asked for"):
            loop.train(data, TINY, asked, finished["train"], given, quiet)
    longer = dataclasses.replace(config, schedule=dataclasses.replace(SCHEDULE, minutes=5.0, log_every=5))
    loop.train(bundle, TINY, longer, finished["train"], report=quiet)


def test_given_weights_count_by_their_parameters_whatever_their_names(bundle: Bundle) -> None:
    plans = [run_plan(TrainConfig(SCHEDULE), bundle, TINY, initial=untrained_network(TINY, seed, name))
             for seed, name in ((0, "a"), (1, "a"), (0, "b"))]
    assert plans[0] == plans[2] != plans[1]
    assert {k for k in plans[0] if plans[0][k] != plans[1][k]} == {"initial"}


def test_a_checkpoint_of_another_training_is_refused(bundle: Bundle, finished: dict[str, Path]) -> None:
    with pytest.raises(TrainingError, match="a run with steps 10, 12 was asked for"):
        run_stage("train", bundle, finished["train"], dataclasses.replace(SCHEDULE, steps=12))
    with pytest.raises(TrainingError, match=rf"a run with network.width {TINY.width}, 20 was asked for"):
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


@pytest.mark.parametrize("stage", STAGES)
def test_a_folder_in_which_another_run_trains_is_refused(bundle: Bundle, tmp_path: Path, stage: str) -> None:
    with sole_run(tmp_path), pytest.raises(OutputError, match=r"another run is filling .* give another folder$"):
        run_stage(stage, bundle, tmp_path)
    assert not (tmp_path / LOG).exists()


def test_a_folder_that_cannot_be_made_is_refused_before_the_work(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def working(*_: object) -> None:
        raise AssertionError("the work began")

    monkeypatch.setattr(loop, "step_losses", working)
    monkeypatch.setattr(pretraining, "posture_clouds", working)
    (tmp_path / "file").write_text("")
    for stage in STAGES:
        for folder in (tmp_path / "file", tmp_path / "file" / "runs" / "main"):
            with pytest.raises(OutputError, match="is a file"):
                run_stage(stage, bundle, folder)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("file", [LOG, f"{CHECKPOINT}.part"])
def test_a_full_disk_is_told_and_leaves_the_old_checkpoint(tmp_path: Path, file: str) -> None:
    model = nn.Linear(1, 1)
    run = TrainingRun(tmp_path / "run", model, SCHEDULE, torch.Generator())
    run.folder.path.mkdir()
    run.save()
    before = (run.folder.path / CHECKPOINT).read_bytes()
    (run.folder.path / file).symlink_to("/dev/full")
    told = rf"cannot write .*{file.removesuffix('.part')}: No space left on device; .* resumes from its last checkpoint"
    with pytest.raises(OutputError, match=told):
        run.train(lambda: {"total": model.weight.square().sum()}, quiet)
    assert (run.folder.path / CHECKPOINT).read_bytes() == before


def test_a_log_that_cannot_be_cut_on_a_full_disk_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    folder = RunFolder(tmp_path)
    for step in (1, 2):
        folder.append_to_log({"step": step})
    before = (tmp_path / LOG).read_bytes()
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OutputError, match=r"cannot write the log to .*: No space left on device"):
        folder.cut_log(1)
    assert [path.name for path in tmp_path.iterdir()] == [LOG]
    assert (tmp_path / LOG).read_bytes() == before
    monkeypatch.undo()
    folder.cut_log(1)
    assert (tmp_path / LOG).read_text() == json.dumps({"step": 1}) + "\n"


def test_the_average_is_the_moving_average_of_the_weights(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model, weights = nn.Linear(2, 1), []
    run = TrainingRun(tmp_path / "run", model, SCHEDULE, torch.Generator())

    def losses() -> dict[str, torch.Tensor]:
        weights.append(model.weight.detach().clone())
        return {"total": model(torch.ones(1, 2)).square().sum()}

    run.train(losses, quiet)
    last = torch.load(tmp_path / "run" / CHECKPOINT)["model"]["weight"]
    expected = weights[1]
    for value in [*weights[2:], last]:
        expected = 0.9 * expected + 0.1 * value
    torch.testing.assert_close(model.weight.detach(), expected)
    assert not torch.allclose(expected, last)


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


@pytest.mark.slow
def test_two_processes_descend_the_curve_of_one(
    home: Path, bundle: Bundle, finished: dict[str, Path], tmp_path: Path
) -> None:
    (tmp_path / "bundle.safetensors").symlink_to(home / "bundle.safetensors")
    (tmp_path / "shared.py").write_text(SHARED)
    # The processes import the package and the tests from where this one does; a busy machine takes minutes to start them.
    places = os.pathsep.join([str(ROOT), *(place for place in sys.path if place)])
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", tmp_path / "shared.py",
         str(tmp_path)],
        capture_output=True, text=True, timeout=500, env=os.environ | {"PYTHONPATH": places, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
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
    assert curve(finished["train"])[0] != pytest.approx(curve(tmp_path / "alone")[0], rel=1e-4), "two shards see more"


def test_every_shard_of_every_step_and_seed_draws_numbers_of_its_own(tmp_path: Path) -> None:
    generator = torch.Generator()

    def draw(seed: int, step: int, shard: int) -> float:
        run = TrainingRun(tmp_path, torch.nn.Linear(1, 1), dataclasses.replace(SCHEDULE, seed=seed), generator)
        run.step = step
        run.seed_shard(shard)
        return float(torch.rand((), generator=generator))

    places = list(itertools.product(range(2), range(3), range(3)))
    drawn = [draw(*place) for place in places]
    assert len(set(drawn)) == len(places)
    assert drawn == [draw(*place) for place in places]


@pytest.mark.parametrize("schedule", [SCHEDULE, SHARDED], ids=["one shard", "two shards"])
def test_samples_drawn_ahead_in_a_thread_give_the_same_curve(
    schedule: ScheduleConfig, bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_stage("train", bundle, tmp_path / "in turn", schedule)
    drawn, draw = [], SampleSource.draw_all
    monkeypatch.setattr(runs, "draws_ahead", lambda _: True)
    monkeypatch.setattr(SampleSource, "draw_all", lambda *values: drawn.append(threading.current_thread()) or draw(*values))
    run_stage("train", bundle, tmp_path / "ahead", schedule)
    assert curve(tmp_path / "ahead") == curve(tmp_path / "in turn")
    steps = schedule.steps * schedule.shards
    assert sum(thread is not threading.main_thread() for thread in drawn) in {steps, steps + 1}, "the last is not needed"
    assert not any(thread.is_alive() for thread in drawn if thread is not threading.main_thread())


def test_a_fault_of_the_thread_that_draws_is_told(bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "draws_ahead", lambda _: True)
    monkeypatch.setattr(SampleSource, "draw_all", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_stage("train", bundle, tmp_path / "run")


def test_shards_that_cannot_be_shared_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(OptionError, match=r"2 processes cannot share 3 shards .* give a multiple of 2"):
        check_schedule(dataclasses.replace(SCHEDULE, shards=3))
    check_schedule(dataclasses.replace(SCHEDULE, shards=4))


@pytest.mark.parametrize("stage", STAGES)
def test_tensorboard_that_is_not_installed_is_told_before_any_work(
    stage: str, bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(OptionError, match=r"pip install '\.\[tensorboard\]' in the folder"):
        run_stage(stage, bundle, tmp_path / "run", dataclasses.replace(SCHEDULE, tensorboard=True))
    # The command asks before it so much as reads the bundle, which does not exist.
    command = [stage, "--bundle", "none", "--run-folder", str(tmp_path / "run"), "--output", str(tmp_path / "w.safetensors")]
    assert main([*command, "--tensorboard"]) == 2
    assert "'.[tensorboard]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_tensorboard_gets_the_log(bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    schedule = dataclasses.replace(SCHEDULE, steps=4, tensorboard=True)
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
    monkeypatch.setattr("dro_grasp.extras.find_spec", lambda _: object())
    run_stage("pretrain", bundle, tmp_path / "with", schedule)
    log = curve(tmp_path / "with")
    assert written == [*(("total", line["total"], line["step"]) for line in log), ("closed", 0.0, 0)]


def test_a_line_now_and_then_with_the_time_that_is_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    report = console_report("training")
    for step, seconds in ((10, 0.0), (11, 1.0), (40, 60.0), (100, 61.0)):
        clock[0] = 1000.0 + seconds
        report(RunProgress(step, 100, step / 100), {"total": 0.5})
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in lines] == ["10/100", "40/100", "100/100"], "not within ten seconds, but at the end"
    assert lines[1].endswith("  2 min left"), "three tenths took a minute, so the other six take two"
    assert "total 0.5000" in lines[0]


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_seed_out_of_range_is_refused(seed: int) -> None:
    with pytest.raises(OptionError, match=rf"seed is {seed}; give an integer from 0 to 2\^63 - 1"):
        check_schedule(dataclasses.replace(SCHEDULE, seed=seed))
    check_schedule(dataclasses.replace(SCHEDULE, seed=2**62))
