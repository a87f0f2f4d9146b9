"""`hand vary`: what it writes, says and refuses; variants themselves are tested where they are made."""

from __future__ import annotations

import json
import shlex
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from dro_grasp.cli.main import main
from dro_grasp.hands.description.loader import read_state
from dro_grasp.hands.library import BUILTIN_FOLDER


def places(path: Path) -> np.ndarray:
    """Where the file puts each joint in the frame of the link above [m]."""
    joints = ET.parse(path).getroot().findall("joint")
    return np.array([joint.find("origin").get("xyz").split() for joint in joints], float)  # type: ignore[union-attr]


@pytest.mark.parametrize("options", [["--scale", "2"], ["--mirrored"], ["--mirrored", "--scale", "0.5"]], ids=" ".join)
def test_the_file_holds_the_variant_that_is_told(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, mirrored = tmp_path / "other.urdf", "--mirrored" in options
    assert main(["hand", "vary", "gripper3", *options, "--output", str(output), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    factor = float(options[-1]) if "--scale" in options else 1.0
    assert told == {"hand": "gripper3", "mirrored": mirrored, "scale": factor, "output": str(output)}
    original = places(BUILTIN_FOLDER / "gripper3.urdf")
    assert np.abs(original[:, 1]).max() > 0.01
    np.testing.assert_allclose(places(output), factor * original * [1, -1 if mirrored else 1, 1], atol=1e-8)
    assert main(["hand", "vary", "gripper3", *options, "--output", str(output)]) == 0
    said = capsys.readouterr().out
    assert said == f"{output}; see it with: dro-grasp hand check {output} --picture hand.png\n"


def test_the_command_that_shows_it_is_one_for_shells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "it's $HOME; left hand.urdf"
    assert main(["hand", "vary", "gripper3", "--mirrored", "--output", str(output)]) == 0
    said = capsys.readouterr().out.rpartition("see it with: ")[2]
    assert shlex.split(said) == ["dro-grasp", "hand", "check", str(output), "--picture", "hand.png"]


@pytest.mark.parametrize(("options", "said"), [
    (["--output", "same.urdf"], "give --mirrored, --scale, or both"),
    (["--mirrored", "--output", "left.xml"], "left.xml: give a name that ends in .urdf, such as left.urdf"),
    (["--mirrored", "--output", "nowhere/left.urdf"], "create it first"),
    (["--scale", "-1", "--output", "left.urdf"], "--scale is -1.0; give a positive number"),
])
def test_what_cannot_be_written_is_refused_in_words(
    options: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["hand", "vary", "gripper3", *options]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


SLIDER = """<robot name="jaws"><link name="base"/>
<link name="left"/><joint name="slide" type="prismatic"><parent link="base"/><child link="left"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.03" effort="25" velocity="1"/></joint>
<link name="right"/><joint name="turn" type="revolute"><parent link="base"/><child link="right"/><axis xyz="0 1 0"/>
<limit lower="0" upper="1" effort="2" velocity="1"/></joint></robot>"""


def test_postures_beside_the_hand_come_along(tmp_path: Path) -> None:
    (tmp_path / "jaws.urdf").write_text(SLIDER)
    (tmp_path / "jaws.srdf").write_text('<robot name="jaws"><group_state name="open" group="hand"><joint name="slide" '
                                        'value="0.02"/><joint name="turn" value="0.5"/></group_state></robot>')
    output = tmp_path / "large.urdf"
    assert main(["hand", "vary", str(tmp_path / "jaws.urdf"), "--scale", "1.5", "--mirrored", "--output", str(output)]) == 0
    assert read_state(output.with_suffix(".srdf"), "open") == pytest.approx({"slide": 0.03, "turn": 0.5})
    assert main(["hand", "vary", "gripper3", "--mirrored", "--output", str(tmp_path / "left.urdf")]) == 0
    assert not (tmp_path / "left.srdf").exists()


def test_the_hand_that_is_read_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.urdf"
    assert main(["hand", "vary", "gripper3", "--scale", "1.1", "--output", str(file)]) == 0
    before = file.read_text()
    assert main(["hand", "vary", str(file), "--scale", "2", "--output", str(file)]) == 2
    assert "is the hand itself, which would be lost" in capsys.readouterr().err
    assert file.read_text() == before
