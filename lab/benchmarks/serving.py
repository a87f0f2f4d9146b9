"""A grasp server under load: several clients ask at once, each again as soon as it has its answer.

Half of the requests name an object, a quarter send a mesh, always the same, and a quarter a cloud that was never seen before.
Each asks for one grasp of the network's, refined. An answer counts if it is the one to its request and holds a grasp of finite
numbers. With as many clients as wait, an answer ideally takes as long as that many lone calls.

    python -m lab.benchmarks.serving [--json] [--clients 8] [--requests 500] [--hand gripper3] [--weights NAME]
"""

from __future__ import annotations

import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from dro_grasp.apps.server.client import GraspClient
from lab.benchmarks.report import emit, options_of

LONE = 12
"""Lone calls that are timed before the load, after as many that are not, and again after it."""
MILLION = 1e6


def started(arguments: Sequence[str]) -> tuple[subprocess.Popen[str], str]:
    """A server on a free port, and its address."""
    command = [sys.executable, "-m", "dro_grasp", "serve", "--port", "0", *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    line = process.stderr.readline()
    if "http://" not in line:
        raise SystemExit(f"the server did not start: {line}{process.stderr.read()}")
    return process, line.split()[2].rstrip(",")


def ask(client: GraspClient, hand: str, number: int, mesh: Path) -> float:
    """Seconds until the answer to the request of a number; infinite if it is wrong."""
    obj: Any = "can" if number % 4 < 2 else mesh
    if number % 4 == 3:
        cloud = trimesh.creation.cylinder(0.03, 0.1).sample(2000, seed=number)
        obj = cloud @ Rotation.random(rng=np.random.default_rng(number)).as_matrix()
    begin = time.perf_counter()
    answer = client.predict(hand, obj, 1, candidates=1, source="network", seed=number, least_confidence=0.0,
                            id=f"load-{number}")
    seconds = time.perf_counter() - begin
    (grasp,) = answer["grasps"]
    whole = answer["id"] == f"load-{number}" and all(map(math.isfinite, [*grasp["joints"], *grasp["wrist_position"]]))
    return seconds if whole else math.inf


def memory(client: GraspClient, process: int) -> tuple[float, float]:
    """Memory of the computing process, as the server tells it, and of the one that talks to clients [MB]."""
    from urllib.request import urlopen

    told = urlopen(f"{client.url}/metrics").read().decode()
    computing = float(next(line for line in told.splitlines() if line.startswith("dro_grasp_process_memory")).split()[1])
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return computing / MILLION, 4096 * pages / MILLION


def main(arguments: Sequence[str] | None = None) -> int:
    """Start a server, load it, print; 1 if an answer is missing or wrong."""
    parser = options_of(__doc__)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--requests", type=int, default=500)
    parser.add_argument("--hand", default="gripper3")
    parser.add_argument("--weights")
    options = parser.parse_args(arguments)
    own = ["--hand", options.hand, *(["--weights", options.weights] if options.weights else [])]
    process, url = started(own)
    client = GraspClient(url, timeout=600.0)
    try:
        with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.clients) as crowd:
            mesh = Path(folder) / "cylinder.stl"
            trimesh.creation.cylinder(0.03, 0.1).export(mesh)
            lone = [ask(client, options.hand, options.requests + number, mesh) for number in range(2 * LONE)][LONE:]
            grown, seconds, begin = [memory(client, process.pid)], [], time.perf_counter()
            for part in np.array_split(np.arange(options.requests), 4):
                seconds += crowd.map(lambda number: ask(client, options.hand, int(number), mesh), part)
                grown.append(memory(client, process.pid))
            whole = time.perf_counter() - begin
            lone += [ask(client, options.hand, options.requests + 2 * LONE + number, mesh) for number in range(LONE)]
    finally:
        process.terminate()
    process.communicate()
    code = process.returncode
    lost = sum(not math.isfinite(value) for value in seconds)
    alone, median = statistics.mean(lone), statistics.median(seconds)
    ratio = median / (options.clients * alone)
    rows = [["lone call, mean [s]", alone], ["answer, median [s]", median], ["answer, longest [s]", max(seconds)],
            [f"median over {options.clients} lone calls", ratio], ["answers a minute", 60 * len(seconds) / whole],
            ["lost or wrong", lost], ["memory, computing, after each quarter [MB]", " ".join(f"{m:.0f}" for m, _ in grown)],
            ["memory, serving, after each quarter [MB]", " ".join(f"{m:.0f}" for _, m in grown)],
            ["exit code after SIGTERM", code]]
    emit(f"{len(seconds)} requests of {options.clients} clients", rows, ["", ""], {
        "lone": alone, "median": median, "longest": max(seconds), "ratio": ratio, "requests": len(seconds), "lost": lost,
        "memory": grown, "exit": code}, options.json)
    return int(lost > 0 or code != 0)


if __name__ == "__main__":
    sys.exit(main())
