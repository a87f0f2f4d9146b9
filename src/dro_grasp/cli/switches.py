"""Messages for the command line: what the package says of arguments, `num=16`, becomes what is typed, `--num 16`."""

from __future__ import annotations

import re
import sys
from dataclasses import fields, is_dataclass
from functools import cache

ARGUMENT = re.compile(r"(?<![\w.`'/+-])([a-z][a-z0-9_]*)=(\.\.\.|\([^()\n]*\)|'[^'\n]*'|[\w+-]+(?:\.[\w+-]+)*)")
"""An argument with its value, as Python has it; `...` stands for any value."""


def in_switches(text: str) -> str:
    """A message with the options of commands in place of arguments of their names; the rest stays."""
    return ARGUMENT.sub(_switch, text)


def _switch(found: re.Match[str]) -> str:
    name, value = found.groups()
    if name not in _options():
        return found[0]
    words = "" if value in {"...", "True"} else value.strip("()'").replace(",", "")
    return f"--{name.replace('_', '-')}" + (f" {words}" if words else "")


@cache
def _options() -> frozenset[str]:
    """Names of all options of commands, as their dataclasses have them."""
    modules = [module for name, module in sys.modules.items() if name.startswith(f"{__package__}.")]
    classes = {found for module in modules for found in vars(module).values() if isinstance(found, type)}
    return frozenset(field.name for found in classes if is_dataclass(found) for field in fields(found))
