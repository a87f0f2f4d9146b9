"""Grasps of objects that were loaded with a scale: every command finds the object again as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.cli.main import main
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import complete
from dro_grasp.grasps.sources import object_of, object_source, with_own_files, with_sources
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.sources.controls import palm_facing_starts
from dro_grasp.training.data.collections.collection import Sources
from tests.helpers.bench_clone import clone_of_bars
from tests.helpers.loaded_hands import loaded_hand


@pytest.fixture(scope="module")
def hand() -> Hand:
    return loaded_hand("gripper3")


def starts(hand: Hand, obj: ObjectModel) -> GraspBatch:
    return complete(hand, palm_facing_starts(hand, obj, num=2, seed=0), torch.zeros(3))


@pytest.mark.parametrize("name", ["mug", "procedural_3"])
@pytest.mark.parametrize("by_command", [False, True])
def test_the_scale_of_a_named_object_is_known_again(hand: Hand, tmp_path: Path, name: str, by_command: bool) -> None:
    obj = load_object(name, scale=0.7)
    made = starts(hand, obj)
    made = with_sources(made, "gripper3", name, 0.7) if by_command else with_own_files(made, hand, obj)
    made.save(tmp_path / "small.parquet")
    back = GraspBatch.load(tmp_path / "small.parquet")
    assert object_source(back) == (name, 0.7)
    assert object_of(back, None, 1.0).sha256 == Sources().of(back)[1].sha256 == obj.sha256
    with_sources(starts(hand, load_object(name)), "gripper3", name, 1.0).save(tmp_path / "whole.parquet")
    whole = GraspBatch.load(tmp_path / "whole.parquet")
    both = dict(GraspBatch.concatenate([whole, back]).by_object())
    assert [object_source(part)[1] for part in both.values()] == [1.0, 0.7]


def test_a_folder_of_dexgraspbench_is_found_again(hand: Hand, tmp_path: Path) -> None:
    folder = clone_of_bars(tmp_path, ("bar",)) / "assets" / "bar"
    obj = load_object(folder, scale=0.06)
    made = with_sources(starts(hand, obj), "gripper3", str(folder), 0.06)
    assert object_of(made, None, 1.0).sha256 == obj.sha256


def test_commands_take_a_given_file_at_the_scale_of_the_grasps_and_say_where_it_is_another(
    hand: Hand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, moved, other = (tmp_path / name for name in ("box.stl", "moved.stl", "other.stl"))
    for path, size in ((file, 50.0), (moved, 50.0), (other, 60.0)):
        trimesh.creation.box((size, 40.0, 70.0)).export(path)
    obj = load_object(file, scale=0.001)
    with_sources(starts(hand, obj), "gripper3", str(file), 0.001).save(tmp_path / "g.parquet")
    file.unlink()
    out = tmp_path / "npy"
    export = ["export", str(tmp_path / "g.parquet"), "--format", "dexgraspbench", "--output"]
    assert main([*export, str(out), "--object", str(moved)]) == 0
    entry = np.load(next(out.rglob("*.npy")), allow_pickle=True).item()
    assert (entry["obj_path"], entry["obj_scale"]) == (str(moved), 0.001)
    draw = ["picture", str(tmp_path / "g.parquet"), "--posture", "grasp", "--output", str(tmp_path / "p.png")]
    assert main([*draw, "--object", str(moved)]) == 0
    assert "made for another" not in capsys.readouterr().err
    assert main([*export, str(tmp_path / "other"), "--object", str(other)]) == 0
    assert "made for another 'box' than the given other" in capsys.readouterr().err
    assert main([*draw, "--object", str(moved), "--scale", "0.0011"]) == 0
    assert "made for another 'box' than the given moved" in capsys.readouterr().err
    for command in (draw, ["evaluate", str(tmp_path / "g.parquet")]):
        assert main([*command, "--scale", "0.001"]) == 2
        assert "name the object, too: --object" in capsys.readouterr().err
