"""The side of an object that nobody saw: symmetries propose it, a network decides between them, place by place.

Source: the network weighs the symmetries of `perception/symmetry.py`; its surface is where the signed distance is zero, as in
Park et al. 2019 (DeepSDF).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.models.completion_network import SurfaceNetwork, shipped_surface
from dro_grasp.objects.surface_distances import cloud_distances
from dro_grasp.perception.symmetry import Guess, SeenSide, nearest_points, projected

GUESSES = 5
"""Symmetries that the network decides between."""
SEEN = 2048
"""Seen points that guesses are made of."""
THINNEST = 1e-4
"""Width in the image below which nothing can be said of the other side [m]."""
CELLS = 20_000
"""About how many cells the grid has on which the surface is looked for: edges of 5 mm for a large can, 1 mm for a die."""
MARGIN = 0.01
"""How far the grid reaches beyond all guesses [m]."""
SPREAD, STEPS, CLOSE = 40_000, 4, 0.0005
"""Points that are moved to the surface, in so many steps, and how close they have to come [m]."""
NEAR, FINE, COARSE = 40, 0.002, 10
"""Of seen points one is kept in each cube whose edge is the object's width over the first number, but at least so long [m],
unless that is more than the width over the last."""
SMALL, LENGTH = 0.01, 0.05
"""Distances that the network sees as about 1/2, and lengths that it sees as 1 [m]."""


class CompletedCloud(NamedTuple):
    """Both sides of an object of which one was seen."""

    points: Float[np.ndarray, "k 3"]
    normals: Float[np.ndarray, "k 3"]
    """Outward, of length 1."""
    added: Bool[np.ndarray, " k"]
    """Which points nobody saw; they come last."""


class SurfaceFeatures(NamedTuple):
    """What the network is told of n places."""

    guessed: Float[Tensor, "n 5"]
    """Signed distances to the guesses [m]."""
    features: Float[Tensor, "n 20"]
    """The same, squeezed. Squeezed likewise: distance to the nearest seen point, height over its tangent plane, distance from
    the seen image, height over its surface there, heights above the end and the top of what was seen. Place along the view and
    across it; how little each guess agrees with what was seen; the seen width; whether there was a camera."""


def completed(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None = None,
    up: Float[np.ndarray, "3"] | None = None, network: SurfaceNetwork | None = None,
) -> CompletedCloud:
    """Both sides of an object of which one was seen, about as dense on either; of the seen points some are left out for that.

    To a line to the camera nothing is added.

    Args:
        points: Of the seen side [m].
        normals: Outward unit normals there.
        camera: Where it stands [m]. Without it the points are taken to be all that lies on one side of a plane, whose normal is
            then the mean of theirs.
        up: Unit vector along which the object stands, if it does: what stands is rather turned or mirrored upright.
        network: Decides between symmetries; the one that ships by default.
    """
    side, axes, middle = looked_at(points, normals, camera)
    if side.width < THINNEST:
        return CompletedCloud(points, normals, np.zeros(len(points), bool))
    guesses = side.guesses(None if up is None else up @ axes, GUESSES)
    surface, outward = zero_level(side, guesses, network or shipped_surface())
    apart = max(side.width / NEAR, min(FINE, side.width / COARSE))
    seen, seen_normals = _thinned(side.points, side.normals, apart)
    between = 2 * float(np.median(nearest_points(seen).query(seen, k=2)[0][:, 1]))
    near = side.space.query(surface)[0] < 1.5 * max(apart, between)
    # The points near the seen side have the density that is to be, over an area that has too many or too few.
    share = min(1.0, len(seen) / max(1, int(near.sum())))
    added = np.flatnonzero(~near)[: round(share * int((~near).sum()))]
    both, both_normals = np.concatenate([seen, surface[added]]), np.concatenate([seen_normals, outward[added]])
    return CompletedCloud(both @ axes.T + middle, both_normals @ axes.T, np.arange(len(both)) >= len(seen))


def looked_at(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None
) -> tuple[SeenSide, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """What was seen, in axes with z to the camera; the axes as columns; and the middle, from which they start [m]."""
    if len(points) > SEEN:
        kept = np.random.default_rng(0).permutation(len(points))[:SEEN]
        points, normals = points[kept], normals[kept]
    middle = points.mean(0)
    view = normals.mean(0) if camera is None else camera - middle
    away = float(np.linalg.norm(view))
    view = view / max(away, 1e-9)
    helper = np.eye(3)[np.abs(view).argmin()]
    across = np.cross(view, helper) / np.linalg.norm(np.cross(view, helper))
    axes = np.stack([across, np.cross(view, across), view], 1)
    return SeenSide.of((points - middle) @ axes, normals @ axes, None if camera is None else away), axes, middle


def surface_features(side: SeenSide, guesses: list[Guess], places: Float[np.ndarray, "n 3"]) -> SurfaceFeatures:
    """What the network is told of places in the axes of the seen side [m]; nothing in it depends on turns about the view."""
    guessed = np.stack([cloud_distances(g.points, g.normals, places) for g in guesses], 1)
    distance, nearest = side.space.query(places)
    over = ((places - side.points[nearest]) * side.normals[nearest]).sum(1)
    beside, hiding = side.image.query(projected(places, side.away))
    height = places[:, 2]
    metres = np.column_stack([
        guessed, distance, over, beside, height - side.points[hiding, 2], height - side.end, height - side.top])
    across = np.linalg.norm(places[:, :2], axis=1)
    whole = np.array([*(g.cost for g in guesses), side.width / LENGTH, float(side.away is not None)])
    features = np.column_stack([
        np.arcsinh(metres / SMALL) / 2, height / LENGTH, across / LENGTH, np.broadcast_to(whole, (len(places), len(whole)))])
    return SurfaceFeatures(torch.from_numpy(guessed).float(), torch.from_numpy(features).float())


@torch.no_grad()
def zero_level(
    side: SeenSide, guesses: list[Guess], network: SurfaceNetwork
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Points all over the surface and unit normals there, in the axes of the seen side.

    Where the network finds no surface they are those of the best guess.
    """
    from scipy.interpolate import RegularGridInterpolator

    everything = np.concatenate([g.points for g in guesses])
    low, high = everything.min(0) - MARGIN, everything.max(0) + MARGIN
    spacing = float((np.prod(high - low) / CELLS) ** (1 / 3))
    along = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*along, indexing="ij"), -1)
    distances = network(*surface_features(side, guesses, places.reshape(-1, 3))).double().numpy().reshape(places.shape[:3])
    model = np.stack([distances, *np.gradient(distances, spacing)], -1)
    inner = RegularGridInterpolator(along, model)

    def values(at: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
        return inner(np.clip(at, low, [axis[-1] for axis in along]))

    rng = np.random.default_rng(0)
    close = places[np.abs(distances) < 1.5 * spacing]
    if not len(close):
        return guesses[0].points, guesses[0].normals
    points = close[rng.integers(len(close), size=SPREAD)] + rng.uniform(-0.5, 0.5, (SPREAD, 3)) * spacing
    for _ in range(STEPS):
        here = values(points)
        points = points - here[:, :1] * here[:, 1:] / np.maximum((here[:, 1:] ** 2).sum(1, keepdims=True), 0.1)
    here = values(points)
    kept = (np.abs(here[:, 0]) < CLOSE) & (points > low).all(1) & (points < high).all(1)
    outward = here[kept, 1:]
    return points[kept], outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)


def _thinned(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], spacing: float
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """One point of each cell of a grid."""
    first = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_index=True)[1]
    return points[first], normals[first]
