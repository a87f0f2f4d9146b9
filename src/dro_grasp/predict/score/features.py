"""What the ranking network sees of a grasp: each link at the object's surface, and the grasp as a whole.

Differs from the paper, which ranks by the grasp energy alone: the energy knows nothing of the closing motion, and most
predicted grasps fail because fingers that arrive one after the other push the object away.

A new feature is one entry of LINK_FEATURES or GRASP_FEATURES; then train the network again (lab/recipe/ranking.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import complete
from dro_grasp.optimize.grasp_energy import TERMS, GraspEnergy, NearestPoints

NEAR = 0.005  # Distance from the surface at which a link's nearness is 1/e [m] (ours)
LENGTH = 0.05  # Positions and sizes are given to the network in this unit [m] (ours)
MOTION = 0.01  # Gaps and motions are given to the network in this unit [m] (ours)
FARTHEST = 0.05  # Links farther away than this look alike [m] (ours)


@dataclass(frozen=True)
class LinkMeasures:
    """n grasps of an object; each of the l links that have surface points stands at its point nearest to the object.

    Vectors are in the object's frame; `palm_axes` turns them into the palm's, in which all hands look alike.
    """

    gap: Float[Tensor, "n l"]  # signed distance to the object [m]
    object_normal: Float[Tensor, "n l 3"]  # outward, as that of the link
    link_normal: Float[Tensor, "n l 3"]
    position: Float[Tensor, "n l 3"]  # position relative to the object's centre [m]
    arriving: Float[Tensor, "n l 3"]  # motion from the pregrasp to the grasp [m]
    closing: Float[Tensor, "n l 3"]  # motion from the grasp to the squeeze [m]
    is_palm: Float[Tensor, "n l"]  # 1 for the palm, 0 for other links
    palm_axes: Float[Tensor, "n 3 3"]  # axes of the palm as columns
    terms: Float[Tensor, "n terms"]  # weighted terms of the grasp energy
    size: Float[Tensor, " n"]  # typical distance of the object's surface from its centre [m]
    offset: Float[Tensor, " n"]  # distance of the grasp centre from the object's centre [m]

    @property
    def nearness(self) -> Float[Tensor, "n l"]:
        """From 0, far from the object, to 1, on its surface."""
        return torch.exp(-self.gap.clamp_min(0) / NEAR)

    def along(self, vectors: Float[Tensor, "n l 3"]) -> Float[Tensor, "n l"]:
        """Components along the object's normal."""
        return (vectors * self.object_normal).sum(-1)


class Feature(NamedTuple):
    """One or several numbers for the network."""

    width: int  # how many numbers
    of: Callable[[LinkMeasures], Float[Tensor, "n *rest"]]
    """Computes them: (n l) or (n l width) for each link, (n) or (n width) for the whole grasp."""


LINK_FEATURES = {
    "gap": Feature(1, lambda s: s.gap.clamp(-FARTHEST, FARTHEST) / MOTION),
    "normals": Feature(1, lambda s: s.along(s.link_normal)),
    "arriving": Feature(1, lambda s: -s.along(s.arriving) / MOTION),
    "closing": Feature(1, lambda s: -s.along(s.closing) / MOTION),
    "palm": Feature(1, lambda s: s.is_palm),
    "nearness": Feature(1, lambda s: s.nearness),
    "object normal": Feature(3, lambda s: s.object_normal @ s.palm_axes),
    "position": Feature(3, lambda s: s.position @ s.palm_axes / LENGTH),
    "closing vector": Feature(3, lambda s: s.closing @ s.palm_axes / MOTION),
    "within reach": Feature(1, lambda s: (s.gap < FARTHEST).to(s.gap)),
}
"""Features of each link, in the order of the network's inputs."""
GRASP_FEATURES = {
    "energy terms": Feature(len(TERMS), lambda s: s.terms.clamp_min(0).log1p()),
    "object size": Feature(1, lambda s: s.size / LENGTH),
    "centre offset": Feature(1, lambda s: s.offset / LENGTH),
}
"""Features of the whole grasp, in the order of the network's inputs."""


class GraspFeatures(NamedTuple):
    """The network's inputs for n grasps."""

    links: Float[Tensor, "n l link_features"]
    nearness: Float[Tensor, "n l"]
    whole: Float[Tensor, "n grasp_features"]


def feature_names() -> list[str]:
    """Names of all features."""
    return [*LINK_FEATURES, *GRASP_FEATURES]


def grasp_features(energy: GraspEnergy, grasps: GraspBatch, terms: Float[Tensor, "n terms"]) -> GraspFeatures:
    """Features of grasps of one hand on one object, whose energy has these weighted terms."""
    state = grasp_state(energy, grasps, terms)

    def table(features: dict[str, Feature], *shape: int) -> Float[Tensor, "*shape features"]:
        return torch.cat([feature.of(state).reshape(*shape, feature.width) for feature in features.values()], -1)

    return GraspFeatures(table(LINK_FEATURES, *state.gap.shape), state.nearness, table(GRASP_FEATURES, len(state.gap)))


def _of_rows(value: float | Float[Tensor, "n 1"], like: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """A value that all rows share, or each has, as one for each."""
    return value[:, 0] if isinstance(value, Tensor) else torch.full_like(like, value)


def grasp_state(energy: GraspEnergy, grasps: GraspBatch, terms: Float[Tensor, "n terms"]) -> LinkMeasures:
    """Grasps as their features see them; arguments as for `grasp_features`."""
    hand, device = energy.hand, energy.device
    grasps = complete(energy.source, grasps, energy.centres.cpu())
    T, q, pregrasp, squeeze = (
        x.to(device) for x in (grasps.T_object_wrist, grasps.joints, grasps.pregrasp_joints, grasps.squeeze_joints))
    near = NearestPoints.of(energy, T, q)
    before, after = (near.pick(hand.points(joints, T)) for joints in (pregrasp, squeeze))
    offset = (hand.grasp_centres(T)[:, None] - energy.centres)[:, 0].norm(dim=-1)
    return LinkMeasures(
        gap=near.gap, object_normal=near.object_normals, link_normal=near.link_normals, position=near.points - energy.centres,
        arriving=near.points - before, closing=after - near.points,
        is_palm=(near.links == hand.palm).to(near.gap).expand_as(near.gap), palm_axes=T[:, :3, :3] @ hand.palm_axes_wrist,
        terms=terms, size=_of_rows(energy.lengths, offset), offset=offset,
    )
