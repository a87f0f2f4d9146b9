"""Keyword options that belong to several configurations."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from dro_grasp.errors import OptionError


def by_owner(values: Mapping[str, Any], *owners: type[Any]) -> list[dict[str, Any]]:
    """Keyword options, told apart by the dataclass of which they are fields; the first of several has them.

    Raises:
        OptionError: A name is no field of any; the error lists those that there are.
    """
    home = {f.name: owner for owner in reversed(owners) for f in dataclasses.fields(owner)}
    if unknown := [name for name in values if name not in home]:
        names = dict.fromkeys(f.name for owner in owners for f in dataclasses.fields(owner))
        raise OptionError(f"there is no option '{unknown[0]}'; the options are {', '.join(names)}")
    return [{name: value for name, value in values.items() if home[name] is owner} for owner in owners]
