"""`dro-grasp hands`, `objects` and `hand`: names of hands and objects, and the check of a description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.hand_make import Make
from dro_grasp.cli.hand_vary import Vary
from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.output import print_json, print_result, say


@dataclass(frozen=True)
class Hands:
    """List hands by name. Any URDF or MJCF file works as well."""

    json: Flag = False
    """Print one JSON object."""

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

    json: Flag = False
    """Print one JSON object."""

    def run(self) -> int:
        """Print names and splits."""
        from dro_grasp.objects.catalogue import object_names

        names = object_names()
        print_result(self.json, {"objects": names}, "objects", ["name", "split"], [*names.items()],
                     "also: the path of a mesh or point cloud, or procedural_SEED for an object that a seed draws")
        return 0


@dataclass(frozen=True)
class Check:
    """Check a hand description: report what is derived from it and what is wrong with it, and draw it.

    Example: dro-grasp hand check my_hand.urdf --picture my_hand.png
    """

    hand: tyro.conf.Positional[str]
    """Name of a hand, or path of a URDF or MJCF file; FILE#LINK for the hand of a whole robot, by its first link."""
    picture: Annotated[Path | None, optional("PNG", "none")] = None
    """PNG file with the hand open and closed, its palm direction and its contact links."""
    json: Flag = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        """Check, print, draw."""
        from dro_grasp.files import check_output
        from dro_grasp.hands.check import check_hand, picture

        if self.picture is not None:
            check_output(self.picture, ".png")
        report = check_hand(self.hand)
        if self.picture is not None:
            picture(report.hand, self.picture)
        if self.json:
            print_json({**report.to_dict(), "picture": None if self.picture is None else str(self.picture)})
            return 0
        for line in report.lines():
            say(line)
        if self.picture is not None:
            say(f"picture: {self.picture}")
        return 0


@dataclass(frozen=True)
class HandCommand:
    """Check, make, vary and list hands."""

    command: (
        Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Make, tyro.conf.subcommand("make")]
        | Annotated[Vary, tyro.conf.subcommand("vary")]
        | Annotated[Hands, tyro.conf.subcommand("list")]
    )
