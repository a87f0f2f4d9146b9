"""Held, empty or slipping, by joints of which everything is known."""

from __future__ import annotations

import numpy as np
import pytest

from dro_grasp.errors import OptionError
from dro_grasp.grasps.hold import HoldConfig, HoldExpectation, check_hold

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
    rows = watched(np.full(4, 1e4), noise=0.0)
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
    for settings in ({"encoder": 0.0}, {"slide": 0.0}, {"share": 1.0}, {"spread": -1.0}, {"priors": (1.0, 0.0, 0.0)}):
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
