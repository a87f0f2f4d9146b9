"""Where tensors live: devices that are asked for must be there, and records of tensors move as one."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import torch
from torch import Tensor

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
    """A frozen dataclass of tensors and plain values with its tensors on a device; itself where they are there already."""
    if torch.device(device) == torch.device("cpu"):
        return record
    tensors = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}  # type: ignore[arg-type]
    moved = {name: value.to(device) for name, value in tensors.items() if isinstance(value, Tensor)}
    return dataclasses.replace(record, **moved)  # type: ignore[type-var]
