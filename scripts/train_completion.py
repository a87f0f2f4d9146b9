"""Train the network that completes objects seen in part, on views of training objects whose whole surface is known.

    python scripts/train_completion.py --folder FOLDER [--part K N] [--steps N] [--collect-only]

Each object is seen as it is and stretched, by half and by a depth camera, from many sides; its true signed distance is asked
for near its surface, near what symmetries guess, and around both. Views of one object are remembered in the folder, so that
the script can be stopped and started again, and other processes can take other objects. Errors on objects left out are
reported; the network that is written to the package has seen them all. Needs the development assets.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from dro_grasp.errors import ObjectError
from dro_grasp.models.completion_network import SHIPPED, SurfaceNetwork
from dro_grasp.models.small_networks import save_small
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.loading import mesh_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.objects.surface_distances import signed_distances
from dro_grasp.perception.camera import DepthCamera
from dro_grasp.perception.completion import GUESSES, THINNEST, looked_at, surface_features
from dro_grasp.perception.partial_views import seen_side

Kind = Literal["half", "depth"]
KINDS: tuple[Kind, ...] = ("half", "depth")
"""How objects are seen."""
SHAPES, SIDES, PLACES = 5, 4, 1536
"""Shapes of each object, of which the first is its own; sides from which each is seen each way; places asked for in a view."""
STRETCH = (0.7, 1.35)
"""Factors of a stretched object's extents."""
BLUR, AROUND = 0.006, 0.02
"""Distance of places from surfaces, as a standard deviation, and how far the others reach beyond both surfaces [m]."""
AWAY = 0.006
"""Places that are this far from all seen points were not seen [m]."""
DISTANCE, NOISE, FEWEST = (0.35, 0.7), (0.0, 0.0015), 40
"""Cameras' distances and noise [m], and fewest points that they see."""
STANDING = 0.5
"""Share of depth images in which the vertical is known."""
FARTHEST = 0.03
"""Distances beyond this are all alike [m]."""
VIEWS, SOME, RATE, DECAY, AVERAGE = 32, 384, 1e-3, 1e-4, 0.998
"""Views in a batch, places of each; learning rate, weight decay, decay of the averaged weights."""
EVERY = 6
"""One in so many objects is left out of the first fit."""


class Views(NamedTuple):
    """Places in v views."""

    guessed: Tensor
    """(v n 5) [m]."""
    features: Tensor
    """(v n 20)."""
    truth: Tensor
    """(v n) [m]."""
    kind: Tensor
    """(v): index into KINDS."""
    unseen: Tensor
    """(v n): whether a place is away from all that was seen."""


def stretched(obj: ObjectModel, rng: np.random.Generator) -> ObjectModel:
    """The object with other extents."""
    assert obj.vertices is not None
    assert obj.faces is not None
    mesh = trimesh.Trimesh(obj.vertices * rng.uniform(*STRETCH, 3), obj.faces, process=False)
    return mesh_object(obj.name, mesh, origin=obj.name)


