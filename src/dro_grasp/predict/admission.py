"""Which grasps respect the constraints of a problem, and why the others do not."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.anatomy import PALM
from dro_grasp.kinds import Checked
from dro_grasp.optimize.grasp_energy import PRESSED, Surroundings
from dro_grasp.optimize.squeeze import GripConfig
from dro_grasp.optimize.starts import APPROACH, angle_to_arc
from dro_grasp.predict.problem import GraspProblem

APPROACH_CHECKS = 9  # Places on the approach at which the hand is checked, both ends included (ours)
OPENING_STEPS = 9  # Steps in which a pregrasp opens (ours)
# The texts of reasons are stored in plans and told in JSON, so they stay when a word of ours changes.
PLANE = "in the table"  # The hand, or its approach, is below the table
OBSTACLES = "in the scene to avoid"  # It meets what stands around the object
SPARED = "in a place to spare"  # It meets a keep-out ball
TURNED = "turned away"  # The palm tilts farther than `max_tilt` from the wanted direction
BESIDE = "touching beside the place to hold"  # The hand touches the object elsewhere too, or with fewer than two fingers there
NARROW = "too close in pregrasp"  # The hand opens less than was asked for
REASONS = {"plane": PLANE, "obstacles": OBSTACLES, "keep_out": SPARED}  # Reason by part of the surroundings


@dataclass(frozen=True)
class AdmissionConfig(Checked):
    """By how much grasps may miss what the constraints ask (ours)."""

    least_clearance: float = 0.002
    """Least distance of a hand's surface points to its surroundings [m]; its corners come up to 2 mm nearer."""
    least_tip_height: float = -0.001
    """The same of fingertips that may touch the table. They are told to squeeze up to PRESSED below it."""
    touch: float = 0.003
    """Distance at which a hand touches the object [m]: refined grasps keep 1 mm off it."""
    fewest_fingers: int = 2
    """Fingers that touch the contact region, at least."""
    reach: float = GripConfig.reach
    """Distance up to which they count as touching [m]: as where forces are balanced."""


def feasible(problem: GraspProblem, grasps: GraspBatch, config: AdmissionConfig | None = None) -> Bool[Tensor, " n"]:
    """Which complete grasps respect the problem's constraints."""
    kept = torch.ones(len(grasps), dtype=torch.bool)
    if not len(grasps):
        return kept
    for wrong in violations(problem, grasps, config, apart=False).values():
        kept &= ~wrong
    return kept


def count_violations(
    problem: GraspProblem, grasps: GraspBatch, config: AdmissionConfig | None = None
) -> Counter[str]:
    """How many complete grasps do not respect the constraints, by the first reason."""
    counted: Counter[str] = Counter()
    left = torch.ones(len(grasps), dtype=torch.bool)
    if not len(grasps):
        return counted
    for reason, wrong in violations(problem, grasps, config).items():
        counted[reason] += int((wrong & left).sum())
        left &= ~wrong
    return +counted


def violations(
    problem: GraspProblem, grasps: GraspBatch, config: AdmissionConfig | None = None, apart: bool = True
) -> dict[str, Bool[Tensor, " n"]]:
    """Which complete grasps do not respect the constraints, by reason; with `apart`, table, obstacles and keep-outs apart."""
    found, constraints, config = {}, problem.constraints, config or AdmissionConfig()
    if problem.surroundings is not None:
        parts = problem.surroundings.parts if apart else {"obstacles": problem.surroundings}
        found = {REASONS[name]: ~clear(problem, grasps, part, config) for name, part in parts.items()}
    if constraints.max_tilt is not None:
        found[TURNED] = ~facing(problem, grasps)
    if constraints.contact_region:
        found[BESIDE] = ~holds_in_place(problem, grasps, config)
    if constraints.pregrasp_clearance is not None:
        found[NARROW] = finger_gap(problem, grasps.T_object_wrist, grasps.pregrasp_joints) < constraints.pregrasp_clearance
    return found


