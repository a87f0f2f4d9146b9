"""The command line: exit codes, messages, the JSON contract, and files. Weights are untrained throughout."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
import torch

from dro_grasp.__main__ import run
from dro_grasp._version import __version__
from dro_grasp.cli import main as cli
from dro_grasp.cli.main import main
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.simulation.contacts import measure_contacts
from dro_grasp.simulation.protocols import protocol
from tests.helpers.loaded_hands import loaded_hand


def names_of(command: Any) -> list[list[str]]:
    """The words that reach each command below a union of commands, groups of commands included."""
    found = []
    for kind, settings in (get_args(part) for part in get_args(command)):
        below = get_type_hints(kind, include_extras=True).get("command")
        found += [[settings.name], *([settings.name, *words] for words in (names_of(below) if below else []))]
    return found


COMMANDS = [[], *names_of(cli.Command)]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: " ".join(c) or "top")
def test_every_command_has_help(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    out = capsys.readouterr().out
    assert stop.value.code == 0
    assert "usage: dro-grasp" in out
    assert "{None}" not in out, "options that may be left out say what happens then"


def test_commands_within_groups_are_found() -> None:
    assert ["generate"] in COMMANDS
    assert ["dataset", "filter"] in COMMANDS


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"dro-grasp {__version__}\n"


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\nfrom dro_grasp.cli.main import main\n"
        "try: main(['generate', '--help'])\nexcept SystemExit: pass\n"
        "print(sorted({'torch', 'mujoco', 'trimesh', 'viser', 'matplotlib', 'pyarrow'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--num", "0"], "num is 0"),
        (["--num", "-1"], "num is -1"),
        (["--num", "1000000000"], "at most"),
        (["--table", "nan"], "table is nan"),
        (["--output", "grasps.csv"], "grasps.parquet"),
        (["--picture", "grasps.svg"], "grasps.png"),
        (["--direction", "0", "0", "0"], "direction"),
        (["--seed", "-1"], "seed is -1"),
        (["--hand", "allegr"], "allegro"),
        (["--hand", "nowhere.urdf"], "nowhere.urdf"),
        (["--object", "mugg"], "mug"),
        (["--object", "nowhere.obj"], "nowhere.obj"),
        (["--scale", "0"], "scale"),
        (["--weights", "nowhere.safetensors"], "nowhere.safetensors"),
        (["--output", "nowhere/grasps.parquet"], "create it first"),
        (["--picture", "nowhere/grasps.png"], "create it first"),
    ],
)
def test_bad_input_is_one_message_and_status_2(
    arguments: list[str], word: str, weights: str, capsys: pytest.CaptureFixture[str]
) -> None:
    base = {"--hand": ["gripper3"], "--object": ["sphere"], "--weights": [weights], "--num": ["2"]}
    base[arguments[0]] = arguments[1:]
    assert main(["generate", *[word for pair in base.items() for word in (pair[0], *pair[1])]]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("error: ")
    assert word in said.err
    assert "Traceback" not in said.err


def test_wrong_arguments_are_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["generate", "--hand", "gripper3", "--object", "sphere", "--numb", "3"])
    assert stop.value.code == 2
    assert "--num" in capsys.readouterr().err


def test_our_fault_is_status_1(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    class Broken:
        def run(self) -> int:
            raise ZeroDivisionError("oops")

    monkeypatch.setattr(cli, "parse", lambda arguments: Broken())
    assert main(["hands"]) == 1
    short = capsys.readouterr().err
    assert "internal error: ZeroDivisionError: oops" in short
    assert "--verbose" in short
    assert "Traceback" not in short
    assert main(["hands", "--verbose"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_nobody_reads_the_output() -> None:
    """As in `dro-grasp objects | head -1`: silence, and the exit code that rich has for it; of a table, of text and of JSON."""
    reader, writer = os.pipe()
    os.close(reader)
    for arguments in ("hands", "--help", "objects --json"):
        command = [sys.executable, "-m", "dro_grasp", *arguments.split()]
        done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
        assert (done.returncode, done.stderr) == (1, ""), arguments
    os.close(writer)


def test_ctrl_c_ends_a_command_with_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(_: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "run", interrupted)
    assert run() == 130
    assert capsys.readouterr() == ("", "stopped\n")


def test_evaluate_and_view_take_the_file_that_generate_wrote(generate, tmp_path: Path, capsys) -> None:
    grasps, tried, picture = tmp_path / "a.parquet", tmp_path / "b.parquet", tmp_path / "a.png"
    generate("--output", str(grasps), "--protocol", "none", num=2)
    assert main(["evaluate", str(grasps), "--protocol", "strict", "--output", str(tried), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["num"] == 2
    assert report["interval_95"][0] <= report["success_rate"] <= report["interval_95"][1]
    evaluated = GraspBatch.load(tried)
    assert set(evaluated.protocol) == {"strict/1"}
    fingers = evaluated.fingers_in_contact
    assert report["fingers_in_contact"] == pytest.approx(float(fingers.mean()) / 3)
    assert report["all_fingers_in_contact"] == pytest.approx(float((fingers == 3).float().mean()))
    assert "trials_held" not in report
    assert report["contact_quality"] == {}
    assert main(["evaluate", str(grasps), "--protocol", "robust", "--output", str(tried), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["trials_held"] == pytest.approx(float(GraspBatch.load(tried).robustness.mean()))
    assert main(["evaluate", str(grasps), "--protocol", "robust"]) == 0
    assert "held in" in capsys.readouterr().out
    assert main(["picture", str(tried), "--output", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_evaluate_measures_contacts_with_the_protocols_friction(generate, tmp_path: Path, capsys) -> None:
    grasps, tried = tmp_path / "a.parquet", tmp_path / "b.parquet"
    generate("--output", str(grasps), "--protocol", "none", num=2)
    options = ["--protocol", "dexgraspbench", "--friction", "0.9", "--contact-quality"]
    assert main(["evaluate", str(grasps), *options, "--output", str(tried), "--json"]) == 0
    means = json.loads(capsys.readouterr().out)["contact_quality"]
    measured = GraspBatch.load(tried)
    rules = replace(protocol("dexgraspbench"), friction=0.9)
    wanted = measure_contacts(loaded_hand("gripper3"), load_object("sphere"), measured, rules)
    assert set(means) == {field.name for field in fields(wanted)}
    for name, mean in means.items():
        # Poses in files are rounded.
        torch.testing.assert_close(measured.extra[name], getattr(wanted, name), rtol=1e-3, atol=1e-3)
        assert mean == pytest.approx(float(measured.extra[name].mean()), rel=1e-4)
    assert main(["evaluate", str(grasps), *options]) == 0
    assert "contact distance" in capsys.readouterr().out


def test_evaluation_on_another_object_is_told(generate, tmp_path: Path, capsys) -> None:
    path = tmp_path / "grasps.parquet"
    generate("--output", str(path), "--protocol", "none")
    assert main(["evaluate", str(path)]) == 0
    assert "made for another" not in capsys.readouterr().err
    assert main(["evaluate", str(path), "--object", "can"]) == 0
    assert "made for another 'sphere' than the given can" in capsys.readouterr().err


def test_evaluate_counts_reasons_by_kind(generate, tmp_path: Path, capsys) -> None:
    path = tmp_path / "grasps.parquet"
    generate("--output", str(path), "--protocol", "none", num=1)
    grasps = GraspBatch.load(path)
    # The wrist inside the object, at different depths.
    poses = torch.eye(4).expand(3, 4, 4).clone()
    poses[:, 2, 3] = torch.tensor([0.0, 0.005, 0.01])
    GraspBatch.concatenate([grasps] * 3).replace(T_object_wrist=poses).save(path)
    assert main(["evaluate", str(path), "--protocol", "strict", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["reasons"] == {"hand penetrates object": 3}
    assert main(["evaluate", str(path), "--protocol", "strict"]) == 0
    assert "3 failed: hand penetrates object\n" in capsys.readouterr().out


RUNS_TRIALS = [["generate"], ["evaluate"], ["benchmark"], ["synthesize"], ["dataset", "check"], ["dataset", "filter"]]


def test_a_new_protocol_is_a_choice_of_every_command() -> None:
    code = f"""
