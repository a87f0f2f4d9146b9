"""The side that nobody saw, against shapes whose surface is known exactly."""

from __future__ import annotations

from collections.abc import Callable

import igl
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from dro_grasp.objects.camera import DepthCamera, visible_points
from dro_grasp.objects.completion import completed
from dro_grasp.objects.library import load_object

Shape = tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]


def ellipsoid() -> Shape:
    axes = np.array([0.03, 0.04, 0.07])
    unit = np.random.default_rng(0).normal(size=(4000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normals = unit / axes
    # To first order, which is enough near the surface.
    return (unit * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True),
            lambda p: np.abs(np.linalg.norm(p / axes, axis=1) - 1) * axes.min())


def box() -> Shape:
    half = np.array([0.03, 0.04, 0.06])
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-1, 1, (6000, 3)) * half, np.zeros((6000, 3))
    face = rng.choice(3, 6000, p=(1 / half) / (1 / half).sum())
    sign = rng.choice([-1.0, 1.0], 6000)
    points[np.arange(6000), face] = sign * half[face]
    normals[np.arange(6000), face] = sign

    def distance(p: np.ndarray) -> np.ndarray:
        out = np.abs(p) - half
        return np.abs(np.linalg.norm(np.maximum(out, 0), axis=1) + np.minimum(out.max(1), 0))

    return points, normals, distance


def cylinder() -> Shape:
    radius, half = 0.035, 0.06
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 5000), rng.uniform(-half, half, 5000)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(5000)], 1)
    points = np.column_stack([radius * normals[:, :2], height])
    lid = np.arange(5000) < 1300
    points[lid, :2] *= np.sqrt(rng.uniform(0, 1, lid.sum()))[:, None]
    points[lid, 2] = half * np.sign(height[lid])
    normals[lid] = np.stack([np.zeros(lid.sum()), np.zeros(lid.sum()), np.sign(height[lid])], 1)

    def distance(p: np.ndarray) -> np.ndarray:
        out = np.stack([np.linalg.norm(p[:, :2], axis=1) - radius, np.abs(p[:, 2]) - half], 1)
        return np.abs(np.linalg.norm(np.maximum(out, 0), axis=1) + np.minimum(out.max(1), 0))

    return points, normals, distance


def mirrored(points: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """The naive way: a mirror where the seen side ends."""
    along = points @ towards
    return points + 2 * (along.min() - along)[:, None] * towards


@pytest.mark.parametrize("by_camera", [True, False], ids=["camera", "cut"])
@pytest.mark.parametrize("shape", [ellipsoid, box, cylinder])
def test_bodies_seen_askew_are_closed_on_their_surface(shape: Callable[[], Shape], by_camera: bool) -> None:
    points, normals, distance = shape()
    found, naive = [], []
    for seed in range(12):
        towards = Rotation.random(random_state=seed).as_matrix()[:, 2]
        # Of a convex body a far camera sees what faces it.
        shown = normals @ towards > 0.1 if by_camera else points @ towards > 0
        both, outward = completed(points[shown], normals[shown], 100 * towards if by_camera else None)
        n = int(shown.sum())
        np.testing.assert_array_equal(both[:n], points[shown])
        np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1, atol=1e-9)
        found.append(distance(both[n:]).mean())
        naive.append(distance(mirrored(points[shown], towards)).mean())
        assert (outward[n:] * both[n:]).sum(1).mean() > 0, "normals look outward"
    assert np.median(found) < 0.006
    assert np.mean(found) < (0.25 if by_camera else 0.7) * np.mean(naive)


def test_a_face_seen_straight_on_becomes_as_thick_as_it_is_wide() -> None:
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 25), np.linspace(-0.05, 0.05, 40))
    face = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.4)], 1)
    points, normals = completed(face, np.tile([0.0, 0.0, -1.0], (len(face), 1)), np.array([0.0, 0.0, -99.0]))
    assert np.ptp(points[:, 2]) == pytest.approx(0.06, abs=0.002)
    assert set(np.unique(normals[:, 2].round(9))) == {-1.0, 1.0}


def test_a_ball_in_a_real_depth_image() -> None:
    ball = load_object("sphere")
    radius = float(np.linalg.norm(ball.vertices, axis=1).mean())
    view = torch.tensor([0.0, 0.0, 1.0])
    points = visible_points(ball, view, torch.Generator().manual_seed(0), DepthCamera(noise=0)).double().numpy()
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    both, outward = completed(points, normals, DepthCamera().place(ball, view))
    off = np.abs(np.linalg.norm(both, axis=1) - radius)
    assert np.mean(off) < 0.1 * radius
    assert np.quantile(off, 0.95) < 0.25 * radius
    assert np.mean((outward * both).sum(1) / np.linalg.norm(both, axis=1)) > 0.95


@pytest.mark.parametrize("end", [(0.05, 0.0, 0.5), (0.0, 0.0, 0.6)], ids=["across", "along the ray"])
def test_a_line_is_no_reason_to_stumble(end: tuple[float, float, float]) -> None:
    line = np.linspace((0.0, 0.0, 0.5), end, 40)
    both, outward = completed(line, np.tile([0.0, 0.0, -1.0], (40, 1)), np.zeros(3))
    np.testing.assert_array_equal(both[:40], line)
    assert np.isfinite(both).all()
    assert np.isfinite(outward).all()


def test_what_stands_is_completed_upright() -> None:
    """A flower pot seen from above and aside: inverted, it would stand on its head."""
    pot = trimesh.creation.revolve(np.array([[0, 0], [0.03, 0], [0.048, 0.11], [0, 0.11]]), sections=64)
    points, face = trimesh.sample.sample_surface(pot, 6000, seed=0)
    normals = np.asarray(pot.face_normals[face])
    anyhow = []
    for seed in range(6):
        towards = np.array([np.cos(1.3 * seed), np.sin(1.3 * seed), 0.5]) / np.sqrt(1.25)
        shown = normals @ towards > 0.15
        n = int(shown.sum())
        both, outward = completed(points[shown], normals[shown], 100 * towards, np.array([0.0, 0.0, 1.0]))
        off = np.abs(igl.signed_distance(both[n:], pot.vertices, pot.faces)[0])
        assert off.mean() < 0.003
        assert abs((outward[n:, 2] - normals[shown, 2]).mean()) < 1e-6, "as much looks up as before"
        other, _ = completed(points[shown], normals[shown], 100 * towards)
        anyhow.append(np.abs(igl.signed_distance(other[n:], pot.vertices, pot.faces)[0]).mean())
    assert max(anyhow) > 0.01, "without knowing what is up it is not always guessed"
