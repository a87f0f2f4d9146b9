"""The experiment: attempts are stored, not repeated, and counted."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import dro_grasp as dro
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.arm.tabletop.attempts import Attempt, endings, failures, read_attempts, write_attempts
from dro_grasp.arm.tabletop.experiment import TabletopConfig
from dro_grasp.arm.tabletop.run import TabletopRun, run_tabletop
from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError, OutputError
from dro_grasp.network.checkpoints import DEFAULT, load_weights, save_weights
from tests.helpers.processes import alive, children, start, wait_for

QUICK = TabletopConfig(
    see="mesh", hold_seconds=0.5, shake_seconds=0.5, plan=PlanConfig(num=8, best_seconds=30, planner_seconds=30))


def test_attempts_are_stored_and_not_repeated(small_robot: str, tmp_path: Path) -> None:
    output, calls = tmp_path / "results.parquet", []

    def counted(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
        calls.append(number)
        ended = "done" if number else "plan"
        return Attempt(robot.name, obj.name, number, seed, QUICK.label(), number > 0, ended, "no path", score=0.5)

    run = TabletopRun(small_robot, ("can",), attempts=2, config=QUICK)
    first = run_tabletop(run, output, make=counted)
    assert calls == [0, 1]
    assert run_tabletop(replace(run, attempts=3), output, make=counted)[:2] == first
    assert calls == [0, 1, 2]
    assert endings(first) == {"plan": 1, "done": 1}
    assert failures(first) == ["can, attempt 0, plan: no path"]
    stored = read_attempts(output)
    assert len(stored) == 3
    write_attempts(stored[:1], output)
    run_tabletop(run, output, make=counted)
    assert calls == [0, 1, 2, 1]
    (tmp_path / "other.parquet").write_bytes(b"not this")
    with pytest.raises(dro.DroGraspError, match="expected a file of attempts"):
        run_tabletop(run, tmp_path / "other.parquet")


def test_two_objects_of_one_name_are_refused_and_one_object_counts_once(
    small_robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
        return Attempt(robot.name, obj.name, number, seed, QUICK.label(), True, "done")

    for folder, side in (("003", 0.05), ("004", 0.06)):
        (tmp_path / folder).mkdir()
        trimesh.creation.box((side, side, 0.08)).export(tmp_path / folder / "textured.obj")
    box, other = (str(tmp_path / folder / "textured.obj") for folder in ("003", "004"))
    output = tmp_path / "results.parquet"
    refusal = rf"'{box}' and '{other}' are different objects of the name 'textured'.*rename one"
    with pytest.raises(OptionError, match=refusal):
        run_tabletop(TabletopRun(small_robot, (box, other), attempts=1, config=QUICK), output)
    assert not output.exists()
    again = str(tmp_path / "004" / ".." / "003" / "textured.obj")
    (done,) = run_tabletop(TabletopRun(small_robot, (box, again), attempts=1, config=QUICK), output, make=ended)
    assert (done.object, done.object_file) == ("textured", box)
    with pytest.raises(OptionError, match=rf"'{other}' is not the object 'textured' .* made with '{box}'.*output="):
        run_tabletop(TabletopRun(small_robot, (other,), attempts=1, config=QUICK), output)
    whole, half = dro.load_object(box), trimesh.creation.box((0.025, 0.05, 0.08))
    halves = tuple((np.add(half.vertices, [x, 0, 0]), half.faces) for x in (-0.0125, 0.0125))
    with monkeypatch.context() as patch:
        patch.setattr("dro_grasp.arm.tabletop.run.load_object", lambda source: replace(whole, exact_parts=halves))
        with pytest.raises(OptionError, match=rf"'{box}' is not the object 'textured' .* as it was then"):
            run_tabletop(TabletopRun(small_robot, (box,), attempts=1, config=QUICK), output)
    trimesh.creation.box((0.04, 0.05, 0.08)).export(box)
    with pytest.raises(OptionError, match=rf"'{box}' is not the object 'textured' .* as it was then"):
        run_tabletop(TabletopRun(small_robot, (box,), attempts=1, config=QUICK), output)


def test_attempts_with_other_weights_or_another_robot_are_no_results_of_these(small_robot: str, tmp_path: Path) -> None:
    calls: list[str] = []

    def counted(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
        calls.append(obj.name)
        return Attempt(robot.name, obj.name, number, seed, QUICK.label(), True, "done", score=float(len(calls)))

    def run(output: Path = tmp_path / "results.parquet") -> list[float]:
        return [a.score for a in run_tabletop(TabletopRun(str(file), ("can",), 1, 0, weights, QUICK), output, make=counted)]

    text, file, weights = Path(small_robot).read_text(), tmp_path / "robot.yaml", None
    file.write_text(f"{text}\n# a remark changes nothing\n")
    assert run() == [1]
    file.write_text(text)
    assert run() == [1]
    weights = str(tmp_path / f"{DEFAULT}.safetensors")
    save_weights(load_weights(), weights, {"trained": "elsewhere"})
    assert run() == [2], "the name is not enough"
    file.write_text(text.replace("velocity: 2.0", "velocity: 1.25"))
    assert run() == [3]
    assert run() == [3]
    stored = read_attempts(tmp_path / "results.parquet")
    assert [(a.weights, Path(a.robot_file).name) for a in stored] == [
        (DEFAULT, "robot.yaml"), (weights, "robot.yaml"), (weights, "robot.yaml")]


def test_the_command_prints_rates_and_refuses_what_cannot_be(
    small_robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def ended(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
        return Attempt(robot.name, obj.name, number, seed, TabletopConfig().label(), True, "done", processor_seconds=2.0)

    stored = tmp_path / "stored.parquet"
    run_tabletop(TabletopRun(small_robot, ("can",), attempts=4), stored, make=ended)
    common = ["tabletop", "--robot", small_robot, "--objects", "can", "--attempts"]
    assert main([*common, "4", "--output", str(stored)]) == 0
    said = capsys.readouterr().out
    assert "4 of 4 attempts succeeded (100%, 95 % interval 51% to 100%)" in said
    assert "median 2.0 s" in said
    assert main([*common, "0"]) == 2
    assert main([*common, "1", "--video", str(tmp_path / "film.avi")]) == 2
    assert ".gif or .webp" in capsys.readouterr().err


def broken(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
    """The second attempt with the torus ends in a fault."""
    if obj.name == "torus" and number:
        raise ValueError("a fault")
    return Attempt(robot.name, obj.name, number, seed, TabletopConfig().label(), True, "done")


def test_a_fault_loses_nothing_of_what_other_processes_make(small_robot: str, tmp_path: Path) -> None:
    stored = tmp_path / "stored.parquet"
    with pytest.raises(ValueError, match="a fault"):
        run_tabletop(TabletopRun(small_robot, ("torus", "can"), attempts=2), stored, workers=2, make=broken)
    assert sorted((a.object, a.number) for a in read_attempts(stored)) == [("can", 0), ("can", 1), ("torus", 0)]


def deadly(robot: dro.Robot, obj: dro.ObjectModel, number: int, seed: int, *others: object) -> Attempt:
    """The second attempt with the torus ends its process, as a system does that is out of memory."""
    if obj.name == "torus" and number:
        os.kill(os.getpid(), signal.SIGKILL)
    return Attempt(robot.name, obj.name, number, seed, TabletopConfig().label(), True, "done")


def test_a_process_that_dies_loses_nothing_but_its_attempt(small_robot: str, tmp_path: Path) -> None:
    stored, objects = tmp_path / "stored.parquet", ("torus", "can", "sphere")
    with pytest.raises(OptionError, match=r"died over its attempt .*ask for fewer"):
        run_tabletop(TabletopRun(small_robot, objects, attempts=2), stored, workers=2, make=deadly)
    made = {(a.object, a.number) for a in read_attempts(stored)}
    assert made == {(name, number) for name in objects for number in (0, 1)} - {("torus", 1)}


def stuck(robot: dro.Robot, obj: dro.ObjectModel, number: int, *others: object) -> Attempt:
    """The second attempt with an object takes for ever."""
    Path(os.environ["MARKS"], f"{obj.name}-{number}").touch()
    time.sleep(600 * number)
    return deadly(robot, obj, 0, *others)


PARENT = """
import signal, sys
from pathlib import Path
from dro_grasp.arm.tabletop.run import TabletopRun, run_tabletop
from tests.arm.tabletop.test_tabletop import stuck
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
    run_tabletop(TabletopRun(sys.argv[1], ("can", "torus", "sphere"), 2), Path(sys.argv[2]), workers=2, make=stuck)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_is_stopped_begins_nothing_more_and_keeps_what_has_ended(
    small_robot: str, tmp_path: Path, end: signal.Signals
) -> None:
    script, output = tmp_path / "parent.py", tmp_path / "stored.parquet"
    script.write_text(PARENT)
    parent = start(script, small_robot, output, MARKS=str(tmp_path))
    try:
        wait_for(lambda: len(list(tmp_path.glob("*-1"))) == 2)  # both are at an attempt that takes for ever
        wait_for(lambda: output.is_file() and len(read_attempts(output)) == 2)
        started = children(parent.pid)
        parent.send_signal(end)
        parent.wait(20)
    finally:
        parent.kill()
        parent.wait()
    wait_for(lambda: not any(alive(pid) for pid in started))
    assert sorted((a.object, a.number) for a in read_attempts(output)) == [("can", 0), ("torus", 0)]


def test_a_second_run_into_one_file_is_refused_and_loses_nothing(small_robot: str, tmp_path: Path) -> None:
    output, run = tmp_path / "stored.parquet", TabletopRun(small_robot, ("can",), attempts=2)

    def ended(robot: dro.Robot, obj: dro.ObjectModel, number: int, *others: object) -> Attempt:
        if number:
            with pytest.raises(OutputError, match=r"another run is storing its attempts in .*stored.parquet"):
                run_tabletop(replace(run, objects=("torus",)), output, make=deadly)
        return deadly(robot, obj, number, *others)

    run_tabletop(run, output, make=ended)
    assert len(run_tabletop(run, output)) == 2


def test_a_bare_cloud_is_refused_before_anything_is_attempted(small_robot: str, tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", dro.load_object("can").cloud)
    with pytest.raises(OptionError, match="object 'cloud' is a bare cloud"):
        run_tabletop(TabletopRun(small_robot, ("can", str(tmp_path / "cloud.npy"))), make=broken)
