"""Amounts of the grasp controller, apart from it: the command line reads protocols, which state them, without torch."""

from __future__ import annotations

from dataclasses import dataclass

from dro_grasp.kinds import Checked


@dataclass(frozen=True)
class ControllerConfig(Checked):
    """How far joints move from a grasp."""

    outer: float = 0.25  # share of the remaining range by which the pregrasp opens. Source: official release.
    inner: float = 0.30  # share of the remaining range by which the squeeze closes
    # Differs from the paper's release (0.15), which leaves small objects without contact; the controls gain as well.
    dead_zone: float = 1e-3  # joints whose downstream points approach the object's centre more slowly stay [m/rad] (ours)
