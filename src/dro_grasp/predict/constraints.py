"""What grasps have to respect beside hand and object: palm directions, what stays clear, where the object is touched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Real
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.files import MAX_QUOTED_CHARS
from dro_grasp.geometry.distance_field import Ball, Balls
from dro_grasp.kinds import Checked, plain
from dro_grasp.objects.scenery import Scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.grasp_energy import Surroundings, Workspace
from dro_grasp.optimize.starts import Direction

SAME_TABLE_WITHIN = 0.01  # A table farther than this from the one in the cloud is another [m] (ours)
MIN_UPRIGHT_COSINE = math.cos(math.radians(5.0))
"""Least cosine between z and the normal of a table whose height along z is given (ours)."""
MIN_PLANE_COSINE = 0.1  # Least such cosine of a plane that has a height at all (ours)
Z_AXIS_TOLERANCE = 1e-6  # Largest deviation of a z axis that points upwards (ours)
MAX_PREGRASP_CLEARANCE = 0.2  # Largest pregrasp clearance that is accepted [m] (ours)
MAX_MARGIN = 10.0  # Largest margin that is accepted (ours)
LOW = 0.035  # Height on a table up to which a thing is pinched from above, rather than clasped [m] (ours)
MAX_BALLS = 1000  # Most balls of a contact region or keep-out (ours): each costs time at every step
MIN_REGION_POINTS = 16  # Fewest points of an object's cloud that a contact region must contain (ours)
DirectionLike = Sequence[float] | Real[np.ndarray, "3"] | Real[Tensor, "3"]
BallRows = Sequence[Sequence[float]] | Real[np.ndarray, "n 4"] | Real[Tensor, "n 4"]  # What may be given for balls


@dataclass(frozen=True)
class Constraints(Checked):
    """What grasps have to respect; nothing by default. All in the object's frame.

    Examples:
        >>> above = Constraints(direction=(0, 0, -1), max_tilt=0.5, table=0.0, obstacles=load_scene("shelf.ply"))
        >>> grasps = GraspPredictor().predict(hand, obj, constraints=above)
    """

    direction: Direction | None = None
    """Palm direction; any by default. Over a table, palms also tilt down as far as the hand needs room."""
    table: float | None = None
    """Height of a plane [m]; the hand stays above it. By default the table that was found in a cloud, if any."""
    max_tilt: float | None = None
    """Largest angle between the palm direction and `direction` [rad]; palms are spread evenly within it and tilt no farther.
    By default palms point roughly along the direction."""
    obstacles: Scene | None = None
    """What else the hand stays clear of: see `load_scene`."""
    contact_region: tuple[Ball, ...] = ()
    """Contact region, as balls (x, y, z, radius) [m]: in the grasp, the hand touches the object nowhere else. By default it may
    touch all of it."""
    keep_out: tuple[Ball, ...] = ()
    """Keep-out, as balls (x, y, z, radius) [m] that the hand stays out of."""
    pregrasp_clearance: float | None = None
    """Least distance between the object and every link that closes, in pregrasp [m]: the error of place that the approach
    tolerates. The pregrasp opens as far as that takes. By default joints open by a quarter of the range left."""
    touch_table: bool | None = None
    """Whether fingertips may touch the table; by default beside an object that lies lower than LOW, which can hardly be grasped
    otherwise."""
    margin: float | None = None
    """Multiple of the object's weight that the squeeze holds whichever way gravity pulls; None takes the configuration's."""
    max_force: float | None = None
    """Largest normal force of a contact at the squeeze [N], for what is soft or fragile; any by default."""

    def __repr__(self) -> str:
        given = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}
        return f"Constraints({', '.join(f'{name}={value!r}' for name, value in given.items())})"

    def __post_init__(self) -> None:
        """Refuse what cannot be done, before any work.

        Raises:
            OptionError: A number is out of range, the direction is no vector or zero, or `max_tilt` has no direction.
        """
        if self.direction is not None:
            object.__setattr__(self, "direction", _vector(self.direction))
        for name, balls in (("contact_region", self.contact_region), ("keep_out", self.keep_out)):
            object.__setattr__(self, name, _balls(name, balls))
        super().__post_init__()  # after these, whose errors say more
        if self.direction is not None and not 1e-9 <= math.hypot(*self.direction) < math.inf:
            raise OptionError(f"direction {self.direction} has no direction; give the palm direction in the object's frame, "
                              "for example direction=(0, 0, -1) to grasp from above")
        if self.table is not None and not math.isfinite(self.table):
            raise OptionError(f"table is {self.table}; give the height in metres, for example table=0")
        if self.max_tilt is not None and not 0 < self.max_tilt <= math.pi:
            degrees = f"; {self.max_tilt:g} degrees are {math.radians(self.max_tilt):.3g}" if 0 < self.max_tilt <= 180 else ""
            raise OptionError(f"max_tilt is {self.max_tilt}; give the largest angle in radians, above 0 and at most "
                              f"3.14{degrees}")
        if self.max_tilt is not None and self.direction is None:
            raise OptionError("max_tilt is an angle from direction, which is absent; give both, for example "
                              "direction=(0, 0, -1), max_tilt=0.5")
        if self.margin is not None and not 0 <= self.margin <= MAX_MARGIN:
            raise OptionError(f"margin is {self.margin}; give a multiple of the object's weight from 0 to {MAX_MARGIN:g}, for "
                              "example margin=1.5")
        if self.max_force is not None and not 0 < self.max_force < math.inf:
            raise OptionError(f"max_force is {self.max_force}; give newtons above 0, for example max_force=5; leave it out "
                              "where contacts may press as hard as they do")
        if self.pregrasp_clearance is not None and not 0 < self.pregrasp_clearance <= MAX_PREGRASP_CLEARANCE:
            raise OptionError(f"pregrasp_clearance is {self.pregrasp_clearance}; give metres, above 0 and at most "
                              f"{MAX_PREGRASP_CLEARANCE:g}: 0.01 for 1 cm")

    def moved(self, T: Float[np.ndarray, "4 4"]) -> Constraints:
        """The same in another frame, of which T is the motion from this one's coordinates to its own [m].

        Raises:
            OptionError: There is a table, and the other frame's z axis points elsewhere.
        """
        R, t = T[:3, :3], T[:3, 3]
        if self.table is not None and abs(T[2, 2] - 1) > Z_AXIS_TOLERANCE:
            raise OptionError("table is a height along z, and the other frame's z axis points elsewhere; leave out table, or "
                              "turn the frame")
        region, keep_out = (tuple((*(R @ ball[:3] + t).tolist(), ball[3]) for ball in balls)
                            for balls in (self.contact_region, self.keep_out))
        return replace(
            self, direction=None if self.direction is None else tuple((R @ self.direction).tolist()),
            table=None if self.table is None else self.table + float(t[2]),
            obstacles=None if self.obstacles is None else self.obstacles.moved(T), contact_region=region, keep_out=keep_out)

    def require_fit(self, obj: ObjectModel) -> None:
        """Refuse what leaves nothing of this object to grasp.

        Raises:
            OptionError: The table is above it, or the contact region is not on it, or the keep-out is all of it.
            ObjectError: The scene contains it.
        """
        cloud = torch.from_numpy(obj.cloud)
        top = float(cloud[:, 2].max())
        if self.table is not None and not self.table < top:
            raise OptionError(f"a table at {self.table} m leaves nothing of the object, which ends at z = {top:.3f} m; give "
                              "the table's height in metres in the frame of the grasps")
        spans = ", ".join(f"{axis} = {a:.3f} to {b:.3f}" for axis, a, b in zip("xyz", obj.cloud.min(0), obj.cloud.max(0),
                                                                              strict=True))
        free = torch.ones(len(cloud), dtype=torch.bool)
        if (place := Balls.of(self.contact_region)) is not None:
            free = place.distances(cloud)[0] <= 0
            if int(free.sum()) < MIN_REGION_POINTS:
                raise OptionError(f"contact_region is not on the object: {int(free.sum())} of {len(cloud)} points of its "
                                  f"surface are within the balls, and it spans {spans} m. Move the "
                                  "balls, or give a larger radius")
        if (place := Balls.of(self.keep_out)) is not None:
            free &= place.distances(cloud)[0] > 0
            if int(free.sum()) < MIN_REGION_POINTS:
                raise OptionError(f"keep_out leaves nothing{' of contact_region' if self.contact_region else ''} to "
                                  f"touch on the object, which spans {spans} m; give a smaller radius")
        if self.obstacles is not None:
            self.obstacles.require_apart(obj)

    def warning(self, obj: ObjectModel) -> str | None:
        """A sentence about a table that contradicts the cloud's own; None if there is none."""
        if self.table is None or obj.table is None:
            return None
        found, centre = torch.tensor(obj.table), torch.tensor(obj.centre_of_mass)
        height = float((found[3] - found[:2] @ centre[:2]) / found[2]) if abs(float(found[2])) > MIN_PLANE_COSINE else math.inf
        if abs(height - self.table) < SAME_TABLE_WITHIN and float(found[2]) > MIN_UPRIGHT_COSINE:
            return None
        x, y, z, distance = (f"{float(value):.3g}" for value in obj.table)
        return (f"table is z = {self.table:g} m, but the table in the cloud is where {x} x + {y} y + {z} z = {distance} "
                "m. Leave out table, which takes the one in the cloud; or, if the cloud is a camera's, give the camera's pose")

    def workspace(self, obj: ObjectModel, reach: float) -> Workspace:
        """Where a hand may be around an object, and where it may touch it.

        Args:
            obj: The object.
            reach: How far the hand gets from it [m]; nothing farther away matters.
        """
        plane = obj.table if self.table is None else (0.0, 0.0, 1.0, self.table)
        obstacles, keep_out = None, Balls.of(self.keep_out)
        if self.obstacles is not None:
            obstacles = self.obstacles.near(obj.cloud.min(0) - reach, obj.cloud.max(0) + reach)
        surroundings = None
        if plane is not None or obstacles is not None or keep_out is not None:
            below = None if plane is None else torch.tensor(plane, dtype=torch.float32)
            touch = below is not None and (lies_low(obj, below) if self.touch_table is None else self.touch_table)
            surroundings = Surroundings(below, obstacles, keep_out, touch)
        return Workspace(surroundings, Balls.of(self.contact_region))


