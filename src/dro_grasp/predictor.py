"""The one-call face of the pipeline: a hand and an object in, ranked grasps out."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import require_device
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import with_own_files
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.models.checkpoints import load_weights
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.options import by_owner
from dro_grasp.pipeline.constraints import Constraints
from dro_grasp.pipeline.pool import CandidatePool
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import Proposal, ProposalConfig, check_temperature, propose
from dro_grasp.pipeline.stages import complete, optimise
from dro_grasp.stopwatch import Stopwatch

LARGEST_CALL = 100_000
"""Most candidates of one call; more do not fit memory."""
Progress = Callable[[int, int], None]
"""Called with (candidates made so far, candidates wanted), by the network and then by the optimiser."""
Method = Literal["auto", "network", "optimise"]
"""Where candidates come from."""
TRUSTED_SCORES = (1.5, 1.0, 1.0, 1.0)
"""Log-odds of holding from which on a grasp needs no rival from the optimiser, in each round that it is asked (ours)."""
OPTIMISED_PER_GRASP = 8
"""Candidates that the optimiser makes in a round for each grasp that needs rivals (ours)."""
TRUSTED_IN_SURROUNDINGS = (1.5, 0.5)
"""The scores where a descent also watches surroundings, which takes twice as long (ours)."""
OPTIMISED_IN_SURROUNDINGS = 4
"""The candidates there; as many of the grasps hold (ours)."""


@dataclass(frozen=True)
class GraspRequest(Checked):
    """What is asked of a predictor."""

    num: int = 16
    """Grasps to return."""
    seed: int = 0
    """The same seed gives the same grasps."""
    candidates: int = 4
    """Candidates proposed for each grasp returned; the best by score are returned."""
    refine: bool = True
    """Refine the candidates on the object's geometry before they are ranked."""
    temperature: float | None = None
    """Spread of z; None takes the predictor's."""
    method: Method = "auto"
    """Where candidates come from: the network, the optimiser that also makes training data, or `auto`: the network, and the
    optimiser for as many grasps as the score does not trust the network with."""

    def __post_init__(self) -> None:
        """Refuse what cannot be done, before any work.

        Raises:
            OptionError: `num` or `candidates` is not positive, or another value is out of range.
        """
        super().__post_init__()
        if self.num < 1:
            raise OptionError(f"num is {self.num}; ask for at least one grasp (--num 16)")
        if self.candidates < 1:
            raise OptionError(f"candidates is {self.candidates}; propose at least one for each grasp")
        if self.num * self.candidates > LARGEST_CALL:
            raise OptionError(f"{self.num} grasps of {self.candidates} candidates each do not fit memory; predict at most "
                              f"{LARGEST_CALL} at once, with another --seed for more")
        if not 0 <= self.seed < 2**63:
            raise OptionError(f"seed is {self.seed}; give an integer from 0 to 2^63 - 1")
        check_temperature(self.temperature)
        check_method(self.method)


def check_method(method: str) -> None:
    """Refuse a method that does not exist.

    Raises:
        OptionError: As said.
    """
    if method not in get_args(Method):
        raise OptionError(f"method is '{method}'; choose {', '.join(get_args(Method))}")


@dataclass(frozen=True)
class PredictorConfig(ProposalConfig):
    """How grasps are sampled and decoded."""

    rounds: int = 4
    """How often at most the network is asked again when constraints reject candidates."""
    least_yield: float = 0.2
    """Share of the candidates up to which it is not asked again."""
    reserve: float = 1.5
    """How many times as many candidates it is asked for again as the share that was rejected suggests."""


@dataclass(frozen=True)
class Prediction:
    """Grasps, and how they were made."""

    grasps: GraspBatch
    """Best score first."""
    proposed: GraspBatch
    """The same grasps as network or optimiser proposed them, before refinement."""
    points: Float[Tensor, "n n_points 3"]
    """Hand points of the proposed grasps [m]; the network's are multilaterated, and the solved hand differs from them."""
    candidates: int
    """Candidates made, those that constraints rejected included."""
    dropped: dict[str, int]
    """Candidates that constraints rejected, by reason."""
    seconds: dict[str, float]
    """Time by part: network, choose, decode, optimise, refine, settle, rank [s]."""
    shortage: str | None = None
    """Why there are fewer grasps than were asked for, and what to do; None if there are as many."""

    def __repr__(self) -> str:
        return f"Prediction({self.grasps!r}, best of {self.candidates} candidates, {sum(self.seconds.values()):.1f} s)"

    @property
    def origin(self) -> list[str]:
        """Where each grasp comes from: `network` or `optimiser`."""
        return ["network" if maker.startswith("network") else "optimiser" for maker in self.grasps.provenance]


