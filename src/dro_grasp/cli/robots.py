"""`dro-grasp robot`: the check of a robot description, and the names of the built-in robots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.output import print_json, print_result, say


@dataclass(frozen=True)
class CheckRobot:
    """Check a robot description: chains, limits, reach, what collides; and draw it.

    Example: dro-grasp robot check robot.yaml --picture robot.png
    """

    robot: tyro.conf.Positional[str]
    """A robot file, or the name of a built-in robot."""
    picture: Annotated[Path | None, optional("PNG", "none")] = None
    """PNG file with the robot at home, its table, and where its camera looks."""
    json: Flag = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        """Check, print, draw."""
        from dro_grasp.files import check_output
        from dro_grasp.planning.robot_check import check_robot, draw_robot

        if self.picture is not None:
            check_output(self.picture, ".png")
        report = check_robot(self.robot)
        if self.picture is not None:
            draw_robot(report.robot, self.picture)
        if self.json:
            print_json({**report.to_dict(), "picture": None if self.picture is None else str(self.picture)})
        else:
            for line in [*report.lines(), *([f"picture: {self.picture}"] if self.picture else [])]:
                say(line)
        return 0 if report.usable else 2


@dataclass(frozen=True)
class Robots:
    """List the built-in robots. Any other is a robot file."""

    json: Flag = False
    """Print one JSON object."""

    def run(self) -> int:
        """Print the names."""
        from dro_grasp.planning.robot import robot_names

        names = robot_names()
        print_result(self.json, {"robots": names}, "robots", ["name"], [[n] for n in names], "also: the path of a robot.yaml")
        return 0


@dataclass(frozen=True)
class RobotCommand:
    """Check and list robots: arms that carry a hand."""

    command: Annotated[CheckRobot, tyro.conf.subcommand("check")] | Annotated[Robots, tyro.conf.subcommand("list")]
