"""What planning refuses: in words, and with nothing written."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp import extras
from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError
from dro_grasp.planning.planner import plan
from dro_grasp.planning.robot_file import BUILTIN_ROBOTS

BAD = {
    "far away": (["--at", "3", "0"], "farther than the arm and hand are long"),
    "in the robot": (["--at", "0.0", "0.0"], "while the robot is at home"),
    "under the table": (["--pose", "low.json"], "below the table"),
    "no rigid camera": (["--camera", "squashed.json"], "is not a rotation"),
    "two places": (["--at", "0.5", "0", "--pose", "low.json"], "give one of them"),
    "no grasps": (["--num", "0"], "num is 0"),
    "no folder": (["--csv", "nowhere/plan.csv"], "no folder"),
}


def test_a_pose_that_is_none_is_refused_and_not_taken_for_the_table_s_fault(robot: dro.Robot) -> None:
    lost, mirrored = np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])
    far = np.eye(4)
    lost[0, 3], far[0, 3] = np.nan, 500.0
    for T, fault in ((lost, "its matrix holds NaN or infinity"), (mirrored, "not a rotation"), (far, "divide millimetres")):
        with pytest.raises(OptionError, match=f"T_world_object is no pose of 'can'.*{fault}"):
            plan(robot, dro.load_object("can"), T)


@pytest.mark.parametrize(("options", "said"), BAD.values(), ids=BAD)
def test_bad_input_is_refused_in_words_and_nothing_is_written(
    options: list[str], said: str, small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    low, squashed = np.eye(4), np.diag([1.0, 2.0, 1.0, 1.0])
    low[:3, 3] = 0.5, 0.0, -1.0
    Path("low.json").write_text(json.dumps({"frame": "world", "T_frame_object": low.tolist()}))
    Path("squashed.json").write_text(json.dumps({"frame": "world", "T_frame_camera": squashed.tolist()}))
    before = sorted(tmp_path.iterdir())
    assert main(["plan", "--robot", small_robot, "--object", "can", "--output", "plan.npz", *options]) == 2
    assert said in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(("option", "said"), [("robot.yaml", "link 'link9', which the arm does not have"),
                                              (None, "nothing stands on the table: 0 points are left")])
def test_a_robot_and_a_cloud_that_cannot_be_used_leave_nothing_behind(
    option: str | None, said: str, small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (BUILTIN_ROBOTS / "xarm7_leaphand.yaml").read_text()
    Path("robot.yaml").write_text(text.replace("link: link7", "link: link9").replace("arm: ", f"arm: {BUILTIN_ROBOTS}/"))
    x, y = np.meshgrid(np.linspace(0, 0.9, 90), np.linspace(-0.6, 0.6, 120))
    np.save("table.npy", np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3))
    before = sorted(tmp_path.iterdir())
    given = ["--robot", option or small_robot, "--object", "table.npy"]
    assert main(["plan", *given, "--output", "plan.npz", "--csv", "plan.csv"]) == 2
    assert said in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_without_the_extra_planning_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "ompl" else object())
    assert main(["plan", "--robot", "xarm7_leaphand", "--object", "can"]) == 2
    assert "ompl; run pip install 'dro-grasp[arm]'" in capsys.readouterr().err


def test_every_other_command_works_without_the_extra(small_robot: str) -> None:
    blocked = "".join(f"sys.modules[{name!r}] = None; " for name in extras.EXTRAS["arm"])
    code = (f"import sys; {blocked}import dro_grasp as dro; from dro_grasp.cli.main import main; "
            f"dro.PlanConfig, dro.MotionPlan.load; sys.exit(main(['robot', 'check', {small_robot!r}]))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
