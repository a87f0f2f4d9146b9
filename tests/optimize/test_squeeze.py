"""Balanced squeezes against SciPy's solver, statics and virtual work, and in simulation against the usual squeeze."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.hands.library import load_hand
from dro_grasp.optimize.grasp_energy import GraspEnergy, NearestPoints
from dro_grasp.optimize.squeeze import GripConfig, contact_forces, gripping
from dro_grasp.simulation.protocols import protocol
from dro_grasp.simulation.scene import cached_scene
from dro_grasp.simulation.trial import simulate
from tests.helpers.claw import JAWS, ball, claw, grasps_of, power_grasp, wrist_below
from tests.helpers.toy_hand import coupled_hand, toy_hand

CONFIG = GripConfig(iterations=2000)


def contacts(*places: tuple[float, float, float], gap: float = 0.0) -> tuple[NearestPoints, Tensor, Tensor]:
    """One grasp with contacts on a sphere of 3 cm in these directions, each by a finger of one link."""
    outward = torch.nn.functional.normalize(torch.tensor([places], dtype=torch.float32), dim=-1)
    n = len(places)
    near = NearestPoints(
        torch.arange(n), torch.zeros(1, n, dtype=torch.int64), 0.03 * outward, -outward, torch.full((1, n), gap), outward)
    return near, torch.ones(1, n, dtype=torch.bool), torch.eye(n, dtype=torch.bool)


def test_a_thumb_presses_as_hard_as_two_fingers_against_it() -> None:
    near, touches, finger = contacts((1, 0, 0), (-1, 0.3, 0), (-1, -0.3, 0))
    forces = contact_forces(near, touches, finger, torch.zeros(3), 0.03, CONFIG)[0]
    arms = torch.linalg.cross(near.points[0], forces).sum(0) / 0.03
    assert float(forces.sum(0).norm()) < 0.1
    assert float(arms.norm()) < 0.1
    thumb, one, other = forces.norm(dim=-1).tolist()
    assert one == pytest.approx(other, rel=1e-3)
    assert thumb > 1.4 * one
    normal = -(forces * near.object_normals[0]).sum(-1)
    assert float(normal.sum()) == pytest.approx(CONFIG.force, rel=0.02)
    across = (forces + normal[:, None] * near.object_normals[0]).norm(dim=-1)
    assert bool((across <= CONFIG.friction * normal + 1e-4).all())
    assert float(across[1]) > 0.01, "the two oblique forces lean against each other"


def test_only_links_that_touch_press() -> None:
    near, touches, finger = contacts((1, 0, 0), (-1, 0, 0), (0, 1, 0))
    touches[0, 2] = False
    forces = contact_forces(near, touches, finger, torch.zeros(3), 0.03, CONFIG)[0]
    assert float(forces[2].norm()) == 0
    torch.testing.assert_close(forces[0], -forces[1], atol=0.01, rtol=0)
    assert not contact_forces(near, torch.zeros_like(touches), finger, torch.zeros(3), 0.03, CONFIG).any()


def test_joint_offsets_do_the_work_of_the_forces() -> None:
    hand, obj = toy_hand(), ball()
    grasps = grasps_of(hand, obj, wrist_below(0.05, 1), torch.tensor([[-0.1, 0.5, -0.05, 0.6, 0.0, 0.4]]))
    energy = GraspEnergy.of_object(hand, obj)
    config = GripConfig(touching=0.0, idle=0.0, reach=0.02)
    made = gripping(energy, grasps, config)
    near = NearestPoints.of(energy, grasps.T_object_wrist, grasps.joints)
    finger = torch.stack([torch.isin(near.links, torch.tensor(f.links)) for f in hand.fingers])
    forces = contact_forces(near, near.gap < 0.02, finger, energy.centre, energy.length, config)[0].double()
    assert float(forces.norm()) > 1
    exact, T, q = toy_hand(torch.float64), grasps.T_object_wrist.double(), grasps.joints.double()
    for joint in range(hand.tree.n_dof):
        step = torch.zeros_like(q)
        step[0, joint] = 1e-6
        ahead, behind = (near.pick(exact.points(x, T))[0] for x in (q + step, q - step))
        work = float((forces * (ahead - behind) / 2e-6).sum())
        offset = float(made.squeeze_joints[0, joint] - grasps.joints[0, joint])
        assert offset == pytest.approx(work / config.stiffness, abs=2e-5)


def test_servos_of_sliding_jaws_make_half_of_the_force_each_of_their_offsets(tmp_path: Path) -> None:
    (tmp_path / "jaws.xml").write_text(JAWS)
    hand, obj = load_hand(tmp_path / "jaws.xml"), ball(0.02)
    grasps = grasps_of(hand, obj, torch.eye(4)[None], torch.zeros(1, 2))
    made = gripping(GraspEnergy.of_object(hand, obj), grasps, GripConfig(force=8.0, touching=0.0))
    servos = cached_scene(hand, obj, protocol("strict")).model.actuator_gainprm[:, 0]  # [N/m]
    np.testing.assert_allclose(servos * made.squeeze_joints[0].numpy(), [4.0, 4.0], rtol=0.05)


def test_targets_stay_within_the_limits_and_shares_of_the_usual_squeeze_remain() -> None:
    hand, obj = toy_hand(), ball()
    far = grasps_of(hand, obj, wrist_below(0.3, 1), torch.full((1, 6), 0.2))
    made = gripping(GraspEnergy.of_object(hand, obj), far)
    outer, inner = pregrasp_and_squeeze(hand, far.T_object_wrist, far.joints, torch.zeros(3))
    torch.testing.assert_close(made.pregrasp_joints, outer)
    torch.testing.assert_close(made.squeeze_joints, far.joints + 0.7 * (inner - far.joints))
    strong = gripping(GraspEnergy.of_object(hand, obj), power_like(far), GripConfig(force=1e4, reach=0.05))
    assert bool((strong.squeeze_joints <= hand.tree.upper + 1e-6).all())
    assert bool((strong.squeeze_joints >= hand.tree.lower - 1e-6).all())
    assert math.isclose(float(strong.squeeze_joints.max()), 1.4, rel_tol=1e-6)
    assert len(gripping(GraspEnergy.of_object(hand, obj), far[slice(0, 0)])) == 0


def test_a_joint_that_fingers_share_brings_those_that_do_not_touch_yet() -> None:
    hand = coupled_hand()
    obj = ball()
    energy, config = GraspEnergy.of_object(hand, obj), GripConfig(force=0.0)
    T = wrist_below(0.05, 2)
    T[1, 0, 3] = -0.03  # one finger touches
    grasps = grasps_of(hand, obj, T, torch.tensor([[0.1, 0.62]]).expand(2, -1))
    near = NearestPoints.of(energy, T, grasps.joints)
    gap = torch.stack([near.gap[:, torch.isin(near.links, torch.tensor(f.links))].amin(1) for f in hand.fingers], 1)
    assert (gap < config.reach).sum(1).tolist() == [3, 1]
    inner = pregrasp_and_squeeze(hand, T, grasps.joints, energy.centre)[1]
    made = gripping(energy, grasps, config)
    for row, share in enumerate((config.touching, config.idle)):
        torch.testing.assert_close(made.squeeze_joints[row], (grasps.joints + share * (inner - grasps.joints))[row])
    assert float((inner - grasps.joints).abs().min()) > 0.1


def power_like(far: GraspBatch) -> GraspBatch:
    return far.with_poses(wrist_below(0.05, 1), far.joints)


def test_a_lopsided_grasp_moves_the_object_less(tmp_path: Path) -> None:
    hand, obj = claw(tmp_path), ball()
    # One finger is almost closed, and the finger opposite almost open: the shares of what remains of their ranges differ.
    grasps = power_grasp(hand, obj, 6)
    usual = simulate(hand, obj, grasps, "strict", workers=1)
    balanced = simulate(hand, obj, gripping(GraspEnergy.of_object(hand, obj), grasps), "strict", workers=1)
    assert float(np.median(balanced.closing_shift)) < float(np.median(usual.closing_shift))
