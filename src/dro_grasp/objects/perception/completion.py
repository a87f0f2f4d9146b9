"""Completion of an object's unseen side: symmetries propose it, and a network chooses between them, point by point.

A symmetry is a motion x -> M (x - c) + c that is its own inverse (M^2 = I): the inversion M = -I, a half turn
M = 2 a a^T - I about the axis a, or a mirror M = I - 2 m m^T with the normal m. It maps the visible side onto a guess of the
hidden one. A guess is good if the camera could not have seen it (it lies behind the visible side, inside its image), and if
it meets the visible side at the rim without a gap or a kink. Where no unit is given, lengths are in units of the object's width
in the image.

Source: symmetries judged by visibility, Thrun and Wegbreit 2005, Bohg et al. 2011; motions and costs are ours. The surface is
where the network's signed distance is zero, as in Park et al. 2019 (DeepSDF).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.network.completion_network import UNIT, SurfaceFeatures, SurfaceNetwork, load_surface
from dro_grasp.objects.surface_distances import cloud_distances

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
RESTS = 0.002  # What ends no higher above the plane stands on it [m] (ours)
STEEP = 0.94
"""Cosine between view and vertical above which a thing hides what is between it and the plane: 20 degrees (ours)."""
HOLLOW = 0.35
"""In other views, what ends higher than this share of its height above the plane may stand on something else (ours)."""


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
    pitch: float = 0.0  # distance of neighbouring pixels at the object; 0 without a camera [m]
    table: Float[np.ndarray, "4"] | None = None  # plane on which the object stands: upward normal, and height along it [m]
    up: Float[np.ndarray, "3"] | None = None  # upward direction, if it is known

    @classmethod
    def of(
        cls, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera_distance: float | None,
        pitch: float = 0.0, table: Float[np.ndarray, "4"] | None = None, up: Float[np.ndarray, "3"] | None = None,
    ) -> VisibleSide:
        """Find the rim, and predict how the surface continues there."""
        # In an image, a point belongs to the rim if its neighbours lie to one side of it. A cloud cut by a plane has its rim
        # along the cut, at its lowest points.
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
        return cls(points, normals, camera_distance, shuffled[:SAMPLE], rim, expected, smooth, width, float(end), float(top),
                   pitch, table, up)

    @property
    def upright(self) -> bool:
        """Whether the upward direction is known, and lies along y in the image."""
        return self.up is not None and bool(abs(self.up[2]) < STRAIGHT_DOWN)

    def guesses(self, count: int) -> list[Guess]:
        """Both sides by the best symmetries that differ, best first; those that preserve the upward direction are preferred."""
        motions, up = self.symmetries(), self.up
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

    def symmetries(self) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
        """Linear parts M and fixed points c of the candidate motions."""
        across, up = self.points[:, :2], self.up
        # An object that stands is symmetric about its middle along the horizon. Without a vertical, the principal axes of the
        # image are the best guess.
        axes = np.eye(2) if self.upright else np.linalg.eigh(np.cov(across.T))[1]
        along = across @ axes
        middle = axes @ (along.max(0) + along.min(0)) / 2
        turns = np.arange(TURNS) * 2 * np.pi / TURNS
        half_turns = [np.array([np.cos(a / 2), np.sin(a / 2), 0.0]) for a in turns]
        mirrors = [np.array([0.0, 0.0, 1.0])] + [
            np.array([np.sin(tilt) * np.cos(a), np.sin(tilt) * np.sin(a), np.cos(tilt)]) for tilt in TILTS for a in turns]
        if up is not None:
            # The half turn about the vertical, and mirrors in vertical planes, are not among the motions in image axes.
            half_turns.append(up)
            ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up if self.upright else np.cross(up, [1.0, 0.0, 0.0])
            ahead /= np.linalg.norm(ahead)
            mirrors += [np.cos(a) * ahead + np.sin(a) * np.cross(up, ahead) for t in (0.0, *TILTS) for a in {t, -t}]
        linear = [-np.eye(3), *(2 * np.outer(a, a) - np.eye(3) for a in half_turns),
                  *(np.eye(3) - 2 * np.outer(m, m) for m in mirrors)]
        start = self.points[self.rim, 2].mean()
        return [(M, np.array([*middle, start - depth * self.width])) for depth in DEPTHS for M in linear]

    def cost(self, linear: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"]) -> float:
        """Disagreement of a symmetry with the visible side; 0 is best."""
        # The sum of three means: the distance of moved points from where they would be hidden, the deviation of the gap at the
        # rim from the expected one, and the kink 1 - n_moved . n_rim between the normals that meet there.
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
        """Distance of points from where they may be hidden [m]: in the image, behind the surface, above the table."""
        if self.camera_distance is None:
            return np.where(moved[:, 2] > self.end, self.tree.query(moved)[0], 0.0)
        aside, nearest = self.image_tree.query(project(moved, self.camera_distance))
        before = moved[:, 2] - self.points[nearest, 2]
        under = np.zeros(len(moved)) if self.table is None else self.table[3] - moved @ self.table[:3]
        outside = [np.maximum(0, way - TOLERANCE) for way in (aside, before, under)]
        return np.linalg.norm(outside, axis=0)


GUESSES = 5  # Symmetries that the network chooses between (ours)
VISIBLE_POINTS = 2048  # Most visible points that guesses are made of (ours)
CODED = 256  # Most visible points that the network sees (ours)
THINNEST = 1e-4  # Width in the image below which nothing can be said of the other side [m] (ours)
CELLS = 20_000  # Approximate number of grid cells for the surface (ours): edges of 5 mm for a large can, 1 mm for a die
MARGIN = 0.01  # Distance that the grid extends beyond all guesses [m] (ours)
SPREAD = 40_000  # Points that are moved onto the surface (ours)
SMALL = 0.01  # Distance that the network receives as about 1/2 [m] (ours)


class CompletedCloud(NamedTuple):
    """Both sides of an object."""

    points: Float[np.ndarray, "k 3"]
    normals: Float[np.ndarray, "k 3"]  # outward, of length 1
    added: Bool[np.ndarray, " k"]  # which points are completed, not seen; they come last


def complete_cloud(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None = None,
    up: Float[np.ndarray, "3"] | None = None, network: SurfaceNetwork | None = None,
    table: Float[np.ndarray, "4"] | None = None,
) -> CompletedCloud:
    """Complete the unseen side. Both sides get about the same density, for which visible points are thinned.

    Points of the visible side [m] have outward unit normals; if all lie on one viewing ray, they are returned unchanged.
    Without the position of the `camera` [m], they are all on one side of a plane, whose normal is the mean of theirs.
    Symmetries that preserve the `up` direction, if it is known, are preferred. What stands on the plane of a `table`, its
    upward normal and its height along it [m], reaches down to it. The shipped network chooses between symmetries by default.
    """
    side, axes, middle = to_view_axes(points, normals, camera, table, up)
    if side.width < THINNEST:
        return CompletedCloud(points, normals, np.zeros(len(points), bool))
    guesses = side.guesses(GUESSES)
    surface, outward = extract_surface(side, guesses, network or load_surface())
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
    whole = CompletedCloud(both @ axes.T + middle, both_normals @ axes.T, np.arange(len(both)) >= len(seen))
    if table is None:
        return whole
    steep = side.table is not None and side.table[2] > STEEP * np.linalg.norm(table[:3])
    return stood(whole, table, 1.0 if steep else HOLLOW)


def stood(whole: CompletedCloud, table: Float[np.ndarray, "4"], most: float) -> CompletedCloud:
    """The cloud with its unseen side down to the table, by `set_down`, and not below it."""
    kept = ~whole.added | (whole.points @ table[:3] > table[3])
    points, normals, added = (column[kept] for column in whole)
    return CompletedCloud(*set_down(points, normals, added, table, most), added)


def set_down(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], added: Bool[np.ndarray, " n"],
    table: Float[np.ndarray, "4"], most: float,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points [m] and unit normals with an underside that reaches the plane below: what rests on a plane touches it.

    From above, the underside of a lying thing is not seen, and is completed too high. The added points are moved down, in
    proportion to their depth below the height from which on all is seen; what was seen stays where it is. What ends higher
    above the plane than `most` of its own height stays too.
    """
    up = table[:3] / np.linalg.norm(table[:3])
    height = (points @ table[:3] - table[3]) / np.linalg.norm(table[:3])
    gap, rim = float(height.min()), float(np.quantile(height[added], 1 - STRAY)) if added.any() else 0.0
    if not RESTS < gap < min(rim, most * float(height.max())):
        return points, normals
    low, stretch = added & (height < rim), rim / (rim - gap)
    down = np.where(low, (stretch - 1) * (rim - height), 0.0)
    # A surface that is stretched along one axis has normals that shrink along it.
    turned = normals + np.where(low, (1 / stretch - 1) * (normals @ up), 0.0)[:, None] * up
    return points - down[:, None] * up, turned / np.linalg.norm(turned, axis=1, keepdims=True)


