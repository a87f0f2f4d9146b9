"""Files as other projects write them: read to the pose and joints that went in, and never run."""

from __future__ import annotations

import json
import os
import pickle
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from dro_grasp.cli.main import main
from dro_grasp.errors import GraspFileError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.training.data.collections.importing import import_grasps, read_foreign
from tests.helpers.loaded_hands import loaded_hand

HAND = "gripper3"


def turned(axis: str, angle: float) -> np.ndarray:
    """Rotation about one axis, written out."""
    c, s = np.cos(angle), np.sin(angle)
    return {"x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
            "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])}[axis]


@pytest.fixture
def made() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, angles and joints of four grasps."""
    noise = np.random.default_rng(0)
    hand = loaded_hand(HAND)
    joints = hand.random_joints(4, torch.Generator().manual_seed(0)).double().numpy()
    return noise.normal(0, 0.1, (4, 3)), noise.uniform(-1.5, 1.5, (4, 3)), joints


def imported(*arguments: object) -> int:
    return main(["dataset", "import", *map(str, arguments), "--json"])


def test_the_official_data_set(made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    position, angles, joints = made
    hand = loaded_hand(HAND)
    q = torch.from_numpy(np.concatenate([position, angles, joints], 1)).float()
    objects = ["sphere", "can", "sphere", "nothing+here"]
    torch.save({"info": {}, "metadata": [(q[i], objects[i], "theirs") for i in range(4)]}, tmp_path / "cmap_dataset.pt")
    folder = tmp_path / "out"
    assert imported(tmp_path / "cmap_dataset.pt", "--format", "cmap", "--hands", f"theirs={HAND}", "--output", folder) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["missing"]) == ["nothing+here"]
    grasps = GraspBatch.load(told["files"][0]["file"])
    assert sorted(grasps.object) == ["can", "sphere", "sphere"]
    for i in range(3):
        k = next(k for k in range(3) if np.allclose(grasps.joints[k], joints[i], atol=1e-6))
        assert grasps.object[k] == objects[i]
        R = turned("x", angles[i, 0]) @ turned("y", angles[i, 1]) @ turned("z", angles[i, 2])  # about moving axes
        np.testing.assert_allclose(grasps.T_object_wrist[k, :3, :3], R, atol=1e-5)
        np.testing.assert_allclose(grasps.T_object_wrist[k, :3, 3], position[i], atol=1e-6)
    assert grasps.hand == hand.name
    assert not grasps.evaluated.any()


@pytest.mark.parametrize("prefix", ["", "robot0:"])
def test_dexgraspnet(made, tmp_path: Path, capsys: pytest.CaptureFixture[str], prefix: str) -> None:
    position, angles, joints = made
    names = loaded_hand(HAND).tree.joint_names
    entries = []
    for i in range(4):
        wrist = dict(zip(("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz"), [*position[i], *angles[i]], strict=True))
        fingers = {prefix + name: joints[i, k] for k, name in reversed(list(enumerate(names)))}
        entries.append({"qpos": {**fingers, **wrist}, "scale": 0.5})
    np.save(tmp_path / "can.npy", np.array(entries, dtype=object), allow_pickle=True)
    assert imported(tmp_path / "can.npy", "--format", "dexgraspnet", "--hands", HAND, "--output", tmp_path / "out") == 0
    grasps = GraspBatch.load(json.loads(capsys.readouterr().out)["files"][0]["file"])
    np.testing.assert_allclose(grasps.joints, joints, atol=1e-6)
    for i in range(4):
        R = turned("z", angles[i, 2]) @ turned("y", angles[i, 1]) @ turned("x", angles[i, 0])  # about fixed axes
        np.testing.assert_allclose(grasps.T_object_wrist[i, :3, :3], R, atol=1e-5)
    assert set(grasps.object) == {"can"}


def test_dexgraspbench_is_read_as_it_is_exported(made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    position, angles, joints = made
    from dro_grasp.objects.catalogue import load_object

    T = np.tile(np.eye(4, dtype=np.float32), (4, 1, 1))
    T[:, :3, 3] = position
    T[:, :3, :3] = [turned("y", a) for a in angles[:, 0]]
    grasps = GraspBatch.create(loaded_hand(HAND), load_object("can"), torch.from_numpy(T), torch.from_numpy(joints).float())
    grasps.save(tmp_path / "g.parquet")
    frame = {"frame": "base", "T_frame_object": [[0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]}
    (tmp_path / "frame.json").write_text(json.dumps(frame))
    assert main(["export", str(tmp_path / "g.parquet"), "--format", "dexgraspbench", "--frame", str(tmp_path / "frame.json"),
                 "--output", str(tmp_path / "npy"), "--json"]) == 0
    files = [tmp_path / "npy" / f"{i}.npy" for i in range(4)]
    assert imported(*files, "--format", "dexgraspbench", "--output", tmp_path / "out") == 0
    back = GraspBatch.load(json.loads(capsys.readouterr().out.splitlines()[-1])["files"][0]["file"])
    np.testing.assert_allclose(back.T_object_wrist, T, atol=1e-5)
    np.testing.assert_allclose(back.joints, joints, atol=1e-6)
    for i, file in enumerate(files):
        entry = np.load(file, allow_pickle=True).item()
        np.testing.assert_allclose(back.pregrasp_joints[i], entry["pregrasp_qpos"][7:], atol=1e-6)
        np.testing.assert_allclose(back.squeeze_joints[i], entry["squeeze_qpos"][7:], atol=1e-6)
    assert (back.pregrasp_joints - back.squeeze_joints).abs().max() > 0.05


def test_a_dexgraspbench_file_with_a_grasp_alone_states_no_closing(made, tmp_path: Path) -> None:
    entry = {"grasp_qpos": np.array([0, 0, 0.1, 1, 0, 0, 0, *made[2][0]])}
    np.save(tmp_path / "0.npy", np.array(entry, dtype=object), allow_pickle=True)
    grasps, missing = import_grasps([tmp_path / "0.npy"], "dexgraspbench", {"": HAND}, "can")
    assert not missing
    np.testing.assert_allclose(grasps[HAND].joints[0], made[2][0], atol=1e-6)
    assert not grasps[HAND].states_closing.any()


class Evil:
    """Leaves a file where it is unpickled."""

    def __reduce__(self):
        return os.mkdir, (os.environ["TRACE"],)


@pytest.mark.parametrize("kind", ["cmap", "dexgraspnet", "dexgraspbench"])
def test_files_that_want_to_run_code_are_refused(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACE", str(tmp_path / "trace"))
    path = tmp_path / ("bad.pt" if kind == "cmap" else "bad.npy")
    if kind == "cmap":
        torch.save({"metadata": Evil()}, path)
    else:
        np.save(path, np.array([{"qpos": Evil(), "scale": 1.0}], dtype=object), allow_pickle=True)
    with pytest.raises(GraspFileError, match="numbers and names only"):
        read_foreign(path, kind)  # type: ignore[arg-type]
    assert not (tmp_path / "trace").exists()
    with pytest.raises(GraspFileError):
        read_foreign(tmp_path / "missing.npy", kind)  # type: ignore[arg-type]


def test_other_joints_are_told(made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    q = torch.zeros(11)
    torch.save({"metadata": [(q, "can", HAND)]}, tmp_path / "cmap.pt")
    assert imported(tmp_path / "cmap.pt", "--format", "cmap", "--output", tmp_path / "out") == 2
    assert "the grasp has 5 joints" in capsys.readouterr().err
    np.save(tmp_path / "can.npy", np.array([{"qpos": {**dict.fromkeys(
        ("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz"), 0.0), "other": 1.0}, "scale": 1.0}], dtype=object))
    assert imported(tmp_path / "can.npy", "--format", "dexgraspnet", "--hands", HAND, "--output", tmp_path / "out") == 2
    assert "has no joint" in capsys.readouterr().err
    assert imported(tmp_path / "can.npy", "--format", "dexgraspnet", "--output", tmp_path / "out") == 2
    assert "--hands" in capsys.readouterr().err


def test_names_of_hands_that_are_in_no_file_are_refused(made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    position, angles, joints = made
    q = torch.from_numpy(np.concatenate([position, angles, joints], 1)).float()
    torch.save({"metadata": [(row, "can", HAND) for row in q]}, tmp_path / "theirs.pt")
    named = ("--hands", "griper3=barrett", "--output", tmp_path / "out")
    assert imported(tmp_path / "theirs.pt", "--format", "cmap", *named) == 2
    assert f"no grasp is of a hand called griper3; the hands in the files are {HAND} (--hands)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_no_file_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["dataset", "import", "--format", "cmap", "--output", str(out)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "name at least one cmap file" in said.err
    assert imported(tmp_path / "missing.pt", "--format", "cmap", "--output", out) == 2
    assert f"error: no file {tmp_path / 'missing.pt'}; " in capsys.readouterr().err
    assert imported(tmp_path, "--format", "cmap", "--output", out) == 2
    assert "is a folder" in capsys.readouterr().err
    assert not out.exists()


def test_no_grasp_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [str(tmp_path / "cmap.pt"), "--format", "cmap", "--output", str(tmp_path / "out")]
    torch.save({"metadata": [(torch.zeros(11), "nothing+here", HAND)]}, tmp_path / "cmap.pt")
    assert main(["dataset", "import", *given]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "--object" in said.err
    torch.save({"metadata": []}, tmp_path / "cmap.pt")
    assert main(["dataset", "import", *given]) == 2
    assert "cmap.pt holds none" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("plain", [True, False])
def test_a_refused_pickle_is_told_without_advice_to_open_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder, plain: bool
) -> None:
    path = tmp_path / "bad.pt"
    if plain:
        path.write_bytes(pickle.dumps({"metadata": []}, protocol=4))
    else:
        torch.save({"metadata": np.zeros(3)}, path)
    assert imported(path, "--format", "cmap", "--output", tmp_path / "out") == 2
    told = capsys.readouterr().err
    assert "bad.pt holds more than tensors (it " in told
    assert "not opened, for safety" in told
    assert "save its grasps again" in told
    assert "weights_only" not in told
    assert not list(recwarn)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "content", "missing", "expected"),
    [
        ("dexgraspbench", {"pose": 1}, "grasp_qpos", "joint_names"),
        ("dexgraspnet", [{"scale": 1.0}], "qpos", "WRJTx"),
        ("dexgraspnet", [{"scale": 1.0, "qpos": {"j": 0.0}}], "WRJTx", "each with 'scale'"),
        ("cmap", {"info": {}}, "metadata", "a list of (wrist and joints, object, hand)"),
    ],
)
def test_a_missing_entry_is_named(kind: str, content: object, missing: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.file"
    with path.open("wb") as file:
        if kind == "cmap":
            torch.save(content, file)
        else:
            np.save(file, np.array(content, dtype=object), allow_pickle=True)
    with pytest.raises(GraspFileError, match=f"it has no entry '{missing}'; expected ") as told:
        read_foreign(path, kind)  # type: ignore[arg-type]
    assert expected in str(told.value)


@pytest.mark.parametrize("content", [b"", b"hello world"])
def test_files_of_nothing_are_told(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(content)
    for kind in ("cmap", "dexgraspnet", "dexgraspbench"):
        with pytest.raises(GraspFileError, match=f"cannot be read .*expected a {kind} file"):
            read_foreign(tmp_path / "a", kind)  # type: ignore[arg-type]


def test_a_pickle_that_asks_for_room_for_more_objects_than_it_can_hold_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([1], dtype=object), allow_pickle=True)
    whole = (tmp_path / "a.npy").read_bytes()
    header = whole[: whole.index(b"\n") + 1]
    (tmp_path / "a.npy").write_bytes(header + b"\x80\x02]r\xff\xff\xff\x3f.")  # a list, as number 2^30 - 1
    with pytest.raises(GraspFileError, match="numbers more objects than it can hold"):
        read_foreign(tmp_path / "a.npy", "dexgraspnet")


def test_a_header_that_states_two_gigabytes_gets_no_room_for_them(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01" + 30 * b"\x7f")
    tracemalloc.start()
    with pytest.raises(GraspFileError, match="cannot be read"):
        read_foreign(tmp_path / "a.npy", "dexgraspnet")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1e8
