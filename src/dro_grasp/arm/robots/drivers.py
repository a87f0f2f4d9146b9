"""The numbers that a robot's drivers take: vendors put zero elsewhere, count the other way, or in degrees."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from dro_grasp.grasps.hold import HoldExpectation

ANGLES = {"rad": 1.0, "deg": math.degrees(1.0), "turn": 0.5 / math.pi}  # Units of joints that turn, in a radian
LENGTHS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}  # Units of joints that slide, in a metre


@dataclass(frozen=True)
class Drivers:
    """How drivers count the joints of a robot, those of the arm before the independent ones of the hand."""

    zeros: tuple[float, ...]
    """Where a joint is, as the description counts it, when its driver says zero [rad or m]."""
    scales: tuple[float, ...]
    """The driver's units in a radian or metre, negative where it counts the other way."""

    @staticmethod
    def usual(count: int) -> Drivers:
        """Drivers that count as the description does."""
        return Drivers((0.0,) * count, (1.0,) * count)

    @property
    def are_usual(self) -> bool:
        """Whether all numbers are those of the description."""
        return self == Drivers.usual(len(self.zeros))

    def part(self, rows: slice) -> Drivers:
        """Those of some of the joints."""
        return Drivers(self.zeros[rows], self.scales[rows])

    def positions(self, joints: Float[np.ndarray, "*k n"]) -> Float[np.ndarray, "*k n"]:
        """What the drivers are told, for joints of the description [rad or m]."""
        return (joints - np.array(self.zeros)) * np.array(self.scales)

    def joints(self, positions: Float[np.ndarray, "*k n"]) -> Float[np.ndarray, "*k n"]:
        """The inverse: joints of the description [rad or m], for what the drivers say."""
        return positions / np.array(self.scales) + np.array(self.zeros)

    def rates(self, rates: Float[np.ndarray, "*k n"]) -> Float[np.ndarray, "*k n"]:
        """Velocities or accelerations in the drivers' units, for those of the description [rad/s or m/s, and so on]."""
        return rates * np.array(self.scales)

    def efforts(self, efforts: Float[np.ndarray, "*k n"]) -> Float[np.ndarray, "*k n"]:
        """Efforts with the drivers' signs; they stay in Nm or N."""
        return efforts * np.sign(self.scales)

    def holding(self, expected: HoldExpectation) -> HoldExpectation:
        """What to expect of a hand, in the numbers of its drivers, for what the description says."""
        return replace(
            expected, held_joints=self.positions(expected.held_joints), held_efforts=self.efforts(expected.held_efforts),
            empty_joints=self.positions(expected.empty_joints), empty_efforts=self.efforts(expected.empty_efforts),
            unit=expected.unit * np.abs(self.scales))

    def lines(self, names: tuple[str, ...]) -> list[str]:
        """Each joint that its driver counts otherwise, in words."""
        return [f"driver of {name}: zero at {zero:g}, {scale:g} in a radian or metre"
                for name, zero, scale in zip(names, self.zeros, self.scales, strict=True) if (zero, scale) != (0.0, 1.0)]
