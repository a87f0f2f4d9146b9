"""Every command of every measurement is understood, before a night is spent on it."""

from __future__ import annotations

import argparse
import importlib
import shlex
from typing import Any

import pytest

from dro_grasp.cli.main import parse
from lab.measurements import MEASUREMENTS, PREPARATIONS

COMMANDS = sorted({cell for m in MEASUREMENTS.values() for cell in m.cells.values()} | set(PREPARATIONS.values()))


class Understood(Exception):
    """The arguments were taken."""


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.startswith("dro-grasp ")])
def test_a_command_of_the_program_is_understood(command: str) -> None:
    parse(shlex.split(command)[1:])


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.startswith("python -m ")])
def test_a_command_of_the_laboratory_is_understood(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(command)[2:]
    take = argparse.ArgumentParser.parse_args

    def only_take(parser: argparse.ArgumentParser, *given: Any) -> Any:
        take(parser, *given)
        raise Understood

    monkeypatch.setattr("sys.argv", words)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", only_take)
    with pytest.raises(Understood):
        importlib.import_module(words[0]).main()


def test_there_is_no_other_kind_of_command() -> None:
    assert all(c.startswith(("dro-grasp ", "python -m ")) for c in COMMANDS)