def to_view_axes(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None,
    table: Float[np.ndarray, "4"] | None = None, up: Float[np.ndarray, "3"] | None = None,
) -> tuple[VisibleSide, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """The visible side in view axes; these axes as columns; and their origin, the middle [m].

    z points to the camera. The image of the `up` direction lies along y; if that is not known, the image is longest along x.
    """
    pitch = 0.0 if camera is None else _pitch(points, camera)
    if len(points) > VISIBLE_POINTS:
        kept = np.random.default_rng(0).permutation(len(points))[:VISIBLE_POINTS]
        points, normals = points[kept], normals[kept]
    middle = points.mean(0)
    view = normals.mean(0) if camera is None else camera - middle
    length = float(np.linalg.norm(view))
    view = view / max(length, 1e-9)
    axes = _axes(points - middle, view, up)
    if table is not None:
        table = np.append(table[:3] @ axes, table[3] - table[:3] @ middle)
    distance = None if camera is None else length
    known = None if up is None else up @ axes
    return VisibleSide.of((points - middle) @ axes, normals @ axes, distance, pitch, table, known), axes, middle


def _axes(
    points: Float[np.ndarray, "n 3"], view: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "3 3"]:
    """Axes as columns, the view last."""
    if up is not None and abs(view @ up) < STRAIGHT_DOWN:
        across = np.cross(up, view)
    else:
        helper = np.eye(3)[np.abs(view).argmin()]
        first = np.cross(view, helper)
        image = np.stack([first, np.cross(view, first)], 1) / np.linalg.norm(first)
        flat = points @ image
        longest = np.linalg.eigh(flat.T @ flat)[1][:, 1]
        # The direction in which the points reach farther from their middle.
        across = image @ longest * np.sign(((flat @ longest) ** 3).sum() or 1.0)
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(view, across), view], 1)


