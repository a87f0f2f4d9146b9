"""The process that cuts one mesh into convex parts; `cutting` starts it, watches it, and reads what it leaves."""

from __future__ import annotations

import ctypes
import math
import os
import resource
import signal
import sys
from typing import Any

import numpy as np
from jaxtyping import Float, Int

ENDS_WITH_PARENT = 1  # PR_SET_PDEATHSIG. Source: Linux's prctl(2)


def main(parent: str, method: str, source: str, target: str, seconds: str) -> None:
    """Cut the mesh in one file by a method, and store the parts in another, within some seconds of computing.

    It ends with the process that started it, whose number is `parent`.
    """
    ctypes.CDLL(None).prctl(ENDS_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != int(parent):  # it ended while this one was starting
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Python's own handler waits until the library returns
    limit = math.ceil(float(seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
    with np.load(source) as stored:
        mesh = {name: stored[name] for name in stored.files}
    vertices, faces, options = mesh.pop("vertices"), mesh.pop("faces"), {name: value.item() for name, value in mesh.items()}
    parts = {"coacd": _coacd, "vhacd": _vhacd}[method](vertices, faces, options)
    with open(target, "wb") as file:
        np.savez(file, **{f"{what}{i}": array for i, part in enumerate(parts)  # type: ignore[arg-type]
                          for what, array in zip("vf", part, strict=True)})


def _coacd(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], options: dict[str, Any]) -> list[Any]:
    import coacd

    coacd.set_log_level("error")
    return coacd.run_coacd(coacd.Mesh(vertices, faces), **options)


def _vhacd(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], options: dict[str, Any]) -> list[Any]:
    from vhacdx import compute_vhacd

    rows = np.column_stack([np.full(len(faces), 3), faces]).ravel().astype(np.uint32)  # as VTK writes polygons
    parts = compute_vhacd(np.ascontiguousarray(vertices, np.float64), rows, **options)
    return [(corners, triangles.astype(np.int32)) for corners, triangles in parts]


if __name__ == "__main__":
    main(*sys.argv[1:])
