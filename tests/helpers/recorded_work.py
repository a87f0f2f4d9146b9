"""Recorded work on the fake device: what is launched is written down, and done again by each call, as a CUDA graph does it.

As of a graph, nothing but tensors and the generator's state enters a repetition: all that Python computed is as it was.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

from dro_grasp import graphs
from tests.helpers.fake_device import DEVICE, DeviceTensor, compute
from tests.helpers.operators import waits


class _Recorder(TorchDispatchMode):
    """Writes down the operators of the device; refuses those that wait, as a stream that is captured does."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[tuple[Any, Any, Any, list[DeviceTensor]]] = []
        self._before: dict[int, tuple[DeviceTensor, torch.Tensor]] = {}  # tensors from outside that the work writes to
        self._own: set[int] = set()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
        if waits(operation, torch.device(DEVICE), args, kwargs):
            raise RuntimeError(f"operation not permitted when stream is capturing: {operation}")
        for i, argument in enumerate(operation._schema.arguments):
            if argument.alias_info and argument.alias_info.is_write and i < len(args):
                for x in tree_leaves(args[i]):
                    if isinstance(x, DeviceTensor) and x.held.untyped_storage().data_ptr() not in self._own:
                        self._before.setdefault(id(x), (x, x.held.clone()))
        result = operation(*args, **kwargs)
        made = [x for x in tree_leaves(result) if isinstance(x, DeviceTensor)]
        if made or any(isinstance(x, DeviceTensor) for x in given):
            self.done.append((operation, args, kwargs, made))
        if not given or operation.is_view is False:
            self._own.update(x.held.untyped_storage().data_ptr() for x in made if all(x is not y for y in given))
        return result

    def undo(self) -> None:
        """Give tensors from outside what they held before: a stream that is captured does nothing."""
        for tensor, values in self._before.values():
            tensor.held.copy_(values)

    def repeat(self) -> None:
        """Do it again, on the same tensors."""
        with _disable_current_modes(), torch.no_grad():
            self._repeat()

    def _repeat(self) -> None:
        for operation, args, kwargs, made in self.done:
            again = [x for x in tree_leaves(compute(operation, args, kwargs)) if isinstance(x, DeviceTensor)]
            for old, new in zip(made, again, strict=True):
                if old is not new:
                    old.held.copy_(new.held)


def record(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Let the fake device record work; the counter tells what was recorded, repeated, and refused."""
    seen = Counter[str]()

    def recorded(
        run: Callable[[], None], device: torch.device, warm: Callable[[], object] = lambda: None,
        generator: torch.Generator | None = None, once: bool = False,
    ) -> Callable[[], None] | None:
        warm()
        state = None if generator is None else generator.get_state()
        recorder = _Recorder()
        try:
            with recorder:
                run()
            recorder.undo()
        except RuntimeError as error:
            seen[f"refused: {error}"] += 1
            return None
        finally:
            if generator is not None:
                generator.set_state(state)
        seen["recorded"] += 1

        def again() -> None:
            seen["repeated"] += 1
            recorder.repeat()

        return again

    monkeypatch.setattr(graphs, "captures", lambda device: torch.device(device).type == DEVICE)
    monkeypatch.setattr(graphs, "recorded", recorded)
    return seen
