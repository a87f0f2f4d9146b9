"""Tendons over sites, which an actuator pulls: their joints stay free, and that is told. JSON and picture agree on open."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dro_grasp.hands.check import check_hand
from dro_grasp.hands.description.loader import load_description
from tests.helpers.claw_urdf import written

BOX = "<geom type='box' size='.006 .006 .02' pos='0 0 .02'/>"


def mjcf(path: str, actuator: str, more: str = "") -> str:
    fingers = "".join(
        f"<body name='{n}1' pos='{x} 0 .01'><joint name='{n}_a' axis='0 {s} 0' range='0 1.4'/>{BOX}"
        f"<site name='{n}_s1' pos='0 0 .02'/>"
        f"<body name='{n}2' pos='0 0 .04'><joint name='{n}_b' axis='0 {s} 0' range='0 1.4'/>{BOX}"
        f"<site name='{n}_s2' pos='0 0 .02'/>"
        "</body></body>" for n, x, s in (("l", -0.035, 1), ("r", 0.035, -1)))
    return (f"<mujoco><compiler angle='radian'/><worldbody><body name='palm'><geom type='box' size='.04 .04 .01'/>"
            f"<site name='root'/>{fingers}</body></worldbody>"
            f"<tendon>{path}</tendon><actuator>{actuator}</actuator>{more}</mujoco>")


OVER_SITES = "<spatial name='cord'><site site='root'/><site site='l_s1'/><site site='l_s2'/></spatial>"
TO_KNUCKLE = "<spatial name='cord'><site site='root'/><site site='l_s1'/></spatial>"
FIXED = "<fixed name='cord'><joint joint='l_a' coef='1'/><joint joint='l_b' coef='1'/></fixed>"
MOTOR = "<motor tendon='cord'/>"


@pytest.mark.parametrize(("path", "actuator", "pulled"), [
    (OVER_SITES, MOTOR, "l_a, l_b"), (OVER_SITES, "", None), (TO_KNUCKLE, MOTOR, None), (FIXED, MOTOR, None),
    (OVER_SITES.replace("root", "r_s1"), MOTOR, "r_a, l_a, l_b")])
def test_a_pulled_tendon_over_sites_is_told(tmp_path: Path, path: str, actuator: str, pulled: str | None) -> None:
    description = load_description(written(tmp_path, mjcf(path, actuator), "hand.xml"))
    told = [note.text for note in description.notes if note.subject == "cord"]
    assert [f"moves ({pulled}) is taken as free" in text for text in told] == ([] if pulled is None else [True])
    assert len(description.tree.joint_names) == (3 if path == FIXED else 4)


def test_the_open_posture_that_is_told_is_the_one_that_is_drawn() -> None:
    """Barrett's fingers spread by a joint from 0 to pi, whose open hand is a quarter in."""
    report = check_hand("barrett")
    hand = report.hand
    drawn = dict(zip(hand.tree.joint_names, hand.canonical_joints(1.0).tolist(), strict=True))
    assert report.facts["open_posture"] == pytest.approx({n: drawn[n] for n in report.facts["free_joints"]}, abs=1e-3)
    assert not torch.equal(hand.canonical_joints(1.0), hand.open_ends), "a joint only spreads"