from dataclasses import replace
from dro_grasp.simulation.protocols import PROTOCOLS
PROTOCOLS["brand_new"] = replace(PROTOCOLS["dro"], name="brand_new")
from dro_grasp.cli.main import main
for words in {RUNS_TRIALS}:
    try:
        main([*words, "--help"])
    except SystemExit:
        print("end of", *words)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          env=os.environ | {"COLUMNS": "300"})
    pages = re.split(r"^end of .*$", done.stdout, flags=re.MULTILINE)[:-1]
    assert ["brand_new" in page for page in pages] == [True] * len(RUNS_TRIALS)


def test_a_quick_benchmark_does_not_call_candidates_grasps(capsys: pytest.CaptureFixture[str]) -> None:
    """Of 16 candidates for each of two objects, four are returned."""
    assert main(["benchmark", "--methods", "start", "--hands", "gripper3", "--objects", "can", "sphere", "--quick"]) == 0
    title, *table = [line for line in capsys.readouterr().out.splitlines() if line]
    names, _, row = [[cell.strip() for cell in line.split("|")] for line in table[:3]]
    assert row[names.index("n")].split()[0] == "8"
    assert title.startswith("16 candidates of each hand on each of 2 objects;")


def test_foreign_and_empty_grasp_files_are_status_2(generate, tmp_path: Path, capsys) -> None:
    foreign, empty = tmp_path / "foreign.parquet", tmp_path / "empty.parquet"
    foreign.write_bytes(b"PAR1 not really")
    generate("--output", str(empty), "--protocol", "none", num=1)
    GraspBatch.load(empty)[slice(0, 0)].save(empty)
    for file in (foreign, empty, tmp_path / "missing.parquet"):
        for command in ("evaluate", "view"):
            assert main([command, str(file)]) == 2
            assert file.name in capsys.readouterr().err


