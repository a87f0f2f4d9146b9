"""What both training loops share: the run folder, its log, checkpoints, the learning rate."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Adam
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from dro_grasp.devices import require_device
from dro_grasp.errors import OptionError, OutputError, TrainingError
from dro_grasp.models.precision import fast_products
from dro_grasp.training.config import ScheduleConfig
from dro_grasp.training.processes import Processes
from dro_grasp.training.reports import tensorboard_reports

CHECKPOINT = "checkpoint.pt"
LOG = "log.jsonl"


@dataclass
class Run:
    """A model in training, with everything that a checkpoint must hold to go on alike.

    A step's batch consists of shards, each with random numbers that follow from the seed, the step and the shard's number
    alone. Processes share the shards out and add up their gradients: however many they are, they descend the same curve.
    """

    folder: Path
    model: nn.Module
    schedule: ScheduleConfig
    generator: torch.Generator
    processes: Processes = field(default_factory=Processes)
    optimiser: Adam = field(init=False)
    average: AveragedModel = field(init=False)
    step: int = field(default=0, init=False)
    seconds: float = field(default=0.0, init=False)
    """Time spent training, over all sittings [s]."""
    _clock: float = field(default=0.0, init=False)
    """When time was last added."""

    def __post_init__(self) -> None:
        """Make optimiser and average; take up the folder's checkpoint if there is one."""
        check_schedule(self.schedule, self.processes)
        if self.processes.first:
            make_run_folder(self.folder)
        self.optimiser = Adam(self._trained(), lr=self.schedule.learning_rate)
        self.average = AveragedModel(
            self.model, multi_avg_fn=get_ema_multi_avg_fn(self.schedule.average_decay), use_buffers=True
        )
        state = self._read() if self.processes.first and (self.folder / CHECKPOINT).is_file() else None
        state = self.processes.from_first(state)
        if state is not None:
            self._resume(state)
        if self.processes.first:
            self._cut_log()

    @property
    def progress(self) -> float:
        """How much of the schedule is behind: 0 at the start, 1 at the end."""
        steps = self.step / self.schedule.steps
        limit = self.schedule.minutes
        return steps if limit is None else max(steps, self.seconds / (60 * limit))

    def train(self, losses: Callable[[], dict[str, torch.Tensor]], report: Callable[[Run, dict[str, float]], None]) -> None:
        """Steps until the schedule ends.

        Args:
            losses: Makes the next batch and returns its losses by name; `total` is descended.
            report: Called with the run and the mean losses since the last call, every `log_every` steps.

        Raises:
            TrainingError: A loss or the gradient is not finite.
            OutputError: Log or checkpoint cannot be written.
        """
        reports = [report] if self.processes.first else []
        if self.schedule.tensorboard and self.processes.first:
            reports += tensorboard_reports(self.folder)
        with fast_products():
            self._steps(losses, reports)
        self.save()

    def _steps(
        self, losses: Callable[[], dict[str, torch.Tensor]], reports: list[Callable[[Run, dict[str, float]], None]]
    ) -> None:
        sums: dict[str, float] = {}
        counted, saved = 0, time.monotonic()
        self._clock = saved
        while self.progress < 1:
            for name, value in self._step(losses).items():
                sums[name] = sums.get(name, 0.0) + value
            counted += 1
            if self.step % self.schedule.log_every == 0 or self.progress >= 1:
                means = {name: total / counted for name, total in sums.items()}
                if self.processes.first:
                    self._log(means)
                for report in reports:
                    report(self, means)
                sums, counted = {}, 0
            # A checkpoint goes only where the log has a line, so that a resumed log has neither gap nor double.
            if counted == 0 and time.monotonic() - saved >= self.schedule.checkpoint_seconds:
                self.save()
                saved = time.monotonic()

    def _step(self, losses: Callable[[], dict[str, torch.Tensor]]) -> dict[str, float]:
        """One step of the optimiser; returns the losses before it, mean over the shards of all processes."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.schedule.learning_rate * learning_rate_share(self.step, self.progress, self.schedule)
        self.optimiser.zero_grad(set_to_none=True)
        names: list[str] = []
        sums: Tensor | None = None
        for shard in range(self.processes.rank, self.schedule.shards, self.processes.count):
            self.seed_shard(shard)
            values = losses()
            (values["total"] / self.schedule.shards).backward()
            shares = torch.stack([value.detach() for value in values.values()]) / self.schedule.shards
            names, sums = list(values), shares if sums is None else sums + shares
        assert sums is not None
        gradients = [p.grad for p in self._trained() if p.grad is not None]
        elapsed = self._elapsed()
        self.processes.add_up([sums, elapsed, *gradients])
        norm = nn.utils.clip_grad_norm_(self._trained(), self.schedule.gradient_norm)
        *found, size, seconds = torch.cat([sums, norm.detach()[None], elapsed]).tolist()
        means = dict(zip(names, found, strict=True))
        self._check(means)
        self._check({"gradient": size})
        self.optimiser.step()
        self.average.update_parameters(self.model)
        self.step += 1
        self.seconds += seconds
        return means

    def _elapsed(self) -> Tensor:
        """Time since the last call by the first process's clock, zero in the others: all must end at the same step."""
        before, self._clock = self._clock, time.monotonic()
        return torch.tensor([self._clock - before if self.processes.first else 0.0], device=self.generator.device)

    def seed_shard(self, shard: int = 0) -> None:
        """Begin the random numbers, the model's own included, of a shard of the next step."""
        seed = (self.schedule.seed * 1_000_003 + self.step) * 1_009 + shard
        self.generator.manual_seed(seed)
        torch.manual_seed(seed)

    def _trained(self) -> list[nn.Parameter]:
        return [p for p in self.model.parameters() if p.requires_grad]

    def save(self) -> None:
        """Write the checkpoint, whole or not at all; the first process does.

        Raises:
            OutputError: It cannot be written.
        """
        if not self.processes.first:
            return
        state = {
            "step": self.step, "seconds": self.seconds, "model": self.model.state_dict(),
            "average": self.average.state_dict(), "optimiser": self.optimiser.state_dict(), "plan": self._plan(),
        }
        path, temporary = self.folder / CHECKPOINT, self.folder / f"{CHECKPOINT}.part"
        try:
            with writing_into(self.folder):
                torch.save(state, temporary)
                os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    def _plan(self) -> dict[str, Any]:
        """What decides on a run's curve beside model and data; a checkpoint goes on only with the same."""
        s = self.schedule
        return {"steps": s.steps, "learning_rate": s.learning_rate, "seed": s.seed, "shards": s.shards}

    def _read(self) -> dict[str, Any]:
        path = self.folder / CHECKPOINT
        try:
            state = torch.load(path, weights_only=True, map_location="cpu")
            _ = [state[key] for key in ("step", "seconds", "model", "average", "optimiser", "plan")]
        except (RuntimeError, LookupError, TypeError, ValueError, EOFError, OSError, UnpicklingError) as error:
            raise self._misfit(error) from error
        for name, asked in self._plan().items():
            if state["plan"].get(name) != asked:
                raise TrainingError(f"{path} belongs to a run with {name} {state['plan'].get(name)}, {asked} was asked for; "
                                    "use the same to go on, or another folder")
        return state

    def _resume(self, state: dict[str, Any]) -> None:
        try:
            self.model.load_state_dict(state["model"])
            self.average.load_state_dict(state["average"])
            self.optimiser.load_state_dict(state["optimiser"])
        except (RuntimeError, LookupError, TypeError, ValueError) as error:
            raise self._misfit(error) from error
        self.step, self.seconds = state["step"], state["seconds"]

    def _misfit(self, error: Exception) -> TrainingError:
        reason = str(error).partition("\n")[0] or "it is empty"
        return TrainingError(f"{self.folder / CHECKPOINT} does not fit this training ({reason}); use another folder, or the "
                             "configuration it was made with")

    def _cut_log(self) -> None:
        """Drop the log's lines after the checkpoint, all where there is none; a line that was cut short is one of them."""
        log = self.folder / LOG
        if not log.is_file():
            return
        kept = []
        for line in log.read_text().splitlines():
            try:
                if json.loads(line)["step"] <= self.step:
                    kept.append(line)
            except json.JSONDecodeError:
                break
        log.write_text("".join(line + "\n" for line in kept))

    def _check(self, values: dict[str, float]) -> None:
        wrong = [name for name, value in values.items() if not math.isfinite(value)]
        if len(wrong) > 1 and "total" in wrong:
            wrong.remove("total")
        if wrong:
            raise TrainingError(f"{', '.join(wrong)} is not finite at step {self.step}; the last checkpoint in "
                                f"{self.folder} is sound. Lower the learning rate or check the data")

    def _log(self, means: dict[str, float]) -> None:
        line = {"step": self.step, "seconds": round(self.seconds, 3), "learning_rate": self.learning_rate, **means}
        with writing_into(self.folder), (self.folder / LOG).open("a") as file:
            file.write(json.dumps(line) + "\n")

    @property
    def learning_rate(self) -> float:
        """The rate of the last step."""
        return self.optimiser.param_groups[0]["lr"]


