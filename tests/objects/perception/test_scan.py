"""From rendered depth images back to the object: points, normals and frames against the mesh they were rendered from."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from dro_grasp.cli.main import main
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.frames import NamedMotion, read_motion
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import object_of, with_sources
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.partial_views import visible_points
from dro_grasp.objects.perception.scan import check_depths, depth_points, load_scan, ordinary, scanned_object
from dro_grasp.objects.perception.scene_files import SceneCamera, sight_of_cloud
from dro_grasp.objects.shape import ObjectModel
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.weights import untrained_weights

INTRINSICS = np.array([[300.0, 0, 79.5], [0, 310.0, 59.5], [0, 0, 1]])
SHAPE = (120, 160)


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return load_object("mug")


@pytest.fixture(scope="module")
def T_object_camera() -> np.ndarray:
    """A camera half a metre off that looks at the mug askew."""
    T = np.eye(4)
    T[:3, :3] = (Rotation.from_euler("y", 25, degrees=True) * Rotation.from_euler("x", 200, degrees=True)).as_matrix()
    T[:3, 3] = -0.5 * T[:3, 2]
    return T


@pytest.fixture(scope="module")
def depth(mug: ObjectModel, T_object_camera: np.ndarray) -> np.ndarray:
    """Depth along z of the first surface on each pixel's ray, by igl; zero where there is none."""
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    rays = np.stack([(column - 79.5) / 300, (row - 59.5) / 310, np.ones(SHAPE)], -1).reshape(-1, 3)
    image = np.zeros(len(rays))
    for i, ray in enumerate(rays @ T_object_camera[:3, :3].T):
        hits = igl.ray_mesh_intersect(T_object_camera[:3, 3], ray, mug.vertices, mug.faces)
        if hits:
            image[i] = min(h[1] for h in hits)  # rays have z = 1, so the parameter is the depth
    return image.reshape(SHAPE)


def off_surface(mug: ObjectModel, points: np.ndarray) -> np.ndarray:
    return np.abs(igl.signed_distance(points, mug.vertices, mug.faces)[0])


def test_points_lie_on_the_mesh(mug: ObjectModel, depth: np.ndarray, T_object_camera: np.ndarray) -> None:
    points = depth_points(depth, INTRINSICS)
    assert len(points) == int((depth > 0).sum()) > 500
    assert off_surface(mug, points @ T_object_camera[:3, :3].T + T_object_camera[:3, 3]).max() < 1e-5
    mask = np.zeros(SHAPE, bool)
    mask[:, 80:] = True
    right = depth_points(depth, INTRINSICS, mask)
    assert 0 < len(right) < len(points)
    assert right[:, 0].min() > 0, "x points right"


def test_a_scan_is_in_the_frame_asked_for_and_looks_at_the_camera(
    mug: ObjectModel, depth: np.ndarray, T_object_camera: np.ndarray
) -> None:
    noise = np.random.default_rng(0)
    points = depth_points(depth, INTRINSICS)
    stray = np.array([[0.0, 0.0, 0.3], [0.1, 0.1, 0.6], [-0.1, 0.05, 0.45]])
    dirty = np.concatenate([points + noise.normal(0, 5e-4, points.shape), stray, [[np.nan, 0, 0]]])
    scan = scanned_object("mug seen", dirty, T_object_camera, complete=False)
    assert scan.is_cloud
    assert off_surface(mug, scan.cloud.astype(float)).max() < 0.004, "the stray points are gone"
    towards = T_object_camera[:3, 3] - scan.cloud
    assert ((scan.cloud_normals * towards).sum(1) > 0).all()
    kept = scanned_object("mug seen", dirty[:-1], T_object_camera, denoise=False, complete=False)
    assert off_surface(mug, kept.cloud.astype(float)).max() > 0.02
    _, face, _, _ = igl.signed_distance(scan.cloud.astype(float), mug.vertices, mug.faces)
    own = np.cross(*(mug.vertices[mug.faces[face, k]] - mug.vertices[mug.faces[face, 0]] for k in (1, 2)))
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    assert np.median((own * scan.cloud_normals).sum(1)) > 0.95


