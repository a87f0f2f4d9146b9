"""Yield: where the candidates of a shard, a pair or a whole data set end up, in numbers that add up."""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Yield:
    """Counts; every candidate is in exactly one of `ranked_out`, `deep`, `moved`, `failures`, `duplicates`, `valid`."""

    candidates: int = 0
    """Grasps synthesised."""
    ranked_out: int = 0
    """Without a trial because their energy was too high."""
    deep: int = 0
    """Without a trial because they penetrate the object too far."""
    moved: int = 0
    """Without a trial because closing moved the object too far."""
    failures: dict[str, int] = field(default_factory=dict)
    """Failed trials by reason."""
    duplicates: int = 0
    """Passed, but near-duplicates of an earlier grasp."""
    valid: int = 0
    """Passed and stored."""
    cpu_seconds: float = 0.0
    """CPU time without loading hand and object [s]."""
    preparation_seconds: float = 0.0
    """CPU time of loading hand and object, with convex parts and grid where they are not cached [s]."""

    @property
    def evaluated(self) -> int:
        """Number of trials."""
        return sum(self.failures.values()) + self.duplicates + self.valid

    @property
    def per_cpu_hour(self) -> float:
        """Valid grasps per hour of one core; 0 without any time."""
        return 3600 * self.valid / self.cpu_seconds if self.cpu_seconds > 0 else 0.0

    def __add__(self, other: Yield) -> Yield:
        names = [f.name for f in dataclasses.fields(self) if f.name != "failures"]
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return Yield(**sums, failures=dict(Counter(self.failures) + Counter(other.failures)))

    def main_obstacle(self) -> str:
        """Where most of the tested candidates were lost, in words."""
        lost = self.failures | {
            "hand too deep in the object": self.deep, "closing moves the object too far": self.moved,
        }
        reason = max(lost, key=lambda name: lost[name], default="")
        share = lost[reason] / max(1, self.evaluated + self.deep + self.moved) if reason else 0.0
        return f"{reason} ({share:.0%} of the tested candidates)" if share else "no candidate was tested"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Yield:
        """The inverse of `to_dict`; entries of other versions are ignored."""
        known = {f.name for f in dataclasses.fields(Yield)}
        return Yield(**{name: value for name, value in values.items() if name in known})
