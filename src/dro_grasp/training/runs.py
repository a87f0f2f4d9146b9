"""What both training loops share: the run folder, its log, checkpoints, the learning rate."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.optim import Adam
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from dro_grasp.errors import OutputError, TrainingError
from dro_grasp.training.config import ScheduleConfig

CHECKPOINT = "checkpoint.pt"
LOG = "log.jsonl"


@dataclass
class Run:
    """A model in training, with everything that a checkpoint must hold to go on alike."""

    folder: Path
    model: nn.Module
    schedule: ScheduleConfig
    generator: torch.Generator
    optimiser: Adam = field(init=False)
    scheduler: LambdaLR = field(init=False)
    average: AveragedModel = field(init=False)
    step: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        """Make optimiser, schedule and average; take up the folder's checkpoint if there is one."""
        make_run_folder(self.folder)
        parameters = [p for p in self.model.parameters() if p.requires_grad]
        self.optimiser = Adam(parameters, lr=self.schedule.learning_rate)
        self.scheduler = LambdaLR(self.optimiser, lambda step: learning_rate_share(step, self.schedule))
        self.average = AveragedModel(
            self.model, multi_avg_fn=get_ema_multi_avg_fn(self.schedule.average_decay), use_buffers=True
        )
        if (self.folder / CHECKPOINT).is_file():
            self._resume()

    def train(self, losses: Callable[[], dict[str, torch.Tensor]], report: Callable[[Run, dict[str, float]], None]) -> None:
        """Steps until the schedule ends.

        Args:
            losses: Makes the next batch and returns its losses by name; `total` is descended.
            report: Called with the run and the mean losses since the last call, every `log_every` steps.

        Raises:
            TrainingError: A loss is not finite.
        """
        sums: dict[str, float] = {}
        counted = 0
        saved = time.monotonic()
        while self.step < self.schedule.steps:
            values = losses()
            self._check(values)
            self.optimiser.zero_grad(set_to_none=True)
            values["total"].backward()
            nn.utils.clip_grad_norm_(self.model.parameters(), self.schedule.gradient_norm)
            self.optimiser.step()
            self.scheduler.step()
            self.average.update_parameters(self.model)
            self.step += 1
            counted += 1
            for name, value in values.items():
                sums[name] = sums.get(name, 0.0) + float(value.detach())
            if self.step % self.schedule.log_every == 0 or self.step == self.schedule.steps:
                means = {name: total / counted for name, total in sums.items()}
                self._log(means)
                report(self, means)
                sums, counted = {}, 0
            # A checkpoint goes only where the log has a line, so that a resumed log has neither gap nor double.
            if counted == 0 and time.monotonic() - saved > self.schedule.checkpoint_seconds:
                self.save()
                saved = time.monotonic()
        self.save()

    def save(self) -> None:
        """Write the checkpoint, whole or not at all."""
        state = {
            "step": self.step, "model": self.model.state_dict(), "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(), "scheduler": self.scheduler.state_dict(),
            "generator": self.generator.get_state(), "torch_rng": torch.get_rng_state(), "steps": self.schedule.steps,
        }
        handle, temporary = tempfile.mkstemp(dir=self.folder, suffix=".part")
        with os.fdopen(handle, "wb") as file:
            torch.save(state, file)
        os.replace(temporary, self.folder / CHECKPOINT)

    def _resume(self) -> None:
        path = self.folder / CHECKPOINT
        try:
            state = torch.load(path, weights_only=True)
            if state["steps"] != self.schedule.steps:
                raise TrainingError(f"{path} belongs to a run of {state['steps']} steps, {self.schedule.steps} were asked "
                                    "for; use the same number to go on, or another folder")
            self.model.load_state_dict(state["model"])
            self.average.load_state_dict(state["average"])
        except (RuntimeError, KeyError, EOFError) as error:
            raise TrainingError(f"{path} does not fit this training ({str(error).splitlines()[0]}); use another folder, or "
                                "the configuration it was made with") from error
        self.optimiser.load_state_dict(state["optimiser"])
        self.scheduler.load_state_dict(state["scheduler"])
        self.generator.set_state(state["generator"])
        torch.set_rng_state(state["torch_rng"])
        self.step = state["step"]
        log = self.folder / LOG
        if log.is_file():
            kept = [line for line in log.read_text().splitlines() if line and json.loads(line)["step"] <= self.step]
            log.write_text("".join(line + "\n" for line in kept))

    def _check(self, values: dict[str, torch.Tensor]) -> None:
        wrong = [name for name, value in values.items() if not bool(torch.isfinite(value))]
        if wrong:
            raise TrainingError(f"loss {', '.join(wrong)} is not finite at step {self.step}; the last checkpoint in "
                                f"{self.folder} is sound. Lower the learning rate or check the data")

    def _log(self, means: dict[str, float]) -> None:
        line = {"step": self.step, "learning_rate": self.scheduler.get_last_lr()[0], **means}
        with (self.folder / LOG).open("a") as file:
            file.write(json.dumps(line) + "\n")


def learning_rate_share(step: int, schedule: ScheduleConfig) -> float:
    """Linear warm-up, then a cosine to zero."""
    if step < schedule.warmup_steps:
        return (step + 1) / schedule.warmup_steps
    progress = (step - schedule.warmup_steps) / max(1, schedule.steps - schedule.warmup_steps)
    return 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def make_run_folder(folder: Path) -> None:
    """The folder of a run; its parent must exist.

    Raises:
        OutputError: It cannot be made.
    """
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the run folder {folder}: {error.strerror}; create {folder.parent} first") from error


def console_report(title: str) -> Callable[[Run, dict[str, float]], None]:
    """Prints a line of losses and the time left to stderr, at most every ten seconds."""
    import sys

    state: dict[str, Any] = {"begin": time.monotonic(), "first": None, "said": 0.0}

    def report(run: Run, means: dict[str, float]) -> None:
        now = time.monotonic()
        state["first"] = run.step if state["first"] is None else state["first"]
        if now - state["said"] < 10 and run.step < run.schedule.steps:
            return
        state["said"] = now
        done = run.step - state["first"]
        left = (now - state["begin"]) / max(done, 1) * (run.schedule.steps - run.step) if done else float("nan")
        text = "  ".join(f"{name} {value:.4f}" for name, value in means.items())
        print(f"{title} {run.step}/{run.schedule.steps}  {text}  {left / 60:.0f} min left", file=sys.stderr, flush=True)

    return report


def tensorboard_report(folder: Path) -> Callable[[Run, dict[str, float]], None] | None:
    """Writes losses for TensorBoard; None where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    writer = SummaryWriter(str(folder))

    def report(run: Run, means: dict[str, float]) -> None:
        for name, value in means.items():
            writer.add_scalar(name, value, run.step)

    return report
