"""Devices and cores of this machine; time spent on them; records of tensors: moved to a device, cached."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any, TypeVar

import torch

from dro_grasp.errors import OptionError

Record = TypeVar("Record")


def choose_device(name: str) -> str:
    """The named device; `auto` stands for CUDA if there is a GPU, and for the CPU otherwise."""
    return name if name != "auto" else "cuda" if torch.cuda.is_available() else "cpu"


def require_device(name: str) -> None:
    """Refuse a device that this machine does not have.

    Raises:
        OptionError: The name is no device, or this machine has no such device.
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        raise OptionError(f"device is '{name}'; give cpu, cuda, cuda:1 or mps") from None
    count = {"cuda": torch.cuda.device_count, "mps": torch.mps.device_count}.get(device.type)
    if count is not None and count() <= (device.index or 0):
        raise OptionError(f"device is '{name}', but torch {torch.__version__} finds {count() or 'no'} such; use --device cpu, "
                          f"which always works, or install a build of torch with {device.type.upper()}")


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_device(record: Record, device: torch.device | str) -> Record:
    """Copy a frozen dataclass to a device: its tensors, and its records that have a `to`."""
    values = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}  # type: ignore[arg-type]
    moved = {name: value.to(device) for name, value in values.items() if hasattr(value, "to")}
    return dataclasses.replace(record, **moved)  # type: ignore[type-var]


class cached_tensor(cached_property):  # type: ignore[type-arg]  # reads like the decorator it extends
    """A cached property whose tensors still work in training after inference has computed them."""

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with torch.inference_mode(False):
            return super().__get__(instance, owner)


class Stopwatch:
    """Adds up the time spent in named blocks."""

    def __init__(self, *names: str) -> None:
        """Start the named parts at zero; others appear when they run."""
        self.seconds: dict[str, float] = dict.fromkeys(names, 0.0)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count the block towards a part; CUDA, if it is in use, is waited for before the clock is read."""
        begin = time.perf_counter()
        yield
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin
