"""Where a lifted object is put down: as it stood, or as its mesh stands, its foot on a surface, turned about the vertical.

A place is a motion of the object from where it stood. Those that the surface, the arm's length or other things rule out are
refused in words before any grasp is made. Ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Real
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from dro_grasp.arm.planning.workcell import SINK, TABLE, VOXEL, Workcell
from dro_grasp.arm.robots.robot import Robot, Table
from dro_grasp.errors import OptionError, PlanError
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.table_plane import moved_plane
from dro_grasp.objects.shape import ObjectModel

AWAY = 0.15  # Least distance of a place that is chosen from where the object stood [m] (ours)
SPACING = 0.05  # Distance between the places on a table that one is chosen from [m] (ours)
APART = 0.03  # Distance that a place which is chosen keeps from other things [m] (ours)
SPOTS = 4  # Places that are chosen on a table, for a grasp to reach one of (ours)
TURNS = 8  # Turns about the vertical that are tried where none is given (ours)
LEVEL = 0.98  # Least cosine between a table's normal and the vertical [1] (ours): 11 degrees
FLOATS = 0.1  # Greatest height of a cloud's lowest point above what it stands on [m] (ours)
GAP = 0.01  # Farthest that an object may stand above what carries it [m] (ours): a release from there tips most of them over
TOP = 0.01  # Points of a thing within this depth below its highest are its top [m] (ours)


def beyond_reach(robot: Robot, spot: Float[np.ndarray, "3"]) -> str:
    """What is wrong with a spot of the world [m] that no hand of the robot reaches; nothing if it may reach it."""
    distance, longest = float(np.linalg.norm(spot - robot.T_world_base[:3, 3])), robot.longest_reach
    return (f"is {distance:.2f} m from the base, farther than the arm and hand are long ({longest:.2f} m)"
            if distance > longest else "")


@dataclass(frozen=True)
class Place:
    """What was asked for: a spot, or a surface on which one is chosen."""

    spot: tuple[float, float, float] | None = None  # Where the middle of the object's foot comes to stand [m]
    yaw: float | None = None  # By how much it is turned about the vertical [rad]; None for any
    surface: str = TABLE  # Name of what it is put on, where no spot is given
    falls: float = 0.0  # How far it may fall from the spot, as into a bin [m]

    @staticmethod
    def of(given: PlaceLike) -> Place:
        """From what a user gives.

        Raises:
            OptionError: It is neither the name of a surface nor three or four finite numbers.
        """
        if isinstance(given, Place):
            return given
        if isinstance(given, str):
            return Place(surface=given)
        try:
            x, y, z, *turn = map(float, given)
        except (TypeError, ValueError):
            x, y, z, turn = math.nan, 0.0, 0.0, []
        if len(turn) > 1 or not all(map(math.isfinite, (x, y, z, *turn))):
            raise OptionError(f"place is {given}; give X Y Z of the object's foot in metres, and a turn about the vertical in "
                              "radians where one is wanted; or the name of a surface, such as 'table'")
        return Place((x, y, z), turn[0] if turn else None)


PlaceLike = Place | Sequence[float] | Real[np.ndarray, " n"] | Real[Tensor, " n"] | str


@dataclass(frozen=True)
class Places:
    """Where an object may be put."""

    motions: list[Float[np.ndarray, "4 4"]]  # From where it stands, the most convenient first [m]
    allowed: float  # How deep it may be in what carries it [m]


@dataclass(frozen=True)
class Fit:
    """Whether an object fits somewhere."""

    depth: float  # How deep it would be in table or obstacles, 0 where it does not touch them [m]
    thing: str  # What it would be in deepest


def foot(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Middle of what points cover seen from above, at the height of the lowest [m]."""
    low, high = points.min(0), points.max(0)
    return np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]], np.float64)


