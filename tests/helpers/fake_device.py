"""A strict accelerator without hardware: its tensors compute on the CPU, but meet the CPU's as rarely as a GPU's do.

Inside `fake_device()` the device named `DEVICE` exists. A tensor on it is a `DeviceTensor`, which holds a CPU tensor and
shows another device. Every operation passes `compute`, below autograd, which refuses what CUDA refuses, computes on the held
tensors, and wraps the results. Results are therefore those of the CPU to the last bit.
"""

from __future__ import annotations

import dataclasses
import functools
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar
from unittest import mock

import numpy as np
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = "meta"
"""Name of the fake device. PyTorch builds `meta` tensors everywhere, and no kernel of its own can compute with them."""

MIXED = "Expected all tensors to be on the same device, but found at least two devices, {} and cpu! ({})"
"""Message of a refusal, as CUDA words it."""

aten = torch.ops.aten
COPIES = {aten.copy_.default, aten._to_copy.default}
"""Operations that take tensors of both devices."""

INDEXED = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default}
"""Operations whose indices may lie on the CPU where the indexed tensor does not."""

SCALARS = {aten.where.self, aten.masked_fill.Tensor, aten.masked_fill_.Tensor, aten.fill_.Tensor, *INDEXED}
"""Operations that take a 0-dimensional CPU tensor beside tensors of the device, besides all pointwise ones."""

CONSTRUCTORS = {torch.tensor, torch.as_tensor, torch.asarray}
"""Functions that read Python data, for which PyTorch makes empty `meta` tensors without asking anyone."""


_CPU_GENERATOR = torch.Generator


class DeviceTensor(torch.Tensor):
    """A tensor on the fake device."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> DeviceTensor:
        tensor = torch.Tensor._make_wrapper_subclass(
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype, device=DEVICE
        )
        tensor.held = held
        return tensor

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(operation, args, kwargs or {})

    @property
    def is_cuda(self) -> bool:
        """Branches for a GPU are taken."""
        return True

    def __repr__(self, *, tensor_contents: str | None = None) -> str:
        return f"DeviceTensor({self.held})"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def numpy(self, *, force: bool = False) -> np.ndarray:
        if force:
            return self.detach().cpu().numpy()
        raise TypeError(f"can't convert {DEVICE} device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host "
                        "memory first.")

    def __array__(self, dtype: Any = None) -> np.ndarray:
        return self.numpy()


class _GeneratorKind(type(torch.Generator)):
    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, _CPU_GENERATOR)


class DeviceGenerator(_CPU_GENERATOR, metaclass=_GeneratorKind):
    """A generator for one device: `torch.Generator` inside `fake_device`."""

    ours: ClassVar[set[int]] = set()
    """Addresses of those for the fake device, since an operation is shown a generator by its address alone."""

    def __new__(cls, device: Any = "cpu") -> Any:
        generator = super().__new__(cls, "cpu")
        generator.place = torch.device(device)
        if _is_ours(device):
            cls.ours.add(generator._cdata)
            weakref.finalize(generator, cls.ours.discard, generator._cdata)
        return generator

    @property
    def device(self) -> torch.device:
        return self.place


class _Autocast(torch.autocast):
    """Mixed precision of the fake device, which is the CPU's."""

    def __init__(self, device_type: str, *args: Any, **kwargs: Any) -> None:
        super().__init__("cpu" if device_type == DEVICE else device_type, *args, **kwargs)


