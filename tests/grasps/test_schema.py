"""A grasp file's header and columns are checked on loading, for every reader."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from dro_grasp.errors import GraspFileError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CAMERA, FRAME, OBJECT_MASS, OBJECT_SCALE
from dro_grasp.grasps.grasp_file import METADATA_KEY, read_footer
from dro_grasp.training.data.collections.collection import count_collection
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand


def written(path: Path, header: dict[str, Any] | None = None, columns: dict[str, Any] | None = None) -> Path:
    """A sound file with other entries of its header and other columns; a column that is None is left out."""
    grasps = made_up_grasps(toy_hand(), count=2)
    grasps.replace(extra={FRAME: ("base",) * 2, CAMERA: torch.eye(4).reshape(1, 16).repeat(2, 1)}).save(path)
    table = pq.read_table(path)
    entries = json.loads(table.schema.metadata[METADATA_KEY]) | (header or {})
    every = {name: table[name] for name in table.column_names} | (columns or {})
    kept = pa.table({name: column for name, column in every.items() if column is not None})
    pq.write_table(kept.replace_schema_metadata({METADATA_KEY: json.dumps(entries).encode()}), path)
    return path


def test_the_sound_file_is_read(tmp_path: Path) -> None:
    assert len(GraspBatch.load(written(tmp_path / "g.parquet"))) == 2


@pytest.mark.parametrize(("header", "message"), [
    ({"hand": ["allegro"]}, "'hand' is .'allegro'., expected a name"), ({"hand": None}, "'hand' is None"),
    ({"hand_sha256": 5}, "'hand_sha256' is 5"), ({"wrist_link": {}}, "'wrist_link' is {}"),
    ({"joint_names": 4}, "'joint_names' is 4"), ({"joint_names": ["a", "a"]}, "a list of different names"),
    ({"joint_names": []}, "a list of different names"), ({"notes": ["x"]}, "'notes' is"), ({"format_version": []}, "version"),
])
def test_a_header_of_other_types_is_refused(tmp_path: Path, header: dict[str, Any], message: str) -> None:
    path = written(tmp_path / "g.parquet", header)
    for read in (GraspBatch.load, read_footer, count_collection):
        with pytest.raises(GraspFileError, match=message):
            read(path)


@pytest.mark.parametrize(("columns", "message"), [
    ({"object": pa.array([1, 2])}, "column 'object' holds int64, expected texts"),
    ({"protocol": pa.array([["strict"]] * 2)}, "column 'protocol' holds list.*, expected texts"),
    ({"reason": pa.array([1, 2])}, "column 'reason' holds int64"), ({"hand_file": pa.array([1.0, 2.0])}, "column 'hand_file'"),
    ({"score": pa.array(["a", "b"])}, "column 'score' holds string, expected numbers"),
    ({"seed": pa.array(["a", "b"])}, "column 'seed' holds string"),
    ({"object_mass": pa.array(["a", "b"])}, "column 'object_mass' holds string, expected numbers"),
    ({"success": pa.array([1, 0])}, "column 'success' holds int64"),
    ({"contact_links": pa.array([[1], [2]])}, "column 'contact_links'"), ({CAMERA: None}, f"lacks the column '{CAMERA}'"),
    ({CAMERA: pa.array([[1.0], [2.0]])}, "no pose of 16 finite numbers"),
    ({CAMERA: pa.array([[np.nan] * 16] * 2)}, "no pose of 16 finite numbers"),
    ({"joints": pa.array([[1.0], [2.0]])}, "lists of length"),
])
def test_columns_of_other_types_are_refused(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    with pytest.raises(GraspFileError, match=message):
        GraspBatch.load(written(tmp_path / "g.parquet", columns=columns))


@pytest.mark.parametrize("yields", [5, {"ball": []}, {"ball": {"valid": "x"}}, {"ball": {"failures": {"x": None}}},
                                    {"ball": {"cpu_seconds": float("nan")}}])
def test_yields_that_are_no_counts_are_refused(tmp_path: Path, yields: Any) -> None:
    with pytest.raises(GraspFileError, match="yields"):
        count_collection(written(tmp_path / "g.parquet", {"notes": {"yields": yields}}))


@pytest.mark.parametrize("column", [OBJECT_SCALE, OBJECT_MASS])
def test_a_scale_or_mass_that_is_not_stated_is_none(tmp_path: Path, column: str) -> None:
    assert column not in GraspBatch.load(written(tmp_path / "g.parquet", columns={column: pa.nulls(2)})).extra