def height_below(obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"] | None = None) -> float | None:
    """Height of the level plane on which an object stands, below its middle in the world [m]; None without one."""
    T = np.eye(4) if T_world_object is None else T_world_object
    plane = None if obj.table is None else moved_plane(obj.table, T)
    if plane is None or plane[2] < LEVEL:
        return None
    x, y, _ = T[:3, :3] @ obj.cloud.mean(0) + T[:3, 3]
    return float((plane[3] - plane[0] * x - plane[1] * y) / plane[2])


def floats(obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"]) -> float:
    """How far the lowest point of a cloud is above the plane on which it was seen [m]; 0 for a mesh.

    Of what a camera sees from above, the underside is often missing: put down with the lowest point on a surface, it would be
    pressed into it.
    """
    height = height_below(obj, T_world_object) if obj.vertices is None else None
    if height is None:
        return 0.0
    lowest = float((obj.cloud @ T_world_object[2, :3]).min() + T_world_object[2, 3])
    return min(max(0.0, lowest - height), FLOATS)


def standing_turn(obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3 3"]:
    """The least rotation after which a mesh stands stably on a level surface; none for a cloud, which stood as it was seen."""
    if obj.vertices is None:
        return np.eye(3)
    hull = trimesh.convex.convex_hull(obj.vertices)
    poses, _ = trimesh.poses.compute_stable_poses(hull, center_mass=obj.centre_of_mass, n_samples=1, threshold=0.0)
    if not len(poses):
        return np.eye(3)
    downs = -poses[:, 2, :3] @ T_world_object[:3, :3].T  # what would be below, as the object is now
    nearest = downs[downs[:, 2].argmin()]
    axis = np.cross(nearest, (0.0, 0.0, -1.0))  # of length sin(angle)
    sine, cosine = float(np.linalg.norm(axis)), -float(nearest[2])
    return Rotation.from_rotvec(axis / max(sine, 1e-12) * math.atan2(sine, cosine)).as_matrix()


class Placing:
    """Finds where the object of a workcell is put."""

    def __init__(self, cell: Workcell, place: Place) -> None:
        """Note what is asked for."""
        assert cell.target is not None
        self.cell, self.place, obj, T = cell, place, cell.target, cell.T_world_target
        self._name = obj.name
        others = [thing.cloud for thing in cell.obstacles]
        self._things = KDTree(np.concatenate(others)) if others else None
        stand = standing_turn(obj, T)
        points = (obj.cloud if obj.vertices is None else obj.vertices).astype(np.float64)
        now = points @ T[:3, :3].T + T[:3, 3]
        self._outline = now @ stand.T  # of the object as it will stand, about the world's origin
        self._floats = floats(obj, T)
        below = np.array([0.0, 0.0, self._floats])
        self._stand, self._foot = stand, foot(self._outline) - below
        self.now = foot(now) - below  # Where its foot is [m]

    def places(self) -> Places:
        """Where the object may be put.

        Raises:
            PlanError: It fits nowhere, there is no such surface, or the spot is off the table, out of reach, or in the air.
        """
        spot = self.place.spot
        return Places(self._on_surface() if spot is None else self._at(np.array(spot)), self.allowed)

    def _on_surface(self) -> list[Float[np.ndarray, "4 4"]]:
        """Motions to spots that are chosen on a surface, or a PlanError."""
        found = list[Float[np.ndarray, "4 4"]]()
        for taken, spot in enumerate(self._chosen()):
            if taken == SPOTS:
                break
            found += self._fitting(spot)[0][:TURNS // 2]
        if not found:
            raise PlanError(f"'{self._name}' fits nowhere on '{self.place.surface}', {100 * AWAY:.0f} cm from where it stands "
                            f"and {100 * APART:.0f} cm from other things; clear it, or give a place (place=(X, Y, Z))")
        return found

    def _at(self, spot: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "4 4"]]:
        """Motions to one spot, or a PlanError that says why there are none."""
        x, y, z = spot
        where = f"the place ({x:.3f}, {y:.3f}, {z:.3f}) m"
        if far := beyond_reach(self.cell.robot, spot):
            raise PlanError(f"{where} {far}; give a place in the robot's world frame [m]")
        table = self.cell.robot.table
        if table is not None and z < table.height - SINK:
            raise PlanError(f"{where} is {100 * (table.height - z):.1f} cm below the table at {table.height:.3f} m; give the "
                            "height of the surface that the object shall stand on")
        found, nearest = self._fitting(spot)
        if not found:
            raise PlanError(f"something stands at {where}: '{self._name}' would be {100 * nearest.depth:.1f} cm deep in "
                            f"{nearest.thing}; give a place farther away from it")
        if self._beside(self._motion(spot - (0, 0, GAP + self.place.falls + self._floats), self._yaw(found[0]))).depth == 0.0:
            self._refuse_air(spot, where)
        return found

    def _refuse_air(self, spot: Float[np.ndarray, "3"], where: str) -> None:
        """Say what is wrong with a spot that nothing carries."""
        table = self.cell.robot.table
        outside = math.inf if table is None else off_table(table, spot)
        if table is not None and outside > 0:
            (x, y), (dx, dy) = table.centre, (table.size[0] / 2, table.size[1] / 2)
            raise PlanError(f"{where} is {100 * outside:.1f} cm outside the table, which reaches from ({x - dx:.2f}, "
                            f"{y - dy:.2f}) to ({x + dx:.2f}, {y + dy:.2f}) m, and nothing else carries the object there")
        height = 0.0 if table is None else table.height
        raise PlanError(f"{where} is in the air: nothing carries the object there, and the table is "
                        f"{100 * (spot[2] - height):.1f} cm lower; give the height of a surface, such as {height:.3f}")

    def _chosen(self) -> Iterator[Float[np.ndarray, "3"]]:
        """Spots on the surface, the most convenient first."""
        if self.place.surface != TABLE:
            yield self._top_of(self.place.surface)
            return
        table = self.cell.robot.table
        if table is None:
            raise PlanError("there is no table to put the object on; state `table` in the robot file")
        axes = [np.arange(c - s / 2 + SPACING, c + s / 2 - SPACING / 2, SPACING)
                for c, s in zip(table.centre, table.size, strict=True)]
        spots = np.stack([*np.meshgrid(*axes, indexing="ij"), np.full([len(a) for a in axes], table.height)], -1).reshape(-1, 3)
        base, reach = self.cell.robot.T_world_base[:2, 3], self.cell.robot.longest_reach
        away, radius = np.linalg.norm(spots[:, :2] - self.now[:2], axis=1), np.linalg.norm(spots[:, :2] - base, axis=1)
        half = float(np.linalg.norm(self._outline[:, :2] - self._foot[:2], axis=1).max())
        inside = np.array([off_table(table, spot) < -half for spot in spots], bool)
        # As far from the base as it stands, the arm need only turn; nearer is a shorter way (both ours).
        cost = np.abs(radius - np.linalg.norm(self.now[:2] - base)) + 0.3 * away
        order = cost.argsort(kind="stable")
        for spot in spots[order[((away >= AWAY) & inside & (radius < reach))[order]]]:
            if self._is_clear(spot) and self._fitting(spot)[0]:
                yield spot

    def _top_of(self, name: str) -> Float[np.ndarray, "3"]:
        """Middle of the top of a thing."""
        things = {thing.name: thing for thing in self.cell.obstacles}
        if name not in things:
            known = ", ".join(f"'{other}'" for other in [TABLE, *things])
            raise PlanError(f"nothing is called '{name}' to put the object on; there are {known}")
        points = things[name].cloud if things[name].vertices is None else things[name].vertices
        assert points is not None
        top = float(points[:, 2].max())
        middle = foot(points[points[:, 2] > top - TOP])
        return np.array([middle[0], middle[1], top])

    def _is_clear(self, spot: Float[np.ndarray, "3"]) -> bool:
        """Whether the object keeps its distance to other things at a spot, with the first turn."""
        if self._things is None:
            return True
        motion = self._motion(spot, self._yaws(spot)[0])
        turn = motion[:3, :3] @ self._stand.T
        return float(self._things.query(self._outline @ turn.T + motion[:3, 3])[0].min()) > APART

    def _fitting(self, spot: Float[np.ndarray, "3"]) -> tuple[list[Float[np.ndarray, "4 4"]], Fit]:
        """Motions to a spot where nothing stands, and the best fit that there is."""
        motions = [self._motion(spot, yaw) for yaw in self._yaws(spot)]
        fits = [self._beside(motion) for motion in motions]
        return ([motion for motion, fit in zip(motions, fits, strict=True) if fit.depth <= self.allowed],
                min(fits, key=lambda fit: fit.depth))

    @property
    def allowed(self) -> float:
        """How deep the object may be in what carries it [m]: a cloud's cells reach beyond its points."""
        foot_in_ground = min(-self.cell.resting, 0.005)  # [m]: what stands deeper than this touches something else (ours)
        cells = self._off_the_table and any(thing.is_cloud for thing in self.cell.obstacles)
        return SINK + foot_in_ground + (VOXEL if cells else 0.0)

    @property
    def _off_the_table(self) -> bool:
        spot, table = self.place.spot, self.cell.robot.table
        return self.place.surface != TABLE or (
            spot is not None and (table is None or abs(spot[2] - table.height) > SINK))

    def _yaws(self, spot: Float[np.ndarray, "3"]) -> list[float]:
        """Turns about the vertical to try; first the one for which the arm turns about its base alone."""
        if self.place.yaw is not None:
            return [self.place.yaw]
        base = self.cell.robot.T_world_base[:2, 3]
        (x, y), (now_x, now_y) = spot[:2] - base, self.now[:2] - base
        first = math.atan2(y, x) - math.atan2(now_y, now_x)
        steps = sorted(range(TURNS), key=lambda k: min(k, TURNS - k))
        return [first + 2 * math.pi * k / TURNS for k in steps]

    def _motion(self, spot: Float[np.ndarray, "3"], yaw: float) -> Float[np.ndarray, "4 4"]:
        """How the object moves from where it stands to a spot."""
        turn, T = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]), np.eye(4)
        T[:3, :3] = turn @ self._stand
        T[:3, 3] = spot - turn @ self._foot
        return T

    def _yaw(self, motion: Float[np.ndarray, "4 4"]) -> float:
        turn = motion[:3, :3] @ self._stand.T
        return math.atan2(turn[1, 0], turn[0, 0])

    def _beside(self, motion: Float[np.ndarray, "4 4"]) -> Fit:
        """How the object fits at the end of a motion."""
        distance, name = min(self.cell.beside(motion), default=(0.0, ""))
        return Fit(max(0.0, -distance), name)


def off_table(table: Table, spot: Float[np.ndarray, "3"]) -> float:
    """How far a spot is outside the table's edges [m], negative within them."""
    return float((np.abs(spot[:2] - table.centre) - np.array(table.size) / 2).max())
