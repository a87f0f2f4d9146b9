"""Cutting a mesh into convex parts in a process of its own: it can be watched, and ends with a limit of time."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float, Int

from dro_grasp.errors import OutputError
from dro_grasp.files import MAX_QUOTED_CHARS
from dro_grasp.geometry.mesh_files import trimesh

LOOK_EVERY = 0.5  # Time between looks at the process [s] (ours)

Part = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]  # Vertices [m] and faces of a convex part
Spent = Callable[[float], None]  # Called now and then with the computing time spent so far [s]


class CutShortError(Exception):
    """The process ended without parts; says why, whether its time was over, and whether it might do better another time."""

    def __init__(self, why: str, over: bool = False, chance: bool = False):
        super().__init__(why)
        self.over, self.chance = over, chance


def cut_apart(
    method: str, mesh: trimesh.Trimesh, seconds: float, spent: Spent, **options: float | int | bool | str
) -> list[Part]:
    """Convex parts of a closed mesh by `coacd` or `vhacd`, within some seconds of computing; CutShortError without any.

    OutputError: there is no room for temporary files.
    """
    given = {"vertices": mesh.vertices, "faces": mesh.faces, **options}
    with contextlib.ExitStack() as stack:
        try:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="dro-grasp-")))
            source, target = folder / "mesh.npz", folder / "parts.npz"
            np.savez(source, **{name: np.asarray(value) for name, value in given.items()})  # type: ignore[arg-type]
        except OSError as error:
            raise OutputError(f"a mesh cannot be cut into convex parts: its temporary file cannot be written "
                              f"({error.strerror or error}); free some space, or name another folder in TMPDIR") from error
        _run([method, str(source), str(target), str(seconds)], spent)
        with np.load(target) as stored:
            found = [(stored[f"v{i}"], stored[f"f{i}"]) for i in range(len(stored.files) // 2)]
    if not found:
        raise CutShortError("it found none")
    return found


def _run(arguments: list[str], spent: Spent) -> None:
    words = [sys.executable, "-P", "-m", "dro_grasp.objects.cutting_process", str(os.getpid()), *arguments]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        process = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    except OSError as error:
        raise CutShortError(f"no process can be started: {error.strerror}", chance=True) from error
    with process:
        try:
            said = _watched(process, spent)
        finally:
            process.kill()
    if process.returncode == -signal.SIGXCPU:
        raise CutShortError("its time was over", over=True)
    if process.returncode:
        lines = [line for line in said.decode("utf-8", "replace").split("\n") if line.strip()]
        why = lines[-1] if lines else f"it ended with code {process.returncode}"
        raise CutShortError(why[:MAX_QUOTED_CHARS], chance=process.returncode == -signal.SIGKILL)


def _watched(process: subprocess.Popen[bytes], spent: Spent) -> bytes:
    """What a process writes as errors until it ends."""
    while True:
        try:
            return process.communicate(timeout=LOOK_EVERY)[1]
        except subprocess.TimeoutExpired:
            spent(_computing_time(process.pid))


def _computing_time(process: int) -> float:
    """Processor time of a process [s]; 0 if it is over."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        # User and system time are the entries 14 and 15; a name in parentheses, which may hold spaces, is the second.
        entries = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(entries[11]) + int(entries[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0
