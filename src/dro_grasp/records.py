"""Records of tensors, which are frozen dataclasses: moved to a device, and with tensors that are computed once."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any, TypeVar

import torch

from dro_grasp.errors import OptionError

Record = TypeVar("Record")


def on_device(record: Record, device: torch.device | str) -> Record:
    """Copy a frozen dataclass to a device: its tensors, and its records that have a `to`."""
    values = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}  # type: ignore[arg-type]
    moved = {name: value.to(device) for name, value in values.items() if hasattr(value, "to")}
    return dataclasses.replace(record, **moved)  # type: ignore[type-var]


def by_record(values: Mapping[str, Any], *records: type[Any]) -> list[dict[str, Any]]:
    """Values by the dataclass of which their names are fields, the first of several.

    Raises:
        OptionError: A name is no field of any; the error lists those that there are.
    """
    home = {f.name: record for record in reversed(records) for f in dataclasses.fields(record)}
    if unknown := [name for name in values if name not in home]:
        names = dict.fromkeys(f.name for record in records for f in dataclasses.fields(record))
        raise OptionError(f"there is no option '{unknown[0]}'; the options are {', '.join(names)}")
    return [{name: value for name, value in values.items() if home[name] is record} for record in records]


class cached_tensor(cached_property):  # type: ignore[type-arg]  # reads like the decorator it extends
    """A cached property whose tensors still work in training after inference has computed them."""

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with torch.inference_mode(False):
            return super().__get__(instance, owner)