def lies_low(obj: ObjectModel, table: Float[Tensor, "4"]) -> bool:
    """Whether an object ends less than LOW above a table, so that fingertips have to come down to the table beside it."""
    return float((torch.from_numpy(obj.cloud) @ table[:3]).max() - table[3]) < LOW


def _vector(given: Any) -> Direction:
    """A direction as plain numbers, from any kind of vector."""
    try:
        x, y, z = _numbers(given)
    except (TypeError, ValueError, RuntimeError, OptionError) as error:  # PyTorch raises the third
        raise OptionError(f"direction is {_shortly(given)}; give three numbers, the palm direction in the object's frame, for "
                          "example direction=(0, 0, -1) to grasp from above") from error
    return x, y, z


def _balls(name: str, given: Any) -> tuple[Ball, ...]:
    """Balls as plain numbers, from any kind of rows."""
    example = f"x, y, z and a radius above 0 in metres, for example --{name.replace('_', '-')} 0 0 0.1 0.03"
    try:
        rows = [_numbers(ball) for ball in given]
    except (TypeError, ValueError, RuntimeError, OptionError) as error:
        raise OptionError(f"{name} is {_shortly(given)}; give a list of balls, each of {example}") from error
    if len(rows) > MAX_BALLS:
        raise OptionError(f"{name} has {len(rows)} balls; give at most {MAX_BALLS}, with a larger radius")
    balls: list[Ball] = []
    for row in rows:
        if len(row) != 4 or not all(map(math.isfinite, row)) or not row[3] > 0:
            raise OptionError(f"{name} has the ball {row}; give {example}")
        balls.append(row)
    return tuple(balls)


def _numbers(given: Any) -> tuple[float, ...]:
    """The numbers of any kind of vector; digits in a text are none."""
    return tuple(map(float, plain("", list(given), tuple[float, ...])))


def _shortly(given: Any) -> str:
    """What was given, in one line."""
    return " ".join(str(given).split())[:MAX_QUOTED_CHARS]
