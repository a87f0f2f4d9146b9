"""Columns of a grasp file against SciPy and Arrow alone."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import torch
from scipy.spatial.transform import Rotation

from dro_grasp.grasps.grasp_file import decode, encode
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand


def test_columns_say_what_a_stranger_would_compute() -> None:
    grasps = made_up_grasps(toy_hand(), "can", 7, seed=3)
    columns, header = encode(grasps)
    turns = np.array(columns["wrist_quaternion_wxyz"].to_pylist())
    given = Rotation.from_quat(turns[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(given, grasps.T_object_wrist[:, :3, :3].numpy(), atol=1e-6)
    np.testing.assert_allclose(columns["joints"].to_pylist(), grasps.joints.numpy())
    assert header["joint_names"] == list(grasps.joint_names)
    again = decode(pa.table(columns), header, "memory")
    torch.testing.assert_close(again["T_object_wrist"], grasps.T_object_wrist, atol=1e-6, rtol=0)
    assert again["object"] == grasps.object
    # They have no trial: neither a success nor a failure.
    assert columns["success"].null_count == len(grasps) - int(grasps.evaluated.sum())


def test_files_without_energies_hold_them_as_scores_of_synthesized_grasps() -> None:
    """What earlier versions wrote: the score of a synthesized grasp is minus its energy; predicted ones have log-odds."""
    terms = torch.tensor([1.0, 2.0, torch.nan, 1.0])
    grasps = made_up_grasps(toy_hand(), count=4, score=torch.tensor([-7.0, -9.0, 2.0, -3.0]), extra={"energy_distance": terms})
    made = ("dro-grasp 0.1.0, synthesis 2", "dro-grasp 0.1.0, synthesis 2, 200 to 400 steps", "network multi", "network multi")
    columns, header = encode(grasps.replace(provenance=made))
    early = decode(pa.table(columns).drop_columns(["energy"]), header, "memory")
    np.testing.assert_array_equal(early["energy"], [7.0, 9.0, np.nan, np.nan])
    np.testing.assert_array_equal(early["score"], [np.nan, np.nan, 2.0, -3.0])
    now = decode(pa.table(columns), header, "memory")
    np.testing.assert_array_equal(now["score"], [-7.0, -9.0, 2.0, -3.0])
    assert now["energy"].isnan().all()
