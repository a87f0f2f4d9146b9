"""The data engine on a Ray cluster of several nodes, one of which is unplugged; in a process of its own, as Ray lingers."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
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
        subprocess.run([sys.executable, "-c", start], capture_output=True, timeout=90, check=True)
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


def test_without_ray_the_engine_says_what_to_install(monkeypatch):
    from dro_grasp.training.data.engine.pools import RayPool
    from dro_grasp.training.data.engine.worker import EngineConfig

    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(OptionError, match=r"pip install 'dro-grasp\[ray\]'"):
        RayPool(Job(0, EngineConfig()), 1, 60.0)
