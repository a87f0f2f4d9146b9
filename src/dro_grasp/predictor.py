"""The one-call face of the pipeline: a hand and an object in, ranked grasps out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import Stopwatch, require_device
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.models.checkpoints import load_weights
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import Direction, Proposal, ProposalConfig, check_temperature, propose
from dro_grasp.pipeline.stages import above_table, complete, optimise, refine, scored

LARGEST_CALL = 100_000
"""Most candidates of one call; more do not fit memory."""
Progress = Callable[[int, int], None]
"""Called with (candidates made so far, candidates wanted), by the network and then by the optimiser."""
Method = Literal["auto", "network", "optimise"]
"""Where candidates come from."""
TRUSTED_SCORE = 0.5
"""Log-odds of holding from which on a grasp needs no rival from the optimiser (ours)."""
OPTIMISED_PER_GRASP = 8
"""Candidates that the optimiser makes for each grasp below TRUSTED_SCORE (ours)."""


@dataclass(frozen=True)
class GraspRequest:
    """What is asked of a predictor."""

    num: int = 16
    """Grasps to return."""
    seed: int = 0
    """The same seed gives the same grasps."""
    direction: Direction | None = None
    """Palm direction in the object's frame; any by default."""
    table: float | None = None
    """Height of a plane in the object's frame [m]. Candidates whose hand goes below it, in the pregrasp or in the grasp, are
    dropped, and sampling continues."""
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
            OptionError: `num` or `candidates` is not positive, `direction` is zero, or another value is out of range.
        """
        if self.num < 1:
            raise OptionError(f"num is {self.num}; ask for at least one grasp (--num 16)")
        if self.candidates < 1:
            raise OptionError(f"candidates is {self.candidates}; propose at least one for each grasp")
        if self.num * self.candidates > LARGEST_CALL:
            raise OptionError(f"{self.num} grasps of {self.candidates} candidates each do not fit memory; predict at most "
                              f"{LARGEST_CALL} at once, with another --seed for more")
        if self.direction is not None and not 1e-9 <= math.hypot(*self.direction) < math.inf:
            raise OptionError(f"direction {self.direction} has no direction; give the palm direction in the object's frame, "
                              "for example --direction 0 0 -1 to grasp from above")
        check_temperature(self.temperature)
        if self.method not in get_args(Method):
            raise OptionError(f"method is '{self.method}'; choose {', '.join(get_args(Method))}")
        if self.table is not None and not math.isfinite(self.table):
            raise OptionError(f"table is {self.table}; give the height in metres, for example --table 0")


@dataclass(frozen=True)
class PredictorConfig(ProposalConfig):
    """How grasps are sampled and decoded."""

    table_rounds: int = 20
    """How often sampling is repeated when a table plane rejects candidates."""


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
    """Candidates made, those that a table rejected included."""
    seconds: dict[str, float]
    """Time by part: network, decode, optimise, refine, rank [s]."""

    @property
    def origin(self) -> list[str]:
        """Where each grasp comes from: `network` or `optimiser`."""
        return ["network" if maker.startswith("network") else "optimiser" for maker in self.grasps.provenance]


class GraspPredictor:
    """Predicts grasps of any object by any hand with one set of weights.

    Example:
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

    @property
    def weights_name(self) -> str:
        """Name of the weights."""
        return self.network.name

    def predict(self, hand: Hand, obj: ObjectModel, num: int = 16, seed: int = 0, **options: Any) -> GraspBatch:
        """Grasps with pregrasp, squeeze and score, the best score first.

        Args:
            hand: Any hand.
            obj: A mesh or a bare point cloud.
            num: Grasps to return.
            seed: The same seed gives the same grasps.
            options: Other fields of `GraspRequest`: direction, table, candidates, refine, temperature, method.

        Raises:
            OptionError: An argument is out of range, or too few grasps stay above the table.
        """
        problem = GraspProblem(hand, obj, self.device)
        return self.run(problem, GraspRequest(num, seed, **options)).grasps

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def run(self, problem: GraspProblem, request: GraspRequest, progress: Progress | None = None) -> Prediction:
        """Propose, refine and rank, and keep the best; results do not depend on batch sizes.

        Args:
            problem: Hand and object, on the predictor's device.
            request: What is asked for.
            progress: See `Progress`.

        Raises:
            OptionError: Too few grasps stay above the table, or near the direction.
        """
        _check_table(problem.obj, request)
        watch = Stopwatch("network", "decode", "optimise", "refine", "rank")
        pool = _Pool(problem, request, watch)
        if request.method != "optimise":
            self._ask_network(pool, progress)
        if count := pool.to_optimise():
            with watch("optimise"):
                grasps = optimise(problem, count, request.seed, request.direction, progress)
                hand = problem.thinned(self.network.config.n_hand).to("cpu")
                proposal = Proposal(grasps, hand.points(grasps.joints, grasps.T_object_wrist))
            pool.add(proposal)
        return pool.best()

    def _ask_network(self, pool: _Pool, progress: Progress | None) -> None:
        """Propose until the pool has the candidates that were asked for."""
        request = pool.request
        wanted, generator = request.num * request.candidates, torch.Generator().manual_seed(request.seed)
        config = self.config if request.temperature is None else replace(self.config, temperature=request.temperature)
        for _ in range(1 if request.table is None else config.table_rounds):
            pool.add(propose(
                pool.problem, self.network, wanted, generator, request.direction, config, pool.watch, progress), wanted)
            if len(pool) >= wanted:
                break


