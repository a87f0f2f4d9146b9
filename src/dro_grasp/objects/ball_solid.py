"""A solid of a bare cloud: balls that touch its surface from inside, so that hollows stay hollow. Ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int

from dro_grasp.geometry.balls import Balls
from dro_grasp.objects.shape import ObjectModel

RADII = (0.008, 0.006, 0.004, 0.003, 0.002)
"""Radii of balls [m]; each point gets the largest that stays inside, or else the smallest (ours)."""
SPACING = 0.008
"""Distance between the points that are touched [m] (ours): between the largest balls the surface is 1 mm low."""
MOST = 2000
"""Balls of a solid at most (ours): larger things get larger balls, farther apart. Hands take in a few hundred."""
COARSER = 1.25
"""Factor of the spacing, until there are few enough (ours)."""
OUTSIDE = 0.0012
"""How far a ball may reach through the surface elsewhere [m] (ours)."""
ROUND = 1e-12
"""Added to the inertia at unit density [m^5], so that a flat cloud has one about every axis (ours)."""


def solid_of(obj: ObjectModel) -> ObjectModel:
    """What the closing of a hand is simulated on: a mesh as it is; a bare cloud with balls, and the mass of what it encloses.

    Trials take the cloud itself, and refuse it: what becomes of an estimate is no outcome.
    """
    if not obj.is_cloud or obj.balls is not None:
        return obj
    cell, inside = _enclosed(obj)
    centre = inside.mean(0)
    apart = inside - centre
    products = cell * apart.T @ apart
    return replace(
        obj, balls=_balls(obj), volume=cell * len(inside), centre_of_mass=centre,
        inertia=np.trace(products) * np.eye(3) - products + ROUND * np.eye(3))


def _enclosed(obj: ObjectModel) -> tuple[float, Float[np.ndarray, "n 3"]]:
    """Volume [m^3] and middles [m] of the cells inside a cloud; of those with points if it encloses none."""
    field = obj.distance_field
    nodes = np.indices(field.shape).reshape(3, -1).T[field.slopes[:, 0].numpy() < 0]
    inside = nodes * field.spacing + field.origin.numpy()
    if not len(inside):
        inside = (np.unique(np.floor(obj.cloud / field.spacing), axis=0) + 0.5) * field.spacing
    return field.spacing**3, inside.astype(float)


def _spread(cloud: Float[np.ndarray, "m 3"], spacing: float) -> Int[np.ndarray, " k"]:
    """Rows of points about this far apart [m]: the one nearest to the middle of each cell of a grid."""
    cells = np.floor(cloud / spacing)
    order = np.linalg.norm(cloud / spacing - cells - 0.5, axis=1).argsort(kind="stable")
    return order[np.unique(cells[order], axis=0, return_index=True)[1]]


def _balls(obj: ObjectModel) -> Balls:
    """Balls that touch a cloud with normals from inside."""
    cloud, radii, spacing = obj.cloud.astype(float), np.array(RADII), SPACING
    while len(rows := _spread(cloud, spacing)) > MOST:
        spacing *= COARSER
        radii = np.array([RADII[0] * spacing / SPACING, *RADII])
    centres = cloud[rows] - radii[:, None, None] * obj.cloud_normals[rows]
    depth = -obj.distance_field.distances(torch.from_numpy(centres).float())[0].numpy()
    fits = depth > radii[:, None] - OUTSIDE
    fits[-1] = True
    largest = fits.argmax(0)
    return Balls(torch.from_numpy(centres[largest, np.arange(len(rows))]), torch.from_numpy(radii[largest]))
