"""The run-time type checker that tests install over the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

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