@pytest.mark.parametrize("command", [["hands"], ["objects"], ["weights", "list"]])
def test_lists_in_both_forms(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command, "--json"]) == 0
    names = json.loads(capsys.readouterr().out)[command[0]]
    assert main(command) == 0
    table = capsys.readouterr().out
    assert all((n if isinstance(n, str) else n["name"]) in table for n in names)


def test_hand_check_in_both_forms(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["hand", "check", "gripper3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["hand"]
    assert main(["hand", "check", "gripper3", "--picture", str(tmp_path / "hand.png")]) == 0
    assert "palm" in capsys.readouterr().out
    assert main(["hand", "check", "nowhere.urdf"]) == 2


def test_own_files_are_found_again(
    weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import shutil

    import trimesh

    from dro_grasp.hands.library import BUILTIN_FOLDER

    shutil.copy(BUILTIN_FOLDER / "gripper3.urdf", tmp_path / "mine.urdf")
    trimesh.creation.box((40, 40, 60)).export(tmp_path / "box.stl")
    (tmp_path / "below").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["generate", "--hand", "mine.urdf", "--object", "box.stl", "--scale", "0.001", "--num", "2", "--weights",
                 weights, "--source", "network", "--output", "grasps.parquet", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    monkeypatch.chdir(tmp_path / "below")
    assert main(["evaluate", "../grasps.parquet", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["success"] == made["success"]
    (tmp_path / "mine.urdf").unlink()
    assert main(["picture", "../grasps.parquet", "--output", "a.png"]) == 2
    assert "give its file with --hand" in capsys.readouterr().err


def test_verify_prints_no_empty_table(weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    assert main(["weights", "verify", str(tmp_path / "bad.safetensors")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "bad.safetensors" in said.err
    assert main(["weights", "verify", str(tmp_path / "bad.safetensors"), weights]) == 2
    assert capsys.readouterr().out == f"{sha256(Path(weights).read_bytes()).hexdigest()}  {weights}: ok\n"
