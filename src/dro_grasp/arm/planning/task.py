"""What is to be planned: a robot and one object in its workcell, and how."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.arm.planning.physics import DEVIATIONS, FRICTION, Deviation, Rehearsal, check_friction
from dro_grasp.arm.planning.placing import Place, Places, Placing, height_below
from dro_grasp.arm.planning.reachability import Reachability, ReachConfig
from dro_grasp.arm.planning.workcell import Workcell, moved, scene_solid, upright
from dro_grasp.arm.robots.robot import JointsLike, Robot, Table
from dro_grasp.errors import OptionError, PlanError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.admission import BESIDE, NARROW, SPARED, TURNED, AdmissionConfig
from dro_grasp.predict.config import AUTO
from dro_grasp.predict.constraints import MAX_PREGRASP_CLEARANCE, Constraints, lies_low
from dro_grasp.predict.finish import check_confidence
from dro_grasp.predict.sources.source import Source

Directions = Literal["paper", "all"]  # Palm directions that are asked for
ASSUMED_EXTENT = 1.2  # Largest edge of a table that no robot file states [m] (ours)
BASE_ROOM = 0.15  # Distance of its edge from the middle of the arm's base, where that is possible [m] (ours)
TIPS_DOWN = AdmissionConfig().least_tip_height
"""Height over the table that fingertips keep which may touch it [m], as where grasps are made."""
SURROUNDS = 0.1  # Least distance of its edge from what stands on it [m] (ours)


@dataclass(frozen=True)
class PlanConfig(Checked):
    """How a motion is planned. Values without a source are ours."""

    num: int = 8
    """Grasps that are asked for, in each of the batches. Each is tried as soon as it is known."""
    top: int = 5
    """Reachable grasps of best score that are given to the planner at once. Source: paper, real-robot experiment."""
    directions: Directions = "all"
    """Palm directions: `paper`, from above to the right side, or `all` for which the table leaves room."""
    constraints: Constraints = field(default_factory=Constraints)
    """What grasps have to respect, in the world's frame. The arm stays clear of obstacles too. The table is the robot's."""
    order: Literal["score", "random"] = "score"
    """Which reachable grasps are taken: the best by score, or any, as a control."""
    rounds: int = 3
    """Largest number of times that the planner is asked, each time with the next `top` grasps."""
    rehearsals: int = 8
    """Grasps whose lift is simulated, on the object as it is known, whenever there are new ones; 0 for none."""
    friction: float = FRICTION
    """Coefficient of friction between hand, object and table, for rehearsals."""
    deviations: tuple[Deviation, ...] = DEVIATIONS
    """How the rehearsals of one grasp deviate from what is known."""
    trusted_share: float = 0.5
    """Share of its rehearsals in which a grasp should hold the object after the whole of a batch."""
    trusted_score: float = 1.0
    """Log-odds of holding that a grasp should have, where nothing is rehearsed."""
    batches: int = 3
    """Largest number of batches. Another is made while no grasp is trusted, or none works."""
    candidates: int = 3
    """Candidates for each grasp, as in `GraspRequest`."""
    source: str | Source = AUTO
    """What proposes grasps, as in `GraspRequest`."""
    least_confidence: float | None = None
    """Grasps that hold with less probability are not tried, as in `GraspRequest`. Where nothing is given and lifts are
    rehearsed, it is `doubtful`, and in the last batch all are tried: a rehearsed lift tells more about a lift."""
    doubtful: float = 0.12
    """Probability of holding below which grasps are tried last, and only if they hold the object when rehearsed (ours): of
    those that do, half hold the true object of training scenes; of likelier ones nine in ten."""
    guess_clearance: float = 0.015
    """Distance that fingers keep in pregrasp from an object of which a side is a guess [m]: in the first of several batches,
    unless the constraints ask for another; 0 for none."""
    best_seconds: float = 1.0
    """Longest processor time for a path to the best grasp alone, tried before all goals are given at once [s]."""
    planner_seconds: float = 3.0
    """Longest processor time for one path to several goals [s]."""
    closing_seconds: float = 1.0
    """Least time in which the hand closes [s]. Source: as in trials."""
    grip_seconds: float = 0.5
    """How long the hand presses before the arm lifts [s]."""
    reach: ReachConfig = field(default_factory=ReachConfig)
    """Approach and lift."""

    def __post_init__(self) -> None:
        """Refuse what cannot be done.

        Raises:
            OptionError: A number is negative, or 0 where it must not be, or not finite, or something is stated twice.
        """
        super().__post_init__()
        if self.constraints.table is not None:
            raise OptionError("the table is the robot's: state its height in the robot file, and not in constraints")
        if self.constraints.direction is not None and self.directions != "all":
            raise OptionError(f"both direction and directions '{self.directions}' say whence to grasp; leave out one of them")
        check_confidence(self.least_confidence or 0.0)
        check_confidence(self.doubtful)
        check_friction(self.friction)
        if not self.deviations and self.rehearsals:
            raise OptionError("there are no deviations to rehearse lifts with; give one at least, or rehearsals=0")
        if not 0 <= self.guess_clearance <= MAX_PREGRASP_CLEARANCE:
            raise OptionError(f"guess_clearance is {self.guess_clearance}; give metres from 0 to {MAX_PREGRASP_CLEARANCE:g}")
        for name in ("num", "top", "rounds", "batches", "candidates", "planner_seconds"):
            if not 0 < getattr(self, name) < math.inf:
                raise OptionError(f"{name} is {getattr(self, name)}; give a number above 0")
        for name in ("rehearsals", "best_seconds", "closing_seconds", "grip_seconds"):
            if not 0 <= getattr(self, name) < math.inf:
                raise OptionError(f"{name} is {getattr(self, name)}; give 0 or a number above it")


@dataclass(frozen=True, eq=False)
class Task:
    """One object to lift, and to put somewhere if a place is asked for."""

    cell: Workcell
    obj: ObjectModel  # With a frame whose z axis points up
    T: Float[np.ndarray, "4 4"]  # Where it stands in the world [m]
    config: PlanConfig
    constraints: Constraints  # Without obstacles, which the cell has
    seed: int
    start: Float[np.ndarray, " n_arm"]  # Of the arm [rad or m]
    place: Place | None = None
    avoid: Sequence[Float[np.ndarray, "4 4"]] = ()

    @staticmethod
    def of(
        robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"], obstacles: Sequence[ObjectModel],
        config: PlanConfig, seed: int, start: JointsLike | None = None,
        place: Place | None = None, avoid: Sequence[Float[np.ndarray, "4 4"]] = (),
    ) -> Task:
        """The object, upright, in a workcell with all that is in the way; arguments are those of `plan`."""
        obj, T = upright(obj, T_world_object)
        if robot.table is None:
            robot = replace(robot, table=table_below(robot, obj, T))
        obstacles = [*obstacles, *around(robot, obj, config.constraints)]
        first = robot.home if start is None else robot.require_start(start)
        return Task(
            Workcell(robot, obstacles, obj, T), obj, T, config, replace(config.constraints, obstacles=None), seed, first, place,
            avoid)

    @property
    def robot(self) -> Robot:
        """Of the cell."""
        return self.cell.robot

    @property
    def height(self) -> float | None:
        """Of the table [m]."""
        return None if self.robot.table is None else self.robot.table.height

    @property
    def touches_table(self) -> bool:
        """Whether fingertips may touch the table: as in `Constraints.touch_table`."""
        if (asked := self.constraints.touch_table) is not None:
            return asked
        if self.height is None:
            return False
        return lies_low(self.obj, torch.tensor([*self.T[2, :3], self.height - self.T[2, 3]], dtype=torch.float32))

    @property
    def distance(self) -> float:
        """From the arm's base to the object's middle, along the ground [m]."""
        middle = self.T[:2, :3] @ self.obj.cloud.mean(0) + self.T[:2, 3]
        return float(np.linalg.norm(middle - self.robot.T_world_base[:2, 3]))

    def at_object(self, grasps: GraspBatch) -> GraspBatch:
        """Grasps in the world, in the object's frame."""
        return grasps.replace(T_object_wrist=torch.from_numpy(np.linalg.inv(self.T)).float() @ grasps.T_object_wrist)

    @cached_property
    def reach(self) -> Reachability:
        """Inverse kinematics, with its own draws."""
        config = self.config.reach
        if self.touches_table:
            config = replace(config, table_margin=min(config.table_margin, TIPS_DOWN), clearance=min(config.clearance, 0.0))
        return Reachability(self.cell, config, self.seed, self.places)

    @cached_property
    def places(self) -> Places | None:
        """Where the object may be put."""
        if self.place is None:
            return None
        return Placing(self.cell, self.place).places()

    @cached_property
    def rehearsal(self) -> Rehearsal | None:
        """The simulated lift, where lifts are rehearsed."""
        wanted = self.config.rehearsals > 0 and self.config.order == "score" and self.robot.table is not None
        return Rehearsal(self.cell, self.config.deviations, friction=self.config.friction) if wanted else None

    def seed_of(self, batch: int) -> int:
        """Seed of a batch, far from those of other plans."""
        return self.seed + 7919 * batch

    def least_confidence(self, batch: int) -> float | None:
        """Grasps of this batch that hold with less probability are not tried; None for what is usual."""
        given, last = self.config.least_confidence, batch == self.config.batches - 1
        if given is not None or self.rehearsal is None:
            return given
        return 0.0 if last and batch else self.config.doubtful

    def wanted(self, batch: int) -> Constraints:
        """What the grasps of this batch have to respect, apart from table and obstacles."""
        own, room = self.constraints, self.config.guess_clearance
        first, guessed = batch == 0 < self.config.batches - 1, self.obj.seen is not None
        if first and guessed and room and own.pregrasp_clearance is None:
            return replace(own, pregrasp_clearance=room)
        return own

    def check_start(self) -> None:
        """Refuse robot and object that are in each other's way from the start, and constraints that leave nothing to grasp."""
        if self.config.constraints != Constraints():
            self.config.constraints.require_fit(moved(self.obj, self.T))
        top = float((self.obj.cloud @ self.T[2, :3]).max() + self.T[2, 3])
        if self.height is not None and top <= self.height:
            raise PlanError(f"object '{self.obj.name}' ends at z = {top:.3f} m, below the table at {self.height:.3f} m; "
                            "give the object in the robot's world frame (camera=..., pose=...), or correct `table` in the "
                            "robot file")
        if self.distance > (longest := self.robot.longest_reach):
            raise PlanError(f"object '{self.obj.name}' stands {self.distance:.2f} m from the base, farther than the arm and "
                            f"hand are long ({longest:.2f} m); give its place in the robot's world frame [m]")
        self.cell.refuse_contacts(self.start, "at home" if np.array_equal(self.start, self.robot.home) else "at the start")
        _ = self.places  # refused before the work

    def advice(self, dropped: dict[str, int]) -> str:
        """What to change, by the reason for which most grasps were dropped."""
        reason = max(dropped, key=lambda r: dropped[r], default="")
        if not reason:
            return "there are no grasps to try; give some (grasps=...), or leave them out"
        if reason in (TURNED, SPARED, BESIDE, NARROW):
            return (f"most grasps are {reason}; relax max_tilt, contact_region, keep_out or pregrasp_clearance, or ask for "
                    "more grasps (num=...)")
        return (f"the object stands {self.distance:.2f} m from the base, and most grasps are {reason}; move the object, ask "
                "for more grasps (num=...), or for other palm directions (directions=...)")


def around(robot: Robot, obj: ObjectModel, constraints: Constraints) -> list[ObjectModel]:
    """What the constraints say stands around, as far as the robot gets with the object, as things in the world."""
    if (scene := constraints.obstacles) is None:
        return []
    reach = robot.full_reach + float(np.linalg.norm(np.ptp(obj.cloud, axis=0)))
    return scene_solid(scene, robot.T_world_base[:3, 3], reach)


def table_below(robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"]) -> Table:
    """What an object stands on where nothing else is known: a level square below it, which leaves room for the arm's base.

    Its height is that of the table in the object's cloud, if one was seen, else of the object's lowest point.
    """
    points = obj.cloud @ T_world_object[:3, :3].T + T_world_object[:3, 3]
    low, high = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
    middle = (low[:2] + high[:2]) / 2
    room = float(np.abs(middle - robot.T_world_base[:2, 3]).max()) - BASE_ROOM
    half = max(float((high[:2] - low[:2]).max()) / 2 + SURROUNDS, min(room, ASSUMED_EXTENT / 2))
    seen = height_below(obj, T_world_object)
    return Table(float(low[2]) if seen is None else seen, (float(middle[0]), float(middle[1])), (2 * half, 2 * half))
