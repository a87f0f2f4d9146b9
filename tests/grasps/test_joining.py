"""A file whose grasps state no pregrasp, joined with one whose grasps do, evaluates like its parts."""

from __future__ import annotations

import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import ControllerConfig, pregrasp_and_squeeze
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand


def test_grasps_with_and_without_pregrasps_evaluate_like_their_parts(tmp_path) -> None:
    hand, ball = loaded_hand("gripper3"), load_object("sphere")
    without = synthesize(hand, ball, 16, 0, SynthesisConfig(steps=40))[:8]
    centre = torch.as_tensor(ball.centre_of_mass, dtype=torch.float32)
    pregrasp, squeeze = pregrasp_and_squeeze(
        hand, without.T_object_wrist, without.joints, centre, ControllerConfig(outer=0.1, inner=0.05))
    stated = without.replace(pregrasp_joints=pregrasp, squeeze_joints=squeeze)
    GraspBatch.concatenate([without, stated]).save(tmp_path / "both.parquet")
    parts = [simulate(hand, ball, part, "dro") for part in (without, stated)]
    both = simulate(hand, ball, GraspBatch.load(tmp_path / "both.parquet"), "dro")
    assert both.reason == parts[0].reason + parts[1].reason
    assert both.success.any()
    # The weaker squeeze is honoured: the same grasps end elsewhere.
    assert not torch.equal(parts[0].displacement.nan_to_num(), parts[1].displacement.nan_to_num())
