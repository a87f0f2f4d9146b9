"""How much force a hand's joints exert at most: as its description states it, or what suits its size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.hands.description.compiling import Note
from dro_grasp.hands.hand import Hand

TIP_FORCE = 10.0
"""Force that a finger exerts with its tip, where nothing better is known [N]. Ours: makers of hands state 5 to 20 N."""
GRIP_FORCE = 40.0  # Force of a jaw that slides, likewise [N]. Ours: makers of electric grippers state 20 to 140 N
LEAST = 0.1
"""Least multiple of what suits the hand's size at which an effort is believed. Ours: files state 0 for none."""
MOST = 40.0
"""Largest such multiple. Ours: files state 1000 for none."""
SHORTEST = 0.01  # Least lever arm from a joint to its fingertip [m] (ours)


@dataclass(frozen=True)
class Efforts:
    """Largest effort of each independent joint."""

    limit: Float[Tensor, " n_dof"]  # [Nm or N]
    stated: Bool[Tensor, " n_dof"]  # whether the description states it, and it is believed


def find_efforts(hand: Hand) -> Efforts:
    """The efforts that a description states, and what suits the hand's size where it states none or nonsense.

    A hand without a description gets what suits its size.
    """
    suited = suited_efforts(hand)
    if hand.description is None:
        return Efforts(suited, torch.zeros_like(suited, dtype=torch.bool))
    told = torch.from_numpy(hand.description.efforts).to(suited)
    believed = (told >= LEAST * suited) & (told <= MOST * suited)
    return Efforts(torch.where(believed, told, suited), believed)


def suited_efforts(hand: Hand) -> Float[Tensor, " n_dof"]:
    """Efforts with which fingertips press by TIP_FORCE, and sliding jaws by GRIP_FORCE [Nm or N].

    The lever arm of a joint is how far its fingertips move a radian in the open hand, of all fingers that it moves together.
    """
    tree = hand.tree
    tips = torch.tensor(hand.tips, device=tree.origin.device)
    poses = tree.forward(hand.open_ends)
    points = poses[tips, :3, 3] + (poses[tips, :3, :3] @ hand.tip_offsets[..., None])[..., 0]
    lever = tree.point_jacobian(poses, points, tips).norm(dim=-2).sum(0).clamp_min(SHORTEST)
    return torch.where(tree.joint_unit == 1, TIP_FORCE, GRIP_FORCE) * lever


def effort_notes(hand: Hand) -> Iterator[Note]:
    """What `hand check` says of efforts that are missing or not believed."""
    if hand.description is None:
        return
    found, told = find_efforts(hand), hand.description.efforts
    for text, rows in (
        ("state no effort", np.isnan(told)), ("state an effort that does not suit the hand's size", ~np.isnan(told))):
        missing = torch.from_numpy(rows) & ~found.stated
        if bool(missing.any()):
            names = [name for name, row in zip(hand.tree.joint_names, missing.tolist(), strict=True) if row]
            taken, slides = found.limit[missing], hand.tree.joint_unit[missing] != 1
            presses = [f"fingertips press by {TIP_FORCE:.0f} N"] * (not bool(slides.all()))
            presses += [f"jaws that slide press by {GRIP_FORCE:.0f} N"] * bool(slides.any())
            yield Note("info", ", ".join(names), f"{text}; {float(taken.min()):.2g} to {float(taken.max()):.2g} Nm (N where it "
                       f"slides) are taken, with which {' and '.join(presses)}")
