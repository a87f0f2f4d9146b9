"""Methods that are compared: a source, beside the predictor that returns what becomes of its candidates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch

from dro_grasp.geometry.se3 import apply
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.config import GraspRequest, PredictorConfig
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.controls import MeanGrasp
from dro_grasp.predict.sources.registry import WITH_DATA, make_source
from dro_grasp.predict.sources.source import AUTO, Candidates, Source, ask


@dataclass(frozen=True)
class MethodOptions(Checked):
    """What methods are made with."""

    weights: str | None = None
    """Name or path of weights; the shipped ones if omitted."""
    device: str = "cpu"
    """Device on which networks run."""
    temperature: float | None = None
    """Spread of z of the D(R,O) network."""
    bundle: Any = None  # its class is of training, a wing above this one
    """A `Bundle` of training grasps, for the mean grasp."""
    candidates: int = GraspRequest.candidates
    """Candidates for each grasp that a method returns."""
    least_confidence: float | None = None
    """Grasps that hold with less probability are not returned; None takes the default."""


class Method:
    """A source by the name that it has in tables."""

    def __init__(
        self, source: str | Source, predictor: GraspPredictor, name: str | None = None,
        candidates: int = GraspRequest.candidates,
    ) -> None:
        """Find the source.

        Args:
            source: A source, or its name; `auto` proposes with the network, and returns what that rule does.
            predictor: Finishes what the source proposes, with the same configuration for every method of a table.
            name: Its name in tables; the source's own if omitted.
            candidates: Made for each grasp that is returned.

        Raises:
            OptionError: There is no such source.
        """
        self.predictor, self.source, self.candidates = predictor, predictor.source(source), candidates
        self.asks = AUTO if source == AUTO else self.source
        self.name = name or (AUTO if source == AUTO else self.source.name)

    def knows(self, hand: Hand) -> bool:
        """Whether it makes grasps of this hand at all."""
        return self.source.knows(hand)

    def asked(self, obj: ObjectModel, num: int) -> int:
        """How many grasps of an object it can be asked for, of `num`."""
        return self.source.asked(obj, num)

    @torch.no_grad()
    def propose(self, problem: GraspProblem, num: int, seed: int) -> Candidates:
        """Candidates as the source makes them."""
        return ask(self.source, problem, num, seed)

    def returned(self, problem: GraspProblem, num: int, seed: int) -> Prediction:
        """Grasps as `generate --source` returns them.

        Raises:
            NoGraspError: There is none.
        """
        return self.predictor.run(problem, GraspRequest(num, seed, self.candidates, source=self.asks))

    def predict(self, hand: Hand, obj: ObjectModel, num: int = 16, seed: int = 0) -> GraspBatch:
        """Grasps as `GraspPredictor.predict` returns them: at most `num`, the same for the same seed."""
        return self.returned(GraspProblem(hand, obj, self.predictor.device), num, seed).grasps.with_asked(self.asked(obj, num))


def make_method(name: str, options: MethodOptions | None = None) -> Method:
    """A method, ready to make grasps.

    Args:
        name: A name that `generate --source` takes, or a control that needs training grasps; `auto` and `network` with weights
            of their own, as `network@my_weights.safetensors`.
        options: What methods are made with.

    Raises:
        OptionError: There is no such source, or it lacks what it needs.
        GraspFileError: The grasp file cannot be read.
        WeightsError: There are no such weights.
    """
    options = options or MethodOptions()
    plain, at, weights = name.partition("@")
    own = bool(at) and plain in (AUTO, "network")
    config = PredictorConfig()
    if options.temperature is not None:
        config = replace(config, network=replace(config.network, temperature=options.temperature))
    if options.least_confidence is not None:
        config = replace(config, finish=replace(config.finish, least_confidence=options.least_confidence))
    predictor = GraspPredictor(weights if own else options.weights, options.device, config)
    if plain in WITH_DATA:
        means = None if options.bundle is None else mean_grasps_of(options.bundle)
        return Method(make_source(plain, means), predictor, candidates=options.candidates)
    source, label = (plain, f"{plain}@{weights}") if own else (f"{plain}{at}{weights}", None)
    return Method(source, predictor, label, options.candidates)


def mean_grasps_of(bundle: Any) -> dict[str, MeanGrasp]:
    """The mean grasp of each hand in a training bundle that has grasps."""
    clouds = torch.stack([cloud.points.mean(0) for cloud in bundle.objects.values()])
    means = {}
    for hand, grasps in bundle.grasps.items():
        if len(grasps.joints):
            centres = apply(torch.linalg.inv(grasps.T_object_wrist), clouds[grasps.object_index])
            means[hand] = MeanGrasp(grasps.joints.mean(0), centres.mean(0))
    return means
