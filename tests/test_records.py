"""Folders of shards: names, damaged and foreign files, reading pairs."""

from __future__ import annotations

import os
import time
from types import SimpleNamespace

import pytest
import torch

from dro_grasp.datasets.records import Shard, count_grasps, find_shards, read_pairs, remove_leftovers
from dro_grasp.errors import GraspFileError, OutputError
from dro_grasp.grasps.batch import GraspBatch


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
    shard.save(grasps(2, hand, obj), tmp_path)
    assert find_shards(tmp_path) == [shard]
    assert shard.path(tmp_path).resolve().is_relative_to(tmp_path.resolve())
    assert count_grasps(tmp_path, shard) == 2


def test_an_empty_shard_counts_as_done(tmp_path):
    Shard("toy", "ball", 0).save(grasps(0), tmp_path)
    assert count_grasps(tmp_path, Shard("toy", "ball", 0)) == 0
    assert list(read_pairs(tmp_path)) == []


def test_pairs_join_their_rounds_and_leave_failures_out(tmp_path):
    Shard("toy", "ball", 0).save(grasps(2), tmp_path)
    Shard("toy", "ball", 1).save(grasps(3), tmp_path)
    Shard("toy", "ball", 2).save(grasps(5, success=False), tmp_path)
    Shard("toy", "cube", 0).save(grasps(4, obj="cube", success=None), tmp_path)
    Shard("other", "ball", 0).save(grasps(1, hand="other"), tmp_path)
    pairs = {pair: len(batch) for pair, batch in read_pairs(tmp_path)}
    assert pairs == {("toy", "ball"): 5, ("other", "ball"): 1}
    everything = {pair: len(batch) for pair, batch in read_pairs(tmp_path, ["toy"], only_successful=False)}
    assert everything == {("toy", "ball"): 10, ("toy", "cube"): 4}


def test_a_damaged_shard_does_not_count_and_is_named_when_read(tmp_path):
    shard = Shard("toy", "ball", 0)
    shard.save(grasps(2), tmp_path)
    path = shard.path(tmp_path)
    path.write_bytes(path.read_bytes()[:-20])
    assert count_grasps(tmp_path, shard) is None
    with pytest.raises(GraspFileError, match=r"00000\.parquet"):
        list(read_pairs(tmp_path))


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(GraspFileError, match="no folder"):
        find_shards(tmp_path / "none")


def test_a_folder_that_cannot_be_made_is_an_output_error(tmp_path):
    (tmp_path / "toy").write_text("in the way")
    with pytest.raises(OutputError):
        Shard("toy", "ball", 0).save(grasps(1), tmp_path)


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