class GraspPredictor:
    """Predicts grasps of any object by any hand with one set of weights.

    Examples:
        >>> import dro_grasp as dro
        >>> hand, obj = dro.load_hand("allegro"), dro.load_object("mug")
        >>> grasps = dro.GraspPredictor().predict(hand, obj, num=16)
    """

    def __init__(self, weights: str | None = None, device: str = "cpu", config: PredictorConfig | None = None) -> None:
        """Load the weights once.

        Args:
            weights: Name of shipped weights or path of a weights file; the default weights if omitted.
            device: Where the network and the grasp energy run.
            config: How grasps are sampled and decoded.

        Raises:
            WeightsError: There are no such weights.
            OptionError: This machine has no such device.
        """
        require_device(device)
        self.device, self.config = device, config or PredictorConfig()
        self.network: DistanceNetwork = load_weights(weights).to(device).eval()

    def __repr__(self) -> str:
        return f"GraspPredictor(weights '{self.weights_name}', device '{self.device}')"

    @property
    def weights_name(self) -> str:
        """Name of the weights."""
        return self.network.name

    def predict(
        self, hand: Hand, obj: ObjectModel, num: int = 16, seed: int = 0, constraints: Constraints | None = None, **options: Any
    ) -> GraspBatch:
        """Grasps with pregrasp, squeeze and score, the best score first; fewer, with a warning, if no more can be found.

        Args:
            hand: Any hand.
            obj: A mesh or a bare point cloud.
            num: Grasps to return.
            seed: The same seed gives the same grasps.
            constraints: What grasps have to respect.
            options: Fields of `Constraints` (direction, table, ...) and of `GraspRequest` (candidates, refine, method, ...).

        Raises:
            ObjectError: The scene to avoid contains the object.
            OptionError: An argument is out of range or unknown, the table is above the object, or no grasp was found.
        """
        wanted, asked = by_owner(options, Constraints, GraspRequest)
        problem = GraspProblem(hand, obj, self.device, replace(constraints or Constraints(), **wanted))
        if (doubt := problem.constraints.doubt(obj)) is not None:
            warnings.warn(doubt, stacklevel=2)
        made = self.run(problem, GraspRequest(num, seed, **asked))
        if made.shortage is not None:
            warnings.warn(made.shortage, stacklevel=2)
        return made.grasps

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def run(self, problem: GraspProblem, request: GraspRequest, progress: Progress | None = None) -> Prediction:
        """Propose, refine and rank, and keep the best; results do not depend on batch sizes.

        Args:
            problem: Hand, object and constraints, on the predictor's device.
            request: What is asked for.
            progress: See `Progress`.

        Raises:
            OptionError: No grasp was found.
        """
        watch = Stopwatch("network", "choose", "decode", "optimise", "refine", "settle", "rank")
        pool = CandidatePool(problem, request.num, request.refine, watch)
        if request.method != "optimise":
            self._ask_network(pool, request, progress)
        if request.method != "network":
            self._ask_optimiser(pool, request.seed, progress)
        shortage = pool.shortage(one_source=request.method != "auto")
        if not len(pool):
            raise OptionError(str(shortage))
        grasps, chosen = pool.best()
        given, proposed = (g.with_asked(request.num) for g in (
            with_own_files(grasps, problem.hand, problem.obj), complete(problem, chosen.grasps)))
        return Prediction(given, proposed, chosen.points, pool.made, dict(pool.dropped), watch.seconds, shortage)

    def _ask_network(self, pool: CandidatePool, request: GraspRequest, progress: Progress | None) -> None:
        """Propose until the pool has the candidates that were asked for."""
        wanted, generator = request.num * request.candidates, torch.Generator().manual_seed(request.seed)
        config = self.config if request.temperature is None else replace(self.config, temperature=request.temperature)
        count = wanted
        for _ in range(config.rounds):
            pool.add(propose(pool.problem, self.network, count, generator, config, pool.watch, progress), wanted)
            if len(pool) >= wanted or len(pool) <= config.least_yield * pool.made:
                break
            lacking = (wanted - len(pool)) * pool.made / len(pool)
            count = min(wanted, math.ceil(config.reserve * lacking))
        pool.settle()

    def _ask_optimiser(self, pool: CandidatePool, seed: int, progress: Progress | None) -> None:
        """Rivals for each grasp that the score does not trust, again and again for those that it still does not."""
        problem = pool.problem
        free = problem.surroundings is None
        each = OPTIMISED_PER_GRASP if free else OPTIMISED_IN_SURROUNDINGS
        hand = problem.thinned(self.network.config.n_hand).to("cpu")
        levels = TRUSTED_SCORES if free else TRUSTED_IN_SURROUNDINGS
        # Drawn, not counted up from the request's seed: neighbouring seeds must not share rounds.
        seeds = np.random.default_rng(seed).integers(2**63, size=len(levels)).tolist()
        for one, least_score in zip(seeds, levels, strict=True):
            if not (count := each * pool.lacking(least_score)):
                break
            with pool.watch("optimise"):
                grasps, turned = optimise(problem, count, one, progress)
            pool.add(Proposal(grasps, hand.points(grasps.joints, grasps.T_object_wrist)), turned=turned)
            pool.settle()
