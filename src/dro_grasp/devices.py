"""Where tensors live: devices that are asked for must be there, and records of tensors move as one."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import torch

from dro_grasp.errors import OptionError

Record = TypeVar("Record")


def choose_device(name: str) -> str:
    """The device of a name; `auto` is CUDA where there is one, and else the CPU.

    Raises:
        OptionError: There is no such device here.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    require_device(name)
    return name


def require_device(device: str) -> None:
    """Refuse a device that this machine lacks.

    Raises:
        OptionError: There is no such device here.
    """
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise OptionError(f"device is '{device}', but torch {torch.__version__} finds no CUDA device; use --device cpu, which "
                          "needs none, or install a build of torch with CUDA")


def on_device(record: Record, device: torch.device | str) -> Record:
    """A frozen dataclass with whatever it holds that can move, tensors and records with a `to`, on a device."""
    values = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}  # type: ignore[arg-type]
    moved = {name: value.to(device) for name, value in values.items() if hasattr(value, "to")}
    return dataclasses.replace(record, **moved)  # type: ignore[type-var]
