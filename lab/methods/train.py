"""Train the network of GenDexGrasp, or that in the style of ManiFM, on the bundle that the D(R,O) network is trained on.

    python -m lab.methods.train --method gendexgrasp --bundle BUNDLE --run-folder runs/maps --output maps.safetensors

A stopped run resumes from its last checkpoint.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import tyro

from dro_grasp.files import check_output
from dro_grasp.network.checkpoints import save_weights
from dro_grasp.training.config import ScheduleConfig
from dro_grasp.training.data.bundle.training_file import load_bundle
from dro_grasp.training.runs import check_schedule, how_long, is_first
from lab.methods.gendexgrasp.map_training import MapTrainingConfig, train_contact_maps
from lab.methods.manifm.contact_training import ContactTrainingConfig, train_contacts


def train(
    method: Literal["gendexgrasp", "manifm"], bundle: Path, run_folder: Path, output: Path, steps: int = 10_000,
    minutes: float | None = None, learning_rate: float = 1e-3, device: str = "cpu", seed: int = 0,
) -> None:
    """Train, and save the weights.

    Args:
        method: Whose network.
        bundle: From `dro-grasp dataset bundle`.
        run_folder: For log and checkpoints; a run in it is resumed.
        output: Weights file to write.
        steps: Optimiser steps.
        minutes: Time limit; the learning rate follows steps or time, whichever is further on.
        learning_rate: Its peak.
        device: Where to compute.
        seed: Of everything.
    """
    check_output(output, ".safetensors")
    schedule = ScheduleConfig(steps=steps, minutes=minutes, learning_rate=learning_rate, device=device, seed=seed)
    check_schedule(schedule)
    data = load_bundle(bundle)
    config: Any = MapTrainingConfig(schedule) if method == "gendexgrasp" else ContactTrainingConfig(schedule)
    model = (train_contact_maps if method == "gendexgrasp" else train_contacts)(data, config, run_folder)
    if not is_first():
        return
    save_weights(model, output, {
        **how_long(run_folder), "stage": method, "data": data.summary(),
        "settings": dataclasses.asdict(config)})


if __name__ == "__main__":
    tyro.cli(train)
