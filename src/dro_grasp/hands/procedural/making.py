"""Make procedural hands: plans are drawn from a seed until one can grasp."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dro_grasp.errors import HandError, OptionError
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.procedural.acceptance import why_unfit
from dro_grasp.hands.procedural.plan import HandPlan
from dro_grasp.hands.procedural.sampling import sample_plan
from dro_grasp.hands.procedural.writing import write_urdf
from dro_grasp.kinds import checked

MOST_DRAWS = 200
"""Draws after which a seed is given up (ours; the first one or two are usually kept)."""


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
        for _ in range(MOST_DRAWS):
            plan = sample_plan(generator)
            text = write_urdf(plan, name)
            file.write_text(text)
            try:
                reason = why_unfit(plan, check_hand(file))
            except HandError as error:
                reason = str(error).removeprefix(f"{file}: ")
            if not reason:
                return MadeHand(name, seed, plan, text, tuple(redrawn))
            redrawn.append(reason)
    raise HandError(f"none of {MOST_DRAWS} plans drawn from seed {seed} can grasp (last: {redrawn[-1]}); give another seed")
