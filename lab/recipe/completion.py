"""Train the network that completes objects seen in part, on views of training objects with known surfaces.

    python -m lab.recipe.completion --folder FOLDER [--output FILE] [--objects GROUP ...] [--steps N] [--workers N]

Each object is viewed in its own and in stretched shapes, as half of a cloud, by a depth camera from many sides, and most often
by one that sees it stand on a table. Cameras have no noise, that of each pixel alone, or that of a kind of camera. The network
learns the object's true signed distance near its surface, near the surfaces that symmetries guess, and around both. The folder
keeps the views of each object, so a stopped script resumes. It reports errors on objects left out of a first fit; the network
that is written is fitted to all. Assets are needed where objects are of them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from dro_grasp.errors import ObjectError
from dro_grasp.network.checkpoints import save_weights
from dro_grasp.network.completion_network import SHIPPED, SurfaceFeatures, SurfaceNetwork
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.loading import estimate_normals, mesh_object
from dro_grasp.objects.perception.completion import CODED, GUESSES, THINNEST, surface_features, to_view_axes
from dro_grasp.objects.perception.depth_noise import NoiseName
from dro_grasp.objects.perception.partial_views import DepthCamera, visible_points, visible_side
from dro_grasp.objects.perception.scan import ordinary
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.objects.surface_distances import signed_distances
from dro_grasp.provenance import made_by
from lab.recipe.parts import fill, fingerprint

Kind = Literal["half", "depth", "table"]
KINDS: tuple[Kind, ...] = ("half", "depth", "table")
"""Kinds of view."""
SHAPES = 5
"""Shapes of each object; the first is its own, the others are stretched."""
SIDES: dict[Kind, int] = {"half": 1, "depth": 3, "table": 5}
"""Views of each shape of each kind."""
PLACES = 1536
"""Points with a true distance in a view."""
KEPT = 384
"""Points of the visible side that are kept of a view; each batch takes others of them."""
STRETCH = (0.7, 1.35)
"""Range of the factors of a stretched object's extents."""
BLUR = 0.006
"""Standard deviation of points about surfaces [m]."""
AROUND = 0.02
"""Margin of the other points beyond both surfaces [m]."""
AWAY = 0.006
"""Points at least this far from all seen points are unseen [m]."""
DISTANCE = (0.35, 1.0)
"""Range of the cameras' distances [m]."""
PIXEL = (0.0012, 0.0036)
"""Range of the angle between pixels [rad]."""
NOISE = (0.0, 0.0015)
"""Range of the noise of each pixel alone [m]."""
KNOWN: tuple[NoiseName, ...] = ("none", "structured_light", "time_of_flight", "stereo")
"""Kinds of cameras; each has a view in five, as has noise of each pixel alone."""
ELEVATION = (0.35, 1.3)
"""Range of the angles of views of a table [rad]."""
CUT = (0.002, 0.006)
"""Range of the heights above a table below which points are cut off with it [m]."""
LEVEL = 0.001
"""Standard deviation of the height at which a table is found [m]."""
FEWEST = 40
"""Fewest seen points of a view that is used."""
STANDING = 0.5
"""Share of depth images without a table with a known up direction."""
RESTING = 0.7
"""Share of them in which the object rests as it may come to rest by itself; in the others, its own z axis is up."""
FARTHEST = 0.03
"""Distances are clamped to plus and minus this [m]."""
VIEWS = 32
"""Views in a batch."""
SOME = 384
"""Points of each of them."""
RATE = 1e-3
"""Peak learning rate."""
DECAY = 1e-2
"""Weight decay."""
AVERAGE = 0.998
"""Decay of the moving average of the weights."""
EVERY = 6
"""One in this many objects is left out of the first fit."""


class Views(NamedTuple):
    """Points in v views."""

    guessed: Float[Tensor, "v n guesses"]
    """Signed distances to the guessed surfaces [m]."""
    features: Float[Tensor, "v n features"]
    """Other features of the points."""
    truth: Float[Tensor, "v n"]
    """True signed distances [m]."""
    kind: Int[Tensor, " v"]
    """Index into KINDS."""
    unseen: Bool[Tensor, "v n"]
    """Whether a point is away from all seen points."""
    places: Float[Tensor, "v n 3"]
    """The points in view axes [m]."""
    seen: Float[Tensor, "v s 6"]
    """Points of the visible side in view axes [m], and their normals."""
    upright: Float[Tensor, " v"]
    """1 where y is the image of the upward direction, otherwise 0."""

    @property
    def told(self) -> SurfaceFeatures:
        """What the network is told."""
        return SurfaceFeatures(self.guessed, self.features, self.places, self.seen, self.upright)


def stretched(obj: ObjectModel, rng: np.random.Generator) -> ObjectModel:
    """The object with other extents."""
    assert obj.vertices is not None
    assert obj.faces is not None
    mesh = trimesh.Trimesh(obj.vertices * rng.uniform(*STRETCH, 3), obj.faces, process=False)
    return mesh_object(obj.name, mesh, origin=obj.name)


