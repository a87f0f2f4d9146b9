"""What is seen of an object, by how much of it, and by which seed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree

from dro_grasp.errors import OptionError
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.loading import cloud_object, mesh_object
from dro_grasp.objects.perception.depth_noise import PRESETS, NoiseName
from dro_grasp.objects.perception.partial_views import POINTS, DepthCamera, View, partial_view, visible_points, visible_side
from dro_grasp.objects.shape import ObjectModel


def test_the_whole_object_is_itself() -> None:
    can = load_object("can")
    assert partial_view(can, "whole", 0) is can


@pytest.mark.parametrize("view", ["half", "depth"])
def test_a_view_is_a_cloud_in_the_objects_frame_that_follows_the_seed(view: View) -> None:
    can = load_object("can")
    camera = DepthCamera(noise=0.001)
    first, again, other = (partial_view(can, view, seed, camera) for seed in (3, 3, 4))
    once, again, other = first.cloud, again.cloud, other.cloud
    np.testing.assert_array_equal(once, again)
    assert once.shape != other.shape or np.abs(once - other).max() > 0.005
    seen, given = first.seen, visible_side(can, view, 3, camera)[0]
    assert seen is not None
    assert KDTree(given).query(seen)[0].max() < 1e-6
    assert len(seen) < 0.8 * len(once)
    assert partial_view(can, "cloud", 3).seen is None
    low, high = can.cloud.min(0) - 0.03, can.cloud.max(0) + 0.03
    assert ((once > low) & (once < high)).mean() > 0.9
    if view == "half":
        assert len(visible_side(can, view, 3)[0]) == POINTS
        assert POINTS < len(once) < 3 * POINTS, "the seen half, thinned, and the other"


CLEAR = DepthCamera(noise=0.0)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def ball(at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ObjectModel:
    mesh = trimesh.creation.icosphere(4, 0.04)
    mesh.apply_translation(at)
    return mesh_object("ball", mesh, origin="ball")


def bare(obj: ObjectModel) -> ObjectModel:
    return cloud_object("bare", obj.cloud.astype(np.float64), origin="bare")


@pytest.mark.parametrize("direction", [(0, 0, 2.0), (-1.0, 0, 0), (1.0, 2.0, -3.0)])
@pytest.mark.parametrize("as_cloud", [False, True])
def test_only_the_near_side_of_a_sphere_is_seen(direction: tuple[float, float, float], as_cloud: bool):
    middle = torch.tensor([0.1, 0.0, -0.05])
    obj = ball((0.1, 0.0, -0.05))
    towards = torch.tensor(direction) / torch.tensor(direction).norm()
    points = visible_points(bare(obj) if as_cloud else obj, towards, seeded(), CLEAR) - middle
    assert len(points) > 500
    assert (points.norm(dim=-1) - 0.04).abs().max() < 3e-4
    height = points @ towards
    assert height.max() > 0.039
    # From distance d, a sphere of radius r is seen down to the height r^2 / d.
    assert height.min() > 0.04**2 / 0.5 - (0.006 if as_cloud else 1e-3)
    assert height.min() < 0.015
    across = points - height[:, None] * towards
    assert across.mean(0).norm() < 1e-3


def test_pixels_lie_as_close_as_the_camera_says():
    slab = mesh_object("slab", trimesh.creation.box((0.1, 0.1, 0.02)), origin="slab")
    points = visible_points(slab, torch.tensor([0.0, 0, 1]), seeded(), CLEAR)
    assert points[:, 2].min() > 0.0099
    expected = (0.1 / (0.0015 * (0.5 - 0.01) / 0.5)) ** 2
    assert len(points) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("as_cloud", [False, True])
def test_what_stands_in_front_hides_what_is_behind(as_cloud: bool):
    near = trimesh.creation.box((0.06, 0.06, 0.01), trimesh.transformations.translation_matrix((0, 0, 0.05)))
    far = trimesh.creation.box((0.04, 0.04, 0.01), trimesh.transformations.translation_matrix((0, 0, -0.05)))
    obj = mesh_object("two", trimesh.util.concatenate([near, far]), origin="two")
    points = visible_points(bare(obj) if as_cloud else obj, torch.tensor([0.0, 0, 1]), seeded(), CLEAR)
    assert points[:, 2].min() > (0.0 if as_cloud else 0.04)


def test_noise_is_along_the_ray_and_of_the_stated_size():
    camera = DepthCamera(distance=1.0, pixel=0.001, noise=0.001)
    slab = mesh_object("slab", trimesh.creation.box((0.1, 0.1, 0.02)), origin="slab")
    towards = torch.tensor([0.0, 0, 1])
    noisy = visible_points(slab, towards, seeded(), camera)
    spread = (noisy[:, 2] - 0.01).std()
    assert float(spread) == pytest.approx(0.001 * 4 * 0.98, rel=0.05)  # a metre away: four times that of half a metre
    torch.testing.assert_close(noisy, visible_points(slab, towards, seeded(), camera))
    assert not torch.equal(noisy, visible_points(slab, towards, seeded(1), camera))


@pytest.mark.parametrize("as_cloud", [False, True])
@pytest.mark.parametrize("name", ["structured_light", "time_of_flight", "stereo"])
def test_a_kind_of_camera_has_its_noise(name: NoiseName, as_cloud: bool):
    slab = mesh_object("slab", trimesh.creation.box((0.2, 0.1, 0.02)), origin="slab")
    obj, camera = bare(slab) if as_cloud else slab, DepthCamera(distance=1.0, pixel=0.002, noise=name)
    noisy = visible_points(obj, torch.tensor([0.0, 0, 1]), seeded(), camera)
    inside = noisy[(noisy[:, 0].abs() < 0.09) & (noisy[:, 1].abs() < 0.04), 2] - 0.01
    assert len(inside) > 500
    expected = float(PRESETS[name].deviation(np.array(0.99), np.array(0.0)))
    assert float(inside.std()) == pytest.approx(expected, rel=0.2)
    torch.testing.assert_close(noisy, visible_points(obj, torch.tensor([0.0, 0, 1]), seeded(), camera))
    extent = np.ptp(noisy.numpy()[:, :2], axis=0)
    np.testing.assert_allclose(extent, (0.2, 0.1), atol=0.012, err_msg="rows and columns are where they should be")


def test_lost_pixels_return_nothing():
    towards = torch.tensor([0.0, 0, 1])
    whole = len(visible_points(ball(), towards, seeded(), CLEAR))
    rest = len(visible_points(ball(), towards, seeded(), DepthCamera(noise=0, lost=0.4)))
    assert rest == pytest.approx(0.6 * whole, rel=0.1)


def test_grazing_surfaces_return_nothing():
    towards = torch.tensor([0.0, 0, 1])
    steep = visible_points(ball(), towards, seeded(), DepthCamera(noise=0, grazing=0.8))
    assert steep[:, 2].min() > 0.04 * np.sin(0.8)
    assert len(steep) < 0.6 * len(visible_points(ball(), towards, seeded(), CLEAR))


@pytest.mark.parametrize("direction", [(0.0, 0, 0), (float("nan"), 0, 1)])
def test_direction_without_length_is_refused(direction: tuple[float, float, float]):
    with pytest.raises(OptionError, match="give a vector from the object to the camera"):
        visible_points(ball(), torch.tensor(direction), seeded())


@pytest.mark.usefixtures("as_users_have_it")
def test_impossible_cameras_are_refused():
    with pytest.raises(OptionError, match="is inside the object"):
        visible_points(ball(), torch.tensor([0.0, 0, 1]), seeded(), DepthCamera(distance=0.05))
    for wrong in ({"distance": 0.0}, {"pixel": -1.0}, {"lost": 1.0}):
        with pytest.raises(OptionError, match="no possible camera"):
            DepthCamera(**wrong)
    for noise in (-0.1, "sonar"):
        with pytest.raises(OptionError, match="structured_light"):
            DepthCamera(noise=noise)
