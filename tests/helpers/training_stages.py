"""Short runs of both stages of training on the tiny bundle, shared by several tests."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from dro_grasp.network.network import DistanceNetwork
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.training.config import PretrainConfig, ScheduleConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle
from dro_grasp.training.loop import train
from dro_grasp.training.pretraining import pretrain
from dro_grasp.training.runs import LOG, Report, RunProgress
from tests.helpers.tiny_bundle import TINY

SCHEDULE = ScheduleConfig(
    steps=10, warmup_steps=3, learning_rate=3e-3, average_decay=0.9, checkpoint_seconds=0, log_every=2, recalibration=4,
)
SHARDED = dataclasses.replace(SCHEDULE, shards=2)
STAGES = ["train", "pretrain"]


def quiet(run: RunProgress, means: dict[str, float]) -> None:
    """A report that nobody reads."""


def run_stage(
    stage: str, bundle: Bundle, folder: Path, schedule: ScheduleConfig = SCHEDULE,
    report: Report = quiet, network: NetworkConfig = TINY,
) -> DistanceNetwork:
    if stage == "pretrain":
        return pretrain(bundle, network, PretrainConfig(schedule, hands_per_step=1), folder, report)
    return train(bundle, network, TrainConfig(schedule, hands_per_step=1, columns=24), folder, report=report)


def curve(folder: Path) -> list[dict[str, float]]:
    """The log without times."""
    lines = [json.loads(line) for line in (folder / LOG).read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "seconds"} for line in lines]
