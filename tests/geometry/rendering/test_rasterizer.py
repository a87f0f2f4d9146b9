"""The software renderer against solid geometry."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from dro_grasp.geometry.rendering.rasterizer import Camera, Mesh, Style, arrow, corner_normals, dots, render

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
FLAT = Style(ambient=1.0, diffuse=0.0, specular=0.0, outline=0.0)


def covered(picture: np.ndarray) -> np.ndarray:
    return (picture != 255).any(-1)


def test_silhouette_of_a_sphere_has_the_area_of_its_cone() -> None:
    distance, radius, angle, height = 1.0, 0.2, 0.6, 300
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    camera = Camera((distance, 0.0, 0.0), (0.0, 0.0, 0.0), field_of_view=angle)
    picture = render([Mesh(ball.vertices, ball.faces, RED)], camera, 400, height, style=FLAT)
    half = np.tan(np.arcsin(radius / distance)) / np.tan(angle / 2) * height / 2
    assert (1 - picture[..., 1] / 255).sum() == pytest.approx(np.pi * half**2, rel=0.005)


def test_nearer_hides_farther_whatever_the_order() -> None:
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.1
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    near, far = Mesh(square + np.array([0, 0, 0.1]), faces, RED), Mesh(2 * square, faces, BLUE)
    camera = Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    one, other = (render(m, camera, 80, 60, style=FLAT) for m in ([near, far], [far, near]))
    assert (one == other).all()
    assert one[30, 40].tolist() == [255, 0, 0]
    assert one[30, 40 + 16].tolist() == [0, 0, 255]


def test_intersecting_triangles_split_where_they_meet() -> None:
    upright = np.array([[0, -1, -1], [0, 1, -1], [0, 0, 1.0]])
    tilted = upright @ trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1))[:3, :3].T
    faces = np.array([[0, 1, 2]])
    camera = Camera((3.0, 3.0, 0.0), (0.0, 0.0, 0.0))
    picture = render([Mesh(upright, faces, RED), Mesh(tilted, faces, BLUE)], camera, 90, 90, style=FLAT)
    assert picture[60, 38].tolist() != picture[60, 52].tolist()


@pytest.mark.parametrize("direction", [(1, 0, 0), (0.3, -1, 0.4), (0, 0, 1), (0, 0, -1)])
@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_camera_sees_every_point_and_not_from_too_far(direction: tuple[float, float, float], aspect: float) -> None:
    points = np.random.default_rng(0).normal(size=(60, 3)) * (0.05, 0.1, 0.3) + (1, 2, 3)
    camera = Camera.around(points, direction, aspect=aspect)
    seen = (points - camera.position) @ camera.axes().T
    half = np.tan(camera.field_of_view / 2)
    share = np.abs(seen[:, :2]) / -seen[:, 2:] / (half * aspect, half)
    assert (seen[:, 2] < 0).all()
    assert 0.8 < share.max() < 0.95


def test_triangles_behind_the_camera_and_empty_scenes_draw_nothing() -> None:
    camera = Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    behind = Mesh(np.array([[0, 0, 2.0], [1, 0, 2], [0, 1, 2]]), np.array([[0, 1, 2]]), RED)
    assert not covered(render([behind], camera, 40, 30)).any()
    assert not covered(render([], camera, 40, 30)).any()


def test_both_sides_of_a_face_are_lit_alike() -> None:
    vertices, faces = np.array([[-1, -1, 0.0], [1, -1, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    camera = Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    front = render([Mesh(vertices, faces, RED)], camera, 40, 30)
    back = render([Mesh(vertices, faces[:, ::-1].copy(), RED)], camera, 40, 30)
    assert (front == back).all()


def test_normals_are_smooth_on_spheres_and_sharp_on_boxes() -> None:
    ball, box = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.box()
    smooth = corner_normals(ball.vertices, ball.faces, 0.85)
    assert np.abs(smooth - ball.vertices[ball.faces]).max() < 0.02
    sharp = corner_normals(box.vertices, box.faces, 0.85)
    assert np.allclose(sharp, box.face_normals[:, None])


def test_arrow_and_dots_are_closed_solids_where_they_belong() -> None:
    shaft = arrow(np.zeros(3), np.array([0.0, 0.0, 0.1]), RED)
    assert np.allclose(shaft.vertices[:, 2].max(), 0.1)
    points = np.array([[0.0, 0, 0], [1, 2, 3]])
    marks = dots(points, BLUE, radius=0.1)
    assert np.allclose(marks.vertices.reshape(2, -1, 3).mean(1), points)
    for mesh, volume in ((shaft, None), (marks, 2 * 4 / 3 * 0.1**3)):
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
        solid.update_faces(solid.nondegenerate_faces())
        assert solid.is_watertight
        assert solid.volume > 0
        if volume is not None:
            assert solid.volume == pytest.approx(volume)
