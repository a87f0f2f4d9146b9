"""Libraries of a prediction, loaded in less time than one after the other."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import importlib.util
import sys
import threading
from pathlib import Path

TORCH = "torch"  # Module that takes the longest to load
OTHERS = ("numpy", "scipy.spatial", "dro_grasp.geometry.mesh_files", "mujoco")  # What does not need PyTorch
ALLOCATIONS = 50_000
"""New objects after which Python looks for unused cycles (ours), of which loading leaves none; its own number is 700."""


def load_libraries() -> None:
    """Load PyTorch and the rest. Nothing but the time depends on it."""
    gc.set_threshold(ALLOCATIONS)
    if TORCH in sys.modules:
        return
    beside = threading.Thread(target=_open_torch, daemon=True)
    beside.start()
    for name in OTHERS:
        importlib.import_module(name)
    beside.join()
    importlib.import_module(TORCH)


def _open_torch() -> None:
    """Map PyTorch's library, for which Python need not wait. One with CUDA is left alone: it has an order of its own."""
    found = importlib.util.find_spec(TORCH)
    folder = Path(found.origin).parent / "lib" if found and found.origin else Path()
    if (library := folder / "libtorch_cpu.so").is_file() and not (folder / "libtorch_cuda.so").exists():
        with contextlib.suppress(OSError):  # PyTorch says better what is wrong
            ctypes.CDLL(str(library))
