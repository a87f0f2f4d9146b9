"""Columns of a grasp file against SciPy and Arrow alone."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import torch
from scipy.spatial.transform import Rotation

from dro_grasp.grasps.codec import decode, encode
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
