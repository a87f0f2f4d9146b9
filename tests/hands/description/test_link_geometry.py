"""Shapes of links against the formula of each kind of shape, and against SciPy's rotations."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dro_grasp.hands.description.tree_reading import quaternion_matrix, read_geometry

TURN = Rotation.from_euler("xyz", [20, -35, 70], degrees=True)
PLACE = np.array([0.01, -0.02, 0.03])
SHAPES = {
    "sphere": ("0.02", 4 / 3 * math.pi * 0.02**3),
    "ellipsoid": ("0.01 0.02 0.03", 4 / 3 * math.pi * 0.01 * 0.02 * 0.03),
    "capsule": ("0.01 0.03", math.pi * 0.01**2 * 0.06 + 4 / 3 * math.pi * 0.01**3),
    "cylinder": ("0.02 0.03", math.pi * 0.02**2 * 0.06),
    "box": ("0.01 0.02 0.03", 8 * 0.01 * 0.02 * 0.03),
}
"""Sizes, and volumes [m^3]."""


def model_of(geoms: str, assets: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{assets}</asset><worldbody><body name='link'><joint range='0 1' limited='true'/>{geoms}</body>"
        "</worldbody></mujoco>")


def placed(kind: str, rest: str) -> str:
    w = TURN.as_quat(scalar_first=True)
    return f"<geom type='{kind}' pos='{' '.join(map(str, PLACE))}' quat='{' '.join(map(str, w))}' {rest}/>"


@pytest.mark.parametrize("kind", list(SHAPES))
def test_shapes_have_their_volume_and_lie_where_mujoco_has_them(kind: str) -> None:
    size, volume = SHAPES[kind]
    model = model_of(placed(kind, f"size='{size}'"))
    (shape,) = read_geometry(model, {1: 0})
    mesh = trimesh.Trimesh(shape.vertices, shape.faces)
    assert mesh.is_watertight
    assert volume * 0.9 < mesh.volume < volume * 1.001, "facets lie within, and outward is outward"
    np.testing.assert_allclose(mesh.center_mass, PLACE, atol=1e-6)
    # MuJoCo's own distance from a far point, along lines through the shape.
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for direction in Rotation.random(12, random_state=1).as_matrix()[:, 0]:
        start = PLACE + 0.2 * direction
        theirs = mujoco.mj_ray(model, data, start, -direction, None, 1, -1, np.zeros(1, np.int32), None)
        hits = mesh.ray.intersects_location(start[None], -direction[None])[0]
        assert np.linalg.norm(hits - start, axis=1).min() == pytest.approx(theirs, abs=0.002)


def test_meshes_that_collide_are_hulls_and_others_are_as_drawn(tmp_path) -> None:
    bowl = trimesh.creation.annulus(r_min=0.02, r_max=0.03, height=0.02)
    bowl.export(tmp_path / "ring.stl")
    asset = f"<mesh name='ring' file='{tmp_path / 'ring.stl'}'/>"
    model = model_of("<geom type='mesh' mesh='ring'/><geom type='mesh' mesh='ring' contype='0' conaffinity='0'/>", asset)
    colliding, drawn = read_geometry(model, {1: 0})
    assert (colliding.collides, colliding.visual) == (True, False), "another shape is drawn"
    assert (drawn.collides, drawn.visual) == (False, True)
    hull, ring = (trimesh.Trimesh(s.vertices, s.faces) for s in (colliding, drawn))
    assert hull.volume == pytest.approx(bowl.convex_hull.volume, rel=1e-3)
    assert ring.volume == pytest.approx(bowl.volume, rel=1e-3)
    assert colliding.fill == pytest.approx(bowl.volume / bowl.convex_hull.volume, rel=1e-3)
    assert drawn.fill == 1


def test_shapes_of_other_bodies_are_left_out() -> None:
    assert read_geometry(model_of("<geom size='0.01'/>"), {}) == ()


def test_quaternions_are_those_of_scipy() -> None:
    for rotation in Rotation.random(20, random_state=3):
        np.testing.assert_allclose(quaternion_matrix(rotation.as_quat(scalar_first=True)), rotation.as_matrix(), atol=1e-12)
