"""Exported files, read back by other means: every pose, posture and name is where its format says."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

import dro_grasp as dro
from dro_grasp.cli.main import main
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CAMERA, FRAME
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.grasps.export.writers import Frame, dexgraspbench
from dro_grasp.objects.catalogue import load_object
from tests.helpers.loaded_hands import loaded_hand

HAND, COUNT = "gripper3", 5
TURN = Rotation.from_euler("xyz", [0.3, -0.8, 1.2])
SHIFT = [0.4, -0.1, 0.9]


@pytest.fixture(scope="module")
def grasps() -> GraspBatch:
    hand, mug, can = loaded_hand(HAND), load_object("mug"), load_object("can")
    generator = torch.Generator().manual_seed(0)
    T = torch.eye(4).repeat(COUNT, 1, 1)
    T[:, :3, :3] = torch.from_numpy(Rotation.random(COUNT, random_state=1).as_matrix())
    T[:, :3, 3] = 0.1 * torch.randn(COUNT, 3, generator=generator)
    joints = hand.random_joints(COUNT, generator)
    pregrasp, squeeze = pregrasp_and_squeeze(hand, T, joints, torch.zeros(3))
    return GraspBatch.create(
        hand, [mug, mug, can, mug, can], T, joints, pregrasp_joints=pregrasp, squeeze_joints=squeeze,
        score=torch.tensor([2.0, 0.0, -1.0, -3.0, 40.0]), success=torch.tensor([True, False, True, True, False]),
        protocol=("strict/1", "strict/1", "strict/1", "strict/1", ""))


@pytest.fixture
def one(grasps: GraspBatch, tmp_path: Path) -> Path:
    """The grasps of the mug."""
    grasps[[0, 1, 3]].save(tmp_path / "mug.parquet")
    return tmp_path / "mug.parquet"


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = TURN.as_matrix(), SHIFT
    (tmp_path / "camera.json").write_text(json.dumps({"frame": "camera", "T_frame_object": T.tolist()}))
    return tmp_path / "camera.json"


def export(*arguments: object) -> int:
    return main(["export", *map(str, arguments)])


def pose(position: list[float], wxyz: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), position
    return T


def expected(grasps: GraspBatch, i: int, in_camera: bool) -> np.ndarray:
    T = np.eye(4)
    if in_camera:
        T[:3, :3], T[:3, 3] = TURN.as_matrix(), SHIFT
    return T @ grasps.T_object_wrist[i].double().numpy()


def postures(grasps: GraspBatch) -> dict[str, torch.Tensor]:
    return {"pregrasp": grasps.pregrasp_joints, "grasp": grasps.joints, "squeeze": grasps.squeeze_joints}


def test_objects_with_names_of_folders_stay_in_the_folder(grasps: GraspBatch, tmp_path: Path) -> None:
    strange = grasps[[0, 1, 2, 4]].replace(object=("..", "..", "a/b", "a/b"), object_sha256=("", "", "", ""))
    strange.save(tmp_path / "strange.parquet")
    assert export(tmp_path / "strange.parquet", "--format", "csv", "--output", tmp_path / "inner" / "out") == 0
    assert sorted(p.name for p in (tmp_path / "inner").iterdir()) == ["out"]
    assert sorted(p.name for p in (tmp_path / "inner" / "out").iterdir()) == ["a-b.csv", "object.csv"]


def test_old_files_are_not_mixed_with_new_ones(grasps: GraspBatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grasps.save(tmp_path / "all.parquet")
    assert export(tmp_path / "all.parquet", "--format", "csv", "--output", tmp_path / "out") == 0
    assert export(tmp_path / "all.parquet", "--format", "csv", "--output", tmp_path / "out") == 2
    assert "old and new grasps would be mixed" in capsys.readouterr().err


def test_json_names_the_frame_of_what_a_camera_saw(
    grasps: GraspBatch, camera: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = grasps[[0, 1]].replace(extra={FRAME: ("base", "base"), CAMERA: torch.eye(4).reshape(1, 16).repeat(2, 1)})
    seen.save(tmp_path / "seen.parquet")
    for frame, told in (([], "base"), (["--frame", camera], "camera")):
        assert export(tmp_path / "seen.parquet", "--format", "csv", "--output", tmp_path / "a.csv", "--json", *frame) == 0
        assert json.loads(capsys.readouterr().out)["frame"] == told


def test_no_other_frame_is_called_as_the_object_s_own(one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    T = np.eye(4)
    T[0, 3] = 0.1
    (tmp_path / "frame.json").write_text(json.dumps({"frame": "object", "T_frame_object": T.tolist()}))
    assert export(one, "--format", "csv", "--output", tmp_path / "a.csv", "--frame", tmp_path / "frame.json") == 2
    assert "calls its frame 'object'" in capsys.readouterr().err


@pytest.mark.parametrize("in_camera", [False, True])
def test_isaac_grasp(grasps: GraspBatch, one: Path, camera: Path, tmp_path: Path, in_camera: bool) -> None:
    out = tmp_path / "out.yaml"
    assert export(one, "--format", "isaac_grasp", "--output", out, *(["--frame", camera] if in_camera else [])) == 0
    content = yaml.safe_load(out.read_text())
    assert (content["format"], content["format_version"]) == ("isaac_grasp", 1.0)
    assert content["object_frame_link"] == ("camera" if in_camera else "mug")
    assert content["gripper_frame_link"] == loaded_hand(HAND).wrist_link
    assert list(content["grasps"]) == ["grasp_0", "grasp_1", "grasp_2"]
    for i, grasp in zip((0, 1, 3), content["grasps"].values(), strict=True):
        assert set(grasp) == {"confidence", "position", "orientation", "cspace_position", "pregrasp_cspace_position",
                              "squeeze_cspace_position"}
        np.testing.assert_allclose(list(grasp["squeeze_cspace_position"].values()), grasps.squeeze_joints[i], atol=1e-6)
        wxyz = [grasp["orientation"]["w"], *grasp["orientation"]["xyz"]]
        np.testing.assert_allclose(pose(grasp["position"], wxyz), expected(grasps, i, in_camera), atol=2e-6)
        assert list(grasp["cspace_position"]) == list(grasps.joint_names)
        np.testing.assert_allclose(list(grasp["cspace_position"].values()), grasps.joints[i], atol=1e-6)
        np.testing.assert_allclose(list(grasp["pregrasp_cspace_position"].values()), grasps.pregrasp_joints[i], atol=1e-6)
        assert grasp["confidence"] == pytest.approx(1 / (1 + np.exp(-float(grasps.score[i]))), abs=1e-5)
    assert out.read_text().startswith("# Grasps by hand 'gripper3'")


@pytest.mark.parametrize("in_camera", [False, True])
def test_moveit(grasps: GraspBatch, one: Path, camera: Path, tmp_path: Path, in_camera: bool) -> None:
    out = tmp_path / "out.yaml"
    assert export(one, "--format", "moveit", "--output", out, *(["--frame", camera] if in_camera else [])) == 0
    messages = yaml.safe_load(out.read_text())
    hand = loaded_hand(HAND)
    for i, message in zip((0, 1, 3), messages, strict=True):
        assert set(message) == {
            "id", "pre_grasp_posture", "grasp_posture", "grasp_pose", "grasp_quality", "pre_grasp_approach",
            "post_grasp_retreat", "post_place_retreat", "max_contact_force", "allowed_touch_objects"}
        at = message["grasp_pose"]["pose"]
        T = pose([at["position"][k] for k in "xyz"], [at["orientation"][k] for k in "wxyz"])
        np.testing.assert_allclose(T, expected(grasps, i, in_camera), atol=2e-6)
        assert message["grasp_pose"]["header"]["frame_id"] == ("camera" if in_camera else "mug")
        for name, joints in (("pre_grasp_posture", grasps.pregrasp_joints), ("grasp_posture", grasps.squeeze_joints)):
            (point,) = message[name]["points"]
            assert message[name]["joint_names"] == list(grasps.joint_names)
            np.testing.assert_allclose(point["positions"], joints[i], atol=1e-6)
        approach = message["pre_grasp_approach"]
        vector = np.array([approach["direction"]["vector"][k] for k in "xyz"])
        assert approach["direction"]["header"]["frame_id"] == hand.wrist_link
        np.testing.assert_allclose(vector, hand.palm_direction_wrist, atol=1e-6)
        assert approach["desired_distance"] > approach["min_distance"] > 0
        for name, frame, away in (("post_grasp_retreat", message["grasp_pose"]["header"]["frame_id"], [0.0, 0.0, 1.0]),
                                  ("post_place_retreat", hand.wrist_link, -vector)):
            direction = message[name]["direction"]
            assert direction["header"]["frame_id"] == frame
            np.testing.assert_allclose([direction["vector"][k] for k in "xyz"], away, atol=1e-6)


def test_only_a_score_makes_a_confidence(grasps: GraspBatch, tmp_path: Path) -> None:
    """Synthesized grasps have an energy: no format calls them hopeless, or certain, for it."""
    energies = torch.tensor([300.0, 0.1])
    synthesized = grasps[[0, 1]].without("score").replace(energy=energies)
    GraspBatch.concatenate([synthesized, grasps[[3]]]).save(tmp_path / "mug.parquet")
    for format, name in (("isaac_grasp", "isaac.yaml"), ("moveit", "moveit.yaml"), ("csv", "table.csv")):
        assert export(tmp_path / "mug.parquet", "--format", format, "--output", tmp_path / name) == 0
    isaac = (tmp_path / "isaac.yaml").read_text()
    known = 1 / (1 + np.exp(3.0))
    confidences = [grasp["confidence"] for grasp in yaml.safe_load(isaac)["grasps"].values()]
    assert confidences == [0.5, 0.5, pytest.approx(known, abs=1e-5)]
    assert "# 2 of 3 grasps have no score: their confidence 0.5 stands for unknown" in isaac
    qualities = [message.get("grasp_quality") for message in yaml.safe_load((tmp_path / "moveit.yaml").read_text())]
    assert qualities == [None, None, pytest.approx(known, abs=1e-5)]
    rows = list(csv.DictReader(x for x in (tmp_path / "table.csv").read_text().splitlines() if not x.startswith("#")))
    assert [row["score"] for row in rows] == ["", "", "-3.0"]
    assert [float(row["energy"] or "nan") for row in rows] == pytest.approx([300.0, 0.1, np.nan], abs=1e-6, nan_ok=True)


def test_csv_holds_every_posture(grasps: GraspBatch, one: Path, tmp_path: Path) -> None:
    assert export(one, "--format", "csv", "--output", tmp_path / "out.csv") == 0
    lines = [x for x in (tmp_path / "out.csv").read_text().splitlines() if not x.startswith("#")]
    for i, row in zip((0, 1, 3), csv.DictReader(lines), strict=True):
        T = pose([float(row[k]) for k in "xyz"], [float(row[f"q{k}"]) for k in "wxyz"])
        np.testing.assert_allclose(T, expected(grasps, i, False), atol=2e-6)
        for posture, joints in postures(grasps).items():
            values = [float(row[f"{posture}:{joint}"]) for joint in grasps.joint_names]
            np.testing.assert_allclose(values, joints[i], atol=1e-6)
        assert (row["object"], row["success"], row["protocol"]) == ("mug", str(int(grasps.success[i])), "strict/1")


def test_dexgraspbench_has_a_file_a_grasp(grasps: GraspBatch, one: Path, camera: Path, tmp_path: Path) -> None:
    assert export(one, "--format", "dexgraspbench", "--frame", camera, "--output", tmp_path / "out") == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["0.npy", "1.npy", "2.npy"]
    for k, i in enumerate((0, 1, 3)):
        content = np.load(tmp_path / "out" / f"{k}.npy", allow_pickle=True).item()
        for name, joints in postures(grasps).items():
            qpos = content[f"{name}_qpos"]
            np.testing.assert_allclose(pose(qpos[:3], qpos[3:7]), expected(grasps, i, True), atol=2e-6)
            np.testing.assert_allclose(qpos[7:], joints[i], atol=1e-6)
        # The wrist seen from the object is the stored one, whatever the frame.
        T_frame_object = pose(content["obj_pose"][:3], content["obj_pose"][3:])
        wrist = np.linalg.inv(T_frame_object) @ pose(content["grasp_qpos"][:3], content["grasp_qpos"][3:7])
        np.testing.assert_allclose(wrist, grasps.T_object_wrist[i], atol=2e-6)
        assert (content["obj_path"], content["obj_scale"], content["frame"]) == ("mug", 1.0, "camera")
        assert content["joint_names"] == list(grasps.joint_names)


def test_the_file_of_a_cameras_cloud_is_placed_by_the_camera_and_then_by_the_frame(grasps: GraspBatch, one: Path) -> None:
    looking = Rotation.from_euler("xyz", [2.0, 0.4, -0.7])
    T_base_camera = np.eye(4)
    T_base_camera[:3, :3], T_base_camera[:3, 3] = looking.as_matrix(), [0.2, 0.5, -0.3]
    poses = torch.from_numpy(T_base_camera).float().reshape(1, 16).expand(3, -1)
    seen = grasps[[0, 1, 3]].replace(extra={FRAME: ["base"] * 3, CAMERA: poses})
    T = torch.eye(4)
    T[:3, :3], T[:3, 3] = torch.from_numpy(TURN.as_matrix()).float(), torch.tensor(SHIFT)
    for content in dexgraspbench(seen, Frame("arm", T), str(one), 1.0):
        point = np.array([0.1, -0.2, 0.6])  # in the file, which is in the camera's frame
        there = TURN.apply(looking.apply(point) + T_base_camera[:3, 3]) + SHIFT
        np.testing.assert_allclose((pose(content["obj_pose"][:3], content["obj_pose"][3:]) @ [*point, 1])[:3], there, atol=2e-6)


def test_several_objects_get_a_file_each(grasps: GraspBatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grasps.save(tmp_path / "all.parquet")
    assert export(tmp_path / "all.parquet", "--format", "csv", "--output", tmp_path / "out", "--only-successful", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["num"] == 3, "one has failed, one was not evaluated"
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["can.csv", "mug.csv"]
    assert told["files"] == [str(tmp_path / "out" / name) for name in ("mug.csv", "can.csv")]
    assert export(tmp_path / "all.parquet", "--format", "csv", "--output", tmp_path / "all.csv") == 2
    assert "all.csv is the name of a file; for 2 objects give that of a folder" in capsys.readouterr().err


def test_missing_pregrasps_are_made(grasps: GraspBatch, tmp_path: Path) -> None:
    grasps[[0]].without("pregrasp_joints", "squeeze_joints").save(tmp_path / "bare.parquet")
    assert export(tmp_path / "bare.parquet", "--format", "isaac_grasp", "--output", tmp_path / "out.yaml") == 0
    (grasp,) = yaml.safe_load((tmp_path / "out.yaml").read_text())["grasps"].values()
    centre = torch.as_tensor(load_object("mug").centre_of_mass, dtype=torch.float32)
    pregrasp, _ = pregrasp_and_squeeze(loaded_hand(HAND), grasps.T_object_wrist[:1], grasps.joints[:1], centre)
    np.testing.assert_allclose(list(grasp["pregrasp_cspace_position"].values()), pregrasp[0], atol=1e-6)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("not json", "it does not"), ("{}", "no entry 'frame'"),
        ('{"frame": "a", "T_frame_object": [[1, 0], [0, 1]]}', "shape"),
        ('{"frame": "a", "T_frame_object": [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}', "not a rotation"),
        ('{"frame": "a", "T_frame_object": [[-1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "not a rotation"),
        ('{"frame": "a", "T_frame_object": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[1,0,0,1]]}', "last row"),
        (None, "no such file"),
    ],
)
def test_a_frame_that_is_none_is_refused(
    one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None, word: str
) -> None:
    path = tmp_path / "frame.json"
    if content is not None:
        path.write_text(content)
    assert export(one, "--format", "csv", "--frame", path, "--output", tmp_path / "out.csv") == 2
    told = capsys.readouterr().err
    assert word in told
    assert "frame.json" in told
    assert not (tmp_path / "out.csv").exists()


def test_a_hand_is_checked_even_where_a_format_needs_none(
    one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.csv"
    for hand in ("barrett", "no_such_hand"):
        assert export(one, "--format", "csv", "--hand", hand, "--output", out) == 2
        assert hand in capsys.readouterr().err
    assert not out.exists()


def test_nothing_successful_is_told(grasps: GraspBatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grasps[[1]].save(tmp_path / "failed.parquet")
    out = tmp_path / "out.csv"
    assert export(tmp_path / "failed.parquet", "--format", "csv", "--only-successful", "--output", out) == 2
    assert "no grasp in" in capsys.readouterr().err


def test_the_frame_of_the_object_changes_nothing(grasps: GraspBatch) -> None:
    position, quaternion = Frame().place(grasps)
    np.testing.assert_allclose(position, grasps.T_object_wrist[:, :3, 3], atol=1e-7)
    assert bool((quaternion[:, 0] >= 0).all())


@pytest.mark.parametrize("old", ["9.npy", "mug/0.npy"])
def test_old_and_new_npy_files_are_not_mixed(
    grasps: GraspBatch, tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str
) -> None:
    grasps.save(tmp_path / "all.parquet")
    (tmp_path / "out" / old).parent.mkdir(parents=True)
    (tmp_path / "out" / old).write_bytes(b"old")
    assert export(tmp_path / "all.parquet", "--format", "dexgraspbench", "--output", tmp_path / "out") == 2
    told = capsys.readouterr().err
    assert f"into {tmp_path / 'out'}: it holds npy files already ({old})" in told
    assert "choose an empty folder" in told
    assert [p for p in (tmp_path / "out").rglob("*") if p.is_file()] == [tmp_path / "out" / old]
    (tmp_path / "out" / old).unlink()
    assert export(tmp_path / "all.parquet", "--format", "dexgraspbench", "--output", tmp_path / "out") == 0


def test_a_failed_export_leaves_no_folder(grasps: GraspBatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grasps.without("pregrasp_joints").save(tmp_path / "all.parquet")
    bad = ("--format", "dexgraspbench", "--hand", "nowhere.urdf", "--output", tmp_path / "out")
    assert export(tmp_path / "all.parquet", *bad) == 2
    assert "nowhere.urdf" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_grasps_of_several_objects_or_of_none_share_no_frame(grasps: GraspBatch) -> None:
    two = GraspBatch.concatenate([grasps[:1], grasps[:1].replace(object=("another",), object_sha256=("f" * 64,))])
    for batch in (two, grasps[:0]):
        with pytest.raises(OptionError, match=r"grasps of \d objects; a file has the frame of one object"):
            dro.isaac_grasp(batch, Frame())
        with pytest.raises(OptionError, match=r"a file has the frame of one object"):
            dro.csv_table(batch, Frame())
    assert "object_frame_link: bench" in dro.isaac_grasp(two, Frame("bench"))
