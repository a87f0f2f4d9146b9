"""Commands that read grasps, with another hand or object than the file's: shown, or refused, and never mixed up."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from dro_grasp.apps.viewer.studio import Studio, StudioServer
from dro_grasp.cli.main import main, parse
from dro_grasp.cli.view import View
from dro_grasp.grasps.batch import GraspBatch, load_grasps
from dro_grasp.hands.library import BUILTIN_FOLDER
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.sources.controls import palm_facing_starts
from tests.helpers.browser import free_port
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.served_studio import visited

URDF = (BUILTIN_FOLDER / "gripper3.urdf").read_text()
COMMANDS = {
    "view": ["view"], "picture": ["picture", "--posture", "grasp", "--output", "sheet.png"],
    "export": ["export", "--format", "moveit", "--output", "grasps"],
}


@pytest.fixture
def both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> GraspBatch:
    """Grasps of the mug and the can, in `both.parquet` in the current folder."""
    monkeypatch.chdir(tmp_path)
    batches = [palm_facing_starts(loaded_hand("gripper3"), load_object(name), num=num, seed=0)
               for name, num in (("mug", 1), ("can", 2))]
    both = GraspBatch.concatenate(batches)
    both.save("both.parquet")
    return both


@pytest.fixture
def first_page():
    """What opens the page of `view` with some arguments, and returns it."""
    servers: list[StudioServer] = []

    def opened(*arguments: str) -> Studio:
        assert parse(["view", *arguments, "--port", str(free_port())]).run(servers.append) == 0
        visited(servers[-1], 1)
        return servers[-1].studios[0]

    yield opened
    for server in servers:
        server.stop()


@pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")
def test_view_shows_grasps_with_a_hand_of_the_same_joints_and_says_that_it_is_another(both: GraspBatch, first_page) -> None:
    Path("variant.urdf").write_text(URDF.replace('radius="0.04"', 'radius="0.041"'))
    note = "made for another 'gripper3' than the given variant"
    both[0].save("mug.parquet")
    for more in (["--object", "sphere"], []):
        page = first_page("mug.parquet", "--hand", "variant.urdf", *more)
        assert page.made is not None, page.status.content
        assert page.made.hand.name == "variant"
        assert len(page.shown) == 1
        assert note in page.status.content
    page.hand.value = "barrett"
    page._pick_object()
    assert page.made is None, "another hand has no grasps"
    page.hand.value = "variant"
    page._pick_object()
    assert page.made is not None
    page.hand.value = "gripper3"
    page._pick_object()
    assert page.made is not None, "that of the file's own hash"
    assert "made for another" not in page.status.content


@pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")
def test_view_shows_grasps_that_name_no_version_of_their_hand(both: GraspBatch, first_page) -> None:
    both.replace(hand_sha256="").save("unversioned.parquet")
    page = first_page("unversioned.parquet")
    assert page.made is not None, page.status.content
    assert len(page.shown) == 1
    assert "made for another" not in page.status.content


@pytest.mark.parametrize("command", COMMANDS)
def test_a_hand_of_other_joints_is_refused(both: GraspBatch, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    name, *more = COMMANDS[command]
    assert main([name, "both.parquet", "--hand", "barrett", *more]) == 2
    assert "these grasps are for hand 'gripper3' with joints" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["both.parquet"]


@pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")
@pytest.mark.parametrize("command", ["view", "picture"])
def test_a_mesh_does_not_replace_one_of_several_objects(
    both: GraspBatch, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *more = COMMANDS[command]
    assert main([name, "both.parquet", "--object", "sphere", *more]) == 2
    assert "--object is 'sphere', but the grasps are of 2 objects (mug, can)" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["evaluate"], COMMANDS["export"]], ids=["evaluate", "export"])
@pytest.mark.parametrize("names", [("mug", "can"), ("can", "can")], ids=["two names", "one name"])
def test_an_object_that_is_given_stands_for_one_alone(
    both: GraspBatch, command: list[str], names: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = names
    both.replace(object=(first, second, second)).save("both.parquet")
    assert main([command[0], "both.parquet", "--object", "sphere", *command[1:]]) == 2
    assert "both.parquet holds grasps of 2 objects; another object fits a file with one" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["both.parquet"]


def test_an_object_without_success_does_not_get_the_grasps_of_another(
    both: GraspBatch, capsys: pytest.CaptureFixture[str]
) -> None:
    both.replace(success=torch.tensor([False, True, False]), protocol=("strict/1",) * 3).save("both.parquet")
    command = ["picture", "both.parquet", "--only-successful", "--output", "sheet.png"]
    assert main([*command, "--object", "mug"]) == 2
    assert "no grasp of mug in both.parquet has passed a trial; leave out --only-successful" in capsys.readouterr().err
    assert main([*command, "--object", "sphere"]) == 2
    assert "--object is 'sphere'" in capsys.readouterr().err
    for more in ([], ["--object", "can"]):
        drawn = parse([*command, *more]).pairs(load_grasps("both.parquet"))
        assert [(obj.name, len(own)) for obj, own in drawn] == [("can", 1)]


def test_the_viewer_shows_the_object_of_a_file_in_the_scale_that_is_given(
    generate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, shown = tmp_path / "grasps.parquet", list[Any]()
    generate("--output", str(path), "--protocol", "none", num=1)
    monkeypatch.setattr(View, "_pages", lambda _, fill: fill)
    for scale in ([], ["--scale", "1.2"]):
        fill: Any = parse(["view", str(path), "--object", "sphere", *scale])._opened(path)
        fill(SimpleNamespace(open=lambda *given: shown.append(given[2])))
    assert shown[0] is None, "the file's own"
    assert np.ptp(shown[1].vertices) == pytest.approx(1.2 * np.ptp(load_object("sphere").vertices))
