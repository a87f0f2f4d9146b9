"""Picks of things from a table, and the memory of those that failed, as far as a camera confirms it. Ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

SAME = 0.04  # Farthest that a thing may be from where a pick failed to count as the same [m] (ours)
THERE = 0.01  # Distance within which a point is seen again [m] (ours)


@dataclass(frozen=True)
class Pick:
    """What became of one pick."""

    place: tuple[float, float]
    """Where the thing stood [m]."""
    stage: str
    """Where it ended: see, plan, lift, carry, look, or done."""
    reason: str = ""
    """Why it failed."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """A pick, with the thing as it was seen before."""

    pick: Pick
    cloud: Float[np.ndarray, "n 3"] | None = None  # In the world [m]; None where it was not seen
    T_world_wrist: Float[np.ndarray, "4 4"] | None = None  # Of its grasp [m], as long as the thing is where it was

    def stays(self, points: Float[np.ndarray, "n 3"]) -> bool:
        """Whether most of the thing is still among these points in the world [m]."""
        if self.cloud is None or not len(points):
            return False
        return float((KDTree(points).query(self.cloud)[0] < THERE).mean()) > 0.5


@dataclass
class Memory:
    """Where picks have failed, as far as the camera confirms it."""

    tries: int
    failed: list[Outcome] = field(default_factory=list)  # The place of each pick is where its thing is now
    gone: list[Pick] = field(default_factory=list)  # Failed, and the thing is out of sight
    before: Sequence[tuple[float, float]] = ()  # Where things stood when the camera looked last

    def left(self, places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        """Where things stand that are not given up, what has failed least first."""
        self.before = places
        return sorted((place for place in places if len(self._near(place)) < self.tries),
                      key=lambda place: len(self._near(place)))  # the rest of the order is that of places

    def note(self, made: Outcome) -> None:
        """A pick has failed, and nothing has moved."""
        self.failed.append(made)

    def wrists(self, place: tuple[float, float]) -> list[Float[np.ndarray, "4 4"]]:
        """Those of grasps that have failed on what stands at a place, and stands as it did then."""
        return [made.T_world_wrist for made in self._near(place) if made.T_world_wrist is not None]

    def see(
        self, made: Outcome, points: Float[np.ndarray, "n 3"], places: Sequence[tuple[float, float]]
    ) -> Pick:
        """What has become of a pick, as the camera sees it now, in the world; a thing that was lost elsewhere is the same."""
        pick, stays = made.pick, made.stays(points)
        if pick.stage == "done" and not stays:
            self.failed = [other for other in self.failed if not _alike(other.pick.place, pick.place)]
            return pick
        if pick.stage == "done":
            pick = replace(pick, stage="look", reason="it still stands there, as the camera sees it")
        new = [place for place in places if not any(_alike(place, old) for old in self.before)]
        if stays or any(_alike(place, pick.place) for place in places):
            self.failed.append(replace(made, pick=pick, T_world_wrist=made.T_world_wrist if stays else None))
        elif new:
            there = min(new, key=lambda place: math.dist(place, pick.place))
            self.failed.append(replace(made, pick=pick))
            self.failed = [replace(other, pick=replace(other.pick, place=there), T_world_wrist=None)
                           if _alike(other.pick.place, pick.place) else other for other in self.failed]
        else:
            pick = replace(pick, reason=f"{pick.reason}; the camera sees it nowhere")
            self.gone.append(pick)
        return pick

    def given_up(self, places: Sequence[tuple[float, float]]) -> tuple[Pick, ...]:
        """What is left on the table, and why; and what is out of sight."""
        found = list[Pick]()
        for place in places:
            own = [made.pick for made in self._near(place)]
            reasons = "; ".join(dict.fromkeys(pick.reason for pick in own))
            told = f"{'given up' if len(own) >= self.tries else 'left'} after {len(own)} pick{'s' * (len(own) > 1)}: {reasons}"
            found.append(Pick(place, own[-1].stage, told) if own else Pick(place, "see", "not tried"))
        return (*found, *self.gone)

    def _near(self, place: tuple[float, float]) -> list[Outcome]:
        return [made for made in self.failed if _alike(made.pick.place, place)]


def _alike(first: tuple[float, float], second: tuple[float, float]) -> bool:
    return math.dist(first, second) < SAME
