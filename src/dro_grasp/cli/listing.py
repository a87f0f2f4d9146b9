"""`dro-grasp hands` and `objects`: names of hands and objects."""

from __future__ import annotations

from dataclasses import dataclass

from dro_grasp.cli.output import Flag, print_json, print_table


@dataclass(frozen=True)
class Hands:
    """List hands by name. Any URDF or MJCF file works as well."""

    json: Flag = False
    """Print one JSON object."""

    def run(self) -> int:
        """Print names and their sources."""
        from dro_grasp.hands.library import hand_names

        names = hand_names()
        if self.json:
            print_json({"hands": names})
        else:
            print_table("hands", ["name", "from"], [[n, o] for n, o in names.items()],
                        note="also: the path of a URDF or MJCF file, or a robot_descriptions name")
        return 0


@dataclass(frozen=True)
class Objects:
    """List objects by name. Any mesh or point cloud file works as well."""

    json: Flag = False
    """Print one JSON object."""

    def run(self) -> int:
        """Print names and splits."""
        from dro_grasp.objects.catalogue import object_names

        names = object_names()
        if self.json:
            print_json({"objects": names})
        else:
            print_table("objects", ["name", "split"], [[n, s] for n, s in names.items()],
                        note="also: the path of a mesh or point cloud")
        return 0
