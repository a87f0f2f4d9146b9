"""A run that cleared a table, kept in one file: motions, what the camera saw, what the joints said, what each pick became."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from dro_grasp.arm.clearing.loop import Pick, Rig
from dro_grasp.arm.planning.motion import Trajectory
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.animation import Recorder
from dro_grasp.errors import PlanError
from dro_grasp.files import UNTYPED, check_output, given_path, reading, replacing
from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.grasps.hold import HoldCheck, HoldState

FORMAT = 1  # Version of files of such runs
KIND = "cleared table"  # Entry `kind` of their header
WANTED = "a record of a cleared table (.npz), as `dro-grasp clear --record` writes it"  # What a reader expects
KEPT = 0.003  # Edge of the cubes of which one point each is kept [m] (ours)
RATE = 10.0  # Moments that are kept for each second (ours)

Shape = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]  # Vertices [m] and triangles


@dataclass(frozen=True)
class Look:
    """The camera has looked."""

    moment: int  # Index of the moment at which it happened, as of the other events
    cloud: int  # Number of the cloud


@dataclass(frozen=True)
class Judgement:
    """Whether the hand held something was judged by its joints."""

    moment: int
    state: HoldState
    confidence: float
    held: bool | None = None  # Whether it really held something; None where nobody knows


@dataclass(frozen=True)
class Picked:
    """A pick has ended."""

    moment: int
    place: tuple[float, float]  # Where the thing stood [m]
    stage: str  # As of `Pick`
    reason: str  # Likewise


Event = Look | Judgement | Picked


@dataclass(frozen=True, eq=False)
class ClearRecord:
    """What a robot did to clear its table, moment by moment."""

    robot: str
    """Name of the robot, or its file."""
    robot_sha256: str
    """Its hash."""
    rate: float
    """Moments in a second [1/s]."""
    arm: Float[np.ndarray, "k n_arm"]
    """Joints at each moment [rad or m]."""
    hand: Float[np.ndarray, "k n_dof"]
    """Likewise."""
    poses: Float[np.ndarray, "k o 4 4"]
    """Of the objects in the world [m], where they are known, as in simulation."""
    names: tuple[str, ...]
    """Of the objects."""
    objects: tuple[Shape, ...]
    """Their meshes."""
    fixtures: tuple[Shape, ...]
    """Meshes of what does not move, such as the bin, in the world."""
    clouds: tuple[Float[np.ndarray, "_ 3"], ...]
    """What the camera saw at each look, in its frame [m]."""
    events: tuple[Event, ...]
    """What happened, in its order."""

    def save(self, path: Path | str) -> None:
        """Write a file (NPZ); it appears whole or not at all.

        Raises:
            OutputError: The path cannot be written.
        """
        events = [{"what": type(event).__name__, **asdict(event)} for event in self.events]
        header = {"kind": KIND, "format_version": FORMAT, "robot": self.robot, "robot_sha256": self.robot_sha256,
                  "rate": self.rate, "objects": self.names, "fixtures": len(self.fixtures), "events": events}
        arrays = {"arm": self.arm, "hand": self.hand, "poses": self.poses}
        arrays |= {f"cloud_{i}": cloud for i, cloud in enumerate(self.clouds)}
        for kind, shapes in (("object", self.objects), ("fixture", self.fixtures)):
            for i, (vertices, faces) in enumerate(shapes):
                arrays |= {f"{kind}_{i}_vertices": vertices, f"{kind}_{i}_faces": faces.astype(np.int32)}
        arrays = {name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in arrays.items()}
        with replacing(check_output(path, ".npz"), "record") as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, header=np.array(json.dumps(header)), allow_pickle=False, **arrays)

    @staticmethod
    def load(path: Path | str) -> ClearRecord:
        """Read such a file.

        Raises:
            PlanError: No such file, or a truncated or foreign one, or one of another version.
        """
        path = given_path(path)
        with reading(path, PlanError, WANTED, *UNTYPED), path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            header: dict[str, Any] = json.loads(str(file["header"]))
            if header.get("kind") != KIND or header.get("format_version") != FORMAT:
                raise PlanError(f"{path} is no record of a cleared table, or one of another version; record again")
            events = tuple(_event(row) for row in header["events"])

            def shapes(kind: str, count: int) -> tuple[Shape, ...]:
                return tuple((file[f"{kind}_{i}_vertices"], file[f"{kind}_{i}_faces"]) for i in range(count))

            looks = sum(isinstance(event, Look) for event in events)
            return ClearRecord(
                header["robot"], header["robot_sha256"], float(header["rate"]), file["arm"], file["hand"], file["poses"],
                tuple(header["objects"]), shapes("object", len(header["objects"])), shapes("fixture", header["fixtures"]),
                tuple(file[f"cloud_{i}"] for i in range(looks)), events)


def is_record(path: Path) -> bool:
    """Whether a file (.npz) holds a cleared table, and no plan."""
    if not path.is_file():
        return False
    try:
        with reading(path, PlanError, WANTED, *UNTYPED), path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            return json.loads(str(file["header"])).get("kind") == KIND
    except PlanError:
        return False


def _event(row: dict[str, Any]) -> Event:
    kinds: dict[str, type[Event]] = {kind.__name__: kind for kind in (Look, Judgement, Picked)}
    kind = kinds[row.pop("what")]
    if "place" in row:
        row["place"] = tuple(row["place"])
    return kind(**row)


@dataclass
class ClearRecorder(Recorder):
    """Keeps a run while it happens: `looked`, `judged` and `picked` are told of it, and `moved` where it is simulated."""

    rate: float = RATE
    clouds: list[Float[np.ndarray, "n 3"]] = field(default_factory=list)  # [m]
    events: list[Event] = field(default_factory=list)

    def looked(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Keep what the camera sees, in its frame, one point of each cube of KEPT [m]."""
        self.events.append(Look(self._moment, len(self.clouds)))
        points = points[np.isfinite(points).all(1)]
        self.clouds.append(points[one_per_cell(points, KEPT)] if len(points) else points)

    def judged(self, check: HoldCheck, held: bool | None = None) -> None:
        """Keep what was made of the joints, and whether something was really held, where that is known."""
        self.events.append(Judgement(self._moment, check.state, check.confidence, held))

    def picked(self, pick: Pick) -> None:
        """Keep what became of a pick."""
        self.events.append(Picked(self._moment, pick.place, pick.stage, pick.reason))

    @property
    def _moment(self) -> int:
        return max(0, len(self.frames) - 1)

    def record(self, robot: Robot) -> ClearRecord:
        """What was kept.

        Raises:
            PlanError: Nothing has moved.
        """
        if not self.frames:
            raise PlanError("nothing has moved, so there is nothing to keep: the camera saw nothing to pick, or no plan worked")
        arm, hand, poses = (np.stack(part) for part in zip(*self.frames, strict=True))
        meshes = [[(o.vertices, o.faces) for o in things if o.vertices is not None and o.faces is not None]
                  for things in (self.objects, self.fixtures)]
        return ClearRecord(
            robot.source or robot.name, robot.sha256, self.rate, arm, hand, poses, tuple(obj.name for obj in self.objects),
            tuple(meshes[0]), tuple(meshes[1]), tuple(self.clouds), tuple(self.events))


