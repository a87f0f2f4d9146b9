"""`dro-grasp dataset bundle`: one file for training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dro_grasp.cli.output import Flag, optional, print_json, print_table, say_aside


@dataclass(frozen=True)
class BundleCommand:
    """Pack grasps, hands and object clouds into one portable file for training.

    Example: dro-grasp dataset bundle data --output bundle.safetensors
    """

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """Output folders of `dro-grasp synthesize`, folders of grasp files, or grasp files."""
    output: Path
    """Bundle to write (.safetensors)."""
    split: Literal["train", "few_shot", "validate"] = "train"
    """Grasps to include. train: for training. few_shot: of held-out hands, for fine-tuning. validate: on objects that no
    weights are trained on, for measuring."""
    hands: tuple[str, ...] = ()
    """Hands to include; by default all."""
    per_pair: Annotated[int | None, optional("N", "all")] = None
    """Limit of grasps of a hand on an object; those that cover palm directions best are kept."""
    json: Flag = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Select the grasps of the split, find their hands and objects, write the bundle."""
        from dro_grasp.datasets.collections.bundling import make_bundle
        from dro_grasp.files import check_output

        check_output(self.output)
        bundle, left_out = make_bundle(self.inputs, self.output, self.split, self.hands, self.per_pair)
        if left_out:
            say_aside(f"{left_out} grasps outside split '{self.split}' are left out")
        report = {"output": str(self.output), "bytes": self.output.stat().st_size, **bundle.summary()}
        if self.json:
            print_json(report)
        else:
            print_table(f"bundle {self.output}", ["hand", "grasps"], [list(i) for i in report["hands"].items()],
                        note=f"{report['objects']} objects, {report['grasps']} grasps, {report['bytes'] / 1e6:.1f} MB")
        return 0
