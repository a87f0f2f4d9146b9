"""How well the hand encoder recognises a point: in another pose of its hand, and on other hands.

    python -m lab.studies.matching_rank [--weights NAME|PATH] [--picture PNG] [--json]

Within a hand the counterpart is the point itself; across hands it is the nearest one after the palms of both open hands
are aligned. Ranks are means over points and grasps on validate objects; chance is half of the number of points. The picture
paints each point of every grasping hand like the most similar point of the first, open hand. Needs the development assets.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor
from torch.nn import functional

from dro_grasp.geometry.rendering.rasterizer import Camera, dots, render
from dro_grasp.hands.hand import Hand
from dro_grasp.network.checkpoints import load_weights
from dro_grasp.network.encoder import StaticGraphEncoder
from dro_grasp.pictures.sheets import contact_sheet
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.measures import matching_rank, mean_rank
from dro_grasp.training.samples import SampleSource
from lab.benchmarks.distance_error import validation_bundle
from lab.benchmarks.report import emit
from lab.benchmarks.synthesis import HANDS

TILE = (300, 300)
"""Width and height of a hand's picture [pixels]."""


def counterparts(a: Hand, b: Hand) -> Int[Tensor, " n_a"]:
    """For each point of one open hand, the point of another open hand in the same place.

    Points are compared in the palm's axes about the grasp centre, after both hands are scaled to one size. One hand is
    mirrored if that fits better, so that a left hand matches a right one.
    """
    ours, theirs = _normalized(a), _normalized(b)
    mirrored = ours * ours.new_tensor([1, -1, 1])
    distances = [torch.cdist(cloud, theirs) for cloud in (ours, mirrored)]
    best = min(distances, key=lambda d: float(d.amin(1).mean() + d.amin(0).mean()))
    return best.argmin(1)


def _normalized(hand: Hand) -> Float[Tensor, "n 3"]:
    """The open hand's points in the palm's axes about the grasp centre, scaled to a root mean square of 1."""
    points = (hand.points(hand.canonical_joints()) - hand.grasp_centre_wrist) @ hand.palm_axes_wrist
    return points / points.square().sum(-1).mean().sqrt()


def draw(encoder: StaticGraphEncoder, source: SampleSource, path: Path) -> None:
    """The colour-matching picture: the first hand open and grasping, then the others grasping."""
    first = source.hands[source.names[0]]
    axes = source.network.axes
    reference = first.points(first.canonical_joints()) @ axes(first.palm_axes_wrist)
    span = reference.amax(0) - reference.amin(0)
    colours = ((reference - reference.amin(0)) / span.clamp_min(1e-6)).mul(0.85).add(0.1)
    tiles, captions = [tile(reference, colours)], [(f"{first.name}, open", None)]
    for name in source.names:
        hand, grasps = source.hands[name], source.grasps[name]
        points = hand.points(grasps.joints[0]) @ axes(hand.palm_axes_wrist)
        tiles.append(tile(points, colours[most_similar(encoder, points, reference)]))
        captions.append((f"{name}, grasping", None))
    sheet = contact_sheet(tiles, captions, "each point in the colour of the most similar point of the first hand", len(tiles))
    Image.Image.save(sheet, path)


def tile(points: torch.Tensor, colours: torch.Tensor) -> np.ndarray:
    """One hand as coloured dots."""
    cloud = points.numpy()
    meshes = [dots(p[None], tuple(c), radius=0.005) for p, c in zip(cloud, colours.tolist(), strict=True)]
    return render(meshes, Camera.around(cloud, (0.6, -1.0, 0.5), aspect=TILE[0] / TILE[1]), *TILE)


@torch.no_grad()
def most_similar(
    encoder: StaticGraphEncoder, points: Float[Tensor, "n 3"], reference: Float[Tensor, "m 3"]
) -> Int[Tensor, " n"]:
    """For each point of a hand, the point of a reference hand with the most similar feature; both in the network's axes."""
    features = [functional.normalize(encoder((c - c.mean(0))[None])[0], dim=-1) for c in (points, reference)]
    return (features[0] @ features[1].mT).argmax(1)


def main() -> None:
    """Measure, draw and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default=None, help="name of shipped weights, or a weights file")
    parser.add_argument("--picture", type=Path, default=None, help="PNG to draw")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(1)
    network = load_weights(options.weights)
    source = SampleSource(validation_bundle(list(HANDS)), network.config, AugmentationConfig())
    generator = torch.Generator().manual_seed(0)
    within = matching_rank(network.hand_encoder, source, generator)
    rows = []
    for a in source.names:
        across = [within[a] if a == b else mean_rank(
            network.hand_encoder, source, (a, b), counterparts(source.hands[a], source.hands[b]), generator)
            for b in source.names]
        rows.append([a, *across])
    if options.picture is not None:
        draw(network.hand_encoder, source, options.picture)
    emit(f"mean rank of counterparts, weights '{network.name}'; chance is {network.config.n_hand / 2:.0f}", rows,
         ["grasping", *(f"{name}, open" for name in source.names)],
         {str(row[0]): dict(zip(source.names, row[1:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
