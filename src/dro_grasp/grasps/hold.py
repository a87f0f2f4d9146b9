"""Did it hold? What a robot's joints say after the hand has closed and lifted: held, empty, slipping, or unexpected.

Fingers that close on an object stop where it is, and press; fingers that close on nothing go on to their targets. Both ends are
known from closings in simulation (`expect_hold`). Fingers from which an object slips move while it does, and only then: whoever
watches them for a fifth of a second sees it, unless the object slides along fingers that rest. Joints that are far from all of
this say nothing of the object: the hand has not closed, encoders fail, or numbers are in other units. One wrong joint of many
is not told: objects push single fingers aside as far. Ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import HOLD_COLUMNS, WEIGHT_COLUMN
from dro_grasp.kinds import Checked

HoldState = Literal["held", "empty", "slipping", "unexpected"]
STATES: tuple[HoldState, ...] = ("held", "empty", "slipping", "unexpected")
"""In the order of HoldConfig.priors; the last has the probability of its doubt."""
STEPS = 10  # Shares of the way that are tried for a slipping object (ours)
ONSETS = (0.0, 0.25, 0.5, 0.7, 0.85)  # Shares of the watched time after which a slip may begin (ours)
FEWEST = 4  # Fewest rows of joints that show how fast they move (ours)
MOST = 50.0  # Largest log-likelihood ratio of one joint that moves, and of all (ours)
STEADY = 1e-3  # Least noise of encoders [rad, or a share of a sliding joint's unit] (ours): no number is exact
SPREADS = ("encoder", "sensor", "spread", "slack", "anywhere", "creep", "slide", "scale", "heavy")  # Of HoldConfig


@dataclass(frozen=True, eq=False)
class HoldExpectation:
    """Where independent joints should be once the hand has squeezed, and what they should exert."""

    held_joints: Float[np.ndarray, " n_dof"]
    """With the object in the hand [rad or m]."""
    held_efforts: Float[np.ndarray, " n_dof"]
    """Likewise [Nm or N]."""
    empty_joints: Float[np.ndarray, " n_dof"]
    """With nothing in the hand [rad or m]."""
    empty_efforts: Float[np.ndarray, " n_dof"]
    """Likewise [Nm or N]."""
    unit: Float[np.ndarray, " n_dof"]
    """What counts as a radian: 1, or a length where a joint slides [m]."""
    weight: float | None = None
    """Of the object [N]; None where nobody knows."""

    @property
    def ends(self) -> dict[str, tuple[Float[np.ndarray, " n_dof"], Float[np.ndarray, " n_dof"]]]:
        """Joints and efforts of both, by the names that files give them."""
        return {"held": (self.held_joints, self.held_efforts), "empty": (self.empty_joints, self.empty_efforts)}

    @staticmethod
    def of(grasps: GraspBatch, index: int) -> HoldExpectation | None:
        """Those of one grasp; None where `expect_hold` has not been asked.

        Raises:
            OptionError: There is no grasp of this index.
        """
        if not -len(grasps) <= index < len(grasps):
            raise OptionError(
                f"index is {index}; give one from {-len(grasps)} to {len(grasps) - 1}: the batch has {len(grasps)} grasps")
        if not all(name in grasps.extra for name in HOLD_COLUMNS):
            return None
        values = [grasps.extra[name][index] for name in HOLD_COLUMNS]
        if any(value is None for value in values):
            return None
        rows = [np.asarray(value, np.float64) for value in values]
        weight = float(grasps.extra[WEIGHT_COLUMN][index]) if WEIGHT_COLUMN in grasps.extra else math.nan
        known = weight if math.isfinite(weight) else None
        return HoldExpectation(*rows, weight=known) if all(np.isfinite(row).all() for row in rows) else None


@dataclass(frozen=True)
class HoldConfig(Checked):
    """How far measurements may be from what is expected. Values are ours, from closings of training objects."""

    encoder: float = 0.02
    """Standard deviation of measured joints, and of where an empty hand stops [rad, or a share of a sliding joint's unit]."""
    sensor: float = 0.3
    """Standard deviation of measured efforts, as a share of the largest expected one; nobody knows servos exactly [1]."""
    spread: float = 0.25
    """Standard deviation of where fingers stop on the object, as a share of the way from there to where an empty hand does."""
    slack: float = 0.02
    """The same where there is no way: the object stands some millimetres off [rad, or likewise]."""
    anywhere: float = 4.0
    """Width of the range in which joints are of which nothing is known [rad, or likewise]."""
    slip: tuple[float, float] = (0.15, 0.9)
    """Shares of the way from where they were to the empty hand's joints that fingers have gone when an object slips [1]."""
    unsure: float = 0.5
    """The least such share where nobody measured before: fingers that hold may stop as far from the expected place [1]."""
    priors: tuple[float, float, float] = (0.48, 0.48, 0.04)
    """Probabilities of held, empty and slipping before anything is measured."""
    creep: float = 0.018
    """Standard deviation of how fast joints move of a hand that holds [rad/s, or likewise]."""
    slide: float = 0.08
    """The same of joints that move because an object slips."""
    share: float = 0.8
    """Share of the joints that do."""
    doubt: float = 0.02
    """Probability that joints are unexpected, and that none of this is true, and all states are as likely."""
    scale: float = 0.6
    """Standard deviation of measured loads [N]. Source: ten weighings with a wrist sensor (forum.universal-robots.com, thread
    229); sensors inside arms are six times worse."""
    heavy: float = 0.4
    """Standard deviation of the object's weight, as a share of what is expected [1]."""

    def __post_init__(self) -> None:
        """Refuse what is no spread and no probability.

        Raises:
            OptionError: A spread is not above 0, or a probability not between 0 and 1.
        """
        super().__post_init__()
        if not all(0 < size < math.inf for size in (getattr(self, name) for name in SPREADS)):
            raise OptionError(f"{', '.join(f'{name} is {getattr(self, name)}' for name in SPREADS)}; give numbers above 0")
        if not all(0 < prior < 1 for prior in (*self.priors, self.share, self.doubt)):
            raise OptionError(f"priors are {self.priors}, share is {self.share} and doubt is {self.doubt}; give "
                              "probabilities between 0 and 1")


@dataclass(frozen=True)
class HoldCheck:
    """What the joints say."""

    state: HoldState
    """The most probable state: *held* is what rests in the hand, *slipping* what has left its place by a centimetre or more and
    goes on at 2 cm/s or more; *empty* is a hand that has closed on nothing; *unexpected* are joints that fit none of these."""
    confidence: float
    """Its probability."""
    probabilities: dict[str, float]
    """Those of all states."""


def check_hold(
    expected: HoldExpectation | None, measured_joints: ArrayLike, measured_efforts: ArrayLike | None = None, *,
    before: ArrayLike | None = None, watched: ArrayLike | None = None, seconds: float = 0.2, load: float | None = None,
    config: HoldConfig | None = None,
) -> HoldCheck:
    """Compare measured joints, and efforts if there are any, with those that are expected with the object and without.

    Measure after the lift, best for a fifth of a second (`watched`). Where joints end at the same place with the object and
    without, the confidence is low, and efforts or a load are needed. Slow motion of the object is neither held nor slipping. An
    unexpected hand is open, broken, or measured in other units: look at it. Of many joints, one that is wrong is not told.

    Args:
        expected: What to expect, of a plan (`MotionPlan.hold`) or of grasps (`HoldExpectation.of`).
        measured_joints: Independent joints of the hand, in its order, (n_dof) [rad or m].
        measured_efforts: What they exert, likewise [Nm or N], positive toward larger values.
        before: Joints as they were measured while the object was held, likewise: how they moved since shows that it slips.
            Where they are unexpected themselves, so is what came of them.
        watched: Joints that were measured one after the other at even times while nothing was commanded, up to now,
            (k, n_dof), 4 rows at least: that they move shows that it slips. Where they are is their mean.
        seconds: Time from the first to the last of these [s].
        load: How much more the wrist carries than before the hand closed [N], for which the object's weight has to be expected.
        config: Spreads.

    Raises:
        OptionError: Nothing is expected; measurements have another shape, or are not finite; a load is given, and no weight is
            expected.
    """
    if expected is None:
        raise OptionError("nothing is expected of these grasps; let `expect_hold` find it first")
    config, size = config or HoldConfig(), len(expected.held_joints)
    joints, held = _measured("measured_joints", measured_joints, size), expected.held_joints
    noise, start = config.encoder * expected.unit, None if before is None else _measured("before", before, size)
    rows = None if watched is None else _rows(watched, seconds, size)
    joints = joints if rows is None else rows.mean(0)
    slack = config.slack * expected.unit
    total = _log_likelihoods(joints, held, expected.empty_joints, noise, slack, start, config)
    other = _anywhere(expected.unit, config)
    if start is not None:
        other += _anywhere(expected.unit, config)
        total = total + _log_likelihoods(start, held, expected.empty_joints, noise, slack, None, config)[0]
    if measured_efforts is not None:
        efforts = _measured("measured_efforts", measured_efforts, size)
        noise = np.full(size, config.sensor * max(float(np.abs(expected.held_efforts).max()), 1e-9))
        told = _log_likelihoods(efforts, expected.held_efforts, expected.empty_efforts, noise, 0 * noise, None, config)
        total, other = total + told, other + float(told.max())
    if load is not None:
        told = _weighed(load, expected.weight, len(total), config)
        total, other = total + told, other + float(told[2])
    slipping = float(np.logaddexp.reduce(total[2:])) - math.log(len(total) - 2)
    if rows is not None:  # where fingers are says little then: a slip begins where the object is held
        slipping = float(max(total[0], total[1])) + min(MOST, _moves(rows / expected.unit, seconds, config))
    odds = np.array([total[0], total[1], slipping, other]) + np.log([*config.priors, config.doubt])
    likely = np.exp(odds - np.logaddexp.reduce(odds))
    chances = ((1 - config.doubt) * likely + config.doubt / len(STATES)).tolist()
    best = max(range(len(STATES)), key=chances.__getitem__)
    return HoldCheck(STATES[best], chances[best], dict(zip(STATES, chances, strict=True)))


def _measured(name: str, given: ArrayLike, size: int) -> Float[np.ndarray, " n_dof"]:
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{name} is no row of numbers ({error}); give one for each of the hand's {size} joints") from error
    if values.shape != (size,) or not np.isfinite(values).all():
        raise OptionError(f"{name} is {values.tolist()}; give one finite number for each of the hand's {size} joints")
    return values


def _rows(watched: ArrayLike, seconds: float, size: int) -> Float[np.ndarray, "k n_dof"]:
    try:
        rows = np.asarray(watched, np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"watched is no table of numbers ({error}); give a row of joints for each time") from error
    fits = rows.ndim == 2 and len(rows) >= FEWEST and rows.shape[1] == size
    if not (fits and np.isfinite(rows).all() and 0 < seconds < math.inf):
        raise OptionError(f"watched has shape {rows.shape} over {seconds} s; give at least {FEWEST} rows, each of one finite "
                          f"number for each of the hand's {size} joints, and a time above 0")
    return rows


def _weighed(load: float, weight: float | None, count: int, config: HoldConfig) -> Float[np.ndarray, " k"]:
    """Log-likelihoods of a load [N] if the object is held, if it is gone, and, in all further rows, if either may be true."""
    if weight is None or not (math.isfinite(load) and weight > 0):
        raise OptionError(f"load is {load} N where the object should weigh {weight} N; give a finite load, and what says how "
                          "heavy the object is (plans and `expect_hold` do)")
    loose = math.hypot(config.scale, config.heavy * weight)
    carried = min(load, weight)  # what weighs more than it should is there
    here = -((carried - weight) / loose) ** 2 / 2 - math.log(loose)
    gone = -(carried / config.scale) ** 2 / 2 - math.log(config.scale)
    either = float(np.logaddexp(here, gone)) - math.log(2)
    return np.array([here, gone, *[either] * (count - 2)])


def _moves(rows: Float[np.ndarray, "k n_dof"], seconds: float, config: HoldConfig) -> float:
    """Log-likelihood ratio of joints that a slipping object moves, to those that rest or creep, from rows at even times.

    All creep evenly. What slips begins to do so at one of ONSETS. Speeds are means over the whole time.
    """
    rows = rows - rows.mean(0)
    noise = max(STEADY, math.sqrt(float((np.diff(rows, 2, axis=0) ** 2).mean()) / 6))  # what is not smooth
    onsets = np.array(ONSETS)[:, None]
    ways = np.maximum(np.linspace(0, 1, len(rows)) - onsets, 0) * seconds / (1 - onsets)  # as far as in the whole time
    ways -= ways.mean(1, keepdims=True)
    even = np.linspace(-seconds / 2, seconds / 2, len(rows))
    still = noise**2 * np.eye(len(rows)) + config.creep**2 * np.outer(even, even)
    ratio = np.stack([_gaussian(rows, still + config.slide**2 * np.outer(way, way)) for way in ways]) - _gaussian(rows, still)
    each = np.log1p(config.share * np.expm1(np.minimum(ratio, MOST))).sum(1)
    return float(np.logaddexp.reduce(each)) - math.log(len(ONSETS))


def _gaussian(columns: Float[np.ndarray, "k n"], covariance: Float[np.ndarray, "k k"]) -> Float[np.ndarray, " n"]:
    """Log-likelihood of each column, but for a constant."""
    root = np.linalg.cholesky(covariance)
    return -(np.linalg.solve(root, columns) ** 2).sum(0) / 2 - np.log(np.diag(root)).sum()


def _anywhere(unit: Float[np.ndarray, " n"], config: HoldConfig) -> float:
    """Log-likelihood of joints that may be anywhere, as `_log_likelihoods` has it: but for a constant of each joint."""
    return float((math.log(2 * math.pi) / 2 - np.log(config.anywhere * unit)).sum())


def _log_likelihoods(
    measured: Float[np.ndarray, " n"], held: Float[np.ndarray, " n"], empty: Float[np.ndarray, " n"],
    noise: Float[np.ndarray, " n"], slack: Float[np.ndarray, " n"], before: Float[np.ndarray, " n"] | None, config: HoldConfig,
) -> Float[np.ndarray, " k"]:
    """Of held, of empty, and of slipping by some shares of the way, from rows of one number for each joint.

    Fingers that hold stop each by itself, some way off the expected place, and stay there; those of an empty hand are where
    they should be; and those from which an object slips have gone some way together.
    """
    start = held if before is None else before
    way = empty - start
    moving = np.hypot(noise, config.spread / 2 * way)
    first, last = config.slip
    shares = np.linspace(max(first, config.unsure) if before is None else first, last, STEPS)
    places = [(empty, noise), *((start + share * way, moving) for share in shares)]
    if before is None:
        close = np.hypot(noise, config.spread * way)
        places += [(held, close), (held, np.hypot(close, slack))]
    else:
        places += [(start, np.hypot(math.sqrt(2) * noise, 0.1 * way))]
    errors, spreads = (np.stack(rows) for rows in zip(*((measured - place, spread) for place, spread in places), strict=True))
    likely = -((errors / spreads) ** 2 / 2 + np.log(spreads)).sum(1)
    return np.array([likely[1 + STEPS:].max(), *likely[:1 + STEPS]])
