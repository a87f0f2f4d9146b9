"""What users give: numbers and truth values, made Python's or refused by name."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import operator
from collections.abc import Callable
from numbers import Real
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from dro_grasp.errors import OptionError

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
WORDS = {int: "an integer", float: "a number", bool: "True or False", NoneType: "None"}
"""Kinds that are checked, and their names in errors; what is annotated as something else is not looked at."""
MAX_QUOTED_CHARS = 80  # Characters of a value that an error repeats (ours)


class Checked:
    """Base of frozen dataclasses that users fill: their fields of the kinds in WORDS hold these, or there is an error.

    A subclass with a `__post_init__` of its own calls this one first.
    """

    def __post_init__(self) -> None:
        """Make the numbers Python's; an OptionError if a field holds something else than its annotation says."""
        for name, kind in _hints(type(self)).items():
            given = getattr(self, name)
            if (value := plain(name, given, kind)) is not given:
                object.__setattr__(self, name, value)


def checked(call: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """A function whose arguments of the kinds in WORDS are these, or there is an OptionError, before any work."""
    signature = inspect.signature(call)

    @functools.wraps(call)
    def checking(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        bound, kinds = signature.bind(*args, **kwargs), _hints(call)
        for name, given in bound.arguments.items():
            if name in kinds:
                bound.arguments[name] = plain(name, given, kinds[name])
        return call(*bound.args, **bound.kwargs)

    return checking


def require_positive(**numbers: int) -> None:
    """Refuse numbers below 1, by their names: OptionError."""
    for name, number in numbers.items():
        if number < 1:
            raise OptionError(f"{name} is {number}; give at least 1 ({name}=...)")


def require_seed(seed: int, bits: int = 63) -> None:
    """Refuse a seed of random numbers that does not fit into so many bits, or is negative: OptionError."""
    if not 0 <= seed < 2**bits:
        raise OptionError(f"seed is {seed}; give an integer from 0 to 2^{bits} - 1")


def is_number(value: Any) -> bool:
    """Whether a value is a finite number, and no truth value."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer beyond the largest float
        return False


def plain(name: str, given: Any, kind: Any) -> Any:
    """A value as Python's own of its kind, of WORDS, a choice, or a tuple of these; an OptionError if it is of another."""
    for each in _members(kind):
        try:
            return _converted(given, each)
        except (TypeError, ValueError, RuntimeError):  # NumPy's and PyTorch's conversions raise these
            continue
    options = [each for each in _members(kind) if get_origin(each) is Literal]
    told = " ".join((given if options and isinstance(given, str) else repr(given)).split())[:MAX_QUOTED_CHARS]
    if options:
        numbers = [f"give {WORDS[each]}, or " for each in _members(kind) if each in (int, float)]
        raise OptionError(f"{name} is '{told}'; {''.join(numbers)}choose {', '.join(map(str, get_args(options[0])))}")
    raise OptionError(f"{name} is {told}; give {' or '.join(_words(each) for each in _members(kind))}")


def _converted(given: Any, kind: Any) -> Any:
    """The value as one of this kind, the same object where it is one; TypeError, ValueError or RuntimeError if it is none."""
    if kind is NoneType or get_origin(kind) is Literal:
        if not any(given is each or (isinstance(given, type(each)) and given == each) for each in (get_args(kind) or [None])):
            raise ValueError
        return given
    if get_origin(kind) is tuple:
        return _row(given, get_args(kind))
    truth = isinstance(given, bool) or str(getattr(given, "dtype", "")).endswith("bool")
    if isinstance(given, str | bytes) or getattr(given, "ndim", 0) != 0 or truth != (kind is bool):
        raise TypeError
    if type(given) in (kind, int):
        return given
    return {int: operator.index, float: float, bool: bool}[kind](given)


def _row(given: Any, kinds: tuple[Any, ...]) -> tuple[Any, ...]:
    """The values as a tuple of these kinds; `(kind, ...)` takes any number."""
    if isinstance(given, str | bytes):
        raise TypeError
    values = tuple(given)
    each = kinds[:1] * len(values) if kinds[1:] == (...,) else kinds
    if len(values) != len(each):
        raise ValueError
    try:
        made = tuple(plain("", value, kind) for value, kind in zip(values, each, strict=True))
    except OptionError as error:
        raise ValueError from error
    same = isinstance(given, tuple) and all(a is b for a, b in zip(given, made, strict=True))
    return given if same else made


def _members(kind: Any) -> tuple[Any, ...]:
    """The kinds that a union allows."""
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def _words(kind: Any) -> str:
    """A kind in words."""
    if get_origin(kind) is not tuple:
        return WORDS[kind]
    first, *rest = get_args(kind)
    noun = {int: "integers", float: "numbers", bool: "truth values"}.get(first, "rows of numbers")
    return f"a list of {noun}" if rest == [...] else f"{1 + len(rest)} {noun}"


def _is_known(kind: Any) -> bool:
    """Whether a kind is one that is checked."""
    if get_origin(kind) is tuple:
        return all(_is_known(each) for each in get_args(kind) if each is not ...)
    return kind in WORDS if get_origin(kind) is None else (
        get_origin(kind) is Literal or (kind not in _members(kind) and all(map(_is_known, _members(kind)))))


@functools.cache
def _hints(owner: Any) -> dict[str, Any]:
    """The kinds of a dataclass's fields or of a function's arguments, without those that are not checked."""
    if isinstance(owner, type):
        found = get_type_hints(owner)
    else:  # what a function returns is not looked at: its name need not be known where the function is
        given = {name: kind for name, kind in owner.__annotations__.items() if name != "return"}
        found = get_type_hints(SimpleNamespace(__annotations__=given), inspect.unwrap(owner).__globals__)
    return {name: kind for name, kind in found.items() if _is_known(kind)}


def flat(record: Any, prefix: str = "") -> dict[str, Any]:
    """The values of a dataclass and of those in it, by name; what is nested has dots in its name."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        name = f"{prefix}{field.name}"
        values |= flat(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return values
