"""The one-call face of the pipeline: a hand and an object in, ranked grasps out."""

from __future__ import annotations

import itertools
import math
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.devices import require_device
from dro_grasp.errors import NoGraspError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import with_own_files
from dro_grasp.hands.hand import Hand
from dro_grasp.network.checkpoints import load_weights
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.objects.scenery import Scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.config import AUTO, GraspRequest, PredictorConfig
from dro_grasp.predict.constraints import BallRows, Constraints, DirectionLike
from dro_grasp.predict.finish import FinishConfig, Finished, complete_grasps, finish_all
from dro_grasp.predict.problem import GraspProblem, problems_of
from dro_grasp.predict.settling import can_settle
from dro_grasp.predict.shortage import shortage_in_words
from dro_grasp.predict.sources.network import NetworkSource
from dro_grasp.predict.sources.optimiser import OptimiserSource
from dro_grasp.predict.sources.registry import source_or_name
from dro_grasp.predict.sources.source import Asked, Candidates, Progress, Source, ask, ask_all
from dro_grasp.predict.sources.variation import VariationSource
from dro_grasp.predict.stages import complete, grouped
from dro_grasp.simulation.rollout import FEW
from dro_grasp.simulation.worlds import require_worlds

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

    def __init__(self, weights: str | Path | None = None, device: str = "cpu", config: PredictorConfig | None = None) -> None:
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

    def predict(
        self, hand: Hand, obj: ObjectModel, num: int = 16, seed: int = 0, constraints: Constraints | None = None, *,
        direction: DirectionLike | None = None, max_tilt: float | None = None, table: float | None = None,
        obstacles: Scene | None = None, contact_region: BallRows | None = None, keep_out: BallRows | None = None,
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
                `max_force` replace its fields, where they are not None; no balls take those of its fields away.
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
            candidates: Most candidates for each grasp, before rivals; the best by score are returned.
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
        wanted = replace(constraints or Constraints(), **{name: x for name, x in given.items() if x is not None})
        problem = GraspProblem(hand, obj, self.device, wanted)
        if (warning := problem.constraints.warning(obj)) is not None:
            warnings.warn(warning, stacklevel=2)
        made = self.run(problem, GraspRequest(num, seed, candidates, refine, temperature, source, least_confidence))
        if made.shortage is not None:
            warnings.warn(made.shortage, stacklevel=2)
        return made.grasps

    def predict_many(
        self, hand: Hand, objects: Sequence[ObjectModel], num: int = 16, seed: int = 0, constraints: Constraints | None = None,
        *, candidates: int = 4, refine: bool = True, temperature: float | None = None, source: str | Source = AUTO,
        least_confidence: float | None = None,
    ) -> list[GraspBatch]:
        """Grasps of several objects: those of `predict`, computed together on a GPU, one object after the other on a CPU.

        Arguments are those of `predict`. An object of which no grasp was found has an empty batch, with a warning.

        Raises:
            OptionError: An argument is out of range, or a table is above its object.
        """
        problems = problems_of(hand, objects, self.device, constraints or Constraints())
        for problem in problems:
            if (warning := problem.constraints.warning(problem.obj)) is not None:
                warnings.warn(f"{problem.obj.name}: {warning}", stacklevel=2)
        request = GraspRequest(num, seed, candidates, refine, temperature, source, least_confidence)
        found = []
        for problem, made in zip(problems, self.run_many(problems, request), strict=True):
            if (shortage := str(made) if isinstance(made, NoGraspError) else made.shortage) is not None:
                warnings.warn(shortage, stacklevel=2)
            none = GraspBatch.none(hand, problem.obj).replace(asked_of={(problem.obj.name, problem.obj.sha256): num})
            found.append(none if isinstance(made, NoGraspError) else made.grasps)
        return found

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
        made, = self.run_many([problem], request, progress)
        if isinstance(made, NoGraspError):
            raise made
        return made

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def run_many(
        self, problems: Sequence[GraspProblem], request: GraspRequest, progress: Progress | None = None
    ) -> list[Prediction | NoGraspError]:
        """The same for several problems with one hand, round by round: what is asked of one source is made together.

        Args:
            problems: With one hand, on the predictor's device.
            request: What is asked for, of each.
            progress: See `Progress`.

        Returns:
            For each problem what `run` returns, or the error of one without any grasp.

        Raises:
            OptionError: There is no such source, it does not know the hand, forces are limited and nothing settles, or so many
                grasps settle on a device and the extra for that is missing.
        """
        self._require_worlds(problems, request)
        for problem in problems:
            self._require_settling(problem, request)
        under_way = [_Asking(self, problem, request) for problem in problems]
        rounds = {asking: asking.rounds(*self._roles(asking.problem, request)) for asking in under_way}
        while rounds:
            now = {asking: ask for asking, turns in rounds.items() if (ask := next(turns, None)) is not None}
            rounds = {asking: rounds[asking] for asking in now}
            for together in _alike(now):
                _take(together, [now[asking] for asking in together], progress)
        complete_grasps([asking.done for asking in under_way if asking.done is not None and len(asking.done.rows)])
        return [asking.result() for asking in under_way]

    @torch.no_grad()
    def rounds(self, problem: GraspProblem, request: GraspRequest) -> Iterator[GraspBatch]:
        """Grasps as they become known: after each round in which sources were asked, the best of what was not yielded yet.

        For those who need one good grasp soon and know by themselves which is: who has it asks for no further round. Errors
        are those of `run`; where nothing is found at all, no batch comes before the error.

        Yields:
            Complete grasps with scores, the best score first; as many as were asked for at most.
        """
        self._require_settling(problem, request)
        asking, shown = _Asking(self, problem, request), torch.zeros(0, dtype=torch.bool)
        for wanted in asking.rounds(*self._roles(problem, request)):
            _take([asking], [wanted], None)
            done = asking.done
            assert done is not None
            shown = torch.cat([shown, shown.new_zeros(len(done.pool) - len(shown))])
            if len(rows := done.best(~shown)):
                shown[rows] = True
                yield with_own_files(done.among(rows).grasps, problem.hand, problem.obj)
        if not shown.any():
            raise NoGraspError(str(asking.shortage))

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

    def _require_settling(self, problem: GraspProblem, request: GraspRequest) -> None:
        """Refuse limits of forces where no hand settles, which alone tells forces: OptionError."""
        stated = [name for name in ("margin", "max_force") if getattr(problem.constraints, name) is not None]
        if stated and not (request.refine and self.config.finish.settle is not None and can_settle(problem)):
            why = ("with refine=False none does" if not request.refine else
                   "its hand has no description to simulate" if not can_settle(problem) else "this configuration leaves it out")
            says = "say" if stated[1:] else "says"
            raise OptionError(f"{' and '.join(stated)} {says} how hands squeeze once they settle, and {why}; leave out one of "
                              "them")

    def _require_worlds(self, problems: Sequence[GraspProblem], request: GraspRequest) -> None:
        """Refuse at once what would settle on a device without the extra for that: so many candidates together."""
        settle = self.config.finish.settle if request.refine and all(map(can_settle, problems)) else None
        if settle is not None and len(problems) * request.num * min(settle.spare, request.candidates) >= FEW:
            require_worlds(self.device)

    def _roles(self, problem: GraspProblem, request: GraspRequest) -> tuple[Source | None, Source | None]:
        """The source that is asked first, and the one that makes rivals for what is not trusted."""
        named = self.source(request.source, request.temperature)
        if request.source == AUTO:
            if problem.lies_flat:  # the network knows no table, and no hand that pinches beside one
                return None, self.source(OptimiserSource.name)
            return named, self.source(OptimiserSource.name)
        # The optimiser alone makes as few candidates as are trusted, which takes less time than a fixed number.
        return (None, named) if isinstance(named, OptimiserSource) else (named, None)


class _Ask(NamedTuple):
    """What is asked of a source next."""

    source: Source
    num: int
    seed: int


class _Asking:
    """One request under way: what was finished so far."""

    def __init__(self, predictor: GraspPredictor, problem: GraspProblem, request: GraspRequest) -> None:
        self.config, self.n_points = predictor.config, predictor.network.config.n_hand
        self.problem, self.request, self.finishing = problem, request, _finishing(self.config.finish, request)
        self.done: Finished | None = None
        rescue = self.config.rescue
        most = self.config.retry.rounds + max(len(rescue.trusted_scores), len(rescue.trusted_in_surroundings))
        self.seeds = iter(_drawn(request.seed, most))
        self.made = Counter[str]()  # candidates by source
        self.seconds: dict[str, float] = dict.fromkeys(PARTS, 0.0)

    def rounds(self, first: Source | None, rescue: Source | None) -> Iterator[_Ask]:
        """What is asked for, one after the other; before the next is asked for, `take` is called with what came."""
        hand = self.problem.hand
        for source in (first, rescue):
            if source is not None and not source.knows(hand):
                raise OptionError(f"source '{source.name}' does not know hand '{hand.name}'; choose another source")
        if first is not None:
            yield from self.until_enough(first)
        if rescue is not None:
            yield from self.until_trusted([source for source in (rescue, first) if source is not None])

    def take(self, done: Finished, made: Candidates) -> None:
        """Keep what came of what was asked for."""
        self.done = done
        self.seconds |= {name: self.seconds.get(name, 0.0) + spent for name, spent in made.seconds.items()} | done.seconds

    def result(self) -> Prediction | NoGraspError:
        """What is returned."""
        done, request = self.done, self.request
        if done is None or not len(done.rows):
            return NoGraspError(str(self.shortage))
        proposed = done.proposed
        given, before = (grasps.with_asked(request.num) for grasps in (
            with_own_files(done.grasps, self.problem.hand, self.problem.obj), complete(self.problem, proposed.grasps)))
        return Prediction(given, before, proposed.points, list(proposed.origin), done.made, dict(done.dropped),
                          self.seconds | done.watch.seconds, self.shortage)

    @property
    def shortage(self) -> str | None:
        """Why there are fewer grasps so far than were asked for; None if there are as many."""
        if self.done is not None and len(self.done.rows) == self.request.num:
            return None
        return shortage_in_words(self.problem, self.request.num, self.done, self.request.source != AUTO)

    def until_enough(self, source: Source) -> Iterator[_Ask]:
        """Candidates until enough are trusted, or as many as were asked for are admitted, as long as that is in sight."""
        wanted, retry = self.request.num * self.request.candidates, self.config.retry
        count, admitted = min(wanted, self._at_first()), 0
        for seed in (self.request.seed, *itertools.islice(self.seeds, retry.rounds - 1)):
            yield _Ask(source, count, seed)
            done = self.done
            assert done is not None
            admitted += len(done.refined)
            lacking = self._lacking_candidates(admitted)
            if admitted >= wanted or admitted <= retry.least_yield * done.made or not lacking:
                return
            missing = min(wanted - admitted, lacking)
            count = missing if admitted == done.made else min(wanted, math.ceil(retry.reserve * missing * done.made / admitted))

    def _at_first(self) -> int:
        """Candidates that are asked for at first, at most; all where their scores will not tell which to trust."""
        num, whole, retry = self.request.num, self.request.num * self.request.candidates, self.config.retry
        return max(retry.first * num, whole // 2, retry.fewest) if self._scores_tell else whole

    @property
    def _scores_tell(self) -> bool:
        """Whether candidates settle and their scores then tell which hold: not of pinches, and no part of a cloud is sure."""
        problem = self.problem
        return (self.finishing.settle is not None and can_settle(problem) and not problem.lies_flat
                and problem.obj.seen is None)

    def _lacking_candidates(self, admitted: int) -> int:
        """How many more candidates are likely to give what is lacking, from the trusted share of those admitted so far."""
        num, retry = self.request.num, self.config.retry
        if not self._scores_tell or self.done is None:
            return num * self.request.candidates
        lacking = self.done.lacking(self.config.rescue.rounds(self.problem.surroundings is not None)[0][0])
        likely = retry.reserve * lacking * admitted / max(num - lacking, 1)
        return max(retry.fewest, math.ceil(likely)) if lacking else 0

    def until_trusted(self, sources: Sequence[Source]) -> Iterator[_Ask]:
        """Rivals for each grasp that the score does not trust, again and again for those that it still does not."""
        rescue, flat = self.config.rescue, self.problem.lies_flat
        levels, each = rescue.rounds(self.problem.surroundings is not None and not flat)
        for k, (seed, least_score) in enumerate(zip(self.seeds, levels, strict=False)):
            lacking = self.request.num if self.done is None else self.done.lacking(least_score)
            if not lacking:
                return
            nothing = lacking == self.request.num
            if k and nothing and self._is_hopeless():
                return
            count = rescue.blind if k and nothing else each * lacking
            yield _Ask(self._promising(sources, least_score), count, seed)

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


def _alike(now: Mapping[_Asking, _Ask]) -> list[list[_Asking]]:
    """Requests whose next candidates are made and finished together."""
    asking, kinds = list(now), [now[each].source.name for each in now]
    groups = [[i for i, own in enumerate(kinds) if own == kind] for kind in dict.fromkeys(kinds)]
    return [[asking[rows[i]] for i in part] for rows in groups for part in grouped(
        [asking[i].problem for i in rows], [1] * len(rows), len(rows) if asking[0].config.together else None)]


def _take(asking: Sequence[_Asking], asks: Sequence[_Ask], progress: Progress | None) -> None:
    """Candidates of one kind of source that it has not proposed before, finished beside those that it has."""
    first, problems = asking[0], [each.problem for each in asking]
    wanted = [Asked(problem, ask.num, ask.seed) for problem, ask in zip(problems, asks, strict=True)]
    if isinstance(asks[0].source, VariationSource):  # each knows grasps of its own
        made = [ask(source.source, *own, progress, first.n_points) for source, own in zip(asks, wanted, strict=True)]
    else:
        made = ask_all(asks[0].source, wanted, progress, first.n_points)
    for i, each in enumerate(asking):
        each.made[asks[i].source.name] += len(made[i])
        if each.done is not None:
            made[i] = made[i].beside(each.done.candidates)
    finished = finish_all(problems, made, first.finishing, first.request.num, [each.done for each in asking])
    for each, done, own in zip(asking, finished, made, strict=True):
        each.take(done, own)


def _finishing(config: FinishConfig, request: GraspRequest) -> FinishConfig:
    """What becomes of candidates, as the request wants it."""
    if not request.refine:
        config = replace(config, refine=None, settle=None, ease=None, least_confidence=0.0)
    return config if request.least_confidence is None else replace(config, least_confidence=request.least_confidence)


def _drawn(first: int, count: int) -> list[int]:
    """Seeds drawn from a request's: neighbouring requests must not share rounds, so they are not counted up."""
    return np.random.default_rng(first).integers(2**63, size=count).tolist()
