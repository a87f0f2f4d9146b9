"""`dro-grasp view` and `picture`: look at the grasps of a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dro_grasp.cli.output import load_grasps, optional, say
from dro_grasp.grasps.sources import hand_of, object_of

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel

MOST_SIDE = 4096
"""Largest width and height of one picture [pixels]."""
MOST_PIXELS = 100_000_000
"""Of all pictures of a sheet together."""


@dataclass(frozen=True)
class View:
    """Look at the grasps of a file in the browser; without a file, make grasps there.

    Example: dro-grasp view grasps.parquet
    """

    file: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[FILE]")] = None
    """Grasp file; without one the page lets you pick or upload a hand and an object, generate, watch trials and export."""
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Hand to use instead of the one that the file names or remembers."""
    object: Annotated[str | None, optional("NAME|PATH", "the names in the file")] = None
    """Object to look at: a name in the file, or the mesh to use for its only object."""
    scale: float = 1.0
    """Scale of the mesh given with --object."""
    port: int = 8080
    """Port; the next free one is taken."""
    host: str = "127.0.0.1"
    """Who may connect: this machine alone. 0.0.0.0 lets the whole network in."""
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Weights that the page generates with."""

    def run(self) -> int:
        """Show the grasps of one object of the file, or the page that makes some."""
        if self.file is None:
            from dro_grasp.viewer.studio import serve_studio

            serve_studio(self.weights, self.port, self.host)
            return 0
        from dro_grasp.viewer.app import view_grasps

        view_grasps(*of_one_object(self.file, self.hand, self.object, self.scale), port=self.port, host=self.host)
        return 0


@dataclass(frozen=True)
class Picture:
    """Draw the grasps of a file on one sheet, without browser or OpenGL.

    Example: dro-grasp picture grasps.parquet --output sheet.png --opacity 0.5 --contacts
    """

    file: tyro.conf.Positional[Path]
    """Grasp file."""
    output: Path
    """PNG to write; its name ends in .png."""
    count: int = 16
    """Most grasps drawn, the first of the file."""
    columns: int = 4
    """Pictures side by side."""
    size: tuple[int, int] = (320, 280)
    """Width and height of one picture in pixels, at most 4096 each."""
    opacity: float = 1.0
    """Of the object: at 0.5 the hand shows through it."""
    contacts: tyro.conf.FlagCreatePairsOff[bool] = False
    """Mark in red where the hand touches."""
    only_successful: tyro.conf.FlagCreatePairsOff[bool] = False
    """Leave out grasps that failed their trial or had none."""
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Hand to use instead of the one that the file names or remembers."""
    object: Annotated[str | None, optional("NAME|PATH", "the names in the file")] = None
    """Object to look at: a name in the file, or the mesh to use for its only object."""
    scale: float = 1.0
    """Scale of the mesh given with --object."""

    def run(self) -> int:
        """Load the file and draw the grasps of one object."""
        from dro_grasp.errors import GraspFileError, OptionError
        from dro_grasp.files import check_output
        from dro_grasp.viewer.pictures import PictureStyle, draw_grasps

        self._check_options()
        check_output(self.output)
        hand, obj, grasps = of_one_object(self.file, self.hand, self.object, self.scale)
        if self.only_successful:
            if not bool(grasps.success.any()):
                raise GraspFileError(f"no grasp in {self.file} has succeeded in a trial; leave out --only-successful")
            grasps = grasps[grasps.success]
        shown = min(self.count, len(grasps))
        if (pixels := shown * self.size[0] * self.size[1]) > MOST_PIXELS:
            raise OptionError(f"{shown} pictures of {self.size[0]} x {self.size[1]} are {pixels / 1e6:.0f} million pixels; a "
                              f"sheet has at most {MOST_PIXELS // 10**6} million: give a smaller --size or --count")
        style = PictureStyle(self.size, self.opacity, self.contacts)
        draw_grasps(hand, obj, grasps, self.output, self.count, self.columns, style)
        say(f"picture: {self.output}")
        return 0

    def _check_options(self) -> None:
        """Refuse what cannot be drawn, naming only the option that is wrong."""
        from dro_grasp.errors import OptionError, OutputError

        if self.output.suffix.lower() != ".png":
            raise OutputError(f"cannot write {self.output}: pictures are PNG; give a name that ends in .png")
        for option, value in (("--count", self.count), ("--columns", self.columns)):
            if value < 1:
                raise OptionError(f"{option} is {value}; give at least 1")
        if not (min(self.size) >= 1 and max(self.size) <= MOST_SIDE):
            raise OptionError(f"--size is {self.size[0]} {self.size[1]}; give a width and a height of 1 to {MOST_SIDE} pixels")
        if not 0 <= self.opacity <= 1:
            raise OptionError(f"--opacity is {self.opacity}; give a number from 0 to 1")


def of_one_object(
    file: Path, hand_name: str | None, object_name: str | None, scale: float
) -> tuple[Hand, ObjectModel, GraspBatch]:
    """The hand, one object and its grasps of a file: the object named, or the first.

    Raises:
        DroGraspError: The file, its hand or its object cannot be had.
    """
    grasps = load_grasps(file)
    hand = hand_of(grasps, hand_name)
    name = object_name if object_name in grasps.object else grasps.object[0]
    chosen = grasps[[i for i, o in enumerate(grasps.object) if o == name]]
    return hand, object_of(chosen, None if object_name == name else object_name, scale), chosen
