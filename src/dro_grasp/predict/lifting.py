"""Lifting: pinches of what lies flat on a table, closed in simulation with several squeezes. Ours.

Two pads on something thin hold it barely: too soft a squeeze lets it turn, too firm a one ejects it. No rule on contacts tells
which, but a simulated closing and short pulls by the weight do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import Checked
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.simulation.grasp_state import GraspState, Squeeze, WeightConfig, grasp_state, join, press
from dro_grasp.simulation.protocols import protocol as find_protocol

MARGIN = 1.5
"""Multiple of the weight for which proposed pinches press; with another margin they press otherwise. Source: PinchConfig."""


@dataclass(frozen=True)
class LiftConfig(Checked):
    """Which squeezes are tried (ours)."""

    strengths: tuple[float, ...] = (1.0, 2.0, 4.0)
    """Multiples of the squeeze."""
    pulling: float = 0.3
    """Time of each pull as they are compared [s]."""
    near: float = 1.5
    """Grasps by which the object moves or turns farther, as a multiple of what a trial allows, are not looked at longer."""


def lifted(
    problem: GraspProblem, grasps: GraspBatch, protocol: str, weight: WeightConfig, config: LiftConfig
) -> tuple[GraspBatch, GraspState, Squeeze]:
    """Each grasp with the squeeze by which the object gives way least, with payloads, and what then holds the object.

    What a longer pull shows is asked of those alone that short pulls hardly move.

    Args:
        problem: Hand, and an object on a table.
        grasps: Complete grasps with the table.
        protocol: Physics of the closing.
        weight: How the weight pulls.
        config: What is tried.
    """
    short, n = replace(weight, pulling=config.pulling), len(grasps)
    asked = weight.margin / MARGIN if weight.margin > 0 else 1.0
    tried = GraspBatch.concatenate([firmer(problem, grasps, asked * strength) for strength in config.strengths])
    state, squeeze = grasp_state(problem.hand, problem.solid, tried, protocol, config=short, device=str(problem.device))
    best = gives(state, protocol).reshape(-1, n).argmin(0) * n + torch.arange(n)
    found, state, squeeze = tried[best], state.rows(best), squeeze.rows(best)
    near = gives(state, protocol) < config.near
    held, others = near.nonzero()[:, 0], (~near).nonzero()[:, 0]
    if not len(held):
        return found.replace(payload=torch.zeros(n)), state, squeeze
    # Pressing for no weight leaves the squeeze as it is, gentle enough where that is asked, and tells the payload.
    firm, unchanged = found[held], replace(weight, margin=0.0)
    pressed = problem.on_table(press(
        problem.hand, problem.solid, firm, protocol, config=unchanged, device=str(problem.device)))
    if weight.max_force == math.inf:
        pressed = firm.replace(payload=pressed.payload)
    longer = grasp_state(problem.hand, problem.solid, pressed, protocol, config=weight, device=str(problem.device))
    order = torch.cat([held, others]).argsort()
    found = GraspBatch.concatenate([pressed, found[others].replace(payload=torch.zeros(len(others)))])[order]
    return found, join([longer[0], state.rows(others)]).rows(order), join([longer[1], squeeze.rows(others)]).rows(order)


def gives(state: GraspState, protocol: str) -> Float[Tensor, " n"]:
    """How far closing and the weight move or turn the object, as a multiple of what a trial allows; infinite where unknown."""
    rules = find_protocol(protocol)
    gave = torch.maximum(state.gave[:, 0] / rules.max_displacement, state.gave[:, 1] / rules.max_rotation)
    return gave.nan_to_num(torch.inf)


def firmer(problem: GraspProblem, grasps: GraspBatch, factor: float) -> GraspBatch:
    """The grasps with a multiple of their squeeze, within the joints' limits."""
    tree = problem.hand.tree
    lower, upper = torch.minimum(tree.lower, grasps.joints), torch.maximum(tree.upper, grasps.joints)
    squeeze = grasps.joints + factor * (grasps.squeeze_joints - grasps.joints)
    return grasps.replace(squeeze_joints=squeeze.clamp(lower, upper))
