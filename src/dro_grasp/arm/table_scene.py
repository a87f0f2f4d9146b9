"""Objects on a table, told apart in the points of a depth camera: the table's plane by a fit, the rest by distance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from dro_grasp.arm.flat_things import overhang, seen_flat
from dro_grasp.arm.robot import Robot, Table
from dro_grasp.arm.workcell import VOXEL
from dro_grasp.errors import ObjectError, RobotError
from dro_grasp.geometry.table_plane import largest_plane
from dro_grasp.kinds import checked
from dro_grasp.objects.loading import MIN_CLOUD, cloud_object
from dro_grasp.objects.perception.scan import given_points, given_pose, scanned_object
from dro_grasp.objects.reading import numbers, returned
from dro_grasp.objects.shape import ObjectModel

THICKNESS = 0.006  # Points at most this far from the plane are the table's [m]: four standard deviations of the noise (ours)
NEIGHBOUR = 0.012
"""Points nearer to each other than this are of one object [m] (ours): a camera a metre away has points each 3 mm."""
OVERHANG = 0.1  # How far things may overhang the table [m] (ours)
FEWEST = 60  # Fewest points of an object (ours)


@dataclass(frozen=True)
class Sight:
    """What a camera sees on a table."""

    points: Float[np.ndarray, "n 3"]  # Points of the object that is wanted, in the frame in which they were given [m]
    others: Float[np.ndarray, "m 3"]  # Points of other things on the table, in the world [m]
    table_height: float  # Height of the fitted plane in the middle of the table [m]
    places: Float[np.ndarray, "k 2"]
    """Where things stand on the table, the one with most points first: x and y in the world [m]."""


@dataclass(frozen=True)
class PickedObject:
    """One object on a table, ready for planning."""

    obj: ObjectModel
    """In the world's frame, without what its completion put below the table."""
    obstacles: list[ObjectModel]
    """The other things, likewise, if there are any. What is below a point that was seen counts as solid."""
    robot: Robot
    """With its table at the height that was seen."""


@checked
def pick_object(
    name: str, points: ArrayLike, robot: Robot, T_world_camera: ArrayLike | None = None,
    near: tuple[float, float] | None = None, mask: ArrayLike | None = None,
) -> PickedObject:
    """Find the table in a cloud, remove it, and pick one of the objects on it.

    Objects are told apart by distance: two that are less than 12 mm apart count as one, unless a mask is given. A mask also
    shows what is too flat for the camera's depth, such as a card.

    Examples:
        >>> picked = pick_object("mug", points, robot, robot.camera.T_world_camera, near=(0.5, 0.1))
        >>> made = plan(picked.robot, picked.obj, obstacles=picked.obstacles)

    Args:
        name: What to call it.
        points: In the camera's frame, or in the world's, (n, 3) [m]; several objects, and the table. NaN are left out.
        robot: With a table.
        T_world_camera: The camera's pose [m], if the points are in its frame: the unseen side is then estimated.
        near: A place in the world near the object that is wanted [m]; needed where there are several.
        mask: Which points belong to the object that is wanted, (n,): those where it is true or not 0.

    Raises:
        ObjectError: No level plane, nothing on it, or nothing within the mask; or it is not clear which object is wanted.
        OptionError: The pose is no rigid motion.
        RobotError: The robot has no table.
    """
    if robot.table is None:
        raise RobotError(f"robot '{robot.name}' has no table to look for in '{name}'; state it in the robot file, or give the "
                         "object's points alone")
    given, T = given_points(points, name)[:, :3], None if T_world_camera is None else given_pose(T_world_camera)
    wanted = None if mask is None else numbers(mask, "the mask", "biuf") != 0
    if wanted is not None and wanted.shape != (len(given),):
        raise ObjectError(f"the mask has shape {wanted.shape}; expected ({len(given)},), one entry for each point of '{name}'")
    finite = returned(given)
    if wanted is not None and T is not None:
        world = given[finite] @ T[:3, :3].T + T[:3, 3]
        if (flat := seen_flat(name, world, wanted[finite], robot.table, T[:3, 3])) is not None:
            return PickedObject(flat.obj, flat.others, replace(robot, table=replace(robot.table, height=flat.table)))
    sight = sort_out(
        given[finite], np.eye(4) if T is None else T, robot.table, near, None if wanted is None else wanted[finite])
    if len(sight.places) > 1 and near is None and mask is None:
        places = ", ".join(f"({x:.2f}, {y:.2f})" for x, y in sight.places)
        raise ObjectError(f"'{name}' has {len(sight.places)} things that stand on the table, at {places} m; say which one is "
                          "wanted by a place near it (near=(X, Y)), or give its points alone")
    height = sight.table_height
    level = replace(robot, table=replace(robot.table, height=height))
    if T is None:
        return PickedObject(cloud_object(name, sight.points, origin=name, keep_table=True), _solid(sight), level)
    whole = scanned_object(name, sight.points, T, keep_table=True)
    rows = np.concatenate([whole.cloud, whole.cloud_normals], 1)[whole.cloud[:, 2] > height]
    return PickedObject(
        replace(cloud_object(name, rows, origin=name, keep_table=True, seen=whole.seen), notes=whole.notes),
        _solid(sight), level)


