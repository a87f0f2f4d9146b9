"""Error of predicted distances, with z from the true grasp (posterior) and with z sampled at inference (prior).

Measured on the shipped grasps of the validate objects, which no weights were trained on. The prior error is mostly not an
error: a sampled z means another valid grasp than the stored one.

    python -m lab.benchmarks.distance_error [--weights NAME|PATH] [--json]

Needs the development assets.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from dro_grasp.cli.main import main as command
from dro_grasp.network.checkpoints import load_weights
from dro_grasp.training.data.bundle.training_file import Bundle, load_bundle
from dro_grasp.training.measures import distance_errors
from lab.benchmarks.report import ROOT, emit
from lab.benchmarks.synthesis import HANDS


def validation_bundle(hands: list[str]) -> Bundle:
    """The shipped grasps of hands on the validate objects."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "validate.safetensors"
        command(["dataset", "bundle", str(ROOT / "data" / "grasps"), "--split", "validate", "--hands", *hands, "--output",
                 str(path), "--json"])
        return load_bundle(path)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default=None, help="name of shipped weights, or a weights file")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    network = load_weights(options.weights)
    errors = distance_errors(network, validation_bundle(list(HANDS)))
    rows = [[e.hand, 1e3 * e.posterior, 1e3 * e.prior, e.divergence] for e in errors]
    columns = ["hand", "posterior [mm]", "prior [mm]", "divergence [nat]"]
    emit(f"distance error of weights '{network.name}'", rows, columns,
         {str(row[0]): dict(zip(columns[1:], row[1:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
