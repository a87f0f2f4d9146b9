"""The energy of surroundings: by finite differences, and against a plain loop over points and postures."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from dro_grasp.geometry.distance_field import Balls
from dro_grasp.geometry.se3 import turned_about
from dro_grasp.grasps.controller_config import ControllerConfig
from dro_grasp.optimize.grasp_energy import EnergyConfig, GraspEnergy, Surroundings, Workspace
from tests.helpers.energy_samples import near_kinks, precise, rounded_box
from tests.helpers.toy_hand import toy_hand

HAND = precise(toy_hand())
SLANTED = torch.nn.functional.normalize(torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64), dim=0)
PLANE = torch.cat([SLANTED, torch.tensor([-0.03], dtype=torch.float64)])
ASIDE = dataclasses.replace(rounded_box(), origin=torch.tensor([-0.02, -0.08, -0.08], dtype=torch.float64))
SPARED = Balls(torch.tensor([[0.05, 0.0, 0.02], [-0.04, 0.03, 0.0]]).double(), torch.tensor([0.05, 0.04]).double())
HELD = Balls(torch.tensor([[0.03, 0.0, 0.0], [0.0, 0.02, 0.02]]).double(), torch.tensor([0.02, 0.015]).double())
KINDS = {
    "plane": Workspace(Surroundings(PLANE)), "obstacle": Workspace(Surroundings(obstacles=ASIDE)),
    "keep_out": Workspace(Surroundings(keep_out=SPARED)), "all": Workspace(Surroundings(PLANE, ASIDE, SPARED)),
    "contact_region": Workspace(contact_region=HELD)}
ONLY = EnergyConfig(
    force_closure=0, distance=0, penetration=0, self_penetration=0, alignment=0, joints=0, clearance=100, clearance_points=64)


def energy_in(kind: str) -> GraspEnergy:
    return GraspEnergy(HAND, rounded_box(), torch.zeros(3).double(), 0.03, ONLY, workspace=KINDS[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_is_that_of_the_value(kind: str) -> None:
    energy = energy_in(kind)
    samples = near_kinks(energy)
    T, q = samples.T[:16], samples.q[:16]
    given = energy(T, q)
    assert float((given.clearance > 0).double().mean()) > 0.8
    assert torch.equal(given.total, given.clearance[:, 0])

    def total(x: Tensor) -> Tensor:
        moved = turned_about(T, energy.pivot(T), x[:, :3], x[:, 3:6])
        return energy(moved, q + x[:, 6:]).total

    size = 6 + q.shape[1]
    steps = 1e-7 * torch.eye(size, dtype=torch.float64)
    numeric = torch.stack([(total(s.expand(16, -1)) - total(-s.expand(16, -1))) / 2e-7 for s in steps], -1)
    expected = torch.cat([given.by_pose, given.by_joint], -1)
    # Within the step a point may cross a kink; most entries meet none.
    off = (numeric - expected).abs() / (1 + expected.abs())
    assert float((off < 1e-5).double().mean()) > 0.97
    assert float(expected.abs().amax(0)[6:].min()) > 0, "every joint matters"


def test_value_counts_every_point_below_the_plane_in_pregrasp_grasp_and_squeeze() -> None:
    energy, config = energy_in("plane"), ControllerConfig()
    samples = near_kinks(energy)
    T, q = samples.T[:8], samples.q[:8]
    few, moving = HAND.with_points(64), HAND.movable & ~HAND.abduction
    depth = torch.zeros(8).double()
    for end, share in ((HAND.open_ends, config.outer), (HAND.open_ends, 0.0), (HAND.closed_ends, config.inner)):
        joints = torch.where(moving, q + share * (end - q), q)
        for row in range(8):
            for point in few.points(joints[row], T[row]):
                depth[row] += max(0.0, ONLY.clear - float(point @ SLANTED - PLANE[3]))
    torch.testing.assert_close(energy(T, q).clearance[:, 0], 100 * depth)


def test_distance_is_that_of_the_nearest_point() -> None:
    energy = energy_in("plane")
    samples = near_kinks(energy)
    assert energy.clearance is not None
    points = HAND.with_points(64).points(samples.q, samples.T)
    torch.testing.assert_close(energy.clearance.distance(samples.T, samples.q), (points @ SLANTED - PLANE[3]).amin(-1))
    lifted = points + energy.clearance.surroundings.lift(points, 0.01)[:, None]
    assert float((lifted @ SLANTED - PLANE[3]).min()) > 0.01 - 1e-9


def test_no_surroundings_cost_nothing() -> None:
    energy = GraspEnergy(HAND, rounded_box(), torch.zeros(3).double(), 0.03, ONLY)
    samples = near_kinks(energy)
    assert energy.clearance is None
    assert not energy(samples.T, samples.q).clearance.any()
    far, gradient = Surroundings().distances(samples.T[:, :3, 3])
    assert bool(far.isinf().all())
    assert not gradient.any()
