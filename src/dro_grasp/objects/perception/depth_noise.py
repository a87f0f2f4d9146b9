"""Noise as depth cameras make it: from an ideal depth image to one that a camera would return.

Left out: errors that stay (calibration, reflections between surfaces, phase wiggling) and the blur of matching windows.

Sources: [Nguyen] Nguyen, Izadi and Lovell 2012, Kinect; [Khoshelham] Khoshelham and Elberink 2012, Kinect; [Fankhauser]
Fankhauser et al. 2015, Kinect v2; [Intel] Grunnet-Jepsen, Sweetser and Woodfill, Best-known methods for tuning RealSense D400.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter, gaussian_filter1d, maximum_filter
from scipy.special import ndtr

from dro_grasp.errors import OptionError
from dro_grasp.kinds import Checked

JUMP = 0.01
"""Distance along a ray from the plane of its neighbour from which a pixel is on another surface [m] (ours)."""
REFLECTANCE = 0.5  # Share of the light that a surface returns where nothing is known [1] (ours)
PATCH = 1.5  # Standard deviation of the blur that makes lost pixels patches [pixels] (ours)
LEAST_BLUR = 0.3  # Blurs below this change nothing [pixels] (ours)
STEEPEST = 1.55  # Angles to the normal count as at most this, since noise grows without bound [rad] (ours)

Pixels = tuple[slice, slice] | tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]
"""Rows and columns of some pixels of an image."""


@dataclass(frozen=True)
class DepthNoise(Checked):
    """How a camera's depth differs from the truth; without arguments not at all.

    Pixels are the camera's own, at `focal`: images of other sizes get the same noise by angle.
    """

    axial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviation of depth: terms of 1, z and z^2 [m, 1, 1/m]."""
    glance: float = 0.0
    """What the angle to the normal adds: this times z^glance_power angle^2 / (pi/2 - angle)^2 [m]."""
    glance_power: float = 0.0
    """Power of depth in that term [1]."""
    subpixel: float = 0.0
    """Standard deviation of the disparity [pixels]; that of depth grows with its square."""
    lateral: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of where edges are: head on, and what angle / (pi/2 - angle) adds [pixels]."""
    correlation: float = 0.0
    """Over how many pixels errors of depth are alike: standard deviation of the blur [pixels]."""
    focal: float = 580.0
    """Focal length [pixels]."""
    baseline: float = 0.0
    """How far to the right the second sensor or the projector is [m]: what it does not see is lost."""
    disparity_step: float = 0.0
    """Step in which disparities are stored [pixels]."""
    depth_step: float = 0.0
    """Step in which depths are stored [m]."""
    edge_loss: float = 0.0
    """Share of pixels at edges that return nothing."""
    flying: float = 0.0
    """Share of pixels at edges that return a depth between the two surfaces."""
    steep: tuple[float, float] = (math.pi / 2, math.pi / 2)
    """Angles to the normal from which pixels begin to be lost, and from which all are [rad]."""
    least_signal: float = 0.0
    """Reflectance times cosine of the angle over z^2 below which pixels are lost [1/m^2]."""

    def __post_init__(self) -> None:
        """Refuse noise that no camera has.

        Raises:
            OptionError: A share is not from 0 to 1, a length or step is negative, or steps of disparity have no baseline.
        """
        super().__post_init__()
        if not all(0 <= share <= 1 for share in (self.edge_loss, self.flying)):
            raise OptionError(f"edge_loss is {self.edge_loss} and flying {self.flying}; give shares from 0 to 1")
        sizes = (self.glance, self.subpixel, *self.lateral, self.correlation, self.disparity_step, self.depth_step,
                 self.least_signal)
        if not all(0 <= size < math.inf for size in sizes) or not 0 < self.focal < math.inf:
            raise OptionError(f"{self} has a size that is negative or not finite; give numbers from 0 on, and a focal above 0")
        if self.baseline == 0 and max(self.disparity_step, self.subpixel) > 0:
            raise OptionError("disparities need two sensors; give the distance between them, baseline=... [m]")
        if not self.steep[0] <= self.steep[1]:
            raise OptionError(f"steep is {self.steep}; give the smaller angle first")

    def deviation(self, depth: Float[np.ndarray, "*n"], angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Standard deviation of depth at a depth [m] and an angle between ray and normal [rad], quantisation included [m]."""
        angle, (constant, linear, square) = np.minimum(angle, STEEPEST), self.axial
        slant = self.glance * depth**self.glance_power * (angle / (math.pi / 2 - angle)) ** 2 if self.glance else 0.0
        own = constant + linear * depth + square * depth**2 + slant
        return np.asarray(np.hypot(own, self.depth_of(self.subpixel, depth)))

    def depth_of(self, disparity: float, depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """How much depth changes with a small change of the disparity [m]."""
        return np.asarray(disparity * depth**2 / (self.focal * abs(self.baseline))) if self.baseline else np.zeros_like(depth)

    def step(self, depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Distance between the depths that can be stored [m]."""
        return np.asarray(np.maximum(self.depth_of(self.disparity_step, depth), self.depth_step))


PRESETS = {
    "none": DepthNoise(),
    "structured_light": DepthNoise(
        axial=(0.001504, -0.00152, 0.0019), glance=1e-4, glance_power=-0.5,  # [Nguyen]: 0.0012 + 0.0019 (z - 0.4)^2 + ...
        lateral=(0.8, 0.035),  # [Nguyen]
        correlation=1.0,  # (ours)
        focal=580.0, baseline=0.075, disparity_step=1 / 8,  # [Khoshelham]
        depth_step=0.001,  # (ours): drivers give millimetres
        edge_loss=0.4, steep=(1.22, 1.48), least_signal=0.05),  # (ours): from 70 to 85 degrees
    "time_of_flight": DepthNoise(
        axial=(0.0015, -0.0005, 0.0003), glance=1e-4, glance_power=1.5,  # [Fankhauser]
        lateral=(0.5, 0.0),  # [Fankhauser]: 1.6 mm, which are 0.5 pixels at a little over a metre
        focal=366.0, depth_step=0.001,
        edge_loss=0.3, flying=0.5, steep=(1.31, 1.53), least_signal=0.08),  # (ours): from 75 to 88 degrees
    "stereo": DepthNoise(
        subpixel=0.08, focal=1005.0, baseline=0.055, disparity_step=1 / 32, depth_step=0.001,  # [Intel]: D415, 1280 x 720
        lateral=(2.0, 0.0), correlation=4.0,  # (ours): windows of matching are several pixels wide
        edge_loss=0.3, steep=(1.22, 1.48), least_signal=0.02),  # (ours): from 70 to 85 degrees
}
"""Noise of some kinds of cameras. Shares of what is lost are ours: they depend on scenes, and no paper states them."""
NoiseName = Literal["none", "structured_light", "time_of_flight", "stereo"]
"""Names of the presets."""


def depth_noise(given: float | str) -> DepthNoise:
    """A preset by its name, or noise that is alike and independent for all pixels by its standard deviation [m].

    Raises:
        OptionError: There is no such preset, or the standard deviation is negative or not finite.
    """
    if isinstance(given, str):
        if given not in PRESETS:
            raise OptionError(f"noise is '{given}'; give {', '.join(PRESETS)}, or a standard deviation in metres, as 0.0015")
        return PRESETS[given]
    if not 0 <= given < math.inf:
        raise OptionError(f"noise is {given}; give a standard deviation in metres from 0 on, for example 0.0015, or one of "
                          f"{', '.join(PRESETS)}")
    return DepthNoise(axial=(float(given), 0.0, 0.0))


@dataclass(frozen=True, eq=False)
class DepthView:
    """An ideal depth image."""

    depth: Float[np.ndarray, "h w"]
    """Along z [m]; 0 where there is nothing."""
    normals: Float[np.ndarray, "h w 3"]
    """Unit normals of the surfaces in the camera's frame; their sign does not matter."""
    intrinsics: Float[np.ndarray, "3 3"]
    """Focal lengths and principal point [pixels]."""
    reflectance: Float[np.ndarray, "h w"] | None = None
    """Share of the light that each surface returns; REFLECTANCE by default."""

    @property
    def seen(self) -> Bool[np.ndarray, "h w"]:
        """Pixels with a surface."""
        return self.depth > 0

    @cached_property
    def rays(self) -> Float[np.ndarray, "h w 3"]:
        """Directions with z = 1."""
        row, column = np.indices(self.depth.shape)
        rays = np.linalg.solve(self.intrinsics, np.stack([column, row, np.ones_like(row)]).reshape(3, -1).astype(float))
        return (rays / rays[2]).T.reshape(*self.depth.shape, 3)

    @cached_property
    def angle(self) -> Float[np.ndarray, "h w"]:
        """Between ray and normal, at most a right angle [rad]."""
        rays = self.rays
        cosine = np.abs((rays * self.normals).sum(-1)) / np.linalg.norm(rays, axis=-1)
        return np.where(self.seen, np.arccos(np.clip(cosine, 0, 1)), 0.0)


def measured_depth(view: DepthView, noise: DepthNoise, seed: int) -> Float[np.ndarray, "h w"]:
    """What a camera returns of a view: depth along z [m], and 0 for nothing. The same seed gives the same image."""
    rng, scale = np.random.default_rng(seed), float(view.intrinsics[0, 0]) / noise.focal
    white, edge = rng.standard_normal(view.depth.shape), edges(view)
    angle = view.angle
    source = _jittered(view, noise, edge, angle, scale, rng)
    depth, angle = view.depth[source], angle[source]
    depth = _flying(view, noise, edge, depth, rng)
    lost = _lost(view, noise, edge, rng)[source]
    depth = _with_error(depth, angle, noise, _blurred(white, noise.correlation * scale))
    return np.where((view.depth[source] > 0) & (depth > 0) & ~lost, depth, 0.0)


def edges(view: DepthView) -> Bool[np.ndarray, "h w"]:
    """Pixels of which a neighbour in the row or column is on another surface, or on none."""
    edge = np.zeros(view.depth.shape, bool)
    for first, second in _neighbours():
        apart = _apart(view, first, second)
        edge[first] |= apart
        edge[second] |= apart
    return edge & view.seen


def shadow(view: DepthView, baseline: float) -> Bool[np.ndarray, "h w"]:
    """Pixels whose surface a second sensor, which is `baseline` to the right [m], does not see behind a nearer one.

    Beside the image's borders the other sensor is taken to see as much as is needed.
    """
    depth, (row, column) = view.depth, np.nonzero(view.seen)
    z = depth[row, column]
    if baseline == 0 or not len(z):
        return np.zeros(depth.shape, bool)
    focal = float(view.intrinsics[0, 0])
    place = np.round(column - focal * baseline / z).astype(int)
    place -= place.min() - 1
    nearest = np.full((len(depth), place.max() + 2), np.inf)
    np.minimum.at(nearest, (row, place), z)
    # A surface that the other sensor sees less obliquely leaves gaps of one pixel.
    nearest[:, 1:-1] = np.minimum(nearest[:, 1:-1], np.maximum(nearest[:, :-2], nearest[:, 2:]))
    slope = np.tan(np.minimum(view.angle[row, column], STEEPEST))
    hidden = np.zeros(depth.shape, bool)
    hidden[row, column] = z - nearest[row, place] > JUMP + 2 * z / focal * slope
    return hidden


def _neighbours() -> tuple[tuple[Pixels, Pixels], ...]:
    """Slices of the first and second pixels of all pairs in rows, then in columns."""
    whole, first, second = slice(None), slice(None, -1), slice(1, None)
    return ((whole, first), (whole, second)), ((first, whole), (second, whole))


def _apart(view: DepthView, first: Pixels, second: Pixels) -> Bool[np.ndarray, "..."]:
    """Whether neither pixel of a pair lies on the plane through the other."""
    away = (_off_plane(view, a, b) for a, b in ((first, second), (second, first)))
    return (np.minimum(*away) > JUMP) | (view.seen[first] != view.seen[second])


def _off_plane(view: DepthView, one: Pixels, other: Pixels) -> Float[np.ndarray, "..."]:
    """How far along their rays the surfaces of other pixels are from the planes of some [m]."""
    normals = view.normals[one]
    height, across = view.depth[one] * (view.rays[one] * normals).sum(-1), (view.rays[other] * normals).sum(-1)
    return np.abs(view.depth[other] - height / np.where(np.abs(across) > 1e-9, across, 1e-9))


def _jittered(
    view: DepthView, noise: DepthNoise, edge: Bool[np.ndarray, "h w"], angle: Float[np.ndarray, "h w"], scale: float,
    rng: np.random.Generator,
) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """Row and column of the pixel that each one really sees: edges are not where they should be, surfaces stay.

    Noise of depth was measured on planes and has what shifts add there, so that only edges are shifted.
    """
    row, column = (np.asarray(at) for at in np.indices(view.depth.shape))
    head_on, slant = noise.lateral
    if max(head_on, slant) == 0:
        return row, column
    steep = np.minimum(angle, STEEPEST)
    deviation = (head_on + slant * steep / (math.pi / 2 - steep)) * scale
    shifts = np.round(deviation * rng.standard_normal((2, *view.depth.shape))).astype(int)
    to_row, to_column = (np.clip(at + shift, 0, size - 1) for at, shift, size in
                         zip((row, column), shifts, view.depth.shape, strict=True))
    reach = 2 * math.ceil(3 * head_on * scale) + 3
    moved = np.asarray(maximum_filter(edge, reach), bool) & (_off_plane(view, (row, column), (to_row, to_column)) > JUMP)
    return np.where(moved, to_row, row), np.where(moved, to_column, column)


def _flying(
    view: DepthView, noise: DepthNoise, edge: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "h w"]:
    """Depths with those of pixels that get light from two surfaces: between them, by what each gives."""
    if noise.flying == 0:
        return depth
    near, far = view.depth.copy(), view.depth.copy()
    for first, second in _neighbours():
        both = _apart(view, first, second) & view.seen[first] & view.seen[second]
        for a, b in ((first, second), (second, first)):
            near[a] = np.where(both, np.minimum(near[a], view.depth[b]), near[a])
            far[a] = np.where(both, np.maximum(far[a], view.depth[b]), far[a])
    share, chosen = rng.random(depth.shape), rng.random(depth.shape) < noise.flying
    return np.where(chosen & edge & (far > near), near + share * (far - near), depth)


def _lost(
    view: DepthView, noise: DepthNoise, edge: Bool[np.ndarray, "h w"], rng: np.random.Generator
) -> Bool[np.ndarray, "h w"]:
    """Pixels that return nothing: in the shadow, at edges, and on glancing and dark surfaces."""
    angle, (begin, end) = view.angle, noise.steep
    light = np.full(view.depth.shape, REFLECTANCE) if view.reflectance is None else view.reflectance
    signal = light * np.cos(angle) / np.maximum(view.depth, JUMP) ** 2
    steep = np.clip((angle - begin) / max(end - begin, 1e-9), 0, 1)
    dark = np.clip(1 - signal / noise.least_signal, 0, 1) if noise.least_signal else 0.0
    chance = 1 - (1 - steep) * (1 - dark) * (1 - noise.edge_loss * edge)
    drawn = ndtr(_blurred(rng.standard_normal(view.depth.shape), PATCH))
    return (drawn < chance) | shadow(view, noise.baseline)


def _with_error(
    depth: Float[np.ndarray, "h w"], angle: Float[np.ndarray, "h w"], noise: DepthNoise, drawn: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Depths with errors of the stated deviation, and then in the stored steps."""
    safe = np.where(depth > 0, depth, 1.0)
    # Steps have a deviation of their own: a uniform error's.
    deviation = np.sqrt(np.maximum(noise.deviation(safe, angle) ** 2 - noise.step(safe) ** 2 / 12, 0.0))
    depth = np.where(depth > 0, depth + deviation * drawn, 0.0)
    if noise.disparity_step:
        product, tiny = noise.focal * abs(noise.baseline), 1e-6
        disparity = np.round(product / np.maximum(depth, tiny) / noise.disparity_step) * noise.disparity_step
        depth = np.where((depth > tiny) & (disparity > 0), product / np.maximum(disparity, tiny), 0.0)
    return np.round(depth / noise.depth_step) * noise.depth_step if noise.depth_step else depth


def _blurred(white: Float[np.ndarray, "h w"], deviation: float) -> Float[np.ndarray, "h w"]:
    """Independent standard normal numbers made alike over some pixels; they stay standard normal."""
    if deviation < LEAST_BLUR:
        return white
    impulse = np.zeros(2 * math.ceil(4 * deviation) + 3)
    impulse[len(impulse) // 2] = 1.0
    kernel = gaussian_filter1d(impulse, deviation, mode="constant")
    return gaussian_filter(white, deviation, mode="wrap") / float((kernel**2).sum())
