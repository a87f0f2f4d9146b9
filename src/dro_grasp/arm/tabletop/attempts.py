"""What became of attempts: one by one, in a file, and counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dro_grasp.arm.planning.motion import PLACING
from dro_grasp.errors import GraspFileError
from dro_grasp.files import locking, reading, replacing
from dro_grasp.grasps.grasp_file import read_parquet


@dataclass(frozen=True)
class Attempt:
    """What became of one attempt; plain values."""

    robot: str
    object: str
    number: int
    """Number of the attempt with this object, from 0."""
    seed: int
    """Seed of all draws."""
    settings: str
    """Version and every setting, as `TabletopConfig.label`."""
    success: bool = False
    """Whether the object was held to the end, or stands at its place."""
    stage: str = "see"
    """Where it ended: see, plan, one of the motion's stages, hold, shake, place, or done."""
    reason: str = ""
    """Why it failed."""
    place: str = "[]"
    """JSON: the object's pose at rest in the world [m]."""
    raised: float = 0.0
    """How much higher the object was at the end than at rest [m]."""
    score: float = float("nan")
    """Score of the grasp [log-odds of holding]."""
    rehearsed: float | None = None
    """Share of its rehearsed lifts in which the grasp held the object; None where nothing was rehearsed."""
    grasps: int = 0
    """Grasps to choose from."""
    dropped: str = "{}"
    """JSON: how many were dropped, by reason."""
    see_seconds: float = 0.0
    """From the depth image to the object's cloud [s]."""
    plan_seconds: float = 0.0
    """From the cloud to the timed plan [s]."""
    grasp_seconds: float = 0.0
    """Part of `plan_seconds` for proposing and refining grasps [s]."""
    processor_seconds: float = 0.0
    """Time of one core from the depth image to the timed plan [s]; the other times are by the clock."""
    motion_seconds: float = 0.0
    """Duration of the planned motion [s]."""
    place_error: float | None = None
    """Distance of the placed object's centre of mass from where it should be [m]; None if it was not placed."""
    place_tilt: float | None = None
    """Angle between the placed object's upright and the one it had [degrees], likewise."""
    place_turn: float | None = None
    """How far it is turned about the vertical from what was planned [degrees], likewise."""
    pushes: int = 0
    """How often it was pushed towards an edge of the table before it was grasped."""
    pushed: float = 0.0
    """Largest displacement of another object [m]."""
    robot_file: str = ""
    """Name or file that the robot was loaded from."""
    object_file: str = ""
    """Name or file that the object was loaded from."""
    weights: str = ""
    """Name or file of the weights."""
    robot_sha256: str = ""
    """Hash of the robot with its arm and hand. All four hashes are empty where attempts are made one by one."""
    object_sha256: str = ""
    """Hash of the mesh."""
    weights_sha256: str = ""
    """Hash of the weights file."""
    solid_sha256: str = ""
    """Hash of what was simulated of the object. The same mesh may be cut into other convex parts."""

    @property
    def moved(self) -> bool:
        """Whether the robot carried out a motion."""
        return self.pushes > 0 or self.stage not in {"see", "plan"}


def write_attempts(attempts: Sequence[Attempt], path: Path) -> None:
    """Write all attempts to a Parquet file, which appears whole or not at all."""
    with replacing(path, "attempts") as temporary:
        pq.write_table(pa.Table.from_pylist([asdict(a) for a in attempts]), temporary)


def sole_writer(path: Path) -> AbstractContextManager[None]:
    """Keep a second run out of the file while the block lasts, by an OutputError: it would drop what this one stores."""
    return locking(path.with_name(f".{path.name}.lock"), lambda: (
        f"another run is storing its attempts in {path}; wait for it, or give another file"))


def read_attempts(path: Path) -> list[Attempt]:
    """Read such a file."""
    known = {f.name for f in fields(Attempt)}
    expected = "a file of attempts; name another one, or move this one away"
    with reading(path, GraspFileError, expected, pa.ArrowException, TypeError):  # which names the columns that are missing
        return [Attempt(**{k: v for k, v in row.items() if k in known}) for row in read_parquet(path).to_pylist()]


def lifted(attempts: Sequence[Attempt]) -> list[Attempt]:
    """Those whose object was in the air, of attempts that put it down."""
    return [a for a in attempts if a.stage in {*PLACING, "place", "done"}]


def placing_errors(attempts: Sequence[Attempt]) -> dict[str, float] | None:
    """Median errors of the placed objects [m and degrees], and the number placed; None if none was."""
    rows = [(a.place_error, a.place_tilt or 0.0) for a in attempts if a.place_error is not None]
    if not rows:
        return None
    error, tilt = np.median(rows, axis=0).tolist()
    return {"error": error, "tilt": tilt, "n": len(rows)}


def endings(attempts: Sequence[Attempt]) -> dict[str, int]:
    """How many attempts ended in each stage, the successful ones as `done`."""
    return dict(Counter(a.stage for a in attempts))


def failures(attempts: Sequence[Attempt]) -> list[str]:
    """One line for each failure."""
    return [f"{a.object}, attempt {a.number}, {a.stage}: {a.reason}" for a in attempts if not a.success]


def processor_seconds(attempts: Sequence[Attempt]) -> dict[str, float] | None:
    """Time of one core from depth image to timed plan [s], of attempts that were planned; None if none was."""
    seconds = [a.processor_seconds for a in attempts if a.processor_seconds > 0]
    if not seconds:
        return None
    return {"median": float(np.median(seconds)), "within_95": float(np.quantile(seconds, 0.95)), "n": len(seconds)}
