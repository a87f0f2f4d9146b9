"""How a motion is planned."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from dro_grasp.errors import OptionError
from dro_grasp.kinds import Checked
from dro_grasp.pipeline.constraints import Constraints
from dro_grasp.planning.candidates import Directions
from dro_grasp.planning.reachability import ReachConfig


@dataclass(frozen=True)
class PlanConfig(Checked):
    """How a motion is planned. Values without a source are ours."""

    num: int = 24
    """Grasps to choose from, in each of the batches."""
    top: int = 5
    """Reachable grasps of best score that are given to the planner at once. Source: paper, real-robot experiment."""
    directions: Directions = "all"
    """Palm directions: `paper`, from above to the right side, or `all` that a table leaves room for."""
    constraints: Constraints = field(default_factory=Constraints)
    """What grasps have to respect, in the world's frame; the scene to avoid, the arm too. The table is the robot's."""
    order: Literal["score", "random"] = "score"
    """Which reachable grasps are taken: the best by score, or any, as a control."""
    rounds: int = 3
    """How often the planner is asked, each time with the next `top` grasps."""
    rehearsals: int = 8
    """Grasps of each batch whose lift is simulated, where a table is known, on the object as it is known; 0 for none."""
    trusted_share: float = 0.5
    """Share of its rehearsals in which the best grasp that can be carried out should hold the object."""
    trusted_score: float = 1.0
    """Without rehearsals: log-odds of holding that it should have."""
    batches: int = 3
    """How often at most `num` grasps are made, while none of them is trusted, or none works."""
    best_seconds: float = 1.0
    """Longest time for a path to the best grasp alone, which is tried before all goals are given at once [s]."""
    planner_seconds: float = 3.0
    """Longest time for one path to several goals [s]."""
    closing_seconds: float = 1.0
    """Least time in which the hand closes [s]. Source: as in trials."""
    grip_seconds: float = 0.5
    """How long the hand presses before the arm lifts [s]."""
    reach: ReachConfig = field(default_factory=ReachConfig)
    """Approach and lift."""

    def __post_init__(self) -> None:
        """Refuse what cannot be done.

        Raises:
            OptionError: A number is not positive or not finite, or something is stated twice.
        """
        super().__post_init__()
        if self.constraints.table is not None:
            raise OptionError("the table is the robot's: state its height in the robot file, and not in constraints")
        if self.constraints.direction is not None and self.directions != "all":
            raise OptionError(f"both direction and directions '{self.directions}' say whence to grasp; leave out one of them")
        for name in ("num", "top", "rounds", "batches", "planner_seconds"):
            if not 0 < getattr(self, name) < math.inf:
                raise OptionError(f"{name} is {getattr(self, name)}; give a number above 0")
