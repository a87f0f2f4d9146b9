from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.cache import cache_folder, cached_arrays, content_hash
from dro_grasp.objects import shape, surface_distances
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.loading import cloud_object, mesh_object
from dro_grasp.objects.shape import BALL_OUTSIDE, BALL_RADII, BALL_SPACING, DENSITY, ObjectModel, solid_of
from tests.helpers.clouds import cloud_of
from tests.helpers.saddle import saddle


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DRO_GRASP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def ball(radius: float = 0.03, fineness: int = 4) -> shape.ObjectModel:
    return mesh_object("ball", trimesh.creation.icosphere(fineness, radius), origin="ball")


def l_block() -> trimesh.Trimesh:
    arm = trimesh.creation.box((0.03, 0.03, 0.03), trimesh.transformations.translation_matrix((0.03, 0, -0.03)))
    return trimesh.boolean.union([trimesh.creation.box((0.03, 0.03, 0.09)), arm], engine="manifold")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_points_are_guesses_the_farther_they_are_from_what_was_seen() -> None:
    cloud = cloud_of(trimesh.creation.icosphere(4, 0.04), "ball")
    assert not cloud.guessed.any()
    seen = cloud.cloud[cloud.cloud[:, 2] > 0]
    guessed = replace(cloud, seen=seen).guessed
    away = np.array([np.linalg.norm(seen - point, axis=1).min() for point in cloud.cloud])
    assert (guessed[away <= 0.004] == 0).all()
    assert (guessed[away >= 0.016] == 1).all()
    between = (away > 0.004) & (away < 0.016)
    assert between.sum() > 100
    np.testing.assert_allclose(guessed[between], (away[between] - 0.004) / 0.012, atol=1e-4)


def test_mass_properties_of_a_box():
    sides = np.array([0.04, 0.06, 0.08])
    box = trimesh.creation.box(sides, trimesh.transformations.translation_matrix((0.1, 0, -0.05)))
    obj = mesh_object("box", box, origin="box")
    volume = sides.prod()
    assert obj.volume == pytest.approx(volume)
    assert obj.mass == pytest.approx(500 * volume)
    np.testing.assert_allclose(obj.centre_of_mass, (0.1, 0, -0.05), atol=1e-9)
    squares = sides**2
    np.testing.assert_allclose(obj.inertia, np.diag(volume / 12 * (squares.sum() - squares)), atol=1e-15)
    np.testing.assert_allclose(obj.extents, sides)


def test_cloud_lies_on_the_surface_with_outward_normals():
    obj = ball()
    assert obj.cloud.shape == obj.cloud_normals.shape == (shape.CLOUD_POINTS, 3)
    radii = np.linalg.norm(obj.cloud, axis=1)
    assert 0.0297 < radii.min() <= radii.max() < 0.03001
    assert ((obj.cloud / radii[:, None] * obj.cloud_normals).sum(1) > 0.99).all()
    np.testing.assert_array_equal(obj.cloud, ball().cloud)


def test_grid_gives_the_distance_to_a_sphere():
    obj = ball()
    points = 0.12 * (torch.rand(2000, 3, generator=seeded()) - 0.5)
    value, gradient = obj.distance_field.distances(points)
    radius = points.norm(dim=-1)
    assert (value - (radius - 0.03)).abs().max() < 5e-4
    clear = radius > 0.012  # at the centre the gradient has no direction
    assert ((gradient * points / radius[:, None]).sum(-1)[clear] > 0.97).all()


def test_grid_of_a_bare_cloud_gives_the_distance_to_a_sphere(cache: Path):
    obj = cloud_object("cloud", np.concatenate([ball().cloud, ball().cloud_normals], 1).astype(np.float64), origin="cloud")
    points = 0.12 * (torch.rand(2000, 3, generator=seeded()) - 0.5)
    value, gradient = obj.distance_field.distances(points)
    radius = points.norm(dim=-1)
    clear = radius > 0.012
    assert (value - (radius - 0.03)).abs()[clear].max() < 1e-3
    assert ((gradient * points / radius[:, None]).sum(-1)[clear] > 0.97).all()
    assert not cache.exists() or not list(cache.iterdir()), "scans would fill the disk"


