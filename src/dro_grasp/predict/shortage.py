"""Why fewer grasps are returned than were asked for, in words, from what is known of hand, object and candidates. Ours."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float

from dro_grasp.geometry import se3
from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.geometry.point_clouds import even_directions
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.scenery import Scene
from dro_grasp.predict.admission import PLANE, dropped_in_words
from dro_grasp.predict.finish import Finished
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import GIVES_WAY, HARSH
from dro_grasp.simulation.protocols import CARRY

POSTURES = 17  # Postures from open to closed in which fingertips are compared (ours)
LINES = 400  # Directions along which an object is measured (ours)
ACROSS = 0.2  # Largest cosine between a direction and those that count as across it (ours)
LEAST_LEVER = 1e-3  # Joints with a shorter lever do not bend the finger [m] (ours)
HALF = 0.5  # Openness in which the force of fingertips is looked at (ours)


@dataclass(frozen=True)
class Misfit:
    """Why a hand can hardly hold an object."""

    fact: str
    """In words, with numbers."""
    remedy: str
    """What would help."""


def shortage_in_words(problem: GraspProblem, asked: int, done: Finished | None, alone: bool) -> str:
    """How many grasps there are, what candidates were dropped for, and what to do.

    Args:
        problem: With its constraints.
        asked: Grasps that were asked for.
        done: What there is; None for nothing.
        alone: Whether one source alone was asked for.
    """
    tally = Tally() if done is None else Tally(
        int(done.trusted.sum()), done.made, done.dropped, done.doubted, done.config.least_confidence,
        done.made - sum(done.dropped.values()) - len(done.pool))
    return tally.in_words(problem, asked, alone)


@dataclass(frozen=True)
class Tally:
    """What became of candidates."""

    found: int = 0
    """Grasps that there are."""
    made: int = 0
    """Candidates that were made."""
    dropped: Mapping[str, int] = field(default_factory=dict)
    """Candidates that the constraints rejected, by reason."""
    doubted: Mapping[str, int] = field(default_factory=dict)
    """Candidates below the least confidence, by what closing showed against them."""
    least_confidence: float = 0.0
    """What was demanded of them."""
    unsettled: int = 0
    """Candidates that ranked too low to be closed in simulation."""

    def in_words(self, problem: GraspProblem, asked: int, alone: bool) -> str:
        """As `shortage_in_words`."""
        doubted, misfits = sum(self.doubted.values()), []
        if doubted:
            misfits = list(find_misfits(problem))
        steps = [*dict.fromkeys(misfit.remedy for misfit in misfits)]
        if not steps:
            steps.append("try another seed")
        steps += firmer(problem) if self.doubted.get(GIVES_WAY) or self.doubted.get(HARSH) else []
        steps += advice(problem, self.dropped) + (["use the source 'auto'"] if alone else [])
        if doubted:
            steps.append("see the doubtful ones with least_confidence=0")
        told = (f"only {self.found} of {self.made} candidates on object '{problem.obj.name}' meet what was asked of them"
                f"{dropped_in_words(self.dropped)}; {asked} were asked for. ")
        if doubted:
            told += (f"{doubted} hold with a probability below {100 * self.least_confidence:.0f} %"
                     f"{dropped_in_words(self._fates(), 'fingers ')}. ")
        if self.unsettled:
            told += f"The {self.unsettled} that ranked lowest were not closed in simulation. "
        told += "".join(f"{misfit.fact}. " for misfit in misfits)
        last = "; or ".join(steps)
        return told + last[0].upper() + last[1:]

    def _fates(self) -> dict[str, int]:
        """What closing showed, the most frequent first."""
        return {why: count for why, count in Counter(self.doubted).most_common() if why}


def advice(problem: GraspProblem, dropped: Mapping[str, int]) -> list[str]:
    """Which constraints to relax."""
    constraints, low, high = problem.constraints, *problem.height_range
    steps = {
        "table": f"lower table (now {_short(constraints.table)} m; the object spans z = {low:.3f} to {high:.3f} m)",
        "max_tilt": f"widen max_tilt (now {_short(constraints.max_tilt)} rad)",
        "direction": "leave out direction, or give another one",
        "obstacles": _room(constraints.obstacles),
        "contact_region": "enlarge the balls of contact_region",
        "keep_out": "make the balls of keep_out smaller",
        "pregrasp_clearance": f"ask for less pregrasp_clearance (now {_short(constraints.pregrasp_clearance)} m)",
    }
    asked = [name for name in steps if getattr(constraints, name) not in (None, ()) and name not in problem.fixed]
    given = [steps[name] for name in asked]
    if constraints.table is None and dropped.get(PLANE):
        given.append("state the table's height if it is lower than the one found in the cloud")
    return given


def firmer(problem: GraspProblem) -> list[str]:
    """Which limits of forces to relax where grasps give way."""
    margin, most = problem.constraints.margin, problem.constraints.max_force
    return ([f"allow more max_force (now {_short(most)} N)"] if most is not None else []) + (
        [f"ask for a smaller margin (now {_short(margin)})"] if margin is not None else [])


def _room(obstacles: Scene | None) -> str:
    """What gives room among obstacles: those that were given may lie elsewhere, those of the object's scene do not."""
    given = obstacles is not None and any(part.sight is not None or part.faces is not None for part in obstacles.parts)
    return ("check that obstacles is in the object's frame, and leave out what may be touched" if given else
            "make room around the object, or check in a picture of its scene that nothing of it counts as an obstacle")


