"""The one-call face of the pipeline: a hand and an object in, ranked grasps out."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import require_device
from dro_grasp.errors import NoGraspError, OptionError
from dro_grasp.geometry.distance_field import Ball
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import with_own_files
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import FORMER_CONSTRAINTS, renamed
from dro_grasp.network.checkpoints import load_weights
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.objects.scenery import Scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.starts import Direction
from dro_grasp.predict.config import AUTO, GraspRequest, PredictorConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import FinishConfig, Finished, finish
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.shortage import shortage_in_words
from dro_grasp.predict.sources.network import NetworkSource
from dro_grasp.predict.sources.optimiser import OptimiserSource
from dro_grasp.predict.sources.registry import source_or_name
from dro_grasp.predict.sources.source import Progress, Source, ask
from dro_grasp.predict.sources.variation import VariationSource
from dro_grasp.predict.stages import complete

PARTS = ("network", "choose", "decode", "optimiser", "refine", "settle", "rank", "weigh", "ease")
"""Parts of a prediction whose seconds are always told."""


@dataclass(frozen=True)
class Prediction:
    """Grasps, and how they were made."""

    grasps: GraspBatch
    """Best score first."""
    proposed: GraspBatch
    """The same grasps as their source proposed them, before refinement."""
    points: Float[Tensor, "n n_points 3"]
    """Hand points of the proposed grasps [m]; the network's are multilaterated, and the solved hand differs from them."""
    origin: list[str]
    """Name of the source of each grasp."""
    candidates: int
    """Candidates made, those that constraints rejected included."""
    dropped: dict[str, int]
    """Candidates that constraints rejected, by reason."""
    seconds: dict[str, float]
    """Time by part: PARTS, and the name of any other source [s]."""
    shortage: str | None = None
    """Why there are fewer grasps than were asked for, and what to do; None if there are as many."""

    def __repr__(self) -> str:
        return f"Prediction({self.grasps!r}, best of {self.candidates} candidates, {sum(self.seconds.values()):.1f} s)"


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
            config: Everything that decides which grasps are returned.

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

    @renamed(**FORMER_CONSTRAINTS)
    def predict(
        self, hand: Hand, obj: ObjectModel, num: int = 16, seed: int = 0, constraints: Constraints | None = None, *,
        direction: Direction | None = None, max_tilt: float | None = None, table: float | None = None,
        obstacles: Scene | None = None, contact_region: tuple[Ball, ...] = (), keep_out: tuple[Ball, ...] = (),
        pregrasp_clearance: float | None = None, touch_table: bool | None = None, margin: float | None = None,
        max_force: float | None = None,
        candidates: int = 4, refine: bool = True, temperature: float | None = None, source: str | Source = AUTO,
        least_confidence: float | None = None,
    ) -> GraspBatch:
        """Grasps with pregrasp, squeeze and score, the best score first; fewer, with a warning, if no more can be found.

        Args:
            hand: Any hand.
            obj: A mesh or a bare point cloud.
            num: Grasps to return.
            seed: The same seed gives the same grasps.
            constraints: What grasps have to respect, in the object's frame. The keywords from `direction` to
                `max_force` replace its fields.
            direction: Palm direction; (0, 0, -1) grasps from above.
            max_tilt: Largest angle between the palm direction and `direction` [rad].
            table: Height of a table [m]; the hand stays above it.
            obstacles: What else the hand stays clear of; see `load_scene`.
            contact_region: Balls (x, y, z, radius) in which the hand may touch the object [m].
            keep_out: Balls (x, y, z, radius) that the hand stays out of [m].
            pregrasp_clearance: Least distance in pregrasp between the object and every link that closes [m].
            touch_table: Whether fingertips may touch the table; None lets them beside what lies flat.
            margin: Multiple of the object's weight that the squeeze holds whichever way gravity pulls.
            max_force: Largest normal force of a contact at the squeeze [N].
            candidates: Candidates for each grasp; the best by score are returned.
            refine: Refine and settle the candidates before they are ranked.
            temperature: Spread of z: 0 for the likeliest grasps, 1 for the diversity of the training grasps; None takes the
                predictor's.
            source: What proposes: `auto`, `network`, `optimiser`, another name that `make_source` knows, or a source.
            least_confidence: Grasps that hold with less probability are not returned: 0 returns all; None takes the
                predictor's.

        Raises:
            ObjectError: The obstacles contain the object.
            NoGraspError: No grasp was found.
            OptionError: An argument is out of range, or the table is above the object.
        """
        given = {"direction": direction, "max_tilt": max_tilt, "table": table, "obstacles": obstacles,
                 "contact_region": contact_region, "keep_out": keep_out, "pregrasp_clearance": pregrasp_clearance,
                 "touch_table": touch_table, "margin": margin, "max_force": max_force}
        wanted = replace(constraints or Constraints(), **{name: x for name, x in given.items() if x is not None and x != ()})
        problem = GraspProblem(hand, obj, self.device, wanted)
        if (warning := problem.constraints.warning(obj)) is not None:
            warnings.warn(warning, stacklevel=2)
        made = self.run(problem, GraspRequest(num, seed, candidates, refine, temperature, source, least_confidence))
        if made.shortage is not None:
            warnings.warn(made.shortage, stacklevel=2)
        return made.grasps

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def run(self, problem: GraspProblem, request: GraspRequest, progress: Progress | None = None) -> Prediction:
        """Ask the sources, finish their candidates, and keep the best; results do not depend on batch sizes.

        Args:
            problem: Hand, object and constraints, on the predictor's device.
            request: What is asked for.
            progress: See `Progress`.

        Raises:
            NoGraspError: No grasp was found.
            OptionError: There is no such source, or it does not know the hand.
        """
        first, rescue = self._roles(problem, request)
        for source in (first, rescue):
            if source is not None and not source.knows(problem.hand):
                raise OptionError(f"source '{source.name}' does not know hand '{problem.hand.name}'; choose another source")
        config = self.config.finish
        if not request.refine:
            config = replace(config, refine=None, settle=None, ease=None, least_confidence=0.0)
        if request.least_confidence is not None:
            config = replace(config, least_confidence=request.least_confidence)
        asked = _Asking(self, problem, request, config, progress)
        if first is not None:
            asked.until_enough(first)
        if rescue is not None:
            asked.until_trusted([source for source in (rescue, first) if source is not None])
        done, shortage = asked.done, None
        if done is None or len(done.rows) < request.num:
            shortage = shortage_in_words(problem, request.num, done, alone=first is None or rescue is None)
        if done is None or not len(done.rows):
            raise NoGraspError(str(shortage))
        proposed = done.proposed
        given, before = (grasps.with_asked(request.num) for grasps in (
            with_own_files(done.grasps, problem.hand, problem.obj), complete(problem, proposed.grasps)))
        return Prediction(given, before, proposed.points, list(proposed.origin), done.made, dict(done.dropped),
                          asked.seconds | done.watch.seconds, shortage)

    def source(self, name: str | Source, temperature: float | None = None) -> Source:
        """A source by its name, with the predictor's weights and configuration where it has any.

        Args:
            name: See `GraspRequest.source`; `auto` stands for the network, which that rule asks first.
            temperature: Spread of z; None takes the predictor's.

        Raises:
            OptionError: There is none of that name.
        """
        source = source_or_name(name) if isinstance(name, str) else name
        if isinstance(source, Source):
            return source
        if source in (AUTO, NetworkSource.name):
            config = self.config.network
            return NetworkSource(self.network, config if temperature is None else replace(config, temperature=temperature))
        return OptimiserSource(self.config.optimiser, self.network.config.n_hand)

    def _roles(self, problem: GraspProblem, request: GraspRequest) -> tuple[Source | None, Source | None]:
        """The source that is asked first, and the one that makes rivals for what is not trusted."""
        named = self.source(request.source, request.temperature)
        if request.source == AUTO:
            if problem.lies_flat:  # the network knows no table, and no hand that pinches beside one
                return None, self.source(OptimiserSource.name)
            return named, self.source(OptimiserSource.name)
        # The optimiser alone makes as few candidates as are trusted, which takes less time than a fixed number.
        return (None, named) if isinstance(named, OptimiserSource) else (named, None)


