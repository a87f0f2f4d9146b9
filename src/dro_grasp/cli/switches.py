"""Messages for the command line: what the package says of arguments, `num=16`, becomes what is typed, `--num 16`."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

ARGUMENT = re.compile(r"(?<![\w.`'/+-])([a-z][a-z0-9_]*)=(\.\.\.|\([^()\n]*\)|'[^'\n]*'|[\w+-]+(?:\.[\w+-]+)*)")
"""An argument with its value, as Python has it; `...` stands for any value."""
INSTEAD = {
    "scale": ("a file in metres", "a file with all coordinates times {}"),
    "keep_table": ("load_object with keep_table in Python", "load_object(..., keep_table={}) in Python"),
    "candidates": ("`dro-grasp generate --candidates N`", "`dro-grasp generate --candidates {}`"),
    "source": ("`dro-grasp generate --source NAME`", "`dro-grasp generate --source {}`"),
    "camera": ("`dro-grasp generate --camera JSON`", "`dro-grasp generate --camera {}`"),
    "direction": ("`dro-grasp generate --direction X Y Z`", "`dro-grasp generate --direction {}`"),
    "only_successful": ("--only-successful", "--only-successful"),
}
"""What helps where a command has no such option: of any value, and of a certain one."""

AS_SCENE = re.compile(r"\((scene=FILE camera=JSON)(, and )(nearest=True, at=\(X, Y, Z\) or pixel=\(U, V\)); "
                      r"load_scene and object_at in Python\)")
"""How a cloud is given as a scene and one thing of it is chosen, as the package says it (objects/perception/things.py)."""

_running: list[frozenset[str]] = []  # Options of the command that runs; empty while none does
_given: list[str] = []  # What was typed for it that may read like an argument, such as the path `seed=3.csv`


def use_options_of(command: Any | None, typed: Sequence[str] = ()) -> None:
    """From now on, let messages speak of the options of this command alone; of those of all commands for None.

    What was typed for it stays as it is.
    """
    _running[:] = [] if command is None else [frozenset(_names(command))]
    _given[:] = [word.partition("=")[2] if word.startswith("--") else word for word in typed]


def in_switches(text: str) -> str:
    """A message with the options of the running command in place of arguments of their names; the rest stays.

    What this command cannot be told, such as a scale or a scene, becomes what helps instead.
    """
    return ARGUMENT.sub(_switch, AS_SCENE.sub(_scene, text))


def _scene(found: re.Match[str]) -> str:
    scene, also, choice = found.groups()
    if not _running or {"scene", "nearest", "at", "pixel"} <= _running[0]:
        return f"({scene}{also}{choice})"
    if "scene" in _running[0]:
        return f"({scene}, and a click on the page)"
    scene, choice = (ARGUMENT.sub(lambda each: _typed(*each.groups()), part) for part in (scene, choice))
    return f"(`dro-grasp generate {scene}` with {choice})"


def _switch(found: re.Match[str]) -> str:
    name, value = found.groups()
    if any(found[0] in word for word in _given):
        return found[0]
    if name in (_running[0] if _running else _options()):
        return _typed(name, value)
    if _running and name in INSTEAD:
        return INSTEAD[name][value != "..."].format(_words(value))
    return found[0]


def _typed(name: str, value: str) -> str:
    return " ".join(filter(None, [f"--{name.replace('_', '-')}", "" if value in {"...", "True"} else _words(value)]))


def _words(value: str) -> str:
    return value.strip("()'").replace(",", "")


def _names(command: Any) -> Iterator[str]:
    """Names of a command's options, those of its groups included."""
    for field in fields(command) if is_dataclass(command) else ():
        yield field.name
        if is_dataclass(group := getattr(command, field.name)):
            yield from _names(group)


@cache
def _options() -> frozenset[str]:
    """Names of all options of commands, as their dataclasses have them."""
    modules = [module for name, module in sys.modules.items() if name.startswith(f"{__package__}.")]
    classes = {found for module in modules for found in vars(module).values() if isinstance(found, type)}
    return frozenset(field.name for found in classes if is_dataclass(found) for field in fields(found))
