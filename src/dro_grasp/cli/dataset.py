"""`dro-grasp dataset`: work with folders of grasps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.output import print_json, print_table, say_aside


@dataclass(frozen=True)
class BundleCommand:
    """Pack grasps, hands and object clouds into one portable file for training.

    Example: dro-grasp dataset bundle data --output bundle.safetensors
    """

    folder: tyro.conf.Positional[Path]
    """Folder that `dro-grasp synthesize` filled."""
    output: Path
    """The bundle to write."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Load every shard and its hand and objects, leave out what is held out, write."""
        import torch

        from dro_grasp.datasets.bundle import TRAINING_SPLITS, ObjectCloud, write_bundle
        from dro_grasp.datasets.records import read_pairs
        from dro_grasp.grasps.batch import check_output
        from dro_grasp.hands.library import load_hand
        from dro_grasp.objects.library import load_object

        check_output(self.output)
        batches = [batch for _, batch in read_pairs(self.folder)]
        kept = [b[[i for i, s in enumerate(b.split) if s in TRAINING_SPLITS]] for b in batches]
        left_out = sum(map(len, batches)) - sum(map(len, kept))
        if left_out:
            say_aside(f"{left_out} grasps of held-out objects are left out")
        kept = [b for b in kept if len(b)]
        hands = [load_hand(name) for name in dict.fromkeys(b.hand for b in kept)]
        clouds = {}
        for name in sorted({o for b in kept for o in b.object}):
            obj = load_object(name)
            clouds[name] = ObjectCloud(torch.from_numpy(obj.cloud), torch.from_numpy(obj.cloud_normals))
        bundle = write_bundle(self.output, hands, clouds, kept)
        report = {"output": str(self.output), "bytes": self.output.stat().st_size, **bundle.summary()}
        if self.json:
            print_json(report)
        else:
            print_table(f"bundle {self.output}", ["hand", "grasps"], [list(i) for i in report["hands"].items()],
                        note=f"{report['objects']} objects, {report['grasps']} grasps, {report['bytes'] / 1e6:.1f} MB")
        return 0


@dataclass(frozen=True)
class Info:
    """Count the grasps of a folder, per hand and object."""

    folder: tyro.conf.Positional[Path]
    """Folder that `dro-grasp synthesize` filled."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Read the footers and count."""
        from dro_grasp.datasets.records import count_grasps, find_shards

        counts: dict[str, dict[str, int]] = {}
        for shard in find_shards(self.folder):
            of_hand = counts.setdefault(shard.hand, {})
            of_hand[shard.object] = of_hand.get(shard.object, 0) + (count_grasps(self.folder, shard) or 0)
        total = sum(sum(c.values()) for c in counts.values())
        if self.json:
            print_json({"total": total, "hands": counts})
        else:
            rows = [[hand, len(c), sum(c.values())] for hand, c in counts.items()]
            print_table(f"data set {self.folder}", ["hand", "objects", "grasps"], rows, note=f"{total} grasps in all")
        return 0


@dataclass(frozen=True)
class Dataset:
    """Work with grasp data sets."""

    command: Annotated[BundleCommand, tyro.conf.subcommand("bundle")] | Annotated[Info, tyro.conf.subcommand("info")]

    def run(self) -> int:
        """Run the subcommand."""
        return self.command.run()
