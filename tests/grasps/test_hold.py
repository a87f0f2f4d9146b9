"""Held, empty, slipping or unexpected, by joints of which everything is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, norm

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.hold import HoldConfig, HoldExpectation, check_hold
from tests.helpers.claw import ball
from tests.helpers.toy_hand import toy_hand

EXPECTED = HoldExpectation(
    np.array([0.5, 0.6, 0.4, 0.02]), np.array([0.3, 0.2, 0.25, 8.0]), np.array([0.8, 0.9, 0.55, 0.0]), np.zeros(4),
    np.array([1.0, 1.0, 1.0, 0.05]))


def between(share: float) -> np.ndarray:
    return EXPECTED.held_joints + share * (EXPECTED.empty_joints - EXPECTED.held_joints)


def test_the_ends_are_told_apart_and_surely() -> None:
    for share, state in ((0.0, "held"), (-0.3, "held"), (1.0, "empty")):
        found = check_hold(EXPECTED, between(share))
        assert (found.state, found.confidence > 0.9) == (state, True), share
        assert sum(found.probabilities.values()) == pytest.approx(1)
        assert found.confidence == found.probabilities[state]


FAR = {"an open hand": between(-4.0), "degrees": np.degrees(EXPECTED.held_joints), "beyond the empty hand": between(2.0),
       "a dead encoder": between(1.0) * np.array([1.0, 0.0, 1.0, 1.0]), "zeros": np.zeros(4)}
"""Joints that say nothing of the object."""


@pytest.mark.parametrize("what", FAR)
def test_joints_that_fit_neither_end_are_unexpected(what: str) -> None:
    """Whatever else is measured: resting there, having been there before, efforts of the squeeze, and a load."""
    joints, known = FAR[what], replace(EXPECTED, weight=2.0)
    for more in ({}, {"watched": np.tile(joints, (11, 1))}, {"before": joints}, {"before": EXPECTED.held_joints},
                 {"measured_efforts": EXPECTED.held_efforts}, {"load": 2.0}):
        found = check_hold(known, joints, **more)
        assert (found.state, found.confidence > 0.95) == ("unexpected", True), (what, more)


def test_random_postures_are_unexpected() -> None:
    """Of many joints nearly all; as likely as the rule says: independently, by one joint alone."""
    rng, many = np.random.default_rng(0), np.ones(16)
    wide = HoldExpectation(0.5 * many, 0.3 * many, 0.8 * many, 0 * many, many)
    assert all(check_hold(wide, joints).state == "unexpected" for joints in rng.uniform(-0.5, 1.8, (500, 16)))
    one = HoldExpectation(*(row[:1] for row in (0.5 * many, 0.3 * many, 0.8 * many, 0 * many, many)))
    config = HoldConfig()
    for place in (-2.0, 0.0, 0.3, 0.5, 0.7, 0.8, 1.2):
        spread = np.hypot(config.encoder, config.spread * 0.3)
        held = max(norm.pdf(place, 0.5, spread), norm.pdf(place, 0.5, np.hypot(spread, config.slack)))
        shares = np.linspace(config.unsure, config.slip[1], 10)
        slips = np.mean(norm.pdf(place, 0.5 + 0.3 * shares, np.hypot(config.encoder, config.spread / 2 * 0.3)))
        odds = np.array([held, norm.pdf(place, 0.8, config.encoder), slips, 1 / config.anywhere])
        odds *= [*config.priors, config.doubt]
        expected = (1 - config.doubt) * odds / odds.sum() + config.doubt / 4
        assert list(check_hold(one, [place]).probabilities.values()) == pytest.approx(expected, abs=1e-9)


def test_what_nobody_expects_cannot_be_checked() -> None:
    hand = toy_hand()
    grasps = GraspBatch.create(hand, ball(), torch.eye(4)[None], torch.zeros(1, hand.tree.n_dof))
    assert HoldExpectation.of(grasps, 0) is None
    with pytest.raises(OptionError, match="nothing is expected of these grasps; let `expect_hold` find it first"):
        check_hold(HoldExpectation.of(grasps, 0), [0.0])
    with pytest.raises(OptionError, match="index is 7; give one from -1 to 0: the batch has 1"):
        HoldExpectation.of(grasps, 7)


def test_noise_of_encoders_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    for share, state in ((0.0, "held"), (1.0, "empty")):
        noisy = between(share) + 0.01 * EXPECTED.unit * rng.normal(size=(200, 4))
        assert sum(check_hold(EXPECTED, row).state == state for row in noisy) == 200


def test_fingers_that_move_on_together_let_the_object_slip() -> None:
    held = between(0.1)
    assert check_hold(EXPECTED, between(0.12), before=held).state == "held"
    assert check_hold(EXPECTED, between(0.6), before=held).state == "slipping"
    assert check_hold(EXPECTED, between(1.0), before=held).state == "empty"


def watched(speed: np.ndarray, share: float = 0.0, noise: float = 0.003, seed: int = 0) -> np.ndarray:
    """Eleven rows in a fifth of a second, of joints that move so fast [rad/s, or a share of the unit], with noise."""
    time = np.linspace(-0.2, 0.0, 11)[:, None]
    return between(share) + EXPECTED.unit * (time * speed + noise * np.random.default_rng(seed).normal(size=(11, 4)))


def test_fingers_that_move_while_nothing_is_commanded_let_the_object_slip() -> None:
    """Whichever way they move, wherever they are; what rests, and what creeps, is held."""
    still, some, away = np.zeros(4), np.array([0.0, 0.4, -0.3, 0.0]), np.array([-0.5, 0.0, 0.0, 0.3])
    for speed, share, state in ((still, 0.0, "held"), (still, 1.0, "empty"), (some, 0.0, "slipping"), (away, 0.0, "slipping"),
                                (some, 0.6, "slipping"), (0.02 * some, 0.0, "held")):
        right = 0
        for seed in range(50):
            rows = watched(speed, share, seed=seed)
            right += check_hold(EXPECTED, rows[-1], watched=rows).state == state
        assert right == 50, (speed, share)
    rows = watched(some)
    assert check_hold(EXPECTED, rows[-1]).state == "held"  # at one moment nothing shows it
    assert check_hold(EXPECTED, rows[-1], watched=rows, seconds=20.0).state == "held"  # as slow as that


def test_exact_encoders_and_many_joints_do_not_overflow() -> None:
    rows = watched(np.full(4, 1e4), noise=0.0) + 1e3 * EXPECTED.unit  # about where the object is held
    found = check_hold(EXPECTED, rows[-1], watched=rows)
    assert found.state == "slipping"
    assert sum(found.probabilities.values()) == pytest.approx(1)
    rows = watched(np.zeros(4), noise=0.0)
    assert check_hold(EXPECTED, rows[-1], watched=rows).state == "held"


def test_the_more_open_hand_holds_something_larger() -> None:
    larger = between(-0.5)
    assert check_hold(EXPECTED, larger).state == "held"
    assert check_hold(EXPECTED, larger, before=larger).state == "held"


def test_joints_that_end_at_the_same_place_say_little_and_efforts_decide() -> None:
    blind = HoldExpectation(
        EXPECTED.held_joints, EXPECTED.held_efforts, EXPECTED.held_joints + 1e-3 * EXPECTED.unit, np.zeros(4), EXPECTED.unit)
    assert check_hold(blind, blind.held_joints).confidence < 0.6
    assert check_hold(blind, blind.held_joints, blind.held_efforts).state == "held"
    pressing = check_hold(blind, blind.held_joints, blind.held_efforts)
    idle = check_hold(blind, blind.held_joints, np.zeros(4))
    assert (pressing.state, idle.state) == ("held", "empty")
    assert min(pressing.confidence, idle.confidence) > 0.9


def test_a_sliding_joint_counts_by_its_own_unit() -> None:
    """Two centimetres are a long way for a jaw, and nothing in radians."""
    jaw = HoldExpectation(np.array([0.02]), np.array([20.0]), np.array([0.0]), np.array([0.0]), np.array([0.05]))
    assert check_hold(jaw, [0.019]).state == "held"
    assert check_hold(jaw, [0.0]).state == "empty"
    assert check_hold(jaw, [0.0]).confidence > 0.9


def test_measurements_that_do_not_fit_are_refused() -> None:
    for wrong in ([0.5, 0.6], [0.5, 0.6, 0.4, float("nan")], "open", [[0.5, 0.6, 0.4, 0.02]]):
        with pytest.raises(OptionError, match="hand's 4 joints"):
            check_hold(EXPECTED, wrong)
        with pytest.raises(OptionError, match=r"measured_efforts.*hand's 4 joints"):
            check_hold(EXPECTED, EXPECTED.held_joints, wrong)
    for wrong in ([0.5, 0.6, 0.4, 0.02], np.zeros((3, 4)), np.zeros((11, 3)), np.full((11, 4), np.nan), [["a"]]):
        with pytest.raises(OptionError, match="watched"):
            check_hold(EXPECTED, EXPECTED.held_joints, watched=wrong)
    with pytest.raises(OptionError, match="a time above 0"):
        check_hold(EXPECTED, EXPECTED.held_joints, watched=np.zeros((11, 4)), seconds=0.0)
    for settings in ({"encoder": 0.0}, {"slide": 0.0}, {"share": 1.0}, {"spread": -1.0}, {"slack": 0.0},
                     {"scale": 0.0}, {"heavy": float("inf")}, {"doubt": 1.0}, {"priors": (1.0, 0.0, 0.0)}):
        with pytest.raises(OptionError, match="give"):
            HoldConfig(**settings)


def test_a_slip_that_has_just_begun_is_seen_and_rest_is_not_taken_for_one() -> None:
    """Three joints that move on by 0.03 rad in the last 60 ms, of 0.2 s that are watched at 100 Hz, 3 mrad of noise."""
    time, right = np.linspace(0, 0.2, 21)[:, None], {"slipping": 0, "held": 0}
    for seed in range(100):
        noise = 0.003 * np.random.default_rng(seed).normal(size=(21, 4))
        for state, far in (("slipping", 0.03), ("held", 0.0)):
            way = far * np.maximum(time - 0.14, 0) / 0.06 * np.array([1.0, -1.0, 1.0, 0.0])
            rows = EXPECTED.held_joints + EXPECTED.unit * (way + noise)
            right[state] += check_hold(EXPECTED, rows[-1], watched=rows).state == state
    assert min(right.values()) >= 98, right


def test_fingers_that_stop_far_from_both_places_hold_something() -> None:
    """The object stands a few millimetres off where the plan has it; nobody knows which way."""
    near = HoldExpectation(
        EXPECTED.held_joints, np.zeros(4), EXPECTED.held_joints + 0.01 * EXPECTED.unit, np.zeros(4), EXPECTED.unit)
    for side in (-1.0, 1.0):
        check = check_hold(near, near.held_joints + side * np.array([0.1, 0.08, 0.0, 0.0]))
        assert (check.state, check.confidence > 0.9) == ("held", True), side


def test_the_load_decides_where_joints_say_nothing_and_the_object_is_heavy() -> None:
    blind = HoldExpectation(EXPECTED.held_joints, np.zeros(4), EXPECTED.held_joints, np.zeros(4), EXPECTED.unit, weight=5.0)
    for load, state in ((5.0, "held"), (3.0, "held"), (40.0, "held"), (0.0, "empty"), (-0.5, "empty")):
        check = check_hold(blind, blind.held_joints, load=load)
        assert (check.state, check.confidence > 0.85) == (state, True), load
    light = HoldExpectation(EXPECTED.held_joints, np.zeros(4), EXPECTED.held_joints, np.zeros(4), EXPECTED.unit, weight=0.1)
    assert check_hold(light, light.held_joints, load=0.1).confidence < 0.6, "sensors do not feel 10 g"
    assert check_hold(light, light.held_joints, load=0.1, config=HoldConfig(scale=0.01)).state == "held"
    for expected, load in ((EXPECTED, 1.0), (blind, float("nan"))):
        with pytest.raises(OptionError, match="how heavy the object is"):
            check_hold(expected, expected.held_joints, load=load)


def test_a_load_counts_as_a_gaussian_of_known_spreads() -> None:
    """The odds of held and empty by hand: joints say nothing, and the spread of the weight adds to that of the sensor."""
    blind = HoldExpectation(EXPECTED.held_joints, np.zeros(4), EXPECTED.held_joints, np.zeros(4), EXPECTED.unit, weight=2.0)
    config = HoldConfig(scale=0.5, heavy=0.6, doubt=1e-12)
    for load in (0.3, 0.9, 1.6):
        found = check_hold(blind, blind.held_joints, load=load, config=config).probabilities
        odds = norm.logpdf(load, 2.0, np.hypot(0.5, 0.6 * 2.0)) - norm.logpdf(load, 0.0, 0.5)
        assert np.log(found["held"] / found["empty"]) == pytest.approx(odds, abs=1e-6)


def test_moving_joints_are_judged_as_gaussian_processes() -> None:
    """The odds of slipping and held by SciPy's normal density, for one joint."""
    one = HoldExpectation(np.array([0.5]), np.zeros(1), np.array([0.9]), np.zeros(1), np.ones(1))
    rng, time, config = np.random.default_rng(1), np.linspace(-0.1, 0.1, 21), HoldConfig(doubt=1e-12)
    rows = 0.5 + 0.05 * np.maximum(time, 0) + 0.002 * rng.normal(size=21)
    noise = np.sqrt((np.diff(rows, 2) ** 2).mean() / 6)
    still = noise**2 * np.eye(21) + config.creep**2 * np.outer(time, time)
    ratios = []
    for onset in (0.0, 0.25, 0.5, 0.7, 0.85):
        way = np.maximum(np.linspace(0, 1, 21) - onset, 0) / (1 - onset) * 0.2
        way -= way.mean()
        moving = multivariate_normal.logpdf(rows - rows.mean(), cov=still + config.slide**2 * np.outer(way, way))
        ratio = np.exp(moving - multivariate_normal.logpdf(rows - rows.mean(), cov=still))
        ratios.append(1 - config.share + config.share * ratio)
    found = check_hold(one, rows[-1:], watched=rows[:, None], seconds=0.2, config=config).probabilities
    prior = np.log(config.priors[2] / config.priors[0])
    assert np.log(found["slipping"] / found["held"]) == pytest.approx(prior + np.log(np.mean(ratios)), abs=1e-6)


def test_nothing_is_surer_than_doubt_allows() -> None:
    check = check_hold(EXPECTED, between(0.0), EXPECTED.held_efforts, config=HoldConfig(doubt=0.3))
    assert check.confidence == pytest.approx(0.7 + 0.3 / 4, abs=1e-3)
    assert sum(check.probabilities.values()) == pytest.approx(1)
