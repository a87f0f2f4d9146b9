"""`dro-grasp dataset check` and `filter`: stored grasps tried again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dro_grasp.cli.output import optional, print_json, print_table, progress_bar, say


@dataclass(frozen=True)
class Check:
    """Try a random sample of a data set again, and say how often the verdict is the stored one.

    Example: dro-grasp dataset check data --sample 500
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `dro-grasp synthesize` filled, folders of grasp files, or grasp files."""
    sample: int = 100
    """Grasps to try, drawn evenly from all."""
    protocol: Literal["strict", "dro", "dro_static", "dexgraspbench"] = "strict"
    """The trial."""
    friction: Annotated[float | None, optional("MU", "the protocol's")] = None
    """Friction between hand and object."""
    mass_factor: float = 1.0
    """Multiplies the objects' masses, and with them the forces."""
    seed: int = 0
    """Of the draw."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Draw, try, compare."""
        from dro_grasp.datasets.collections.checking import check
        from dro_grasp.datasets.collections.collection import read_collection
        from dro_grasp.evaluation.metrics import wilson_interval
        from dro_grasp.simulation.protocols import changed

        rules = changed(self.protocol, friction=self.friction, mass_factor=self.mass_factor)
        pairs = (pair for path in self.inputs for pair in read_collection(path, only_successful=False))
        with progress_bar("trying again", self.json) as progress:
            found = check(pairs, self.sample, rules, self.seed, progress)
        low, high = wilson_interval(found.agreed, found.tried)
        if self.json:
            print_json({
                "protocol": found.protocol, "tried": found.tried, "agreed": found.agreed,
                "agreement": found.agreed / found.tried, "interval_95": [low, high], "succeeded": found.succeeded,
                "reasons": dict(found.reasons.most_common()), "hands": {h: list(c) for h, c in found.hands.items()},
            })
            return 0
        rows = [[hand, tried, success, success / tried] for hand, (tried, success) in found.hands.items()]
        print_table(f"tried again, protocol {found.protocol}", ["hand", "grasps", "success", "rate"], rows)
        say(f"{found.agreed} of {found.tried} verdicts are the stored ones: {found.agreed / found.tried:.1%} "
            f"(95 %: {low:.1%} to {high:.1%})")
        for reason, count in found.reasons.most_common(5):
            say(f"  {count} that succeeded before: {reason}")
        return 0


@dataclass(frozen=True)
class Filter:
    """Try all grasps of a data set, anybody's, and keep those that pass.

    Example: dro-grasp dataset filter theirs.parquet --protocol strict --output kept
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `dro-grasp synthesize` filled, folders of grasp files, or grasp files."""
    output: Path
    """Folder for the files, one a hand; made when only itself is missing."""
    protocol: Literal["strict", "dro", "dro_static", "dexgraspbench"] = "strict"
    """The trial."""
    friction: Annotated[float | None, optional("MU", "the protocol's")] = None
    """Friction between hand and object."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Try, keep, write one file a hand."""
        from dro_grasp.datasets.collections.checking import keep_passing
        from dro_grasp.datasets.collections.collection import read_collection
        from dro_grasp.datasets.collections.merging import file_name
        from dro_grasp.files import make_folder
        from dro_grasp.grasps.batch import GraspBatch
        from dro_grasp.simulation.protocols import changed

        rules = changed(self.protocol, friction=self.friction)
        folder = make_folder(self.output)
        pairs = [pair for path in self.inputs for pair in read_collection(path, only_successful=False)]
        with progress_bar("trying", self.json) as progress:
            kept = keep_passing(pairs, rules, progress)
        by_hand: dict[str, list[GraspBatch]] = {}
        for _, passed in kept:
            by_hand.setdefault(passed.hand, []).append(passed)
        for hand, batches in by_hand.items():
            GraspBatch.concatenate(batches).save(folder / file_name(hand))
        rows = [[pair.hand, pair.object, len(pair.grasps), len(passed)] for pair, passed in kept]
        tried, passed = sum(row[2] for row in rows), sum(row[3] for row in rows)
        if self.json:
            columns = ("hand", "object", "grasps", "kept")
            print_json({"output": str(folder), "protocol": rules.label, "grasps": tried, "kept": passed,
                        "pairs": [dict(zip(columns, row, strict=True)) for row in rows]})
        else:
            print_table(f"protocol {rules.label}", ["hand", "object", "grasps", "kept"], rows,
                        note=f"{passed} of {tried} kept, in {folder}")
        return 0
