"""A run in parts that share a folder, as the tasks of an array job."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from dro_grasp.cli.main import main
from dro_grasp.errors import GraspFileError, OptionError, OutputError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.training.data.engine import schedule
from dro_grasp.training.data.engine.pools import Work
from dro_grasp.training.data.engine.schedule import SETTINGS, own_pairs, require_settings, synthesize_dataset
from dro_grasp.training.data.engine.shards import Shard, find_shards, sole_run
from dro_grasp.training.data.engine.worker import EngineConfig, Job
from tests.helpers.engine_work import GRASPS, easy, slow
from tests.helpers.here_pool import HerePool

HANDS, OBJECTS, GOAL = ["a", "b"], ["x", "y", "z"], 3 * GRASPS
"""Pairs, and as many grasps of each as three shards hold."""


def fill(folder: Path, shard: tuple[int, int] = (1, 1), work: Work = easy) -> schedule.DatasetReport:
    config = EngineConfig(shard=shard)
    return synthesize_dataset(
        HANDS, OBJECTS, GOAL, folder, lambda job: HerePool(job, work), config=config, progress=lambda _: None)


def content(folder: Path) -> dict[Shard, tuple[list, list]]:
    grasps = {shard: GraspBatch.load(shard.path(folder)) for shard in find_shards(folder)}
    return {shard: (g.joints.tolist(), g.T_object_wrist.tolist()) for shard, g in grasps.items()}


def test_two_parts_and_one_that_is_killed_and_rerun_make_what_one_run_makes(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    folder = tmp_path / "parts"
    parts = [context.Process(target=fill, args=(folder, (i, 3), slow)) for i in (1, 2, 3)]
    for part in parts:
        part.start()
    killed = own_pairs(HANDS, OBJECTS, (3, 3))
    while not any(Shard(*pair, 0).path(folder).exists() for pair in killed):
        time.sleep(0.01)
    os.kill(parts[2].pid or 0, signal.SIGKILL)
    for part in parts:
        part.join(30)
    assert [part.exitcode for part in parts] == [0, 0, -signal.SIGKILL]
    fill(tmp_path / "whole")
    before = content(folder)
    assert len(before) >= 13
    report = fill(folder, (3, 3))
    assert report.shards == 18 - len(before)
    assert report.grasps == 2 * GOAL
    assert content(folder) == content(tmp_path / "whole")


def begin(folder: Path, protocol: str, barrier: threading.Barrier) -> str:
    """How a part that begins the folder together with others fares."""
    barrier.wait()
    try:
        require_settings(folder, Job(0, EngineConfig(protocol)))
    except OptionError as error:
        return str(error)
    return protocol


def test_of_parts_that_begin_at_once_with_other_settings_one_kind_goes_on(tmp_path: Path) -> None:
    for turn in range(20):
        folder, asked = tmp_path / str(turn), ["dro", "strict"] * 4
        folder.mkdir()
        barrier = threading.Barrier(len(asked))
        with ThreadPoolExecutor(len(asked)) as pool:
            told = list(pool.map(begin, repeat(folder), asked, repeat(barrier)))
        kept = json.loads((folder / SETTINGS).read_text())["protocol"]
        refused = [text for protocol, text in zip(asked, told, strict=True) if protocol != kept]
        assert [text for text in told if text == kept] == [kept] * 4
        assert all(f"was begun with protocol {kept}, " in text for text in refused)
        assert [path.name for path in folder.iterdir()] == [SETTINGS]


def test_every_pair_belongs_to_one_part() -> None:
    for count in (1, 2, 4, 9):
        parts = [own_pairs(HANDS, OBJECTS, (i, count)) for i in range(1, count + 1)]
        assert sorted(pair for part in parts for pair in part) == sorted((h, o) for h in HANDS for o in OBJECTS)
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert own_pairs(["a", "a"], ["x"], (1, 1)) == [("a", "x")]


def test_parts_share_a_folder_and_other_runs_do_not(tmp_path: Path) -> None:
    with sole_run(tmp_path, (1, 2)), sole_run(tmp_path, (2, 2)):
        for part, told in (((1, 2), "as part 1 of 2"), ((1, 1), "part . of 2"), ((1, 3), "part . of 2")):
            with pytest.raises(OutputError, match=rf"another run is filling .* {told} \(process {os.getpid()} on"), \
                    sole_run(tmp_path, part):
                pass
    for part in ((1, 1), (2, 3)):
        with sole_run(tmp_path, part):
            pass
    with sole_run(tmp_path), pytest.raises(OutputError, match="another run"), sole_run(tmp_path, (1, 2)):
        pass


def test_a_part_without_pairs_is_done_at_once(tmp_path: Path) -> None:
    report = fill(tmp_path, (7, 7))
    assert (report.grasps, report.shards, report.failures) == (0, 0, {})


@pytest.mark.parametrize("shard", ["0/2", "3/2", "1", "a/b", "-1/2"])
def test_a_part_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], shard: str) -> None:
    given = ["--hand", "barrett", "--object", "mug", "--output", str(tmp_path / "data"), f"--shard={shard}"]
    assert main(["synthesize", *given]) == 2
    assert f"is {shard}; give" in capsys.readouterr().err.replace("'", "")
    assert not (tmp_path / "data").exists()


def test_the_command_hands_on_its_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    report = schedule.DatasetReport(0, 0, 0, 0.0, {})
    monkeypatch.setattr(schedule, "synthesize_dataset", lambda *given: asked.append(given[6]) or report)
    given = ["--hand", "barrett", "--object", "mug", "--output", str(tmp_path), "--shard", "2/4"]
    assert main(["synthesize", *given]) == 0
    assert asked[0].shard == (2, 4)
    with pytest.raises(OptionError, match="shard is 5/4"):
        EngineConfig(shard=(5, 4))


@pytest.mark.parametrize("where", ["footer", "middle"])
def test_a_damaged_shard_is_set_aside_whole(tmp_path: Path, where: str) -> None:
    fill(tmp_path)
    path = Shard("a", "x", 1).path(tmp_path)
    good = path.read_bytes()
    damaged = good[:60] if where == "footer" else good[:8] + bytes(len(good) // 2) + good[8 + len(good) // 2 :]
    path.write_bytes(damaged)
    Shard("a", "x", 2).path(tmp_path).unlink()  # so that the pair is not finished
    lines: list[str] = []
    synthesize_dataset(HANDS, OBJECTS, GOAL, tmp_path, lambda job: HerePool(job, easy), progress=lines.append)
    assert any("00001.parquet" in line and "set aside as 00001.parquet.damaged and made again" in line for line in lines)
    assert path.with_name("00001.parquet.damaged").read_bytes() == damaged
    assert content(tmp_path)[Shard("a", "x", 1)] == content(tmp_path)[Shard("a", "x", 0)]
    assert len(content(tmp_path)) == 18


def test_a_shard_that_cannot_be_read_now_is_left_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path)
    before = content(tmp_path)

    def fail(*_: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(pq, "read_metadata", fail)
        with pytest.raises(GraspFileError, match="Input/output error"):
            synthesize_dataset(HANDS, OBJECTS, GOAL, tmp_path, lambda job: HerePool(job, easy))
    assert content(tmp_path) == before
    assert not list(tmp_path.rglob("*.damaged"))


def test_what_disappears_while_a_folder_is_listed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def vanish(folder: Path, pattern: str) -> Iterator[Path]:
        raise FileNotFoundError(2, "No such file or directory", str(folder / "gone"))
        yield folder / pattern

    monkeypatch.setattr(Path, "glob", vanish)
    with pytest.raises(GraspFileError, match="gone disappeared while"):
        find_shards(tmp_path)
