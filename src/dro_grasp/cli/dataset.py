"""`dro-grasp dataset`: work with folders of grasps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from dro_grasp.cli.output import print_json, print_table, say_aside


def distinct_names(things: list[Any]) -> list[Any]:
    """Hands or objects, each once; two of one name would be mixed up.

    Raises:
        BundleError: Different things have one name.
    """
    from dro_grasp.errors import BundleError

    found = {thing.sha256: thing for thing in things}
    names = [thing.name for thing in found.values()]
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise BundleError(f"different files are called {', '.join(double)}; rename them and synthesise again")
    return list(found.values())


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
        from dro_grasp.files import check_output
        from dro_grasp.hands.library import load_hand
        from dro_grasp.objects.library import load_object

        check_output(self.output)
        # Folders are named as the pair was asked for: a path where the grasps know the name alone.
        pairs = dict(read_pairs(self.folder))
        kept = {pair: b[[i for i, s in enumerate(b.split) if s in TRAINING_SPLITS]] for pair, b in pairs.items()}
        left_out = sum(map(len, pairs.values())) - sum(map(len, kept.values()))
        if left_out:
            say_aside(f"{left_out} grasps of held-out objects are left out")
        kept = {pair: b for pair, b in kept.items() if len(b)}
        hands = distinct_names([load_hand(name) for name in dict.fromkeys(hand for hand, _ in kept)])
        objects = distinct_names([load_object(name) for name in sorted({obj for _, obj in kept})])
        clouds = {o.name: ObjectCloud(torch.from_numpy(o.cloud), torch.from_numpy(o.cloud_normals)) for o in objects}
        bundle = write_bundle(self.output, hands, clouds, list(kept.values()))
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