class RecordedRig:
    """A rig of yours that is recorded: it does the same, and a recorder is told of looks and motions.

    Examples:
        >>> recorder = ClearRecorder()
        >>> rig = RecordedRig(my_rig, recorder)
        >>> clear_table(robot, rig, judged=recorder.judged, progress=recorder.picked)
        >>> recorder.record(robot).save("cleared.npz")
    """

    def __init__(self, rig: Rig, recorder: ClearRecorder) -> None:
        self._rig, self._recorder = rig, recorder
        self._due = 0.0  # When the next moment is to be kept, from the begin of the next motion on [s]

    def look(self) -> Float[np.ndarray, "n 3"]:
        """As of `Rig`."""
        points = self._rig.look()
        self._recorder.looked(points)
        return points

    def move(self, arm: Trajectory, hand: Trajectory) -> None:
        """As of `Rig`; what is commanded is kept."""
        self._rig.move(arm, hand)
        times = np.arange(self._due, arm.seconds, 1 / self._recorder.rate)
        self._due += len(times) / self._recorder.rate - arm.seconds
        self._recorder.frames += [(_at(arm, time), _at(hand, time), np.zeros((0, 4, 4))) for time in times]

    def joints(self) -> tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_dof"]]:
        """As of `Rig`."""
        return self._rig.joints()


def _at(part: Trajectory, time: float) -> Float[np.ndarray, " n"]:
    return np.array([np.interp(time, part.time, column) for column in part.position.T])

