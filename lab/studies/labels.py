"""Cost and benefit of labels and starts: yield, diversity and penetration of grasps, with and without each choice.

Settled labels are read after the hand has closed on the object in simulation. Wide starts have joints anywhere within
their limits. Random idle fingers have no contacts in the energy; after the trial they close onto the object. The engine
descends for 120 steps and evaluates the better 70 %. Success with half the friction, of grasps that pass `strict`, shows
whether a choice makes them weaker.

    python -m lab.studies.labels [--candidates 128] [--json]
"""

from __future__ import annotations

import argparse
import random
import time

import torch

from dro_grasp.compare.metrics import diversity
from dro_grasp.compare.rows import finger_contact
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.contacts import ContactConfig
from dro_grasp.optimize.starts import StartConfig
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.simulation.protocols import changed
from dro_grasp.simulation.trial import simulate
from dro_grasp.training.data.engine.worker import EngineConfig, valid_grasps
from lab.benchmarks.report import emit
from lab.benchmarks.synthesis import HANDS, training_objects

OBJECTS = 6
"""Training objects, drawn with seed 1."""
NARROW = StartConfig(openness=(0.45, 0.85), joint_noise=0.08)
"""Starts around half-open joints."""


def choices(candidates: int) -> dict[str, EngineConfig]:
    """Configurations by name."""
    all_hold = ContactConfig(idle=0.0)
    return {
        "the engine's": EngineConfig(candidates=candidates),
        "idle fingers stay": EngineConfig(candidates=candidates, close_fingers=False),
        "a finger is idle with 0.3": EngineConfig(
            candidates=candidates, synthesis=SynthesisConfig(contacts=ContactConfig(idle=0.3))),
        "labels as synthesized": EngineConfig(candidates=candidates, settle=False),
        "400 steps, best third evaluated": EngineConfig(
            candidates=candidates, trial_share=0.34, synthesis=SynthesisConfig(steps=400)),
        "every finger holds": EngineConfig(candidates=candidates, synthesis=SynthesisConfig(contacts=all_hold)),
        "narrow starts, every finger holds": EngineConfig(
            candidates=candidates, synthesis=SynthesisConfig(starts=NARROW, contacts=all_hold)),
    }


def measure(hand_name: str, objects: list[str], config: EngineConfig) -> list[object]:
    """Valid grasps, per CPU-hour, fingers, diversity and its parts, median penetration [mm], success with less friction [%]."""
    hand, batches, seconds = load_hand(hand_name), [], 0.0
    for name in objects:
        obj = load_object(name)
        _ = obj.distance_field, obj.parts
        start = time.process_time()
        grasps, _ = valid_grasps(hand, obj, 5, config)
        seconds += time.process_time() - start
        batches.append(grasps)
    joined = GraspBatch.concatenate(batches)
    spread = diversity(joined.T_object_wrist, joined.joints)
    depth = float(joined.penetration.median()) * 1e3
    slippery = changed("strict", friction=0.5)
    held = sum(int(simulate(hand, load_object(n), b, slippery).success.sum()) for n, b in zip(objects, batches, strict=True))
    share, everyone = finger_contact(joined.fingers_in_contact, len(hand.fingers))
    fingers = f"{100 * share:.0f} ({100 * everyone:.0f})"
    return [len(joined), 3600 * len(joined) / seconds, fingers, *(f"{v:.3f}" for v in spread.values()), depth,
            100 * held / max(1, len(joined))]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--candidates", type=int, default=128, help="grasps synthesized for each pair")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    objects = random.Random(1).sample(training_objects(), OBJECTS)
    rows = [
        [hand, name, *measure(hand, objects, config)]
        for hand in HANDS for name, config in choices(options.candidates).items()
    ]
    emit(f"{options.candidates} candidates on each of {OBJECTS} training objects", rows,
         ["hand", "choice", "valid", "per CPU-hour", "fingers", "diversity", "wrist", "joints", "penetration [mm]",
          "friction 0.5 [%]"],
         {"rows": [[str(cell) for cell in row] for row in rows]}, options.json)


if __name__ == "__main__":
    main()
