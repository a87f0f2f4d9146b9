"""Balls for a bare cloud: they stay inside its surface, hollows stay hollow, and mass properties are those of the shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dro_grasp.objects.ball_solid import OUTSIDE, RADII, SPACING, solid_of
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.loading import cloud_object
from dro_grasp.objects.shape import DENSITY, ObjectModel
from tests.helpers.clouds import cloud_of

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
    assert np.abs(reach - RADIUS).max() < OUTSIDE
    assert (radii == RADII[0]).mean() > 0.95
    towards = np.random.default_rng(0).normal(size=(2000, 3))
    places = CENTRE + RADIUS * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    gap = (np.linalg.norm(places[:, None] - centres, axis=2) - radii).min(1)
    assert gap.max() < SPACING / 4  # a finger meets the surface some 2 mm low at most


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
    assert (np.linalg.norm(centres[:, :2], axis=1) - radii > 0.03 - 2 * OUTSIDE).all()
    assert (np.linalg.norm(centres[:, :2], axis=1) + radii < 0.036 + 2 * OUTSIDE).all()


def test_a_large_thing_has_larger_balls_and_not_more_of_them(sphere: ObjectModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a thing of 30 cm is for the usual number of balls, a small one is for fewer."""
    usual = len(balls_of(sphere)[1])
    monkeypatch.setattr("dro_grasp.objects.ball_solid.MOST", usual // 4)
    centres, radii = balls_of(sphere)
    assert usual // 8 < len(radii) <= usual // 4
    assert radii.max() > 1.5 * RADII[0]
    reach = np.linalg.norm(centres - CENTRE, axis=1) + radii
    assert np.abs(reach - RADIUS).max() < OUTSIDE


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
