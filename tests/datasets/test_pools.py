"""Worker processes of the data engine: killed, stuck, orphaned, crowded, out of space."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dro_grasp.datasets.engine.pools import LocalPool
from dro_grasp.datasets.engine.schedule import EngineConfig, synthesize_dataset
from dro_grasp.datasets.engine.shards import find_shards, read_yield, sole_run
from dro_grasp.errors import OutputError
from dro_grasp.grasps.batch import GraspBatch
from tests.helpers import engine_work
from tests.helpers.engine_work import GRASPS

ROOT = Path(__file__).parents[2]
PARENT = """
import sys
from dro_grasp.datasets.engine.schedule import EngineConfig, synthesize_dataset
from dro_grasp.datasets.engine.pools import LocalPool
from tests.helpers.engine_work import {work}
if __name__ == "__main__":
    def pool(job):
        made = LocalPool(job, 2, 60, {work})
        print(*[w.process.pid for w in made.workers], flush=True)
        return made
    synthesize_dataset(["a", "b"], ["x", "y"], 40, sys.argv[1], make_pool=pool)
"""


def pool(work, limit: float = 60.0):
    return lambda job: LocalPool(job, 2, limit, work)


def whole(folder: Path) -> int:
    """Grasps in the folder, every file read; fails on a file that is not whole, or doubled rounds."""
    shards = find_shards(folder)
    assert len({(s.hand, s.object, s.round) for s in shards}) == len(shards)
    assert not list(folder.glob("*/*/.*.part"))
    return sum(len(GraspBatch.load(s.path(folder))) for s in shards)


def test_a_killed_worker_costs_its_shard_and_a_deadly_pair_itself(tmp_path):
    marks, folder, lines = tmp_path / "marks", tmp_path / "data", []
    marks.mkdir()
    report = synthesize_dataset(
        ["a"], ["x", "fragile", "deadly", "y"], 10, folder, protocol=str(marks), progress=lines.append,
        make_pool=pool(engine_work.dying))
    assert report.grasps == whole(folder) == 30
    assert set(report.failures) == {("a", "deadly")}
    assert "process died (exit code -9), 2 times" in report.failures["a", "deadly"]
    assert any(line.startswith("a on deadly: ") for line in lines)


def test_an_object_that_takes_too_long_is_stopped_and_the_rest_goes_on(tmp_path):
    config = EngineConfig(most_crashes=1)
    report = synthesize_dataset(["a"], ["endless", "x", "y"], 10, tmp_path, config=config, progress=lambda _: None,
                                make_pool=pool(engine_work.endless, limit=4.0))
    assert report.failures == {("a", "endless"): "took longer than 4 s, 1 times"}
    assert report.grasps == whole(tmp_path) == 20


def start_parent(tmp_path: Path, folder: Path) -> subprocess.Popen[str]:
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(work="slow"))
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, script, folder], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                            text=True, env=environment)


def wait_for(condition, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_killed_parent_leaves_whole_shards_and_no_process_and_a_rerun_finishes(tmp_path):
    folder = tmp_path / "data"
    parent = start_parent(tmp_path, folder)
    assert parent.stdout is not None
    workers = [int(pid) for pid in parent.stdout.readline().split()]
    wait_for(lambda: len(list(folder.glob("*/*/*.parquet"))) >= 3)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    wait_for(lambda: not any(alive(pid) for pid in workers), 15)
    before = whole(folder)
    assert 0 < before < 160
    report = synthesize_dataset(["a", "b"], ["x", "y"], 40, folder, progress=lambda _: None, make_pool=pool(engine_work.easy))
    assert report.added == 160 - before
    assert report.grasps == whole(folder) == 160


def test_a_second_run_into_a_folder_is_refused_and_the_first_goes_on(tmp_path):
    with (
        sole_run(tmp_path),
        pytest.raises(OutputError, match=rf"another run is filling .* \(process {os.getpid()}\)"),
    ):
        synthesize_dataset(["a"], ["x"], 1, tmp_path, make_pool=pool(engine_work.easy))
    report = synthesize_dataset(["a"], ["x"], 1, tmp_path, progress=lambda _: None, make_pool=pool(engine_work.easy))
    assert report.grasps == GRASPS


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 48 KiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    library = ctypes.CDLL(None, use_errno=True)
    if os.geteuid() != 0 or library.mount(b"none", str(folder).encode(), b"tmpfs", 0, b"size=48k"):
        pytest.skip("needs root and the right to mount")
    yield folder, lambda: library.mount(b"none", str(folder).encode(), b"tmpfs", 32, b"size=64m")  # 32: remount
    library.umount2(str(folder).encode(), 2)


def test_a_full_disk_ends_the_run_clearly_and_loses_nothing(small_disk):
    folder, enlarge = small_disk
    with pytest.raises(OutputError, match=r"No space left on device.*free some space"):
        synthesize_dataset(["a"], ["x", "y", "z"], 50, folder, progress=lambda _: None, make_pool=pool(engine_work.easy))
    before = whole(folder)
    assert before > 0
    assert enlarge() == 0
    report = synthesize_dataset(["a"], ["x", "y", "z"], 50, folder, progress=lambda _: None, make_pool=pool(engine_work.easy))
    assert report.added == 150 - before
    assert whole(folder) == 150


def test_ctrl_c_ends_the_workers(tmp_path):
    folder = tmp_path / "data"
    parent = start_parent(tmp_path, folder)
    assert parent.stdout is not None
    workers = [int(pid) for pid in parent.stdout.readline().split()]
    wait_for(lambda: len(list(folder.glob("*/*/*.parquet"))) >= 1)
    parent.send_signal(signal.SIGINT)
    parent.wait(20)
    parent.stdout.close()
    wait_for(lambda: not any(alive(pid) for pid in workers), 15)
    assert sum(read_yield(folder, s).valid for s in find_shards(folder)) == whole(folder)