def test_a_completed_scan_knows_which_of_its_points_were_seen(
    mug: ObjectModel, depth: np.ndarray, T_object_camera: np.ndarray
) -> None:
    points = depth_points(depth, INTRINSICS)
    scan = scanned_object("mug seen", points, T_object_camera)
    assert scan.seen is not None
    given = KDTree(points @ T_object_camera[:3, :3].T + T_object_camera[:3, 3])
    assert given.query(scan.seen)[0].max() < 1e-5
    away = given.query(scan.cloud)[0]
    assert 0.9 * len(points) < len(scan.seen) <= len(points), "without strays"
    assert 0.2 < (away > 0.003).mean() < 0.8
    assert scanned_object("mug seen", points, T_object_camera, complete=False).seen is None


@pytest.mark.parametrize(("mask", "word"), [(np.zeros((5, 5), bool), "shape"), (np.zeros(SHAPE, bool), "within the mask")])
def test_masks_that_show_nothing_are_refused(depth: np.ndarray, mask: np.ndarray, word: str) -> None:
    with pytest.raises(ObjectError, match=word):
        depth_points(depth, INTRINSICS, mask)


@pytest.mark.parametrize("depth_of_one", [-0.1, 0.0, 1e-9, 0.001])
def test_points_beside_the_camera_are_refused(mug: ObjectModel, depth_of_one: float) -> None:
    seen = mug.cloud - mug.cloud.mean(0) + [0, 0, 0.5]
    stray = [0.1, 0, depth_of_one] + np.linspace(0, 0.01, 40)[:, None] * [0, 1, 0]
    scanned_object("mug", seen)
    with pytest.raises(ObjectError, match="points behind or beside the camera"):
        scanned_object("mug", np.concatenate([seen, stray]), denoise=False, keep_table=True)


@pytest.mark.parametrize(("median", "units"), [
    (45.0, ["0.45 m in centimetres (divide by 100)"]),
    (600.0, ["6 m in centimetres (divide by 100)", "0.6 m in millimetres (divide by 1000)"]),
    # A room in millimetres, or a bench in tenths of one: only who knows the camera knows which.
    (3500.0, ["3.5 m in millimetres (divide by 1000)", "0.35 m in tenths of a millimetre (divide by 10000)"]),
    (450000.0, ["0.45 m in micrometres (divide by 1000000)"]),
    (1e9, ["too far for any unit"]),
])
def test_depths_in_other_units_are_refused_with_all_that_they_may_be(median: float, units: list[str]) -> None:
    with pytest.raises(ObjectError) as caught:
        depth_points(np.full(SHAPE, median), INTRINSICS)
    told = str(caught.value)
    assert all(unit in told for unit in units)
    assert told.count("divide by") == sum("divide by" in unit for unit in units)


@pytest.mark.parametrize(("median", "told"), [
    (0.0008, "times 1000 it is 0.8 m; times 10000 it is 8 m"), (8e-7, "times 1000000 it is 0.8 m"),
    (0.029, "times 100 it is 2.9 m"), (1e-12, "nearer than a depth camera measures (0.03 m). Give metres"),
    (0.031, None), (0.08, None)])
def test_depths_nearer_than_a_camera_measures_are_refused(median: float, told: str | None) -> None:
    if told is None:
        assert depth_points(np.full(SHAPE, median), INTRINSICS)[0, 2] == pytest.approx(median)
        return
    with pytest.raises(ObjectError) as caught:
        depth_points(np.full(SHAPE, median), INTRINSICS)
    assert told in str(caught.value)
    assert str(caught.value).endswith(". Give metres"), "there is neither a scale nor a stated unit"


@pytest.mark.parametrize(("given", "said"), [
    ({}, "millimetres already; leave out a scale (if one is given) or correct the camera's depth_unit"),
    ({"scale": 1.0}, "millimetres already; correct the camera's depth_unit"),
    ({"scale": 0.001}, "millimetres already; leave out a scale (scale=0.001) or correct the camera's depth_unit"),
    ({"scale": 0.001, "with_unit": False}, ". Give metres; leave out a scale (scale=0.001)"),
    ({"scale": 1.0, "with_unit": False}, ". Give metres"),
])
def test_a_scale_and_a_unit_are_named_where_they_may_be_wrong(given: dict[str, Any], said: str) -> None:
    check_depths(1.0, **given)
    with pytest.raises(ObjectError) as caught:
        check_depths(0.0008, **given)
    assert str(caught.value).endswith(said)


