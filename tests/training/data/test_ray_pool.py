"""The data engine on a Ray cluster of several nodes, one of which is unplugged; in a process of its own, as Ray lingers."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.training.data.engine.shards import find_shards
from dro_grasp.training.data.engine.worker import Job

ROOT = Path(__file__).parents[3]
CLUSTER = """
import json, sys
from ray.cluster_utils import Cluster
from dro_grasp.training.data.engine.schedule import synthesize_dataset
from dro_grasp.training.data.engine.pools import RayPool
from tests.helpers.engine_work import slow

class Watched(RayPool):
    made = 0
    def wait(self, timeout):
        outcomes = super().wait(timeout)
        before, Watched.made = Watched.made, Watched.made + len(outcomes)
        if before < 6 <= Watched.made:
            cluster.remove_node(node, allow_graceful=False)  # like pulling the plug
        return outcomes

if __name__ == "__main__":
    head = {"num_cpus": 1, "object_store_memory": 100 * 2**20, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    cluster.add_node(num_cpus=1, object_store_memory=100 * 2**20)
    node = cluster.add_node(num_cpus=1, object_store_memory=100 * 2**20)
    cluster.wait_for_nodes()
    report = synthesize_dataset(["a", "b", "broken"], ["x", "y"], 30, sys.argv[1], progress=lambda _: None,
                                workers=lambda job: Watched(job, 1, 60, cluster.address, slow))
    print(json.dumps({"grasps": report.grasps, "shards": report.shards, "failures": sorted(map(list, report.failures))}))
"""


@pytest.fixture(scope="module")
def ray_starts() -> None:
    """Skips where Ray cannot start a node, as in a sandbox without network interfaces."""
    pytest.importorskip("ray")
    start = "import ray; ray.init(address='local', num_cpus=1, include_dashboard=False)"
    try:
        subprocess.run([sys.executable, "-c", start], capture_output=True, timeout=240, check=True)
    except subprocess.SubprocessError as error:
        pytest.skip(f"Ray starts no node on this machine: {error}")


@pytest.mark.slow
@pytest.mark.usefixtures("ray_starts")
def test_a_node_that_dies_costs_nothing(tmp_path):
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    path = os.pathsep.join(map(str, [ROOT, ROOT / "src"]))
    done = subprocess.run(
        [sys.executable, script, tmp_path / "data"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, timeout=300,
        env=os.environ | {"PYTHONPATH": path, "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}, check=True)
    report = json.loads(done.stdout.splitlines()[-1])
    assert report == {"grasps": 120, "shards": 24, "failures": [["broken", "x"], ["broken", "y"]]}
    shards = find_shards(tmp_path / "data")
    assert len({(s.hand, s.object, s.round) for s in shards}) == len(shards) == 24
    assert sum(len(GraspBatch.load(s.path(tmp_path / "data"))) for s in shards) == 120


def test_an_address_where_nobody_listens_is_told_at_once():
    pytest.importorskip("ray")
    from dro_grasp.training.data.engine.pools import RayPool
    from dro_grasp.training.data.engine.worker import EngineConfig

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and not listening
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(OptionError, match=f"no Ray cluster answers at {address}.*ray start --head"):
            RayPool(Job(0, EngineConfig()), 1, 60.0, address)


def test_a_script_that_cannot_be_imported_again_is_told(tmp_path):
    pytest.importorskip("ray")
    code = ("from dro_grasp.training.data.engine.pools import RayPool; from dro_grasp.training.data.engine.worker import *\n"
            "RayPool(Job(0, EngineConfig()), 1, 60.0)")
    done = subprocess.run([sys.executable, "-"], input=code, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 1
    assert "ClusterError: the process that joins the Ray cluster ended as it began; give it a script" in done.stderr


def test_without_ray_the_engine_says_what_to_install(monkeypatch):
    from dro_grasp.training.data.engine.pools import RayPool
    from dro_grasp.training.data.engine.worker import EngineConfig

    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(OptionError, match=r"pip install 'dro-grasp\[ray\]'"):
        RayPool(Job(0, EngineConfig()), 1, 60.0)


ON_GPU = """
import ray
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.training.data.engine.pools import RayPool
from dro_grasp.training.data.engine.worker import EngineConfig, Job
from tests.helpers.engine_work import telling_process

if __name__ == "__main__":
    ray.init(address="local", num_cpus=1, num_gpus=1, include_dashboard=False)  # there need be none
    pool, told = RayPool(Job(0, EngineConfig(synthesis=SynthesisConfig(device="cuda"))), 1, 60, None, telling_process), []
    for _ in range(3):
        pool.submit([])
        (_, failed), = pool.wait(60)
        told.append(failed.reason)
    print(" ".join(told))
"""


@pytest.mark.slow
@pytest.mark.usefixtures("ray_starts")
def test_the_process_of_a_gpu_stays_with_all_that_it_has_compiled(tmp_path):
    (tmp_path / "script.py").write_text(ON_GPU)
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, timeout=300,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [ROOT, ROOT / "src"]))}, check=True)
    first, *others = done.stdout.split()
    assert others == [first, first]


DRIVER = """
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dro_grasp.errors import DroGraspError
from dro_grasp.training.data.engine.schedule import synthesize_dataset
from dro_grasp.training.data.engine.pools import RayPool
from tests.helpers.engine_work import slow

if __name__ == "__main__":
    try:
        synthesize_dataset(["a", "b"], ["x", "y"], int(sys.argv[2]), sys.argv[1],
                           workers=lambda job: RayPool(job, 1, 60, None, slow))
    except DroGraspError as error:
        sys.exit(f"error: {error}")
"""


def raylets_below(process: int) -> list[int]:
    """Processes of Ray's nodes among the descendants of a process."""
    below, commands = {process}, {}
    for stat in sorted(Path("/proc").glob("[0-9]*/stat"), key=lambda path: int(path.parent.name)):
        with suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            commands[int(stat.parent.name)] = parent, (stat.parent / "cmdline").read_bytes()
    while more := {number for number, (parent, _) in commands.items() if parent in below} - below:
        below |= more
    return [number for number in below if number in commands and b"raylet/raylet" in commands[number][1]]


@contextmanager
def driver(folder: Path, grasps: int) -> Iterator[subprocess.Popen[str]]:
    """A run on a cluster of its own, whose node runs."""
    script = folder / "driver.py"
    script.write_text(DRIVER)
    path = os.pathsep.join(map(str, [ROOT, ROOT / "src"]))
    with subprocess.Popen([sys.executable, script, folder / "data", str(grasps)], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": path}) as process:
        yield process
        process.kill()


def killed_raylet(process: subprocess.Popen[str], folder: Path, shards: int) -> None:
    """Kill the node when there are so many shards."""
    while process.poll() is None and len(list((folder / "data").glob("*/*/*.parquet"))) < shards:
        time.sleep(0.1)
    while process.poll() is None and not (found := raylets_below(process.pid)):
        time.sleep(0.1)
    for number in found:
        os.kill(number, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_starts")
@pytest.mark.parametrize("shards", [0, 2])
def test_a_node_that_dies_below_its_driver_is_told_and_the_next_run_goes_on(tmp_path, shards):
    with driver(tmp_path, 300) as process:
        killed_raylet(process, tmp_path, shards)
        told = process.communicate(timeout=200)
    assert process.returncode == 1
    assert re.search("error: (the Ray node of this machine died|Ray could not start a node on this machine)", told[1])
    assert told[0] == ""
    made = len(find_shards(tmp_path / "data"))
    assert made >= shards
    with driver(tmp_path, 5 * max(made, 4)) as process:
        process.communicate(timeout=200)
        assert process.returncode == 0
    assert not raylets_below(process.pid)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_starts")
@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_driver_that_is_killed_leaves_no_cluster_behind(tmp_path, sign):
    with driver(tmp_path, 300) as process:
        while not (left := raylets_below(process.pid)):
            time.sleep(0.1)
        process.send_signal(sign)
        process.communicate(timeout=60)
    end = time.monotonic() + 60
    while any(Path(f"/proc/{number}/exe").exists() for number in left) and time.monotonic() < end:
        time.sleep(0.2)
    assert not [number for number in left if Path(f"/proc/{number}/exe").exists()]