def test_a_cloud_is_a_surface_of_discs():
    height = 0.01
    x, y = np.meshgrid(np.linspace(-0.02, 0.02, 9), np.linspace(-0.02, 0.02, 9))
    sheet = np.stack([x.ravel(), y.ravel(), np.full(81, height)], 1)
    points = np.array([[0, 0, 0.03], [0.0025, 0.0025, 0.0], [0.001, 0, height], [0.06, 0, height]])
    found = surface_distances.cloud_distances(sheet, np.tile([0.0, 0, 1], (81, 1)), points)
    np.testing.assert_allclose(found[:3], [0.02, -0.01, 0], atol=1e-12)
    assert 0.03 < found[3] < 0.035, "beyond the rim, to the rim's disc"


def test_signed_distances_survive_a_hole_flipped_faces_and_overlap():
    mesh = trimesh.creation.icosphere(4, 0.03)
    faces = mesh.faces[40:].copy()
    faces[::50] = faces[::50, ::-1]
    second = trimesh.creation.icosphere(3, 0.02)
    vertices = np.concatenate([mesh.vertices, second.vertices])
    faces = np.concatenate([faces, second.faces + len(mesh.vertices)])
    points = np.random.default_rng(0).normal(size=(1000, 3))
    points *= (np.linspace(0.001, 0.06, 1000) / np.linalg.norm(points, axis=1))[:, None]
    radius = np.linalg.norm(points, axis=1)
    distance = surface_distances.signed_distances(vertices, faces, points)
    clear = np.abs(radius - 0.03) > 0.002
    assert (np.sign(distance) == np.sign(radius - 0.03))[clear].mean() > 0.995


