"""Whole commands, from the shell to their files: what a user waits for, start and loading included.

Each runs once uncounted, for the caches of files and of built-in geometry. A new mesh is another one every time: no cache
knows its convex parts and distances.

    python -m lab.benchmarks.commands [--runs N] [--json]
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh

from lab.benchmarks.report import emit, options_of

BUILT_IN = ("generate", "--hand", "allegro", "--object", "rubber_duck", "--output", "grasps.parquet")
NEW = ("generate", "--hand", "allegro", "--object", "new.stl", "--num", "16", "--output", "grasps.parquet")
COMMANDS = {
    "import dro_grasp": (),
    "--help": ("--help",),
    "1 grasp": (*BUILT_IN, "--num", "1"),
    "16 grasps": (*BUILT_IN, "--num", "16"),
    "16 grasps, no trial": (*BUILT_IN, "--num", "16", "--protocol", "none"),
    "16 grasps, the network's first": (*BUILT_IN, "--num", "16", "--source", "network", "--candidates", "1"),
    "16 grasps of a new mesh": NEW,
    "16 grasps of a new mesh, no trial": (*NEW, "--protocol", "none"),
    "16 grasps of a new mesh, the network's first": (*NEW, "--source", "network", "--candidates", "1"),
}
"""Arguments by row; `import dro_grasp` is no command."""
SUBDIVISIONS = 5
"""Of an icosahedron: 20,480 faces."""


def new_mesh(path: Path, seed: int) -> None:
    """A lump of 7 cm with dents, another for every seed."""
    mesh, rng = trimesh.creation.icosphere(SUBDIVISIONS, 0.035), np.random.default_rng(seed)
    waves, phases = rng.normal(0, 60, (4, 3)), rng.uniform(0, 2 * np.pi, 4)
    mesh.vertices *= 1 + 0.06 * np.sin(mesh.vertices @ waves.T + phases).sum(1, keepdims=True)
    mesh.export(path)


def seconds(arguments: tuple[str, ...], folder: Path) -> tuple[float, float]:
    """Time and CPU time of one run [s]."""
    program = ["-m", "dro_grasp", *arguments] if arguments else ["-c", "import dro_grasp"]
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, *program], cwd=folder, check=True, capture_output=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.perf_counter() - begin, used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--runs", type=int, default=3, help="counted runs of each command")
    options = parser.parse_args()
    rows, found, seed = [], {}, time.time_ns()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for row, arguments in COMMANDS.items():
            times = []
            for run in range(options.runs + 1):
                new_mesh(folder / "new.stl", seed := seed + 1)
                spent = seconds(arguments, folder)
                times += [spent] if run else []
            wall, cpu = (statistics.median(part) for part in zip(*times, strict=True))
            rows.append([row, wall, max(t[0] for t in times), cpu])
            found[row] = wall
    emit(f"Allegro hand, built-in rubber duck or a new mesh of 20,480 faces: median of {options.runs} runs", rows,
         ["command", "time [s]", "longest [s]", "CPU time [s]"], found, options.json)


if __name__ == "__main__":
    main()
