"""The predictor with untrained weights: repeatability, batches, order, directions, tables, bare clouds."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, Never

import pytest
import torch
from torch import Tensor

from dro_grasp import devices, extras
from dro_grasp.errors import NoGraspError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.network import placement
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.partial_views import partial_view
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize import refinement
from dro_grasp.optimize.refinement import RefineConfig
from dro_grasp.optimize.starts import Spread, wrist_rotations
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.predict import predictor as predictor_module
from dro_grasp.predict.admission import PLANE, TURNED, AdmissionConfig
from dro_grasp.predict.config import GraspRequest, PredictorConfig, RescueConfig, RetryConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import FinishConfig, Finished
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.score.holding import Evidence, holding_score
from dro_grasp.predict.sources import network as network_source
from dro_grasp.predict.sources.choice import ChoiceConfig
from dro_grasp.predict.sources.controls import palm_facing_starts
from dro_grasp.predict.sources.network import ProposalConfig, _placements
from dro_grasp.predict.sources.optimiser import OptimiserConfig, OptimiserSource
from dro_grasp.predict.sources.source import Candidates, Progress, Source
from dro_grasp.predict.stages import scored
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.toy_hand import toy_hand

HAND = toy_hand()
NOWHERE = FinishConfig(admission=AdmissionConfig(least_clearance=1.0))
"""Above a table: no grasp keeps a metre off it."""
QUICK = OptimiserConfig(synthesis=SynthesisConfig(steps=30))
"""A quarter of the steps: worse grasps, made in the same way."""


@pytest.fixture(scope="module")
def predictor(weights: str) -> GraspPredictor:
    return GraspPredictor(weights)


@pytest.fixture(scope="module")
def ball() -> ObjectModel:
    return load_object("sphere")


@pytest.fixture(scope="module")
def grasps(predictor: GraspPredictor, ball: ObjectModel) -> GraspBatch:
    return predictor.predict(HAND, ball, num=7, seed=3, candidates=1, source="network")


def lowest_point(q: Tensor, T: Tensor) -> float:
    """Height of the lowest surface point of a grasping hand [m], point by point."""
    poses = T @ HAND.tree.forward(q)
    heights = []
    for link, point in zip(HAND.link_index.tolist(), HAND.link_points, strict=True):
        heights.append(float(poses[link, 2, :3] @ point + poses[link, 2, 3]))
    return min(heights)


def test_the_same_seed_gives_the_same_grasps(predictor: GraspPredictor, ball: ObjectModel, grasps: GraspBatch) -> None:
    torch.manual_seed(99)
    again, other = (predictor.predict(HAND, ball, num=7, seed=seed, candidates=1, source="network") for seed in (3, 4))
    assert torch.equal(again.T_object_wrist, grasps.T_object_wrist)
    assert torch.equal(again.joints, grasps.joints)
    assert not torch.equal(other.joints, grasps.joints)
    assert grasps.seed.tolist() == [3] * 7


@pytest.mark.parametrize("batch_size", [1, 3])
def test_grasps_do_not_depend_on_the_batch_size(
    weights: str, ball: ObjectModel, grasps: GraspBatch, batch_size: int
) -> None:
    config = PredictorConfig(network=ProposalConfig(batch_size=batch_size, network_batch_size=batch_size))
    other = GraspPredictor(weights, config=config).predict(HAND, ball, num=7, seed=3, candidates=1, source="network")
    for name in ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints", "score"):
        torch.testing.assert_close(getattr(other, name), getattr(grasps, name), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("least_yield", [0.0, 0.2])
def test_nothing_is_found_where_constraints_reject_everything(weights: str, ball: ObjectModel, least_yield: float) -> None:
    """Also with a share of zero, below which no share is."""
    strict = GraspPredictor(weights, config=PredictorConfig(finish=NOWHERE, retry=RetryConfig(least_yield=least_yield)))
    with pytest.raises(NoGraspError, match=r"only 0 of 2 candidates .*2 were asked for.* lower table .* use the source 'auto'"):
        strict.predict(HAND, ball, num=2, candidates=1, source="network", table=-0.2)
    with pytest.raises(OptionError, match="leaves nothing of the object"):
        strict.predict(HAND, ball, num=3, table=0.05)


def test_grasps_are_complete_valid_and_sorted(
    predictor: GraspPredictor, weights: str, ball: ObjectModel, grasps: GraspBatch
) -> None:
    assert len(grasps) == 7
    assert grasps.score.tolist() == sorted(grasps.score.tolist(), reverse=True)
    expected = holding_score(scored(GraspProblem(HAND, ball), grasps).score, Evidence.none(7, ball.mass))
    torch.testing.assert_close(grasps.score, expected, atol=1e-4, rtol=1e-4)
    for joints in (grasps.joints, grasps.pregrasp_joints, grasps.squeeze_joints):
        assert bool(((joints >= HAND.tree.lower - 1e-5) & (joints <= HAND.tree.upper + 1e-5)).all())
    rotation = grasps.T_object_wrist[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(7, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(7))
    assert (grasps.hand, set(grasps.object), set(grasps.provenance)) == ("toy", {"sphere"}, {"network untrained"})
    assert not grasps.extra


def test_a_run_returns_how_the_grasps_were_made(predictor: GraspPredictor, ball: ObjectModel) -> None:
    steps: list[tuple[int, int]] = []
    request = GraspRequest(num=10, candidates=2, source="network")
    made = predictor.run(GraspProblem(HAND, ball), request, lambda done, wanted: steps.append((done, wanted)))
    assert steps == [(16, 20), (20, 20)]
    assert (len(made.grasps), made.candidates) == (10, 20)
    assert set(made.seconds) == {"network", "choose", "decode", "optimiser", "refine", "settle", "rank", "weigh", "ease"}
    assert {part for part, seconds in made.seconds.items() if seconds == 0} == {"optimiser", "settle", "weigh"}
    # Solved hands stay near the multilaterated points they were fitted to, row by row.
    hand = HAND.with_points(predictor.network.config.n_hand)
    for grasps in (made.proposed, made.grasps):
        solved = hand.points(grasps.joints, grasps.T_object_wrist)
        own = (made.points - solved).norm(dim=-1).mean(-1)
        others = (made.points - solved.roll(1, 0)).norm(dim=-1).mean(-1)
        assert float(own.mean()) < 0.5 * float(others.mean())


@pytest.mark.parametrize("num", [0, -3])
def test_no_grasp_cannot_be_asked_for(predictor: GraspPredictor, ball: ObjectModel, num: int) -> None:
    with pytest.raises(OptionError, match=f"num is {num}"):
        predictor.predict(HAND, ball, num=num)


def test_an_option_that_does_not_exist_is_named(predictor: GraspPredictor, ball: ObjectModel) -> None:
    with pytest.raises(TypeError, match="tabel"):
        predictor.predict(HAND, ball, num=1, tabel=0.1)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (math.nan, 0.0, 1.0), (math.inf, 0.0, 0.0)])
def test_a_direction_must_point_somewhere(
    predictor: GraspPredictor, ball: ObjectModel, direction: tuple[float, float, float]
) -> None:
    with pytest.raises(OptionError, match="has no direction"):
        predictor.predict(HAND, ball, num=1, direction=direction)


def test_of_several_candidates_the_best_are_kept(predictor: GraspPredictor, ball: ObjectModel) -> None:
    many = predictor.predict(HAND, ball, num=12, seed=4, candidates=1, source="network")
    best = predictor.predict(HAND, ball, num=3, seed=4, source="network")
    torch.testing.assert_close(best.T_object_wrist, many.T_object_wrist[:3])
    torch.testing.assert_close(best.score, many.score[:3])
    with pytest.raises(OptionError, match="candidates is 0"):
        predictor.predict(HAND, ball, num=1, candidates=0)


@pytest.mark.parametrize("temperature", [-0.1, math.nan, 3.0])
def test_a_temperature_out_of_range_is_refused(temperature: float) -> None:
    with pytest.raises(OptionError, match=f"temperature is {temperature}; give 0"):
        PredictorConfig(network=ProposalConfig(temperature=temperature))
    with pytest.raises(OptionError, match=f"temperature is {temperature}; give 0"):
        GraspRequest(temperature=temperature)


def test_the_temperature_scales_what_z_is_made_of(weights: str, ball: ObjectModel) -> None:
    """At 0 all draws are the same, so of one placement one grasp; a request's own temperature goes before the predictor's."""
    cloud = dataclasses.replace(ball, vertices=None, faces=None)

    def proposed(obj: ObjectModel, own: float | None, asked: float | None) -> Tensor:
        config = PredictorConfig(network=ProposalConfig(temperature=own, choice=ChoiceConfig.first()))
        source = GraspPredictor(weights, config=config).source("network", asked)
        made = source.propose(GraspProblem(HAND, obj), 3, 5)
        assert isinstance(made, Candidates)
        return made.points

    cold, mild, plain = (proposed(ball, own, None) for own in (0.0, 0.5, None))
    torch.testing.assert_close(proposed(ball, 0.3, 0.5), mild)
    torch.testing.assert_close(proposed(ball, None, 1.0), plain)
    torch.testing.assert_close(proposed(cloud, None, None), proposed(cloud, 0.5, None), msg="bare clouds get surer grasps")
    off = [float((points - cold).norm(dim=-1).mean()) for points in (mild, plain)]
    assert 0 < off[0] < off[1]


@pytest.mark.parametrize("direction", [(0, 0, -1), (0.0, 0.0, -5.0), (0.0, 0.0, 1e-3), (1.0, 2.0, 2.0)])
def test_placements_face_the_direction_at_any_roll(
    direction: tuple[float, float, float]
) -> None:
    turns = wrist_rotations(HAND, 400, direction, Spread(math.radians(5)), torch.Generator().manual_seed(0))
    wanted = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float32), dim=0)
    angles = torch.acos((turns @ HAND.palm_direction_wrist @ wanted).clamp(-1, 1))
    # Two normal tilts of 5 degrees: their length is Rayleigh distributed.
    expected = math.radians(5) * math.sqrt(math.pi / 2)
    assert float(angles.mean()) == pytest.approx(expected, rel=0.15)
    side = torch.linalg.cross(wanted, torch.eye(3)[wanted.abs().argmin()])
    side = side / side.norm()
    seen = turns @ torch.eye(3)[0]
    roll = torch.atan2(seen @ torch.linalg.cross(wanted, side), seen @ side)
    assert bool((torch.histc(roll, 4, -math.pi, math.pi) > 70).all())


class Preferring(DistanceNetwork):
    """Of the rotations that are offered, its prior prefers the last ones."""

    preferred: Tensor

    def sample_placements(
        self, obj: Tensor, rotations: Tensor, num: int, generator: torch.Generator, proportions: Tensor
    ) -> tuple[Tensor, Tensor]:
        assert len(rotations) >= 2 * num, "the prior has a choice"
        self.preferred = rotations[-num:].flip(0)
        return self.preferred, torch.zeros(num, 3)


def test_where_there_is_room_for_all_the_prior_chooses_above_a_table_too(
    predictor: GraspPredictor, ball: ObjectModel
) -> None:
    network, cloud = Preferring(predictor.network.config), torch.from_numpy(ball.cloud)
    for direction in ((0.0, 0.0, -1.0), None):
        problem = GraspProblem(HAND, ball, constraints=Constraints(table=-3.0, direction=direction))
        T = _placements(problem, HAND, network, cloud, 6, 1, ProposalConfig(), torch.Generator().manual_seed(0))
        assert T.shape == (6, 1, 4, 4)
    turns = (T[..., :3, :3] @ network.config.axes(HAND.palm_axes_wrist)).flatten(0, 1)
    torch.testing.assert_close(turns, network.preferred[:6], atol=1e-5, rtol=0)


def test_hands_stay_above_the_table(predictor: GraspPredictor, ball: ObjectModel) -> None:
    table = -0.06
    problem = GraspProblem(HAND, ball, constraints=Constraints(table=table))
    run = predictor.run(problem, GraspRequest(num=8, candidates=1, source="network"))
    kept = run.grasps
    assert 0 < len(kept) == len(run.proposed) == len(run.points) <= 8
    assert (run.shortage is None) == (len(kept) == 8)
    for q, p, s, T in zip(kept.joints, kept.pregrasp_joints, kept.squeeze_joints, kept.T_object_wrist, strict=True):
        assert min(lowest_point(joints, T) for joints in (q, p, s)) > table - 1e-6


class Listed(Source):
    """Proposes what it is given, one list after the other."""

    def __init__(self, *answers: GraspBatch, name: str = "listed") -> None:
        self.name, self.answers, self.asked_for = name, answers, list[tuple[int, int]]()

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        self.asked_for.append((num, seed))
        return self.answers[min(len(self.asked_for), len(self.answers)) - 1]


def some(ball: ObjectModel, count: int, seed: int = 0) -> GraspBatch:
    return palm_facing_starts(HAND, ball, count, seed)


def lifted(grasps: GraspBatch, height: float) -> GraspBatch:
    T = grasps.T_object_wrist.clone()
    T[:, 2, 3] += height
    return grasps.replace(T_object_wrist=T)


def test_what_was_found_is_returned_with_a_warning(weights: str, ball: ObjectModel) -> None:
    """Of each answer one candidate is far above the table, and the rest far below."""
    plain = GraspPredictor(weights, config=PredictorConfig(finish=FinishConfig.nothing(), retry=RetryConfig(least_yield=0.0)))
    answers = [GraspBatch.concatenate([lifted(part[:1], 1.0), lifted(part[1:], -1.0)])
               for part in (some(ball, 6, seed) for seed in range(4))]
    source = Listed(*answers)
    with pytest.warns(UserWarning, match=r"only 4 of 24 candidates on object 'sphere' .*20 in the table.* 6 were .* "
                                         r"lower table \(now -0.1 m"):
        found = plain.predict(HAND, ball, num=6, seed=3, table=-0.1, candidates=1, source=source)
    assert (len(found), found.asked) == (4, 6)
    assert [num for num, _ in source.asked_for] == [6, 6, 6, 6], "as many as the share suggests, but never more than at first"
    assert source.asked_for[0][1] == 3
    assert len({seed for _, seed in source.asked_for}) == 4


def test_a_source_is_asked_again_for_what_was_rejected(weights: str, ball: ObjectModel) -> None:
    half = GraspBatch.concatenate([lifted(some(ball, 6, 0), 1.0), lifted(some(ball, 2, 1), -1.0)])
    for retry, counts in ((RetryConfig(), [8, 4]), (RetryConfig(reserve=3.0), [8, 8]), (RetryConfig(rounds=1), [8]),
                          (RetryConfig(least_yield=0.75), [8])):
        predictor = GraspPredictor(weights, config=PredictorConfig(finish=FinishConfig.nothing(), retry=retry))
        source = Listed(half, lifted(some(ball, 4, 2), 1.0))
        problem = GraspProblem(HAND, ball, constraints=Constraints(table=-0.1))
        made = predictor.run(problem, GraspRequest(2, source=source))
        assert [num for num, _ in source.asked_for] == counts
        assert made.dropped == {PLANE: 2}
        assert (len(made.grasps), made.origin) == (2, ["listed"] * 2)


class Starts(Source):
    """Hands that face the object, and how many were asked for."""

    name = "starts"

    def __init__(self) -> None:
        self.asked_for: list[tuple[int, int]] = []

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        self.asked_for.append((num, seed))
        return palm_facing_starts(problem.hand, problem.obj, num, seed)


@pytest.mark.parametrize(("trusted", "given", "counts"), [
    (-math.inf, {}, [8]), (math.inf, {}, [8, 8]), (-math.inf, {"candidates": 6}, [12]), (-math.inf, {"candidates": 1}, [4]),
    (-math.inf, {"refine": False}, [16]), (-math.inf, {"num": 1}, [4])])
def test_no_more_candidates_are_made_once_enough_are_trusted(
    weights: str, trusted: float, given: dict[str, Any], counts: list[int]
) -> None:
    source, hand, can = Starts(), loaded_hand("gripper3"), load_object("can")
    config = PredictorConfig(
        finish=FinishConfig(refine=RefineConfig(steps=2), weigh=None, least_confidence=0.0),
        rescue=RescueConfig(trusted_scores=(trusted,)))
    request = GraspRequest(**{"num": 4, "source": source} | given)
    made = GraspPredictor(weights, config=config).run(GraspProblem(hand, can), request)
    assert [num for num, _ in source.asked_for] == counts
    assert len({seed for _, seed in source.asked_for}) == len(counts)
    assert made.candidates == sum(counts)
    assert len(made.grasps) == request.num


def test_where_scores_do_not_tell_all_candidates_are_made_at_once(weights: str) -> None:
    """Without a description nothing settles; of what was seen in part nothing is sure."""
    hand, can = loaded_hand("gripper3"), load_object("can")
    config = PredictorConfig(
        finish=FinishConfig(refine=RefineConfig(steps=2), weigh=None, least_confidence=0.0),
        rescue=RescueConfig(trusted_scores=(-math.inf,)))
    bare = dataclasses.replace(hand, description=None)
    for whose, obj in ((bare, can), (hand, partial_view(can, "half", 0))):
        source = Starts()
        GraspPredictor(weights, config=config).run(GraspProblem(whose, obj), GraspRequest(4, source=source))
        assert [num for num, _ in source.asked_for] == [16]


def test_a_source_that_has_no_more_does_not_return_the_same_grasp_twice(weights: str, ball: ObjectModel) -> None:
    predictor = GraspPredictor(weights, config=PredictorConfig(finish=FinishConfig.nothing()))
    source = Listed(some(ball, 3))
    made = predictor.run(GraspProblem(HAND, ball), GraspRequest(5, source=source))
    assert (len(made.grasps), made.candidates, made.grasps.asked) == (3, 3, 5)
    assert len({tuple(row) for row in made.grasps.T_object_wrist.flatten(1).tolist()}) == 3
    assert made.shortage is not None


def test_a_source_that_proposes_nothing_is_told(weights: str, ball: ObjectModel) -> None:
    for config in (FinishConfig(), FinishConfig.nothing()):
        with pytest.raises(NoGraspError, match="only 0 of 0 candidates"):
            GraspPredictor(weights, config=PredictorConfig(finish=config)).predict(
                HAND, ball, num=2, source=Listed(some(ball, 1)[:0]))


def test_many_grasps_on_a_device_without_the_extra_for_trials_are_refused_before_the_work(
    weights: str, ball: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    hand, predictor = loaded_hand("gripper3"), GraspPredictor(weights)
    problem, source = GraspProblem(hand, ball), Listed(GraspBatch.none(hand, ball))
    predictor.device = "cuda"
    with pytest.raises(NoGraspError):  # so few would close on the processor
        predictor.run(problem, GraspRequest(16, source=source))
    for problems, request in (([problem] * 4, GraspRequest(16, source=source)), ([problem], GraspRequest(64, source=source))):
        asked = len(source.asked_for)
        with pytest.raises(OptionError, match=r"warp, mujoco_warp.*dro-grasp\[gpu\]"):
            predictor.run_many(problems, request)
        assert len(source.asked_for) == asked
        predictor.run_many(problems, dataclasses.replace(request, refine=False))  # nothing closes


def test_a_source_that_does_not_know_the_hand_is_not_asked(weights: str, ball: ObjectModel) -> None:
    class Choosy(Listed):
        def knows(self, hand: Hand) -> bool:
            return hand.name != HAND.name

    source = Choosy(some(ball, 3), name="choosy")
    with pytest.raises(OptionError, match="source 'choosy' does not know hand 'toy'"):
        GraspPredictor(weights).predict(HAND, ball, source=source)
    assert not source.asked_for


def test_a_bare_cloud_is_grasped(weights: str, ball: ObjectModel) -> None:
    network = ProposalConfig(temperature=1.0, choice=ChoiceConfig.first())  # a choice sees the surface, too
    predictor = GraspPredictor(weights, config=PredictorConfig(network=network))
    cloud = dataclasses.replace(ball, vertices=None, faces=None)
    made = predictor.predict(HAND, cloud, num=7, seed=3, candidates=1, source="network")
    assert bool(made.score.isfinite().all())
    # The network sees points alone: the same grasps before refinement, in an order of their own.
    raw = [
        predictor.predict(HAND, o, num=7, seed=3, candidates=1, refine=False, source="network").joints.tolist()
        for o in (cloud, ball)]
    assert sorted(map(tuple, raw[0])) == sorted(map(tuple, raw[1]))
    assert sorted(map(tuple, made.joints.tolist())) != sorted(map(tuple, raw[0]))


def test_a_cloud_with_too_few_points_is_grasped(predictor: GraspPredictor, ball: ObjectModel) -> None:
    few = dataclasses.replace(
        ball, cloud=ball.cloud[:40], cloud_normals=ball.cloud_normals[:40], vertices=None, faces=None
    )
    assert bool(predictor.predict(HAND, few, num=2, source="network").joints.isfinite().all())


def test_gradients_are_left_alone(predictor: GraspPredictor, grasps: GraspBatch) -> None:
    assert torch.is_grad_enabled()
    assert not grasps.joints.requires_grad
    assert not grasps.joints.is_inference()


def test_prediction_runs_wholly_on_the_device_it_is_told(
    weights: str, ball: ObjectModel, grasps: GraspBatch, device: str
) -> None:
    there = GraspPredictor(weights, device=device).predict(HAND, ball, num=7, seed=3, candidates=1, source="network")
    for name in ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints", "score"):
        assert type(getattr(there, name)) is Tensor, "grasps come back to the CPU"
        torch.testing.assert_close(getattr(there, name), getattr(grasps, name), atol=1e-4, rtol=1e-4)


def rescuing(
    predictor: GraspPredictor, scores: tuple[float, ...], per_grasp: int, blind: int, patience: int = 1000
) -> GraspPredictor:
    """The predictor with other rounds of a quick optimiser; it gives up after `patience` candidates."""
    other = copy.copy(predictor)
    rescue = RescueConfig(scores, per_grasp, blind=blind, patience=patience, hopeless=math.inf)
    other.config = PredictorConfig(optimiser=QUICK, rescue=rescue)
    return other


def test_auto_lets_the_optimiser_help_only_where_the_score_distrusts_the_network(
    predictor: GraspPredictor, ball: ObjectModel
) -> None:
    problem, alone = GraspProblem(HAND, ball), GraspRequest(4, seed=1, candidates=2, source="network")
    auto, network = dataclasses.replace(alone, source="auto"), predictor.run(problem, alone)
    assert network.origin == ["network"] * 4
    trusted = sorted(network.grasps.score.tolist())[1]  # three of the four best are above it
    helped = rescuing(predictor, (trusted - 1e-6, -math.inf), 3, 12).run(problem, auto)
    assert helped.candidates == network.candidates + 3
    assert float(helped.grasps.score.min()) >= float(network.grasps.score.min())
    again = rescuing(predictor, (trusted - 1e-6, math.inf, math.inf), 3, 12).run(problem, auto)
    assert again.candidates == helped.candidates + 2 * 4 * 3, "two rounds more, for all four"
    assert bool((again.grasps.score >= helped.grasps.score).all())
    assert rescuing(predictor, (-math.inf, math.inf), 3, 12).run(problem, auto).candidates == network.candidates


def test_a_request_is_given_up_once_enough_candidates_are_hopeless(predictor: GraspPredictor, ball: ObjectModel) -> None:
    """Nothing is near demands that nothing meets; the first rivals are made before that is asked."""
    problem, request = GraspProblem(HAND, ball), GraspRequest(2, seed=1, source="auto")
    network = predictor.run(problem, dataclasses.replace(request, source="network")).candidates
    for patience, rounds in ((0, 1), (network + 5, 2), (1000, 4)):
        asked = rescuing(predictor, (math.inf,) * 4, 2, 4, patience)
        assert asked.run(problem, request).candidates == network + 4 * rounds
    near = rescuing(predictor, (math.inf,) * 4, 2, 4, 0)
    near.config = dataclasses.replace(near.config, rescue=dataclasses.replace(near.config.rescue, hopeless=-math.inf))
    assert near.run(problem, request).candidates == network + 4 * 4


def test_as_long_as_nothing_is_trusted_rounds_have_a_fixed_size(predictor: GraspPredictor, ball: ObjectModel) -> None:
    asked, source = rescuing(predictor, (math.inf, math.inf, -math.inf), 2, 7), Noting()
    asked.run(GraspProblem(HAND, ball), GraspRequest(2, source=source))
    assert [num for num, _ in source.asked_for] == [4, 7]


def test_the_best_candidates_are_varied_where_no_source_is_named(predictor: GraspPredictor, ball: ObjectModel) -> None:
    """Once both sources brought nothing that is trusted, and then in turn with them; a source by its name is asked alone."""
    problem, asked = GraspProblem(HAND, ball), rescuing(predictor, (math.inf,) * 3, 20, 40)
    request = GraspRequest(2, seed=1, source="auto")
    made: Counter[str] = Counter()
    finish_all = predictor_module.finish_all

    def noting(problems: list[GraspProblem], candidates: list[Candidates], *rest: Any) -> list[Finished]:
        made.update(candidates[0].origin)
        return finish_all(problems, candidates, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(predictor_module, "finish_all", noting)
        given = asked.run(problem, request)
        assert made == {"network": 48, "optimiser": 40, "variation": 40}
        assert set(given.origin) <= set(made)
        made.clear()
        asked.run(problem, dataclasses.replace(request, source="optimiser"))
        assert made == {"optimiser": 120}


class Noting(OptimiserSource):
    """The optimiser, which notes what it is asked for."""

    def __init__(self) -> None:
        super().__init__(QUICK)
        self.asked_for: list[tuple[int, int]] = []

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> Candidates:
        self.asked_for.append((num, seed))
        return super().propose(problem, num, seed, progress)


def test_seeds_next_to_each_other_share_no_round_of_the_optimiser(predictor: GraspPredictor, ball: ObjectModel) -> None:
    asked, source = rescuing(predictor, (math.inf,) * 3, 2, 4), Noting()
    for first in (0, 1, 2, 2**63 - 1):
        asked.run(GraspProblem(HAND, ball), GraspRequest(2, seed=first, source=source))
    assert {num for num, _ in source.asked_for} == {4}
    assert len({seed for _, seed in source.asked_for}) == 4 * 3


def test_in_surroundings_fewer_rivals_are_made(predictor: GraspPredictor, ball: ObjectModel) -> None:
    asked, source = copy.copy(predictor), Noting()
    rescue = RescueConfig((math.inf,), 3, trusted_in_surroundings=(math.inf, math.inf), per_grasp_in_surroundings=1, blind=2)
    asked.config = PredictorConfig(finish=FinishConfig.nothing(), rescue=rescue)
    for table in (None, -0.1):
        problem = GraspProblem(HAND, ball, constraints=Constraints(table=table))
        asked.run(problem, GraspRequest(2, source=source))
    assert [num for num, _ in source.asked_for] == [6, 2, 2]


def test_candidates_that_turn_away_as_they_are_made_are_counted(predictor: GraspPredictor, ball: ObjectModel) -> None:
    """By a direction of palms that none of them keeps to a thousandth of a degree, and by one that all do."""
    problem = GraspProblem(HAND, ball, constraints=Constraints(direction=(0.0, 0.0, -1.0)))
    for farthest, turned in ((1e-5, 8), (math.pi, 0)):
        source = OptimiserSource(dataclasses.replace(QUICK, starts_per_candidate=1, farthest_direction=farthest))
        made = source.propose(problem, 8, 1)
        assert (len(made), made.turned) == (8 - turned, turned)
    few = OptimiserSource(dataclasses.replace(QUICK, starts_per_candidate=1, farthest_direction=1e-5))
    with pytest.raises(NoGraspError, match=rf"only 0 of 8 candidates .*8 {TURNED}"):
        rescuing(predictor, (math.inf,), 4, 8).run(problem, GraspRequest(2, seed=1, source=few))


class Deaf(DistanceNetwork):
    """Never asked."""

    def move(self, *_: object) -> Never:
        raise AssertionError("the network was asked")


def test_the_optimiser_alone_asks_no_network(predictor: GraspPredictor, ball: ObjectModel) -> None:
    alone = rescuing(predictor, (math.inf, math.inf), 4, 8)
    alone.network = Deaf(predictor.network.config)
    with pytest.raises(AssertionError, match="the network was asked"):
        alone.predict(HAND, ball, 1, source="network")
    cloud = dataclasses.replace(ball, vertices=None, faces=None)
    direction = torch.tensor([0.0, 0.6, -0.8])
    for obj in (ball, cloud):
        constraints = Constraints(direction=tuple(direction.tolist()))
        problem = GraspProblem(HAND, obj, constraints=constraints)
        made = alone.run(problem, GraspRequest(2, seed=1, source="optimiser"))
        assert made.origin == ["optimiser"] * 2
        assert made.candidates == 16, "of two rounds; those that the descent turned away count, too"
        assert made.seconds["optimiser"] > 0 == made.seconds["network"]
        angles = torch.rad2deg(torch.acos(HAND.palm_directions(made.proposed.T_object_wrist) @ direction))
        assert float(angles.max()) < 20
        solved = HAND.with_points(predictor.network.config.n_hand).points(made.proposed.joints, made.proposed.T_object_wrist)
        torch.testing.assert_close(made.points, solved)


def test_what_is_no_source_is_refused_before_any_work() -> None:
    with pytest.raises(OptionError, match="there is no source 'magic'; choose auto, network, optimiser, dfc, start"):
        GraspRequest(source="magic")


def test_what_threads_compute_beside_each_other_rounds_in_one_way(
    predictor: GraspPredictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a product rounds by whether another thread is in a block of quick products, and a seed has no one result."""
    seen = []

    def watched(work: Callable[..., Any], *parts: Iterable[Any]) -> list[Any]:
        def alone(*job: Any) -> Any:
            blocks.clear()
            before = torch.get_float32_matmul_precision()
            made = work(*job)
            seen.append({before, *blocks, torch.get_float32_matmul_precision()})
            return made

        return [alone(*job) for job in zip(*parts, strict=True)]

    def told(precision: str) -> None:
        blocks.append(precision)
        plain(precision)

    blocks, plain = list[str](), torch.set_float32_matmul_precision
    monkeypatch.setattr(torch, "set_float32_matmul_precision", told)
    monkeypatch.setattr(devices, "quick_path_is_accurate", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for module in (network_source, placement, refinement):
        monkeypatch.setattr(module, "side_by_side", watched)
    with contextlib.suppress(NoGraspError):
        predictor.run(GraspProblem(HAND, load_object("sphere")), GraspRequest(16, source="network"))
    assert all(len(settings) == 1 for settings in seen)
    assert {"medium"} in seen
