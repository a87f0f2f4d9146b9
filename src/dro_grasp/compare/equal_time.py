"""Equal time: every method makes candidates for as long as the first one, and returns as many grasps, the best by score.

Time is the CPU time of this process, with one thread of PyTorch: other programs make it wait, but hardly work longer. What is
prepared once for a pair (distance field, contacts, collision scene) is not counted. Ours.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

from dro_grasp.compare.methods import Method
from dro_grasp.devices import one_thread
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.predict.finish import finish
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import ease

Maker = Callable[[int, int], GraspBatch]  # Makes a number of grasps with scores from a seed
SMALLEST_ROUND = 0.1  # A method goes on if this share of the candidates that it has made still fits into the time (ours)


@dataclass(frozen=True)
class Returned:
    """What a method returns."""

    grasps: GraspBatch  # The best by score, best first
    candidates: int  # Grasps made, of which these are the best
    seconds: float  # CPU time of all of them [s]


def equal_time(
    makers: Mapping[str, Maker], num: int, keep: int, seed: int, clock: Callable[[], float] = time.process_time
) -> dict[str, Returned]:
    """The best candidates of each method, all in the time that the first one takes for `num`.

    Args:
        makers: How each method makes candidates with scores; what they share is prepared at their first call.
        num: Candidates of the first method.
        keep: Grasps that each method returns, fewer if it has lost candidates.
        seed: The same seed gives the same candidates, but time decides how many.
        clock: Tells the time [s].
    """
    (first, make), *others = makers.items()
    with one_thread():
        make(keep, seed)
        begin = clock()
        grasps = make(num, seed)
        found = {first: Returned(_best(grasps, keep), num, clock() - begin)}
        for name, make in others:
            found[name] = best_within(found[first].seconds, make, keep, seed, clock)
    return found


def best_within(budget: float, make: Maker, keep: int, seed: int, clock: Callable[[], float]) -> Returned:
    """The best of as many candidates as fit into a time, by what one was measured to cost; of `keep` at least.

    Args:
        budget: Time to use [s].
        make: Makes candidates with scores.
        keep: Grasps to return.
        seed: Of the candidates.
        clock: Tells the time [s].
    """
    generator = torch.Generator().manual_seed(seed)

    def timed(num: int) -> tuple[GraspBatch, float]:
        begin = clock()
        grasps = make(num, int(torch.randint(2**31, (), generator=generator)))
        return grasps, clock() - begin

    _, cost = timed(keep)  # a rough measure, which also prepares what is shared; its time is not counted
    num, made, spent, pool = max(keep, int(budget * keep / cost)), 0, 0.0, []
    while num > SMALLEST_ROUND * made:
        grasps, seconds = timed(num)
        pool.append(grasps)
        made, spent = made + num, spent + seconds
        num = int((budget - spent) * made / spent)
    return Returned(_best(GraspBatch.concatenate(pool), keep), made, spent)


def finished_maker(problem: GraspProblem, method: Method, keep: int) -> Maker:
    """Candidates of a method, finished; of those that settle, `keep` at least."""
    config = method.predictor.config.finish

    def make(num: int, seed: int) -> GraspBatch:
        pool = finish(problem, method.propose(problem, num, seed), config, keep).pool
        return ease(problem, pool, config.ease, config.admission)

    return make


def _best(grasps: GraspBatch, keep: int) -> GraspBatch:
    return grasps[grasps.score.topk(min(keep, len(grasps))).indices]
