"""Dense samples on the outside of a hand's links."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.descriptions.loader import Description
from dro_grasp.geometry.point_clouds import sample_surface
from dro_grasp.kinematics.tree import KinematicTree

POINTS_PER_LINK_SAMPLED = 512
"""Points sampled on each link before farthest point sampling. Source: appendix, robot point cloud sampling."""
NUDGE = 5e-4
"""Samples this close in front of another shape of their link are where the two meet, not outside [m]."""


@dataclass(frozen=True)
class LinkSurface:
    """Samples on the links from the palm on."""

    points: Float[Tensor, "n 3"]
    """In their links' frames [m]."""
    normals: Float[Tensor, "n 3"]
    """Outward unit normals, in their links' frames."""
    link: Int[Tensor, " n"]
    """The link of each point."""

    def thinned(self, step: int) -> LinkSurface:
        """Every `step`-th sample."""
        return LinkSurface(self.points[::step], self.normals[::step], self.link[::step])

    def middle(self, link: int) -> Float[Tensor, "3"]:
        """Mean of a link's samples, in its frame [m]."""
        return self.points[self.link == link].mean(0)

    def posed(self, tree: KinematicTree, q: Float[Tensor, " n_dof"]) -> tuple[np.ndarray, np.ndarray]:
        """Points (n 3) [m] and normals (n 3) in the root link's frame."""
        T = tree.forward(q)[self.link]
        points = (T[:, :3, :3] @ self.points[..., None])[..., 0] + T[:, :3, 3]
        return points.numpy(), (T[:, :3, :3] @ self.normals[..., None])[..., 0].numpy()


def sample_links(description: Description, links: list[int], seed: int) -> LinkSurface:
    """Dense samples on what MuJoCo collides, or on the visual shapes of links that do not collide."""
    generator = torch.Generator().manual_seed(seed)
    points, normals, index = [], [], []
    for link in links:
        shapes = [g for g in description.geometry if g.link == link]
        shapes = [g for g in shapes if g.collides] or shapes
        p, n = _sample_shapes([(g.vertices, g.faces) for g in shapes], generator)
        points.append(p)
        normals.append(n)
        index.append(torch.full((len(p),), link))
    return LinkSurface(torch.cat(points), torch.cat(normals), torch.cat(index))


def _sample_shapes(
    shapes: list[tuple[np.ndarray, np.ndarray]], generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Samples on the outside of a union of convex shapes."""
    vertices = torch.cat([torch.tensor(v, dtype=torch.float32) for v, _ in shapes])
    starts = np.cumsum([0, *[len(v) for v, _ in shapes]])
    faces = torch.cat([torch.tensor(f.astype(np.int64)) + int(s) for (_, f), s in zip(shapes, starts, strict=False)])
    owner = torch.cat([torch.full((len(f),), i) for i, (_, f) in enumerate(shapes)])
    points, normals, face = sample_surface(vertices, faces, 4 * POINTS_PER_LINK_SAMPLED, generator)
    hidden = torch.zeros(len(points), dtype=torch.bool)
    if len(shapes) > 1:
        for i, (v, f) in enumerate(shapes):
            others = (owner[face] != i).nonzero()[:, 0]
            hidden[others] |= _inside_convex(points[others] + NUDGE * normals[others], v, f)
    seen = (~hidden).nonzero()[:, 0]
    seen = seen if len(seen) >= POINTS_PER_LINK_SAMPLED // 4 else torch.arange(len(points))
    seen = seen[:POINTS_PER_LINK_SAMPLED]
    return points[seen], normals[seen]


def _inside_convex(points: Float[Tensor, "n 3"], vertices: np.ndarray, faces: np.ndarray) -> Bool[Tensor, " n"]:
    """Mask of points behind all faces of a convex shape."""
    corners = torch.tensor(vertices, dtype=torch.float32)[torch.tensor(faces.astype(np.int64))]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    low, high = corners.amin((0, 1)), corners.amax((0, 1))
    inside = ((points >= low) & (points <= high)).all(1)
    near = points[inside]
    height = ((near[:, None] - corners[None, :, 0]) * normal).sum(-1)
    inside[inside.clone()] = (height < -1e-4 * normal.norm(dim=-1)).all(1)
    return inside
