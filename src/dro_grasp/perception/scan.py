"""From a camera's depth image or cloud to an object in the frame in which grasps are wanted."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Num
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.frames import motion_fault
from dro_grasp.geometry.point_clouds import distinct_points
from dro_grasp.geometry.table_plane import above_plane, table_plane
from dro_grasp.objects.loading import check_extent, cloud_object, estimate_normals, read_points, table_note
from dro_grasp.objects.shape import CLOUD_POINTS, ObjectModel
from dro_grasp.perception.completion import complete_cloud

NEIGHBOURS = 12
"""Neighbours that decide whether a point is an outlier (ours)."""
TOLERANCE = 2.5
"""Outliers are farther from their neighbours than the mean by this many standard deviations (ours)."""
FARTHEST = 10.0
"""Larger depths are taken to be in another unit [m] (ours)."""


def depth_points(
    depth: Num[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"], mask: Bool[np.ndarray, "rows columns"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Points of a depth image in the camera's frame: x right, y down, z forward [m].

    Args:
        depth: Depth along z [m]; 0 or NaN where there is no measurement.
        intrinsics: Pinhole matrix: focal lengths and principal point [pixels].
        mask: The object's pixels; all pixels with a depth by default.

    Raises:
        ObjectError: Mask and image differ in shape, nothing is left, or depths are not in metres.
    """
    if mask is not None and mask.shape != depth.shape:
        raise ObjectError(f"the mask has shape {mask.shape}, the depth image {depth.shape}; give one of the same size")
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(depth) & (depth > 0)
    valid = valid if mask is None else valid & mask
    if not valid.any():
        raise ObjectError("no pixel of the depth image has a depth" + ("" if mask is None else " within the mask")
                          + "; give depths in metres, and a mask that is true on the object")
    if float(np.median(depth[valid])) > FARTHEST:
        raise ObjectError(f"the median depth is {np.median(depth[valid]):g}, too far for metres; divide millimetres by 1000")
    row, column = np.nonzero(valid)
    z = depth[valid].astype(np.float64)
    rays = np.linalg.solve(intrinsics.astype(np.float64), np.stack([column, row, np.ones_like(row)]).astype(np.float64))
    return (rays / rays[2] * z).T


def load_scan(
    path: Path, T_frame_camera: Float[np.ndarray, "4 4"], scale: float = 1.0, keep_table: bool = False
) -> ObjectModel:
    """The object in a cloud file (PLY, NPY, PCD) in the camera's frame, times `scale`; see `scanned_object`.

    Raises:
        ObjectError: The file holds no cloud, or none of an object's size, or `scale` is not positive.
        OptionError: The pose is no rigid motion.
    """
    if not (math.isfinite(scale) and scale > 0):
        raise ObjectError(f"scale is {scale}; give a positive number, for example --scale 0.001 for millimetres")
    return scanned_object(path.stem, read_points(path) * scale, T_frame_camera, keep_table=keep_table)


def scanned_object(
    name: str, points: Float[np.ndarray, "n 3"], T_frame_camera: Float[np.ndarray, "4 4"] | None = None, denoise: bool = True,
    complete: bool = True, keep_table: bool = False,
) -> ObjectModel:
    """An object from the points of a camera at the origin; its grasps are in the given frame.

    Args:
        points: Points in the camera's frame [m].
        T_frame_camera: The camera's pose in the wanted frame, whose z axis points up and in which `direction` and `table`
            are given; the camera's own frame by default.
        denoise: Drop outliers.
        complete: Add the unseen side; switch it off for a scan from all sides.
        keep_table: Take every point for the object's. By default a table in the cloud is found and cut off, said in a note, and
            hands stay above it.

    Raises:
        ObjectError: Too few points are left, they are not in metres, or some lie behind the camera.
        OptionError: The pose is no rigid motion.
    """
    if T_frame_camera is not None and (fault := motion_fault(torch.as_tensor(T_frame_camera).float())) is not None:
        raise OptionError(f"T_frame_camera is not the camera's pose in the wanted frame, in metres: {fault}")
    kept = np.asarray(points, np.float64)
    kept, camera = kept[np.isfinite(kept).all(1)], np.zeros(3)
    kept = kept[distinct_points(kept)]
    total, table = len(kept), None if keep_table else table_plane(kept, camera)
    if table is not None:
        kept = kept[above_plane(kept, table)]
    cut = total - len(kept)
    if len(kept) > CLOUD_POINTS:
        kept = kept[np.random.default_rng(0).permutation(len(kept))[:CLOUD_POINTS]]
    if denoise and len(kept) > NEIGHBOURS:
        kept = without_outliers(kept)
    if len(kept) < NEIGHBOURS:
        raise ObjectError(f"{name} has {len(kept)} points after cleaning; give a denser cloud or a larger mask")
    check_extent(kept, name)
    if float((kept @ kept.mean(0)).min()) <= 0:
        raise ObjectError(f"{name} has points behind the camera, which is at the cloud's origin; give the cloud in the "
                          "camera's frame")
    normals = estimate_normals(kept.astype(np.float32), camera).astype(np.float64)
    seen, added = kept, np.zeros(0, bool)
    if complete:
        up = None if T_frame_camera is None else T_frame_camera[2, :3].astype(np.float64)
        kept, normals, added = complete_cloud(kept, normals, camera, up)
    if T_frame_camera is not None:
        R, t = T_frame_camera[:3, :3], T_frame_camera[:3, 3]
        kept, seen, normals = kept @ R.T + t, seen @ R.T + t, normals @ R.T
        if table is not None:
            up = R @ table[:3]
            table = np.append(up, table[3] + up @ t)
    obj = cloud_object(
        name, np.concatenate([kept, normals], 1), origin=name, keep_table=True, seen=seen if added.any() else None)
    return obj if table is None else replace(obj, table=table, notes=(*obj.notes, table_note(table, cut, total)))


def without_outliers(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """Remove points whose mean distance to their neighbours is unusually large. Source: Rusu et al. 2008."""
    distance = KDTree(points).query(points, k=min(NEIGHBOURS, len(points) - 1) + 1)[0][:, 1:].mean(1)
    return points[distance <= distance.mean() + TOLERANCE * distance.std()]
