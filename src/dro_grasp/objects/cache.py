"""Derived geometry kept on disk under the hash of what it was derived from."""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dro_grasp.errors import OutputError
from dro_grasp.files import replacing

DAMAGED = (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile)
"""What numpy raises on a file that is missing, cut short, or no archive of arrays."""


def cache_folder() -> Path:
    """Where derived geometry is kept: `DRO_GRASP_CACHE`, or the user's cache folder."""
    root = os.environ.get("DRO_GRASP_CACHE")
    return Path(root) if root else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "dro-grasp"


def cached_arrays(key: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Arrays from the cache, or made and stored there.

    A damaged file is made anew. A folder that cannot be written costs time, and is no error.
    """
    path = cache_folder() / f"{key}.npz"
    try:
        with path.open("rb") as file, np.load(file) as stored:
            return {name: stored[name] for name in stored.files}
    except DAMAGED:
        made = make()
    with contextlib.suppress(OSError, OutputError):
        _store(path, made)
    return made


def content_hash(*arrays: np.ndarray) -> str:
    """Hash of geometry: equal arrays of one type have equal hashes on every machine."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _store(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write under a temporary name and rename, so that no reader meets half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