def test_grid_of_a_large_object_stays_small(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(surface_distances, "LARGEST_GRID", 20_000)
    box = trimesh.creation.box((0.3, 0.3, 0.3))
    baked = surface_distances.bake_grid(box.vertices, lambda points: points[:, 0])
    assert baked["values"].size < 25_000
    assert baked["spacing"] > surface_distances.GRID_SPACING


def test_few_points_are_computed_of_a_surface_that_fills_its_box(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(surface_distances, "EXACT_GRID", 20_000)
    monkeypatch.setattr(surface_distances, "MOST_EXACT", 150_000)
    corners = np.random.default_rng(0).uniform(-0.15, 0.15, (300, 3))
    asked: list[int] = []

    def distance(points: np.ndarray) -> np.ndarray:
        asked.append(len(points))
        return surface_distances.signed_distances(corners, np.arange(300).reshape(-1, 3), points)

    baked = surface_distances.bake_grid(corners, distance)
    assert asked[-1] <= 150_000
    assert sum(asked) < 400_000, "to find out how wide it must be, too"
    assert surface_distances.GRID_SPACING < baked["spacing"] < 3 * surface_distances.GRID_SPACING
    at = baked["origin"] + baked["spacing"] * np.indices(baked["values"].shape).reshape(3, -1).T
    exact = distance(at)
    near = np.abs(exact) < surface_distances.NEAR
    np.testing.assert_allclose(baked["values"].ravel()[near], exact[near], atol=1e-6)


def test_grid_is_read_from_the_cache_and_damage_is_mended(cache: Path, monkeypatch: pytest.MonkeyPatch):
    first = ball(0.01, 1).distance_field
    (file,) = cache.iterdir()
    assert file.name.startswith(f"grid-{ball(0.01, 1).sha256[:24]}")
    with monkeypatch.context() as patch:
        patch.setattr(shape, "bake_grid", lambda *_: pytest.fail("was in the cache"))
        second = ball(0.01, 1).distance_field
    torch.testing.assert_close(first.slopes, second.slopes)
    whole = file.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"something else", whole[:200] + b"\0" * 50 + whole[250:]):
        file.write_bytes(damaged)
        third = ball(0.01, 1).distance_field
        torch.testing.assert_close(first.slopes, third.slopes)
        assert len(file.read_bytes()) == len(whole)
    assert [f.name for f in cache.iterdir()] == [file.name]


def test_unwritable_cache_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DRO_GRASP_CACHE", str(tmp_path / "file" / "cache"))
    assert cached_arrays("key", lambda: {"a": np.arange(3)})["a"].tolist() == [0, 1, 2]
    assert cache_folder() == tmp_path / "file" / "cache"


def test_nothing_half_written_stays_in_the_cache(cache: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("dro_grasp.geometry.cache.os.replace", fail)
    cached_arrays("key", lambda: {"a": np.arange(3)})
    assert list(cache.iterdir()) == []


def test_convex_mesh_is_its_own_part():
    ((vertices, faces),) = mesh_object("box", trimesh.creation.box((0.05, 0.05, 0.05)), origin="box").parts
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(0.05**3)


def test_parts_of_a_concave_mesh_fill_it_and_are_cached(monkeypatch: pytest.MonkeyPatch):
    obj = mesh_object("l", l_block(), origin="l")
    hulls = [trimesh.Trimesh(*part) for part in obj.parts]
    assert len(hulls) >= 2
    assert all(hull.is_convex for hull in hulls)
    assert sum(hull.volume for hull in hulls) == pytest.approx(obj.volume, rel=0.1)
    monkeypatch.setattr("dro_grasp.objects.convex_parts._run", lambda *_: pytest.fail("was in the cache"))
    again = mesh_object("l", l_block(), origin="l").parts
    assert len(again) == len(hulls)
    for (vertices, faces), hull in zip(again, hulls, strict=True):
        np.testing.assert_allclose(trimesh.Trimesh(vertices, faces).volume, hull.volume)


def test_parts_of_a_mesh_with_a_hole_fill_it():
    whole = l_block().subdivide().subdivide().subdivide()
    obj = mesh_object("l", trimesh.Trimesh(whole.vertices, whole.faces[60:]), origin="l")
    assert any("not watertight" in note for note in obj.notes)
    hulls = [trimesh.Trimesh(*part) for part in obj.parts]
    assert len(hulls) >= 2
    assert sum(hull.volume for hull in hulls) == pytest.approx(whole.volume, rel=0.15)


def test_part_of_a_sheet_is_its_hull():
    obj = mesh_object("sheet", saddle(), origin="sheet")
    assert sum(trimesh.Trimesh(*part).volume for part in obj.parts) == pytest.approx(obj.volume, rel=0.1)


def test_bare_cloud_has_no_parts():
    obj = cloud_object("cloud", ball().cloud.astype(np.float64), origin="cloud")
    assert obj.is_cloud
    with pytest.raises(ObjectError, match=r"'cloud' is a bare point cloud and has no convex parts; give a mesh"):
        _ = obj.parts


def test_sampled_points_are_distinct_and_seeded():
    obj = ball()
    points = obj.sample_points(512, seeded(3))
    assert points.shape == (512, 3)
    assert len(points.unique(dim=0)) == 512
    torch.testing.assert_close(points, obj.sample_points(512, seeded(3)))
    assert not torch.equal(points, obj.sample_points(512, seeded(4)))


def test_sampling_more_points_than_a_small_cloud_has():
    obj = cloud_object("cloud", ball().cloud[:100].astype(np.float64), origin="cloud")
    assert obj.sample_points(512, seeded()).shape == (512, 3)
    assert obj.sample_partial(256, seeded()).shape == (256, 3)


def test_partial_cloud_is_one_side():
    points = ball().sample_partial(512, seeded())
    assert points.shape == (512, 3)
    towards = points.mean(0)
    assert towards.norm() > 0.012  # the mean of a half sphere lies at half the radius
    assert (points @ towards / towards.norm() > -0.004).all()


def test_hash_tells_content_apart():
    points = np.arange(6, dtype=np.float32).reshape(2, 3)
    assert content_hash(points) == content_hash(np.asfortranarray(points))
    assert content_hash(points) != content_hash(points + 1)


def test_a_few_wrong_normals_do_not_turn_a_cloud_inside_out() -> None:
    """A can without its bottom, as a camera sees it on a table, with wrong normals at its rim; the can is the oracle."""
    radius, height = 0.035, 0.1
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(0, height, 26))
    side = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1).reshape(-1, 3)
    wall = radius * side + z.reshape(-1, 1) * [0, 0, 1]
    x, y = np.meshgrid(np.linspace(-radius, radius, 18), np.linspace(-radius, radius, 18))
    inside = np.hypot(x, y) < radius - 0.002
    lid = np.stack([x[inside], y[inside], np.full(int(inside.sum()), height)], 1)
    cloud, normals = np.concatenate([wall, lid]), np.concatenate([side, np.tile([0.0, 0, 1], (len(lid), 1))])
    normals[wall.shape[0] - 60:wall.shape[0]:3] *= -1
    points = np.random.default_rng(0).uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.2], (4000, 3))
    apart = np.stack([np.hypot(points[:, 0], points[:, 1]) - radius, points[:, 2] - height], 1)
    true = np.minimum(apart.max(1), 0) + np.linalg.norm(np.maximum(apart, 0), axis=1)
    clear = np.abs(true) > 0.005
    found = surface_distances.closed_cloud_distances(cloud, normals, points)
    assert ((found < 0) == (true < 0))[clear].mean() > 0.995
    assert np.abs(found - true)[clear].max() < 0.01
    discs = surface_distances.cloud_distances(cloud, normals, points)
    assert ((discs < 0) == (true < 0))[clear].mean() < 0.95, "discs alone tell as much"
    turned = points[:500] * [1, 1, -1]  # below the open end
    assert (surface_distances.closed_cloud_distances(cloud, normals, turned)[turned[:, 2] < -0.02] > 0).all()