def camera_of(rng: np.random.Generator) -> DepthCamera:
    """A depth camera of a random kind at a random distance."""
    kind, distance = int(rng.integers(len(KNOWN) + 1)), rng.uniform(*DISTANCE)
    noise = rng.uniform(*NOISE) if kind == len(KNOWN) else KNOWN[kind]
    return DepthCamera(distance=distance, pixel=distance * rng.uniform(*PIXEL), noise=noise)


class Seen(NamedTuple):
    """What is known of an object, in its frame."""

    points: Float[np.ndarray, "n 3"]
    """The visible side [m]."""
    normals: Float[np.ndarray, "n 3"]
    """Its normals."""
    camera: Float[np.ndarray, "3"] | None
    """Place of the camera [m]."""
    up: Float[np.ndarray, "3"] | None
    """Upward direction."""
    table: Float[np.ndarray, "4"] | None
    """Plane on which it stands: upward normal, and height along it [m]."""


def seen_of(obj: ObjectModel, kind: Kind, up: Float[np.ndarray, "3"], rng: np.random.Generator) -> Seen | None:
    """One view of an object, which stands on a table with `up` upward if it does; None if too little is seen."""
    camera, seed = camera_of(rng), int(rng.integers(1 << 30))
    if kind == "half":
        return Seen(*visible_side(obj, kind, seed), None, None)
    towards = rng.normal(size=3)
    if kind == "table":
        angle, flat = rng.uniform(*ELEVATION), np.cross(up, towards)
        towards = np.sin(angle) * up + np.cos(angle) * flat / np.linalg.norm(flat)
    height = float((obj.vertices @ up).min())
    points = visible_points(obj, towards, torch.Generator().manual_seed(seed), camera).numpy().astype(np.float64)
    if kind == "table":
        points = points[points @ up - height > rng.uniform(*CUT)]
    if len(points) < FEWEST:
        return None
    points, place = points[ordinary(points)], camera.place(obj, torch.from_numpy(towards))
    normals = estimate_normals(points.astype(np.float32), place).astype(np.float64)
    table = np.append(up, height + LEVEL * rng.normal()) if kind == "table" else None
    known = table is not None or rng.uniform() < STANDING
    return Seen(points, normals, place, up if known else None, table)


def view_of(obj: ObjectModel, kind: Kind, up: Float[np.ndarray, "3"], rng: np.random.Generator) -> Views | None:
    """One view, without a dimension of views; None if too little is seen."""
    seen = seen_of(obj, kind, up, rng)
    if seen is None or len(seen.points) < FEWEST:
        return None
    side, axes, middle = to_view_axes(seen.points, seen.normals, seen.camera, seen.table, seen.up)
    if side.width < THINNEST:
        return None
    guesses = side.guesses(GUESSES)
    true = (obj.cloud - middle) @ axes
    guessed = np.concatenate([g.points for g in guesses])
    both, n = np.concatenate([true, guesses[0].points]), PLACES // 3
    near = [rng.choice(surface, n) + BLUR * rng.normal(size=(n, 3)) for surface in (true, guessed)]
    places = np.concatenate([*near, rng.uniform(both.min(0) - AROUND, both.max(0) + AROUND, (n, 3))])
    told = surface_features(side, guesses, places)
    assert obj.vertices is not None
    assert obj.faces is not None
    truth = signed_distances(obj.vertices, obj.faces, places @ axes.T + middle)
    unseen = side.tree.query(places)[0] > AWAY
    kept = rng.choice(len(side.points), KEPT, replace=len(side.points) < KEPT)
    visible = np.concatenate([side.points[kept], side.normals[kept]], 1)
    return Views(told.guessed, told.features, torch.from_numpy(truth).float(), torch.tensor(KINDS.index(kind)),
                 torch.from_numpy(unseen), told.places, torch.from_numpy(visible).float(), told.upright)


