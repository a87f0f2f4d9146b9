"""The run-time check of array shapes that tests install over the package.

Whether a call fits its signature depends on the types, dtypes and shapes of what it takes and returns, and on nothing else. So
each call is compared with those before, and checked unless an equal one was: a loop over arrays of one shape is checked once.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Hashable, Iterable
from types import FunctionType
from typing import Any

import jaxtyping
import numpy as np
import torch
from beartype import BeartypeConf, beartype

LONGEST = 16
"""Most elements of a list, tuple or dictionary that are looked at one by one."""
_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
_always = jaxtyping.jaxtyped


class Unlike(Exception):
    """A container that cannot be compared with others; what takes or returns it is always checked."""


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check one of the two stand-ins that jaxtyping makes of a function: one takes the arguments, and returns `Any`, and one
    takes the result as well.

    The second would check the arguments again. It need not: jaxtyping remembers the sizes that the first has found.
    """
    returned = function.__annotations__.get("return", Any)
    if returned is not Any:
        function.__annotations__ = {"return": returned}
    return _checked(function)


def likeness(value: object) -> Hashable:
    """All of a value that a check can depend on.

    Raises:
        Unlike: It is a container that cannot be looked through.
    """
    kind = type(value)
    if isinstance(value, torch.Tensor | np.ndarray):
        return kind, value.dtype, tuple(value.shape)
    if value is None or isinstance(value, int | str | type):
        return kind, value
    if isinstance(value, list | tuple) and len(value) <= LONGEST:
        return kind, tuple(map(likeness, value))
    if isinstance(value, dict) and len(value) <= LONGEST:
        return kind, tuple(map(likeness, value)), tuple(map(likeness, value.values()))
    if isinstance(value, Iterable) and not isinstance(value, bytes) and not kind.__module__.startswith("dro_grasp"):
        raise Unlike
    return kind


def jaxtyped(function: Any = None, *, typechecker: Any = None) -> Any:
    """jaxtyping's decorator, which checks every call, made to check those that are unlike all before."""
    if function is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    checked = _always(function, typechecker=typechecker)
    if not isinstance(function, FunctionType) or inspect.isgeneratorfunction(function):
        return checked  # of classes and properties, jaxtyping comes back with their functions
    results: list[Any] = []
    returning = _always(_returning(function, results), typechecker=typechecker)
    taken: set[Hashable] = set()
    returned: set[Hashable] = set()

    @functools.wraps(function)
    def remembering(*arguments: Any, **options: Any) -> Any:
        __tracebackhide__ = True
        try:
            call = tuple(map(likeness, arguments)), tuple((name, likeness(value)) for name, value in options.items())
        except Unlike:
            return checked(*arguments, **options)
        known = call in taken
        result = (function if known else checked)(*arguments, **options)
        taken.add(call)
        try:
            whole = call, likeness(result)
        except Unlike:
            whole = None
        if known and (whole is None or whole not in returned):
            results.append(result)
            returning(*arguments, **options)
        returned.add(whole)
        return result

    return remembering


def _returning(function: FunctionType, results: list[Any]) -> FunctionType:
    """A function of the same signature that returns what was put into a list."""
    def result_of(*_: Any, **__: Any) -> Any:
        return results.pop()

    # jaxtyping finds the names in annotations among the globals of the function.
    made = FunctionType(result_of.__code__, function.__globals__, function.__name__, closure=result_of.__closure__)
    return functools.update_wrapper(made, function)


jaxtyping.jaxtyped = jaxtyping._decorator.jaxtyped = jaxtyped  # type: ignore[attr-defined]
