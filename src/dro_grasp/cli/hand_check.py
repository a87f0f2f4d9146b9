"""`dro-grasp hand`: work with hand descriptions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.listing import Hands
from dro_grasp.cli.output import optional, print_json, say


@dataclass(frozen=True)
class Check:
    """Say what was derived from a hand description and what is wrong with it, and draw it.

    Example: dro-grasp hand check my_hand.urdf --picture my_hand.png
    """

    hand: tyro.conf.Positional[str]
    """A hand's name or the path of its URDF or MJCF file."""
    picture: Annotated[Path | None, optional("PNG", "none")] = None
    """PNG of the hand open and closed, with palm direction and contact links."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        """Check, print, draw."""
        from dro_grasp.files import check_output
        from dro_grasp.hands.check import check_hand, picture

        if self.picture is not None:
            check_output(self.picture)
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
    """Work with hand descriptions."""

    command: Annotated[Check, tyro.conf.subcommand("check")] | Annotated[Hands, tyro.conf.subcommand("list")]

    def run(self) -> int:
        """Run the subcommand."""
        return self.command.run()
