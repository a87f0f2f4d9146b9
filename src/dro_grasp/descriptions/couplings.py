"""Joints that follow others: URDF mimic, MJCF joint equalities and shared tendons."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from dro_grasp.descriptions.bounds import TURNS
from dro_grasp.errors import HandError


@dataclass(frozen=True)
class Coupling:
    """follower = multiplier * leader + offset."""

    follower: int
    """Index of the following joint."""
    leader: int
    """Index of the leading joint; -1 if the follower is held at the offset."""
    multiplier: float
    """Motion of the follower per motion of the leader."""
    offset: float
    """Value of the follower while the leader is at zero [rad or m]."""


def resolve_couplings(
    couplings: tuple[Coupling, ...], n_joints: int, names: list[str], path: Path
) -> tuple[list[int], Float[np.ndarray, "n_joints n_dof"], Float[np.ndarray, " n_joints"]]:
    """Every joint as an affine function of the independent ones.

    Returns:
        Indices of the independent joints, coupling and offset: joints = coupling @ independent joints + offset.

    Raises:
        HandError: Followers follow each other in a cycle, or absurdly fast, or all joints are held.
    """
    rule = {c.follower: c for c in couplings}
    free = [j for j in range(n_joints) if j not in rule]
    coupling, offset = np.zeros((n_joints, len(free))), np.zeros(n_joints)
    for joint in range(n_joints):
        factor, shift, current, seen = 1.0, 0.0, joint, [joint]
        while current in rule:
            step = rule[current]
            shift += factor * step.offset
            factor *= step.multiplier
            current = step.leader
            if current in seen:
                chain = " -> ".join(names[j] for j in [*seen, current])
                raise HandError(f"{path}: joints follow each other in a cycle ({chain}); one of them must be free")
            if current < 0:
                break
            seen.append(current)
        offset[joint] = shift
        if current >= 0:
            coupling[joint, free.index(current)] = factor
        if not (abs(factor) <= TURNS and abs(shift) <= TURNS):
            raise HandError(f"{path}: joint '{names[joint]}' follows at {factor:g} times its leader, from {shift:g}; expected "
                            f"at most {TURNS:g}")
    if not free:
        raise HandError(f"{path}: every joint follows another or is held; expected at least one that moves by itself")
    return free, coupling, offset