def test_intrinsics_of_a_part_of_an_image_are_taken(depth: np.ndarray) -> None:
    part = depth[10:80, 60:150]
    matrix = INTRINSICS - np.array([[0, 0, 60.0], [0, 0, 10], [0, 0, 0]])
    whole = depth_points(depth, INTRINSICS)
    near = KDTree(whole).query(depth_points(part, matrix))[0]
    assert near.max() < 1e-9


def test_the_matrix_of_an_image_before_it_was_turned_is_refused() -> None:
    upright, matrix = np.full((640, 480), 0.6), np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    with pytest.raises(ObjectError, match="of the image before it was turned"):
        depth_points(upright, matrix)
    assert len(depth_points(upright, np.array([[600.0, 0, 240], [0, 600, 320], [0, 0, 1]]))) == upright.size


def test_points_behind_the_camera_are_refused(depth: np.ndarray, T_object_camera: np.ndarray) -> None:
    """As OpenGL has them: z points backward."""
    points = depth_points(depth, INTRINSICS) * [1, -1, -1]
    with pytest.raises(ObjectError, match="100 % of its points behind the camera, whose z points forward"):
        scanned_object("mug", points, T_object_camera)
    with pytest.raises(ObjectError, match="behind the camera"):
        sight_of_cloud(points, SceneCamera(T_object_camera), None)


def test_a_scan_drops_and_counts_pixels_without_a_return(
    mug: ObjectModel, depth: np.ndarray, T_object_camera: np.ndarray
) -> None:
    points, gaps = depth_points(depth, INTRINSICS), np.concatenate([np.zeros((500, 3)), np.full((200, 3), np.nan)])
    clean = scanned_object("mug", points, T_object_camera)
    dirty = scanned_object("mug", np.concatenate([points, gaps]), T_object_camera)
    assert dirty.sha256 == clean.sha256
    assert f"700 of {len(points) + 700} points are none (NaN, or 0 0 0 for no return) and were dropped" in dirty.notes


@pytest.mark.parametrize("kind", [bool, np.uint8, int, float, list, torch.as_tensor])
def test_a_mask_of_any_type_is_true_where_it_is_not_zero(depth: np.ndarray, kind) -> None:
    """Masks of segmentation networks are bytes, of images 0 and 255."""
    mask = np.zeros(SHAPE, np.uint8)
    mask[:, 80:] = 255
    given = mask.tolist() if kind is list else kind(mask) if kind is torch.as_tensor else mask.astype(kind)
    expected = np.stack(np.nonzero((depth > 0) & (mask > 0)), 1)
    points = depth_points(depth, INTRINSICS, given)
    pixels = points @ INTRINSICS.T / points[:, 2:]
    np.testing.assert_allclose(pixels[:, [1, 0]], expected, atol=1e-9)


@pytest.mark.parametrize("kind", [torch.as_tensor, lambda a: torch.as_tensor(a).requires_grad_(), np.ndarray.tolist])
def test_lists_and_tensors_are_taken_as_arrays_are(
    mug: ObjectModel, depth: np.ndarray, T_object_camera: np.ndarray, kind
) -> None:
    points = depth_points(depth, INTRINSICS)
    np.testing.assert_array_equal(depth_points(kind(depth), kind(INTRINSICS)), points)
    scan = scanned_object("mug", points, T_object_camera)
    assert scanned_object("mug", kind(points), kind(T_object_camera)).sha256 == scan.sha256
    towards = np.array([1.0, 0.5, 2.0])
    seen = [visible_points(mug, x, torch.Generator().manual_seed(0)) for x in (torch.from_numpy(towards), kind(towards))]
    assert torch.equal(*seen)


def test_arrays_of_wrong_shapes_are_refused_in_words(depth: np.ndarray) -> None:
    for image, intrinsics, word in (
        (depth[None], INTRINSICS, r"shape \(1, 120, 160\)"), (depth, [300.0, 300.0, 80.0, 60.0], r"\[300.0, 300.0, 80.0"),
        (depth, np.diag([300.0, 300.0, 0.0]), "principal point"), ([[1.0, 2.0], [3.0]], INTRINSICS, "rows have equal lengths"),
        ([["a"]], INTRINSICS, "instead of numbers"),
    ):
        with pytest.raises(ObjectError, match=word):
            depth_points(image, intrinsics)
    for points in (np.ones((40, 4)), np.ones(12), 5.0):
        with pytest.raises(ObjectError, match=r"expected \(n, 3\) points"):
            scanned_object("thing", points)


