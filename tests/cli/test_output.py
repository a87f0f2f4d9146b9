"""What people read in a terminal: tables, checksums, probabilities, devices that are not there."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from scipy.special import expit

from dro_grasp.cli.main import main
from dro_grasp.cli.output import print_table, say, say_aside, say_file
from dro_grasp.grasps.batch import percent
from dro_grasp.network.checkpoints import SMALL, weights_names
from dro_grasp.training.data.collections.report import LABEL, short_names
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand


def test_columns_that_say_nothing_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("t", ["name", "size", "reason", "held"], [["a", float("nan"), "", 0], ["b", None, None, False]])
    said = capsys.readouterr().out
    assert "name" in said
    assert "held" in said, "zero and no are values"
    assert "size" not in said
    assert "reason" not in said
    print_table("t", ["name", "size"], [])
    assert "size" in capsys.readouterr().out, "an empty table keeps its head"


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal of 60 columns."""
    monkeypatch.setattr("dro_grasp.cli.output.stdout.width", 60)
    monkeypatch.setattr("dro_grasp.cli.output.stdout._force_terminal", True)


@pytest.mark.usefixtures("narrow")
def test_long_names_are_folded_and_never_cut(capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"{letter}_hand_{'x' * 60}_left" for letter in "ab"]
    print_table("t", ["hand", "object", "rate"], [[*names, 0.5]])
    said = capsys.readouterr().out
    assert "…" not in said
    assert said.count("x") == 120


def test_tables_in_files_are_as_wide_as_they_need_to_be(capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"{letter}_hand_{'x' * 60}_left" for letter in "ab"]
    print_table("t", ["hand", "object", "rate"], [[*names, 0.5]])
    lines = capsys.readouterr().out.splitlines()
    assert any(all(name in line for name in (*names, "0.5")) for line in lines)


@pytest.mark.usefixtures("narrow")
def test_the_names_of_usual_sources_are_not_broken(capsys: pytest.CaptureFixture[str]) -> None:
    head = ["grasp", "origin", "confidence", "carries [kg]", "squeeze [N]", "success", "contacts", "penetration [mm]"]
    for name, whole in (("optimiser", True), ("my_module_of_grasps:MySource", False)):
        print_table("t", head, [[0, name, "99 %", 1.2, 14, True, 6, 1.2]])
        said = capsys.readouterr().out
        assert (name in said) == whole
        assert "…" not in said
        assert all(letter in said for letter in name), "folded, and not cut"


@pytest.mark.parametrize("score", [-3.0, -0.2, 0.0, 1.0, 2.823, 1e4, -1e4])
def test_a_score_is_shown_as_the_probability_that_it_states(score: float) -> None:
    grasps = made_up_grasps(toy_hand(), count=1).replace(score=torch.tensor([score]))
    assert float(grasps.confidence[0]) == pytest.approx(expit(score), abs=1e-7)
    assert percent(float(grasps.confidence[0])) == f"{100 * expit(score):.0f} %"


def test_without_a_score_there_is_no_probability() -> None:
    assert percent(float("nan")) is None


def test_checksums_are_whole_and_each_is_said_to_be_ok(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["weights", "verify"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len([*weights_names(), *SMALL])
    for line in lines:
        checksum, _, rest = line.partition("  ")
        assert len(checksum) == 64
        assert rest.endswith(": ok")


def test_labels_of_joints_differ() -> None:
    names = ["left_hand_finger_1_proximal", "left_hand_finger_2_proximal", "left_hand_thumb_rotation_joint"]
    labels = short_names(names)
    assert labels == ["finger_1_proximal", "finger_2_proximal", "thumb_rotation_joint"] or len(set(labels)) == 3
    assert max(map(len, short_names(["a_first_joint_of_all", "b_second_joint"]))) == LABEL
    long = [f"{i}_the_same_long_ending" for i in range(3)]
    assert short_names(long) == long, "not cut where two would be the same"
    assert short_names(["only_one"]) == ["only_one"]
    assert short_names(["/hand/thumb", "/hand/index"]) == ["thumb", "index"]
    assert short_names(["robot0:THJ1", "robot0:FFJ1"]) == ["THJ1", "FFJ1"]
    assert short_names(["/hand/thumb", "index"]) == ["/hand/thumb", "index"]
    assert short_names(["hand/j1/yaw", "hand/j1/roll", "hand/j2/yaw"]) == ["j1/yaw", "j1/roll", "j2/yaw"]


def test_colons_in_names_are_no_pictures(capsys: pytest.CaptureFixture[str]) -> None:
    say("out/run:fire:1.parquet")
    say_aside("out/run:fire:2.parquet")
    said = capsys.readouterr()
    assert (said.out, said.err) == ("out/run:fire:1.parquet\n", "out/run:fire:2.parquet\n")


@pytest.mark.parametrize("command", [
    ["generate", "--hand", "gripper3", "--object", "sphere"], ["benchmark", "--hands", "gripper3", "--objects", "sphere"],
    ["onboard", "gripper3", "--output", "OUT"], ["view"],
    ["synthesize", "--hand", "gripper3", "--object", "can", "--output", "OUT"],
], ids=lambda c: c[0])
def test_a_device_that_is_not_there_is_refused(command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(tmp_path / "new") if word == "OUT" else word for word in command]
    assert main([*words, "--device", "cuda:77"]) == 2
    said = capsys.readouterr()
    assert "device is 'cuda:77'" in said.err
    assert "--device cpu" in said.err
    assert not (tmp_path / "new").exists()


def test_names_of_files_stay_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    say_file("grasps", "seed=0.parquet")
    say("seed=0 is given")
    assert capsys.readouterr().out.splitlines() == ["grasps: seed=0.parquet", "--seed 0 is given"]
