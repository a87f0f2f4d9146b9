"""A training run, as every stage of training shares it: its folder, steps, learning rate, averaged weights, resumption."""

from __future__ import annotations

import atexit
import io
import json
import math
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, distributed, nn
from torch.optim import Adam
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from dro_grasp.devices import fast_products, require_device
from dro_grasp.errors import OptionError, OutputError, TrainingError
from dro_grasp.extras import require_extra
from dro_grasp.files import FOREIGN, UNTYPED, given_path, is_unread, make_folder, reading, reason_of, replacing, set_aside
from dro_grasp.graphs import Repeated
from dro_grasp.kinds import flat
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.training.config import ScheduleConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.data.engine.shards import sole_run

SECONDS_BETWEEN_LINES = 10.0  # Least time between two lines on the console [s]. Source: ours


@dataclass(frozen=True)
class RunProgress:
    """How far a run is: steps done, those of the schedule, and the share of it that is done, from 0 to 1."""

    step: int
    steps: int
    share: float


Report = Callable[[RunProgress, dict[str, float]], None]  # Called with a run's progress and the mean losses since the last call


def console_report(title: str) -> Report:
    """Prints losses and the time left to stderr, every few seconds and at the end."""
    printed, begin, first = 0.0, time.monotonic(), -1.0

    def report(run: RunProgress, means: dict[str, float]) -> None:
        nonlocal printed, first
        now = time.monotonic()
        first = run.share if first < 0 else first
        if now - printed < SECONDS_BETWEEN_LINES and run.share < 1:
            return
        printed = now
        left = f"{(now - begin) / (run.share - first) * (1 - run.share) / 60:.0f} min left" if run.share > first else ""
        text = "  ".join(f"{name} {value:.4f}" for name, value in means.items())
        print(f"{title} {run.step}/{run.steps}  {text}  {left}", file=sys.stderr, flush=True)

    return report


def tensorboard_report(folder: Path) -> Report:
    """Writes losses for TensorBoard, which must be installed."""
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder))

    def report(run: RunProgress, means: dict[str, float]) -> None:
        for name, value in means.items():
            writer.add_scalar(name, value, run.step)
        if run.share >= 1:
            writer.close()

    return report


CHECKPOINT = "checkpoint.pt"  # File with everything that a run needs to resume
LOG = "log.jsonl"  # File with one JSON object a line: step, seconds, learning rate and mean losses
ENTRIES = ("step", "seconds", "model", "average", "optimiser", "plan")  # Entries of a checkpoint


