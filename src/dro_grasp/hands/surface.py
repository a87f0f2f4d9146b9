"""Dense samples on the outside of a hand's links."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.errors import HandError
from dro_grasp.geometry import se3
from dro_grasp.geometry.point_clouds import sample_surface
from dro_grasp.hands.description.loader import Description
from dro_grasp.hands.description.tree_reading import LinkGeometry
from dro_grasp.hands.kinematics.tree import KinematicTree

SAMPLES_PER_LINK = 512
"""Points sampled on each link before farthest point sampling. Source: appendix, robot point cloud sampling."""
NUDGE = 5e-4  # Samples this close to another shape of their link lie where the two shapes meet, not outside [m] (ours)


@dataclass(frozen=True)
class LinkSurface:
    """Samples on the links from the palm on."""

    points: Float[Tensor, "n 3"]  # in their links' frames [m]
    normals: Float[Tensor, "n 3"]  # outward unit normals, in their links' frames
    link: Int[Tensor, " n"]  # the link of each point

    def thinned(self, step: int) -> LinkSurface:
        """Every `step`-th sample."""
        return LinkSurface(self.points[::step], self.normals[::step], self.link[::step])

    def middle(self, link: int) -> Float[Tensor, "3"]:
        """Mean of a link's samples, in its frame [m]."""
        return self.points[self.link == link].mean(0)

    def posed(
        self, tree: KinematicTree, q: Float[Tensor, " n_dof"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Points [m] and normals in the root link's frame."""
        T = tree.forward(q)[self.link]
        return se3.apply(T, self.points).numpy(), se3.rotate(T[:, :3, :3], self.normals).numpy()


def sample_links(description: Description, links: list[int], seed: int) -> LinkSurface:
    """Samples of links' collision shapes as MuJoCo uses them, or else of visual ones; HandError: a link's have no area."""
    generator = torch.Generator().manual_seed(seed)
    points, normals, index = [], [], []
    for link in links:
        shapes = [g for g in description.geometry if g.link == link]
        shapes = [g for g in shapes if g.collides] or shapes
        try:
            p, n = _sample_shapes(shapes, generator)
        except ValueError as error:
            raise HandError(f"the shapes of link '{description.tree.link_names[link]}' have no area; give it a shape that is "
                            "not flat in two directions") from error
        points.append(p)
        normals.append(n)
        index.append(torch.full((len(p),), link))
    return LinkSurface(torch.cat(points), torch.cat(normals), torch.cat(index))


def _sample_shapes(shapes: list[LinkGeometry], generator: torch.Generator) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Points and normals on the outside of a union of convex shapes."""
    vertices = torch.cat([torch.tensor(s.vertices, dtype=torch.float32) for s in shapes])
    starts = np.cumsum([0, *[len(s.vertices) for s in shapes]])
    faces = torch.cat([torch.tensor(s.faces.astype(np.int64)) + int(i) for s, i in zip(shapes, starts, strict=False)])
    owner = torch.cat([torch.full((len(s.faces),), i) for i, s in enumerate(shapes)])
    points, normals, face = sample_surface(vertices, faces, 4 * SAMPLES_PER_LINK, generator)
    hidden = torch.zeros(len(points), dtype=torch.bool)
    if len(shapes) > 1:
        for i, shape in enumerate(shapes):
            others = (owner[face] != i).nonzero()[:, 0]
            hidden[others] |= _inside_convex(points[others] + NUDGE * normals[others], shape)
    seen = (~hidden).nonzero()[:, 0]
    seen = seen if len(seen) >= SAMPLES_PER_LINK // 4 else torch.arange(len(points))
    seen = seen[:SAMPLES_PER_LINK]
    return points[seen], normals[seen]


def _inside_convex(points: Float[Tensor, "n 3"], shape: LinkGeometry) -> Bool[Tensor, " n"]:
    """Whether each point lies behind all faces of a convex shape."""
    corners = torch.tensor(shape.vertices, dtype=torch.float32)[torch.tensor(shape.faces.astype(np.int64))]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    low, high = corners.amin((0, 1)), corners.amax((0, 1))
    inside = ((points >= low) & (points <= high)).all(1)
    near = points[inside]
    height = ((near[:, None] - corners[None, :, 0]) * normal).sum(-1)
    inside[inside.clone()] = (height < -1e-4 * normal.norm(dim=-1)).all(1)
    return inside