def test_points_that_coincide_count_once(depth: np.ndarray, T_object_camera: np.ndarray) -> None:
    """Neighbours in the same place tell no normal, and hide outliers."""
    points = depth_points(depth, INTRINSICS)
    scan = scanned_object("mug", points, T_object_camera)
    for repeated in (np.tile(points, (20, 1)), np.concatenate([points, np.tile(points[:1], (50_000, 1))])):
        again = scanned_object("mug", repeated, T_object_camera)
        assert again.sha256 == scan.sha256
        np.testing.assert_array_equal(again.cloud_normals, scan.cloud_normals)


def test_few_points_are_refused() -> None:
    with pytest.raises(ObjectError, match="3 points after cleaning"):
        scanned_object("crumbs", np.random.default_rng(0).normal(size=(3, 3)))


def test_images_of_one_channel_are_images(depth: np.ndarray) -> None:
    mask = (depth > 0) & (np.arange(SHAPE[1]) < 80)
    np.testing.assert_array_equal(
        depth_points(depth[..., None], INTRINSICS, mask[..., None]), depth_points(depth, INTRINSICS, mask))


@pytest.mark.parametrize("fault", ["transposed", "mirrored", "millimetres"])
def test_a_pose_that_is_none_is_refused(depth: np.ndarray, T_object_camera: np.ndarray, fault: str) -> None:
    """It would mirror the object, or leave it where the camera is."""
    T = {"transposed": T_object_camera.T, "mirrored": np.diag([1.0, 1, -1, 1]), "millimetres": np.eye(4)}[fault].copy()
    if fault == "millimetres":
        T[:3, 3] = [400.0, 0, 800.0]
    with pytest.raises(OptionError, match="T_frame_camera is not the camera's pose"):
        scanned_object("mug", depth_points(depth, INTRINSICS), T)


def ball_before_a_camera() -> tuple[np.ndarray, np.ndarray]:
    """Points of the near side of a ball half a metre off [m], and its normals, which are exact."""
    normals = np.random.default_rng(0).normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] < -0.2]
    return 0.04 * normals + [0, 0, 0.5], normals


@pytest.mark.parametrize(("given", "used", "told"), [
    (lambda n: n, True, None), (lambda n: -n, True, "pointed away from the camera and were turned"),
    (lambda n: np.where(np.arange(len(n))[:, None] % 2 == 0, n, -n), False, "to both sides of one surface, so they were not"),
    (lambda n: np.where(n[:, :1] > 0, n, -n), False, "do not all face the camera, so they were not"),
    (lambda n: n * np.linspace(0.1, 5, len(n))[:, None], False, "not all one length, so they were not used"),
    (lambda n: 0 * n, False, "not all one length, so they were not used")])
