"""`dro-grasp view`: grasps in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.grasp_files import load_grasps_of_one_object
from dro_grasp.cli.output import optional


@dataclass(frozen=True)
class View:
    """View the grasps of a file in the browser, or generate grasps there.

    Example: dro-grasp view grasps.parquet
    """

    file: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[FILE]")] = None
    """Grasp file. Without it, the page lets you choose a hand and an object, generate grasps, watch trials and export."""
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Hand to use instead of the one named in the file."""
    object: Annotated[str | None, optional("NAME|PATH", "the names in the file")] = None
    """Object to show: a name in the file, or a mesh to use for the file's only object."""
    scale: float = 1.0
    """Factor for the coordinates of the mesh given with --object."""
    port: int = 8080
    """Port to serve on; if it is taken, the next free one."""
    host: str = "127.0.0.1"
    """Address to serve at. By default only this machine can connect; 0.0.0.0 serves the whole network."""
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Weights for grasps generated on the page."""

    def run(self) -> int:
        """Serve the grasps of one object, or the page that generates grasps."""
        if self.file is None:
            from dro_grasp.viewer.studio import serve_studio

            serve_studio(self.weights, self.port, self.host)
            return 0
        from dro_grasp.viewer.app import view_grasps

        view_grasps(*load_grasps_of_one_object(self.file, self.hand, self.object, self.scale), port=self.port, host=self.host)
        return 0
