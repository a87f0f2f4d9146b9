"""How a training run reports its progress: on the console, and to TensorBoard."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dro_grasp.errors import OptionError

SECONDS_BETWEEN_LINES = 10.0
"""Least time between two lines on the console [s]. Source: ours."""


@dataclass(frozen=True)
class RunProgress:
    """How far a run is."""

    step: int
    """Steps done."""
    steps: int
    """Steps of the schedule."""
    share: float
    """Share of the schedule that is done: 0 at the start, 1 at the end."""


Report = Callable[[RunProgress, dict[str, float]], None]
"""Called with a run's progress and the mean losses since the last call."""


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


def require_tensorboard() -> None:
    """Refuse to log for TensorBoard where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter  # noqa: F401
    except ImportError as error:
        raise OptionError("--tensorboard needs TensorBoard, which is not installed; run pip install '.[tensorboard]' "
                          "in the folder of the clone, or leave the option out: log.jsonl holds the same numbers") from error


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