class _Pool:
    """Candidates of all sources, refined, scored and above the table, beside what was proposed."""

    def __init__(self, problem: GraspProblem, request: GraspRequest, watch: Stopwatch) -> None:
        self.problem, self.request, self.watch = problem, request, watch
        self.made = 0
        """Candidates made, those that the table rejected included."""
        self.proposals: list[Proposal] = []
        self.grasps: list[GraspBatch] = []

    def __len__(self) -> int:
        return sum(map(len, self.grasps))

    def add(self, proposal: Proposal, most: int | None = None) -> None:
        """Take in candidates, until there are `most`."""
        problem, request = self.problem, self.request
        self.made += len(proposal.grasps)
        with self.watch("refine"):
            grasps = refine(problem, proposal.grasps) if request.refine else complete(problem, proposal.grasps)
        keep = torch.ones(len(grasps), dtype=torch.bool)
        if request.table is not None:
            keep = above_table(problem, grasps, request.table)
        kept = keep.nonzero()[:, 0][: None if most is None else most - len(self)]
        with self.watch("rank"):
            self.grasps.append(scored(problem, grasps[kept]))
        self.proposals.append(proposal[kept])

    def to_optimise(self) -> int:
        """How many candidates synthesis is asked for: some for each grasp that is missing or that the score does not trust."""
        if self.request.method == "network":
            return 0
        scores = torch.cat([torch.zeros(0), *(g.score for g in self.grasps)]).sort(descending=True).values
        trusted = int((scores[: self.request.num] > TRUSTED_SCORE).sum())
        return OPTIMISED_PER_GRASP * (self.request.num - trusted)

    def best(self) -> Prediction:
        """The best grasps by score.

        Raises:
            OptionError: There are fewer than were asked for.
        """
        if len(self) < self.request.num:
            raise _too_few(self.problem.obj, self.request, len(self), self.made)
        grasps = GraspBatch.concatenate(self.grasps)
        best = (-grasps.score).argsort(stable=True)[: self.request.num]
        chosen = Proposal.concatenate(self.proposals)[best]
        return Prediction(grasps[best], complete(self.problem, chosen.grasps), chosen.points, self.made, self.watch.seconds)


def _check_table(obj: ObjectModel, request: GraspRequest) -> None:
    """Refuse a table above the object."""
    top = float(obj.cloud[:, 2].max())
    if request.table is not None and not request.table < top:
        raise OptionError(f"a table at {request.table} m leaves nothing of the object, which ends at z = {top:.3f} m; give "
                          "--table in metres in the frame of the grasps")


def _too_few(obj: ObjectModel, request: GraspRequest, found: int, made: int) -> OptionError:
    low, high = float(obj.cloud[:, 2].min()), float(obj.cloud[:, 2].max())
    if request.table is None:
        return OptionError(f"the optimiser kept only {found} grasps on object '{obj.name}', {request.num} were asked for; "
                           "ask for another --direction or none, or for --method auto")
    return OptionError(
        f"only {found} of {made} grasps keep the hand above table {request.table} m, {request.num} were asked for; lower "
        f"--table (the object spans z = {low:.3f} to {high:.3f} m), or ask for a --direction from above (0 0 -1)")
