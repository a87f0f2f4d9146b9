"""`dro-grasp dataset import`: grasps of other projects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.output import print_result, records, say_aside


@dataclass(frozen=True)
class Import:
    """Convert grasps of other data sets into grasp files, to evaluate, filter and train on.

    Example: dro-grasp dataset import cmap_dataset.pt --format cmap --hands barrett=assets/barrett_multidex --output imported
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """`cmap_dataset.pt` of the official D(R,O) release, or npy files of DexGraspNet or DexGraspBench."""
    format: Literal["cmap", "dexgraspnet", "dexgraspbench"]
    """Format of the files."""
    output: Path
    """Folder for one grasp file per hand; created if missing."""
    hands: tuple[str, ...] = ()
    """Names or paths of the hands; NAME_IN_FILE=NAME renames one. Files that name no hand need exactly one."""
    object: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Object of all grasps, if the file names another or none."""
    json: Flag = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Read all files, find hands and objects, write grasp files."""
        from dro_grasp.datasets.collections.importing import import_grasps
        from dro_grasp.datasets.collections.merging import file_name
        from dro_grasp.errors import GraspFileError
        from dro_grasp.files import check_folder, make_folder

        check_folder(self.output)
        here = {theirs: ours for theirs, _, ours in (pair.rpartition("=") for pair in self.hands)}
        by_hand, missing = import_grasps(self.inputs, self.format, here, self.object)
        for obj, why in missing.items():
            say_aside(f"grasps of {obj} are left out: {why}")
        if not (by_hand or self.json):
            raise GraspFileError(
                "no grasp was imported; name the object of all grasps with --object, or set DRO_GRASP_ASSETS to the folder "
                "with the data set's objects" if missing else
                f"no grasp was imported: {', '.join(map(str, self.inputs))} holds none; name other files")
        folder = make_folder(self.output) if by_hand else self.output
        rows = []
        for grasps in by_hand.values():
            path = folder / file_name(grasps.hand)
            grasps.save(path)
            rows.append([grasps.hand, len(set(grasps.object)), len(grasps), str(path)])
        columns = ["hand", "objects", "grasps", "file"]
        print_result(self.json, {"files": records(columns, rows), "missing": missing}, "imported", columns, rows,
                     "`dro-grasp dataset filter` keeps those that pass a trial")
        return 0 if rows else 2