def test_normals_of_a_camera_s_file_are_used_where_they_face_it(
    given: Any, used: bool, told: str | None, tmp_path: Path, T_object_camera: np.ndarray
) -> None:
    points, normals = ball_before_a_camera()
    rows = np.column_stack([1000 * points, given(normals)])
    head = "".join(f"property double {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    text = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{head}end_header\n"
    (tmp_path / "scan.ply").write_text(text + "\n".join(" ".join(map(repr, row)) for row in rows.tolist()))
    scan = load_scan(tmp_path / "scan.ply", T_object_camera, 0.001)
    assert scan.seen is not None
    index = KDTree(scan.cloud).query(scan.seen)[1]
    R, t = T_object_camera[:3, :3], T_object_camera[:3, 3]
    centre = R @ [0, 0, 0.5] + t
    off = np.abs(scan.cloud_normals[index] - (scan.seen - centre) / 0.04).max(1)
    assert (np.median(off) < 1e-4) == used
    assert np.median(off) < 0.3, "estimated ones face the camera as well"
    assert [note for note in scan.notes if "its normals" in note] == [note for note in scan.notes if told and told in note]
    assert any("its normals" in note for note in scan.notes) == (told is not None)


@pytest.mark.parametrize("scale", [-1.0, 0.0, float("nan")])
def test_a_scan_of_no_scale_is_refused(depth: np.ndarray, tmp_path: Path, scale: float) -> None:
    np.save(tmp_path / "scan.npy", depth_points(depth, INTRINSICS))
    with pytest.raises(ObjectError, match="scale is"):
        load_scan(tmp_path / "scan.npy", np.eye(4), scale)


def test_a_plane_loses_no_points_but_strays() -> None:
    plane = np.stack([*np.meshgrid(np.linspace(0, 0.1, 20), np.linspace(0, 0.1, 20)), np.zeros((20, 20))], -1).reshape(-1, 3)
    cloud = np.concatenate([plane, [[0.05, 0.05, 0.08]]])
    cleaned = cloud[ordinary(cloud)]
    assert cleaned[:, 2].max() == 0
    assert len(cleaned) >= 396


def test_a_ball_keeps_its_outline_and_loses_strays() -> None:
    """As a camera half a metre away sees it: where it turns away, its points lie as far apart as its surface is steep."""
    radius, pixel, away = 0.03, 0.0015, 0.5
    x, y = np.meshgrid(*[np.arange(-0.05, 0.05, pixel)] * 2)
    inside = np.hypot(x, y) < 0.99 * radius
    ball = np.stack([x[inside], y[inside], away - np.sqrt(radius**2 - x[inside]**2 - y[inside]**2)], 1)
    stray = np.array([[0.0, 0.0, away - 0.06], [0.045, 0.0, away], [-0.02, -0.04, away + 0.03]])
    assert ordinary(ball).mean() >= 0.995
    cloud = np.concatenate([ball, stray])
    cleaned = cloud[ordinary(cloud)]
    assert len(cleaned) >= 0.995 * len(ball)
    assert KDTree(stray).query(cleaned)[0].min() > 0, "no stray is left"


def test_a_table_that_is_known_is_where_the_object_stands(depth: np.ndarray, T_object_camera: np.ndarray) -> None:
    points = depth_points(depth, INTRINSICS)
    R, t = T_object_camera[:3, :3], T_object_camera[:3, 3]
    low = float((points @ R.T + t)[:, 2].min())
    plane = np.append(R[2], low - t[2])
    scan = scanned_object("mug seen", points, T_object_camera, table=plane, keep_table=True)
    assert scan.table is not None
    np.testing.assert_allclose(scan.table, [0, 0, 1, low], atol=1e-9)
    assert scan.seen is not None
    assert low - 1e-6 < scan.cloud[:, 2].min() < low + 0.003, "its unseen side reaches down to the table"
    for wrong in ([0.0, 0.0, 1.0], [0.0, 0.0, 2.0, 0.1], [0.0, 0.0, np.nan, 0.1]):
        with pytest.raises(OptionError, match="upward unit normal"):
            scanned_object("mug seen", points, T_object_camera, table=wrong)


def test_up_is_a_direction_of_any_length(depth: np.ndarray, T_object_camera: np.ndarray) -> None:
    points = depth_points(depth, INTRINSICS)
    one, other = (scanned_object("mug seen", points, up=length * T_object_camera[2, :3]) for length in (1.0, 7.0))
    np.testing.assert_allclose(one.cloud, other.cloud, atol=1e-6)
    for wrong in ([0.0, 0.0, 0.0], [0.0, 1.0], [0.0, np.nan, 1.0]):
        with pytest.raises(OptionError, match="direction of three numbers"):
            scanned_object("mug seen", points, up=wrong)


@pytest.fixture(scope="module")
def command(depth: np.ndarray, T_object_camera: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What grasps a cloud in the frame of a camera file from above, without what makes good grasps."""
    folder = tmp_path_factory.mktemp("scan")
    np.save(folder / "scan.npy", depth_points(depth, INTRINSICS))
    (folder / "camera.json").write_text(json.dumps({"frame": "base", "T_frame_camera": T_object_camera.tolist()}))
    return ["generate", "--object", str(folder / "scan.npy"), "--camera", str(folder / "camera.json"), "--hand", "gripper3",
            "--num", "3", "--weights", str(untrained_weights(folder)), "--direction", "0", "0", "-1", "--no-refine",
            "--source", "network", "--json"]


@pytest.fixture(scope="module")
def made(command: list[str]) -> Path:
    """The file that it writes."""
    file, said = Path(command[2]).with_name("g.parquet"), io.StringIO()
    with redirect_stdout(said):
        assert main([*command, "--output", str(file)]) == 0
    assert json.loads(said.getvalue())["frame"] == "base"
    return file


def test_grasps_of_a_cloud_are_in_the_frame_of_the_camera_file(
    command: list[str], made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same cloud in two frames gives the same grasps in two frames, and the direction counts in the frame named."""
    palms = loaded_hand("gripper3").palm_directions(GraspBatch.load(made).T_object_wrist)
    assert float(palms[:, 2].max()) < -0.8
    wrists = GraspBatch.load(made).T_object_wrist[:, :3, 3]
    assert float(wrists.norm(dim=1).max()) < 0.4, "about the object, not about the camera"
    mesh = [a if not a.endswith("scan.npy") else "mug" for a in command]
    assert main(mesh) == 2
    assert "camera cloud" in capsys.readouterr().err
    assert torch.isfinite(palms).all()


def test_what_a_camera_saw_ends_on_the_table_that_is_given(
    command: list[str], depth: np.ndarray, T_object_camera: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    low = float((depth_points(depth, INTRINSICS) @ T_object_camera[:3, :3].T + T_object_camera[:3, 3])[:, 2].min())
    height = low - 0.004
    file = tmp_path / "g.parquet"
    assert main([*command, "--num", "1", "--table", str(height), "--output", str(file)]) == 0
    grasps = GraspBatch.load(file)
    again = object_of(grasps, None, 1.0)
    assert again.sha256 == grasps.object_sha256[0]
    assert again.cloud[:, 2].min() == pytest.approx(height, abs=0.003)
    assert "made for another" not in capsys.readouterr().err


def test_a_file_remembers_the_frame_and_where_the_camera_stood(
    made: Path, depth: np.ndarray, T_object_camera: np.ndarray, tmp_path: Path
) -> None:
    """Read again, the object stands where the grasps are; every export names their frame."""
    points, file, grasps = depth_points(depth, INTRINSICS), made, GraspBatch.load(made)
    again = object_of(grasps, None, 1.0)
    assert again.sha256 == grasps.object_sha256[0] == load_scan(
        made.with_name("scan.npy"), read_motion(made.with_name("camera.json"), "T_frame_camera").T.double().numpy()).sha256
    seen = points @ T_object_camera[:3, :3].T + T_object_camera[:3, 3]
    assert np.abs(again.cloud.mean(0) - seen.mean(0)).max() < 0.05
    for form, ending in (("isaac_grasp", "yaml"), ("moveit", "moveit.yaml"), ("csv", "csv")):
        target = tmp_path / f"out.{ending}"
        assert main(["export", str(file), "--format", form, "--output", str(target)]) == 0
        assert "in frame 'base'" in target.read_text().splitlines()[0]
    assert main(["export", str(file), "--format", "dexgraspbench", "--output", str(tmp_path / "bench")]) == 0
    position, wxyz = np.split(np.load(tmp_path / "bench" / "0.npy", allow_pickle=True).item()["obj_pose"], [3])
    np.testing.assert_allclose(position, T_object_camera[:3, 3], atol=1e-6)
    turn = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(turn, T_object_camera[:3, :3], atol=1e-6)  # of the file, which is in the camera's frame
    assert "object_frame_link: base" in (tmp_path / "out.yaml").read_text()
    assert "frame_id: base" in (tmp_path / "out.moveit.yaml").read_text()


def test_what_depth_cameras_leave_behind_is_dropped(
    mug: ObjectModel, depth: np.ndarray, T_object_camera: np.ndarray, tmp_path: Path
) -> None:
    """Pixels without depth as NaN, as organised clouds have them, and a stray far beyond the size of any object."""
    points = depth_points(depth, INTRINSICS)
    np.save(tmp_path / "raw.npy", np.concatenate([points, np.full((50, 3), np.nan), [[0.3, 0.2, 1.9]]]))
    obj = load_scan(tmp_path / "raw.npy", T_object_camera)
    assert float(np.ptp(obj.cloud, axis=0).max()) < 0.2
    assert np.quantile(off_surface(mug, obj.cloud.astype(float)), 0.5) < 0.003


def on_a_table(seen: np.ndarray, T_object_camera: np.ndarray) -> np.ndarray:
    """The seen points with a table at the mug's foot, in the camera's frame."""
    rng = np.random.default_rng(0)
    foot = load_object("mug").cloud[:, 2].min()
    table = np.column_stack([rng.uniform(-0.25, 0.25, (4000, 2)), np.full(4000, foot) + rng.normal(0, 0.001, 4000)])
    return np.concatenate([seen, (table - T_object_camera[:3, 3]) @ T_object_camera[:3, :3]])


def test_a_table_in_a_scan_is_cut_off_and_known_in_the_frame_asked_for(
    mug: ObjectModel, depth: np.ndarray, T_object_camera: np.ndarray
) -> None:
    T = T_object_camera if T_object_camera[2, 3] > 0 else np.diag([1.0, 1.0, -1.0, 1.0])
    assert T is T_object_camera, "the camera is above the mug's foot"
    points = on_a_table(depth_points(depth, INTRINSICS), T)
    scan = scanned_object("mug on a table", points, T, complete=False)
    assert off_surface(mug, scan.cloud.astype(float)).max() < 0.004
    assert scan.table is not None
    np.testing.assert_allclose(scan.table, [0, 0, 1, mug.cloud[:, 2].min()], atol=0.02)
    assert "a table was found in the cloud" in scan.notes[-1]
    kept = scanned_object("mug on a table", points, T, complete=False, keep_table=True)
    assert kept.table is None
    assert len(kept.cloud) > 2 * len(scan.cloud)
    assert np.ptp(kept.cloud[:, 0]) > 0.4


def test_a_cloud_file_loses_its_table(
    tmp_path: Path, depth: np.ndarray, T_object_camera: np.ndarray, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("dro_grasp.objects.surface_distances.LARGEST_GRID", 50_000)  # how good the grasp is, is not asked
    points = on_a_table(depth_points(depth, INTRINSICS), T_object_camera)
    path = tmp_path / "scene.npy"
    np.save(path, points)
    cut, whole = load_object(path), load_object(points, keep_table=True)
    assert np.ptp(cut.cloud, axis=0).max() < 0.2 < np.ptp(whole.cloud, axis=0).max()
    np.testing.assert_allclose(cut.table[:3], T_object_camera[2, :3], atol=0.02)
    weights = str(untrained_weights(tmp_path))
    command = ["generate", "--hand", "gripper3", "--object", str(path), "--num", "1", "--source", "network"]
    command += ["--weights", weights]
    assert main([*command, "--table", "0.0"]) == 0
    told = capsys.readouterr().err
    assert "a table was found in the cloud" in told
    assert "but the table in the cloud is where" in told
    assert main([*command, "--table", "-1.0", "--keep-table"]) == 0
    assert "counts along the z axis of the cloud" in capsys.readouterr().err


def test_a_kept_table_is_there_when_the_grasps_are_read_again(
    tmp_path: Path, depth: np.ndarray, T_object_camera: np.ndarray
) -> None:
    points, path = on_a_table(depth_points(depth, INTRINSICS), T_object_camera), tmp_path / "scene.npy"
    np.save(path, points * 1000)
    hand, camera = loaded_hand("gripper3"), NamedMotion("base", torch.from_numpy(T_object_camera).float())
    for keep_table in (False, True):
        for obj, pose in (
            (load_object(path, scale=0.001, keep_table=keep_table), None),
            (load_scan(path, T_object_camera.astype(np.float32).astype(float), 0.001, keep_table), camera),
        ):
            file = tmp_path / "grasps.parquet"
            bare = GraspBatch.create(hand, [obj], torch.eye(4)[None], hand.canonical_joints()[None])
            with_sources(bare, "gripper3", str(path), 0.001, pose).save(file)
            again = object_of(GraspBatch.load(file), None, 1.0)
            assert (again.sha256, again.notes) == (obj.sha256, obj.notes)
            assert (again.table is None) == keep_table
            if pose is None and keep_table:
                stranger = GraspBatch.load(file).replace(object_sha256=("0" * 64,))
                unknown = stranger.replace(object_sha256=("",))
                assert all(object_of(one, None, 1.0).table is not None for one in (stranger, unknown))
