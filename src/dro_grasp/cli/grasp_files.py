"""Reading the grasp files that commands are given."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel


def load_grasps(path: Path) -> GraspBatch:
    """Read a grasp file that holds at least one grasp.

    Raises:
        GraspFileError: The file is missing, foreign or empty.
    """
    from dro_grasp.errors import GraspFileError
    from dro_grasp.grasps.batch import GraspBatch

    grasps = GraspBatch.load(path)
    if len(grasps) == 0:
        raise GraspFileError(f"{path} holds no grasp; generate again, perhaps without --only-successful")
    return grasps


def load_grasps_of_one_object(
    file: Path, hand_name: str | None, object_name: str | None, scale: float
) -> tuple[Hand, ObjectModel, GraspBatch]:
    """Read the grasps of one object in a file, with hand and object; by default those of the first object.

    Raises:
        DroGraspError: The file, its hand or its object cannot be loaded.
    """
    from dro_grasp.grasps.sources import hand_of, object_of

    grasps = load_grasps(file)
    hand = hand_of(grasps, hand_name)
    name = object_name if object_name in grasps.object else grasps.object[0]
    chosen = dict(grasps.by_object())[name]
    return hand, object_of(chosen, None if object_name == name else object_name, scale), chosen
