"""What the side that nobody saw may look like: symmetries that agree with the side that was seen.

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
VISIBLE, GAP = 3.0, 1.0
"""Weights of what should have been seen, and of gaps at the rim."""
KINK, SEEN_KINK = 0.5, 0.1
"""Weights of kinks at the rim: of a cut, and of an image, where normals are less sure."""
LEANING, FLAT = 0.1, 0.999
"""Cost of symmetries that do not keep the vertical; cosine to the view from which a camera looks straight down."""
APART = 0.05
"""Guesses closer to each other than this are one, in widths."""
WORST = 0.5
"""Distances beyond this count no more, in widths."""
TOLERANCE = 0.003
"""Deviation from what was seen that is taken for noise [m]."""
LAST, CUT = 0.02, 0.12
"""Shares of points that may lie behind where the seen side ends, and that are its rim when no camera is known."""
RIM, LOPSIDED, FEWEST = 0.12, 0.35, 8
"""With a camera, rim points are those whose neighbours, within so many widths, lie so far aside; and the fewest of them."""
ROUND = 0.35
"""Cosine between the normal and the ray below which a surface at the rim is taken to turn away, not to end at an edge."""


def _lean(linear: Float[np.ndarray, "3 3"], up: Float[np.ndarray, "3"] | None) -> float:
    """Cost of a motion that does not keep the vertical."""
    return 0.0 if up is None or np.allclose(linear @ up, up, atol=1e-6) else LEANING


def nearest_points(points: Float[np.ndarray, "n d"]) -> KDTree:
    """A tree that finds the nearest of some points; SciPy is loaded when needed."""
    from scipy.spatial import KDTree

    return KDTree(points)


def projected(points: Float[np.ndarray, "n 3"], away: float | None) -> Float[np.ndarray, "n 2"]:
    """Where points are in the image of a camera so far along z, in metres at the height 0."""
    return points[:, :2] if away is None else points[:, :2] / (1 - points[:, 2:] / away)


@dataclass(frozen=True)
class Guess:
    """A side that was seen together with what a symmetry adds, in the axes of the seen side."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    cost: float
    """How little it agrees with what was seen; 0 is best."""