def test_a_banded_grid_is_exact_near_the_surface_and_close_to_it_elsewhere() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(3000, 3))
    normals = cloud / np.linalg.norm(cloud, axis=1, keepdims=True)
    cloud = normals * [0.04, 0.03, 0.05]
    normals = normals / [0.04, 0.03, 0.05]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shell = cloud[:, 2] > -0.02  # open at the bottom, as on a table
    asked = []

    def distance(points: np.ndarray) -> np.ndarray:
        asked.append(len(points))
        return surface_distances.closed_cloud_distances(cloud[shell], normals[shell], points)

    naive = surface_distances.bake_grid(cloud[shell], distance)
    banded = surface_distances.bake_grid(cloud[shell], distance, banded=True)
    near = np.abs(naive["values"]) < surface_distances.NEAR
    np.testing.assert_array_equal(naive["values"][near], banded["values"][near])
    assert np.abs(naive["values"] - banded["values"]).max() < 0.004
    assert ((naive["values"] < 0) == (banded["values"] < 0)).all()
    assert sum(asked[1:]) < 0.7 * asked[0]
    np.testing.assert_array_equal(naive["origin"], banded["origin"])


RADIUS = 0.04
CENTRE = np.array([0.45, 0.0, RADIUS])


def balls_of(obj: ObjectModel) -> tuple[np.ndarray, np.ndarray]:
    balls = solid_of(obj).balls
    assert balls is not None
    return balls.centres.numpy(), balls.radii.numpy()


@pytest.fixture(scope="module")
def sphere() -> ObjectModel:
    mesh = trimesh.creation.icosphere(4, RADIUS)
    mesh.apply_translation(CENTRE)
    return cloud_of(mesh, "sphere")


