"""`dro-grasp view`: look at the grasps of a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.output import load_grasps, optional, say
from dro_grasp.grasps.sources import hand_of, object_of


@dataclass(frozen=True)
class View:
    """Look at the grasps of a file in the browser (localhost only), or as a picture.

    Example: dro-grasp view grasps.parquet
    """

    file: tyro.conf.Positional[Path]
    """Grasp file."""
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Hand to use instead of the one that the file names or remembers."""
    object: Annotated[str | None, optional("NAME|PATH", "the names in the file")] = None
    """Object to look at: a name in the file, or the mesh to use for its only object."""
    scale: float = 1.0
    """Scale of the mesh given with --object."""
    port: int = 8080
    """Port on localhost; the next free one is taken."""
    picture: Annotated[Path | None, optional("PNG", "none")] = None
    """Write a PNG instead of opening the viewer."""

    def run(self) -> int:
        """Load the file and show the grasps of one object."""
        from dro_grasp.files import check_output

        if self.picture is not None:
            check_output(self.picture)
        grasps = load_grasps(self.file)
        hand = hand_of(grasps, self.hand)
        name = self.object if self.object in grasps.object else grasps.object[0]
        chosen = grasps[[i for i, o in enumerate(grasps.object) if o == name]]
        obj = object_of(chosen, None if self.object == name else self.object, self.scale)
        if self.picture is not None:
            from dro_grasp.viewer.pictures import draw_grasps

            draw_grasps(hand, obj, chosen, self.picture)
            say(f"picture: {self.picture}")
            return 0
        from dro_grasp.viewer.app import view_grasps

        view_grasps(hand, obj, chosen, port=self.port)
        return 0
