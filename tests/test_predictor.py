"""The predictor with untrained weights: repeatability, batches, order, directions, tables, bare clouds."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.models.network import Moves
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimization.starts import Spread, wrist_rotations
from dro_grasp.pipeline.admission import TURNED
from dro_grasp.pipeline.constraints import Constraints
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.proposal import _placements
from dro_grasp.pipeline.stages import Optimised, optimise, scored
from dro_grasp.predictor import GraspPredictor, GraspRequest, PredictorConfig
from tests.helpers.toy_hand import toy_hand
from tests.helpers.weights import untrained_weights

HAND = toy_hand()


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(untrained_weights(tmp_path_factory.mktemp("weights")))


@pytest.fixture(scope="module")
def predictor(weights: str) -> GraspPredictor:
    return GraspPredictor(weights)


@pytest.fixture(scope="module")
def ball() -> ObjectModel:
    return load_object("sphere")


@pytest.fixture(scope="module")
def grasps(predictor: GraspPredictor, ball: ObjectModel) -> GraspBatch:
    return predictor.predict(HAND, ball, num=7, seed=3, candidates=1, method="network")


def lowest_point(q: Tensor, T: Tensor) -> float:
    """Height of the lowest surface point of a grasping hand [m], point by point."""
    poses = T @ HAND.tree.forward(q)
    heights = []
    for link, point in zip(HAND.link_index.tolist(), HAND.link_points, strict=True):
        heights.append(float(poses[link, 2, :3] @ point + poses[link, 2, 3]))
    return min(heights)


def test_the_same_seed_gives_the_same_grasps(predictor: GraspPredictor, ball: ObjectModel, grasps: GraspBatch) -> None:
    torch.manual_seed(99)
    again, other = (predictor.predict(HAND, ball, num=7, seed=seed, candidates=1, method="network") for seed in (3, 4))
    assert torch.equal(again.T_object_wrist, grasps.T_object_wrist)
    assert torch.equal(again.joints, grasps.joints)
    assert not torch.equal(other.joints, grasps.joints)
    assert grasps.seed.tolist() == [3] * 7


@pytest.mark.parametrize("batch_size", [1, 3])
def test_grasps_do_not_depend_on_the_batch_size(
    weights: str, ball: ObjectModel, grasps: GraspBatch, batch_size: int
) -> None:
    config = PredictorConfig(batch_size=batch_size, network_batch_size=batch_size)
    other = GraspPredictor(weights, config=config).predict(HAND, ball, num=7, seed=3, candidates=1, method="network")
    for name in ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints", "score"):
        torch.testing.assert_close(getattr(other, name), getattr(grasps, name), atol=1e-4, rtol=1e-4)


def test_nothing_is_found_where_constraints_reject_everything(
    weights: str, ball: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with a share of zero, below which no share is."""
    monkeypatch.setattr("dro_grasp.pipeline.pool.permitted", lambda problem, grasps: torch.zeros(len(grasps), dtype=torch.bool))
    strict = GraspPredictor(weights, config=PredictorConfig(least_yield=0.0))
    with pytest.raises(OptionError, match="only 0 of 2 candidates"):
        strict.predict(HAND, ball, num=2, candidates=1, method="network", table=-0.2)


def test_grasps_are_complete_valid_and_sorted(
    predictor: GraspPredictor, weights: str, ball: ObjectModel, grasps: GraspBatch
) -> None:
    assert len(grasps) == 7
    assert grasps.score.tolist() == sorted(grasps.score.tolist(), reverse=True)
    torch.testing.assert_close(grasps.score, scored(GraspProblem(HAND, ball), grasps).score, atol=1e-4, rtol=1e-4)
    for joints in (grasps.joints, grasps.pregrasp_joints, grasps.squeeze_joints):
        assert bool(((joints >= HAND.tree.lower - 1e-5) & (joints <= HAND.tree.upper + 1e-5)).all())
    rotation = grasps.T_object_wrist[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(7, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(7))
    assert (grasps.hand, set(grasps.object), set(grasps.provenance)) == ("toy", {"sphere"}, {"network untrained"})
    assert not grasps.extra


def test_a_run_returns_how_the_grasps_were_made(predictor: GraspPredictor, ball: ObjectModel) -> None:
    steps: list[tuple[int, int]] = []
    request = GraspRequest(num=10, candidates=2, method="network")
    made = predictor.run(GraspProblem(HAND, ball), request, lambda done, wanted: steps.append((done, wanted)))
    assert steps == [(16, 20), (20, 20)]
    assert (len(made.grasps), made.candidates) == (10, 20)
    assert set(made.seconds) == {"network", "choose", "decode", "optimise", "refine", "settle", "rank"}
    assert {part for part, seconds in made.seconds.items() if seconds == 0} == {"optimise", "settle"}
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
    with pytest.raises(OptionError, match=r"no option 'tabel'; the options are direction, .*table.*candidates"):
        predictor.predict(HAND, ball, num=1, tabel=0.1)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (math.nan, 0.0, 1.0), (math.inf, 0.0, 0.0)])
