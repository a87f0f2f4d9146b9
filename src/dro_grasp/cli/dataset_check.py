"""`dro-grasp dataset check`: whether stored results can be reproduced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.output import Flag, optional, print_json, print_table, progress_bar, say
from dro_grasp.cli.protocol_name import ProtocolName


@dataclass(frozen=True)
class Check:
    """Evaluate a random sample of a data set again, and compare the results with the stored ones.

    Example: dro-grasp dataset check data --sample 500
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Output folders of `dro-grasp synthesize`, folders of grasp files, or grasp files."""
    sample: int = 100
    """Grasps to evaluate, drawn uniformly from all grasps."""
    protocol: ProtocolName = "strict"
    """Protocol of the trial."""
    friction: Annotated[float | None, optional("MU", "the protocol's")] = None
    """Friction coefficient between hand and object."""
    mass_factor: float = 1.0
    """Factor for the masses of the objects, and thereby for the forces."""
    seed: int = 0
    """Seed of the sample."""
    json: Flag = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Draw, evaluate, compare."""
        from dro_grasp.datasets.collections.checking import check
        from dro_grasp.datasets.collections.collection import read_collection
        from dro_grasp.evaluation.metrics import wilson_interval
        from dro_grasp.simulation.protocols import changed

        rules = changed(self.protocol, friction=self.friction, mass_factor=self.mass_factor)
        pairs = (pair for path in self.inputs for pair in read_collection(path, only_successful=False))
        with progress_bar("evaluating", self.json) as progress:
            found = check(pairs, self.sample, rules, self.seed, progress)
        low, high = wilson_interval(found.agreed, found.evaluated)
        if self.json:
            print_json({
                "protocol": found.protocol, "evaluated": found.evaluated, "agreed": found.agreed,
                "agreement": found.agreed / found.evaluated, "interval_95": [low, high], "succeeded": found.succeeded,
                "reasons": dict(found.reasons.most_common()), "hands": {h: list(c) for h, c in found.hands.items()},
            })
            return 0
        rows = [[hand, count, success, success / count] for hand, (count, success) in found.hands.items()]
        print_table(f"evaluated again, protocol {found.protocol}", ["hand", "grasps", "success", "rate"], rows)
        say(f"{found.agreed} of {found.evaluated} results agree with the stored ones: {found.agreed / found.evaluated:.1%} "
            f"(95 %: {low:.1%} to {high:.1%})")
        for reason, count in found.reasons.most_common(5):
            say(f"  {count} stored as successful now fail: {reason}")
        return 0
