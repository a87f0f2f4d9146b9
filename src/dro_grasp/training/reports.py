"""How a training run tells people where it stands."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dro_grasp.training.runs import Run

SECONDS_BETWEEN_LINES = 10.0
"""The console gets a line this often [s]."""


def console_report(title: str) -> Callable[[Run, dict[str, float]], None]:
    """Prints a line of losses and the time left to stderr, now and then and at the end."""
    said, begin, first = 0.0, time.monotonic(), -1.0

    def report(run: Run, means: dict[str, float]) -> None:
        nonlocal said, first
        now, progress = time.monotonic(), run.progress
        first = progress if first < 0 else first
        if now - said < SECONDS_BETWEEN_LINES and progress < 1:
            return
        said = now
        left = f"{(now - begin) / (progress - first) * (1 - progress) / 60:.0f} min left" if progress > first else ""
        text = "  ".join(f"{name} {value:.4f}" for name, value in means.items())
        print(f"{title} {run.step}/{run.schedule.steps}  {text}  {left}", file=sys.stderr, flush=True)

    return report


def tensorboard_reports(folder: Path) -> list[Callable[[Run, dict[str, float]], None]]:
    """One that writes losses for TensorBoard; none where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return []
    writer = SummaryWriter(str(folder))

    def report(run: Run, means: dict[str, float]) -> None:
        for name, value in means.items():
            writer.add_scalar(name, value, run.step)
        if run.progress >= 1:
            writer.close()

    return [report]