class _Asking:
    """One request under way: what was finished so far."""

    def __init__(
        self, predictor: GraspPredictor, problem: GraspProblem, request: GraspRequest, config: FinishConfig,
        progress: Progress | None,
    ) -> None:
        self.config, self.n_points = predictor.config, predictor.network.config.n_hand
        self.problem, self.request, self.finishing, self.progress = problem, request, config, progress
        self.done: Finished | None = None
        self.made = Counter[str]()  # candidates by source
        self.seconds: dict[str, float] = dict.fromkeys(PARTS, 0.0)

    def ask(self, source: Source, num: int, seed: int) -> Finished:
        """Candidates of one source that it has not proposed before, finished beside those that it has."""
        made = ask(source, self.problem, num, seed, self.progress, self.n_points)
        self.made[source.name] += len(made)
        if self.done is not None:
            made = made.beside(self.done.candidates)
        self.done = done = finish(self.problem, made, self.finishing, self.request.num, self.done)
        self.seconds |= {name: self.seconds.get(name, 0.0) + spent for name, spent in made.seconds.items()} | done.seconds
        return done

    def until_enough(self, source: Source) -> None:
        """Candidates until as many as were asked for are admitted, as long as that is in sight."""
        wanted, retry = self.request.num * self.request.candidates, self.config.retry
        count, admitted = wanted, 0
        for seed in (self.request.seed, *_drawn(self.request.seed, retry.rounds - 1)):
            done = self.ask(source, count, seed)
            admitted += len(done.refined)
            if admitted >= wanted or admitted <= retry.least_yield * done.made:
                return
            count = min(wanted, math.ceil(retry.reserve * (wanted - admitted) * done.made / admitted))

    def until_trusted(self, sources: Sequence[Source]) -> None:
        """Rivals for each grasp that the score does not trust, again and again for those that it still does not."""
        rescue, flat = self.config.rescue, self.problem.lies_flat
        levels, each = rescue.rounds(self.problem.surroundings is not None and not flat)
        for k, (seed, least_score) in enumerate(zip(_drawn(self.request.seed, len(levels)), levels, strict=True)):
            lacking = self.request.num if self.done is None else self.done.lacking(least_score)
            if not lacking:
                return
            nothing = lacking == self.request.num
            if k and nothing and self._is_hopeless():
                return
            count = rescue.blind if k and nothing else each * lacking
            self.ask(self._promising(sources, least_score), count, seed)

    def _promising(self, sources: Sequence[Source], least_score: float) -> Source:
        """The source of whose candidates the largest share is trusted so far; the first of several."""
        trusted, untried, done = Counter[str](), self.config.rescue.untried, self.done
        if done is not None:
            rows = (done.pool.score > least_score).nonzero()[:, 0].tolist()
            trusted.update(done.candidates.origin[row] for row in rows)
            # A pinch that does not lift is no nearer to one that does than any other.
            if self.request.source == AUTO and len(done.pool) and not self.problem.lies_flat:
                sources = (*sources, VariationSource(done.pool, self.config.variation))
        return max(sources, key=lambda source: (trusted[source.name] + 1) / (self.made[source.name] + untried))

    def _is_hopeless(self) -> bool:
        """Whether nothing so far is near holding, of candidates enough to tell."""
        if self.done is None:
            return False
        # Scores of pinches that do not lift tell nothing of those to come.
        if self.problem.lies_flat:
            return not len(self.done.rows)
        rescue = self.config.rescue
        return self.done.made >= rescue.patience and not bool((self.done.pool.score > rescue.hopeless).any())


def _drawn(first: int, count: int) -> list[int]:
    """Seeds drawn from a request's: neighbouring requests must not share rounds, so they are not counted up."""
    return np.random.default_rng(first).integers(2**63, size=count).tolist()
