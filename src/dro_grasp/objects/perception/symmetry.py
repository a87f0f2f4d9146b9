"""Guesses of an object's unseen side: symmetries that agree with its visible side.

A symmetry is a motion x -> M (x - c) + c that is its own inverse (M^2 = I): the inversion M = -I, a half turn
M = 2 a a^T - I about the axis a, or a mirror M = I - 2 m m^T with the normal m. It maps the visible side onto a guess of the
hidden one. A guess is good if the camera could not have seen it (it lies behind the visible side, inside its image), and if
it meets the visible side at the rim without a gap or a kink.

Lengths are in units of the object's width in the image, unless a unit is given.

Source: symmetries judged by visibility, Thrun and Wegbreit 2005, Bohg et al. 2011; motions and costs are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

SAMPLE = 300  # Visible points that judge a symmetry (ours)
DEPTHS = (-0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.3, 0.5)  # Depths of the centre c behind the rim [widths] (ours)
TILTS = (0.3, 0.6, 0.9)  # Angles between mirror planes and the image [rad] (ours)
TURNS = 8  # Directions of the tilt, and axes of half turns in the image (ours)
STRAIGHT_DOWN = 0.999  # Cosine between view and vertical above which a camera counts as looking straight down (ours)
TOLERANCE = 0.003  # Deviation from the visible side that counts as noise [m] (ours)
STRAY = 0.02  # Share of points that may lie below the end of the visible side, and above its top (ours)
RIM_RADIUS = 0.12  # With a camera: radius of the neighbourhood that tells rim points [widths] (ours)
TURNS_AWAY = 0.35
"""Cosine between normal and ray below which the surface at the rim turns away; above, it ends at an edge (ours)."""


def project(points: Float[np.ndarray, "n 3"], camera_distance: float | None) -> Float[np.ndarray, "n 2"]:
    """Image coordinates for a camera on the z axis, in metres at height 0; parallel rays without a camera."""
    return points[:, :2] if camera_distance is None else points[:, :2] / (1 - points[:, 2:] / camera_distance)


@dataclass(frozen=True)
class Guess:
    """The visible side together with its image under a symmetry, in view axes."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    cost: float  # disagreement with the visible side; 0 is best


