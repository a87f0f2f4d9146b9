"""From a camera's depth image or cloud to an object in the frame in which grasps are wanted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.frames import motion_fault
from dro_grasp.geometry.point_clouds import distinct_points
from dro_grasp.geometry.table_plane import above_plane, moved_plane, table_plane
from dro_grasp.kinds import checked
from dro_grasp.objects.loading import (
    check_scale,
    check_view,
    cloud_object,
    dropped_note,
    estimate_normals,
    given_normals,
    table_note,
)
from dro_grasp.objects.perception.things import one_thing, refuse_scene
from dro_grasp.objects.reading import in_rows, numbers, one_channel, read_rows, returned
from dro_grasp.objects.shape import CLOUD_POINTS, ObjectModel

SIDES = (4 / 3, 16 / 9, 16 / 10, 5 / 4)
"""Width over height of cameras' images [1] (ours)."""
RESOLUTIONS = (1 / 4, 1 / 3, 1 / 2, 3 / 2, 2.0, 3.0, 4.0)
"""Widths of other images that a camera's matrix may be of, over that of the given one [1] (ours)."""
BEHIND = 0.9  # Share of points behind the camera from which on a cloud is not in its frame [1] (ours)
DEPTH_UNITS = {"centimetres": 1e-2, "millimetres": 1e-3, "tenths of a millimetre": 1e-4, "micrometres": 1e-6}
"""Units of depth images [m], the largest first."""
DEPTHS = (0.2, 10.0)  # Least and largest median depth of a camera's image of things to grasp, or of a room [m] (ours)
NEAREST = 0.03
"""Least median depth of a camera's image [m] (ours): depth cameras for close objects measure from 7 cm on, others from 10 to 50
cm; half of the former leaves room for special ones."""
LEAST_DEPTH = 0.01  # Depth of a point that a camera sees, as a share of the mean depth [1] (ours)
FACING = 0.9  # Share of a camera's normals that face it [1] (ours)
NEIGHBOURS = 12  # Neighbours that decide whether a point is an outlier (ours)
APART = 4.0  # Distance to them, over the median of all points, up to which it is none [1] (ours)


def depth_points(depth: ArrayLike, intrinsics: ArrayLike, mask: ArrayLike | None = None) -> Float[np.ndarray, "n 3"]:
    """Points of a depth image in the camera's frame: x right, y down, z forward [m].

    Arrays, tensors and nested lists are taken.

    Args:
        depth: Depth along z [m], (h, w); 0 or NaN where there is no measurement.
        intrinsics: Pinhole matrix, (3, 3): focal lengths and principal point [pixels].
        mask: The object's pixels, (h, w), which are true or not 0; all pixels with a depth by default.

    Raises:
        ObjectError: Image, mask or matrix have wrong shapes, nothing is left, or depths are not in metres.
    """
    image = one_channel(numbers(depth, "the depth image"))
    matrix = numbers(intrinsics, "the matrix of intrinsics").astype(np.float64)
    if image.ndim != 2:
        raise ObjectError(f"the depth image has shape {image.shape}; expected (h, w), one depth a pixel")
    check_intrinsics(matrix, *image.shape)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(image) & (image > 0)
    if mask is not None:
        wanted = np.nan_to_num(one_channel(numbers(mask, "the mask", "biuf"))) != 0
        if wanted.shape != image.shape:
            raise ObjectError(f"the mask has shape {wanted.shape}, the depth image {image.shape}; give one of the same size")
        valid = valid & wanted
    if not valid.any():
        raise ObjectError("no pixel of the depth image has a depth" + ("" if mask is None else " within the mask")
                          + "; give depths in metres, and a mask that is true on the object")
    check_depths(float(np.median(image[valid])), scale=1.0, with_unit=False)
    row, column = np.nonzero(valid)
    z = image[valid].astype(np.float64)
    rays = np.linalg.solve(matrix, np.stack([column, row, np.ones_like(row)]).astype(np.float64))
    return (rays / rays[2] * z).T