@dataclass(frozen=True)
class RunFolder:
    """Log and checkpoint of one run; where several processes train, the first alone uses it."""

    path: Path

    def write_checkpoint(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint, whole or not at all."""
        path, temporary, content = self.path / CHECKPOINT, self.path / f"{CHECKPOINT}.part", io.BytesIO()
        torch.save(state, content)  # its own writer says of a full disk that a position was not expected
        try:
            with self._writing(path):
                # Path.write_bytes leaves a view in the traceback of a full disk, with which Python 3.12.1 ends later.
                with temporary.open("wb") as file, content.getbuffer() as view:
                    file.write(view)
                os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    def read_checkpoint(self, plan: dict[str, Any]) -> dict[str, Any] | None:
        """The checkpoint, which must have the same plan; None where there is none.

        A damaged one is set aside with its log, and the run begins anew: there is nothing else to go on from. One that
        cannot be read now may be sound, and is left alone.
        """
        path = self.path / CHECKPOINT
        if not path.is_file():
            return None
        try:
            state = _state(path)
        except FOREIGN as error:
            if is_unread(error):
                raise TrainingError(f"{path} cannot be read ({reason_of(error)}); nothing was changed. Start again once it can "
                                    "be, or use another folder") from error
            with self._writing(path):
                aside = set_aside(path, self.path / LOG)
            print(f"{path} is damaged ({type(error).__name__}) and set aside as {aside.name}, its log beside it; the training "
                  "begins anew", file=sys.stderr)
            return None
        found = state["plan"]
        for name, asked in plan.items():
            if found.get(name, asked) != asked:  # earlier versions stored less
                raise TrainingError(f"{path} belongs to a run with {name} {found[name]}, {asked} was asked for; use the "
                                    "same to resume, or another folder")
        return state

    def misfit(self, error: Exception) -> TrainingError:
        """The error of a checkpoint that cannot be used."""
        reason = str(error).partition("\n")[0] or "it is empty"
        return TrainingError(f"{self.path / CHECKPOINT} does not fit this training ({reason}); use another folder, or the "
                             "configuration it was made with")

    def append_to_log(self, line: dict[str, float]) -> None:
        """Write one line of the log."""
        with self._writing(self.path / LOG), (self.path / LOG).open("a") as file:
            file.write(json.dumps(line) + "\n")

    def cut_log(self, step: int) -> None:
        """Drop the lines after a step, among them one that was cut short."""
        log = self.path / LOG
        if not log.is_file():
            return
        kept = []
        for line in log.read_text(errors="replace").splitlines():
            try:
                if json.loads(line)["step"] <= step:
                    kept.append(line)
            except (ValueError, LookupError, TypeError, RecursionError):
                break
        with replacing(log, "the log") as temporary:
            temporary.write_text("".join(line + "\n" for line in kept))

    @contextmanager
    def _writing(self, path: Path) -> Iterator[None]:
        """Explain a full disk or a missing permission, and what is left."""
        try:
            yield
        except OSError as error:
            there = (self.path / CHECKPOINT).is_file()
            left = "the run resumes from its last checkpoint" if there else "there is no checkpoint yet, so the run begins anew"
            raise OutputError(f"cannot write {path}: {error.strerror or error}; free some space, or make it writable, and "
                              f"start again: {left}") from error


def _state(path: Path) -> dict[str, Any]:
    content = io.BytesIO(path.read_bytes())  # PyTorch's reader would hide a failing disk in a RuntimeError
    try:
        state = torch.load(content, weights_only=True, map_location="cpu")
    except UNTYPED as error:  # PyTorch takes a damaged pickle's entries for what they should be
        raise ValueError(str(error)) from error
    kinds = {"step": int, "seconds": (int, float), "plan": dict}
    if not isinstance(state, dict) or not set(ENTRIES) <= state.keys() or not all(
            isinstance(state[name], kind) for name, kind in kinds.items()):
        raise ValueError("it is no checkpoint")
    return state


def how_long(folder: Path) -> dict[str, int]:
    """Steps and seconds that a run took, by its checkpoint."""
    with reading(path := given_path(folder) / CHECKPOINT, TrainingError, "the checkpoint of a run that ended; train again"):
        state = _state(path)
        return {"steps": state["step"], "seconds": round(state["seconds"])}


BOOKKEEPING = frozenset({"minutes", "device", "log_every", "checkpoint_seconds", "tensorboard"})
"""Settings of a schedule that a resumed run may change: how long it goes on, where, and what it tells."""


def run_plan(
    config: Any, bundle: Bundle, network: NetworkConfig | None = None, **given: nn.Module | None
) -> dict[str, Any]:
    """What determines the curve of a run, by name: settings of the stage and its network, content of the data, weights.

    `given` are weights that the run begins with or takes parts of, by role; their parameters count, not their names.
    """
    settings = {name: value for name, value in flat(config).items() if name.removeprefix("schedule.") not in BOOKKEEPING}
    weights = {role: None if each is None else _digest(each) for role, each in given.items()}
    about = {} if network is None else flat(network, "network.")
    return {name.removeprefix("schedule."): value for name, value in settings.items()} | about | weights | {
        "bundle": bundle.fingerprint}


def _digest(network: nn.Module) -> str:
    """Twelve digits that tell parameters apart; statistics of BatchNorm do not count, as each sitting measures its own."""
    digest = sha256()
    for parameter in network.parameters():
        digest.update(parameter.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class Processes:
    """This process, by its number, among those that train together; a process alone by default."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and reports."""
        return self.rank == 0

    def add_up(self, tensors: Iterable[Float[Tensor, "..."]]) -> None:
        """Replace every tensor by its sum over all processes, in one message."""
        tensors = list(tensors)
        if self.count == 1 or not tensors:
            return
        message = torch.cat([t.flatten() for t in tensors])
        distributed.all_reduce(message)
        for tensor, part in zip(tensors, message.split([t.numel() for t in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def from_first(self, value: Any) -> Any:
        """The first process's value, in all processes; the others may lack its disk."""
        if self.count == 1:
            return value
        box = [value]
        distributed.broadcast_object_list(box)
        return box[0]


def is_first() -> bool:
    """Whether this process writes files and reports, according to torchrun; true without torchrun."""
    return os.environ.get("RANK", "0") == "0"


def process_count() -> int:
    """Number of processes that torchrun started; one without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


class Ahead:
    """Draws the samples of the next shard in a thread, on a stream of its own, while a GPU computes the losses of this one."""

    def __init__(self, generator: torch.Generator, kept: int) -> None:
        """Make ready; `generator` goes on as if it had drawn the samples. The GPU is waited for every `kept` shards."""
        self.generator, device = generator, generator.device
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        if self._stream is not None:
            self._stream.wait_stream(torch.cuda.current_stream(device))
        self._thread = ThreadPoolExecutor(1)
        self._begun: dict[int, Future[tuple[Any, UInt8[Tensor, " state"], Any]]] = {}
        # The stream's memory may be used again only once the losses have been computed.
        self._kept: deque[Any] = deque(maxlen=kept)

    def take(self, draw: Callable[[torch.Generator], Any], seed: int, following: int) -> Any:
        """The samples of a seed; those of the following one are begun."""
        samples, state, done = (self._begun.pop(seed, None) or self._thread.submit(self._drawn, draw, seed)).result()
        self._begun = {following: self._thread.submit(self._drawn, draw, following)}
        self.generator.set_state(state)
        if done is not None:
            torch.cuda.current_stream(self.generator.device).wait_event(done)
        self._kept.append(samples)
        return samples

    def _drawn(self, draw: Callable[[torch.Generator], Any], seed: int) -> tuple[Any, UInt8[Tensor, " state"], Any]:
        generator = torch.Generator(self.generator.device)
        generator.manual_seed(seed)
        if self._stream is None:
            return draw(generator), generator.get_state(), None
        with torch.cuda.device(generator.device), torch.cuda.stream(self._stream):
            return draw(generator), generator.get_state(), self._stream.record_event()

    def close(self) -> None:
        """End the thread; what it has begun is not needed."""
        self._thread.shutdown(cancel_futures=True)


def draws_ahead(device: torch.device) -> bool:
    """Whether samples are drawn in a thread: where the processor has time for it, beside a GPU."""
    return device.type == "cuda"


Losses = dict[str, Float[Tensor, ""]]  # Losses of a batch by name; `total` is minimised


class TrainingRun:
    """A model in training, with everything that a checkpoint must hold to reproduce the curve.

    A step's batch consists of shards. A shard's random numbers follow from the seed, the step and the shard's number
    alone. Processes share the shards and add up their gradients: any number of them reproduces the same curve.
    """

    def __init__(
        self, folder: Path, model: nn.Module, schedule: ScheduleConfig, generator: torch.Generator,
        processes: Processes | None = None, plan: Mapping[str, Any] | None = None,
    ) -> None:
        """Prepare optimiser and averaged weights; nothing is read or written before `train`.

        Args:
            model: What is trained, on its device; parameters that require no gradient stay as they are.
            generator: Source of all random numbers of the losses, on the model's device.
            plan: What determines the curve beside the schedule (see `run_plan`): a checkpoint resumes only with the same.
        """
        self.folder, self.model, self.schedule, self.generator = RunFolder(given_path(folder)), model, schedule, generator
        self.processes = processes or Processes()
        self.plan = {"steps": schedule.steps, "learning_rate": schedule.learning_rate, "seed": schedule.seed,
                     "shards": schedule.shards, **(plan or {})}
        self.optimiser = Adam(self._trained(), lr=schedule.learning_rate)
        self.average = AveragedModel(
            model, multi_avg_fn=get_ema_multi_avg_fn(schedule.average_decay), use_buffers=True)
        self.step = 0
        self.seconds = 0.0  # spent training, over all sittings [s]
        self._clock = 0.0  # when time was last added [s]
        self._names, self._moved = list[str](), list[nn.Parameter]()  # losses, and parameters on which they depend
        self._shard, self._ahead = 0, None if not draws_ahead(generator.device) else Ahead(
            generator, -(-schedule.shards // self.processes.count))

    @property
    def progress(self) -> float:
        """Share of the schedule that is done: 0 at the start, 1 at the end."""
        steps = self.step / self.schedule.steps
        limit = self.schedule.minutes
        return steps if limit is None else max(steps, self.seconds / (60 * limit))

    def train(
        self, losses: Callable[..., Losses], report: Report, draw: Callable[[torch.Generator], Any] | None = None
    ) -> None:
        """Make the folder or resume from its checkpoint, step until the schedule ends, and give the model the average.

        Args:
            losses: Those of one shard. What it computes follows from the samples that it is given, the model and the
                generator alone, so that a GPU may record it once (see `Repeated`); without `draw` it is given none, and is
                never recorded.
            report: Called every few steps.
            draw: Draws the samples of a shard, before any other of its random numbers.

        Raises:
            TrainingError: A loss or the gradient is not finite, or the folder holds the checkpoint of another run.
            OutputError: The folder cannot be made, another run is filling it, or log or checkpoint cannot be written.
        """
        if self.processes.first:
            with sole_run(make_folder(self.folder.path)):
                self._train(losses, report, draw)
        else:
            self._train(losses, report, draw)

    def _train(self, losses: Callable[..., Losses], report: Report, draw: Callable[[torch.Generator], Any] | None) -> None:
        reports = []
        if self.processes.first:
            reports.append(report)
            if self.schedule.tensorboard:
                reports.append(tensorboard_report(self.folder.path))
        self._resume()
        try:
            device = self.generator.device
            with fast_products(), torch.cuda.device(device) if device.type == "cuda" else nullcontext():
                self._steps(self._computing(losses, draw), reports)
        finally:
            if self._ahead is not None:
                self._ahead.close()
        self.save()
        self.model.load_state_dict(self.average.module.state_dict())

    def seed_shard(self, shard: int = 0) -> None:
        """Seed the random numbers of a shard of the next step."""
        self._shard = shard
        self.generator.manual_seed(self._seed(self.step, shard))

    def _seed(self, step: int, shard: int) -> int:
        return ((self.schedule.seed * 1_000_003 + step) * 1_009 + shard) % 2**63

    def _computing(
        self, losses: Callable[..., Losses], draw: Callable[[torch.Generator], Any] | None
    ) -> Callable[[], list[Float[Tensor, "..."]]]:
        """What computes the losses of the shard that was seeded last, and their gradients."""
        if draw is None:
            return lambda: self._gradients(losses())
        repeated = Repeated(lambda samples: tuple(self._gradients(losses(samples))), self.generator)
        return lambda: list(repeated(self._drawn(draw)))

    def _gradients(self, values: Losses) -> list[Float[Tensor, "..."]]:
        """A shard's share of the losses, and of the gradient of each parameter that has one."""
        trained = self._trained()
        found = torch.autograd.grad(values["total"] / self.schedule.shards, trained, allow_unused=True)
        self._names, self._moved = list(values), [p for p, g in zip(trained, found, strict=True) if g is not None]
        shares = torch.stack([value.detach() for value in values.values()]) / self.schedule.shards
        return [shares, *(gradient for gradient in found if gradient is not None)]

    def _drawn(self, draw: Callable[[torch.Generator], Any]) -> Any:
        """The samples of the shard that was seeded last."""
        if self._ahead is None:
            return draw(self.generator)
        step, shard = self.step, self._shard + self.processes.count
        if shard >= self.schedule.shards:
            step, shard = step + 1, self.processes.rank
        return self._ahead.take(draw, self._seed(self.step, self._shard), self._seed(step, shard))

    def save(self) -> None:
        """Write the checkpoint into the folder, which exists; the first process does."""
        if self.processes.first:
            self.folder.write_checkpoint({
                "step": self.step, "seconds": self.seconds, "model": self.model.state_dict(),
                "average": self.average.state_dict(), "optimiser": self.optimiser.state_dict(), "plan": self.plan,
            })

    def _resume(self) -> None:
        state = self.folder.read_checkpoint(self.plan) if self.processes.first else None
        state = self.processes.from_first(state)
        if state is not None:
            try:
                self.model.load_state_dict(state["model"])
                self.average.load_state_dict(state["average"])
                self.optimiser.load_state_dict(state["optimiser"])
            except (RuntimeError, LookupError, TypeError, ValueError) as error:
                raise self.folder.misfit(error) from error
            self.step, self.seconds = state["step"], state["seconds"]
        if self.processes.first:
            self.folder.cut_log(self.step)

    def _steps(self, computed: Callable[[], list[Float[Tensor, "..."]]], reports: list[Report]) -> None:
        sums: dict[str, float] = {}
        counted, saved = 0, time.monotonic()
        self._clock = saved
        while self.progress < 1:
            for name, value in self._step(computed).items():
                sums[name] = sums.get(name, 0.0) + value
            counted += 1
            if self.step % self.schedule.log_every == 0 or self.progress >= 1:
                self._tell({name: total / counted for name, total in sums.items()}, reports)
                sums, counted = {}, 0
            # A checkpoint follows a line of the log only, so that a resumed log has neither a gap nor a double line.
            if counted == 0 and time.monotonic() - saved >= self.schedule.checkpoint_seconds:
                self.save()
                saved = time.monotonic()

    def _step(self, computed: Callable[[], list[Float[Tensor, "..."]]]) -> dict[str, float]:
        """One step of the optimiser; returns the losses before it, mean over the shards of all processes."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.schedule.learning_rate * learning_rate_share(self.step, self.progress, self.schedule)
        sums = list[Tensor]()
        for shard in range(self.processes.rank, self.schedule.shards, self.processes.count):
            self.seed_shard(shard)
            values = computed()
            sums = [a + b for a, b in zip(sums, values, strict=True)] if sums else values
        losses, *gradients = sums
        elapsed = self._elapsed()
        self.processes.add_up([losses, elapsed, *gradients])
        self.optimiser.zero_grad(set_to_none=True)
        for parameter, gradient in zip(self._moved, gradients, strict=True):
            parameter.grad = gradient
        norm = nn.utils.clip_grad_norm_(self._trained(), self.schedule.gradient_norm)
        *found, size, seconds = torch.cat([losses, norm.detach()[None], elapsed]).tolist()
        means = dict(zip(self._names, found, strict=True))
        self._check(means)
        self._check({"gradient": size})
        self.optimiser.step()
        self.average.update_parameters(self.model)
        self.step += 1
        self.seconds += seconds
        return means

    def _elapsed(self) -> Float[Tensor, "1"]:
        """Time since the last call by the first process's clock, zero in the others: all must end at the same step [s]."""
        before, self._clock = self._clock, time.monotonic()
        return torch.tensor([self._clock - before if self.processes.first else 0.0], device=self.generator.device)

    def _trained(self) -> list[nn.Parameter]:
        return [p for p in self.model.parameters() if p.requires_grad]

    def _check(self, values: dict[str, float]) -> None:
        wrong = [name for name, value in values.items() if not math.isfinite(value)]
        if len(wrong) > 1 and "total" in wrong:
            wrong.remove("total")
        if wrong:
            raise TrainingError(f"{', '.join(wrong)} is not finite at step {self.step}; the last checkpoint in "
                                f"{self.folder.path} is sound. Lower the learning rate or check the data")

    def _tell(self, means: dict[str, float], reports: list[Report]) -> None:
        if self.processes.first:
            rate = self.optimiser.param_groups[0]["lr"]
            self.folder.append_to_log(
                {"step": self.step, "seconds": round(self.seconds, 3), "learning_rate": rate, **means})
        for report in reports:
            report(RunProgress(self.step, self.schedule.steps, self.progress), means)


def begin(schedule: ScheduleConfig) -> tuple[Processes, str]:
    """Check a schedule, join the processes that torchrun started, if any, and take a device of one's own.

    Processes stay joined until they end, so a second stage of training finds them joined. Device `cuda` stands for the GPU
    with this process's number on its machine.
    """
    check_schedule(schedule)
    device = schedule.device
    if process_count() == 1:
        return Processes(), device
    if device == "cuda":
        number, there = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
        if number >= there:
            raise OptionError(f"process {number} finds no GPU of its own, there are {there} here; start it with "
                              f"`torchrun --nproc-per-node {there}`")
        device = f"cuda:{number}"
        torch.cuda.set_device(number)
    if not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        atexit.register(distributed.destroy_process_group)
    return Processes(distributed.get_rank(), distributed.get_world_size()), device


def learning_rate_share(step: int, progress: float, schedule: ScheduleConfig) -> float:
    """Linear warm-up over the first steps, times a cosine to zero over the whole schedule."""
    warmup = min(1.0, (step + 1) / max(1, schedule.warmup_steps))
    return warmup * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def check_schedule(schedule: ScheduleConfig) -> None:
    """Refuse a schedule that cannot be carried out here."""
    require_device(schedule.device)
    if not 0 <= schedule.seed < 2**63:
        raise OptionError(f"seed is {schedule.seed}; give an integer from 0 to 2^63 - 1")
    for name in ("steps", "minutes", "learning_rate", "log_every", "recalibration", "shards"):
        value = getattr(schedule, name)
        if value is not None and not 0 < value < math.inf:
            raise OptionError(f"{name} is {value}; give a positive number")
    if schedule.shards % process_count():
        raise OptionError(f"{process_count()} processes cannot share {schedule.shards} shards a step; give a multiple of "
                          f"{process_count()}")
    if schedule.tensorboard:
        require_extra("tensorboard")


@torch.no_grad()
def recalibrate(model: nn.Module, forward: Callable[[], object], batches: int) -> None:
    """Measure the statistics of BatchNorm for the averaged weights.

    The averages kept during training belong to other weights: with them the distance error in evaluation mode is
    twice that in training mode. Layers in evaluation mode, as in a frozen encoder, keep their statistics. `forward` passes
    the next batch of training data through the model.
    """
    layers = [layer for layer in model.modules() if isinstance(layer, nn.BatchNorm1d) and layer.training]
    momenta = [layer.momentum for layer in layers]
    for layer in layers:
        layer.reset_running_stats()
        layer.momentum = None
    for _ in range(batches):
        forward()
    for layer, momentum in zip(layers, momenta, strict=True):
        layer.momentum = momentum
