"""Records, which are frozen dataclasses: moved to a device, by rows, with tensors that are computed once, as settings."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

Record = TypeVar("Record")


def on_device(record: Record, device: torch.device | str) -> Record:
    """Copy a frozen dataclass to a device: its tensors, and its records that have a `to`."""
    values = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}  # type: ignore[arg-type]
    moved = {name: value.to(device) for name, value in values.items() if hasattr(value, "to")}
    return dataclasses.replace(record, **moved)  # type: ignore[type-var]


def flat(record: Any, prefix: str = "") -> dict[str, Any]:
    """The values of a dataclass and of those in it, by name; what is nested has dots in its name."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        name = f"{prefix}{field.name}"
        values |= flat(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return values


class Rows:
    """Base of dataclasses each of whose fields has one entry a row: a tensor, an array, or such a record again."""

    def rows(self: Record, index: Any) -> Record:
        """Some of the rows."""
        return type(self)(*(getattr(self, f.name)[index] for f in dataclasses.fields(self)))  # type: ignore[arg-type]

    def where(self: Record, mask: Bool[Tensor, " n"], other: Record) -> Record:
        """These rows where the mask holds, the other's elsewhere."""
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self))  # type: ignore[arg-type]
        return type(self)(*(
            a.where(mask, b) if isinstance(a, Rows) else torch.where(mask.view(-1, *[1] * (a.ndim - 1)), a, b)
            for a, b in pairs))


class cached_tensor(cached_property):  # type: ignore[type-arg]  # reads like the decorator it extends
    """A cached property whose tensors still work in training after inference has computed them."""

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with torch.inference_mode(False):
            return super().__get__(instance, owner)
