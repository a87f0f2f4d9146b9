"""Volume and samples of surfaces, and selection of points."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

COINCIDENT = 1e-7
"""Edge of a cube whose points count as one [m] (ours): single precision rounds a metre by as much, and trees that divide space
until each cell has one point never end on points that coincide."""


def point_distances(a: Float[Tensor, "*#b n 3"], b: Float[Tensor, "*#b m 3"]) -> Float[Tensor, "*#b n m"]:
    """Distance of each point of one cloud to each of another [m], as their coordinates give it."""
    if a.is_cuda:  # whose kernel takes a block of threads for each distance
        return (a[..., :, None, :] - b[..., None, :, :]).norm(dim=-1)
    # PyTorch's form by a matrix product loses half of the digits, and its gradient is not finite where points meet.
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def enclosed_volume(triangles: Float[np.ndarray, "n 3 3"]) -> float:
    """Signed volume inside a closed surface [m^3], by the divergence theorem; positive if corners run counter-clockwise."""
    a, b, c = triangles.transpose(1, 0, 2)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)


def sample_surface(
    vertices: Float[Tensor, "n_vertices 3"], faces: Int[Tensor, "n_faces 3"], count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "count 3"], Float[Tensor, "count 3"], Int[Tensor, " count"]]:
    """Points uniform on a triangle mesh [m], their unit normals (outward for counter-clockwise faces), and their faces."""
    corners = vertices[faces]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = cross.norm(dim=-1)
    if len(faces) == 0 or float(area.sum()) <= 0:
        raise ValueError("the mesh has no area to sample; give at least one triangle that is not degenerate")
    total = area.double().cumsum(0)
    pick = torch.rand(count, generator=generator, dtype=torch.float64) * total[-1]
    chosen = torch.searchsorted(total, pick).clamp(max=len(faces) - 1)
    uv = torch.rand(count, 2, generator=generator).to(vertices)
    root = uv[:, :1].sqrt()
    weights = torch.cat([1 - root, root * (1 - uv[:, 1:]), root * uv[:, 1:]], -1)
    points = (weights[..., None] * corners[chosen]).sum(1)
    return points, torch.nn.functional.normalize(cross[chosen], dim=-1), chosen


def farthest_points(points: Float[Tensor, "*batch n 3"], count: int, start: int = 0) -> Int[Tensor, "*batch count"]:
    """Farthest point sampling: each next point is the one farthest from all before it; the first of several wins."""
    n = points.shape[-2]
    if count > n:
        raise ValueError(f"{count} points were asked for, the cloud has {n}; ask for fewer or give more")
    flat = points.reshape(-1, n, 3)
    rows = torch.arange(len(flat), device=points.device)
    chosen = torch.empty(len(flat), count, dtype=torch.int64, device=points.device)
    nearest = torch.full(flat.shape[:2], torch.inf, device=points.device, dtype=points.dtype)
    current = torch.full((len(flat),), start, dtype=torch.int64, device=points.device)
    for i in range(count):
        chosen[:, i] = current
        nearest = torch.minimum(nearest, (flat - flat[rows, current][:, None]).square().sum(-1))
        current = nearest.argmax(-1)
    return chosen.reshape(*points.shape[:-2], count)


def distinct_points(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " k"]:
    """Indices, in ascending order, of points that do not coincide in single precision: the first in each cube of COINCIDENT."""
    with np.errstate(over="ignore"):
        cells = np.rint(points.astype(np.float32).astype(np.float64) / COINCIDENT)
    order, first = np.lexsort(cells.T), np.ones(len(points), bool)
    first[1:] = (cells[order[1:]] != cells[order[:-1]]).any(1)
    return np.sort(order[first])


def one_per_cell(points: Float[np.ndarray, "n 3"], edge: float) -> Int[np.ndarray, " k"]:
    """Which of some points to keep so that each cube of this edge [m] keeps one, the first in it."""
    cells = np.floor(points / edge).astype(np.int64)
    cells -= cells.min(0)
    return np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(0) + 1)), return_index=True)[1]


def random_half(points: Float[Tensor, "n 3"], count: int, generator: torch.Generator) -> Int[Tensor, " count"]:
    """Indices of random points in the half of a cloud that lies along a random direction. Source: appendix, partial clouds."""
    # Twice as many points as wanted are drawn, and those with the smaller product of position and direction removed.
    if len(points) < 2 * count:
        raise ValueError(f"a random half of {count} points needs a cloud of {2 * count} points, got {len(points)}")
    drawn = torch.randperm(len(points), generator=generator)[: 2 * count]
    return drawn[nearer_half(points[drawn], torch.randn(3, generator=generator).to(points))]


def nearer_half(points: Float[Tensor, "*b n 3"], direction: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b half"]:
    """Indices of the half of the points farthest along a direction, in ascending order."""
    along = (points @ direction[..., None])[..., 0]
    return along.topk(points.shape[-2] // 2, dim=-1).indices.sort(dim=-1).values


def even_directions(count: int) -> Float[Tensor, "count 3"]:
    """Unit vectors spread evenly over the sphere, from the top down (Fibonacci sphere)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    angle, radius = math.pi * (1 + math.sqrt(5)) * i, (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)
