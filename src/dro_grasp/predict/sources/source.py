"""What every source of grasps looks like: it proposes candidates for a problem, and leaves all that follows to `finish`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import Stopwatch
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem

Progress = Callable[[int, int], None]  # Called with (candidates made so far, candidates wanted)
AUTO = "auto"  # The rule: the network proposes, and the optimiser adds rivals for the grasps that the score does not trust
POINTS = 160  # Hand points that are kept beside a candidate whose source states none, as many as the shipped weights see (ours)


@dataclass(frozen=True)
class Candidates:
    """Grasps as a source proposes them."""

    grasps: GraspBatch
    """Grasps, on the CPU. Pregrasp and squeeze may be unknown; scores are ignored."""
    points: Float[Tensor, "n n_points 3"]
    """Hand points of each candidate, on the CPU [m]. The network's are multilaterated; the solved hand differs from them."""
    origin: tuple[str, ...] = ()
    """Name of the source of each candidate."""
    turned: int = 0
    """How many others the source dropped because they turned away from the palm direction."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time by part of the source [s]."""
    exact: bool = False
    """Whether their fingers are where they are meant to be, so that refinement would only move them."""

    @staticmethod
    def of(problem: GraspProblem, grasps: GraspBatch, n_points: int = POINTS) -> Candidates:
        """Grasps beside the points of their hand.

        Raises:
            GraspFileError: They are of another hand.
        """
        grasps.require_hand(problem.hand)
        hand = problem.hand if n_points >= problem.hand.n_points else problem.thinned(n_points).to("cpu")
        return Candidates(grasps, hand.points(grasps.joints, grasps.T_object_wrist))

    def __len__(self) -> int:
        return len(self.grasps)

    def __getitem__(self, rows: slice | Int[Tensor, " k"] | Bool[Tensor, " n"]) -> Candidates:
        """Some of the candidates."""
        chosen = torch.arange(len(self))[rows].tolist()
        return replace(self, grasps=self.grasps[rows], points=self.points[rows],
                       origin=tuple(self.origin[i] for i in chosen) if self.origin else ())

    def beside(self, others: Candidates) -> Candidates:
        """Those that are not among the others: a source that has no more, as a file, proposes the same grasp again."""
        known = {row.numpy().tobytes() for row in others._rows}
        return self[torch.tensor([row.numpy().tobytes() not in known for row in self._rows], dtype=torch.bool)]

    @property
    def _rows(self) -> Float[Tensor, "n k"]:
        """Pose and joints of each."""
        return torch.cat([self.grasps.T_object_wrist.flatten(1), self.grasps.joints], 1)

    @staticmethod
    def concatenate(parts: Sequence[Candidates]) -> Candidates:
        """The candidates of all parts, one after the other, and the time of all."""
        seconds: dict[str, float] = {}
        for part in parts:
            seconds |= {name: seconds.get(name, 0.0) + spent for name, spent in part.seconds.items()}
        return Candidates(
            GraspBatch.concatenate([p.grasps for p in parts]), torch.cat([p.points for p in parts]),
            tuple(name for p in parts for name in p.origin), sum(p.turned for p in parts), seconds)


class Asked(NamedTuple):
    """What a source is asked for: of a problem so many candidates, with this seed."""

    problem: GraspProblem
    num: int
    seed: int


class Source(ABC):
    """Proposes grasps of any object by any hand; whatever it has to load is loaded once."""

    name: str
    """Its name in options, tables and files."""

    @abstractmethod
    def propose(
        self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None
    ) -> Candidates | GraspBatch:
        """Candidates, neither refined nor ranked.

        Args:
            problem: Hand, object, and constraints, which `finish` enforces where a source does not know them.
            num: How many; a source may propose fewer.
            seed: The same seed gives the same candidates.
            progress: See `Progress`.
        """

    def propose_all(
        self, asked: Sequence[Asked], progress: Progress | None = None
    ) -> Sequence[Candidates | GraspBatch]:
        """Candidates of several objects by one hand; those of each are as if it were asked for alone."""
        return [self.propose(*each, progress) for each in asked]

    def knows(self, hand: Hand) -> bool:
        """Whether it proposes grasps of this hand at all."""
        return True

    def asked(self, obj: ObjectModel, num: int) -> int:
        """How many grasps of an object it can be asked for, of `num`; what it does not propose of them are failures."""
        return num


def ask(
    source: Source, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None, n_points: int = POINTS
) -> Candidates:
    """Candidates of a source, each with its points, its origin and the time that it took.

    Args:
        source: What proposes.
        problem: See `Source.propose`, as `num`, `seed` and `progress`.
        n_points: Hand points to keep where the source states none.
    """
    return ask_all(source, [Asked(problem, num, seed)], progress, n_points)[0]


def ask_all(
    source: Source, asked: Sequence[Asked], progress: Progress | None = None, n_points: int = POINTS
) -> list[Candidates]:
    """The same for several problems with one hand, together where the source can; each takes an equal share of the time."""
    watch, found = Stopwatch(), []
    with watch(source.name):
        proposed = [source.propose(*asked[0], progress)] if len(asked) == 1 else source.propose_all(asked, progress)
    seconds = {name: spent / len(asked) for name, spent in watch.seconds.items()}
    for each, made in zip(asked, proposed, strict=True):
        own = Candidates.of(each.problem, made, n_points) if isinstance(made, GraspBatch) else made
        found.append(replace(own, origin=(source.name,) * len(own), seconds=own.seconds or seconds))
    return found
