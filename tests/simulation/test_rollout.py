"""Geometry of the object's motion, against SciPy."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.simulation import scene
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.quiet import quiet
from dro_grasp.simulation.rollout import ObjectState, _matrices, rollouts

ROTATIONS = Rotation.random(200, random_state=0)


def test_matrices_of_quaternions():
    np.testing.assert_allclose(_matrices(ROTATIONS.as_quat(scalar_first=True)), ROTATIONS.as_matrix(), atol=1e-15)


def test_shift_and_turn_between_two_states():
    generator = np.random.default_rng(0)
    first, second = generator.normal(size=(2, 100, 3))
    a, b = (ObjectState(p, r.as_matrix(), np.ones(100, bool)) for p, r in ((first, ROTATIONS[:100]), (second, ROTATIONS[100:])))
    np.testing.assert_allclose(a.turn(b), (ROTATIONS[:100].inv() * ROTATIONS[100:]).magnitude(), atol=1e-12)
    np.testing.assert_allclose(a.shift(b), np.linalg.norm(first - second, axis=1))
    np.testing.assert_allclose(a.turn(a), 0, atol=1e-15)


def test_quiet_blocks_that_overlap_give_the_warnings_back_with_the_last() -> None:
    def handler(_: str) -> None: ...

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(handler)
    try:
        first, second = quiet(), quiet()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert mujoco.get_mju_user_warning() is not handler
        second.__exit__(None, None, None)
        assert mujoco.get_mju_user_warning() is handler
    finally:
        mujoco.set_mju_user_warning(before)


def test_warnings_of_the_simulator_are_kept_quiet_and_heard_again_afterwards() -> None:
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        model = mujoco.MjModel.from_xml_string(
            "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>")
        data = mujoco.MjData(model)
        with quiet():
            data.qvel[0] = np.nan
            mujoco.mj_step(model, data)
        assert not heard
        mujoco.mj_resetData(model, data)
        data.qvel[0] = np.nan
        mujoco.mj_step(model, data)
        assert heard
    finally:
        mujoco.set_mju_user_warning(before)


def test_a_simulation_with_more_contacts_than_fit_into_memory_is_unsound_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as a hand deep in the balls of a cloud."""
    hand, can = load_hand("allegro"), load_object("can")
    away, inside = torch.eye(4), torch.eye(4)
    away[2, 3] = 1.0
    grasps = GraspBatch.create(hand, can, torch.stack([away, inside]), hand.canonical_joints(1.0).expand(2, -1))
    states = []
    for memory in (scene.MEMORY, 1 << 17):
        monkeypatch.setattr(scene, "MEMORY", memory)
        built = scene.build_scene(hand, can, PROTOCOLS["carry"])
        (_, rollout), = rollouts(built, hand, grasps, workers=1)
        states.append(rollout.close())
    assert states[0].stable.tolist() == [True, True]
    assert states[1].stable.tolist() == [True, False]
    np.testing.assert_array_equal(states[0].position[0], states[1].position[0])
