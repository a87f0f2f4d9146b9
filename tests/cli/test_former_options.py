"""Options of before do what those of today do, and one line says what they are called now."""

from __future__ import annotations

import pytest

from dro_grasp.cli.main import FORMER_OPTIONS, parse, present_options
from dro_grasp.cli.robots import Plan

WHAT = ["--hand", "gripper3", "--object", "mug"]
ROBOT = ["--robot", "xarm7_leaphand", "--object", "mug"]
ABOVE = ["--direction", "0", "0", "-1"]
BALL = ["0", "0", "0.1", "0.03"]


@pytest.mark.parametrize(("before", "now"), [
    (["generate", *WHAT, *ABOVE, "--cone", "0.5", "--opening=0.01", "--avoid", "a.stl"],
     ["generate", *WHAT, *ABOVE, "--max-tilt", "0.5", "--pregrasp-clearance=0.01", "--obstacles", "a.stl"]),
    (["generate", *WHAT, "--hold", *BALL, "--spare", *BALL, "--method", "optimise"],
     ["generate", *WHAT, "--contact-region", *BALL, "--keep-out", *BALL, "--source", "optimiser"]),
    (["plan", *ROBOT, "--avoid", "a.stl", "--hold", *BALL],
     ["plan", *ROBOT, "--surroundings", "a.stl", "--contact-region", *BALL]),
    (["onboard", "hand.urdf", "--output", "folder", "--method=synthesise"],
     ["onboard", "hand.urdf", "--output", "folder", "--source", "optimiser"]),
    (["benchmark", "--looks", "2"], ["benchmark", "--views", "2"]),
])
def test_an_option_of_before_is_that_of_today(before: list[str], now: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    made = parse(before)
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert told[0].startswith("warning: ")
    assert " is called --" in told[0]
    assert made == parse(now)
    assert capsys.readouterr().err == ""


def test_things_in_the_way_of_a_plan_keep_their_option(capsys: pytest.CaptureFixture[str]) -> None:
    made = parse(["plan", *ROBOT, "--obstacles", "box", "can"])
    assert isinstance(made, Plan)
    assert (made.obstacles, made.scene) == (("box", "can"), None)
    assert capsys.readouterr().err == ""


def test_every_option_of_today_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    """What the table names is in the help of its command, and what it replaces is not."""
    for command, former in FORMER_OPTIONS.items():
        with pytest.raises(SystemExit):
            parse([command, "--help"])
        words = set(capsys.readouterr().out.replace(",", " ").split())
        assert {now for now in former.values() if now} <= words, command
        assert not set(former) & words, command


def test_what_is_no_option_of_before_stays() -> None:
    """A value that reads like a former source is one after --source alone; an option at the end has no value."""
    assert present_options(["generate", "--object", "optimise"]) == (["generate", "--object", "optimise"], {})
    assert present_options(["generate", "--source"]) == (["generate", "--source"], {})
    assert present_options(["train", "--latent", "4", "--seed", "1"]) == (["train", "--seed", "1"], {"--latent": "4"})
    assert present_options([]) == ([], {})
