"""Worker processes end with the process that started them; memory stays with processes that need it again."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers.processes import alive, start, wait_for

SYNTHESIS = """
from dro_grasp.training.data.engine.pools import LocalPool
from tests.test_workers import work_on
if __name__ == "__main__":
    pool = LocalPool(None, 1, 600, work_on)
    pool.submit(None)
    pool.wait(600)
"""
SERVER = """
from dro_grasp.apps.server.request_queue import RequestQueue
from types import SimpleNamespace
from tests.helpers.quick_answers import QuickAnswerer
from tests.test_workers import work_on

class Answerer(QuickAnswerer):
    answer = work_on

if __name__ == "__main__":
    RequestQueue(None, answerer=Answerer).submit(SimpleNamespace(id="one"))
"""


def work_on(*given: object) -> None:
    """Tell the number of the process, and compute for a long time."""
    mark = Path(os.environ["MARK"])
    mark.with_suffix(".part").write_text(str(os.getpid()))
    mark.with_suffix(".part").rename(mark)
    end = time.monotonic() + 120
    while time.monotonic() < end:
        sum(range(1000))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("script", [SYNTHESIS, SERVER], ids=["synthesis", "server"])
def test_nothing_is_computed_on_once_the_parent_is_killed(script: str, tmp_path: Path) -> None:
    (file := tmp_path / "parent.py").write_text(script)
    parent = start(file, MARK=str(mark := tmp_path / "worker"))
    wait_for(mark.is_file)
    worker = int(mark.read_text())
    parent.kill()
    parent.wait(20)
    try:
        wait_for(lambda: not alive(worker), 20)
    finally:
        if alive(worker):
            os.kill(worker, signal.SIGKILL)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only its way of keeping memory is known")
def test_memory_that_a_command_frees_is_at_hand_again() -> None:
    """Three blocks of 20 MB, again and again: more than glibc keeps of itself, and 15,000 pages to ask for each time."""
    code = """
import contextlib, io, resource
from dro_grasp.cli.main import main
with contextlib.redirect_stdout(io.StringIO()):
    main(["--version"])
for turn in range(8):
    if turn == 3:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    held = [b"x" * 20_000_000 for _ in range(3)]
    del held
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 1_000
