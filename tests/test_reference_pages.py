"""The reference pages state what the code does: the numbers of protocols, and every error."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from dro_grasp import errors
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import DENSITY
from dro_grasp.simulation.outcome import DIRECTIONS, LOST_DISTANCE
from dro_grasp.simulation.protocols import PROTOCOLS, Protocol
from dro_grasp.simulation.scene import cached_scene

DOCS = Path(__file__).parent.parent / "docs"


def table(page: str, begin: str) -> list[list[str]]:
    """Cells of the rows of a page's table, the one whose first line begins so; the heading comes first."""
    lines = (DOCS / page).read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(begin))
    rows = [line for line in lines[first:lines.index("", first)] if not line.startswith("|---")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]] for row in rows]


def numbers(rules: Protocol) -> dict[str, str]:
    """What the table says of a protocol, row by row."""
    def number(value: float, unit: float = 1.0) -> str:
        return f"{value / unit:g}" if math.isfinite(value) else "-"

    degree = math.radians(1)
    return {
        "push, per mass [m/s^2]": number(rules.force),
        "number of directions": number(len(DIRECTIONS)),
        "duration of a push [s]": number(rules.force_time),
        "a push starts from": "the closed hand" if rules.reset else "the last one's end",
        "friction": number(rules.friction),
        "torsional friction [m]": number(rules.torsional_friction),
        "object": f"{DENSITY:g} kg/m^3" if rules.mass is None else f"{rules.mass:g} kg",
        "time to close [s]": number(rules.closing_time),
        "servo stiffness [Nm/rad]": number(rules.stiffness),
        "servo damping [Nms/rad]": number(rules.damping),
        "largest servo torque [Nm]": number(rules.force_limit),
        "displacement, under [cm]": number(rules.max_displacement, 0.01),
        "rotation, under [degrees]": number(rules.max_rotation, degree),
        "displacement while closing, at most [cm]": number(min(rules.max_closing_shift, LOST_DISTANCE), 0.01),
        "rotation while closing, at most [degrees]": number(rules.max_closing_rotation, degree),
        "penetration, at most [mm]": number(rules.max_penetration, 0.001),
        "self-penetration, at most [mm]": number(rules.max_self_penetration, 0.001),
        "time step [ms]": number(rules.timestep, 0.001),
    }


def test_the_table_of_protocols_has_the_numbers_of_the_code() -> None:
    (heading, *rows) = table("conventions.md", "| | `dro`")
    names = [re.findall(r"`(\w+)`", cell) for cell in heading[1:]]
    assert sorted(name for group in names for name in group) == sorted(PROTOCOLS)
    for column, group in enumerate(names, 1):
        stated = {row[0]: row[column] for row in rows}
        assert stated.pop("gravity [m/s^2]") == "0"
        for name in group:
            assert stated == numbers(PROTOCOLS[name]), name


@pytest.mark.parametrize("name", PROTOCOLS)
def test_no_trial_has_gravity(name: str) -> None:
    scene = cached_scene(load_hand("gripper3"), load_object("sphere"), PROTOCOLS[name])
    assert not scene.model.opt.gravity.any()


def test_the_text_about_protocols_has_the_numbers_of_the_code() -> None:
    page = " ".join((DOCS / "conventions.md").read_text().split())
    assert "**`strict` pushes with a twentieth of gravity.**" in page
    assert 9.81 / 20 == pytest.approx(PROTOCOLS["strict"].force, rel=0.02)
    rules = PROTOCOLS["robust"].perturbations
    assert f"must hold in {rules.needed} of {rules.trials} trials" in page
    assert f"stands {rules.shift * 1e3:g} mm away and is turned by {math.degrees(rules.turn):g} degrees" in page
    assert f"friction is {rules.friction[0]:g} to {rules.friction[1]:g} times" in page
    assert f"the push, is {rules.mass[0]:g} to {rules.mass[1]:g} times" in page
    assert f"stiffness and damping are {rules.gain[0]:g} to {rules.gain[1]:g} times" in page
    assert rules.coarse == 4, "the page says: in the last four trials"
    assert Protocol("mine").lever == 0.03, "the page says: a lever of 3 cm"
    assert [n for n, rules in PROTOCOLS.items() if not rules.closing] == ["dro_static"]
    assert [n for n, rules in PROTOCOLS.items() if rules.gradual] == ["dexgraspbench"]


def test_the_page_of_errors_has_every_error() -> None:
    classes = {name: value for name, value in vars(errors).items() if isinstance(value, type)}
    known = {name for name, value in classes.items() if issubclass(value, errors.DroGraspError)}
    stated = {row[0].strip("`") for row in table("errors.md", "| error ")[1:]}
    assert stated == known - {"DroGraspError"}
