"""Things that touch: which are parted where one side is asked for, and which stay one."""

import numpy as np
import pytest
import trimesh

from dro_grasp.errors import OptionError
from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.scenery import load_scene
from tests.helpers.made_scenes import MadeScene, asked, overlap, render_scene, touching

Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # corners [m]
LOW: Box = ((-0.04, -0.07, 0.0), (0.04, 0.07, 0.06))
TALL: Box = ((0.04, -0.03, 0.0), (0.10, 0.03, 0.16))
BEHIND: Box = ((-0.03, 0.071, 0.0), (0.03, 0.11, 0.16))  # of which the camera sees no foot behind LOW
ON_TOP: Box = ((-0.03, -0.05, 0.06), (0.03, 0.05, 0.12))
HIGH: Box = ((-0.04, -0.07, 0.0), (0.04, 0.07, 0.16))
APART: Box = ((0.052, -0.07, 0.0), (0.12, 0.07, 0.06))  # 12 mm beside LOW, its faces in line
HANDLE: Box = ((-0.025, -0.14, 0.08), (0.025, -0.071, 0.13))  # floats before it


def _scene(boxes: tuple[Box, ...], view: int) -> MadeScene:
    meshes = [trimesh.creation.box(bounds=box) for box in boxes]
    return render_scene("table", meshes, ("box",) * len(boxes), np.random.default_rng(0), view)


@pytest.mark.parametrize("view", range(3))
@pytest.mark.parametrize("other", [TALL, BEHIND])
def test_two_boxes_that_touch_are_two(other: Box, view: int) -> None:
    made = _scene((LOW, other), view)
    assert made.load().segments.count == 1
    assert min(asked(made, part=True)) > 0.85


@pytest.mark.parametrize("view", range(2))
@pytest.mark.parametrize("height", [0.11, 0.1])
def test_two_cans_side_by_side_are_two_though_their_tops_are_in_line(height: float, view: int) -> None:
    """The seam between their sides ends at the tops: an upright cut goes on along it. From above it is too short to be told."""
    meshes = [trimesh.creation.cylinder(radius=0.033, height=own) for own in (0.11, height)]
    for mesh, x in zip(meshes, (0.0, 0.067), strict=True):
        mesh.apply_translation((x, 0.0, -mesh.bounds[0, 2]))
    made = render_scene("table", meshes, ("can", "can"), np.random.default_rng(0), view)
    scene = made.load()
    assert scene.segments.count == 1
    assert any("part=True" in note for note in scene.chosen().notes)
    assert min(asked(made, part=True)) > 0.9


@pytest.mark.parametrize("view", range(3))
def test_two_boxes_with_a_gap_between_them_are_two(view: int) -> None:
    made = _scene((LOW, APART), view)
    scene = made.load()
    if scene.segments.count == 1:
        assert any("breaks off at a gap" in note and "part=True" in note for note in scene.chosen().notes)
    assert min(asked(made, part=True)) > 0.85


@pytest.mark.parametrize("spacing", [0.005, 0.0062, 0.007, 0.0074])
def test_a_thinned_cloud_has_no_gaps(spacing: float) -> None:
    made = _scene((LOW,), 1)
    sight = made.load().sight
    assert sight is not None
    points = sight.points[one_per_cell(sight.points, spacing)]
    scene = load_scene(points, camera=made.camera)
    assert not any(scene.segments.seams)
    assert not scene.segments.parts.any()


def test_the_other_side_is_an_obstacle() -> None:
    made = _scene((LOW, TALL), 2)
    scene = made.load()
    chosen = scene.chosen(at=(0.07, 0.0, 0.08), part=True)
    assert scene.sight is not None
    other = np.flatnonzero(made.owner.ravel() == 0)
    assert np.isin(other, scene.sight.pixels[chosen.others]).mean() > 0.9


@pytest.mark.parametrize("boxes", [(LOW, ON_TOP), (HIGH, HANDLE)])
def test_what_stands_on_another_or_floats_beside_it_is_a_part_and_told(boxes: tuple[Box, ...]) -> None:
    made = _scene(boxes, 0)
    scene = made.load()
    assert scene.segments.count == 1
    (told,) = [note for note in scene.chosen().notes if "two things that touch" in note]
    assert "part=True" not in told, "it would take all of it"
    whole = scene.chosen(at=tuple(made.middles[1]), part=True)
    assert sorted(whole.own) == sorted(scene.chosen().own)
    assert any("no side of it stands by itself" in note for note in whole.notes)


@pytest.mark.parametrize("view", range(3))
@pytest.mark.parametrize("name", ["cup", "bowl", "bottle", "torus", "can", "basket"])
def test_one_object_stays_one(name: str, view: int) -> None:
    obj = load_object(name)
    mesh = trimesh.Trimesh(np.asarray(obj.vertices, float), obj.faces, process=False)
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    made = render_scene("table", [mesh], (name,), np.random.default_rng(0), view)
    assert not made.load().segments.parts.any()


def test_objects_that_touch_are_mostly_found() -> None:
    found = [iou for seed in range(6) for iou in asked(touching(seed), part=True)]
    assert np.mean(np.array(found) >= 0.8) > 0.6


def test_a_pixel_says_which_side_is_meant() -> None:
    made = _scene((LOW, TALL), 2)
    v, u = (int(np.median(rows)) for rows in np.nonzero(made.owner == 1))
    assert overlap(made, 1, made.load().chosen(pixel=(u, v), part=True).pixels) > 0.85


def test_a_side_is_asked_for_with_a_place() -> None:
    scene = _scene((LOW, TALL), 2).load()
    with pytest.raises(OptionError, match=r"part asks for one side .* say by a place \(at=\(X, Y, Z\)\) or a pixel"):
        scene.object_at(nearest=True, part=True)
    found = scene.object_at((0.07, 0.0, 0.08), part=True)
    assert np.allclose(found.obj.cloud.mean(0)[:2], (0.07, 0.0), atol=0.02)
    assert found.obstacles is not None
