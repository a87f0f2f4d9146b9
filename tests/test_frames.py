"""Half-axes: their order, their directions, and the nearest one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from dro_grasp.errors import OptionError
from dro_grasp.frames import HALF_AXES, half_axis, half_axis_direction, read_motion


def test_half_axes_are_in_order() -> None:
    axes = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).float()
    assert [HALF_AXES[i] for i in half_axis(axes + 0.2 * axes.roll(1, -1))] == ["+x", "-x", "+y", "-y", "+z", "-z"]
    assert torch.equal(torch.tensor([half_axis_direction(name) for name in HALF_AXES]), axes)


EYE = torch.eye(4).tolist()
CAMERA = {"frame": "base", "T_frame_camera": EYE, "intrinsics": torch.eye(3).tolist(), "depth_unit": 0.001}
LACKING = {name: CAMERA[name] for name in ("frame", "T_frame_camera")}


def test_one_file_holds_the_poses_of_camera_and_object(tmp_path: Path) -> None:
    (tmp_path / "both.json").write_text(json.dumps(CAMERA | {"T_frame_object": EYE}))
    for key in ("T_frame_camera", "T_frame_object"):
        assert read_motion(tmp_path / "both.json", key).frame == "base"


@pytest.mark.parametrize(("given", "entry", "told"), [
    *((CAMERA, entry, r"\. Leave it out$") for entry in (
        "name", "frame_id", "T_world_camera", "T_camera_frame", "depth", "K", "camera_matrix", "Intrinsics", "D")),
    *((LACKING, entry, "Call it 'intrinsics' if it is the camera's pinhole matrix, 3x3 .*; else leave it out$")
      for entry in ("K", "k", "camera_matrix", "Intrinsics")),
    (LACKING, "depth_scale", "Call it 'depth_unit' if it is the metres of one count"),
    (LACKING | {"T_frame_object": EYE}, "name", r"\. Leave it out$"),
])
def test_names_are_proposed_that_the_file_lacks(given: dict[str, object], entry: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(json.dumps(given | {entry: 1}))
    with pytest.raises(OptionError, match=f"has an entry '{entry}', which nothing reads; known are .*{told}"):
        read_motion(tmp_path / "camera.json", "T_frame_camera")


def test_a_pose_that_is_proposed_is_said_to_be_one(tmp_path: Path) -> None:
    (tmp_path / "pose.json").write_text(json.dumps({"frame": "base", "T_frame_object": EYE, "T_world_camera": EYE}))
    with pytest.raises(OptionError, match=r"Call it 'T_frame_camera' if it is the camera's pose in the frame, .*; else"):
        read_motion(tmp_path / "pose.json", "T_frame_object")