def learning_rate_share(step: int, progress: float, schedule: ScheduleConfig) -> float:
    """Linear warm-up over the first steps, times a cosine to zero over the whole schedule."""
    warmup = min(1.0, (step + 1) / max(1, schedule.warmup_steps))
    return warmup * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def check_schedule(schedule: ScheduleConfig, processes: Processes) -> None:
    """Refuse a schedule without end or without a step, a device that is not there, and shards that cannot be shared out.

    Raises:
        OptionError: A number is not positive and finite, this machine lacks the device, or the processes would get
            different numbers of shards.
    """
    require_device(schedule.device)
    for name in ("steps", "minutes", "learning_rate", "log_every", "shards"):
        value = getattr(schedule, name)
        if value is not None and not 0 < value < math.inf:
            raise OptionError(f"{name} is {value}; give a positive number")
    if schedule.shards % processes.count:
        raise OptionError(f"{schedule.shards} shards a step cannot be shared out among {processes.count} processes; give a "
                          f"multiple of {processes.count}")


@contextmanager
def writing_into(folder: Path) -> Iterator[None]:
    """Tells of a full disk or a missing permission; PyTorch's writer says RuntimeError for both.

    Raises:
        OutputError: The block could not write.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise OutputError(f"cannot write into {folder}: {error}; free some space, or make it writable, and start again: the "
                          "run goes on from its last checkpoint") from error


def last_logged(folder: Path) -> dict[str, float]:
    """The last line of a run's log: steps, seconds and losses when it ended."""
    return json.loads((folder / LOG).read_text().splitlines()[-1])


def make_run_folder(folder: Path) -> None:
    """The folder of a run; its parent must exist.

    Raises:
        OutputError: It cannot be made.
    """
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the run folder {folder}: {error.strerror}; create {folder.parent} first") from error
