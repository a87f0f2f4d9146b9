"""Worker processes of the data engine: killed, stuck, orphaned, crowded, out of space."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dro_grasp.errors import OutputError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.training.data.engine.pools import LocalPool, shards_at_once
from dro_grasp.training.data.engine.schedule import simulating_threads, synthesize_dataset
from dro_grasp.training.data.engine.shards import Shard, find_shards, read_yield, sole_run
from dro_grasp.training.data.engine.worker import EngineConfig, FinishedShard, Job, Task
from tests.helpers import engine_work
from tests.helpers.engine_work import GRASPS
from tests.helpers.processes import PATIENCE, alive, children, start, wait_for

PARENT = """
import signal, sys
from dro_grasp.training.data.engine.schedule import synthesize_dataset
from dro_grasp.training.data.engine.pools import LocalPool
from tests.helpers.engine_work import {work}
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
    synthesize_dataset(["a", "b"], ["x", "y"], 40, sys.argv[1], workers=lambda job: LocalPool(job, 2, 60, {work}))
"""


def pool(work, workers: int = 2, limit: float = 60.0):
    return lambda job: LocalPool(job, workers, limit, work)


def whole(folder: Path) -> int:
    """Grasps in the folder, every file read; fails on a file that is not whole, or doubled rounds."""
    shards = find_shards(folder)
    assert len({(s.hand, s.object, s.round) for s in shards}) == len(shards)
    assert not list(folder.glob("*/*/.*.part"))
    return sum(len(GraspBatch.load(s.path(folder))) for s in shards)


@pytest.mark.slow
def test_a_killed_worker_costs_its_shard_and_a_deadly_pair_itself(tmp_path):
    """On `heavy` it dies within the transfer of its shard, holding whatever lock that needs."""
    marks, folder, lines = tmp_path / "marks", tmp_path / "data", []
    marks.mkdir()
    report = synthesize_dataset(
        ["a"], ["x", "fragile", "deadly", "heavy", "y"], 10, folder, workers=pool(engine_work.dying),
        config=EngineConfig(protocol=str(marks)), progress=lines.append)
    assert report.grasps == whole(folder) == 30
    assert set(report.failures) == {("a", "deadly"), ("a", "heavy")}
    assert all("process died (exit code -9), 2 times" in why for why in report.failures.values())
    assert any(line.startswith("a on deadly: ") for line in lines)


def test_the_parent_s_environment_stays_and_workers_have_one_thread(tmp_path, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = dict(os.environ)
    one = pool(engine_work.telling_threads, 1)
    report = synthesize_dataset(["a"], ["x"], 5, tmp_path, one, progress=lambda _: None)
    assert report.failures == {("a", "x"): "1 1"}
    assert dict(os.environ) == before


@pytest.mark.slow
def test_workers_that_feed_a_device_simulate_on_their_share_of_the_cores(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "16")
    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(16)))
    on_device = EngineConfig(synthesis=SynthesisConfig(device="cuda"))
    assert [simulating_threads(workers, on_device) for workers in (1, 3, 40)] == [16, 5, 1]
    assert simulating_threads(2, EngineConfig()) == 1
    assert on_device.threads is None
    assert EngineConfig().threads == 1
    work = LocalPool(Job(0, EngineConfig()), 1, PATIENCE, engine_work.telling_threads, threads=5)
    try:
        work.submit([Task(Shard("a", "x", 0), 1)])
        (_, failed), = work.wait(PATIENCE)
    finally:
        work.close()
    assert failed.reason == "5 1"


@pytest.mark.parametrize(("resources", "on_device", "expected"), [
    ({"CPU": 32.0}, False, (32, 1)), ({"CPU": 32.0, "GPU": 1.0}, False, (32, 1)), ({}, False, (1, 1)), ({}, True, (1, 1)),
    ({"CPU": 16.0, "GPU": 1.0}, True, (4, 4)), ({"CPU": 34.0, "GPU": 2.0}, True, (8, 4)),
    ({"CPU": 2.0, "GPU": 8.0}, True, (2, 1)), ({"CPU": 8.0}, True, (1, 8))])
def test_a_cluster_s_gpus_are_shared_and_their_shards_share_its_cpus(resources, on_device, expected):
    assert shards_at_once(resources, on_device) == expected


def test_an_idle_worker_that_dies_is_replaced():
    before = {p.pid for p in multiprocessing.active_children()}
    work = LocalPool(Job(0, EngineConfig()), 1, 60.0, engine_work.easy)
    try:
        for i in range(3):
            work.submit([Task(Shard("a", "x", i), 64)])
            (outcome,) = work.wait(PATIENCE)
            assert isinstance(outcome[1][0], FinishedShard)
            (process,) = (p for p in multiprocessing.active_children() if "pebble" in p.name and p.pid not in before)
            if i == 0:
                process.kill()
                wait_for(lambda: not work.idle[0].active)
    finally:
        work.close()
    assert not [p for p in multiprocessing.active_children() if "pebble" in p.name and p.pid not in before]


@pytest.mark.slow
def test_an_object_that_takes_too_long_is_stopped_and_the_rest_goes_on(tmp_path):
    config = EngineConfig(max_crashes=1)
    report = synthesize_dataset(["a"], ["endless", "x", "y"], 10, tmp_path, config=config, progress=lambda _: None,
                                workers=pool(engine_work.endless, limit=20.0))
    assert report.failures == {("a", "endless"): "took longer than 20 s, 1 times"}
    assert report.grasps == whole(tmp_path) == 20


def start_parent(tmp_path: Path, folder: Path) -> subprocess.Popen[bytes]:
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(work="slow"))
    return start(script, folder)


def shards_appear(parent: subprocess.Popen[bytes], folder: Path, count: int) -> list[int]:
    """Wait until a parent has made some shards; its children, two workers at least."""
    wait_for(lambda: len(list(folder.glob("*/*/*.parquet"))) >= count or parent.poll() is not None)
    assert parent.poll() is None
    found = children(parent.pid)
    assert len(found) >= 2
    return found


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_killed_parent_leaves_whole_shards_and_no_process_and_a_rerun_finishes(tmp_path):
    folder = tmp_path / "data"
    parent = start_parent(tmp_path, folder)
    started = shards_appear(parent, folder, 3)
    parent.kill()
    parent.wait()
    wait_for(lambda: not any(alive(pid) for pid in started))
    before = whole(folder)
    assert 0 < before < 160
    report = synthesize_dataset(["a", "b"], ["x", "y"], 40, folder, progress=lambda _: None, workers=pool(engine_work.easy))
    assert report.added == 160 - before
    assert report.grasps == whole(folder) == 160


@pytest.mark.slow
def test_a_second_run_into_a_folder_is_refused_and_the_first_goes_on(tmp_path):
    with (
        sole_run(tmp_path),
        pytest.raises(OutputError, match=rf"another run is filling .* \(process {os.getpid()} on"),
    ):
        synthesize_dataset(["a"], ["x"], 1, tmp_path, workers=pool(engine_work.easy))
    report = synthesize_dataset(["a"], ["x"], 1, tmp_path, progress=lambda _: None, workers=pool(engine_work.easy, 1))
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


@pytest.mark.slow
def test_a_full_disk_ends_the_run_clearly_and_loses_nothing(small_disk):
    folder, enlarge = small_disk
    with pytest.raises(OutputError, match=r"No space left on device.*free some space.*the same command goes on"):
        synthesize_dataset(["a"], ["x", "y", "z"], 50, folder, progress=lambda _: None, workers=pool(engine_work.easy))
    before = whole(folder)
    assert before > 0
    assert enlarge() == 0
    report = synthesize_dataset(["a"], ["x", "y", "z"], 50, folder, progress=lambda _: None, workers=pool(engine_work.easy))
    assert report.added == 150 - before
    assert whole(folder) == 150


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("everyone", [False, True])
def test_ctrl_c_ends_the_workers(tmp_path, everyone):
    """A terminal sends the signal to parent and workers alike."""
    folder = tmp_path / "data"
    parent = start_parent(tmp_path, folder)
    started = shards_appear(parent, folder, 1)
    for pid in [*(started if everyone else []), parent.pid]:
        os.kill(pid, signal.SIGINT)
    parent.wait(PATIENCE)
    wait_for(lambda: not any(alive(pid) for pid in started))
    assert sum(read_yield(folder, s).valid for s in find_shards(folder)) == whole(folder)
