"""Geometry of the object's motion, against SciPy."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from dro_grasp.simulation.rollout import ObjectState, _matrices, quiet

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
