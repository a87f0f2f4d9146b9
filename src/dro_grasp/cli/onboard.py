"""`dro-grasp onboard`: everything for a new hand in one command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.output import print_json, say, say_aside


@dataclass(frozen=True)
class Onboard:
    """Check a new hand, synthesize grasps, fine-tune weights on them, and report success rates before and after.

    Example: dro-grasp onboard my_hand.urdf --output my_hand --minutes 30
    """

    hand: tyro.conf.Positional[str]  # Path of a URDF or MJCF file, or name of a hand.
    output: Path  # Folder for data, weights and report. A rerun resumes there.
    objects: tuple[str, ...] = ("builtin:train",)  # Objects to synthesize grasps of: names, meshes, folders or groups.
    held_out: tuple[str, ...] = ("builtin:test",)  # Objects to evaluate the weights on, never used in training.
    minutes: float = 30.0  # Time for data, training and trials [min]; trials are not cut off when it is over.
    num: int = 20  # Grasps of the network evaluated on each held-out object; of what `generate` returns, a quarter as many.
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None  # Weights to fine-tune.
    source: str = "auto"
    """Source of the returned grasps in benchmarks and report, as `generate --source`."""
    device: str = "cpu"
    """Device for the network, its training and the energies: cpu, cuda or cuda:1. Trials always run on the CPU."""
    workers: int = 2  # Processes that synthesize grasps.
    seed: int = 0  # Seed of data, training and trials.
    json: Flag = False  # Print one JSON object at the end.

    def run(self) -> int:
        """Run all steps, then write the report."""
        from dro_grasp.training.onboarding import WEIGHTS, OnboardingConfig, onboard, write_report

        config = OnboardingConfig(
            self.minutes, self.objects, self.held_out, self.num, self.weights, self.workers, self.source, seed=self.seed,
            device=self.device)
        done = onboard(self.hand, self.output, config, say_aside)
        report = write_report(done)
        rates = {step: {row["stage"]: {k: v[0] for k, v in row["success"].items()} for row in done.steps[step]["rows"]}
                 for step in ("before", "after")}
        if self.json:
            print_json({"hand": self.hand, "weights": done.weights, "gained": done.gained,
                        "fine_tuned": str(self.output / WEIGHTS), "without_grasps": done.without_grasps,
                        "report": str(report), **rates,
                        "optimised": {step: done.optimised(step) for step in ("before", "after")},
                        "grasps": done.steps["training"]["grasps"],
                        "seconds": {name: round(step["seconds"], 1) for name, step in done.steps.items()}})
            return 0
        for step in ("before", "after"):
            say(f"{step}: {done.steps[step]['said']}")
        for line in done.verdict():
            say(line)
        say(f"weights: {done.weights or 'the shipped ones'}")
        if not done.gained:
            say(f"fine-tuned: {self.output / WEIGHTS}")
        say(f"report: {report}")
        return 0
