"""Candidates of all sources in one pool: refined, scored, settled, and the best of them chosen by one score."""

from __future__ import annotations

from collections import Counter

import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.pipeline.admission import TURNED, permitted, reasons_against
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import Proposal
from dro_grasp.pipeline.settling import best_settled, can_settle
from dro_grasp.pipeline.shortage import shortage_in_words
from dro_grasp.pipeline.stages import complete, eased, refine, scored
from dro_grasp.stopwatch import Stopwatch


class CandidatePool:
    """Candidates as the constraints want them, beside what was proposed."""

    def __init__(self, problem: GraspProblem, num: int, refined: bool, watch: Stopwatch) -> None:
        """An empty pool.

        Args:
            problem: Hand, object and constraints.
            num: Grasps that are wanted of it.
            refined: Whether candidates are refined and settled.
            watch: Counts the seconds of `refine`, `rank` and `settle`.
        """
        self.problem, self.num, self.refined, self.watch = problem, num, refined, watch
        self.made = 0
        """Candidates made, those that constraints rejected included."""
        self.dropped: Counter[str] = Counter()
        """Those that constraints rejected, by reason."""
        self._proposals: list[Proposal] = []
        self._grasps: list[GraspBatch] = []
        self._settled = 0
        """The first so many parts of the two lists are settled."""

    def __len__(self) -> int:
        return sum(map(len, self._grasps))

    def add(self, proposal: Proposal, most: int | None = None, turned: int = 0) -> None:
        """Take in candidates, until there are `most`; `turned` others turned away from the direction as they were made."""
        problem = self.problem
        self.made += len(proposal.grasps) + turned
        self.dropped[TURNED] += turned
        with self.watch("refine"):
            grasps = refine(problem, proposal.grasps) if self.refined else complete(problem, proposal.grasps)
        allowed = permitted(problem, grasps)
        self.dropped += reasons_against(problem, grasps[~allowed])
        kept = allowed.nonzero()[:, 0][: None if most is None else most - len(self)]
        with self.watch("rank"):
            self._grasps.append(scored(problem, grasps[kept]))
        self._proposals.append(proposal[kept])

    def settle(self) -> None:
        """Settle the better half of what is not, and leave out the rest; without the hand's description, everything stays."""
        fresh = slice(self._settled, None)
        if self.refined and can_settle(self.problem) and self._grasps[fresh]:
            with self.watch("settle"):
                best, grasps = best_settled(self.problem, GraspBatch.concatenate(self._grasps[fresh]), self.num)
            self._grasps[fresh], self._proposals[fresh] = [grasps], [Proposal.concatenate(self._proposals[fresh])[best]]
        self._settled = len(self._grasps)

    def lacking(self, least_score: float) -> int:
        """How many of the grasps that are wanted are missing, or score no better than `least_score`."""
        scores = torch.cat([torch.zeros(0), *(g.score for g in self._grasps)])
        return max(0, self.num - int((scores > least_score).sum()))

    def shortage(self, one_source: bool) -> str | None:
        """Why there are fewer grasps than are wanted, and what to do; None if there are as many.

        Args:
            one_source: Whether network or optimiser alone made the candidates.
        """
        if len(self) >= self.num:
            return None
        return shortage_in_words(self.problem, self.num, len(self), self.made, self.dropped, one_source)

    def best(self) -> tuple[GraspBatch, Proposal]:
        """The best grasps by score, as many as are wanted if there are, and what they were proposed as."""
        grasps = GraspBatch.concatenate(self._grasps)
        best = (-grasps.score).argsort(stable=True)[: self.num]
        given = eased(self.problem, grasps[best]) if self.refined else grasps[best]
        return given, Proposal.concatenate(self._proposals)[best]