def _pitch(points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"]) -> float:
    """Distance of neighbouring pixels at the object's middle [m]: the median angle between neighbouring rays."""
    if len(points) < 2:
        return 0.0
    rays = points - camera
    length = np.linalg.norm(rays, axis=1)
    rays = rays / length[:, None]
    return float(np.median(KDTree(rays).query(rays, k=2)[0][:, 1]) * length.mean())


def surface_features(side: VisibleSide, guesses: list[Guess], places: Float[np.ndarray, "n 3"]) -> SurfaceFeatures:
    """Input of the network at places in view axes [m].

    The other features are distances, squeezed by asinh: those to the guesses, to the nearest visible point, over its tangent
    plane, from the image, over the surface there, above the end and the top of the visible side, above the table, and between
    neighbouring pixels. Then come the position along the view and across it, the cost of each guess, the visible width, and
    whether there is a camera, and a table.
    """
    guessed = np.stack([cloud_distances(g.points, g.normals, places) for g in guesses], 1)
    distance, nearest = side.tree.query(places)
    over = ((places - side.points[nearest]) * side.normals[nearest]).sum(1)
    beside, hiding = side.image_tree.query(project(places, side.camera_distance))
    height = places[:, 2]
    stands = np.zeros(len(places)) if side.table is None else places @ side.table[:3] - side.table[3]
    metres = np.column_stack([
        guessed, distance, over, beside, height - side.points[hiding, 2], height - side.end, height - side.top, stands,
        np.full(len(places), side.pitch)])
    across = np.linalg.norm(places[:, :2], axis=1)
    known = float(side.camera_distance is not None), float(side.table is not None)
    whole = np.array([*(g.cost for g in guesses), side.width / UNIT, *known])
    features = np.column_stack([
        np.arcsinh(metres / SMALL) / 2, height / UNIT, across / UNIT, np.broadcast_to(whole, (len(places), len(whole)))])
    some = side.sample[:CODED]
    seen = np.concatenate([side.points[some], side.normals[some]], 1)
    g, f, p, s = (torch.from_numpy(column).float() for column in (guessed, features, places, seen))
    return SurfaceFeatures(g, f, p, s, torch.tensor(float(side.upright)))


@torch.no_grad()
def extract_surface(
    side: VisibleSide, guesses: list[Guess], network: SurfaceNetwork
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Points on the network's zero level and their unit normals, in view axes; those of the best guess if there is none."""
    from scipy.interpolate import RegularGridInterpolator  # with SciPy's optimisers: slow to load, and rarely wanted

    everything = np.concatenate([g.points for g in guesses])
    low, high = everything.min(0) - MARGIN, everything.max(0) + MARGIN
    spacing = float((np.prod(high - low) / CELLS) ** (1 / 3))
    along = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*along, indexing="ij"), -1)
    distances = network(surface_features(side, guesses, places.reshape(-1, 3))).double().numpy().reshape(places.shape[:3])
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