@dataclass(frozen=True)
class VisibleSide:
    """The visible side of an object in view axes: z points to the camera."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    camera_distance: float | None  # distance of the camera along z, if there is one [m]
    sample: Int[np.ndarray, " sample"]  # indices of the points that judge symmetries
    rim: Int[np.ndarray, " rim"]  # indices of the points where the visible side ends
    expected_gap: Float[np.ndarray, " rim"]  # expected gap between both sides at each rim point [m]: the hidden thickness there
    smoothness: Float[np.ndarray, " rim"]
    """Weight of a kink at each rim point: confidence that the surface continues without an edge."""
    width: float  # smallest extent in the image [m]
    end: float  # height below which nothing is visible [m]
    top: float  # height above which nothing is visible [m]

    @classmethod
    def of(
        cls, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera_distance: float | None
    ) -> VisibleSide:
        """Find the rim, and predict how the surface continues there.

        In an image, a point belongs to the rim if its neighbours lie to one side of it. A cloud cut by a plane has its rim
        along the cut, at its lowest points.
        """
        image, height = project(points, camera_distance), points[:, 2]
        angles = np.linspace(0, np.pi, 16, endpoint=False)
        width = float(np.ptp(image @ np.stack([np.cos(angles), np.sin(angles)]), axis=0).min())
        end, top = np.quantile(height, (STRAY, 1 - STRAY))
        shuffled = np.random.default_rng(0).permutation(len(points))
        if camera_distance is None:
            rim = shuffled[height[shuffled] <= np.quantile(height, 0.12)][:SAMPLE]  # the lowest points (ours)
            rays, flat = np.array([[0.0, 0.0, 1.0]]), 0.0
        else:
            some = shuffled[:1200]  # (ours)
            near = KDTree(image).query_ball_point(image[some], RIM_RADIUS * width)
            aside = np.array([np.linalg.norm(image[i].mean(0) - image[k]) for i, k in zip(near, some, strict=True)])
            # A rim point is as far as this from the middle of its neighbours; there are eight at least (ours).
            rim = some[aside >= min(0.35 * RIM_RADIUS * width, np.sort(aside)[-min(8, len(aside))])]
            rays, flat = np.array([0.0, 0.0, camera_distance]) - points[rim], max(0.0, width - float(top - end))
        facing = np.clip((normals[rim] * rays).sum(1) / np.linalg.norm(rays, axis=1), 0, 1)
        # A surface that turns away continues as a circle: where the ray meets a circle of diameter w with the cosine f to
        # its normal, the chord is f w. One that faces the camera ends at an edge: it is taken to be as thick as wide, less
        # the depth that is visible.
        expected = facing * np.where(facing < TURNS_AWAY, width, flat)
        # In an image normals are less certain than at a cut (ours).
        smooth = 0.5 * (1 - facing) if camera_distance is None else 0.1 * np.clip(1 - facing / TURNS_AWAY, 0, 1)
        return cls(points, normals, camera_distance, shuffled[:SAMPLE], rim, expected, smooth, width, float(end), float(top))

    def guesses(self, up: Float[np.ndarray, "3"] | None, count: int) -> list[Guess]:
        """Both sides by the best symmetries that differ, best first; those that preserve `up` [view axes] are preferred."""
        motions = self.symmetries(up)
        leaning = [up is not None and not np.allclose(linear @ up, up, atol=1e-6) for linear, _ in motions]
        costs = np.array([self.cost(*motion) for motion in motions]) + 0.1 * np.array(leaning)  # (ours)
        found: list[Guess] = []
        sampled: list[KDTree] = []
        for k in costs.argsort():
            linear, centre = motions[k]
            some = (self.points[self.sample] - centre) @ linear.T + centre
            if any(tree.query(some)[0].mean() < 0.05 * self.width for tree in sampled):
                continue  # guesses that are so near count as one (ours)
            sampled.append(KDTree(some))
            behind = (self.points - centre) @ linear.T + centre
            found.append(Guess(np.concatenate([self.points, behind]),
                               np.concatenate([self.normals, self.normals @ linear.T]), float(costs[k])))
            if len(found) == count:
                break
        return found + found[-1:] * (count - len(found))

    def symmetries(self, up: Float[np.ndarray, "3"] | None) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
        """Linear parts M and fixed points c of the candidate motions."""
        across = self.points[:, :2]
        axes = np.linalg.eigh(np.cov(across.T))[1]
        if up is not None and abs(up[2]) < STRAIGHT_DOWN:
            # An object that stands is symmetric about its middle along the horizon. Without a vertical, the principal axes
            # of the image are the best guess.
            axes = np.array([[up[1], up[0]], [-up[0], up[1]]]) / np.hypot(up[0], up[1])
        along = across @ axes
        middle = axes @ (along.max(0) + along.min(0)) / 2
        turns = np.arange(TURNS) * 2 * np.pi / TURNS
        half_turns = [np.array([np.cos(a / 2), np.sin(a / 2), 0.0]) for a in turns]
        mirrors = [np.array([0.0, 0.0, 1.0])] + [
            np.array([np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)]) for tilt in TILTS for a in turns]
        if up is not None:
            # The half turn about the vertical, and mirrors in vertical planes, are not among the motions in image axes.
            half_turns.append(up)
            ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up if abs(up[2]) < STRAIGHT_DOWN else np.cross(up, [1.0, 0.0, 0.0])
            ahead /= np.linalg.norm(ahead)
            mirrors += [np.cos(a) * ahead + np.sin(a) * np.cross(up, ahead) for t in (0.0, *TILTS) for a in {t, -t}]
        linear = [-np.eye(3), *(2 * np.outer(a, a) - np.eye(3) for a in half_turns),
                  *(np.eye(3) - 2 * np.outer(m, m) for m in mirrors)]
        start = self.points[self.rim, 2].mean()
        return [(M, np.array([*middle, start - depth * self.width])) for depth in DEPTHS for M in linear]

    def cost(self, linear: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"]) -> float:
        """Disagreement of a symmetry with the visible side; 0 is best.

        The sum of three means: the distance of moved points from where they would be hidden, the deviation of the gap at
        the rim from the expected one, and the kink 1 - n_moved . n_rim between the normals that meet there.
        """
        wrong = self._exposure((self.points[self.sample] - centre) @ linear.T + centre)
        # The guess is the image of the visible side. As the motion is its own inverse, the distance of a rim point from the
        # guess equals the distance of the moved rim point from the visible side, so one search tree serves all motions.
        moved = (self.points[self.rim] - centre) @ linear.T + centre
        gap, nearest = self.tree.query(moved)
        # In front of the visible side the thickness would be negative.
        gap = gap * np.where(moved[:, 2] > self.points[nearest, 2], -1.0, 1.0)
        kink = 1 - (self.normals[nearest] @ linear.T * self.normals[self.rim]).sum(1)
        most = 0.5 * self.width  # larger distances cost no more (ours)
        misfit = np.minimum(np.abs(gap - self.expected_gap), most)
        far = 3.0 * np.minimum(wrong, most).mean() + misfit.mean()  # the weight is ours
        return float(far / self.width + (kink * self.smoothness).mean())

    @cached_property
    def tree(self) -> KDTree:
        """Search tree of the visible points."""
        return KDTree(self.points)

    @cached_property
    def image_tree(self) -> KDTree:
        """Search tree of the visible points in the image."""
        return KDTree(project(self.points, self.camera_distance))

    def _exposure(self, moved: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
        """Distance of points from where they would be hidden from the camera [m]: inside the image, behind the surface."""
        if self.camera_distance is None:
            return np.where(moved[:, 2] > self.end, self.tree.query(moved)[0], 0.0)
        aside, nearest = self.image_tree.query(project(moved, self.camera_distance))
        before = moved[:, 2] - self.points[nearest, 2]
        return np.hypot(np.maximum(0, aside - TOLERANCE), np.maximum(0, before - TOLERANCE))
