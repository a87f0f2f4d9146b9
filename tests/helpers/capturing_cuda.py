"""PyTorch's side of captures, without CUDA: what generators and memory go through, and what a capture that CUDA refuses leaves.

As of PyTorch 2.6 to 2.11: `capture_end` raises before it has ended what `capture_begin` began.
"""

from __future__ import annotations

from collections import Counter
from contextlib import nullcontext
from itertools import count
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from dro_grasp import graphs

DEVICE = torch.device("meta", 7)
"""Where captures are made; the number is of no real device."""


class Generator:
    """A source of numbers with a state that may be exchanged."""

    device = DEVICE

    def __init__(self, cuda: CapturingCuda, offset: int = 0) -> None:
        self.cuda, self.state = cuda, SimpleNamespace(offset=offset, capturing=False)

    def draw(self) -> int:
        """The next number."""
        if self.state.capturing != self.cuda.capturing:
            raise RuntimeError("Offset increment outside graph capture encountered unexpectedly.")
        self.state.offset += not self.cuda.capturing
        return self.state.offset

    def clone_state(self) -> Generator:
        return Generator(self.cuda, self.state.offset)

    def graphsafe_set_state(self, other: Generator) -> None:
        self.state = other.state


class Graph:
    """A graph, which holds its pool's memory once it is captured."""

    def __init__(self, cuda: CapturingCuda) -> None:
        self.cuda, self.states, self.own, self.ended = cuda, [cuda.default.state], None, False

    def register_generator_state(self, generator: Generator) -> None:
        self.states.append(generator.state)

    def capture_begin(self, pool: Any = None, capture_error_mode: str = "global") -> None:
        self.own = self.cuda.new_pool() if pool is None else pool
        if self.own in self.cuda.underway or (self.own in self.cuda.users and not self.cuda.users[self.own]):
            raise RuntimeError("already recording to mempool_id, or nobody uses it")
        self.cuda.underway.append(self.own)
        self.cuda.users[self.own] += 1
        self.cuda.capturing = True
        for state in self.states:
            state.capturing = True

    def capture_end(self) -> None:
        self.cuda.capturing, refused, self.cuda.refused = False, self.cuda.refused, False
        if refused:
            raise RuntimeError("operation failed due to a previous error during capture")
        self.cuda.end(DEVICE.index, self.own)
        for state in self.states:
            state.capturing = False
        self.ended = True

    def pool(self) -> Any:
        assert self.ended
        return self.own

    def replay(self) -> None:
        assert not self.cuda.capturing

    def __del__(self) -> None:
        if self.ended:
            self.cuda.users[self.own] -= 1


class CapturingCuda:
    """What stands where `torch.cuda` was."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.capturing, self.refused = False, False
        self.underway, self.users, self._numbers = list[Any](), Counter[Any](), count(1)
        self.default = Generator(self)
        stream = SimpleNamespace(device=DEVICE, wait_stream=lambda other: None)
        monkeypatch.setattr(graphs, "captures", lambda device: device.type == DEVICE.type)
        monkeypatch.setattr(graphs, "_capture_stream", lambda device: stream)
        here = Stream()
        for name, value in {
            "CUDAGraph": lambda: Graph(self), "current_stream": lambda device: here, "stream": lambda stream: nullcontext(),
            "graph_pool_handle": self.new_pool, "default_generators": {DEVICE.index: self.default},
        }.items():
            monkeypatch.setattr(torch.cuda, name, value)
        monkeypatch.setattr(torch._C, "_cuda_endAllocateToPool", self.end)
        monkeypatch.setattr(torch._C, "_cuda_releasePool", self.release)

    def new_pool(self) -> tuple[int, int]:
        return 0, next(self._numbers)

    def wait(self) -> None:
        """Wait for the device, which CUDA refuses while it captures."""
        if self.capturing:
            self.refused = True
            raise RuntimeError("operation not permitted when stream is capturing")

    def end(self, device: int, pool: Any) -> None:
        if pool not in self.underway:
            raise RuntimeError("endAllocatePool: not currently recording to mempool_id")
        self.underway.remove(pool)

    def release(self, device: int, pool: Any) -> None:
        self.users[pool] -= 1
        assert self.users[pool] >= 0


class Stream:
    """The stream on which the work is repeated."""

    def wait_stream(self, other: Any) -> None:
        """Nothing runs here."""
