"""Whole results of fixed requests, as numbers: a change of code that is meant to change none must leave them all as they are.

`make golden` writes them anew after a change that is meant to; the changelog says why.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import platform
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import torch

import dro_grasp as dro
from dro_grasp.objects.perception.partial_views import partial_view
from dro_grasp.simulation.protocols import PROTOCOLS
from tests.helpers.tiny_bundle import tiny_bundle

RECORDED = Path(__file__).parent / "recorded.json"
"""Results, and the machine on which they are bitwise these."""
Numbers = dict[str, list[float]]


def vendor() -> str:
    """Who made the processor, as Linux tells: libraries of linear algebra have kernels by maker; empty elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("vendor_id")), "")


def machine() -> dict[str, str]:
    """What decides on the last bits of a result, beside the code."""
    return {"processor": platform.machine(), "vendor": vendor(), "vector unit": torch.backends.cpu.get_cpu_capability(),
            "torch": torch.__version__.split("+")[0], "mujoco": str(mujoco.__version__), "numpy": np.__version__}


def grasps(hand: str, obj: dro.ObjectModel, **constraints: object) -> Numbers:
    """What `predict` returns."""
    made = dro.GraspPredictor().predict(dro.load_hand(hand), obj, num=4, seed=0, constraints=dro.Constraints(**constraints))
    columns = (made.T_object_wrist, made.joints, made.pregrasp_joints, made.squeeze_joints, made.score)
    names = ("poses", "joints", "pregrasp", "squeeze", "score")
    return {name: column.double().flatten().tolist() for name, column in zip(names, columns, strict=True)}


def trials(name: str) -> Numbers:
    """Outcomes of twenty grasps under one protocol."""
    hand, obj = dro.load_hand("gripper3"), dro.load_object("can")
    made = dro.synthesize(hand, obj, 20, seed=0, config=dro.SynthesisConfig(steps=40))
    result = dro.simulate(hand, obj, made, name)
    return outcome(result)


def outcome(result: dro.TrialResult) -> Numbers:
    """What a trial says."""
    return {"success": result.success.double().tolist(), "displacement": result.displacement.double().flatten().tolist(),
            "penetration": result.penetration.double().tolist()}


def carried(name: str) -> Numbers:
    """Outcomes under `carry` of what is returned, and of what nobody refined: some hold, some do not."""
    hand, obj, predictor = dro.load_hand(name), dro.load_object("can"), dro.GraspPredictor()
    made = [predictor.predict(hand, obj, num=4, seed=1, refine=refined) for refined in (True, False)]
    return outcome(dro.simulate(hand, obj, dro.GraspBatch.concatenate(made), "carry"))


def training() -> Numbers:
    """Weights after eight steps."""
    config = dataclasses.replace(
        dro.NetworkConfig.preset("multi"), n_hand=48, n_object=32, width=16, encoder_widths=(8, 16), neighbours=6,
        attention_hidden=16, latent=4, latent_widths=(8, 16), latent_head=(16, 16), latent_neighbours=6, kernel_hidden=(16, 8),
        placement_width=16)
    with tempfile.TemporaryDirectory() as folder:
        bundle = tiny_bundle(Path(folder) / "bundle.safetensors")
        schedule = dro.ScheduleConfig(steps=8, warmup_steps=2, checkpoint_seconds=0, recalibration=2)
        network = dro.train(bundle, config, dro.TrainConfig(schedule, hands_per_step=1, columns=24), Path(folder) / "run",
                            report=lambda run, means: None)
    return {name: value.double().flatten().tolist() for name, value in network.state_dict().items()}


CASES: dict[str, Callable[[], Numbers]] = {
    "grasps of a mesh": lambda: grasps("allegro", dro.load_object("rubber_duck")),
    "grasps of a cloud": lambda: grasps("barrett", partial_view(dro.load_object("mug"), "depth", 0)),
    "grasps from above": lambda: grasps("leaphand", dro.load_object("can"), direction=(0.0, 0.0, -1.0), table=-0.06),
    **{f"trials under {name}": lambda name=name: trials(name) for name in PROTOCOLS},
    "what is carried": lambda: carried("barrett"),
    "training": training,
}


def digest(numbers: Numbers) -> str:
    """A hash of every bit."""
    return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()


def write() -> None:
    """Record all cases on this machine."""
    torch.set_num_threads(1)
    cases = {name: make() for name, make in CASES.items()}
    summary = {name: {"sha256": digest(numbers), "numbers": {k: _rounded(v) for k, v in numbers.items()}}
               for name, numbers in cases.items()}
    RECORDED.write_text(json.dumps({"machine": machine(), "cases": summary}, indent=1) + "\n")


def _rounded(values: list[float]) -> list[float]:
    """The first few of many, in as many digits as another machine should have alike."""
    return [round(x, 5) for x in values[:40]]


if __name__ == "__main__":
    sys.exit(write())
