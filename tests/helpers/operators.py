"""Counts the operators that reach a device that is not the CPU, and finds those that wait for it."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

WAITING = {"_local_scalar_dense", "item", "nonzero", "is_nonzero", "masked_select", "equal", "_unique2", "unique_dim",
           "unique_consecutive", "repeat_interleave.Tensor", "_linalg_check_errors", "_linalg_eigh", "_linalg_svd"}
"""Operators whose result, or the shape of it, is read back."""
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_"}
"""Operators that read a mask back before they can index by it."""


class Operators(TorchDispatchMode):
    """Within the block, what is dispatched to the device."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device = torch.device(device).type
        Operators.counting = True
        self.count = 0
        """Operators, views included."""
        self.waits: Counter[str] = Counter()
        """Those that wait for the device, with the line of the package from which they come."""

    counting = True

    @staticmethod
    @contextmanager
    def paused() -> Iterator[None]:
        """Within the block, nothing is counted."""
        Operators.counting = False
        try:
            yield
        finally:
            Operators.counting = True

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        places, asked = _places(args, kwargs), kwargs.get("device")
        if not Operators.counting:
            return operation(*args, **kwargs)
        if self.device in places or (asked is not None and torch.device(asked).type == self.device):
            self.count += 1
            if waits(operation, self.device, args, kwargs):
                self.waits[f"{operation.overloadpacket.__name__}, {_line()}"] += 1
        return operation(*args, **kwargs)


def waits(operation: Any, device: torch.device | str, args: Any, kwargs: dict[str, Any]) -> bool:
    """Whether an operator waits for the device."""
    name, places, asked = operation.overloadpacket.__name__, _places(args, kwargs), kwargs.get("device")
    if torch.device(device).type not in {*places, None if asked is None else torch.device(asked).type}:
        return False
    if name in INDEXING:
        return any(x is not None and x.dtype in {torch.bool, torch.uint8} for x in args[1])
    if name == "_to_copy":
        return asked is not None and torch.device(asked).type not in places
    return name in WAITING or str(operation).removeprefix("aten.") in WAITING or (name == "copy_" and len(set(places)) > 1)


def _places(args: Any, kwargs: dict[str, Any]) -> list[str]:
    return [x.device.type for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]


def _line() -> str:
    frames = [frame for frame in traceback.extract_stack() if "dro_grasp/" in frame.filename and "tests/" not in frame.filename]
    return f"{frames[-1].filename.rsplit('/', 1)[-1]}:{frames[-1].lineno}" if frames else "elsewhere"
