"""`dro-grasp hand`: hands checked, mirrored or scaled, and made."""

from __future__ import annotations

import csv
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.listing import Hands
from dro_grasp.cli.output import print_json, print_report, print_table, progress_bar, say, say_file
from dro_grasp.errors import OptionError, OutputError
from dro_grasp.files import check_output, command, make_folder, reading, replacing
from dro_grasp.kinds import require_positive

if TYPE_CHECKING:
    from dro_grasp.training.made_hands.making import MadeHand

LISTING = "hands.csv"  # File in the folder that lists its hands

COLUMNS = {"name": "name", "family": "family", "fingers": "fingers", "side": "side", "palm": "palm", "joints": "joints",
           "mimic_joints": "mimic", "folds_back": "folds back", "redrawn": "redrawn"}
"""Columns of the table, by their names in the listing."""


@dataclass(frozen=True)
class Make:
    """Make hands that do not exist, each a URDF of boxes, cylinders and spheres that can grasp.

    Example: dro-grasp hand make --seed 0 --num 24 --output hands --picture hands.png
    """

    output: Path  # Folder for hand_00000.urdf and so on, numbered by seed, and the listing hands.csv; created if missing.
    seed: int = 0  # Seed of the first hand; each following hand has the next one. A seed always gives the same hand.
    num: int = 24  # How many hands.
    picture: Annotated[Path | None, optional("PNG", "none")] = None  # PNG file with a picture of each hand.
    overwrite: Flag = False  # Replace files of these names, which are refused otherwise.
    json: Flag = False  # Print one JSON object instead of a table.

    def run(self) -> int:
        """Make, write, list and draw."""
        from dro_grasp.training.made_hands.making import hand_name, make_hand

        require_positive(num=self.num)
        if self.seed < 0:
            raise OptionError(f"--seed is {self.seed}; give 0 or more")
        if self.picture is not None:
            check_output(self.picture, ".png")
        folder = make_folder(self.output)
        seeds = range(self.seed, self.seed + self.num)
        files = [folder / f"{hand_name(seed)}.urdf" for seed in seeds]
        there = [file for file in files if file.exists()]
        if there and not self.overwrite:
            raise OutputError(f"{len(there)} of {len(files)} files exist (first: {there[0]}); give --overwrite to replace "
                              "them, or another --seed or folder")
        listing, made = _listing(folder / LISTING), []
        with progress_bar("making hands", self.json) as progress:
            for seed, file in zip(seeds, files, strict=True):
                made.append(make_hand(seed))
                with replacing(file) as temporary:
                    temporary.write_text(made[-1].urdf, encoding="utf-8")
                if progress is not None:
                    progress(len(made), self.num)
        listing |= {hand.name: hand.facts() for hand in made}
        with replacing(folder / LISTING) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(made[0].facts()), extrasaction="ignore")
            writer.writeheader()
            writer.writerows(listing[name] for name in sorted(listing))
        if self.picture is not None:
            _draw(files, made, self.picture)
        self._report(made)
        return 0

    def _report(self, made: list[MadeHand]) -> None:
        rows = [hand.facts() for hand in made]
        reasons = Counter(reason for hand in made for reason in hand.redrawn)
        if self.json:
            print_json({"output": str(self.output), "hands": rows, "redrawn": dict(reasons.most_common()),
                        "picture": None if self.picture is None else str(self.picture)})
            return
        print_table("hands made", list(COLUMNS.values()), [[row[name] for name in COLUMNS] for row in rows])
        told = ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common())
        say(f"{len(made)} hands in {self.output}; {reasons.total()} plans were drawn again{': ' if told else ''}{told}")
        if self.picture is not None:
            say_file("picture", self.picture)


def _listing(path: Path) -> dict[str, dict[str, Any]]:
    """Rows of the hands that a folder's listing has, by name; nothing where there is no listing."""
    if not path.exists():
        return {}
    with reading(path, OutputError, "the listing of a folder of made hands; name another folder", KeyError), \
            path.open(newline="", encoding="utf-8") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def _draw(files: list[Path], made: list[MadeHand], path: Path) -> None:
    from dro_grasp.hands.library import load_hand
    from dro_grasp.pictures.sheets import draw_hands

    captions = [f"{hand.seed}   {hand.plan.joints - hand.plan.followers} joints" + (
        f" + {hand.plan.followers}" if hand.plan.followers else "") for hand in made]
    title = f"Procedural hands, seeds {made[0].seed} to {made[-1].seed}: independent joints + joints that follow"
    draw_hands([load_hand(file) for file in files], captions, path, title)


@dataclass(frozen=True)
class Vary:
    """Write the URDF of a hand's mirror image, or of a larger or smaller hand, and the SRDF of its postures if it has one.

    Example: dro-grasp hand vary leaphand --mirrored --scale 0.95 --output leap_left_small.urdf
    """

    hand: tyro.conf.Positional[str]  # Name of a hand, or path of a URDF file.
    output: Path  # URDF file to write. It names the hand's meshes by their absolute paths.
    mirrored: Flag = False  # Mirror it: a right hand becomes a left one. Equal joint values give mirrored poses.
    scale: float = 1.0  # Factor for all lengths; masses grow with its cube.
    json: Flag = False  # Print one JSON object instead of text.

    def run(self) -> int:
        """Read, change, write."""
        from dro_grasp.hands.library import locate_hand
        from dro_grasp.hands.variants import vary_hand, vary_postures

        if not self.mirrored and self.scale == 1:
            raise OptionError("nothing would change; give --mirrored, --scale, or both")
        if not 0 < self.scale < math.inf:
            raise OptionError(f"--scale is {self.scale}; give a positive number, for example 1.2")
        path = check_output(self.output, ".urdf")
        if path.exists() and path.samefile(locate_hand(self.hand).path):
            raise OptionError(f"{path} is the hand itself, which would be lost; give --output another name")
        text = vary_hand(self.hand, mirrored=self.mirrored, factor=self.scale)
        for file, content in ((path.with_suffix(".srdf"), vary_postures(self.hand, factor=self.scale)), (path, text)):
            if content is not None:
                with replacing(file) as temporary:
                    temporary.write_text(content, encoding="utf-8")
        if self.json:
            print_json({"hand": self.hand, "mirrored": self.mirrored, "scale": self.scale, "output": str(self.output)})
        else:
            shown = command("dro-grasp", "hand", "check", self.output, "--picture", "hand.png")
            say(f"{self.output}; see it with: {shown}")
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
    json: Flag = False  # Print one JSON object instead of text.

    def run(self) -> int:
        """Check, print, draw."""
        from dro_grasp.hands.check import check_hand, picture

        if self.picture is not None:
            check_output(self.picture, ".png")
        report = check_hand(self.hand)
        if self.picture is not None:
            picture(report.hand, self.picture)
        print_report(report, self.picture, self.json)
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
