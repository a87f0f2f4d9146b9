"""Files of grasps: they keep every field, and survive or refuse what happens to files."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from dro_grasp.errors import GraspFileError, OutputError
from dro_grasp.files import check_output
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import HOLD_COLUMNS, UNKNOWN_PROTOCOL
from dro_grasp.grasps.hold import HoldExpectation
from dro_grasp.grasps.sources import object_source
from dro_grasp.simulation.protocols import PROTOCOLS, Perturbations, Protocol, changed
from tests.helpers.toy_batches import BALL, CUBE, HAND, evaluated, make


def test_file_round_trip_keeps_every_field(tmp_path):
    grasps = evaluated(5, score=torch.rand(5), pregrasp_joints=torch.rand(5, 2))
    grasps = grasps.replace(
        extra=grasps.extra | {"energy_contact": torch.rand(5), "order": torch.arange(5), "wrench": torch.rand(5, 6),
               "note": ["x"] * 5})
    grasps.save(tmp_path / "g.parquet")
    back = GraspBatch.load(tmp_path / "g.parquet")
    torch.testing.assert_close(back.T_object_wrist, grasps.T_object_wrist, atol=1e-6, rtol=0)
    for name in ("joints", "pregrasp_joints", "score", "success", "displacement", "rotation", "penetration",
                 "seed"):
        assert torch.equal(getattr(back, name), getattr(grasps, name)), name
    for name in ("hand", "hand_sha256", "wrist_link", "joint_names", "object", "object_sha256", "split",
                 "provenance", "protocol"):
        assert getattr(back, name) == getattr(grasps, name), name
    assert back.squeeze_joints.isnan().all()
    for name in ("energy_contact", "order", "wrench"):
        assert torch.equal(back.extra[name], grasps.extra[name]), name
    assert back.extra["reason"] == ["", *["slipped by 30 mm", ""] * 2]
    assert back.extra["failure"] == [None, *["SLIPPED", None] * 2]
    assert back.extra["contact_links"] == [["tip"]] * 5
    assert back.extra["note"] == ["x"] * 5


def test_batch_without_trial_has_null_outcome_in_the_file(tmp_path):
    make(3).save(tmp_path / "g.parquet")
    table = pq.read_table(tmp_path / "g.parquet")
    assert all(table[name].null_count == 3 for name in ("success", "displacement", "protocol"))
    back = GraspBatch.load(tmp_path / "g.parquet")
    assert not back.evaluated.any()
    assert back.protocol == ("",) * 3
    assert not back.evaluated.any()


def test_file_layout_is_format_version_1(tmp_path):
    make(2).save(tmp_path / "g.parquet")
    schema = pq.read_schema(tmp_path / "g.parquet")
    header = json.loads(schema.metadata[b"dro_grasp"])
    assert header == {"format_version": 1, "hand": "toy", "hand_sha256": "a" * 64, "wrist_link": "base",
                      "joint_names": ["j0", "j1"]}
    assert schema.field("wrist_position").type == pa.list_(pa.float32(), 3)
    assert schema.field("wrist_quaternion_wxyz").type == pa.list_(pa.float32(), 4)
    assert schema.field("joints").type == pa.list_(pa.float32())


def test_quaternion_on_disk_is_wxyz(tmp_path):
    T = torch.eye(4)[None].clone()
    T[0, :3, :3] = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, 0.2]))
    GraspBatch.create(HAND, BALL, T, torch.zeros(1, 2)).save(tmp_path / "g.parquet")
    w, x, y, z = pq.read_table(tmp_path / "g.parquet")["wrist_quaternion_wxyz"][0].as_py()
    assert abs(abs(w) - 0.9950042) < 1e-6
    assert abs(abs(z) - 0.0998334) < 1e-6
    assert abs(x) + abs(y) < 1e-6


def test_joining_evaluated_and_unevaluated_survives_the_file(tmp_path):
    joined = GraspBatch.concatenate([make(2, score=torch.rand(2)), evaluated(3, obj=CUBE, seed=7)])
    joined.save(tmp_path / "g.parquet")
    for batch in (joined, GraspBatch.load(tmp_path / "g.parquet")):
        assert batch.evaluated.tolist() == [False] * 2 + [True] * 3
        assert batch.success[2:].tolist() == [True, False, True]
        assert batch.score[2:].isnan().all()
        assert batch.score[:2].isfinite().all()
        assert batch.object == ("ball",) * 2 + ("cube",) * 3
        assert batch.seed.tolist() == [0, 0, 7, 7, 7]


def test_further_columns_that_some_lack_are_unknown_there_and_survive_the_file(tmp_path):
    some = evaluated(2).replace(extra={"links": [["tip"], []], "depth": torch.ones(2), "count": torch.arange(2)})
    GraspBatch.concatenate([make(1), some]).save(tmp_path / "g.parquet")
    back = GraspBatch.load(tmp_path / "g.parquet")
    assert back.extra["links"] == [None, ["tip"], []]
    assert back.extra["count"] == [None, 0, 1]
    assert back.extra["depth"].isnan().tolist() == [True, False, False]


def test_a_file_saved_again_is_the_same_file(tmp_path):
    grasps = GraspBatch.concatenate([make(2, energy=torch.rand(2)), evaluated(3, score=torch.rand(3), obj=CUBE)])
    grasps.save(tmp_path / "first.parquet")
    back = GraspBatch.load(tmp_path / "first.parquet")
    back.save(tmp_path / "second.parquet")
    first, second = (pq.read_table(tmp_path / f"{name}.parquet") for name in ("first", "second"))
    turned = "wrist_quaternion_wxyz"
    assert first.drop_columns([turned]).equals(second.drop_columns([turned]))
    for one, two in zip(first[turned].to_pylist(), second[turned].to_pylist(), strict=True):
        assert one == pytest.approx(two, abs=2e-7)


def test_empty_batch_round_trip(tmp_path):
    make(0).save(tmp_path / "g.parquet")
    assert len(GraspBatch.load(tmp_path / "g.parquet")) == 0


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_truncated_file_is_named(tmp_path, share):
    path = tmp_path / "g.parquet"
    make(20).save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(GraspFileError, match=r"g\.parquet"):
        GraspBatch.load(path)


FOREIGN = ["plain", "other parquet", "other version", "garbled", "no poses", "nan", "width"]


@pytest.mark.parametrize("content", FOREIGN)
def test_foreign_file_is_refused(tmp_path, content):
    path = tmp_path / "g.parquet"
    make(2).save(path)
    table = pq.read_table(path)
    if content == "plain":
        path.write_text("object,joints\n")
    elif content == "other parquet":
        pq.write_table(pa.table({"a": [1]}), path)
    elif content == "other version":
        pq.write_table(table.replace_schema_metadata({"dro_grasp": '{"format_version": 2}'}), path)
    elif content == "garbled":
        pq.write_table(table.replace_schema_metadata({"dro_grasp": "{"}), path)
    elif content == "no poses":
        pq.write_table(table.drop_columns(["wrist_position"]), path)
    elif content == "nan":
        joints = pa.array([[1.0, None], [0.0, 0.0]], pa.list_(pa.float32()))
        pq.write_table(table.set_column(3, "joints", joints), path)
    else:
        joints = pa.array([[1.0], [0.0]], pa.list_(pa.float32()))
        pq.write_table(table.set_column(3, "joints", joints), path)
    with pytest.raises(GraspFileError, match=r"g\.parquet"):
        GraspBatch.load(path)


def test_missing_file_is_a_grasp_file_error(tmp_path):
    with pytest.raises(GraspFileError, match="no grasp file"):
        GraspBatch.load(tmp_path / "none.parquet")


def test_missing_folder_is_refused_and_not_created(tmp_path):
    with pytest.raises(OutputError, match="mkdir"):
        check_output(tmp_path / "no" / "g.parquet")
    with pytest.raises(OutputError):
        make(1).save(tmp_path / "no" / "g.parquet")
    with pytest.raises(OutputError, match="folder"):
        check_output(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_failed_write_leaves_the_old_file_and_no_rest(tmp_path, monkeypatch):
    path = tmp_path / "g.parquet"
    make(2).save(path)
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(OutputError, match="No space left"):
        make(3).save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["g.parquet"]


@pytest.mark.parametrize("label", [
    "<img src=x onerror=alert(1)>", "carry/1</b>", "carry\nstrict", "a b", "x" * 5000 + " ", "carry/",
    "carry/1,strict/1", "+/1"])
def test_a_protocol_that_no_trial_could_have_is_refused_when_read_and_when_written(tmp_path, label):
    path = tmp_path / "g.parquet"
    evaluated(3).save(path)
    table = pq.read_table(path)
    column = table.column_names.index("protocol")
    pq.write_table(table.set_column(column, "protocol", pa.array(["strict/1", label, None])), path)
    own = evaluated(1).replace(protocol=(label,))
    for refused in (lambda: GraspBatch.load(path), lambda: own.save(tmp_path / "h.parquet")):
        with pytest.raises(GraspFileError, match=r"is unknown; trials state a name and a version, such as carry/1") as told:
            refused()
        assert len(str(told.value)) < 600
    assert not (tmp_path / "h.parquet").exists()


def test_protocols_as_trials_state_them_are_read(tmp_path):
    own = Protocol("my-own.v2", max_displacement=0.02, mass=1e-5, perturbations=Perturbations(trials=4, friction=(0.5, 1.0)))
    robust, light = PROTOCOLS["robust"], changed("carry", friction=0.3, mass_factor=2.0)
    labels = [own.label, robust.label, light.label, f"{light.label}, {robust.label}", UNKNOWN_PROTOCOL, "strict"]
    evaluated(len(labels)).replace(protocol=tuple(labels)).save(tmp_path / "g.parquet")
    assert list(GraspBatch.load(tmp_path / "g.parquet").protocol) == labels


def test_the_scale_is_that_of_the_file_that_is_recorded() -> None:
    plain = make(1)
    own = plain.replace(extra={"object_file": ["/ball.stl"], "object_scale": torch.tensor([0.001])})
    assert object_source(GraspBatch.concatenate([plain, own])) == ("/ball.stl", pytest.approx(0.001))


def test_a_hold_that_nobody_knows_is_none_in_a_file_too(tmp_path: Path) -> None:
    known = make(2).replace(extra={name: torch.ones(2, 3) for name in HOLD_COLUMNS})
    GraspBatch.concatenate([known, make(2)])[[2, 3]].save(tmp_path / "none.parquet")
    assert HoldExpectation.of(GraspBatch.load(tmp_path / "none.parquet"), 0) is None


def test_a_file_that_a_run_replaces_meanwhile_is_read_whole(tmp_path: Path) -> None:
    few, many = (evaluated(count).to_bytes() for count in (2, 200))
    path, written = tmp_path / "g.parquet", threading.Event()
    path.write_bytes(few)

    def run() -> None:
        while not written.is_set():
            for content in (many, few):
                (tmp_path / "new").write_bytes(content)
                os.replace(tmp_path / "new", path)

    run_beside = threading.Thread(target=run)
    run_beside.start()
    try:
        assert {len(GraspBatch.load(path)) for _ in range(100)} <= {2, 200}
    finally:
        written.set()
        run_beside.join()
