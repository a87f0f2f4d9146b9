"""Paths of the user, checked before the work; folders made with their parents; one error for all that a library raises."""

from __future__ import annotations

import errno
import os
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dro_grasp.errors import GraspFileError, OptionError, OutputError
from dro_grasp.files import check_folder, check_output, given_path, is_unread, make_folder, reading, replacing, set_aside


@pytest.mark.parametrize("name", ["run", "runs/main/motion"])
def test_a_folder_is_checked_without_a_trace_and_made_with_its_parents(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert check_folder(name) == Path(name)
    assert list(tmp_path.iterdir()) == []
    assert make_folder(name) == make_folder(tmp_path / name).relative_to(tmp_path)
    assert (tmp_path / name).is_dir()


def test_the_command_that_creates_a_folder_is_one_for_shells(tmp_path: Path) -> None:
    folder = tmp_path / "grasps & more"
    with pytest.raises(OutputError) as refusal:
        check_output(folder / "a.parquet")
    assert shlex.split(str(refusal.value).rpartition("(")[2].rstrip(")")) == ["mkdir", "-p", str(folder)]


@pytest.mark.parametrize("name", ["file", "file/run", "file/runs/main"])
def test_a_file_is_no_folder_and_holds_none(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("kept")
    for call in (check_folder, make_folder):
        with pytest.raises(OutputError, match="file is a file"):
            call(tmp_path / name)
    assert (tmp_path / "file").read_text() == "kept"


def test_a_folder_above_that_is_read_only_is_named_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The superuser may write anywhere, so the system's answer is replaced."""
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(OutputError, match=f"into {tmp_path}: no permission"):
        make_folder(tmp_path / "runs" / "main")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a" * 10_000, "a" * 300 + ".obj", "~nobody_here/x", "x\0y", "\udcff.stl"])
def test_what_is_no_path_is_refused(name: str) -> None:
    for check in (given_path, check_folder, check_output):
        with pytest.raises(OptionError, match="is no path of a file"):
            check(name)


@pytest.mark.parametrize("name", ["/dev/full", "/dev/null", "fifo"])
def test_devices_and_pipes_are_not_replaced(tmp_path: Path, name: str) -> None:
    if name == "fifo":
        os.mkfifo(tmp_path / name)
    with pytest.raises(OutputError, match="device or a pipe"):
        check_output(tmp_path / name)


@pytest.mark.parametrize(
    "error", [KeyError("x"), RecursionError(), MemoryError(), OSError(28, "No space left"), ValueError("a\nb")])
def test_what_a_library_raises_becomes_one_error_that_names_the_file(error: Exception) -> None:
    with pytest.raises(GraspFileError, match=r"^f\.parquet cannot be read \(.+\); expected a grasp file$"):
        with reading("f.parquet", GraspFileError, "a grasp file"):
            raise error


def test_a_file_that_is_replaced_has_the_permissions_of_a_new_one_and_a_failure_leaves_nothing(tmp_path: Path) -> None:
    mask = os.umask(0o027)
    try:
        with replacing(tmp_path / "new.txt") as temporary:
            temporary.write_text("new")
    finally:
        os.umask(mask)
    assert (tmp_path / "new.txt").stat().st_mode & 0o777 == 0o640

    def fail_halfway() -> None:
        with replacing(tmp_path / "new.txt") as temporary:
            temporary.write_text("half")
            raise KeyError

    with pytest.raises(KeyError):
        fail_halfway()
    assert [(f.name, f.read_text()) for f in tmp_path.iterdir()] == [("new.txt", "new")]


def test_whoever_reads_a_file_while_it_is_replaced_reads_the_old_one_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    with path.open() as reader:
        with replacing(path) as temporary:
            temporary.write_text("new")
        assert reader.read() == "old"
    assert path.read_text() == "new"


def test_a_file_in_the_home_folder_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with replacing("~/new.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "new.txt").read_text() == "new"


def test_of_a_link_the_target_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link.txt").symlink_to("there/file.txt")
    for content in ("first", "second"):
        with replacing(tmp_path / "link.txt") as temporary:
            temporary.write_text(content)
        assert (tmp_path / "there" / "file.txt").read_text() == content
        assert (tmp_path / "link.txt").is_symlink()
    assert [file.name for file in (tmp_path / "there").iterdir()] == ["file.txt"]


def test_our_own_errors_and_ctrl_c_pass() -> None:
    for error in (OptionError("mine"), KeyboardInterrupt()):
        with pytest.raises(type(error)), reading("f", GraspFileError, "a file"):
            raise error


@pytest.mark.parametrize("fault", [NameError("no_such_name"), AttributeError("no such attribute"), TypeError("wrong call")])
def test_a_fault_of_ours_is_not_taken_for_a_damaged_file(fault: Exception) -> None:
    with pytest.raises(type(fault)), reading("a.parquet", GraspFileError, "a grasp file"):
        raise fault


def test_a_fault_of_ours_in_the_decoder_of_grasp_files_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dro_grasp.grasps import grasp_file
    from tests.helpers.toy_batches import make

    make(2).save(tmp_path / "a.parquet")

    def broken(*_: object) -> None:
        raise NameError("no_such_name")

    monkeypatch.setattr(grasp_file, "decode", broken)
    with pytest.raises(NameError):
        type(make(1)).load(tmp_path / "a.parquet")


@pytest.mark.parametrize(("error", "unread"), [
    (OSError(errno.EIO, "Input/output error"), True), (PermissionError(errno.EACCES, "Permission denied"), True),
    (MemoryError(), True), (OSError("ZSTD decompression failed"), False), (ValueError("no Parquet"), False)])
def test_whether_a_file_could_be_read_at_all_is_known_of_the_error(error: Exception, unread: bool) -> None:
    with pytest.raises(GraspFileError) as told, reading("a.parquet", GraspFileError, "a grasp file"):
        raise error
    assert is_unread(error) == is_unread(told.value) == unread


def test_files_set_aside_keep_their_content_and_what_belongs_together_its_number(tmp_path: Path) -> None:
    state, log = tmp_path / "state", tmp_path / "log"
    for number in range(3):
        state.write_text(f"state {number}")
        if number != 1:
            log.write_text(f"log {number}")
        set_aside(state, log)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {
        "state.damaged": "state 0", "log.damaged": "log 0", "state.damaged.2": "state 1", "state.damaged.3": "state 2",
        "log.damaged.3": "log 2"}


def test_every_reader_expands_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import dro_grasp as dro
    from dro_grasp.apps.server.client import sent_object
    from dro_grasp.arm.planning.motion import MotionPlan
    from dro_grasp.compare.methods import make_method
    from dro_grasp.frames import read_motion
    from dro_grasp.geometry.cache import cache_folder
    from dro_grasp.hands.library import locate_hand

    monkeypatch.setenv("HOME", str(tmp_path))
    readers: list[tuple[Callable[[str], object], str]] = [
        (MotionPlan.load, "x.npz"), (dro.GraspBatch.load, "x.parquet"), (make_method, "x.parquet"), (dro.load_object, "x.obj"),
        (dro.load_hand, "x.urdf"), (dro.load_robot, "x.yaml"), (lambda p: read_motion(Path(p), "T_frame_camera"), "x.json"),
        (sent_object, "x.obj")]
    for read, name in readers:
        (tmp_path / name).write_text("{}")
        if read is sent_object:
            assert str(sent_object(f"~/{name}")).count("x.obj") == 1, name
            assert sent_object(f"~/{name}") == sent_object(tmp_path / name)
            continue
        with pytest.raises(dro.DroGraspError) as refusal:
            read(f"~/{name}")
        assert str(tmp_path / name) in str(refusal.value), name
    monkeypatch.setenv("DRO_GRASP_CACHE", "~/cache")
    monkeypatch.setenv("DRO_GRASP_ASSETS", "~/assets")
    (tmp_path / "assets/hands/ezgripper").mkdir(parents=True)
    file = tmp_path / "assets/hands/ezgripper/ezgripper.urdf"
    file.touch()
    assert (cache_folder(), locate_hand("assets/ezgripper").path) == (tmp_path / "cache", file)


def test_a_user_without_a_home_has_no_cache_and_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container with a user number of its own."""
    from dro_grasp.geometry.cache import cached_arrays

    for name in ("DRO_GRASP_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.getuid", lambda: 987654321)
    with pytest.raises(RuntimeError):
        Path.home()
    assert cached_arrays("key", lambda: {"a": np.arange(3)})["a"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("stated", ["", "cache", None])
def test_an_empty_or_relative_cache_variable_does_not_count(
    stated: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dro_grasp.geometry.cache import cache_folder

    monkeypatch.delenv("DRO_GRASP_CACHE", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if stated is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", stated)
    assert cache_folder() == tmp_path / ".cache" / "dro-grasp"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "mine"))
    assert cache_folder() == tmp_path / "mine" / "dro-grasp"