def sees_table(world: Float[np.ndarray, "n 3"], table: Table) -> bool:
    """Whether points are those of a table, with or without something on it, and not of one object alone."""
    # A fifth of them lies within 3 cm of the table's height in the robot file, and is longer than any object (ours).
    on = world[np.abs(world[:, 2] - table.height) < 0.03]
    return len(on) >= 0.2 * len(world) and float(np.ptp(on[:, :2], axis=0).max(initial=0)) > 0.4


def _solid(sight: Sight) -> list[ObjectModel]:
    if not len(sight.others):
        return []
    cells, column = np.unique(np.floor(sight.others[:, :2] / VOXEL).astype(int), axis=0, return_inverse=True)
    tops = np.full(len(cells), -np.inf)
    np.maximum.at(tops, column.ravel(), sight.others[:, 2])
    heights = [np.arange(top, min(sight.table_height, top - VOXEL), -VOXEL) for top in tops]
    rows = [np.column_stack([np.tile((cell + 0.5) * VOXEL, (len(z), 1)), z]) for cell, z in zip(cells, heights, strict=True)]
    points = np.concatenate(rows)
    if len(points) < MIN_CLOUD:  # an obstacle all the same, in the same cells
        points = (points[:, None] + VOXEL / 3 * (np.indices((3, 3, 3)).reshape(3, -1).T - 1)).reshape(-1, 3)
    return [cloud_object("other things", points, origin="other things", keep_table=True)]


def sort_out(
    points: Float[np.ndarray, "n 3"], T_world_camera: Float[np.ndarray, "4 4"], table: Table,
    near: tuple[float, float] | None = None, mask: Bool[np.ndarray, " n"] | None = None,
) -> Sight:
    """Points of a table sorted: those of one object, and those of others. Arguments as for `pick_object`.

    Without `near` and `mask`, the thing with most points is taken.

    Raises:
        ObjectError: There is no level plane, nothing stands on it, or the mask has nothing of it.
    """
    world = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    beyond = overhang(world, table)
    plane = fit_plane(world[beyond < 0])
    height = world @ plane[:3] - plane[3]
    kept = (beyond < OVERHANG) & (height > THICKNESS) & (height < 0.4)  # [m]: what is higher is no object's (ours)
    middle = (plane[3] - plane[:2] @ np.array(table.centre)) / plane[2]
    points, world, group = points[kept], world[kept], clusters(world[kept])
    sizes = np.bincount(group) if len(group) else np.zeros(1, int)
    if sizes.max() < FEWEST:
        raise ObjectError(f"nothing stands on the table: {int(sizes.max())} points are left after its plane is removed; put "
                          "the object into the camera's view, or correct the camera's pose in the robot file")
    large = [int(g) for g in (-sizes).argsort(kind="stable") if sizes[g] >= FEWEST]
    places = np.stack([world[group == g, :2].mean(0) for g in large])
    if mask is not None:
        wanted = mask[kept]
        if wanted.sum() < FEWEST:
            raise ObjectError(f"the mask has {int(wanted.sum())} points above the table, and at least {FEWEST} are needed; "
                              "give one that is true on the object")
    else:
        nearest = 0 if near is None else int(np.linalg.norm(places - near, axis=1).argmin())
        wanted = group == large[nearest]
    # Small groups within 5 cm of the wanted one are taken for parts of it, and groups of less than 5 points for noise (ours).
    fragment = (sizes[group] < FEWEST) & (KDTree(world[wanted]).query(world)[0] < 0.05)
    others = ~wanted & ~fragment & (sizes[group] >= 5)
    return Sight(points[wanted], world[others], float(middle), places)


def fit_plane(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4"]:
    """Upward unit normal of the plane, tilted by at most 0.2 rad, that most points lie on, and its height along it [m]."""
    plane = largest_plane(points, THICKNESS / 2, 0.2, fits=3)
    if plane is None or (np.abs(points @ plane[:3] - plane[3]) < THICKNESS / 2).sum() < FEWEST:
        raise ObjectError("the camera sees no level table; correct its pose in the robot file, or the table's place")
    return plane


def clusters(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Number of the connected group of each point; neighbours are closer than NEIGHBOUR."""
    pairs = KDTree(points).query_pairs(NEIGHBOUR, output_type="ndarray") if len(points) else np.zeros((0, 2), int)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    return connected_components(graph, directed=False)[1] if len(points) else np.zeros(0, int)
