"""Completion of an object's unseen side: symmetries propose it, and a network chooses between them, point by point.

Source: the network weighs the symmetries of `perception/symmetry.py`; its surface is where the signed distance is zero, as in
Park et al. 2019 (DeepSDF).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree
from torch import Tensor

from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.network.completion_network import SurfaceNetwork, shipped_surface
from dro_grasp.objects.perception.symmetry import Guess, VisibleSide, project
from dro_grasp.objects.surface_distances import cloud_distances

GUESSES = 5  # Symmetries that the network chooses between (ours)
VISIBLE_POINTS = 2048  # Most visible points that guesses are made of (ours)
THINNEST = 1e-4  # Width in the image below which nothing can be said of the other side [m] (ours)
CELLS = 20_000  # Approximate number of grid cells for the surface (ours): edges of 5 mm for a large can, 1 mm for a die
MARGIN = 0.01  # Distance that the grid extends beyond all guesses [m] (ours)
SPREAD = 40_000  # Points that are moved onto the surface (ours)
SMALL = 0.01  # Distance that the network receives as about 1/2 [m] (ours)
LENGTH = 0.05  # Length that the network receives as 1 [m] (ours)


class CompletedCloud(NamedTuple):
    """Both sides of an object."""

    points: Float[np.ndarray, "k 3"]
    normals: Float[np.ndarray, "k 3"]  # outward, of length 1
    added: Bool[np.ndarray, " k"]  # which points are completed, not seen; they come last


class SurfaceFeatures(NamedTuple):
    """Input of the network at n places."""

    guessed: Float[Tensor, "n 5"]  # signed distances to the guesses [m]
    features: Float[Tensor, "n 20"]
    """The same distances, squeezed by asinh. Squeezed likewise: distance to the nearest visible point, height over its tangent
    plane, distance from the image, height over the surface there, heights above the end and the top of the visible side.
    Then: position along the view and across it, the cost of each guess, the visible width, and whether there is a camera."""


def complete_cloud(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None = None,
    up: Float[np.ndarray, "3"] | None = None, network: SurfaceNetwork | None = None,
) -> CompletedCloud:
    """Complete the unseen side. Both sides get about the same density, for which visible points are thinned.

    If all points lie on one viewing ray, the cloud is returned unchanged.

    Args:
        points: Points of the visible side [m].
        normals: Their outward unit normals.
        camera: Its position [m]; without it, the points are all on one side of a plane, whose normal is the mean of theirs.
        up: Up direction, if known; symmetries that preserve it are preferred.
        network: Chooses between symmetries; the shipped one by default.
    """
    side, axes, middle = to_view_axes(points, normals, camera)
    if side.width < THINNEST:
        return CompletedCloud(points, normals, np.zeros(len(points), bool))
    guesses = side.guesses(None if up is None else up @ axes, GUESSES)
    surface, outward = extract_surface(side, guesses, network or shipped_surface())
    # One visible point is kept per cube of a fortieth of the width, but not below 2 mm or a tenth of the width (ours).
    apart = max(side.width / 40, min(0.002, side.width / 10))
    first = one_per_cell(side.points, apart)
    seen, seen_normals = side.points[first], side.normals[first]
    between = 2 * float(np.median(KDTree(seen).query(seen, k=2)[0][:, 1]))
    near = side.tree.query(surface)[0] < 1.5 * max(apart, between)
    # Extracted points near the visible side cover the same area as the thinned visible points: the ratio of the two
    # counts is the share of extracted points that gives the other side the same density.
    share = min(1.0, len(seen) / max(1, int(near.sum())))
    added = np.flatnonzero(~near)[: round(share * int((~near).sum()))]
    both, both_normals = np.concatenate([seen, surface[added]]), np.concatenate([seen_normals, outward[added]])
    return CompletedCloud(both @ axes.T + middle, both_normals @ axes.T, np.arange(len(both)) >= len(seen))


def to_view_axes(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None
) -> tuple[VisibleSide, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """The visible side in view axes, with z to the camera; these axes as columns; and their origin, the middle [m]."""
    if len(points) > VISIBLE_POINTS:
        kept = np.random.default_rng(0).permutation(len(points))[:VISIBLE_POINTS]
        points, normals = points[kept], normals[kept]
    middle = points.mean(0)
    view = normals.mean(0) if camera is None else camera - middle
    length = float(np.linalg.norm(view))
    view = view / max(length, 1e-9)
    helper = np.eye(3)[np.abs(view).argmin()]
    across = np.cross(view, helper) / np.linalg.norm(np.cross(view, helper))
    axes = np.stack([across, np.cross(view, across), view], 1)
    return VisibleSide.of((points - middle) @ axes, normals @ axes, None if camera is None else length), axes, middle


def surface_features(side: VisibleSide, guesses: list[Guess], places: Float[np.ndarray, "n 3"]) -> SurfaceFeatures:
    """Input of the network at places in view axes [m]; it does not depend on rotations about the view."""
    guessed = np.stack([cloud_distances(g.points, g.normals, places) for g in guesses], 1)
    distance, nearest = side.tree.query(places)
    over = ((places - side.points[nearest]) * side.normals[nearest]).sum(1)
    beside, hiding = side.image_tree.query(project(places, side.camera_distance))
    height = places[:, 2]
    metres = np.column_stack([
        guessed, distance, over, beside, height - side.points[hiding, 2], height - side.end, height - side.top])
    across = np.linalg.norm(places[:, :2], axis=1)
    whole = np.array([*(g.cost for g in guesses), side.width / LENGTH, float(side.camera_distance is not None)])
    features = np.column_stack([
        np.arcsinh(metres / SMALL) / 2, height / LENGTH, across / LENGTH, np.broadcast_to(whole, (len(places), len(whole)))])
    return SurfaceFeatures(torch.from_numpy(guessed).float(), torch.from_numpy(features).float())


@torch.no_grad()
def extract_surface(
    side: VisibleSide, guesses: list[Guess], network: SurfaceNetwork
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Points on the network's zero level and their unit normals, in view axes; those of the best guess if there is none."""
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
    # Newton steps x - s grad s / |grad s|^2; the floor on the slope limits steps where the field is flat.
    for _ in range(4):  # (ours)
        here = values(points)
        points = points - here[:, :1] * here[:, 1:] / np.maximum((here[:, 1:] ** 2).sum(1, keepdims=True), 0.1)
    here = values(points)
    arrived = np.abs(here[:, 0]) < 0.0005  # [m] (ours)
    kept = arrived & (points > low).all(1) & (points < high).all(1)
    outward = here[kept, 1:]
    return points[kept], outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