def facing(problem: GraspProblem, grasps: GraspBatch, farthest: float = math.inf) -> Bool[Tensor, " n"]:
    """Which grasps have palms that tilt no farther than allowed, or within an angle of the wanted direction [rad].

    Over a plane, those count too that tilt towards it.
    """
    direction, max_tilt, surroundings = problem.constraints.direction, problem.constraints.max_tilt, problem.surroundings
    if direction is None:
        return torch.ones(len(grasps), dtype=torch.bool)
    palm = problem.hand.palm_directions(grasps.T_object_wrist)
    wanted = torch.nn.functional.normalize(torch.tensor(direction, dtype=palm.dtype), dim=0)
    if max_tilt is not None:
        return angle_to_arc(palm, wanted, None) <= max_tilt
    up = None if surroundings is None else surroundings.up
    return angle_to_arc(palm, wanted, None if up is None else up.to(palm)) < farthest


def clear(
    problem: GraspProblem, grasps: GraspBatch, surroundings: Surroundings, config: AdmissionConfig | None = None
) -> Bool[Tensor, " n"]:
    """Which complete grasps keep the hand out of surroundings.

    The hand is fully open 10 cm back along the palm direction, comes straight in pregrasp, grasps and squeezes.
    """
    near, hand, config = problem.clearance, problem.hand, config or AdmissionConfig()
    leave = config.least_clearance - config.least_tip_height
    assert near is not None
    T = grasps.T_object_wrist
    back = torch.zeros_like(T)
    back[:, :3, 3] = -APPROACH * hand.palm_directions(T)
    opened = hand.canonical_joints(1.0).expand_as(grasps.joints)
    postures = [(T, grasps.joints, leave), (T, grasps.squeeze_joints, leave + PRESSED), (T + back, opened, leave)]
    postures += [(T + share * back, grasps.pregrasp_joints, leave) for share in torch.linspace(0, 1, APPROACH_CHECKS).tolist()]
    closest = torch.full((len(T),), torch.inf)
    for pose, q, lower in postures:
        distance = near.distance(pose.to(problem.device), q.to(problem.device), surroundings, lower)
        closest = torch.minimum(closest, distance.cpu())
    return closest > config.least_clearance


def holds_in_place(problem: GraspProblem, grasps: GraspBatch, config: AdmissionConfig) -> Bool[Tensor, " n"]:
    """Which grasps touch the object in the contact region alone, with two fingers at least."""
    place, hand = problem.workspace.contact_region, problem.hand.to(problem.device)
    assert place is not None
    points = hand.points(grasps.joints.to(problem.device), grasps.T_object_wrist.to(problem.device))
    distance, beside = problem.field.distances(points)[0], place.distances(points)[0] > 0
    finger = hand.finger_of_link[hand.link_index]
    reached = (distance < config.reach) & ~beside
    touching = sum((reached & (finger == index)).any(-1).int() for index in range(len(hand.fingers)))
    enough = torch.as_tensor(touching) >= min(config.fewest_fingers, len(hand.fingers))
    return (enough & ~(beside & (distance < config.touch)).any(-1)).cpu()


def finger_gap(problem: GraspProblem, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]) -> Float[Tensor, " n"]:
    """Least distance of the links that close to the object [m]."""
    hand = problem.hand.to(problem.device)
    closing = hand.tree.moves[:, hand.movable & ~hand.abduction].any(-1) & (hand.finger_of_link != PALM)
    moving = closing[hand.link_index]
    points = hand.points(q.to(problem.device), T.to(problem.device))[:, moving]
    return problem.field.distances(points)[0].amin(-1).cpu()


def opened_wide(problem: GraspProblem, grasps: GraspBatch) -> GraspBatch:
    """Complete grasps whose pregrasp opens as far as the constraints ask, or as far as the hand does."""
    clearance, hand = problem.constraints.pregrasp_clearance, problem.hand
    if clearance is None or not len(grasps):
        return grasps
    q = grasps.pregrasp_joints
    end = torch.where(hand.movable & ~hand.abduction, hand.open_ends, q)
    for share in torch.linspace(0, 1, OPENING_STEPS).tolist():
        tight = finger_gap(problem, grasps.T_object_wrist, q) < clearance
        if not bool(tight.any()):
            break
        q = torch.where(tight[:, None], grasps.pregrasp_joints + share * (end - grasps.pregrasp_joints), q)
    return grasps.replace(pregrasp_joints=q)


def dropped_in_words(dropped: Mapping[str, int], before: str = "dropped: ") -> str:
    """How many candidates were dropped, and why, in brackets; nothing for none."""
    reasons = ", ".join(f"{count} {reason}" for reason, count in dropped.items() if count)
    return f" ({before}{reasons})" if reasons else ""
