"""Merging data sets: duplicates once, an even choice, compact files that mean the same, and the command."""

from __future__ import annotations

import json
import math
import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.cli.main import main
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.frames import NamedMotion
from dro_grasp.geometry import se3
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import object_of, object_source, with_sources
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.training.data.collections.collection import count_collection, read_collection
from dro_grasp.training.data.collections.merging import ANGLE_STEP, POSITION_STEP, Merged, compact, file_name, merge, spread
from dro_grasp.training.data.engine.shards import Shard, Yield, notes_of
from dro_grasp.training.made_hands.making import make_hand
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import made_up_grasps


@pytest.fixture(scope="module")
def hand() -> Hand:
    return loaded_hand("gripper3")


def tried(hand: Hand, obj: str, count: int, seed: int, failed: int = 0) -> GraspBatch:
    """Made-up grasps, the first `failed` of which failed their trial."""
    numbers = torch.rand(count, generator=torch.Generator().manual_seed(seed))
    made = made_up_grasps(hand, obj, count, seed=seed, score=-numbers)
    return made.replace(
        success=torch.arange(count) >= failed, protocol=("strict/1",) * count, penetration=numbers / 300,
        displacement=numbers / 100, rotation=numbers / 7,
        extra={"energy_distance": numbers * 3, "reason": [""] * count, "contact_links": [["base"]] * count},
    )


def grasps_in(merged: Merged) -> GraspBatch:
    """The grasps of a merged file."""
    return GraspBatch.load(BytesIO(merged.to_bytes()))


@pytest.fixture
def folders(hand: Hand, tmp_path: Path) -> tuple[Path, Path]:
    """Two data sets with one shard in common."""
    first, second = tmp_path / "first", tmp_path / "second"
    both = tried(hand, "sphere", 12, seed=0, failed=2)
    for folder, batches in ((first, [both, tried(hand, "can", 6, seed=1)]), (second, [both, tried(hand, "sphere", 8, seed=2)])):
        for i, batch in enumerate(batches):
            made = Yield(candidates=64, failures={"slipped": 2}, valid=len(batch), cpu_seconds=2.0)
            Shard(hand.name, batch.object[0], i).save(batch.to_bytes(notes_of(made)), folder)
    return first, second


def test_what_two_sets_share_is_kept_once_and_failures_are_left_out(folders, hand):
    (merged,) = merge(folders)
    assert merged.hand == "gripper3"
    grasps = grasps_in(merged)
    counts = {name: grasps.object.count(name) for name in ("sphere", "can")}
    assert counts == {"sphere": 18, "can": 6}
    assert merged.duplicates == 10
    assert bool(grasps.success.all())
    assert merged.yields["sphere"].candidates == 3 * 64