def check_intrinsics(matrix: Shaped[np.ndarray, "..."], height: int, width: int) -> None:
    """Refuse a matrix that is no pinhole camera's, or that of an image of another size, by an ObjectError."""
    expected = (f"expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels of this image of {width} x {height}, with the "
                f"principal point (cx, cy) near ({width / 2:g}, {height / 2:g})")
    given = f"the intrinsics are {matrix.tolist()}"
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ObjectError(f"{given}; {expected}")
    if (matrix[:2, 2] == 0).all() and (matrix[2, :2] != 0).any():
        raise ObjectError(f"{given}, which is transposed: its third row holds the principal point; {expected}")
    if not np.allclose(matrix[2], [0, 0, 1]) or abs(matrix[1, 0]) > 1e-6 * abs(matrix[1, 1]):
        raise ObjectError(f"{given}, which is no pinhole matrix: its third row is not 0 0 1, or its second has no 0 first; "
                          f"{expected}")
    (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
    if min(fx, fy) <= 0:
        raise ObjectError(f"{given}: its focal lengths are not positive; {expected}")
    if max(fx, fy) < 10 and max(abs(cx), abs(cy)) <= 1.5:  # (ours) no lens sees so wide
        raise ObjectError(f"{given}, which is divided by the size of the image: multiply its first row by {width} and its "
                          f"second by {height}; {expected}")
    _check_resolution(matrix, height, width, given, expected)


def _check_resolution(matrix: Float[np.ndarray, "3 3"], height: int, width: int, given: str, expected: str) -> None:
    # A part of an image has its principal point anywhere, and rarely the sides of a whole one.
    if not any(abs(max(width, height) / min(width, height) / sides - 1) < 0.01 for sides in SIDES):
        return
    if width != height and all(
            abs(2 * (float(c) + 0.5) / side - 1) < 0.08 for c, side in zip(matrix[:2, 2], (height, width), strict=True)):
        raise ObjectError(f"{given}, which is of the image before it was turned: turn the matrix too, or give the image as the "
                          f"camera took it; {expected}")
    across, down = (2 * (float(c) + 0.5) / side for c, side in zip(matrix[:2, 2], (width, height), strict=True))
    other = any(abs(across / factor - 1) < 0.08 for factor in RESOLUTIONS)
    if other and down > 0 and any(abs(across / down / sides - 1) < 0.08 for sides in (1.0, 4 / 3, 3 / 4)):
        raise ObjectError(f"{given}, which is of an image {across:.2g} times as wide and {down:.2g} times as high: divide its "
                          f"first row by {across:.2g} and its second by {down:.2g}, or give the image that it belongs to; "
                          f"{expected}")


def check_depths(median: float, scale: float | None = None, with_unit: bool = True) -> None:
    """Refuse depths whose median [m] is too far or too near for a camera, by an ObjectError that names their likely unit.

    A camera measures nothing nearer than some centimetres: such depths were divided by 1000 twice, or are in a larger unit.
    `scale` is what they were multiplied by, 1 where nothing was given, None where it is not known; `with_unit` tells whether
    they are of a depth image, of which the camera may state the unit.
    """
    least, most = DEPTHS
    if 0 < median < NEAREST:
        found = {1 / size: median / size for size in DEPTH_UNITS.values() if least <= median / size <= most}
        told = "".join(f"; times {factor:.0f} it is {depth:.3g} m" for factor, depth in found.items())
        steps = [] if scale == 1 else ["leave out a scale" + (" (if one is given)" if scale is None else f" (scale={scale:g})")]
        steps += ["correct the camera's depth_unit"] * with_unit
        whole = ": whole numbers in an image count as millimetres already" if with_unit else ""
        raise ObjectError(f"the median depth is {median:.3g} m, nearer than a depth camera measures ({NEAREST:g} m){told}. "
                          + "; ".join(filter(None, [f"Give metres{whole}", " or ".join(steps)])))
    if median <= most:
        return
    found = {unit: size for unit, size in DEPTH_UNITS.items() if least <= median * size <= most}
    if not found:
        raise ObjectError(f"the median depth is {median:g}, too far for any unit; give depths along z in metres")
    told = " or ".join(f"{median * size:.3g} m in {unit} (divide by {1 / size:.0f})" for unit, size in found.items())
    raise ObjectError(f"the median depth is {median:g}, too far for metres; it is {told}")


def load_scan(
    path: Path, T_frame_camera: Float[np.ndarray, "4 4"], scale: float = 1.0, keep_table: bool = False,
    height: float | None = None,
) -> ObjectModel:
    """The object in a cloud file (PLY, NPY, PCD) in the camera's frame, times `scale`; see `scanned_object`.

    `height` is that of its table in the named frame [m], where the cloud has none.
    """
    check_scale(scale)
    rows = read_rows(path)
    rows[:, :3] *= scale
    return scanned_object(
        path.stem, rows, T_frame_camera, keep_table=keep_table, table=level_plane(height, T_frame_camera))


def level_plane(height: float | None, T_frame_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4"] | None:
    """The plane at a height in the named frame [m], in the camera's: upward normal, and height along it; None for none.

    The height is in single precision, as grasps record it.
    """
    return None if height is None else np.append(T_frame_camera[2, :3], float(np.float32(height)) - T_frame_camera[2, 3])


@checked
def scanned_object(
    name: str, points: ArrayLike, T_frame_camera: ArrayLike | None = None, denoise: bool = True, complete: bool = True,
    keep_table: bool = False, up: ArrayLike | None = None, table: ArrayLike | None = None,
) -> ObjectModel:
    """An object from the points of a camera at the origin; its grasps are in the given frame.

    Arrays, tensors and nested lists are taken.

    Args:
        name: What to call the object.
        points: Points in the camera's frame, (n, 3) or (h, w, 3) [m]; NaN and (0, 0, 0) are dropped. With normals (n, 6), those
            are used if they are unit vectors towards the camera.
        T_frame_camera: The camera's pose, (4, 4), in the wanted frame, whose z axis points up and in which `direction` and
            `table` are given; the camera's own frame by default.
        denoise: Drop outliers.
        complete: Add the unseen side; switch it off for a scan from all sides.
        keep_table: Keep every point. By default a table in the cloud is found and cut off, with a note, and hands stay above
            it.
        up: The upward direction in the camera's frame, (3,), of any length, which completion prefers; by default the normal
            of the table, or the wanted frame's z axis.
        table: The plane on which the object stands, where none is found in the cloud, as it is cut off already: upward unit
            normal and height along it, (4,), in the camera's frame [m]. At height Z of the wanted frame, it is
            [*T_frame_camera[2, :3], Z - T_frame_camera[2, 3]].

    Raises:
        ObjectError: Too few points are left, they are not in metres, or some lie behind the camera.
        OptionError: The pose is no rigid motion, `up` no direction, or the table no plane.
    """
    from dro_grasp.objects.perception.completion import complete_cloud  # it takes a while, and scenes import this

    T = None if T_frame_camera is None else given_pose(T_frame_camera)
    clean = _cleaned(given_points(points, name), name, denoise, keep_table)
    kept, camera = clean.rows[:, :3], np.zeros(3)
    plane = clean.table if clean.table is not None or table is None else _given_plane(table)
    normals, odd = facing_normals(clean.rows, name)
    if normals is None:
        normals = estimate_normals(kept.astype(np.float32), camera).astype(np.float64)
    seen, added = kept, np.zeros(0, bool)
    if complete:
        level = plane[:3] if plane is not None else None if T is None else T[2, :3]
        upward = level if up is None else _given_up(up)
        kept, normals, added = complete_cloud(kept, normals, camera, upward, table=plane)
    if T is not None:
        R, t = T[:3, :3], T[:3, 3]
        kept, seen, normals = kept @ R.T + t, seen @ R.T + t, normals @ R.T
        plane = None if plane is None else moved_plane(plane, T)
    obj = cloud_object(
        name, np.concatenate([kept, normals], 1), origin=name, keep_table=True, seen=seen if added.any() else None)
    cut_off = () if plane is None or clean.table is None else (table_note(plane, clean.cut, clean.total),)
    return replace(obj, table=plane, notes=(*obj.notes, *clean.notes, *odd, *cut_off))


def _given_up(up: ArrayLike) -> Float[np.ndarray, "3"]:
    upward = numbers(up, "up").astype(np.float64)
    if upward.shape != (3,) or not np.isfinite(upward).all() or np.linalg.norm(upward) < 1e-6:
        raise OptionError(f"up is {upward.tolist()}; give a direction of three numbers in the camera's frame, such as 0 -1 0")
    return upward / np.linalg.norm(upward)


def _given_plane(table: ArrayLike) -> Float[np.ndarray, "4"]:
    plane = numbers(table, "table").astype(np.float64)
    if plane.shape != (4,) or not np.isfinite(plane).all() or abs(float(np.linalg.norm(plane[:3])) - 1) > 1e-3:
        raise OptionError(f"table is {plane.tolist()}; give its upward unit normal and its height along it, four numbers in "
                          "the camera's frame, in metres")
    return plane


class Cleaned(NamedTuple):
    """What is the object's of a camera's points."""

    rows: Float[np.ndarray, "n columns"]  # Points [m], and normals if there are any
    table: Float[np.ndarray, "4"] | None  # The table that was cut off: its normal and its height [m]
    cut: int  # Points that went with it
    total: int  # Points before
    notes: tuple[str, ...]  # What to say of the others


def _cleaned(rows: Float[np.ndarray, "n columns"], name: str, denoise: bool, keep_table: bool) -> Cleaned:
    """The points that are the object's; an ObjectError if they are none."""
    there, camera = returned(rows[:, :3]), np.zeros(3)
    told = () if there.all() else (dropped_note(int((~there).sum()), len(there)),)
    rows = rows[there]
    rows = rows[distinct_points(rows[:, :3])]
    whole, total, table = rows[:, :3], len(rows), None if keep_table else table_plane(rows[:, :3], camera)
    if table is not None:
        rows = rows[above_plane(rows[:, :3], table)]
    cut = total - len(rows)
    if not keep_table:
        own, apart = one_thing(rows[:, :3], table is not None, name)
        rows, told = rows[own], (*told, *apart)
    if len(rows) > CLOUD_POINTS:
        rows = rows[np.random.default_rng(0).permutation(len(rows))[:CLOUD_POINTS]]
    if denoise and len(rows) > NEIGHBOURS:
        rows = rows[ordinary(rows[:, :3])]
    if len(rows) < NEIGHBOURS:
        raise ObjectError(f"{name} has {len(rows)} points after cleaning; give a denser cloud or a larger mask")
    check_view(rows[:, :3], name)
    if not keep_table:
        refuse_scene(whole, rows[:, :3], name)
    refuse_behind(whole, f"{name} has")
    middle = rows[:, :3].mean(0)
    if float((rows[:, :3] @ middle).min()) <= LEAST_DEPTH * float(middle @ middle):
        raise ObjectError(f"{name} has points behind or beside the camera, which is at the cloud's origin; give the cloud in "
                          "the camera's frame")
    return Cleaned(rows, table, cut, total, told)


def refuse_behind(points: Float[np.ndarray, "n 3"], has: str) -> None:
    """Refuse points of a camera, in its frame [m], of which nearly all are behind it, by an ObjectError."""
    if len(points) and (share := float((points[:, 2] <= 0).mean())) > BEHIND:
        raise ObjectError(f"{has} {100 * share:.0f} % of its points behind the camera, whose z points forward; give them in "
                          "the camera's frame as OpenCV and ROS's optical frames have it (x right, y down), or leave out the "
                          "camera")


def given_points(points: ArrayLike, origin: str) -> Float[np.ndarray, "n columns"]:
    """The points of a cloud, NaN included [m], and normals if there are any; an ObjectError if they are none."""
    array = in_rows(numbers(points, origin).astype(np.float64))
    if array.ndim != 2 or array.shape[1] not in (3, 6):
        raise ObjectError(f"{origin} holds an array of shape {array.shape}; expected (n, 3) points, or (n, 6) with normals")
    return array


def facing_normals(
    rows: Float[np.ndarray, "n columns"], origin: str
) -> tuple[Float[np.ndarray, "n 3"] | None, tuple[str, ...]]:
    """Given normals, turned to the camera at the origin; None to estimate them. And what to say."""
    normals, odd = given_normals(rows[:, :3], rows[:, 3:], origin, named=True)
    if normals is None:
        return None, odd
    facing = float(((rows[:, :3] * normals).sum(1) < 0).mean())
    if max(facing, 1 - facing) < FACING:
        return None, ("its normals do not all face the camera, so they were not used",)
    if facing < 0.5:
        return -normals, ("its normals pointed away from the camera and were turned",)
    return normals, odd


def given_pose(T_frame_camera: ArrayLike) -> Float[np.ndarray, "4 4"]:
    """The pose of a camera in the wanted frame [m]; an OptionError if it is no rigid motion."""
    T = numbers(T_frame_camera, "T_frame_camera").astype(np.float64)
    if (fault := motion_fault(torch.from_numpy(T))) is not None:
        raise OptionError(f"T_frame_camera is not the camera's pose in the wanted frame, in metres: {fault}")
    return T


def ordinary(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Points whose mean distance to their neighbours is not unusually large. Source: Rusu et al. 2008."""
    distance = KDTree(points).query(points, k=min(NEIGHBOURS, len(points) - 1) + 1)[0][:, 1:].mean(1)
    # Where a surface turns away, at the outline, its points lie apart: they tell how it goes on, and are no outliers.
    return np.asarray(distance <= max(distance.mean() + 2.5 * distance.std(), APART * float(np.median(distance))))  # (ours)
