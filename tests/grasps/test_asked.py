"""How many grasps a batch is the answer to: what keeps the number, what loses it, and where it is told."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pyarrow.parquet as pq
import pytest
import torch

from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch, load_grasps
from dro_grasp.pictures.sheets import heading
from dro_grasp.simulation.outcome import TrialResult
from tests.helpers.claw import ball
from tests.helpers.toy_batches import CUBE, evaluated, make
from tests.helpers.toy_hand import toy_hand

OTHER_BALL = SimpleNamespace(name="ball", sha256="d" * 64, split=None)


def test_a_batch_knows_what_it_was_asked_for_only_when_it_is_told() -> None:
    assert make(2).asked is None
    assert make(2).out_of == 2
    answer = make(2).with_asked(16)
    assert answer.asked == answer.out_of == 16
    assert make(0).with_asked(16).asked == 16
    with pytest.raises(OptionError, match="3 grasps of a request for 2"):
        make(3).with_asked(2)
    with pytest.raises(OptionError, match="ball, cube"):
        GraspBatch.concatenate([make(1), make(1, obj=CUBE)]).with_asked(16)


@pytest.mark.parametrize("change", [
    lambda g: g.sorted_by_score(), lambda g: g.sorted_by_energy(), lambda g: g.poses_only(), lambda g: g.without_trial(),
    lambda g: g.replace(seed=g.seed + 1), lambda g: g.with_poses(g.T_object_wrist, g.joints), lambda g: g.without("score"),
])
def test_what_leaves_all_grasps_there_keeps_it(change) -> None:
    assert change(evaluated(3).with_asked(16)).asked == 16


@pytest.mark.parametrize("index", [0, slice(0, 2), [0, 1], torch.tensor([True, False, True])])
def test_a_selection_is_no_answer(index) -> None:
    assert evaluated(3).with_asked(16)[index].asked is None


def test_answers_join_and_come_apart_by_object() -> None:
    both = GraspBatch.concatenate([make(2).with_asked(16), make(3, obj=CUBE).with_asked(8), make(1).with_asked(4)])
    assert both.asked == 28
    assert {name: part.asked for name, part in both.by_object()} == {"ball": 20, "cube": 8}
    assert both.sorted_by_score().asked == 28
    mixed = GraspBatch.concatenate([make(2).with_asked(16), make(3, obj=CUBE), make(2, obj=OTHER_BALL).with_asked(5)])
    assert mixed.asked is None
    assert [part.asked for _, part in mixed.by_object()] == [16, None, 5]
    assert GraspBatch.concatenate([make(2).with_asked(16), make(1)]).asked is None
    assert GraspBatch.concatenate([make(2).with_asked(16), make(1)]).out_of == 3


def test_files_keep_it_for_each_object(tmp_path: Path) -> None:
    both = GraspBatch.concatenate([make(2).with_asked(16), make(3, obj=CUBE).with_asked(8)])
    both.save(tmp_path / "both.parquet")
    back = GraspBatch.load(tmp_path / "both.parquet")
    assert (back.asked, [part.asked for _, part in back.by_object()]) == (24, [16, 8])
    header = json.loads(pq.read_schema(tmp_path / "both.parquet").metadata[b"dro_grasp"])
    assert header["format_version"] == 1
    assert header["asked"] == [{"object": "ball", "object_sha256": "b" * 64, "num": 16},
                               {"object": "cube", "object_sha256": "c" * 64, "num": 8}]


@pytest.mark.parametrize("asked", [16, [16], [{"object": "ball", "num": 16}],
                                   [{"object": "ball", "object_sha256": "", "num": -1}],
                                   [{"object": "ball", "object_sha256": "", "num": 1.5}]])
def test_a_garbled_number_is_refused(asked: object, tmp_path: Path) -> None:
    make(2).save(tmp_path / "g.parquet")
    table = pq.read_table(tmp_path / "g.parquet")
    header = json.loads(table.schema.metadata[b"dro_grasp"]) | {"asked": asked}
    pq.write_table(table.replace_schema_metadata({b"dro_grasp": json.dumps(header).encode()}), tmp_path / "g.parquet")
    with pytest.raises(GraspFileError, match="'asked'"):
        GraspBatch.load(tmp_path / "g.parquet")


def test_a_folder_keeps_it_though_objects_of_one_name_are_told_apart(tmp_path: Path) -> None:
    make(2).with_asked(16).save(tmp_path / "a.parquet")
    make(1, obj=OTHER_BALL).with_asked(4).save(tmp_path / "b.parquet")
    make(0, obj=CUBE).with_asked(8).save(tmp_path / "c.parquet")
    grasps = load_grasps(tmp_path)
    assert [(name, part.asked) for name, part in grasps.by_object()] == [("a", 16), ("b", 4)]
    assert grasps.asked == 28, "an object without any grasp counts, too"


def test_words_are_of_what_was_asked_for() -> None:
    assert "2 grasps of 16 asked for" in repr(make(2).with_asked(16))
    assert "1 of 16 hold under dro/1" in repr(evaluated(2).with_asked(16))
    assert repr(make(2).with_asked(2)) == repr(make(2))
    assert "2 grasps of 16 asked for" in make(2).with_asked(16)._repr_html_()


def test_a_trial_of_an_answer_is_of_what_was_asked_for() -> None:

    assert "0 of 16 hold" in repr(TrialResult.join([], "dro/1", asked=16))
    assert TrialResult.join([], "dro/1", asked=16).success_rate == 0


def test_pictures_say_so() -> None:
    hand, obj = toy_hand(), ball()
    assert "2 grasps, 1 of 16 succeeded" in heading(hand, obj, evaluated(2).with_asked(16))