def test_merged_files_are_collections_with_their_yields(folders, tmp_path, capsys):
    out = tmp_path / "merged"
    (left := out / ".merge-killed").mkdir(parents=True)  # by a run that was killed
    assert main(["dataset", "merge", *map(str, folders), "--output", str(out), "--per-pair", "5", "--json"]) == 0
    assert not left.exists()
    (told,) = json.loads(capsys.readouterr().out)["files"]
    assert (told["hand"], told["grasps"], told["duplicates"], told["surplus"]) == ("gripper3", 10, 10, 14)
    pairs = {p.object: p for p in read_collection(out)}
    assert {name: len(p.grasps) for name, p in pairs.items()} == {"can": 5, "sphere": 5}
    assert pairs["sphere"].made.failures == {"slipped": 6}
    assert pairs["sphere"].made.valid == 12 + 12 + 8  # as the shards' files say, failures included
    assert "reason" not in pairs["can"].grasps.extra
    assert main(["dataset", "info", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"total": 10, "hands": {"gripper3": {"can": 5, "sphere": 5}}}


def test_large_sets_become_several_files_that_hold_the_same(folders, hand, tmp_path):
    (whole,) = merge(folders, aside=tmp_path)
    parts = list(merge(folders, aside=tmp_path, file_bytes=1))
    assert [file_name(part.hand, part.number) for part in parts] == ["gripper3.parquet", "gripper3.2.parquet"]
    assert [set(grasps_in(part).object) for part in parts] == [{"can"}, {"sphere"}]
    for part in parts:
        part.save(tmp_path / file_name(part.hand, part.number))
    assert not list(tmp_path.glob(".merge-*"))
    pairs = {p.object: p for p in read_collection(tmp_path)}
    for name, grasps in grasps_in(whole).by_object():
        torch.testing.assert_close(pairs[name].grasps.joints, grasps.joints)
        assert pairs[name].made == whole.yields[name]


def test_a_hand_in_a_file_is_found_although_its_first_object_has_no_grasp(hand, tmp_path):
    file = tmp_path / "claw.urdf"
    file.write_text(make_hand(3).urdf)
    own = load_hand(file)
    for name, batch in (("can", tried(own, "can", 3, seed=0)[[]]), ("sphere", tried(own, "sphere", 4, seed=1))):
        Shard(own.name, name, 0).save(with_sources(batch, str(file), name, 1.0).to_bytes(notes_of(Yield())), tmp_path / "set")
    (merged,) = merge([tmp_path / "set"], per_pair=3)
    assert grasps_in(merged).object == ("sphere",) * 3
    assert set(merged.yields) == {"can", "sphere"}


@pytest.mark.parametrize("command", ["merge", "filter"])
def test_what_is_read_is_not_written_over(folders, hand, tmp_path, capsys, command):
    file = tmp_path / "own" / "gripper3.parquet"
    file.parent.mkdir()
    tried(hand, "sphere", 3, seed=0).save(file)
    for given, output in ((file, file.parent), (file.parent, file.parent), (folders[0], folders[0])):
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        assert main(["dataset", command, str(given), "--output", str(output)]) == 2
        assert f"{given} would be replaced by, or mixed with, what is made of it" in capsys.readouterr().err
        assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_grasps_of_other_commands_stay_beside_no_others(folders, hand, tmp_path, capsys):
    tried(hand, "sphere", 3, seed=0).save(tmp_path / "gripper3.parquet")
    assert main(["dataset", "merge", str(tmp_path / "gripper3.parquet"), "--output", str(folders[0])]) == 2
    assert f"{folders[0]} holds grasps of another command" in capsys.readouterr().err


def test_a_second_merge_leaves_nothing_of_the_first(folders, hand, tmp_path):
    (tmp_path / "out").mkdir()
    for number in (2, 3):
        tried(hand, "can", 3, seed=9).save(tmp_path / "out" / file_name(hand.name, number))
    other = tmp_path / "out" / "gripper3.best.parquet"
    tried(hand, "can", 3, seed=9).save(other)
    assert main(["dataset", "merge", str(folders[0]), "--output", str(tmp_path / "out")]) == 0
    assert set((tmp_path / "out").glob("*.parquet")) == {other, tmp_path / "out" / "gripper3.parquet"}


@pytest.mark.parametrize("command", ["merge", "filter", "report", "check", "bundle"])
def test_no_data_set_at_all_is_refused(tmp_path, capsys, command):
    output = {"merge": "out", "filter": "out", "bundle": "out.safetensors"}
    assert main(["dataset", command, *(["--output", str(tmp_path / output[command])] if command in output else [])]) == 2
    assert "no data set was given" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_nothing_to_merge_is_told(hand, tmp_path, capsys):
    tried(hand, "can", 2, seed=0)[[]].save(tmp_path / "none.parquet")
    out = ["--output", str(tmp_path / "out")]
    for name, *further in (("merge", *out), ("filter", *out), ("report",), ("info",)):
        assert main(["dataset", name, str(tmp_path / "none.parquet"), *further]) == 2
        assert "none.parquet holds no grasp; leave it out" in capsys.readouterr().err
    tried(hand, "can", 2, seed=0, failed=2).save(tmp_path / "failed.parquet")
    assert main(["dataset", "merge", str(tmp_path / "failed.parquet"), "--output", str(tmp_path / "c")]) == 0
    assert "no grasp held in a trial" in capsys.readouterr().err


@pytest.mark.parametrize("number", [0, -3])
def test_less_than_one_grasp_of_a_pair_is_refused_before_the_work(folders, hand, tmp_path, capsys, number):
    told = rf"per_pair is {number}; give at least 1, or leave it out to keep all grasps "
    for name, output in (("merge", tmp_path / "out"), ("bundle", tmp_path / "out.safetensors")):
        given = ["dataset", name, *map(str, folders), "--output", str(output), f"--per-pair={number}"]
        assert main(given) == 2
        assert re.search(rf"{told}\(--per-pair\)", capsys.readouterr().err)
        assert not output.exists()
    with pytest.raises(OptionError, match=rf"{told}\(per_pair=...\)"):
        spread(hand, tried(hand, "can", 3, seed=0), number)


def test_compact_numbers_mean_the_same_and_keep_the_limits(hand):
    grasps = tried(hand, "sphere", 200, seed=3)
    grasps = grasps.replace(joints=torch.where(torch.rand(200, hand.tree.n_dof) < 0.3, hand.tree.upper, grasps.joints))
    small = compact(hand, grasps)
    assert (small.joints - grasps.joints).abs().max() <= ANGLE_STEP
    assert (small.joints >= hand.tree.lower).all()
    assert (small.joints <= hand.tree.upper).all()
    assert (small.T_object_wrist[:, :3, 3] - grasps.T_object_wrist[:, :3, 3]).abs().max() <= POSITION_STEP
    turn = small.T_object_wrist[:, :3, :3].mT @ grasps.T_object_wrist[:, :3, :3]
    assert (turn - torch.eye(3)).abs().max() < 2e-4
    torch.testing.assert_close(small.score, grasps.score, rtol=2e-3, atol=0)
    torch.testing.assert_close(small.extra["energy_distance"], grasps.extra["energy_distance"], rtol=2e-3, atol=0)
    moved = (hand.points(small.joints, small.T_object_wrist) - hand.points(grasps.joints, grasps.T_object_wrist)).norm(dim=-1)
    assert moved.max() < 1e-4  # [m]
    assert len(small.to_bytes()) < 0.85 * len(grasps.to_bytes())


def test_compact_postures_keep_targets_beyond_the_limits_and_unknown_rows(hand):
    grasps, upper = tried(hand, "sphere", 200, seed=3), hand.tree.upper
    squeeze = torch.where(torch.rand(200, hand.tree.n_dof) < 0.3, upper, grasps.joints)
    squeeze[0], squeeze[1] = torch.nan, upper + 0.3
    pregrasp = grasps.joints + 1e-3
    small = compact(hand, grasps.replace(squeeze_joints=squeeze, pregrasp_joints=pregrasp))
    for given, kept in ((squeeze, small.squeeze_joints), (pregrasp, small.pregrasp_joints)):
        torch.testing.assert_close(kept, given, atol=ANGLE_STEP / 2, rtol=0, equal_nan=True)
        on_grid = (kept / ANGLE_STEP).frac() == 0
        assert float(on_grid[2:].float().mean()) > 0.6  # all but those at a limit
        assert not (kept[2:] > upper).any()
    assert len(small.to_bytes()) < 0.85 * len(grasps.replace(squeeze_joints=squeeze, pregrasp_joints=pregrasp).to_bytes())


def test_merged_grasps_find_their_own_object_again(hand, tmp_path):
    """A mesh in millimetres, whose scale has no short binary form."""
    trimesh.creation.icosphere(radius=30.0).export(tmp_path / "ball.stl")
    obj = load_object(tmp_path / "ball.stl", scale=0.001)
    grasps = tried(hand, "ball", 4, seed=0).replace(object_sha256=(obj.sha256,) * 4, robustness=torch.full((4,), 0.6))
    camera = NamedMotion("camera", se3.compose(torch.eye(3), torch.tensor([0.1, -0.3, 0.7])))
    grasps = with_sources(grasps, "gripper3", str(tmp_path / "ball.stl"), 0.001, camera)
    grasps.save(tmp_path / "g.parquet")
    (merged,) = merge([tmp_path / "g.parquet"])
    back = grasps_in(merged)
    assert object_source(back) == (str(tmp_path / "ball.stl"), 0.001)
    assert torch.equal(back.extra["T_frame_camera"], grasps.extra["T_frame_camera"])
    assert torch.equal(back.robustness, grasps.robustness)
    extra = {name: column for name, column in back.extra.items() if name not in {"frame", "T_frame_camera"}}
    assert object_of(back.replace(extra=extra), None, 1.0).sha256 == obj.sha256


def test_the_choice_covers_the_sphere_better_than_chance(hand):
    grasps = made_up_grasps(hand, "sphere", 400)
    chosen = spread(hand, grasps, 30)
    assert len(chosen) == len(set(chosen.tolist())) == 30
    assert 0 in chosen
    assert chosen.tolist() == sorted(chosen.tolist())

    def loneliest(rows: torch.Tensor) -> float:
        """Largest angle of any palm direction to the nearest chosen one [rad]."""
        d = hand.palm_directions(grasps.T_object_wrist)
        return float((d @ d[rows].T).clamp(-1, 1).acos().amin(-1).max())

    chance = np.median([loneliest(torch.randperm(400, generator=torch.Generator().manual_seed(i))[:30]) for i in range(9)])
    assert loneliest(chosen) < 0.8 * chance
    assert spread(hand, grasps, 400).tolist() == list(range(400))


def test_what_has_one_name_and_differs_is_not_mixed(hand, tmp_path):
    tried(hand, "sphere", 3, 0).save(tmp_path / "a.parquet")
    other = tried(hand, "sphere", 3, 1).replace(object_sha256=("new",) * 3)
    other.save(tmp_path / "b.parquet")
    reason = r"object 'sphere' .* not the same everywhere .*hashes new, sphere.*: another object of this name, or another "
    with pytest.raises(GraspFileError, match=reason):
        list(merge([tmp_path / "a.parquet", tmp_path / "b.parquet"]))
    GraspBatch.concatenate([tried(hand, "sphere", 3, 0), other]).save(tmp_path / "both.parquet")
    with pytest.raises(GraspFileError, match=reason):
        list(merge([tmp_path / "both.parquet"]))
    tried(hand, "can", 3, 1).replace(hand_sha256="new").save(tmp_path / "c.parquet")
    with pytest.raises(GraspFileError, match=r"hand 'gripper3' .*: another hand of this name, or another version"):
        list(merge([tmp_path / "a.parquet", tmp_path / "c.parquet"]))


def test_objects_of_one_name_are_counted_apart_in_a_file_and_together_in_a_folder(hand, tmp_path):
    first, other = tried(hand, "sphere", 3, 0), tried(hand, "sphere", 2, 1).replace(object_sha256=("new",) * 2)
    for name, batch in (("a", first), ("b", other)):
        (tmp_path / "folder").mkdir(exist_ok=True)
        batch.save(tmp_path / "folder" / f"{name}.parquet")
    assert count_collection(tmp_path / "folder") == {"gripper3": {"sphere": 5}}
    GraspBatch.concatenate([first, other]).save(tmp_path / "both.parquet")
    assert count_collection(tmp_path / "both.parquet") == {"gripper3": {"sphere": 3, "sphere (2)": 2}}


def test_files_are_named_after_hands():
    assert [file_name(n) for n in ("allegro", "assets/allegro_left")] == ["allegro.parquet", "assets-allegro_left.parquet"]


def test_yields_add_up_and_name_the_obstacle():
    a = Yield(candidates=10, ranked_out=2, deep=1, moved=1, failures={"slipped": 2, "lost": 1}, valid=3, cpu_seconds=6.0)
    both = a + Yield(candidates=5, failures={"lost": 4}, valid=1, cpu_seconds=6.0)
    assert both.failures == {"slipped": 2, "lost": 5}
    assert both.evaluated == 11
    assert both.per_cpu_hour == pytest.approx(1200)
    assert both.main_obstacle() == "lost (38% of the tested candidates)"
    assert Yield().main_obstacle() == "no candidate was tested"
    assert Yield().per_cpu_hour == 0
    assert Yield.from_dict(both.to_dict() | {"of another version": 1}) == both
    assert math.isclose(sum(both.to_dict()["failures"].values()), 7)
