"""Deviation of grasps from the requested palm direction, and the spread of directions without a request.

    python -m lab.studies.directions [--weights NAME|PATH] [--num N] [--json]

Each of the six half-axes is requested on each validate object; angles are those of the refined grasps. Without a direction,
each grasp counts for its nearest half-axis; uniform is 16.7 %. Needs the development assets.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.frames import HALF_AXES, half_axis, half_axis_direction
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.predictor import GraspPredictor
from lab.benchmarks.report import emit
from lab.benchmarks.synthesis import HANDS

ALONE: dict[str, Any] = {"candidates": 1, "source": "network", "least_confidence": 0.0}
"""What the network predicts, with nothing chosen among it or left out."""
KEPT = 20.0
"""Angle within which a direction counts as kept [degrees]."""


def palm_angles(hand: Hand, grasps: GraspBatch, direction: tuple[float, float, float]) -> Float[Tensor, " n"]:
    """Angle between the palm direction of each grasp and a requested direction of any length [rad]."""
    actual, requested = hand.palm_directions(grasps.T_object_wrist), torch.tensor(direction)
    sine = torch.linalg.cross(actual, requested.expand_as(actual), dim=-1).norm(dim=-1)
    return torch.atan2(sine, actual @ requested)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default=None, help="name of shipped weights, or a weights file")
    parser.add_argument("--num", type=int, default=16, help="grasps of each hand on each object in each direction")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    predictor = GraspPredictor(options.weights)
    objects = [load_object(name) for name in resolve_objects(["assets:validate"])]
    axes = [half_axis_direction(name) for name in HALF_AXES]
    rows = []
    for name in HANDS:
        hand = load_hand(name)
        asked = torch.cat([
            palm_angles(hand, predictor.predict(hand, obj, options.num, direction=axis, **ALONE), axis)
            for obj in objects for axis in axes]).rad2deg()
        free = torch.cat([
            hand.palm_directions(predictor.predict(hand, obj, 6 * options.num, **ALONE).T_object_wrist)
            for obj in objects])
        shares = 100 * torch.bincount(half_axis(free), minlength=6) / len(free)
        rows.append([name, len(asked), float(asked.median()), float(asked.quantile(0.95)),
                     float((asked <= KEPT).float().mean()) * 100, *shares.tolist()])
    columns = ["hand", "n", "median [deg]", "95 % [deg]", f"within {KEPT:.0f} deg [%]", *(f"{axis} [%]" for axis in HALF_AXES)]
    emit(f"palm directions of weights '{predictor.weights_name}'", rows, columns,
         {str(row[0]): dict(zip(columns[1:], row[1:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
