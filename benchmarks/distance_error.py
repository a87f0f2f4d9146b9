"""How far predicted distances are off, with z from the true grasp (posterior) and with z as it is drawn (prior).

Measured on the grasps that ship for the validate objects, which no weights were trained on; the open hand is placed near
the true grasp, as far off as in training. Equal errors mean that the latent says nothing.

    python benchmarks/distance_error.py [--weights NAME|PATH] [--json]

Needs the development assets.
"""

from __future__ import annotations

import argparse

import torch
from report import ROOT, emit
from synthesis import HANDS

from dro_grasp import distance_matrix
from dro_grasp.datasets.bundle import Bundle, HandGrasps, ObjectCloud
from dro_grasp.datasets.collections import read_collection
from dro_grasp.datasets.merging import file_name
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.models.checkpoints import load_weights
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.objects.library import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.losses import divergence
from dro_grasp.training.samples import SampleSource

SAMPLES = 400
"""Placed hands, of each hand."""


@torch.no_grad()
def distance_errors(network: DistanceNetwork, hand: Hand, objects: list[ObjectModel], grasps: list[GraspBatch]) -> list[float]:
    """Mean absolute error of D(R,O) [m] with posterior and with prior z, and the divergence of the two [nat]."""
    clouds = {o.name: ObjectCloud(torch.from_numpy(o.cloud), torch.from_numpy(o.cloud_normals)) for o in objects}
    index = torch.cat([torch.full((len(g),), i) for i, g in enumerate(grasps)])
    known = HandGrasps(torch.cat([g.T_object_wrist for g in grasps]), torch.cat([g.joints for g in grasps]), index)
    source = SampleSource(Bundle({hand.name: hand}, clouds, {hand.name: known}), network.config, AugmentationConfig())
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    samples = source.draw(hand.name, SAMPLES, generator)
    true = distance_matrix.build(samples.grasp, samples.obj)
    output = network(samples.placed, samples.obj, samples.grasp)
    nats = divergence(output.mean, output.log_variance, output.prior_mean, output.prior_log_variance).sum(-1).mean()
    prior = network.predict(samples.placed, samples.obj, network.sample_latent(SAMPLES, generator))
    return [*(float((d - true).abs().mean()) for d in (output.distances, prior)), float(nats)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default=None, help="name of shipped weights, or a weights file")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    network, rows = load_weights(options.weights), []
    for name in HANDS:
        hand = load_hand(name)
        pairs = [p.grasps for p in read_collection(ROOT / "data" / "grasps" / file_name(name))]
        grasps = [g for g in pairs if len(g) and g.split[0] == "validate"]
        objects = [load_object(g.object[0]) for g in grasps]
        posterior, prior, nats = distance_errors(network, hand, objects, grasps)
        rows.append([name, 1e3 * posterior, 1e3 * prior, nats])
    columns = ["hand", "posterior [mm]", "prior [mm]", "divergence [nat]"]
    emit(f"distance error of weights '{network.name}'", rows, columns,
         {str(row[0]): dict(zip(columns[1:], row[1:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
