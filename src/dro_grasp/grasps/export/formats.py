"""The export formats by name: a new one is one entry here, and one in `writers.WRITERS`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.grasps.export.writers import Frame
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel


@dataclass(frozen=True)
class ExportJob:
    """Grasps of one object on their way into another program's format."""

    grasps: GraspBatch  # each states pregrasp and squeeze
    frame: Frame
    hand: Hand | None = None  # the grasps' hand, for formats that need it
    object_path: str = ""  # file or name of the object
    object_scale: float = 1.0  # scale of that file
    obj: ObjectModel | None = None  # the object itself, for formats that show it


@dataclass(frozen=True)
class ExportFormat:
    """One format and how its files are called."""

    name: str  # name in FORMATS and WRITERS
    title: str
    suffix: str
    explanation: str  # what the files hold
    needs_hand: bool = False  # whether it writes more of the hand than its name
    needs_object: bool = False  # whether it writes more of the object than its file's name
    file_per_grasp: bool = False  # whether an object becomes a folder with one file per grasp

    def content(self, job: ExportJob) -> bytes | list[bytes]:
        """The object's file, or one file per grasp."""
        from dro_grasp.grasps.export.writers import WRITERS  # with PyTorch, which lists of choices do without

        return WRITERS[self.name](job)


FORMATS = {
    "isaac_grasp": ExportFormat("isaac_grasp", "isaac_grasp (YAML)", ".yaml", "YAML 1.0 for Isaac Sim and Isaac ROS"),
    "moveit": ExportFormat("moveit", "MoveIt (YAML)", ".yaml", "moveit_msgs/Grasp as YAML", needs_hand=True),
    "dexgraspbench": ExportFormat(
        "dexgraspbench", "DexGraspBench (NPY)", ".npy", "one npy file per grasp, in a folder", file_per_grasp=True),
    "csv": ExportFormat("csv", "table (CSV)", ".csv", "one line per grasp"),
    "usd": ExportFormat(
        "usd", "USD stage", ".usd", "object, hand and grasps as a USD stage (extra `usd`)", needs_hand=True, needs_object=True),
}
"""All formats, in the order of lists of choices."""