def test_balls_touch_a_sphere_from_inside_and_leave_no_gap(sphere: ObjectModel) -> None:
    centres, radii = balls_of(sphere)
    reach = np.linalg.norm(centres - CENTRE, axis=1) + radii
    assert np.abs(reach - RADIUS).max() < BALL_OUTSIDE
    assert (radii == BALL_RADII[0]).mean() > 0.95
    towards = np.random.default_rng(0).normal(size=(2000, 3))
    places = CENTRE + RADIUS * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    gap = (np.linalg.norm(places[:, None] - centres, axis=2) - radii).min(1)
    assert gap.max() < BALL_SPACING / 4  # a finger meets the surface some 2 mm low at most


def test_a_sphere_weighs_what_it_weighs(sphere: ObjectModel) -> None:
    solid, volume = solid_of(sphere), 4 / 3 * np.pi * RADIUS**3
    assert solid.mass == pytest.approx(DENSITY * volume, rel=0.05)
    np.testing.assert_allclose(solid.centre_of_mass, CENTRE, atol=5e-4)
    moment = 0.4 * volume * RADIUS**2
    np.testing.assert_allclose(solid.inertia, moment * np.eye(3), atol=0.06 * moment)


def test_a_turned_box_has_the_inertia_of_the_box() -> None:
    sides, turn = np.array([0.02, 0.03, 0.07]), trimesh.transformations.rotation_matrix(0.7, (1, 1, 0))
    mesh = trimesh.creation.box(sides)
    mesh.apply_transform(turn)
    solid, volume = solid_of(cloud_of(mesh, "box")), sides.prod()
    own = volume / 12 * np.diag((sides**2).sum() - sides**2)
    expected = turn[:3, :3] @ own @ turn[:3, :3].T
    assert solid.volume == pytest.approx(volume, rel=0.05)
    np.testing.assert_allclose(solid.inertia, expected, atol=0.07 * own.max())
    assert np.abs(expected[0, 2]) > 0.2 * own.max()


def test_a_cup_stays_hollow() -> None:
    centres, radii = balls_of(cloud_of(trimesh.creation.annulus(0.03, 0.036, 0.08), "cup"))
    assert (np.linalg.norm(centres[:, :2], axis=1) - radii > 0.03 - 2 * BALL_OUTSIDE).all()
    assert (np.linalg.norm(centres[:, :2], axis=1) + radii < 0.036 + 2 * BALL_OUTSIDE).all()


def test_a_large_thing_has_larger_balls_and_not_more_of_them(sphere: ObjectModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a thing of 30 cm is for the usual number of balls, a small one is for fewer."""
    usual = len(balls_of(sphere)[1])
    monkeypatch.setattr("dro_grasp.objects.shape.MAX_BALLS", usual // 4)
    centres, radii = balls_of(sphere)
    assert usual // 8 < len(radii) <= usual // 4
    assert radii.max() > 1.5 * BALL_RADII[0]
    reach = np.linalg.norm(centres - CENTRE, axis=1) + radii
    assert np.abs(reach - RADIUS).max() < BALL_OUTSIDE


def test_a_plate_thinner_than_the_grid_has_a_small_mass_all_the_same() -> None:
    x, y, z = (a.ravel() for a in np.meshgrid(np.linspace(0, 0.03, 31), np.linspace(0, 0.03, 31), (-0.0005, 0.0005)))
    points = np.stack([x, y, z, 0 * x, 0 * x, np.sign(z)], 1)
    plate = cloud_object("plate", points, origin="plate", keep_table=True)
    assert not (plate.distance_field.slopes[:, 0] < 0).any()
    solid = solid_of(plate)
    assert 0.0005 < solid.mass < 0.01  # 0.45 g
    assert np.linalg.eigvalsh(solid.inertia).min() > 0


def test_a_mesh_is_its_own_solid_and_other_normals_are_another_solid(sphere: ObjectModel) -> None:
    can = load_object("can")
    assert solid_of(can) is can
    solid = solid_of(sphere)
    assert solid_of(solid) is solid
    turned = replace(sphere, cloud_normals=-sphere.cloud_normals)
    assert len({obj.solid_sha256 for obj in (sphere, turned, solid, solid_of(turned))}) == 4
    assert solid_of(turned).sha256 == turned.sha256 == sphere.sha256
