"""Make procedural hands: plans are drawn from a seed until one can grasp.

A hand can grasp that is derived as it was meant, apart when open, and whose fingers meet in front of the palm.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import HandError, OptionError
from dro_grasp.hands.check import HandReport, check_hand, seen_side
from dro_grasp.hands.description.loader import self_penetration
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.opening import FingerMotion
from dro_grasp.kinds import checked
from dro_grasp.training.made_hands.plan import HandPlan, write_urdf
from dro_grasp.training.made_hands.sampling import sample_plan

MAX_DRAWS = 200  # Draws after which a seed is given up (ours; the first one or two are usually kept)
PALM_COSINE = 0.8  # Least cosine between the derived palm direction and the planned one (ours)
TOUCHING = 5e-4  # Deepest penetration of the open hand's links [m] (ours)
MEETING = 0.03  # Largest distance to which each fingertip comes to one that closes against it, from middle to middle [m] (ours)
FEWEST_WITH_SPARE = 4  # From this number of fingers on, one of them may meet no other, as little fingers do (ours)
POSTURES = 1024  # Random postures in which fingertips are looked for near each other (ours)
SWEEP = (0.25, 0.75)  # Shares of the way from closed to open at which fingertips must be in front of the palm (ours)


@dataclass(frozen=True)
class MadeHand:
    """A hand that does not exist."""

    name: str
    """`hand_00042` for seed 42."""
    seed: int
    """What it was drawn from."""
    plan: HandPlan
    """What it is made of."""
    urdf: str
    """The description, as text."""
    redrawn: tuple[str, ...]
    """For each plan that was drawn before and could not grasp, the reason."""

    def __repr__(self) -> str:
        return f"MadeHand('{self.name}', {self.plan.family}, {len(self.plan.fingers)} fingers, {self.plan.joints} joints)"

    def facts(self) -> dict[str, Any]:
        """A row of the listing."""
        plan = self.plan
        return {"name": self.name, "seed": self.seed, "family": plan.family, "fingers": len(plan.fingers), "side": plan.side,
                "thumb": plan.thumb, "palm": plan.palm_shape, "joints": plan.joints, "mimic_joints": plan.followers,
                "folds_back": plan.folds_back, "redrawn": len(self.redrawn)}


def hand_name(seed: int) -> str:
    """Name of the hand of a seed."""
    return f"hand_{seed:05d}"


@checked
def make_hand(seed: int) -> MadeHand:
    """Make the procedural hand of a seed: the same seed gives the same hand, another one another hand.

    Write its `urdf` to a file, and that file is a hand like any other.

    Args:
        seed: Not negative.

    Raises:
        OptionError: The seed is negative.
        HandError: No plan drawn from this seed can grasp.
    """
    if seed < 0:
        raise OptionError(f"seed is {seed}; give 0 or more")
    name, generator, redrawn = hand_name(seed), np.random.default_rng(seed), []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.urdf"
        for _ in range(MAX_DRAWS):
            plan = sample_plan(generator)
            text = write_urdf(plan, name)
            file.write_text(text, encoding="utf-8")
            try:
                reason = why_unfit(plan, check_hand(file))
            except HandError as error:
                reason = str(error).removeprefix(f"{file}: ")
            if not reason:
                return MadeHand(name, seed, plan, text, tuple(redrawn))
            redrawn.append(reason)
    raise HandError(f"none of {MAX_DRAWS} plans drawn from seed {seed} can grasp (last: {redrawn[-1]}); give another seed")


def why_unfit(plan: HandPlan, report: HandReport) -> str:
    """Why a hand, whose URDF `hand check` reads so, is drawn again; empty if it is kept."""
    hand = report.hand
    warnings = [note.text for note in report.notes if note.level == "warning"]
    if warnings:
        return f"the check warns: {warnings[0]}"
    if misread := _misread(plan, hand):
        return misread
    assert hand.description is not None
    depths = self_penetration(hand.description, posture(plan, hand))
    return "its links overlap in the open hand" if max(depths.values(), default=0.0) > TOUCHING else _idle(hand)


def _misread(plan: HandPlan, hand: Hand) -> str:
    """Whether anatomy and palm were derived otherwise than planned."""
    if len(hand.fingers) != len(plan.fingers):
        return "another number of fingers was derived"
    if float(hand.palm_direction_wrist @ torch.tensor(plan.palm_direction)) < PALM_COSINE:
        return "another palm direction was derived"
    if plan.thumb != "none" and hand.thumb not in (None, len(plan.fingers) - 1):
        return "another finger was taken for the thumb"
    if plan.side != "none" and seen_side(hand) not in (None, plan.side):
        return "the other side was derived"
    bending = plan.bending_joints()
    if any(sign > 0 and name in bending for name, sign in zip(hand.tree.joint_names, hand.opening_signs, strict=True)):
        return "a joint was taken to open the other way"
    return ""


def posture(plan: HandPlan, hand: Hand) -> Float[Tensor, " n_dof"]:
    """The planned open posture [rad]."""
    angles = plan.open_posture()
    return torch.tensor([angles[name] for name in hand.tree.joint_names])


def _idle(hand: Hand) -> str:
    """Whether a fingertip meets none that closes against it, or does not sweep the space in front of the palm."""
    fingertips = FingerMotion.of(hand)
    shares = torch.linspace(*SWEEP, 5)
    tips = fingertips.tips(torch.stack([hand.canonical_joints(float(share)) for share in shares]))
    height = (tips - hand.palm_centre_wrist) @ hand.palm_direction_wrist
    if not bool((height.amax(0) > 0).all()):
        return "a finger closes beside the palm or behind it"
    closing = torch.nn.functional.normalize(tips[0] - tips[-1], dim=-1)
    against = closing @ closing.T < 0.5
    spread = fingertips.tips(hand.random_joints(POSTURES, torch.Generator().manual_seed(0)))
    nearest = torch.cdist(spread, spread).amin(0)
    nearest = torch.where(against & ~torch.eye(len(hand.tips), dtype=torch.bool), nearest, torch.inf).amin(0)
    lonely = int((nearest > MEETING).sum())
    return "a finger meets no other" if lonely > (len(nearest) >= FEWEST_WITH_SPARE) else ""
