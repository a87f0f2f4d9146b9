"""`dro-grasp hands` and `objects`: names of hands and objects."""

from __future__ import annotations

from dataclasses import dataclass

from dro_grasp.cli.inputs import Flag
from dro_grasp.cli.output import print_result


@dataclass(frozen=True)
class Hands:
    """List hands by name. Any URDF or MJCF file works as well."""

    json: Flag = False  # Print one JSON object.

    def run(self) -> int:
        """Print names and their sources."""
        from dro_grasp.hands.library import hand_names

        names = hand_names()
        print_result(self.json, {"hands": names}, "hands", ["name", "from"], [*names.items()],
                     "also: the path of a URDF or MJCF file, FILE#LINK of a whole robot, or a robot_descriptions name")
        return 0


@dataclass(frozen=True)
class Objects:
    """List objects by name. Any mesh or point cloud file works as well."""

    json: Flag = False  # Print one JSON object.

    def run(self) -> int:
        """Print names and splits."""
        from dro_grasp.objects.catalogue import object_names

        names = object_names()
        print_result(self.json, {"objects": names}, "objects", ["name", "split"], [*names.items()],
                     "also: the path of a mesh or point cloud, or procedural_SEED for an object that a seed draws")
        return 0