@dataclass(frozen=True)
class SeenSide:
    """What was seen, in axes with z to the camera."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    away: float | None
    """Distance of the camera along z, where one is known [m]."""
    sample: Int[np.ndarray, " sample"]
    """Indices of the points that symmetries are judged by."""
    rim: Int[np.ndarray, " rim"]
    """Indices of those where the seen side ends."""
    expected: Float[np.ndarray, " rim"]
    """Gap that is to be left at each rim point [m]: the thickness of what is seen face on."""
    smooth: Float[np.ndarray, " rim"]
    """Weight of kinks there: how sure it is that the surface goes on without an edge."""
    width: float
    end: float
    """Height below which nothing was seen [m]."""
    top: float
    """Height above which nothing was seen [m]."""

    @classmethod
    def of(cls, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], away: float | None) -> SeenSide:
        """Find the rim, and how the surface goes on there."""
        image, height = projected(points, away), points[:, 2]
        angles = np.linspace(0, np.pi, 16, endpoint=False)
        width = float(np.ptp(image @ np.stack([np.cos(angles), np.sin(angles)]), axis=0).min())
        end, top = np.quantile(height, (LAST, 1 - LAST))
        shuffled = np.random.default_rng(0).permutation(len(points))
        if away is None:
            rim = shuffled[height[shuffled] <= np.quantile(height, CUT)][:SAMPLE]
            rays, flat = np.array([[0.0, 0.0, 1.0]]), 0.0
        else:
            some = shuffled[:MOST]
            near = nearest_points(image).query_ball_point(image[some], RIM * width)
            aside = np.array([np.linalg.norm(image[i].mean(0) - image[k]) for i, k in zip(near, some, strict=True)])
            rim = some[aside >= min(LOPSIDED * RIM * width, np.sort(aside)[-min(FEWEST, len(aside))])]
            rays, flat = np.array([0.0, 0.0, away]) - points[rim], max(0.0, width - float(top - end))
        facing = np.clip((normals[rim] * rays).sum(1) / np.linalg.norm(rays, axis=1), 0, 1)
        # A surface that turns away goes on as a circle; one that faces the camera ends at an edge.
        expected = facing * np.where(facing < ROUND, width, flat)
        smooth = KINK * (1 - facing) if away is None else SEEN_KINK * np.clip(1 - facing / ROUND, 0, 1)
        return cls(points, normals, away, shuffled[:SAMPLE], rim, expected, smooth, width, float(end), float(top))

    def guesses(self, up: Float[np.ndarray, "3"] | None, count: int) -> list[Guess]:
        """Both sides by the likeliest symmetries that differ, best first; the last is repeated where there are too few.

        Args:
            up: Unit vector along which the object stands, if it does: what stands is rather turned or mirrored upright.
            count: How many.
        """
        motions = self.symmetries(up)
        costs = np.array([self.cost(*motion) + _lean(motion[0], up) for motion in motions])
        found: list[Guess] = []
        sampled: list[KDTree] = []
        for k in costs.argsort():
            linear, centre = motions[k]
            some = (self.points[self.sample] - centre) @ linear.T + centre
            if any(tree.query(some)[0].mean() < APART * self.width for tree in sampled):
                continue
            sampled.append(nearest_points(some))
            behind = (self.points - centre) @ linear.T + centre
            found.append(Guess(np.concatenate([self.points, behind]),
                               np.concatenate([self.normals, self.normals @ linear.T]), float(costs[k])))
            if len(found) == count:
                break
        return found + found[-1:] * (count - len(found))

    def symmetries(self, up: Float[np.ndarray, "3"] | None) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
        """Linear parts and fixed points of the motions that are tried."""
        across = self.points[:, :2]
        axes = np.linalg.eigh(np.cov(across.T))[1]
        if up is not None and abs(up[2]) < FLAT:
            # What stands has its middle along the horizon; of what lies anyhow, the principal axes are the best guess.
            axes = np.array([[up[1], up[0]], [-up[0], up[1]]]) / np.hypot(up[0], up[1])
        along = across @ axes
        middle = axes @ (along.max(0) + along.min(0)) / 2
        turns = np.arange(TURNS) * 2 * np.pi / TURNS
        half_turns = [np.array([np.cos(a / 2), np.sin(a / 2), 0.0]) for a in turns]
        mirrors = [np.array([0.0, 0.0, 1.0])] + [
            np.array([np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)]) for tilt in TILTS for a in turns]
        if up is not None:
            # Of what is upright, the half turn and the mirrors that the image's axes do not offer.
            half_turns.append(up)
            ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up if abs(up[2]) < FLAT else np.cross(up, [1.0, 0.0, 0.0])
            ahead /= np.linalg.norm(ahead)
            mirrors += [np.cos(a) * ahead + np.sin(a) * np.cross(up, ahead) for t in (0.0, *TILTS) for a in {t, -t}]
        linear = [-np.eye(3), *(2 * np.outer(a, a) - np.eye(3) for a in half_turns),
                  *(np.eye(3) - 2 * np.outer(m, m) for m in mirrors)]
        start = self.points[self.rim, 2].mean()
        return [(M, np.array([*middle, start - depth * self.width])) for depth in DEPTHS for M in linear]

    def cost(self, linear: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"]) -> float:
        """How little a symmetry agrees with what was seen; 0 is best."""
        wrong = self._shown((self.points[self.sample] - centre) @ linear.T + centre)
        # Every motion that is tried is its own inverse: what it takes to the rim is where it takes the rim.
        taken = (self.points[self.rim] - centre) @ linear.T + centre
        gap, nearest = self.space.query(taken)
        # Before the seen side instead of behind it, the object would be thinner than nothing.
        gap = gap * np.where(taken[:, 2] > self.points[nearest, 2], -1.0, 1.0)
        kink = 1 - (self.normals[nearest] @ linear.T * self.normals[self.rim]).sum(1)
        most = WORST * self.width
        far = VISIBLE * np.minimum(wrong, most).mean() + GAP * np.minimum(np.abs(gap - self.expected), most).mean()
        return float(far / self.width + (kink * self.smooth).mean())

    @cached_property
    def space(self) -> KDTree:
        """For seen points that are nearest."""
        return nearest_points(self.points)

    @cached_property
    def image(self) -> KDTree:
        """For seen points that are nearest in the image."""
        return nearest_points(projected(self.points, self.away))

    def _shown(self, moved: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        """How far points lie from where they would have been hidden [m]."""
        if self.away is None:
            return np.where(moved[:, 2] > self.end, self.space.query(moved)[0], 0.0)
        aside, nearest = self.image.query(projected(moved, self.away))
        before = moved[:, 2] - self.points[nearest, 2]
        return np.hypot(np.maximum(0, aside - TOLERANCE), np.maximum(0, before - TOLERANCE))
