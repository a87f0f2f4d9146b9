"""The settings that a data set's folder was begun with: whoever fills it further must use the same."""

from __future__ import annotations

import json
import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any

from dro_grasp.datasets.engine.shards import find_shards
from dro_grasp.datasets.engine.worker import Job
from dro_grasp.errors import GraspFileError, OptionError, OutputError
from dro_grasp.files import reading
from dro_grasp.kinds import flat

SETTINGS = "settings.json"
"""File of the settings in a data set's folder."""
FREE = frozenset({
    "seconds", "candidates", "min_candidates", "max_candidates", "max_barren_rounds", "candidate_budget", "max_crashes",
    "shard", "shard_seconds", "synthesis.device"})
"""Settings that a rerun may change: how long it goes on, where, in how large shards, and when it gives up a pair."""


def require_settings(folder: Path, job: Job) -> None:
    """Refuse a job with other settings than those that a folder was begun with; a new folder is begun with the job's.

    The note is there before the first shard. So a folder with shards and without a note is of an earlier version: it is taken
    as it is, and gets none, as nobody knows its settings. Of several processes that begin a folder at once, one writes.

    Raises:
        OptionError: As said; the text names what differs.
        GraspFileError: The note is damaged.
        OutputError: It cannot be written.
    """
    path, asked = folder / SETTINGS, _asked(job)
    found = _noted(path)
    if found is None:
        if not find_shards(folder):
            _write_once(path, json.dumps(asked, indent=1))
        found = _noted(path) or {}
    if differing := [name for name, value in asked.items() if found.get(name, value) != value]:
        made, given = (", ".join(f"{name} {values[name]}" for name in differing) for values in (found, asked))
        raise OptionError(f"{folder} was begun with {made}, {given} was asked for; use the same to go on, or name another "
                          "folder, and join both with `dro-grasp dataset merge`")


def _noted(path: Path) -> dict[str, Any] | None:
    """What the note says; None where there is none."""
    with reading(path, GraspFileError, "the settings of the grasps in its folder; remove it to go on with any"):
        try:
            found = json.loads(path.read_text())
        except FileNotFoundError:
            return None
        if not isinstance(found, dict):
            raise ValueError(f"it holds a {type(found).__name__}")
        return found


def _asked(job: Job) -> dict[str, Any]:
    """What determines the grasps, beside hand, object and the sizes of shards, as plain values by name."""
    values = {"seed": job.seed} | {name: value for name, value in flat(job.config).items() if name not in FREE}
    return json.loads(json.dumps(values, default=str))


def _write_once(path: Path, text: str) -> None:
    """Write a file, whole, unless somebody else has.

    Raises:
        OutputError: It cannot be written.
    """
    temporary = path.with_name(f".{path.name}{secrets.token_hex(4)}.part")
    try:
        temporary.write_text(text)
        try:
            os.link(temporary, path)
        except FileExistsError:
            return
        except OSError:  # a file system without links
            os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; free some space or choose another folder") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