def test_a_direction_must_point_somewhere(
    predictor: GraspPredictor, ball: ObjectModel, direction: tuple[float, float, float]
) -> None:
    with pytest.raises(OptionError, match="has no direction"):
        predictor.predict(HAND, ball, num=1, direction=direction)


def test_of_several_candidates_the_best_are_kept(predictor: GraspPredictor, ball: ObjectModel) -> None:
    many = predictor.predict(HAND, ball, num=12, seed=4, candidates=1, method="network")
    best = predictor.predict(HAND, ball, num=3, seed=4, method="network")
    torch.testing.assert_close(best.T_object_wrist, many.T_object_wrist[:3])
    torch.testing.assert_close(best.score, many.score[:3])
    with pytest.raises(OptionError, match="candidates is 0"):
        predictor.predict(HAND, ball, num=1, candidates=0)


@pytest.mark.parametrize("temperature", [-0.1, math.nan, 3.0])
def test_a_temperature_out_of_range_is_refused(weights: str, ball: ObjectModel, temperature: float) -> None:
    with pytest.raises(OptionError, match=f"temperature is {temperature}; give 0"):
        GraspPredictor(weights, config=PredictorConfig(temperature=temperature)).predict(HAND, ball, num=1)


def test_the_temperature_scales_what_z_is_made_of(weights: str, ball: ObjectModel, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[object, Tensor] = {}
    cloud = dataclasses.replace(ball, vertices=None, faces=None)
    for temperature, obj in ((None, ball), (0.0, ball), (0.5, ball), (None, cloud)):
        predictor = GraspPredictor(weights, config=PredictorConfig(temperature=temperature))
        honest = predictor.network.move

        def move(hand: Tensor, points: Tensor, noise: Tensor, at=(temperature, obj), honest=honest) -> Moves:
            drawn[at] = noise
            return honest(hand, points, noise)

        monkeypatch.setattr(predictor.network, "move", move)
        predictor.predict(HAND, obj, num=3, seed=5, candidates=1, refine=False, method="network")
    assert float(drawn[0.0, ball].abs().max()) == 0
    torch.testing.assert_close(drawn[0.5, ball], 0.5 * drawn[None, ball])
    torch.testing.assert_close(drawn[None, cloud], drawn[0.5, ball], msg="bare clouds get surer grasps")


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


def test_where_there_is_room_for_all_the_prior_chooses_above_a_table_too(
    predictor: GraspPredictor, ball: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    preferred: list[torch.Tensor] = []
    network = predictor.network

    def sample(points, rotations, num, generator, shape):  # type: ignore[no-untyped-def]
        assert len(rotations) >= 2 * num, "the prior has a choice"
        preferred.append(rotations[-num:].flip(0))
        return preferred[-1], torch.zeros(num, 3)

    monkeypatch.setattr(network, "sample_placements", sample)
    cloud = torch.from_numpy(ball.cloud)
    for direction in ((0.0, 0.0, -1.0), None):
        problem = GraspProblem(HAND, ball, constraints=Constraints(table=-3.0, direction=direction))
        T = _placements(problem, HAND, network, cloud, 6, 1, predictor.config, torch.Generator().manual_seed(0))
        assert T.shape == (6, 1, 4, 4)
    turns = (T[..., :3, :3] @ network.config.axes(HAND.palm_axes_wrist)).flatten(0, 1)
    torch.testing.assert_close(turns, preferred[-1][:6], atol=1e-5, rtol=0)


def test_hands_stay_above_the_table(predictor: GraspPredictor, ball: ObjectModel) -> None:
    table = -0.06
    problem = GraspProblem(HAND, ball, constraints=Constraints(table=table))
    run = predictor.run(problem, GraspRequest(num=8, candidates=1, method="network"))
    kept = run.grasps
    assert 0 < len(kept) == len(run.proposed) == len(run.points) <= 8
    assert (run.shortage is None) == (len(kept) == 8)
    for q, p, s, T in zip(kept.joints, kept.pregrasp_joints, kept.squeeze_joints, kept.T_object_wrist, strict=True):
        assert min(lowest_point(joints, T) for joints in (q, p, s)) > table - 1e-6


def test_what_was_found_is_returned_with_a_warning(
    predictor: GraspPredictor, ball: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    def first_of_each_batch(problem: GraspProblem, grasps: GraspBatch) -> Tensor:
        return torch.arange(len(grasps)) == 0

    monkeypatch.setattr("dro_grasp.pipeline.pool.permitted", first_of_each_batch)
    with pytest.warns(UserWarning, match=r"only 1 of 6 candidates on object 'sphere' .* 6 were .* lower table \(now -0.1 m"):
        found = predictor.predict(HAND, ball, num=6, table=-0.1, candidates=1, method="network")
    assert len(found) == 1


def test_an_impossible_table_is_told(predictor: GraspPredictor, ball: ObjectModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dro_grasp.pipeline.pool.permitted", lambda problem, grasps: torch.zeros(len(grasps), dtype=torch.bool))
    with pytest.raises(OptionError, match=r"only 0 of 3 .* 3 were asked for.* lower table .* use the method 'auto'"):
        predictor.predict(
            HAND, ball, num=3, direction=(0.0, 0.0, -1.0), table=-0.04, candidates=1, method="network")
    with pytest.raises(OptionError, match="leaves nothing of the object"):
        predictor.predict(HAND, ball, num=3, table=0.05)


def test_a_bare_cloud_is_grasped(weights: str, ball: ObjectModel) -> None:
    predictor = GraspPredictor(weights, config=PredictorConfig(temperature=1.0))
    cloud = dataclasses.replace(ball, vertices=None, faces=None)
    made = predictor.predict(HAND, cloud, num=7, seed=3, candidates=1, method="network")
    assert bool(made.score.isfinite().all())
    # The network sees points alone: the same grasps before refinement, in an order of their own.
    raw = [
        predictor.predict(HAND, o, num=7, seed=3, candidates=1, refine=False, method="network").joints.tolist()
        for o in (cloud, ball)]
    assert sorted(map(tuple, raw[0])) == sorted(map(tuple, raw[1]))
    assert sorted(map(tuple, made.joints.tolist())) != sorted(map(tuple, raw[0]))


def test_a_cloud_with_too_few_points_is_grasped(predictor: GraspPredictor, ball: ObjectModel) -> None:
    few = dataclasses.replace(
        ball, cloud=ball.cloud[:40], cloud_normals=ball.cloud_normals[:40], vertices=None, faces=None
    )
    assert bool(predictor.predict(HAND, few, num=2, method="network").joints.isfinite().all())


def test_gradients_are_left_alone(predictor: GraspPredictor, grasps: GraspBatch) -> None:
    assert torch.is_grad_enabled()
    assert not grasps.joints.requires_grad
    assert not grasps.joints.is_inference()


def test_prediction_runs_wholly_on_the_device_it_is_told(
    weights: str, ball: ObjectModel, grasps: GraspBatch, device: str
) -> None:
    there = GraspPredictor(weights, device=device).predict(HAND, ball, num=7, seed=3, candidates=1, method="network")
    for name in ("T_object_wrist", "joints", "pregrasp_joints", "squeeze_joints", "score"):
        assert type(getattr(there, name)) is Tensor, "grasps come back to the CPU"
        torch.testing.assert_close(getattr(there, name), getattr(grasps, name), atol=1e-4, rtol=1e-4)


def test_auto_lets_the_optimiser_help_only_where_the_score_distrusts_the_network(
    predictor: GraspPredictor, ball: ObjectModel, quick_synthesis: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dro_grasp.predictor.OPTIMISED_PER_GRASP", 3)
    problem, alone = GraspProblem(HAND, ball), GraspRequest(4, seed=1, candidates=2, method="network")
    network = predictor.run(problem, alone)
    assert network.origin == ["network"] * 4
    trusted = sorted(network.grasps.score.tolist())[1]  # three of the four best are above it
    monkeypatch.setattr("dro_grasp.predictor.TRUSTED_SCORES", (trusted - 1e-6, -math.inf))
    helped = predictor.run(problem, dataclasses.replace(alone, method="auto"))
    assert helped.candidates == network.candidates + 3
    assert float(helped.grasps.score.min()) >= float(network.grasps.score.min())
    monkeypatch.setattr("dro_grasp.predictor.TRUSTED_SCORES", (trusted - 1e-6, math.inf, math.inf))
    again = predictor.run(problem, dataclasses.replace(alone, method="auto"))
    assert again.candidates == helped.candidates + 2 * 4 * 3, "two rounds more, for all four"
    assert bool((again.grasps.score >= helped.grasps.score).all())
    monkeypatch.setattr("dro_grasp.predictor.TRUSTED_SCORES", (-math.inf, math.inf))
    assert predictor.run(problem, dataclasses.replace(alone, method="auto")).candidates == network.candidates


def test_seeds_next_to_each_other_share_no_round_of_the_optimiser(
    predictor: GraspPredictor, ball: ObjectModel, quick_synthesis: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dro_grasp.predictor.TRUSTED_SCORES", (math.inf,) * 3)
    monkeypatch.setattr("dro_grasp.predictor.OPTIMISED_PER_GRASP", 2)
    seeds: list[int] = []

    def counted(problem: GraspProblem, num: int, seed: int, *rest: object) -> Optimised:
        seeds.append(seed)
        return optimise(problem, num, seed)

    monkeypatch.setattr("dro_grasp.predictor.optimise", counted)
    for first in (0, 1, 2, 2**63 - 1):
        predictor.run(GraspProblem(HAND, ball), GraspRequest(2, seed=first, method="optimise"))
    assert len(set(seeds)) == len(seeds) == 4 * 3


def test_candidates_that_turn_away_as_they_are_made_are_counted(
    predictor: GraspPredictor, ball: ObjectModel, quick_synthesis: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dro_grasp.predictor.OPTIMISED_PER_GRASP", 4)
    monkeypatch.setattr("dro_grasp.predictor.TRUSTED_SCORES", (math.inf,))
    monkeypatch.setattr("dro_grasp.pipeline.stages.facing", lambda problem, grasps: torch.arange(len(grasps)) < 3)
    problem = GraspProblem(HAND, ball, constraints=Constraints(direction=(0.0, 0.0, -1.0)))
    made = predictor.run(problem, GraspRequest(2, seed=1, method="optimise"))
    assert (made.candidates, made.dropped[TURNED]) == (8, 5)


def test_the_optimiser_alone_asks_no_network(
    predictor: GraspPredictor, ball: ObjectModel, quick_synthesis: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dro_grasp.predictor.OPTIMISED_PER_GRASP", 4)
    monkeypatch.setattr(predictor.network, "move", None)
    cloud = dataclasses.replace(ball, vertices=None, faces=None)
    direction = torch.tensor([0.0, 0.6, -0.8])
    for obj in (ball, cloud):
        constraints = Constraints(direction=tuple(direction.tolist()))
        problem = GraspProblem(HAND, obj, constraints=constraints)
        made = predictor.run(problem, GraspRequest(2, seed=1, method="optimise"))
        assert made.origin == ["optimiser"] * 2
        assert made.candidates == 16, "of two rounds; those that the descent turned away count, too"
        assert made.seconds["optimise"] > 0 == made.seconds["network"]
        angles = torch.rad2deg(torch.acos(HAND.palm_directions(made.proposed.T_object_wrist) @ direction))
        assert float(angles.max()) < 20
        solved = HAND.with_points(predictor.network.config.n_hand).points(made.proposed.joints, made.proposed.T_object_wrist)
        torch.testing.assert_close(made.points, solved)
    request = GraspRequest()
    object.__setattr__(request, "method", "magic")  # past the type checker of the tests
    with pytest.raises(OptionError, match="method is 'magic'; choose auto, network, optimise"):
        request.__post_init__()
