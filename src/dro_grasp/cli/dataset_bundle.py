"""`dro-grasp dataset bundle`: all that training needs in one file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dro_grasp.cli.output import optional, print_json, print_table, say_aside

if TYPE_CHECKING:
    from dro_grasp.datasets.bundle import ObjectCloud
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.hands.hand import Hand
    from dro_grasp.objects.shape import ObjectModel


@dataclass(frozen=True)
class BundleCommand:
    """Pack grasps, hands and object clouds into one portable file for training.

    Example: dro-grasp dataset bundle data --output bundle.safetensors
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `dro-grasp synthesize` filled, folders of grasp files, or grasp files."""
    output: Path
    """The bundle to write."""
    split: Literal["train", "few_shot", "validate"] = "train"
    """What goes in: grasps that may be trained on, those of held-out hands for fine-tuning studies, or those on objects that
    no weights are trained on, to measure weights with."""
    hands: tuple[str, ...] = ()
    """Only these hands; all when none is named."""
    per_pair: Annotated[int | None, optional("N", "all")] = None
    """Most grasps of a hand on an object; of more, those that spread best over palm directions are kept."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Take the grasps of the split, find their hands and objects, write."""
        from dro_grasp.datasets.bundle import write_bundle
        from dro_grasp.datasets.collections import read_collection
        from dro_grasp.datasets.merging import spread
        from dro_grasp.datasets.splits import SPLITS
        from dro_grasp.files import check_output

        check_output(self.output)
        allowed = SPLITS[self.split]
        kept, left_out = [], 0
        for pair in (pair for path in self.inputs for pair in read_collection(path)):
            if self.hands and pair.hand not in self.hands and pair.grasps.hand not in self.hands:
                continue
            grasps = pair.grasps[[i for i, split in enumerate(pair.grasps.split) if split in allowed]]
            left_out += len(pair.grasps) - len(grasps)
            if len(grasps):
                kept.append(grasps)
        if left_out:
            say_aside(f"{left_out} grasps that are not of split '{self.split}' are left out")
        hands, clouds = sources(kept)
        if self.per_pair is not None:
            by_hash = {hand.sha256: hand for hand in hands}
            kept = [grasps[spread(by_hash[grasps.hand_sha256], grasps, self.per_pair)] for grasps in kept]
        bundle = write_bundle(self.output, hands, clouds, kept, allowed)
        report = {"output": str(self.output), "bytes": self.output.stat().st_size, **bundle.summary()}
        if self.json:
            print_json(report)
        else:
            print_table(f"bundle {self.output}", ["hand", "grasps"], [list(i) for i in report["hands"].items()],
                        note=f"{report['objects']} objects, {report['grasps']} grasps, {report['bytes'] / 1e6:.1f} MB")
        return 0


def sources(batches: list[GraspBatch]) -> tuple[list[Hand], dict[str, ObjectCloud]]:
    """The hands and the object clouds of grasps, each once, checked to be those the grasps were made for.

    Args:
        batches: Each of one hand and one object.

    Raises:
        BundleError: Different files have one name.
        GraspFileError: A hand or an object has changed since.
    """
    import torch

    from dro_grasp.datasets.bundle import ObjectCloud
    from dro_grasp.errors import BundleError
    from dro_grasp.grasps.sources import hand_of, object_of, require_same

    hands: dict[str, Hand] = {}
    objects: dict[str, ObjectModel] = {}
    for grasps in batches:
        if grasps.hand_sha256 not in hands:
            hands[grasps.hand_sha256] = hand_of(grasps, None)
        if grasps.object_sha256[0] not in objects:
            objects[grasps.object_sha256[0]] = object_of(grasps, None, 1.0)
        require_same(grasps, hands[grasps.hand_sha256], objects[grasps.object_sha256[0]])
    for kind, things in (("hand", hands), ("object", objects)):
        names = [thing.name for thing in things.values()]
        double = sorted({name for name in names if names.count(name) > 1})
        if double:
            raise BundleError(f"different files of a {kind} are called {', '.join(double)}; rename them and synthesise again")
    clouds = {o.name: ObjectCloud(torch.from_numpy(o.cloud), torch.from_numpy(o.cloud_normals)) for o in objects.values()}
    return list(hands.values()), clouds
