"""`dro-grasp dataset import`: other projects' grasps as grasp files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dro_grasp.cli.output import optional, print_json, print_table, say_aside

if TYPE_CHECKING:
    from dro_grasp.datasets.foreign import ForeignGrasp
    from dro_grasp.grasps.batch import GraspBatch


@dataclass(frozen=True)
class Import:
    """Turn grasps of other data sets into grasp files, to try them, filter them and train on them.

    Example: dro-grasp dataset import cmap_dataset.pt --format cmap --hands barrett=assets/barrett_multidex --output imported
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """`cmap_dataset.pt` of the official release, or npy files of DexGraspNet or DexGraspBench."""
    format: Literal["cmap", "dexgraspnet", "dexgraspbench"]
    """Whose files they are."""
    output: Path
    """Folder for one grasp file a hand; made when only itself is missing."""
    hands: tuple[str, ...] = ()
    """Names or paths of the hands, as NAME_IN_FILE=NAME_HERE where they differ; for files that name no hand, just one."""
    object: Annotated[str | None, optional("NAME|PATH", "the one that the file names")] = None
    """Object of all grasps, for files that name it otherwise or not at all."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Read all files, find hands and objects, write."""
        from dro_grasp.datasets.foreign import read_foreign
        from dro_grasp.datasets.merging import file_name
        from dro_grasp.errors import ObjectError, OptionError
        from dro_grasp.files import make_folder
        from dro_grasp.grasps.batch import GraspBatch

        here: dict[str, str] = {}
        for pair in self.hands:
            theirs, _, ours = pair.rpartition("=")
            here[theirs] = ours
        groups: dict[tuple[str, str, float], list[ForeignGrasp]] = {}
        for path in self.inputs:
            for grasp in read_foreign(path, self.format):
                groups.setdefault((grasp.hand, self.object or grasp.object, grasp.scale), []).append(grasp)
        folder = make_folder(self.output)
        by_hand: dict[str, list[GraspBatch]] = {}
        missing: dict[str, str] = {}
        for (hand, obj, scale), grasps in groups.items():
            if not (name := here.get(hand, here.get("") or hand)):
                raise OptionError(f"{self.inputs[0]} does not name its hand; name it with --hands")
            if not obj:
                raise OptionError(f"{self.inputs[0]} does not name its object; name it with --object")
            try:
                by_hand.setdefault(name, []).append(batch_of(name, obj, scale, grasps, self.format))
            except ObjectError as error:
                missing[obj] = str(error)
        for obj, why in missing.items():
            say_aside(f"grasps of {obj} are left out: {why}")
        rows = []
        for batches in by_hand.values():
            whole = GraspBatch.concatenate(batches)
            path = folder / file_name(whole.hand)
            whole.save(path)
            rows.append([whole.hand, len(set(whole.object)), len(whole), str(path)])
        if self.json:
            keys = ("hand", "objects", "grasps", "file")
            print_json({"files": [dict(zip(keys, row, strict=True)) for row in rows], "missing": missing})
        else:
            print_table("imported", ["hand", "objects", "grasps", "file"], rows,
                        note="`dro-grasp dataset filter` keeps those that hold")
        return 0 if rows else 2


def batch_of(hand_name: str, obj_name: str, scale: float, grasps: list[ForeignGrasp], origin: str) -> GraspBatch:
    """Grasps of one hand on one object.

    Raises:
        HandError: The hand cannot be loaded.
        ObjectError: The object cannot be loaded.
        GraspFileError: The grasps are of other joints.
    """
    import numpy as np
    import torch

    from dro_grasp.datasets.foreign import in_order
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.grasps.sources import with_sources
    from dro_grasp.hands.library import load_hand
    from dro_grasp.objects.library import load_object

    hand, obj = load_hand(hand_name), load_object(obj_name, scale=scale)
    T = torch.from_numpy(np.stack([grasp.T_object_wrist for grasp in grasps])).float()
    q = torch.tensor([in_order(grasp, hand.tree.moving_names, hand.tree.joint_names) for grasp in grasps])
    made = GraspBatch.create(hand, obj, T, q, provenance=f"imported from {origin}")
    return with_sources(made, hand_name, obj_name, scale)
