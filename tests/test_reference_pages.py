"""The reference pages state what the code does: the numbers of protocols and of the method, every error and every column."""

from __future__ import annotations

import math
import re
from dataclasses import fields
from pathlib import Path

import pytest

from dro_grasp import errors
from dro_grasp.arm.tabletop.attempts import Attempt
from dro_grasp.geometry.contact_forces import LEVER
from dro_grasp.geometry.multilateration import MultilaterationConfig
from dro_grasp.grasps.columns import (
    CAMERA,
    COLUMNS,
    DEPTH,
    FRAME,
    FURTHER,
    HAND_FILE,
    OBJECT_CLOUD,
    OBJECT_FILE,
    OBJECT_MASS,
    OBJECT_SCALE,
    RELABELLED,
)
from dro_grasp.grasps.controller_config import ControllerConfig
from dro_grasp.hands.kinematics.joint_solver import JointSolverConfig
from dro_grasp.hands.library import load_hand
from dro_grasp.network.latent import CERTAIN, FlowPrior, HandMotion
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.completion import CELLS, DEPTHS, GUESSES, SAMPLE, SPREAD, TURNS_AWAY
from dro_grasp.objects.shape import BALL_OUTSIDE, BALL_SPACING, DENSITY
from dro_grasp.optimize.fingers import ClosingConfig, EasingConfig
from dro_grasp.optimize.grasp_energy import EnergyConfig
from dro_grasp.optimize.squeeze import GripConfig
from dro_grasp.predict.score.features import GRASP_FEATURES, LINK_FEATURES, NEAR
from dro_grasp.predict.settling import SettleConfig
from dro_grasp.predict.sources.choice import ChoiceConfig, ChoicePenalties
from dro_grasp.simulation.contacts import NAMES
from dro_grasp.simulation.grasp_state import CHANGE, PUSH, UNIT
from dro_grasp.simulation.outcome import DIRECTIONS, LOST_DISTANCE
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS, Protocol
from dro_grasp.simulation.scene import cached_scene
from dro_grasp.training.config import LossConfig, MotionConfig

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
        "largest servo torque [Nm]": "the joint's effort" if rules.effort else number(rules.force_limit),
        "displacement, under [cm]": number(rules.max_displacement, 0.01),
        "rotation, under [degrees]": number(rules.max_rotation, degree),
        "displacement while closing, at most [cm]": number(min(rules.max_closing_shift, LOST_DISTANCE), 0.01),
        "rotation while closing, at most [degrees]": number(rules.max_closing_rotation, degree),
        "penetration, at most [mm]": number(rules.max_penetration, 0.001),
        "self-penetration, at most [mm]": number(rules.max_self_penetration, 0.001),
        "time step [ms]": number(rules.timestep, 0.001),
    }


def test_the_table_of_protocols_has_the_numbers_of_the_code() -> None:
    (heading, *rows) = table("conventions.md", "| | `carry`")
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
    assert PROTOCOLS["carry"].force == 9.81, "the page says: the object's own weight"
    assert [n for n, rules in PROTOCOLS.items() if rules.effort] == ["carry"] == [DEFAULT_PROTOCOL]
    rules = PROTOCOLS["robust"].perturbations
    assert f"must hold in {rules.needed} of {rules.trials} trials" in page
    assert f"stands {rules.shift * 1e3:g} mm away and is turned by {math.degrees(rules.turn):g} degrees" in page
    assert f"friction is {rules.friction[0]:g} to {rules.friction[1]:g} times" in page
    assert f"the push, is {rules.mass[0]:g} to {rules.mass[1]:g} times" in page
    assert f"stiffness and damping are {rules.gain[0]:g} to {rules.gain[1]:g} times" in page
    assert rules.coarse == 4, "the page says: in the last four trials"
    assert Protocol("mine").lever == 0.03, "the page says: a lever of 3 cm"
    assert [n for n, rules in PROTOCOLS.items() if not rules.closing] == ["dro_static"]
    assert [n for n, rules in PROTOCOLS.items() if rules.gradual] == ["carry", "dexgraspbench"]


def test_the_page_of_errors_has_every_error() -> None:
    classes = {name: value for name, value in vars(errors).items() if isinstance(value, type)}
    known = {name for name, value in classes.items() if issubclass(value, errors.DroGraspError)}
    stated = {row[0].strip("`") for row in table("errors.md", "| error ")[1:]}
    assert stated == known - {"DroGraspError"}