class _Dispatch(TorchDispatchMode):
    """Sees the operations that have no tensor of the device among their arguments: factories and copies to it."""

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(operation, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Turns what PyTorch would make of Python data on its own into steps that `compute` sees."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if function in CONSTRUCTORS and _is_ours(kwargs.get("device")):
            del kwargs["device"]
            return function(*args, **kwargs).to(DEVICE)
        if function is torch.Tensor.new_tensor and isinstance(args[0], DeviceTensor):
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(kwargs.get("device") or DEVICE)
        if function in (torch.Tensor.__getitem__, torch.Tensor.__setitem__) and isinstance(args[0], DeviceTensor):
            index = tuple(map(_as_index, args[1])) if isinstance(args[1], tuple) else _as_index(args[1])
            args = (args[0], index, *args[2:])
        return function(*args, **kwargs)


@contextmanager
def fake_device() -> Iterator[str]:
    """The name of the fake device, which exists inside the block."""
    with mock.patch("torch.Generator", DeviceGenerator), mock.patch("torch.autocast", _Autocast), _Dispatch(), _Functions():
        yield DEVICE


def _is_ours(device: Any) -> bool:
    return device is not None and torch.device(device).type == DEVICE


def _as_index(index: Any) -> Any:
    return torch.as_tensor(index) if isinstance(index, list | np.ndarray) else index


@dataclasses.dataclass(frozen=True)
class _Form:
    """What the signature of an operation says, read once."""

    written: tuple[tuple[int, str], ...]
    """Place and name of each argument that it writes to."""
    scalars: bool
    """It takes 0-dimensional CPU tensors beside tensors of the device."""


@functools.cache
def _form(operation: Any) -> _Form:
    written = tuple((i, x.name) for i, x in enumerate(operation._schema.arguments) if x.alias_info and x.alias_info.is_write)
    return _Form(written, torch.Tag.pointwise in operation.tags or operation in SCALARS)


def compute(operation: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """Compute an operation on the tensors held, after the checks of CUDA."""
    form, leaves = _form(operation), []
    _collect(args, leaves)
    _collect(kwargs.values(), leaves)
    ours = any(type(x) is DeviceTensor for x in leaves)
    asked = kwargs.get("device")
    result_is_ours = ours if asked is None else torch.device(asked).type == DEVICE
    _check_kinds(operation, leaves, result_is_ours)
    written = [args[i] if i < len(args) else kwargs[name] for i, name in form.written if i < len(args) or name in kwargs]
    if ours and operation not in COPIES and any(type(x) is not DeviceTensor for x in leaves if isinstance(x, torch.Tensor)):
        _check_mixture(operation, form, args, kwargs, written)
    held = {name: _held(value) for name, value in kwargs.items() if name != "pin_memory"}
    if asked is not None:
        held["device"] = "cpu"
    result = operation(*map(_held, args), **held)
    if ours and torch.Tag.inplace_view in operation.tags:
        with torch._C._DisableTorchDispatch():
            operation(*args, **kwargs)  # the shape shown follows the shape held
    if written:
        return _same_objects(result, written)
    return _wrapped(result) if result_is_ours else result


def _collect(values: Any, leaves: list[Any]) -> None:
    """Append the tensors and generators in nested arguments."""
    for x in values:
        if isinstance(x, torch.Tensor | _CPU_GENERATOR):
            leaves.append(x)
        elif isinstance(x, list | tuple):
            _collect(x, leaves)


def _held(value: Any) -> Any:
    if type(value) is DeviceTensor:
        return value.held
    return type(value)(map(_held, value)) if isinstance(value, list | tuple) else value


def _wrapped(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)(map(_wrapped, value))
    return DeviceTensor(value) if isinstance(value, torch.Tensor) else value


def _check_kinds(operation: Any, leaves: list[Any], result_is_ours: bool) -> None:
    """Refuse generators of the other device, and tensors that look like the device's and hold nothing."""
    for x in leaves:
        if isinstance(x, _CPU_GENERATOR):
            if (x._cdata in DeviceGenerator.ours) != result_is_ours:
                here, there = (DEVICE, "cpu") if result_is_ours else ("cpu", DEVICE)
                raise RuntimeError(f"Expected a '{here}' device type for generator but found '{there}' ({operation})")
        elif type(x) is not DeviceTensor and x.device.type == DEVICE:
            raise RuntimeError(f"a meta tensor without values came to {operation}; the fake device missed its making")


def _check_mixture(operation: Any, form: _Form, args: tuple, kwargs: dict[str, Any], written: list[Any]) -> None:
    """Refuse CPU tensors beside those of the device, but for the exceptions that CUDA makes."""
    if operation in INDEXED:
        if type(args[0]) is not DeviceTensor:
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
        args = (args[0], *args[2:])
    leaves: list[Any] = []
    _collect([*args, *kwargs.values()], leaves)
    for x in leaves:
        strange = isinstance(x, torch.Tensor) and type(x) is not DeviceTensor
        if strange and (x.ndim or not form.scalars or any(x is y for y in written)):
            raise RuntimeError(MIXED.format(DEVICE, operation))


def _same_objects(result: Any, written: list[Any]) -> Any:
    """The written arguments themselves, since callers go on with those."""
    if any(type(x) is DeviceTensor and x.shape != x.held.shape for x in written):
        raise RuntimeError("the fake device cannot resize a tensor that is written to")
    if result is None:
        return None
    return written[0] if len(written) == 1 else tuple(written)
