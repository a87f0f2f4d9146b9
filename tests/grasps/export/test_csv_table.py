"""The table of grasps, read back with the csv module."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.export.writers import Frame, csv_table, isaac_grasp
from dro_grasp.grasps.sources import CAMERA, FRAME
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_hand import toy_hand

NAME = 'a "large" mug, #2'


@pytest.fixture(scope="module")
def grasps() -> GraspBatch:
    """Three grasps: one that held, one that failed, and one without a trial of which only the energy is known."""
    made = made_up_grasps(
        toy_hand(), NAME, 3, score=torch.tensor([1.5, -2.0, torch.nan]), energy=torch.tensor([torch.nan, 0.25, 3.0]),
        success=torch.tensor([True, False, False]), protocol=("robust/1", "robust/1", ""))
    return made.replace(
        pregrasp_joints=made.joints - 0.1, squeeze_joints=made.joints + 0.2,
        robustness=torch.tensor([0.875, 0.125, torch.nan]), fingers_in_contact=torch.tensor([3.0, 1.0, torch.nan]))


def rows(text: str) -> list[dict[str, str]]:
    comments, table = text.splitlines()[:3], text.splitlines()[3:]
    assert all(line.startswith("# ") for line in comments)
    return list(csv.DictReader(io.StringIO("\n".join(table)), strict=True))


def test_every_value_is_read_back(grasps: GraspBatch) -> None:
    found = rows(csv_table(grasps, Frame()))
    assert [row["object"] for row in found] == [NAME] * 3
    for name in ("score", "energy", "robustness", "fingers_in_contact"):
        cells, values = [row[name] for row in found], getattr(grasps, name).tolist()
        assert [cell == "" for cell in cells] == [value != value for value in values], f"{name} is empty where unknown"
        assert [float(cell) for cell in cells if cell] == pytest.approx([v for v in values if v == v], abs=1e-6)
    assert [(row["success"], row["protocol"]) for row in found] == [("1", "robust/1"), ("0", "robust/1"), ("", "")]
    for posture in ("pregrasp_joints", "joints", "squeeze_joints"):
        column = posture.removesuffix("_joints") if posture != "joints" else "grasp"
        values = [[float(row[f"{column}:{joint}"]) for joint in grasps.joint_names] for row in found]
        torch.testing.assert_close(torch.tensor(values), getattr(grasps, posture), atol=1e-6, rtol=0)


def test_poses_are_those_of_the_frame(grasps: GraspBatch) -> None:
    T = torch.tensor([[0.0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, -0.2], [0, 0, 0, 1]])
    for i, row in enumerate(rows(csv_table(grasps, Frame("camera", T)))):
        w, *xyz = (float(row[f"q{k}"]) for k in "wxyz")
        expected = T @ grasps.T_object_wrist[i]
        for point in torch.eye(3):  # v + 2 w (u x v) + 2 u x (u x v)
            u = torch.tensor(xyz)
            turned = point + 2 * w * torch.linalg.cross(u, point) + 2 * torch.linalg.cross(u, torch.linalg.cross(u, point))
            torch.testing.assert_close(turned, expected[:3, :3] @ point, atol=1e-5, rtol=0)
        torch.testing.assert_close(torch.tensor([float(row[k]) for k in "xyz"]), expected[:3, 3], atol=1e-6, rtol=0)
        assert w >= 0


def turned() -> torch.Tensor:
    """A rigid motion whose rotation is a product of 2000 in single precision, as a long chain of frames has it."""
    step = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix().astype(np.float32)
    T = np.eye(4, dtype=np.float32)
    for _ in range(2000):
        T[:3, :3] = T[:3, :3] @ step
    return torch.from_numpy(T)


@pytest.mark.parametrize("kind", [torch.Tensor.double, torch.Tensor.float])
def test_a_frame_takes_rigid_motions_with_the_rounding_of_single_precision(grasps: GraspBatch, kind) -> None:
    assert float((turned()[:3, :3] @ turned()[:3, :3].T - torch.eye(3)).abs().max()) > 1e-5, "it is rounded"
    position, _ = Frame("base", kind(turned())).place(grasps)
    torch.testing.assert_close(position.float(), grasps.T_object_wrist[:, :3, 3] @ turned()[:3, :3].T)


@pytest.mark.parametrize(("T", "fault"), [
    (torch.diag(torch.tensor([1.001, 1.001, 1.001, 1.0])), "scaled, or mirrored"),
    (torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])), "scaled, or mirrored"), (2 * torch.eye(4), "last row"),
    (torch.eye(4) + 0.01 * torch.eye(4).roll(1, 0).tril(), "scaled, or mirrored|last row"),
    (torch.full((4, 4), torch.nan), "NaN or infinity"),
    (torch.eye(4) + torch.tensor([0, 0, 0, 400.0]) * torch.eye(4)[:, :1], "millimetres"),
])
def test_a_frame_that_is_no_rigid_motion_is_refused(T: torch.Tensor, fault: str) -> None:
    with pytest.raises(OptionError, match=f"frame 'base' must be a rigid motion, in metres; .*({fault})"):
        Frame("base", T)


@pytest.mark.parametrize("name", ["", "  ", "base\nlink", "base\rlink", "base\tlink", "base\x1b[31m", "base\u2028link", "a\0"])
def test_names_of_frames_are_on_one_line(name: str, tmp_path: Path) -> None:
    """A line break in a comment of YAML or CSV begins a line of content."""
    with pytest.raises(OptionError, match="a name on one line"):
        Frame(name, torch.eye(4))
    (tmp_path / "frame.json").write_text(json.dumps({"frame": name, "T_frame_object": torch.eye(4).tolist()}))
    with pytest.raises(OptionError, match="not a name on one line"):
        Frame.load(tmp_path / "frame.json")


def test_no_name_of_old_grasps_breaks_a_line(grasps: GraspBatch) -> None:
    odd = grasps.replace(object=("mug\nx: 1",) * 3, hand="toy\u2028hand", extra={
        **grasps.extra, FRAME: ("base\nx: 1",) * 3, CAMERA: torch.eye(4).reshape(1, 16).expand(3, 16)})
    for batch in (odd, odd.replace(extra=grasps.extra)):
        assert len(rows(csv_table(batch, Frame()))) == 3
        told = yaml.safe_load(isaac_grasp(batch, Frame()))
        assert told["object_frame_link"].endswith("\nx: 1")
