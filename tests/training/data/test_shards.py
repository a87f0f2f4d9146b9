"""Folders of shards: names, damaged and foreign files, reading pairs."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from dro_grasp.errors import GraspFileError, OptionError, OutputError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.training.data.collections.collection import count_collection, read_collection
from dro_grasp.training.data.engine.schedule import require_known
from dro_grasp.training.data.engine.shards import Shard, Yield, find_shards, notes_of, read_yield, remove_leftovers


def grasps(n: int, hand: str = "toy", obj: str = "ball", success: bool | None = True) -> GraspBatch:
    tree = SimpleNamespace(link_names=("base",), joint_names=("j",))
    made = GraspBatch.create(
        SimpleNamespace(name=hand, sha256=hand, tree=tree), SimpleNamespace(name=obj, sha256=obj, split="train"),
        torch.eye(4).repeat(n, 1, 1), torch.arange(float(n))[:, None],
    )
    if success is None:
        return made
    return made.replace(success=torch.full((n,), success), protocol=("strict/1",) * n)


@pytest.mark.parametrize("hand", ["toy", "assets/allegro_left", "/home/me/my hand.urdf", "päd%2F"])
@pytest.mark.parametrize("obj", ["ball", "contactdb+apple", "../mesh.obj"])
def test_any_name_makes_a_shard_inside_the_folder(tmp_path, hand, obj):
    shard = Shard(hand, obj, 3)
    shard.save(grasps(2, hand, obj).to_bytes(), tmp_path)
    assert find_shards(tmp_path) == [shard]
    assert shard.path(tmp_path).resolve().is_relative_to(tmp_path.resolve())
    assert read_yield(tmp_path, shard).valid == 2


@pytest.mark.parametrize("folder", ["hands of " + "a" * 240, "机械手" * 10])
def test_names_that_are_too_long_for_a_folder_are_refused_before_the_work(tmp_path, folder):
    (file := tmp_path / folder / "mine.urdf").parent.mkdir()
    file.write_text("<robot/>")
    with pytest.raises(OptionError, match=r"is too long: .*Give a shorter path"):
        require_known([str(file)], [])


def test_an_empty_shard_counts_as_done(tmp_path):
    shard, made = Shard("toy", "ball", 0), Yield(candidates=64, failures={"slipped": 3}, cpu_seconds=1.5)
    shard.save(grasps(0).to_bytes(notes_of(made)), tmp_path)
    assert read_yield(tmp_path, shard) == made
    (pair,) = read_collection(tmp_path)
    assert len(pair.grasps) == 0
    assert pair.made == made


def test_pairs_join_their_rounds_and_leave_failures_out(tmp_path):
    Shard("toy", "ball", 0).save(grasps(2).to_bytes(notes_of(Yield(candidates=64, valid=2))), tmp_path)
    Shard("toy", "ball", 1).save(grasps(3).to_bytes(notes_of(Yield(candidates=128, valid=3))), tmp_path)
    Shard("toy", "ball", 2).save(grasps(5, success=False).to_bytes(), tmp_path)
    Shard("toy", "cube", 0).save(grasps(4, obj="cube", success=None).to_bytes(), tmp_path)
    Shard("other", "ball", 0).save(grasps(1, hand="other").to_bytes(), tmp_path)
    pairs = {(p.hand, p.object): len(p.grasps) for p in read_collection(tmp_path)}
    assert pairs == {("toy", "ball"): 5, ("toy", "cube"): 0, ("other", "ball"): 1}
    everything = {(p.hand, p.object): p for p in read_collection(tmp_path, only_successful=False)}
    assert len(everything["toy", "ball"].grasps) == 10
    assert everything["toy", "ball"].made.candidates == 192
    assert count_collection(tmp_path) == {"toy": {"ball": 10, "cube": 4}, "other": {"ball": 1}}


def test_files_and_folders_of_files_are_collections_as_well(tmp_path):
    both = GraspBatch.concatenate([grasps(2), grasps(3, obj="cube")])
    both.save(tmp_path / "toy.parquet", {"yields": {"cube": Yield(candidates=9).to_dict(), "none": Yield(deep=4).to_dict()}})
    grasps(1, hand="other").save(tmp_path / "other.parquet")
    found = {(p.hand, p.object): (len(p.grasps), p.made.candidates, p.made.deep) for p in read_collection(tmp_path)}
    assert found == {
        ("toy", "ball"): (2, 0, 0), ("toy", "cube"): (3, 9, 0), ("toy", "none"): (0, 0, 4), ("other", "ball"): (1, 0, 0)}
    assert {p.object for p in read_collection(tmp_path / "toy.parquet")} == {"ball", "cube", "none"}


def test_shards_of_two_versions_of_a_hand_are_not_mixed(tmp_path):
    Shard("toy", "ball", 0).save(grasps(2).to_bytes(), tmp_path)
    Shard("toy", "ball", 1).save(grasps(2).replace(hand_sha256="new").to_bytes(), tmp_path)
    with pytest.raises(GraspFileError, match="different versions of hand 'toy'"):
        list(read_collection(tmp_path))


def test_a_damaged_shard_does_not_count_and_is_named_when_read(tmp_path):
    shard = Shard("toy", "ball", 0)
    shard.save(grasps(2).to_bytes(), tmp_path)
    path = shard.path(tmp_path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(GraspFileError, match=r"00000\.parquet"):
        read_yield(tmp_path, shard)
    with pytest.raises(GraspFileError, match=r"00000\.parquet"):
        list(read_collection(tmp_path))


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(GraspFileError, match="no folder"):
        find_shards(tmp_path / "none")


def test_a_folder_that_cannot_be_made_is_an_output_error(tmp_path):
    (tmp_path / "toy").write_text("in the way")
    with pytest.raises(OutputError):
        Shard("toy", "ball", 0).save(grasps(1).to_bytes(), tmp_path)


def test_only_old_leftovers_are_removed(tmp_path):
    folder = tmp_path / "toy" / "ball"
    folder.mkdir(parents=True)
    old, young = folder / ".00000.parquet.a.part", folder / ".00001.parquet.b.part"
    for path in (old, young):
        path.write_bytes(b"half")
    os.utime(old, (time.time() - 7200,) * 2)
    assert remove_leftovers(tmp_path) == 1
    assert young.exists()
    assert not old.exists()


def test_temporary_files_that_others_finish_meanwhile_are_left_to_them(tmp_path, monkeypatch):
    """As the other parts of an array job do, between the listing of a file and the look at it."""
    folder = tmp_path / "toy" / "ball"
    folder.mkdir(parents=True)
    names = [".settings.json1.part", *(f"toy/ball/.0000{i}.parquet.part" for i in range(3))]
    for name in names:
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time.time() - 7200,) * 2)
    listed = Path.glob

    def rename(place: Path, pattern: str) -> list[Path]:
        found = sorted(listed(place, pattern))
        for path in found[1:]:
            path.rename(path.with_name(path.name.strip(".")))
        return found

    monkeypatch.setattr(Path, "glob", rename)
    assert remove_leftovers(tmp_path) == 2
    assert sorted(path.name for path in folder.iterdir()) == ["00001.parquet.part", "00002.parquet.part"]
