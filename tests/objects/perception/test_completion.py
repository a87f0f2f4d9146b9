"""The side that nobody saw, against shapes whose surface is known exactly."""

from __future__ import annotations

from collections.abc import Callable

import igl
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from dro_grasp.network.completion_network import SurfaceFeatures, SurfaceNetwork, load_surface
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.completion import GUESSES, complete_cloud, surface_features, to_view_axes
from dro_grasp.objects.perception.partial_views import DepthCamera, visible_points, visible_side

FEATURES = 23  # Features of a place
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


def facing(points: np.ndarray, normals: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Points whose surface is seen at more than 6 degrees above its tangent."""
    rays = camera - points
    return (normals * rays).sum(1) > 0.1 * np.linalg.norm(rays, axis=1)


def likeliest(
    points: np.ndarray, normals: np.ndarray, camera: np.ndarray | None, up: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """What the best symmetry alone adds, and its normals."""
    side, axes, middle = to_view_axes(points, normals, camera, up=up)
    guess = side.guesses(1)[0]
    n = len(side.points)
    np.testing.assert_array_equal(guess.points[:n], side.points)
    return guess.points[n:] @ axes.T + middle, guess.normals[n:] @ axes.T


@pytest.mark.parametrize("by_camera", [True, False], ids=["camera", "cut"])
@pytest.mark.parametrize("shape", [ellipsoid, box, cylinder])
def test_bodies_seen_askew_are_closed_on_their_surface(shape: Callable[[], Shape], by_camera: bool) -> None:
    points, normals, distance = shape()
    found, learned, naive = [], [], []
    for seed in range(5):
        towards = Rotation.random(random_state=seed).as_matrix()[:, 2]
        camera = 0.6 * towards if by_camera else None
        # Of a convex body a camera sees what faces it.
        shown = facing(points, normals, camera) if camera is not None else points @ towards > 0
        added, outward = likeliest(points[shown], normals[shown], camera)
        np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1, atol=1e-9)
        found.append(distance(added).mean())
        naive.append(distance(mirrored(points[shown], towards)).mean())
        assert (outward * added).sum(1).mean() > 0, "normals look outward"
        if seed >= 2:  # the network takes longer than the symmetries: two views
            continue
        whole = complete_cloud(points[shown], normals[shown], camera)
        np.testing.assert_allclose(np.linalg.norm(whole.normals, axis=1), 1, atol=1e-9)
        assert (whole.normals * whole.points).sum(1)[whole.added].mean() > 0
        learned.append(distance(whole.points[whole.added]).mean())
    assert np.median(found) < 0.008
    assert np.mean(found) < (0.35 if by_camera else 0.7) * np.mean(naive)
    assert np.median(learned) < 0.009
    assert np.mean(learned) < (0.35 if by_camera else 0.6) * np.mean(naive[:2])


def test_both_sides_are_about_as_dense() -> None:
    """Of a sphere, of which a camera saw one half with many points and another with few."""
    rng = np.random.default_rng(0)
    for many in (600, 20_000):
        unit = rng.normal(size=(many, 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        shown = unit[:, 2] > 0
        whole = complete_cloud(0.04 * unit[shown], unit[shown], None)
        share = whole.added.mean()
        assert 0.35 < share < 0.65, f"{share} of the points were added to half a sphere of {shown.sum()}"


def test_a_die_is_not_thinned_away() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (3000, 3))
    normals = np.eye(3)[np.abs(points).argmax(1)] * np.sign(points)
    points = 0.004 * np.where(normals == 0, points, normals)
    whole = complete_cloud(points[points[:, 2] > 0], normals[points[:, 2] > 0], None)
    assert (~whole.added).sum() > 100
    assert whole.added.sum() > 50
    assert np.abs(np.abs(whole.points).max(1) - 0.004)[whole.added].mean() < 0.001


def test_where_the_network_finds_no_surface_the_best_guess_stays() -> None:
    points, normals, _ = box()
    camera = np.array([0.36, 0.29, 0.38])
    shown = facing(points, normals, camera)
    network = SurfaceNetwork(GUESSES, FEATURES)
    with torch.no_grad():
        # Everything is a metre away.
        network.leave.bias[GUESSES] = 100.0
    whole = complete_cloud(points[shown], normals[shown], camera, network=network)
    added, _ = likeliest(points[shown], normals[shown], camera)
    assert KDTree(added).query(whole.points[whole.added])[0].max() < 1e-9
    assert whole.added.sum() > 0.3 * len(added)


def test_an_untrained_network_believes_the_best_symmetry() -> None:
    points, normals, _ = box()
    camera = np.array([0.36, 0.29, 0.38])
    shown = facing(points, normals, camera)
    added, _ = likeliest(points[shown], normals[shown], camera)
    network = SurfaceNetwork(GUESSES, FEATURES)
    with torch.no_grad():
        # Sure of the first guess instead of only rather so.
        network.leave.bias[0] = 50.0
    whole = complete_cloud(points[shown], normals[shown], camera, network=network)
    both = np.concatenate([points[shown], added])
    # Between points and on edges, where a grid of 5 mm is round.
    assert np.quantile(KDTree(both).query(whole.points[whole.added])[0], 0.95) < 0.005
    assert np.quantile(KDTree(whole.points).query(added)[0], 0.95) < 0.005


def _told(
    points: np.ndarray, normals: np.ndarray, camera: np.ndarray, up: np.ndarray | None, places: np.ndarray
) -> SurfaceFeatures:
    side, axes, middle = to_view_axes(points, normals, camera, up=up)
    return surface_features(side, side.guesses(GUESSES), (places - middle) @ axes)


@pytest.mark.parametrize("up", [None, np.array([0.0, 0.6, 0.8])], ids=["no up", "up"])
def test_what_the_network_is_told_does_not_change_with_the_frame(up: np.ndarray | None) -> None:
    """Of a view that is turned as a whole, with its camera."""
    points, normals, _ = box()
    camera = np.array([0.2, 0.3, 0.48])
    shown = facing(points, normals, camera)
    places = np.random.default_rng(1).uniform(-0.06, 0.06, (200, 3))
    turn, moved = Rotation.from_euler("xyz", (0.7, -2.0, 1.1)).as_matrix(), np.array([0.3, -0.2, 0.5])
    told = _told(points[shown], normals[shown], camera, up, places)
    again = _told(points[shown] @ turn.T + moved, normals[shown] @ turn.T, turn @ camera + moved,
                  None if up is None else turn @ up, places @ turn.T + moved)
    for one, other in zip(told, again, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    assert told.upright == (up is not None)


@pytest.mark.parametrize("up", [np.array([0.0, 0.0, 1.0]), np.array([0.6, -0.64, 0.48])])
def test_up_is_up_in_the_image(up: np.ndarray) -> None:
    points, normals, _ = cylinder()
    camera = np.array([0.2, 0.36, 0.3])
    shown = facing(points, normals, camera)
    side, axes, middle = to_view_axes(points[shown], normals[shown], camera, up=up)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[:, 2], (camera - middle) / np.linalg.norm(camera - middle), atol=1e-12)
    assert side.up is not None
    np.testing.assert_allclose(side.up[0], 0, atol=1e-12)
    assert side.up[1] > 0


def test_a_camera_straight_above_knows_no_up_in_its_image() -> None:
    """The image is then longest along x, as without an upward direction."""
    points, normals, _ = box()
    up = np.array([0.0, 0.0, 1.0])
    shown = facing(points, normals, 0.5 * up)
    seen, camera = points[shown], np.append(points[shown].mean(0)[:2], 0.5)
    side, axes, _ = to_view_axes(seen, normals[shown], camera, up=up)
    assert not side.upright
    np.testing.assert_allclose(np.abs(axes[1, 0]), 1, atol=0.01)
    np.testing.assert_allclose(axes, to_view_axes(seen, normals[shown], camera)[1])


def test_the_network_sees_the_whole_side_and_no_order_of_its_points() -> None:
    torch.manual_seed(0)
    network = load_surface()
    normals = torch.nn.functional.normalize(torch.randn(2, 60, 3), dim=-1)
    told = SurfaceFeatures(
        0.01 * torch.randn(2, 7, GUESSES), torch.randn(2, 7, FEATURES), 0.03 * torch.randn(2, 7, 3),
        torch.cat([0.03 * torch.randn(2, 60, 3), normals], -1), torch.tensor([0.0, 1.0]))
    both = network(told)
    torch.testing.assert_close(network(told._replace(seen=told.seen[:, torch.randperm(60)])), both)
    for k in range(2):
        torch.testing.assert_close(network(SurfaceFeatures(*(column[k] for column in told))), both[k])
    assert (network(told._replace(seen=told.seen.flip(0))) - both).abs().min() > 1e-6


def test_the_network_is_nearer_to_unseen_surfaces_than_symmetry() -> None:
    """On the built-in test objects, which it was not trained on."""
    off, symmetric = [], []
    for name in ("rubber_duck", "spray_bottle", "wine_glass"):
        obj = load_object(name)
        points, normals, camera = visible_side(obj, "depth", 0)
        whole = complete_cloud(points, normals, camera)
        added, _ = likeliest(points, normals, camera)
        for kept, errors in ((whole.points[whole.added], off), (added, symmetric)):
            errors.append(np.abs(igl.signed_distance(kept, obj.vertices, obj.faces)[0]).mean())
    assert np.mean(off) < np.mean(symmetric)


def test_the_network_that_ships_is_one_of_these_features() -> None:
    network = load_surface()
    assert network.guesses == GUESSES
    assert not network.training
    with torch.no_grad():
        far = network(SurfaceFeatures(
            torch.full((1, GUESSES), 0.05), torch.zeros(1, FEATURES), torch.zeros(1, 3), torch.zeros(1, 6), torch.tensor(0.0)))
    assert torch.isfinite(far).all()


def test_a_face_seen_straight_on_becomes_as_thick_as_it_is_wide() -> None:
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 25), np.linspace(-0.05, 0.05, 40))
    face = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.4)], 1)
    added, normals = likeliest(face, np.tile([0.0, 0.0, -1.0], (len(face), 1)), np.array([0.0, 0.0, -99.0]))
    assert np.ptp([*added[:, 2], 0.4]) == pytest.approx(0.06, abs=0.002)
    np.testing.assert_allclose(normals[:, 2], 1.0, atol=1e-9)


def test_a_ball_in_a_real_depth_image() -> None:
    ball = load_object("sphere")
    radius = float(np.linalg.norm(ball.vertices, axis=1).mean())
    view = torch.tensor([0.0, 0.0, 1.0])
    points = visible_points(ball, view, torch.Generator().manual_seed(0), DepthCamera(noise=0)).double().numpy()
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    whole = complete_cloud(points, normals, DepthCamera().place(ball, view))
    length = np.linalg.norm(whole.points, axis=1)
    off = np.abs(length - radius)
    assert np.mean(off) < 0.1 * radius
    assert np.quantile(off, 0.95) < 0.25 * radius
    assert np.mean((whole.normals * whole.points).sum(1) / length) > 0.95


def test_nothing_is_thought_below_a_table() -> None:
    """A low block on a table: upside down below it, it agrees with what was seen, unless the table is known."""
    points, normals, _ = box()
    camera = np.array([0.3, 0.25, 0.45])
    shown = facing(points, normals, camera) & (points[:, 2] > 0.02)
    table = np.array([0.0, 0.0, 1.0, 0.02])
    side, axes, middle = to_view_axes(points[shown], normals[shown], camera, table)
    bare, _, _ = to_view_axes(points[shown], normals[shown], camera)
    assert side.table is not None
    places = np.random.default_rng(0).uniform(-0.08, 0.08, (500, 3))
    height = places[:, 2] - 0.02
    local = (places - middle) @ axes
    np.testing.assert_allclose(local @ side.table[:3] - side.table[3], height, atol=1e-12)
    guesses = bare.guesses(GUESSES)
    told, untold = (surface_features(one, guesses, local).features.double().numpy() for one in (side, bare))
    changed = np.flatnonzero(np.abs(told - untold).max(0) > 0)
    np.testing.assert_allclose(told[:, changed[0]], np.arcsinh(height / 0.01) / 2, atol=1e-6)
    assert np.unique(told[:, changed[1:]]).tolist() == [1.0], "that there is one"
    # The mirror in the table costs as much more as its points are below, beyond noise, three times a width.
    up = axes.T @ table[:3]
    mirror, centre = np.eye(3) - 2 * np.outer(up, up), up * side.table[3]
    moved = (side.points[side.sample] - centre) @ mirror.T + centre
    assert (moved @ up < side.table[3] + 1e-9).all()
    assert side.cost(mirror, centre) > bare.cost(mirror, centre) + 0.1


def test_pixels_are_as_far_apart_as_those_of_the_camera() -> None:
    ball = load_object("sphere")
    camera = DepthCamera(distance=0.8, pixel=0.0028, noise="stereo")
    view = torch.tensor([0.0, 0.0, 1.0])
    points = visible_points(ball, view, torch.Generator().manual_seed(0), camera).double().numpy()
    place = camera.place(ball, view)
    side, _, middle = to_view_axes(points, points / np.linalg.norm(points, axis=1, keepdims=True), place)
    assert side.pitch == pytest.approx(0.0028 * np.linalg.norm(place - middle) / 0.8, rel=0.02)
    assert to_view_axes(points, points, None)[0].pitch == 0


@pytest.mark.parametrize("end", [(0.05, 0.0, 0.5), (0.0, 0.0, 0.6)], ids=["across", "along the ray"])
def test_a_line_is_no_reason_to_stumble(end: tuple[float, float, float]) -> None:
    line = np.linspace((0.0, 0.0, 0.5), end, 40)
    whole = complete_cloud(line, np.tile([0.0, 0.0, -1.0], (40, 1)), np.zeros(3))
    assert np.isfinite(whole.points).all()
    assert np.isfinite(whole.normals).all()
    assert (~whole.added).sum() >= 10


def test_what_stands_is_guessed_upright() -> None:
    """A flower pot seen from above and aside: inverted, it would stand on its head."""
    pot = trimesh.creation.revolve(np.array([[0, 0], [0.03, 0], [0.048, 0.11], [0, 0.11]]), sections=64)
    points, face = trimesh.sample.sample_surface(pot, 6000, seed=0)
    normals = np.asarray(pot.face_normals[face])
    up = np.array([0.0, 0.0, 1.0])
    anyhow = []
    for seed in range(4):
        towards = np.array([np.cos(1.3 * seed), np.sin(1.3 * seed), 0.5]) / np.sqrt(1.25)
        shown = normals @ towards > 0.15
        added, _ = likeliest(points[shown], normals[shown], 100 * towards, up)
        assert np.abs(igl.signed_distance(added, pot.vertices, pot.faces)[0]).mean() < 0.003
        if seed == 0:
            whole = complete_cloud(points[shown], normals[shown], 100 * towards, up)
            assert np.abs(igl.signed_distance(whole.points[whole.added], pot.vertices, pot.faces)[0]).mean() < 0.004
        other, _ = likeliest(points[shown], normals[shown], 100 * towards)
        anyhow.append(np.abs(igl.signed_distance(other, pot.vertices, pot.faces)[0]).mean())
    assert max(anyhow) > 0.01, "without knowing what is up it is not always guessed"