def asked(obj: ObjectModel, kind: Kind, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """One view: guessed distances, features, true distances, and what is away from all seen; None where too little is seen."""
    camera = DepthCamera(distance=rng.uniform(*DISTANCE), noise=rng.uniform(*NOISE))
    points, normals, place = seen_side(obj, kind, int(rng.integers(1 << 30)), camera)
    if len(points) < FEWEST:
        return None
    side, axes, middle = looked_at(points, normals, place)
    if side.width < THINNEST:
        return None
    up = axes[2] if place is not None and rng.uniform() < STANDING else None
    guesses = side.guesses(up, GUESSES)
    true = (obj.cloud - middle) @ axes
    guessed = np.concatenate([g.points for g in guesses])
    both, n = np.concatenate([true, guesses[0].points]), PLACES // 3
    near = [rng.choice(surface, n) + BLUR * rng.normal(size=(n, 3)) for surface in (true, guessed)]
    places = np.concatenate([*near, rng.uniform(both.min(0) - AROUND, both.max(0) + AROUND, (n, 3))])
    told = surface_features(side, guesses, places)
    assert obj.vertices is not None
    assert obj.faces is not None
    truth = signed_distances(obj.vertices, obj.faces, places @ axes.T + middle)
    unseen = side.space.query(places)[0] > AWAY
    return told.guessed, told.features, torch.from_numpy(truth).float(), torch.from_numpy(unseen)


def collect(label: str, seed: int) -> Views:
    """Views of one object and its stretched shapes."""
    rng, own, found, kinds = np.random.default_rng(seed), load_object(label), [], []
    for shape in range(SHAPES):
        try:
            obj = own if shape == 0 else stretched(own, rng)
        except ObjectError as error:
            print(f"{label}: {error}")
            continue
        for k, kind in enumerate(KINDS):
            views = [view for view in (asked(obj, kind, rng) for _ in range(SIDES)) if view is not None]
            found += views
            kinds += [k] * len(views)
    guessed, features, truth, unseen = (torch.stack(column) for column in zip(*found, strict=True))
    return Views(guessed, features, truth, torch.tensor(kinds), unseen)


def joined(parts: list[Views]) -> Views:
    """All views in one."""
    return Views(*(torch.cat(column) for column in zip(*parts, strict=True)))


def error(predicted: Tensor, truth: Tensor) -> Tensor:
    """How far distances are off; it does not matter how far away a place is that is far away [m]."""
    return (predicted.clamp(-FARTHEST, FARTHEST) - truth.clamp(-FARTHEST, FARTHEST)).abs()


def fit(views: Views, steps: int, seed: int) -> SurfaceNetwork:
    """The averaged weights after so many steps."""
    torch.manual_seed(seed)
    network = SurfaceNetwork(GUESSES, views.features.shape[-1])
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(AVERAGE))
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps, pct_start=0.05)
    for _ in range(steps):
        view, place = torch.randint(len(views.truth), (VIEWS, 1)), torch.randint(views.truth.shape[1], (VIEWS, SOME))
        loss = error(network(views.guessed[view, place], views.features[view, place]), views.truth[view, place]).mean()
        optimiser.zero_grad()
        (1e3 * loss).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        average.update_parameters(network)
    network.load_state_dict(average.module.state_dict())
    return network.eval()


@torch.no_grad()
def report(network: SurfaceNetwork, views: Views) -> None:
    """Errors where nothing was seen, beside those of the best symmetry."""
    for k, kind in enumerate(KINDS):
        some = Views(*(column[views.kind == k] for column in views))
        predicted = torch.cat([network(g, f) for g, f in zip(some.guessed.split(16), some.features.split(16), strict=True)])
        for name, values in (("best symmetry", some.guessed[..., 0]), ("network", predicted)):
            near = some.unseen & (some.truth.abs() < 0.01)
            inside = ((values < 0) == (some.truth < 0))[some.unseen].float().mean()
            print(f"{kind}, unseen, {name}: {1e3 * error(values, some.truth)[near].mean():.2f} mm off near the surface, "
                  f"{100 * inside:.1f} % on the right side of it")


def main() -> None:
    """Collect, fit without some objects and report, fit with all and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="where views are remembered")
    parser.add_argument("--part", type=int, nargs=2, default=(0, 1), metavar=("K", "N"), help="collect the k-th of n parts")
    parser.add_argument("--steps", type=int, default=2500, help="of each of the two fits")
    parser.add_argument("--seed", type=int, default=0, help="of everything")
    parser.add_argument("--collect-only", action="store_true", help="do not fit")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.folder.mkdir(exist_ok=True)
    labels = resolve_objects(["assets:train", "builtin:train"])
    for k, label in list(enumerate(labels))[options.part[0]::options.part[1]]:
        path = options.folder / f"{label.replace('/', '-')}-{options.seed}.pt"
        if not path.exists():
            torch.save(tuple(collect(label, options.seed * len(labels) + k)), path)
            print(label, flush=True)
    if options.collect_only:
        return
    parts = [Views(*torch.load(path, weights_only=True)) for path in sorted(options.folder.glob("*.pt"))]
    left_out = [part for k, part in enumerate(parts) if k % EVERY == 0]
    report(fit(joined([p for k, p in enumerate(parts) if k % EVERY]), options.steps, options.seed), joined(left_out))
    SHIPPED.parent.mkdir(exist_ok=True)
    save_small(fit(joined(parts), options.steps, options.seed), SHIPPED)


if __name__ == "__main__":
    main()
