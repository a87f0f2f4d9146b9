"""Derived geometry on disk, under the hash of its source."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Num

from dro_grasp.errors import OutputError
from dro_grasp.files import FOREIGN, given_path, replacing

Arrays = dict[str, Num[np.ndarray, "..."]]  # Arrays by name, as in an NPZ file


def cache_folder() -> Path:
    """The folder of derived geometry: `DRO_GRASP_CACHE`, or the user's cache folder."""
    root = os.environ.get("DRO_GRASP_CACHE")
    if root:
        return given_path(root)
    stated = Path(os.environ.get("XDG_CACHE_HOME", ""))  # by its specification an empty or relative one does not count
    return (stated if stated.is_absolute() else Path.home() / ".cache") / "dro-grasp"


def cached_arrays(key: str, make: Callable[[], Arrays]) -> Arrays:
    """Load arrays from the cache, or make and store them."""
    stored = stored_arrays(key)
    if stored is not None:
        return stored
    made = make()
    store_arrays(key, made)
    return made


def stored_arrays(key: str) -> Arrays | None:
    """Arrays from the cache; None where there are none, or where their file is damaged."""
    try:
        with (cache_folder() / f"{key}.npz").open("rb") as file, np.load(file) as stored:
            return {name: stored[name] for name in stored.files}
    except (*FOREIGN, RuntimeError):  # missing, truncated, no archive of arrays, or of a user without a home
        return None


def store_arrays(key: str, arrays: Arrays) -> None:
    """Put arrays into the cache. A folder that is unknown or cannot be written is no error; it only costs time."""
    with contextlib.suppress(OSError, OutputError, RuntimeError):
        path = cache_folder() / f"{key}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]


def content_hash(*arrays: Num[np.ndarray, "..."]) -> str:
    """SHA-256 of arrays; the hashes of equal arrays of one type agree on every machine."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
