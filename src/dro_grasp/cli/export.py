"""`dro-grasp export`: grasps for other programs and for robots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dro_grasp.cli.output import load_grasps, optional, print_json, say

if TYPE_CHECKING:
    from dro_grasp.export.formats import Frame
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand

SUFFIXES = {"isaac_grasp": ".yaml", "moveit": ".yaml", "csv": ".csv", "dexgraspbench": ""}
"""Ending of one object's file; DexGraspBench has a file a grasp, in a folder."""


@dataclass(frozen=True)
class Export:
    """Write the grasps of a file in another program's format.

    Example: dro-grasp export grasps.parquet --format isaac_grasp --output grasps.yaml
    """

    file: tyro.conf.Positional[Path]
    """Grasp file."""
    format: Literal["isaac_grasp", "moveit", "dexgraspbench", "csv"]
    """isaac_grasp: YAML 1.0 for Isaac Sim and Isaac ROS. moveit: moveit_msgs/Grasp as YAML. dexgraspbench: one npy a grasp, in
    a folder. csv: one line a grasp."""
    output: Path
    """File to write; a folder, made when it is missing, for dexgraspbench and for grasps of several objects."""
    frame: Annotated[Path | None, optional("JSON", "the object's frame")] = None
    """File with {"frame": "camera", "T_frame_object": 4x4}: poses are given in that frame."""
    only_successful: tyro.conf.FlagCreatePairsOff[bool] = False
    """Leave out grasps that failed their trial or had none."""
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Hand to use instead of the one that the file names or remembers."""
    object: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Object to use, likewise, where pregrasps are missing."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object."""

    def run(self) -> int:
        """Complete the grasps, then write a file for each object."""
        import torch

        from dro_grasp.errors import GraspFileError
        from dro_grasp.export.formats import Frame
        from dro_grasp.files import check_folder, check_output, make_folder
        from dro_grasp.grasps.sources import hand_of

        frame = Frame() if self.frame is None else Frame.load(self.frame)
        grasps = load_grasps(self.file)
        if self.only_successful:
            if not bool(grasps.success.any()):
                raise GraspFileError(f"no grasp in {self.file} has succeeded in a trial; `dro-grasp evaluate` tries them, or "
                                     "leave out --only-successful")
            grasps = grasps[grasps.success]
        names = list(dict.fromkeys(grasps.object))
        folder = self.format == "dexgraspbench" or len(names) > 1
        target = check_folder(self.output) if folder else check_output(self.output)
        if self.format == "dexgraspbench":
            refuse_mixing(target)
        stated = bool(torch.stack([grasps.pregrasp_joints, grasps.squeeze_joints]).isfinite().all())
        hand = hand_of(grasps, self.hand) if self.format == "moveit" or not stated else None
        parts = [self._complete(grasps[[i for i, o in enumerate(grasps.object) if o == name]], hand) for name in names]
        if folder:
            make_folder(target)
        written = []
        for name, part in zip(names, parts, strict=True):
            path = target / f"{name.replace('/', '-')}{SUFFIXES[self.format]}" if len(names) > 1 else target
            written += self._write(path, part, hand, frame)
        if self.json:
            print_json({"format": self.format, "frame": frame.name, "num": len(grasps), "files": [str(p) for p in written]})
        else:
            say(f"{len(grasps)} grasps in {len(written)} file{'s' if len(written) > 1 else ''}: {target}")
        return 0

    def _complete(self, grasps: GraspBatch, hand: Hand | None) -> GraspBatch:
        """The same with pregrasp and squeeze."""
        if hand is None:
            return grasps
        import torch

        from dro_grasp.grasps.controller import completed
        from dro_grasp.grasps.sources import object_of

        centre = torch.as_tensor(object_of(grasps, self.object, 1.0).centre_of_mass, dtype=grasps.joints.dtype)
        return completed(hand, grasps, centre)

    def _write(self, path: Path, grasps: GraspBatch, hand: Hand | None, frame: Frame) -> list[Path]:
        """The files of one object."""
        import numpy as np

        from dro_grasp.export.formats import csv_table, dexgraspbench, isaac_grasp, moveit_grasps
        from dro_grasp.files import make_folder, replacing
        from dro_grasp.grasps.sources import object_source

        if self.format == "dexgraspbench":
            folder, files = make_folder(path), []
            source, scale = object_source(grasps)
            for i, content in enumerate(dexgraspbench(grasps, frame, source, scale)):
                with replacing(folder / f"{i}.npy") as temporary, temporary.open("wb") as file:
                    np.save(file, np.array(content, dtype=object), allow_pickle=True)
                files.append(folder / f"{i}.npy")
            return files
        if self.format == "isaac_grasp":
            text = isaac_grasp(grasps, frame)
        elif self.format == "csv":
            text = csv_table(grasps, frame)
        else:
            assert hand is not None
            text = moveit_grasps(grasps, hand, frame)
        with replacing(path) as temporary:
            temporary.write_text(text)
        return [path]


def refuse_mixing(folder: Path) -> None:
    """Refuse a folder that holds npy files, itself or one level down: a reader could not tell old grasps from new.

    Raises:
        OutputError: It holds some.
    """
    from dro_grasp.errors import OutputError

    old = next((path for pattern in ("*.npy", "*/*.npy") for path in folder.glob(pattern)), None)
    if old is not None:
        raise OutputError(f"cannot write grasps into {folder}: it holds npy files already ({old.relative_to(folder)}), and old "
                          "and new grasps would be mixed; choose an empty folder or a new one")
