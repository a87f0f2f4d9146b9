"""The run-time type checker that tests install over the package.

Each function is checked in its first calls of each test: a loop that calls it thousands of times says nothing new, and
checking them all takes a third of the time of a prediction.
"""

from __future__ import annotations

import inspect
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

CALLS = 20
"""Calls of a function that are checked in each test."""
_calls: Counter[tuple[str, str]] = Counter()
_trusted: list[Any] = []
_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check one of the two stand-ins that jaxtyping makes of a function: one takes the arguments, and returns `Any`, and one
    takes the result as well.

    The second would check the arguments again. It need not: jaxtyping remembers the sizes that the first has found.
    """
    returned = function.__annotations__.get("return", Any)
    if returned is not Any:
        function.__annotations__ = {"return": returned}
        return _checked(function)
    checked, name = _checked(function), (function.__module__, function.__qualname__)

    def counted(*args: Any, **options: Any) -> Any:
        _calls[name] += 1
        if _calls[name] == CALLS:
            _trust(*name)
        return checked(*args, **options)

    return counted


def check_anew() -> None:
    """All functions are checked again."""
    _calls.clear()
    while _trusted:
        del _trusted.pop().__no_type_check__


def _trust(module: str, path: str) -> None:
    """Further calls are not checked, if the function is found by its name: what a function defines in itself is not."""
    found: Any = sys.modules[module]
    for part in path.split("."):
        found = inspect.getattr_static(found, part, None)
    found = found.fget if isinstance(found, property) else getattr(found, "func", found)
    found = inspect.unwrap(getattr(found, "__func__", found)) if found is not None else None
    if inspect.isfunction(found):
        found.__no_type_check__ = True
        _trusted.append(found)
