"""The side of an object that nobody saw, from a symmetry that agrees with the side that was seen.

Source: symmetries judged by what the camera sees, Thrun and Wegbreit 2005, Bohg et al. 2011; kinds and costs are our own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    from scipy.spatial import KDTree

SAMPLE, MOST = 300, 1200
"""Seen points that symmetries are judged by, and among which the rim is looked for."""
DEPTHS = (-0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.3, 0.5)
"""Centres that are tried, behind the rim of the seen side, in widths of the object."""
TILTS, TURNS = (0.3, 0.6, 0.9), 8
"""Angles between mirror planes and the image that are tried [rad], and directions of the tilt; half turns have as many axes."""
VISIBLE, GAP, KINK = 2.0, 1.0, 0.5
"""Weights of what should have been seen, of gaps at the rim, and of kinks there."""
WORST = 0.5
"""Distances beyond this count no more, in widths."""
TOLERANCE = 0.003
"""Deviation from what was seen that is taken for noise [m]."""
LAST, CUT = 0.02, 0.12
"""Shares of points that may lie behind where the seen side ends, and that are its rim when no camera is known."""
RIM, LOPSIDED, FEWEST = 0.12, 0.35, 8
"""With a camera, rim points are those whose neighbours, within so many widths, lie so far aside; and the fewest of them."""
ROUND = 0.3
"""Where the rim faces the camera by less than this, the surface is turning away, and goes on as a circle."""


def completed(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], towards: Float[np.ndarray, "3"] | None = None
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Points and normals of both sides of an object of which one was seen.

    The other side is the seen one, inverted, turned by half or mirrored: the way that shows least where the camera saw nothing,
    and that continues the seen side at its rim without gap or kink. What is seen face on is taken to be as thick as wide.

    Args:
        points: Of the seen side [m].
        normals: Outward unit normals there.
        towards: Unit vector to the camera. Without it the points are taken to be all that lies on one side of a plane, whose
            normal is then the mean of theirs.
    """
    mean = normals.mean(0)
    view = mean / max(float(np.linalg.norm(mean)), 1e-9) if towards is None else towards
    axes = _image_axes(view)
    side = _SeenSide.of(points @ axes, normals @ axes, towards is not None)
    linear, centre = min(side.symmetries(), key=lambda symmetry: side.cost(*symmetry))
    behind = (points @ axes - centre) @ linear.T + centre
    return (np.concatenate([points, behind @ axes.T]),
            np.concatenate([normals, normals @ axes @ linear.T @ axes.T]))


def _image_axes(view: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Columns: two directions in the image, and the one to the camera."""
    helper = np.eye(3)[np.abs(view).argmin()]
    across = np.cross(view, helper) / np.linalg.norm(np.cross(view, helper))
    return np.stack([across, np.cross(view, across), view], 1)


def _tree(points: Float[np.ndarray, "n d"]) -> KDTree:
    """For nearest points; SciPy is loaded when needed."""
    from scipy.spatial import KDTree

    return KDTree(points)


@dataclass(frozen=True)
class _SeenSide:
    """What was seen, with z to the camera."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    sample: Int[np.ndarray, " sample"]
    """Indices of the points that symmetries are judged by."""
    rim: Int[np.ndarray, " rim"]
    """Indices of those where the seen side ends."""
    expected: Float[np.ndarray, " rim"]
    """Gap that is to be left at each rim point [m]: the thickness of what is seen face on."""
    width: float
    end: float
    """Height below which nothing was seen [m]."""
    by_camera: bool

    @classmethod
    def of(cls, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], by_camera: bool) -> _SeenSide:
        """Find the rim."""
        image, height = points[:, :2], points[:, 2]
        angles = np.linspace(0, np.pi, 16, endpoint=False)
        width = float(np.ptp(image @ np.stack([np.cos(angles), np.sin(angles)]), axis=0).min())
        end, top = np.quantile(height, (LAST, 1 - LAST))
        shuffled = np.random.default_rng(0).permutation(len(points))
        if by_camera:
            some = shuffled[:MOST]
            near = _tree(image).query_ball_point(image[some], RIM * width)
            aside = np.array([np.linalg.norm(image[i].mean(0) - image[k]) for i, k in zip(near, some, strict=True)])
            rim = some[aside >= min(LOPSIDED * RIM * width, np.sort(aside)[-min(FEWEST, len(aside))])]
        else:
            rim = shuffled[height[shuffled] <= np.quantile(height, CUT)][:SAMPLE]
        facing = np.clip(normals[rim, 2], 0, 1)
        flat = max(0.0, width - (top - end)) if by_camera else 0.0
        expected = facing * np.where(facing < ROUND, width, flat)
        return cls(points, normals, shuffled[:SAMPLE], rim, expected, width, float(end), by_camera)

    def symmetries(self) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
        """Linear parts and fixed points of the motions that are tried."""
        image = self.points[:, :2]
        axes = np.linalg.eigh(np.cov(image.T))[1]
        along = image @ axes
        middle = axes @ (along.max(0) + along.min(0)) / 2
        turns = np.arange(TURNS) * 2 * np.pi / TURNS
        half_turns = [np.array([np.cos(a / 2), np.sin(a / 2), 0.0]) for a in turns]
        mirrors = [np.array([0.0, 0.0, 1.0])] + [
            np.array([np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)]) for tilt in TILTS for a in turns]
        linear = [-np.eye(3), *(2 * np.outer(a, a) - np.eye(3) for a in half_turns),
                  *(np.eye(3) - 2 * np.outer(m, m) for m in mirrors)]
        start = self.points[self.rim, 2].mean()
        return [(M, np.array([*middle, start - depth * self.width])) for depth in DEPTHS for M in linear]

    def cost(self, linear: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"]) -> float:
        """How little a symmetry agrees with what was seen; 0 is best."""
        wrong = self._shown((self.points[self.sample] - centre) @ linear.T + centre)
        # Every motion that is tried is its own inverse: what it takes to the rim is where it takes the rim.
        gap, nearest = self._space.query((self.points[self.rim] - centre) @ linear.T + centre)
        kink = 1 - (self.normals[nearest] @ linear.T * self.normals[self.rim]).sum(1)
        # What faces the camera ends at an edge, and says nothing of how it goes on.
        kink = kink * (1 - np.clip(self.normals[self.rim, 2], 0, 1))
        most = WORST * self.width
        return float(VISIBLE * np.minimum(wrong, most).mean() / self.width
                     + GAP * np.minimum(np.abs(gap - self.expected), most).mean() / self.width + KINK * kink.mean())

    @cached_property
    def _space(self) -> KDTree:
        return _tree(self.points)

    @cached_property
    def _image(self) -> KDTree:
        return _tree(self.points[:, :2])

    def _shown(self, moved: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        """How far points lie from where they would have been hidden [m]."""
        if not self.by_camera:
            return np.where(moved[:, 2] > self.end, self._space.query(moved)[0], 0.0)
        aside, nearest = self._image.query(moved[:, :2])
        before = moved[:, 2] - self.points[nearest, 2]
        return np.hypot(np.maximum(0, aside - TOLERANCE), np.maximum(0, before - TOLERANCE))
