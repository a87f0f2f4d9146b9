"""Payload and forces of the squeeze: columns that files keep, that former files lack, and that other poses make stale."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CARRYING
from tests.helpers.toy_batches import make

NAMES = (*CARRYING, "squeeze_torque")


def known() -> GraspBatch:
    payload, torque = torch.tensor([0.4, torch.nan, 2.5]), torch.rand(3, 2)
    torque[1] = torch.nan
    return make(3).replace(payload=payload, squeeze_force=2 * payload, squeeze_torque=torque)


def test_files_keep_them_and_what_is_unknown_stays_so(tmp_path: Path) -> None:
    grasps, file = known(), tmp_path / "g.parquet"
    grasps.save(file)
    back = GraspBatch.load(file)
    for name in NAMES:
        torch.testing.assert_close(getattr(back, name), getattr(grasps, name), equal_nan=True)
        assert pq.read_table(file)[name].null_count == 1
    joined = GraspBatch.concatenate([back, make(1)])
    assert joined.payload.isnan().tolist() == [False, True, False, True]
    assert joined[2].squeeze_torque.tolist() == grasps[2].squeeze_torque.tolist()


def test_they_are_unknown_in_files_of_before(tmp_path: Path) -> None:
    file = tmp_path / "g.parquet"
    known().save(file)
    pq.write_table(pq.read_table(file).drop_columns(list(NAMES)), file)
    back = GraspBatch.load(file)
    assert back.payload.shape == back.squeeze_force.shape == (3,)
    assert back.squeeze_torque.shape == (3, 2)
    assert all(bool(getattr(back, name).isnan().all()) for name in NAMES)


def test_other_poses_have_others() -> None:
    grasps = known()
    for other in (grasps.poses_only(), grasps.with_poses(grasps.T_object_wrist, grasps.joints), grasps.without(*NAMES)):
        assert all(bool(getattr(other, name).isnan().all()) for name in NAMES)
    assert torch.equal(grasps.without_trial().payload.isnan(), grasps.payload.isnan()), "they are no outcome of a trial"