def test_the_page_of_the_method_has_the_numbers_of_the_code() -> None:
    page = " ".join((DOCS / "derivations.md").read_text().split())
    choice, weights, closing = ChoiceConfig(), ChoicePenalties(), ClosingConfig()
    grip, settle, easing, step = GripConfig(), SettleConfig(), EasingConfig(), JointSolverConfig()
    mm = 1e3
    for text in (
        f"mixture of {NetworkConfig().placement_components} Gaussians",
        f"`SCALE` = {HandMotion.SCALE:g} m",
        f"log_variance near {CERTAIN:g}",
        f"(`motion`, weight {LossConfig().motion:g})",
        "a divergence weight of 1e-5" if MotionConfig().divergence == 1e-5 else "another weight",
        f"`DRAWS` = {FlowPrior.DRAWS}",
        f"`STEPS` = {FlowPrior.STEPS}",
        f"{['', 'one', 'two'][choice.placements]} placements with {choice.draws} z each",
        f"One of the {choice.placements * choice.draws} is",
        f"{weights.finger_penetration / mm:g} mean_f ({weights.margin * mm:g} - d_f)+",
        f"{weights.palm_penetration / mm:g} ({weights.margin * mm:g} - d_palm)+",
        f"{weights.clearance / mm:g} ({weights.margin * mm:g} - d_around)+",
        f"{weights.gap / mm:g} mean_f min(d_f+, {weights.reach * mm:g})",
        f"{weights.crowding / mm:g} ({weights.apart * mm:g} - e)+ + {weights.imbalance:g} | N |",
        f"exp(-d+ / {weights.nearness * mm:g})",
        f"softplus^-1({NetworkConfig().initial_distance:g})",
        f"standard deviation under {MultilaterationConfig().thin * mm:g} mm",
        f"|w|, |dq| <= {step.step_limit:g}",
        f"nearer to them than {EnergyConfig().clear * mm:g} mm",
        f"q + {ControllerConfig().outer:g} (open - q) and q + {ControllerConfig().inner:g} (closed - q)",
        f"more than {closing.idle * mm:g} mm from the object is idle",
        f"posed at {closing.steps} values of s",
        f"stops {closing.contact * mm:g} mm from the object",
        f"goes {closing.rest_shares[1]:g} or {closing.rest_shares[2]:g} of the way",
        f"nearer than {grip.reach * mm:g} mm to the object presses",
        f"(n_in + {grip.friction:g} t_e)",
        f"|A x|^2 + {grip.sharing:g} sum_k (s_k - 1/K)^2 + (sum_k s_k - 1)^2 + {grip.smoothness:g} |x|^2",
        f"Scaled to {grip.force:g} N",
        f"servos of {grip.stiffness:g} Nm/rad",
        f"{grip.touching:g} of it for joints whose fingers all touch, {grip.idle:g} for others",
        f"{sum(f.width for f in LINK_FEATURES.values())} numbers (`LINK_FEATURES`)",
        f"has {sum(f.width for f in GRASP_FEATURES.values())} (`GRASP_FEATURES`)",
        f"exp(-d+ / {NEAR * mm:g} mm)",
        f"m < {settle.still * mm:g} mm",
        f"{settle.still * mm:g} mm <= m < {settle.lost * 1e2:g} cm",
        f"by {settle.farthest * 1e2:g} cm or {math.degrees(settle.largest_turn):g} degrees",
        f"is {settle.deepest * mm:g} mm deep",
        f"each cube of {BALL_SPACING * mm:g} mm",
        f"at most {BALL_OUTSIDE * mm:g} mm through the surface",
        f"at least {easing.clearance * mm:g} mm and at most {easing.unseen * mm:g} mm",
        f"becomes {settle.guess_offset:g} + {settle.guess_worth:g} s, less {settle.clearance_worth:g} log-odds per metre",
        f"F = m {PUSH:g} m/s^2",
        f"|sum f_k + F|^2 / (m {UNIT:g} m/s^2)^2",
        f"(m {UNIT:g} m/s^2 {LEVER * 1e2:g} cm)^2 + {CHANGE:g}^2 sum (x_k - 1)^2",
        f"`DEPTHS` = {DEPTHS[0]:g} ... {DEPTHS[-1]:g} widths",
        f"for {SAMPLE} moved points",
        f"f < {TURNS_AWAY:g}",
        f"`GUESSES` = {GUESSES}",
        f"grid of {CELLS:,} cells. {SPREAD:,} points",
    ):
        assert text in page, text


def stated_names(page: str) -> set[str]:
    """All names in the first cells of a page's tables."""
    rows = [line.split("|")[1] for line in (DOCS / page).read_text().splitlines() if line.startswith("|")]
    return {name for cell in rows for name in re.findall(r"`([\w<>.]+)`", cell)}


def test_the_page_of_formats_has_every_column() -> None:
    stated = stated_names("file-formats.md")
    grasps = {*COLUMNS, "wrist_position", "wrist_quaternion_wxyz", "success", *FURTHER, *NAMES, HAND_FILE, OBJECT_CLOUD,
              OBJECT_FILE, OBJECT_SCALE, OBJECT_MASS, FRAME, CAMERA, DEPTH, RELABELLED}
    assert grasps - {"T_object_wrist", "trial_success"} <= stated
    assert {f.name for f in fields(Attempt)} <= stated