def _short(value: float | None) -> str:
    """A length or an angle to a thousandth."""
    return "not given" if value is None else f"{round(float(value), 3) + 0.0:g}"


def find_misfits(problem: GraspProblem) -> Iterator[Misfit]:
    """What makes the pair hopeless by its measures: too wide, too thin, or too heavy; nothing where it fits."""
    hand, opening, gap = problem.hand, *fingertip_range(problem.hand)
    cloud = problem.obj.cloud
    lines = np.concatenate([even_directions(LINES).numpy(), np.eye(3, dtype=np.float32), principal_axes(cloud)])
    widths = np.ptp(cloud @ lines.T, axis=0)
    narrow, middle = float(widths.min()), sorted(np.ptp(cloud @ principal_axes(cloud).T, axis=0).tolist())[1]
    across = widths if problem.constraints.direction is None else widths[_across(lines, problem.constraints.direction)]
    if narrow > opening:
        yield Misfit(f"The object is {_cm(narrow)} wide where it is narrowest, and '{hand.name}' opens {_cm(opening)} at its "
                     "fingertips", "take a larger hand, or check the object's unit (scale=...)")
    elif float(across.min()) > opening:
        yield Misfit(f"Seen from this direction the object is {_cm(float(across.min()))} wide, too much to pinch it from two "
                     f"sides: '{hand.name}' opens {_cm(opening)} at its fingertips",
                     "grasp from another direction (direction=...)")
    if middle < gap:
        yield Misfit(f"The object is {_cm(middle)} thick, and the fingertips of '{hand.name}' come no nearer to each other "
                     f"than {_cm(gap)}", "take a smaller hand, or check the object's unit (scale=...)")
    weight, held = problem.mass * GRAVITY, CARRY.friction * fingertip_forces(hand)
    if weight > held:
        yield Misfit(f"The object weighs {weight:.3g} N ({problem.mass:.3g} kg), and the fingertips of '{hand.name}' hold no "
                     f"more than {held:.2g} N by friction", "take a stronger hand, or state the object's mass if it is less")


def _cm(length: float) -> str:
    return f"{1e2 * length:.1f} cm"


def _across(lines: Float[np.ndarray, "n 3"], direction: tuple[float, float, float]) -> Bool[np.ndarray, " n"]:
    """Which lines a hand that comes along a direction closes along."""
    return np.abs(lines @ np.array(direction) / np.linalg.norm(direction)) < ACROSS


def principal_axes(points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "3 3"]:
    """Axes along which points spread most and least, in rows."""
    return np.linalg.svd(points - points.mean(0), full_matrices=False)[2]


def fingertip_range(hand: Hand) -> tuple[float, float]:
    """Largest and least distance between the surfaces of two fingertips [m]: of the open hand, and on the way to closed.

    A hand of one finger, which closes against its palm, has no limits.
    """
    if len(hand.tips) < 2:
        return float("inf"), 0.0
    widest, least = 0.0, float("inf")
    for openness in torch.linspace(1, 0, POSTURES).tolist():
        points = hand.points(hand.canonical_joints(openness))
        tips = [points[hand.link_index == tip] for tip in hand.tips]
        apart = [float(torch.cdist(a, b).min()) for i, a in enumerate(tips) for b in tips[:i]]
        if openness == 1:
            widest = max(apart)
        least = min(least, *apart)
    return widest, least


def fingertip_forces(hand: Hand) -> float:
    """Sum of the forces with which fingertips press, each as far as its weakest joint lets it [N].

    Fingers that one joint bends share its effort.
    """
    tree, q = hand.tree, hand.canonical_joints(HALF)
    tips, poses = torch.tensor(hand.tips), tree.forward(q)
    points = se3.apply(poses[tips], hand.tip_offsets)
    lever = tree.point_jacobian(poses, points, tips).norm(dim=-2)
    bends = hand.movable & ~hand.abduction & (lever > LEAST_LEVER)
    share = find_efforts(hand).limit / bends.sum(0).clamp_min(1)
    force = torch.where(bends, share / lever.clamp_min(LEAST_LEVER), torch.inf).amin(1)
    return float(force[force.isfinite()].sum())
