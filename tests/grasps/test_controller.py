from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import ControllerConfig, complete, distance_slope, pregrasp_and_squeeze
from dro_grasp.hands.hand import Hand
from tests.helpers.claw import claw, wrist_below
from tests.helpers.toy_hand import toy_hand


@pytest.fixture(scope="module")
def hand() -> Hand:
    return toy_hand(torch.float64)


def tensors(hand: Hand, *values: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    joints = torch.tensor([values], dtype=torch.float64).expand(1, hand.tree.n_dof).clone()
    return wrist_below(0.05).double(), joints, torch.zeros(3, dtype=torch.float64)


def mean_distance(hand: Hand, T: torch.Tensor, q: torch.Tensor, centre: torch.Tensor, joint: int) -> torch.Tensor:
    """Mean distance of the middles of the links below a joint, from forward kinematics alone."""
    poses = T @ hand.tree.forward(q)[0]
    finger = joint // 2
    links = [1 + 2 * finger, 2 + 2 * finger] if joint % 2 == 0 else [2 + 2 * finger]
    middles = [poses[k, :3, :3] @ hand.link_points[hand.link_index == k].mean(0) + poses[k, :3, 3] for k in links]
    return torch.stack([(m - centre).norm() for m in middles]).mean()


def test_slope_against_finite_differences(hand):
    T, q, centre = tensors(hand, 0.1, 0.5, 0.3, 0.9, -0.2, 0.4)
    centre = centre + torch.tensor([0.01, -0.02, 0.005])
    slope = distance_slope(hand, T, q, centre)[0]
    for joint in range(hand.tree.n_dof):
        step = torch.zeros_like(q)
        step[0, joint] = 1e-6
        numeric = (mean_distance(hand, T[0], q + step, centre, joint)
                   - mean_distance(hand, T[0], q - step, centre, joint)) / 2e-6
        assert slope[joint] == pytest.approx(float(numeric), abs=1e-7)


def test_shares_of_the_remaining_range(hand):
    # Fingers around the centre: bending (towards the upper limit) closes.
    T, q, centre = tensors(hand, 0.2)
    outer, inner = pregrasp_and_squeeze(hand, T, q, centre, ControllerConfig(outer=0.25, inner=0.15))
    lower, upper = hand.tree.lower, hand.tree.upper
    torch.testing.assert_close(outer, q - 0.25 * (q - lower))
    torch.testing.assert_close(inner, q + 0.15 * (upper - q))


def test_amounts_come_from_the_configuration(hand):
    T, q, centre = tensors(hand, 0.2)
    outer, inner = pregrasp_and_squeeze(hand, T, q, centre, ControllerConfig(outer=0.0, inner=0.4))
    torch.testing.assert_close(outer, q)
    torch.testing.assert_close(inner, q + 0.4 * (hand.tree.upper - q))


def test_sign_is_chosen_per_grasp(hand):
    """An object outside a finger is approached by opening that finger: its sign flips, per grasp."""
    T, q, _ = tensors(hand, 0.2)
    beside = torch.tensor([0.15, 0.0, 0.0], dtype=torch.float64)
    _, inner = pregrasp_and_squeeze(hand, T, q, beside)
    assert (inner[0, :2] < q[0, :2]).all()
    assert (inner[0, 2:] > q[0, 2:]).all()


def test_pure_abduction_and_held_joints_stay(hand):
    import dataclasses

    q = torch.full((1, 6), 0.2, dtype=torch.float64)
    flags = torch.tensor([True, False, False, False, False, False])
    spread = dataclasses.replace(hand, abduction=flags, movable=~flags.roll(2))
    outer, inner = pregrasp_and_squeeze(spread, wrist_below(0.05).double(), q, torch.zeros(3, dtype=torch.float64))
    moved = (outer != q)[0] & (inner != q)[0]
    assert moved.tolist() == [False, True, False, True, True, True]


def test_stays_within_limits(hand):
    T, _, centre = tensors(hand, 0.0)
    for q in (hand.tree.lower, hand.tree.upper):
        for joints in pregrasp_and_squeeze(hand, T, q[None], centre):
            assert (joints >= hand.tree.lower).all()
            assert (joints <= hand.tree.upper).all()


def test_opening_and_closing_change_the_distance_as_named(tmp_path):
    real = claw(tmp_path)
    q = torch.tensor([[0.0, 0.6] * 4])
    T, centre = wrist_below(0.042), torch.zeros(3)
    outer, inner = pregrasp_and_squeeze(real, T, q, centre)
    def fingers(joints: torch.Tensor) -> float:
        return float(real.points(joints, T)[0][real.link_index > 0].norm(dim=-1).mean())

    assert fingers(outer) > fingers(q) > fingers(inner)


def test_only_what_is_not_stated_is_completed(hand):
    n, generator = 4, torch.Generator().manual_seed(0)
    T = wrist_below(0.05).double().expand(n, 4, 4).clone()
    joints = hand.random_joints(n, generator).double()
    centre = torch.zeros(3, dtype=torch.float64)
    before, after = pregrasp_and_squeeze(hand, T, joints, centre)
    hints = torch.rand(n, hand.tree.n_dof, generator=generator, dtype=torch.float64)
    nothing = torch.full_like(hints, torch.nan)
    some = torch.tensor([True, True, False, False])[:, None]
    other = torch.tensor([True, False, True, False])[:, None]
    tree = SimpleNamespace(link_names=hand.tree.link_names, joint_names=hand.tree.joint_names)
    owner, thing = SimpleNamespace(name="toy", sha256="a", tree=tree), SimpleNamespace(name="b", sha256="b", split=None)
    grasps = GraspBatch.create(owner, thing, T, joints).replace(
        T_object_wrist=T, joints=joints, pregrasp_joints=torch.where(some, hints, nothing),
        squeeze_joints=torch.where(other, hints, nothing))
    whole = complete(hand, grasps, centre)
    torch.testing.assert_close(whole.pregrasp_joints, torch.where(some, hints, before))
    torch.testing.assert_close(whole.squeeze_joints, torch.where(other, hints, after))
    assert complete(hand, whole, centre) is whole
