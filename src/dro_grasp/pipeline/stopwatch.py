"""Seconds by part of the work."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class Stopwatch:
    """Adds up the time spent in named blocks."""

    def __init__(self, *names: str, device: torch.device | str = "cpu") -> None:
        """Start every part at zero.

        Args:
            names: Parts that are listed even when they never run.
            device: Where the work runs; CUDA is waited for before the clock is read.
        """
        self.seconds: dict[str, float] = dict.fromkeys(names, 0.0)
        self._device = torch.device(device)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count the block towards a part."""
        begin = time.perf_counter()
        yield
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin
