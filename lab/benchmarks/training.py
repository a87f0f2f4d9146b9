"""Samples that training takes a second, by preset and batch, and where a step's time goes.

Hands are built in; objects are ellipsoids, one of them as flat as a phone, and grasps are made up: speed depends on sizes
alone. Steps are those of `train`, timed by its log once they are warm; a GPU multiplies in bfloat16, as `--mixed` has it.
`--against` runs the same with the package of another folder first.

    python -m lab.benchmarks.training [--device cuda] [--quick] [--profile] [--exact] [--against FOLDER/src] [--record FILE]
        [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from dro_grasp.devices import require_device
from dro_grasp.geometry.se3 import compose, random_rotations
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.training.config import ScheduleConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle, ObjectCloud, write_bundle
from dro_grasp.training.loop import train
from lab.benchmarks.report import emit, note, options_of

HANDS = ("allegro", "barrett", "gripper3", "leaphand", "shadowhand")
OBJECTS, FLAT = 48, 0.004
"""Objects, as many as the shipped data has, and the semiaxis of the flattest [m]."""
GRASPS = 200
"""Grasps of each hand on each object."""
COLUMNS = {"multi": 48, "paper": 128}
"""Object points of a step, by preset."""
BATCHES = {"cpu": {"multi": (16,), "paper": (4,)}, "gpu": {"multi": (512, 2048, 8192), "paper": (96, 384, 768)}}
"""Samples of a step, of eight hands on a GPU and four on a CPU."""
QUICK = {"multi": (2048,), "paper": (384,)}
"""The same with `--quick` on a GPU."""
STEPS, WARM_UP = 9, 4
"""Steps, and those that are not counted."""
SHOWN = 30
"""Lines of a profile."""


def made_up_bundle(path: Path) -> Bundle:
    """Write grasps that are random but for their objects, which lie in the hand, and read them."""
    generator, clouds = torch.Generator().manual_seed(0), {}
    for number in range(OBJECTS):
        axes = 0.02 + 0.04 * torch.rand(3, generator=generator)
        axes[0] = FLAT if number == 0 else axes[0]
        directions = torch.nn.functional.normalize(torch.randn(2048, 3, generator=generator), dim=-1)
        clouds[f"object{number}"] = ObjectCloud(directions * axes, torch.nn.functional.normalize(directions / axes, dim=-1))
    hands = [load_hand(name) for name in HANDS]
    return write_bundle(path, hands, clouds, [made_up_grasps(hand, name, generator) for hand in hands for name in clouds])


def made_up_grasps(hand: Hand, obj: str, generator: torch.Generator) -> GraspBatch:
    """Grasps with the object near the hand's grasp centre, in random rotation."""
    rotation = random_rotations(GRASPS, generator)
    shift = 0.003 * torch.randn(GRASPS, 3, generator=generator) - rotation @ hand.grasp_centre_wrist
    about: Any = SimpleNamespace(name=obj, sha256=obj, split="train")
    return GraspBatch.create(hand, about, compose(rotation, shift), hand.random_joints(GRASPS, generator))


def measured(bundle: Bundle, preset: str, samples: int, options: argparse.Namespace) -> tuple[float, str]:
    """Seconds of a step, and the profile of one, if it is asked for."""
    gpu, hands = options.device != "cpu", 8 if options.device != "cpu" else 4
    steps = STEPS if gpu else 4
    schedule = ScheduleConfig(
        steps=steps + options.profile, device=options.device, log_every=1, recalibration=1, mixed=gpu and not options.exact)
    config = TrainConfig(schedule, hands_per_step=hands, samples_per_hand=samples // hands, columns=COLUMNS[preset])
    profiler = profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if gpu else [])])

    def report(progress: Any, _: Any) -> None:
        if options.profile and progress.step == steps:
            profiler.start()
        if options.profile and progress.step == steps + 1:
            profiler.stop()

    with tempfile.TemporaryDirectory() as folder:
        train(bundle, NetworkConfig.preset(preset), config, Path(folder), report=report)
        seconds = [json.loads(line)["seconds"] for line in (Path(folder) / "log.jsonl").read_text().splitlines()][:steps]
    warm = WARM_UP if gpu else 1
    return (seconds[-1] - seconds[warm - 1]) / (len(seconds) - warm), told(profiler, gpu) if options.profile else ""


def told(profiler: profile, gpu: bool) -> str:
    """Kernel launches and waits of the profiled step, and its most expensive kernels, or operators on a CPU."""
    events = profiler.key_averages()
    launches = sum(e.count for e in events if "LaunchKernel" in e.key)
    waits = sum(e.count for e in events if "Synchronize" in e.key)
    time: Callable[[Any], float] = (lambda e: e.self_device_time_total) if gpu else (lambda e: e.self_cpu_time_total)
    found = sorted((e for e in events if not gpu or str(e.device_type).endswith("CUDA")), key=time, reverse=True)
    head = f"{launches} launches, {waits} waits, {sum(map(time, found)) / 1e3:.1f} ms"
    return "\n".join([head, *(f"{time(e) / 1e3:9.2f} ms {e.count:6d} x {e.key[:100]}" for e in found[:SHOWN])])


def speeds(options: argparse.Namespace) -> dict[str, float]:
    """Samples a second by preset and batch; each is printed at once, as the whole takes a minute."""
    batches = BATCHES["cpu"] if options.device == "cpu" else QUICK if options.quick else BATCHES["gpu"]
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        bundle = made_up_bundle(Path(folder) / "bundle.safetensors")
        for preset, sizes in batches.items():
            for samples in sizes:
                try:
                    seconds, profiled = measured(bundle, preset, samples, options)
                except torch.OutOfMemoryError as error:
                    print(f"{preset}, {samples}: {str(error)[:80]}", file=sys.stderr)
                    continue
                found[f"{preset} {samples}"] = samples / seconds
                note(options.record, f"training, {preset}", device=options.device, rate=samples / seconds, samples=samples,
                     exact=options.exact)
                memory = torch.cuda.max_memory_allocated() / 2**30 if torch.cuda.is_initialized() else 0.0
                print(f"{options.label}{preset}, {samples} a step: {samples / seconds:.0f} samples/s, {1e3 * seconds:.0f} ms a "
                      f"step, {memory:.1f} GiB\n{profiled}", file=sys.stderr, flush=True)
    return found


def other_speeds(options: argparse.Namespace) -> dict[str, float]:
    """The same with another folder's package, in a process of its own."""
    given = [argument for argument in ("--quick", "--profile", "--exact") if getattr(options, argument[2:])]
    command = [sys.executable, "-m", "lab.benchmarks.training", "--device", options.device, "--label", "before: ", "--json"]
    paths = [str(options.against), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    done = subprocess.run([*command, *given], env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, stdout=subprocess.PIPE,
                          text=True, check=True)
    return json.loads(done.stdout)["samples_a_second"]


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--quick", action="store_true", help="one batch of each preset")
    parser.add_argument("--profile", action="store_true", help="also profile one step of each")
    parser.add_argument("--exact", action="store_true", help="single precision on a GPU too")
    parser.add_argument("--against", type=Path, help="source folder of another state of the package")
    parser.add_argument("--record", type=Path, help="file to which each result is appended as it is found")
    parser.add_argument("--label", default="", help=argparse.SUPPRESS)
    options = parser.parse_args()
    require_device(options.device)
    before = other_speeds(options) if options.against else {}
    found = speeds(options)
    rows = [[*name.split(), rate, before.get(name, ""), rate / before[name] if name in before else ""]
            for name, rate in found.items()]
    emit(f"Training on {options.device}", rows, ["preset", "samples a step", "samples/s", "before", "ratio"],
         {"samples_a_second": found, "before": before}, options.json)


if __name__ == "__main__":
    main()
