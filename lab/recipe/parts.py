"""Files of a folder, made side by side, each whole or not at all: what is there is not made again."""

from __future__ import annotations

import hashlib
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch

from dro_grasp.files import replacing
from dro_grasp.training.data.engine.pools import LocalPool
from dro_grasp.training.data.engine.shards import Failed, Shard, Yield
from dro_grasp.training.data.engine.worker import FinishedShard

LIMIT = 3600.0
"""Longest time that a file may take [s]."""
FEW = 0.03
"""Share of the files that may fail."""
Task = tuple[Path, Any]
"""The file to make, and of what."""
Make = Callable[[Any, Any], tuple[Any, str]]
"""What a file holds, and what to print of it, from what all files share and what this one is made of."""


def fill(make: Make, shared: Any, tasks: Iterable[Task], workers: int = 1, minutes: float = math.inf) -> None:
    """Make the files that are missing in so many processes; no new one is begun when the time is over.

    One that fails is told and tried once more. The run ends with exit code 1 where more than FEW of the files failed twice;
    the next run tries these again.
    """
    every = list(tasks)
    end, missing = time.monotonic() + 60 * minutes, {path: given for path, given in every if not path.exists()}
    pool = LocalPool((make, shared), max(1, min(workers, len(missing))), LIMIT, _write)
    flying, waiting, failed = 0, list(reversed(missing.items())), Counter[Path]()
    try:
        while waiting or flying:
            while waiting and pool.free and time.monotonic() < end:
                pool.submit(waiting.pop())
                flying += 1
            if not flying:
                break
            for (path, given), told in pool.wait(60.0):
                flying -= 1
                print(f"{path.stem}: {told.reason if isinstance(told, Failed) else told.payload.decode()}", flush=True)
                if isinstance(told, Failed):
                    failed[path] += 1
                    waiting += [(path, given)] if failed[path] == 1 else []
    finally:
        pool.close()
    lost = [path.stem for path, times in failed.items() if times > 1]
    if len(lost) > FEW * len(every):
        raise SystemExit(f"{len(lost)} of {len(every)} failed twice, such as {lost[0]}; see why above, and run it again")


def _write(job: tuple[Make, Any], task: Task) -> FinishedShard:
    """Make a file; what to print of it travels back where the grasps of a shard would."""
    (make, shared), (path, given) = job, task
    begin = time.monotonic()
    content, told = make(shared, given)
    with replacing(path) as temporary:
        torch.save(content, temporary)
    return FinishedShard(Shard(path.stem, "", 0), f"{told}, {time.monotonic() - begin:.0f} s".encode(), Yield())


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def fingerprint(paths: Iterable[Path]) -> str:
    """Twelve digits that tell files of other content apart, and folders of other such files."""
    digest = hashlib.sha256()
    for path in paths:
        for file in sorted(f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]:
            digest.update(file.relative_to(path).as_posix().encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:12]