def resting(obj: ObjectModel, rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A direction that is upward where the object rests, the surest ones most often."""
    hull = trimesh.Trimesh(obj.vertices, obj.faces, process=False).convex_hull
    poses, shares = trimesh.poses.compute_stable_poses(hull, center_mass=obj.centre_of_mass, n_samples=1, threshold=0.0)
    return poses[rng.choice(len(poses), p=shares / shares.sum())][2, :3]


def collect(shapes: int, given: tuple[str, int]) -> tuple[tuple[Tensor, ...], str]:
    """Views of the object of this name, seen with this seed, and of its stretched shapes, and what to print of them."""
    label, seed = given
    rng, own, found = np.random.default_rng(seed), load_object(label), []
    for shape in range(shapes):
        try:
            obj = own if shape == 0 else stretched(own, rng)
        except ObjectError as error:
            print(f"{label}: {error}")
            continue
        for kind, sides in SIDES.items():
            ups = [resting(obj, rng) if rng.uniform() < RESTING else np.eye(3)[2] for _ in range(sides)]
            found += [view for view in (view_of(obj, kind, up, rng) for up in ups) if view is not None]
    if not found:
        raise ValueError(f"nothing is seen of {label}")
    return tuple(torch.stack(column) for column in zip(*found, strict=True)), f"{len(found)} views"


def joined(parts: list[Views]) -> Views:
    """All views in one."""
    return Views(*(torch.cat(column) for column in zip(*parts, strict=True)))


def error(predicted: Float[Tensor, "*n"], truth: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Errors of clamped distances [m]."""
    return (predicted.clamp(-FARTHEST, FARTHEST) - truth.clamp(-FARTHEST, FARTHEST)).abs()


def fit(views: Views, steps: int, seed: int) -> SurfaceNetwork:
    """The averaged weights after the given number of steps."""
    torch.manual_seed(seed)  # of the initial weights
    generator = torch.Generator().manual_seed(seed)
    network = SurfaceNetwork(GUESSES, views.features.shape[-1])
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(AVERAGE))
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps, pct_start=0.05)
    for _ in range(steps):
        view = torch.randint(len(views.truth), (VIEWS, 1), generator=generator)
        place = torch.randint(views.truth.shape[1], (VIEWS, SOME), generator=generator)
        point = torch.randint(views.seen.shape[1], (VIEWS, CODED), generator=generator)
        # Half of the views are mirrored, left to right: other features stay the same.
        side = torch.ones(VIEWS, 1, 6)
        side[torch.rand(VIEWS, generator=generator) < 0.5] = torch.tensor([-1.0, 1, 1, -1, 1, 1])
        predicted = network(SurfaceFeatures(
            views.guessed[view, place], views.features[view, place], views.places[view, place] * side[..., :3],
            views.seen[view, point] * side, views.upright[view[:, 0]]))
        loss = error(predicted, views.truth[view, place]).mean()
        optimiser.zero_grad()
        (1e3 * loss).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        average.update_parameters(network)
    network.load_state_dict(average.module.state_dict())
    return network.eval()


@torch.no_grad()
def errors(network: SurfaceNetwork, views: Views) -> dict[str, dict[str, float]]:
    """Errors at unseen points near the surface [m], and the share on the right side of it, also of the best symmetry."""
    found = {}
    for k, kind in enumerate(KINDS):
        some = Views(*(column[views.kind == k] for column in views))
        if not len(some.kind):
            continue
        parts = (Views(*part) for part in zip(*(column.split(16) for column in some), strict=True))
        predicted = torch.cat([network(v.told) for v in parts])
        for name, values in (("best symmetry", some.guessed[..., 0]), ("network", predicted)):
            near = some.unseen & (some.truth.abs() < 0.01)
            found[f"{kind}, {name}"] = {
                "error": float(error(values, some.truth)[near].mean()),
                "right side": float(((values < 0) == (some.truth < 0))[some.unseen].float().mean())}
    return found


def main() -> None:
    """Collect, fit without some objects and measure, fit with all and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="folder for the views")
    parser.add_argument("--output", type=Path, default=SHIPPED, help="where the network is written")
    parser.add_argument("--objects", nargs="+", default=["assets:train", "builtin:train"], help="training objects")
    parser.add_argument("--shapes", type=int, default=SHAPES, help="shapes of each object; all but one are stretched")
    parser.add_argument("--steps", type=int, default=2500, help="steps of each of the two fits")
    parser.add_argument("--workers", type=int, default=1, help="processes that collect, then threads of a fit")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything")
    parser.add_argument("--collect-only", action="store_true", help="do not fit")
    options = parser.parse_args()
    torch.set_num_threads(options.workers)
    options.folder.mkdir(parents=True, exist_ok=True)
    labels = resolve_objects(options.objects)
    tasks = [(options.folder / f"{label.replace('/', '-')}-{options.seed}.pt", (label, options.seed * len(labels) + k))
             for k, label in enumerate(labels)]
    fill(collect, options.shapes, tasks, options.workers)
    if options.collect_only:
        return
    files = sorted(options.folder.glob("*.pt"))
    parts = [Views(*torch.load(path, weights_only=True)) for path in files]
    left_out = [part for k, part in enumerate(parts) if k % EVERY == 0]
    apart = fit(joined([p for k, p in enumerate(parts) if k % EVERY]), options.steps, options.seed)
    found = errors(apart, joined(left_out))
    for name, measured in found.items():
        print(f"{name}: error {1e3 * measured['error']:.2f} mm near the surface, {100 * measured['right side']:.1f} % on the "
              "right side of it")
    about = {
        "stage": "completion", **made_by(), "steps": options.steps, "seed": options.seed, "metrics": found,
        "samples": options.steps * VIEWS * SOME,
        "data": {"objects": len(parts), "views": sum(len(part.kind) for part in parts), "fingerprint": fingerprint(files)}}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    save_weights(fit(joined(parts), options.steps, options.seed), options.output, about)


if __name__ == "__main__":
    main()
