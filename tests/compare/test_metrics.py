"""Metrics against SciPy and loops, and controls that know nothing of network or shape."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import mannwhitneyu

from dro_grasp.compare.methods import mean_grasps_of
from dro_grasp.compare.metrics import difference_interval, diversity, finger_contact, mean_share, roc_area, wilson_interval
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import ChoiceConfig, choice_scores
from dro_grasp.predict.sources.controls import CHOICE_POINTS, mean_grasps, palm_facing_starts
from dro_grasp.training.data.bundle.training_file import Bundle
from tests.helpers.tiny_bundle import SEMIAXES, ellipsoid, made_up_grasps, tiny_bundle
from tests.helpers.toy_hand import toy_hand

HAND = toy_hand()


def bare(name: str, shift: float = 0.0) -> ObjectModel:
    cloud = ellipsoid(SEMIAXES[name])
    points = (cloud.points + shift).numpy()
    return ObjectModel(name, points, cloud.normals.numpy(), points.mean(0), name)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    return tiny_bundle(tmp_path_factory.mktemp("bundle") / "bundle.safetensors")


@pytest.mark.parametrize(("success", "total"), [(0, 5), (5, 5), (1, 3), (37, 64), (199, 200), (0, 1)])
def test_wilson_interval_holds_the_rates_that_the_score_test_keeps(success: int, total: int) -> None:
    # The ends are where the distance to the observed rate p is 1.96 standard errors: (p - x)^2 = z^2 x (1 - x) / n.
    z, p = 1.959963985, success / total
    ends = np.roots([1 + z**2 / total, -2 * p - z**2 / total, p**2])
    assert wilson_interval(success, total) == pytest.approx((ends.min(), ends.max()), abs=1e-7)


def test_mean_share_covers_the_mean_more_often_than_it_says() -> None:
    """A thousand times 25 grasps, each with a rate of its own: the true mean is inside at least 95 % of the time."""
    generator = np.random.default_rng(0)
    rates = generator.beta(4, 1, size=(1000, 25))
    shares = generator.binomial(8, rates) / 8
    inside = 0
    for row in shares:
        mean, low, high = mean_share(torch.from_numpy(row).float())
        assert low <= mean <= high
        inside += low <= 0.8 <= high
    assert inside >= 950
    assert mean_share(torch.ones(25)) == (1.0, *wilson_interval(25, 25))
    assert math.isnan(mean_share(torch.zeros(0))[0])


def test_finger_contact_is_the_mean_share_and_the_share_of_full_hands() -> None:
    assert finger_contact(torch.tensor([4, 2, 4, 0]), 4) == (10 / 16, 0.5)



@pytest.mark.parametrize(("counts", "interval"), [
    # Newcombe (1998), Statistics in Medicine 17, 873-890, table II, method 10.
    ((56, 70, 48, 80), (0.0524, 0.3339)), ((9, 10, 3, 10), (0.1705, 0.8090)), ((6, 7, 2, 7), (0.0582, 0.8062)),
    ((5, 56, 0, 29), (-0.0381, 0.1926)), ((0, 10, 0, 20), (-0.1611, 0.2775)), ((10, 10, 0, 20), (0.6791, 1.0)),
])
def test_the_interval_of_a_difference_is_the_published_one(
    counts: tuple[int, int, int, int], interval: tuple[float, float]
) -> None:
    success, total, success_before, total_before = counts
    assert difference_interval(success_before, total_before, success, total) == pytest.approx(interval, abs=1e-4)


def test_without_trials_nothing_is_known() -> None:
    assert difference_interval(0, 0, 3, 4) == (-1.0, 1.0)
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_diversity_equals_its_formula() -> None:
    grasps = made_up_grasps(HAND, count=30)
    # Roll, pitch, yaw: turns about the fixed x, y, z axes.
    angles = Rotation.from_matrix(grasps.T_object_wrist[:, :3, :3].double().numpy()).as_euler("xyz")
    coordinates = np.concatenate([grasps.T_object_wrist[:, :3, 3].numpy(), angles, grasps.joints.numpy()], 1)
    deviations = [math.sqrt(sum((x - sum(c) / 30) ** 2 for x in c) / 29) for c in coordinates.T.tolist()]
    found = diversity(grasps.T_object_wrist, grasps.joints)
    assert found["all"] == pytest.approx(sum(deviations) / len(deviations), rel=1e-5)
    assert found["wrist"] == pytest.approx(sum(deviations[:6]) / 6, rel=1e-5)
    assert found["joints"] == pytest.approx(sum(deviations[6:]) / 6, rel=1e-5)
    same = grasps[[0, 0, 0]]
    assert diversity(same.T_object_wrist, same.joints)["all"] == pytest.approx(0, abs=1e-7)
    assert diversity(grasps.T_object_wrist[:1], grasps.joints[:1])["all"] == 0


def test_roc_area_is_mann_whitneys() -> None:
    generator = torch.Generator().manual_seed(0)
    score = torch.randint(10, (40,), generator=generator).float()
    success = torch.rand(40, generator=generator) < 0.4
    u = mannwhitneyu(score[success], score[~success]).statistic
    assert roc_area(score, success) == pytest.approx(u / (success.sum() * (~success).sum()))
    assert math.isnan(roc_area(score, torch.ones(40, dtype=torch.bool)))
    assert roc_area(torch.zeros(40), success) == 0.5


def test_mean_grasp_is_the_mean_in_the_wrist_frame(bundle: Bundle) -> None:
    mean, grasps = mean_grasps_of(bundle)["toy"], bundle.grasps["toy"]
    expected = np.zeros(3)
    for T, index in zip(grasps.T_object_wrist.numpy(), grasps.object_index.tolist(), strict=True):
        centre = bundle.objects[bundle.object_names[index]].points.numpy().mean(0)
        expected += T[:3, :3].T @ (centre - T[:3, 3]) / len(grasps.joints)
    np.testing.assert_allclose(mean.object_centre, expected, atol=1e-6)
    np.testing.assert_allclose(mean.joints, grasps.joints.numpy().mean(0), rtol=1e-5)


def test_mean_grasps_ignore_the_shape(bundle: Bundle) -> None:
    mean, first = mean_grasps_of(bundle)["toy"], ChoiceConfig.first()
    ball, egg = (mean_grasps(GraspProblem(HAND, obj), mean, 12, 3, first) for obj in (bare("ball"), bare("egg", 0.5)))
    assert torch.equal(ball.joints, egg.joints)
    assert torch.equal(ball.joints, mean.joints.expand(12, -1))
    assert torch.equal(ball.T_object_wrist[:, :3, :3], egg.T_object_wrist[:, :3, :3])
    for grasps, obj in ((ball, bare("ball")), (egg, bare("egg", 0.5))):
        T = torch.linalg.inv(grasps.T_object_wrist)
        seen = T[:, :3, :3] @ torch.from_numpy(obj.cloud.mean(0)) + T[:, :3, 3]
        torch.testing.assert_close(seen, mean.object_centre.expand(12, 3), atol=1e-5, rtol=0)


def test_the_chosen_rotation_of_a_mean_grasp_is_the_best_of_its_draws(bundle: Bundle) -> None:
    problem, mean = GraspProblem(HAND, bare("egg", 0.5)), mean_grasps_of(bundle)["toy"]
    config = ChoiceConfig(placements=2, draws=3)
    draws = config.placements * config.draws
    every = mean_grasps(problem, mean, 4 * draws, 3, ChoiceConfig.first())
    thin = problem.thinned(min(CHOICE_POINTS, HAND.n_points))
    scores = choice_scores(thin, problem.field, thin.points(every.joints, every.T_object_wrist), config.penalties)
    best = scores.unflatten(0, (4, draws)).argmax(-1) + draws * torch.arange(4)
    chosen = mean_grasps(problem, mean, 4, 3, config)
    torch.testing.assert_close(chosen.T_object_wrist, every.T_object_wrist[best])
    assert scores.unflatten(0, (4, draws)).std(-1).min() > 0


@pytest.mark.parametrize("name", list(SEMIAXES))
def test_palm_facing_starts_face_the_object(name: str) -> None:
    obj = bare(name, 0.2)
    starts = palm_facing_starts(HAND, obj, 40, 0)
    palm = starts.T_object_wrist @ HAND.T_wrist_palm(starts.joints)
    for T in palm.numpy():
        origin, direction = T[:3, :3] @ HAND.palm_centre.numpy() + T[:3, 3], T[:3, :3] @ HAND.palm_direction.numpy()
        depth = (obj.cloud - origin) @ direction
        assert -1e-5 <= depth.min() <= 0.0101, "the palm is at the surface, or up to a centimetre off [m]"
        across = obj.cloud.mean(0) - origin
        assert np.linalg.norm(across - (across @ direction) * direction) < 1e-5, "the palm's axis meets the centre"


def test_starts_differ_by_seed_alone() -> None:
    obj = bare("ball")
    first, again, other = (palm_facing_starts(HAND, obj, 8, seed) for seed in (1, 1, 2))
    assert torch.equal(first.T_object_wrist, again.T_object_wrist)
    assert not torch.equal(first.T_object_wrist, other.T_object_wrist)
