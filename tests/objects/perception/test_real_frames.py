"""Frames that real cameras recorded: they are read, and noise is as the model says (`real_frames/README.md`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dro_grasp.objects.perception.depth_noise import PRESETS
from dro_grasp.objects.perception.scan import depth_points, scanned_object

FRAMES = {  # unit [m], focal length and principal point [pixels], and rows and columns of one thing
    "desk": (2e-4, (262.5, 262.5, 159.5, 119.5), (slice(150, 215), slice(20, 75))),
    "bin_from_above": (1e-3, (258.8, 258.9, 159.0, 121.4), (slice(85, 130), slice(110, 175))),
    "tote": (1e-4, (308.3, 308.3, 155.7, 115.5), (slice(170, 215), slice(95, 150))),
}
HALF = 4  # Pixels on each side of the middle of a patch


def frame(name: str) -> np.ndarray:
    """Depth along z [m]; 0 where nothing returned."""
    return np.array(Image.open(Path(__file__).parent / "real_frames" / f"{name}.png")) * FRAMES[name][0]


def matrix(name: str) -> np.ndarray:
    fx, fy, cx, cy = FRAMES[name][1]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def roughness(depth: np.ndarray, focal: float) -> np.ndarray:
    """Mean depth [m], slope [rad] and deviation from a plane [m] of all whole patches; planes have linear inverse depths."""
    v, u = np.mgrid[-HALF:HALF + 1, -HALF:HALF + 1]
    plane, size, found = np.stack([v.ravel(), u.ravel(), np.ones(v.size)], 1), 2 * HALF + 1, []
    for i in range(0, depth.shape[0] - size, size):
        for j in range(0, depth.shape[1] - size, size):
            patch = depth[i:i + size, j:j + size].ravel()
            if patch.min() > 0:
                best = np.linalg.lstsq(plane, 1 / patch, rcond=None)[0]
                slope = np.arctan(focal * np.hypot(*best[:2]) * patch.mean())
                found.append((patch.mean(), slope, (1 / patch - plane @ best).std() * patch.mean() ** 2))
    return np.array(found)


@pytest.mark.parametrize("name", FRAMES)
def test_recorded_frames_are_read(name: str) -> None:
    depth, part = frame(name), FRAMES[name][2]
    points = depth_points(depth, matrix(name))
    assert len(points) == (depth > 0).sum() > 30000
    mask = np.zeros(depth.shape, bool)
    mask[part] = True
    mask &= np.abs(depth - np.median(depth[part][depth[part] > 0])) < 0.3
    thing = scanned_object("thing", depth_points(depth, matrix(name), mask), keep_table=True)
    assert thing.seen is None or 300 < len(thing.seen) <= mask.sum()
    assert np.isfinite(thing.cloud).all()
    assert 0.03 < np.ptp(thing.cloud, axis=0).max() < 1.0


def test_a_real_structured_light_camera_has_the_steps_of_the_preset() -> None:
    noise, levels = PRESETS["structured_light"], np.unique(frame("desk"))
    levels = levels[levels > 0]
    ratio = np.diff(levels) / noise.depth_of(noise.disparity_step, levels[:-1])
    assert len(ratio) > 150
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
    assert np.quantile(ratio, [0.1, 0.9]) == pytest.approx([1.0, 1.0], abs=0.1)


def test_a_real_structured_light_camera_is_as_rough_as_the_preset() -> None:
    depth, slope, rough = roughness(frame("desk"), FRAMES["desk"][1][0]).T
    flat = slope < 1.0
    assert flat.sum() > 300
    ratio = rough[flat] / PRESETS["structured_light"].deviation(depth[flat], slope[flat])
    assert np.median(ratio) == pytest.approx(1.0, abs=0.2), "most patches are parts of walls, the desk and the floor"


@pytest.mark.parametrize("name", ["bin_from_above", "tote"])
def test_noise_of_close_frames_is_of_the_presets_size(name: str) -> None:
    depth, slope, rough = roughness(frame(name), FRAMES[name][1][0]).T
    flat = slope < 1.0
    ratio = rough[flat] / PRESETS["structured_light"].deviation(depth[flat], slope[flat])
    assert 0.3 < np.median(ratio) < 1.5
