"""What every method that makes grasps looks like to the benchmark."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.settling import best_settled, can_settle
from dro_grasp.pipeline.stages import eased, refine, scored
from dro_grasp.stopwatch import Stopwatch


@dataclass(frozen=True)
class Made:
    """What a method returns."""

    grasps: GraspBatch
    candidates: int
    """Grasps made, of which these were chosen."""


class Method(ABC):
    """Makes grasps of any object by any hand; whatever it has to load is loaded once."""

    name: str
    """Its name in tables."""

    @abstractmethod
    def make(self, problem: GraspProblem, num: int, seed: int) -> GraspBatch:
        """Grasps as the method alone makes them: not refined, ranked or settled by what it shares with others.

        Args:
            problem: Hand and object.
            num: How many; it may return fewer.
            seed: The same seed gives the same grasps.
        """

    def timed(self, problem: GraspProblem, num: int, seed: int) -> tuple[GraspBatch, dict[str, float]]:
        """Grasps as `make` has them, and the time that their parts took [s]."""
        watch = Stopwatch()
        with watch("make"):
            grasps = self.make(problem, num, seed)
        return grasps, watch.seconds

    def best(self, problem: GraspProblem, num: int, seed: int) -> Made:
        """Grasps as the method returns them to a user; as it makes them, unless it chooses."""
        grasps = self.make(problem, num, seed)
        return Made(grasps, len(grasps))

    def knows(self, hand: Hand) -> bool:
        """Whether it makes grasps of this hand at all."""
        return True

    def asked(self, obj: ObjectModel, num: int) -> int:
        """How many grasps of an object it can be asked for, of `num`; what it does not return of them are failures."""
        return num

    def predict(self, hand: Hand, obj: ObjectModel, num: int = 16, seed: int = 0) -> GraspBatch:
        """Grasps as `GraspPredictor.predict` returns them: at most `num`, the same for the same seed."""
        return self.best(GraspProblem(hand, obj), num, seed).grasps.with_asked(self.asked(obj, num))


def finished(problem: GraspProblem, grasps: GraspBatch, keep: int) -> GraspBatch:
    """Refined and scored grasps, the better half of them settled, `keep` at least: what any candidates can be made into."""
    grasps = scored(problem, refine(problem, grasps))
    return eased(problem, best_settled(problem, grasps, keep)[1] if can_settle(problem) else grasps)
