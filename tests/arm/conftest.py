"""A plan that several tests look at, and what MuJoCo compiles."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import trimesh

import dro_grasp as dro
from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.planning.planner import plan
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.arm.planning.workcell import ARM

PLACE = (0.5, 0.1)


@pytest.fixture(scope="session")
def wall(tmp_path_factory: pytest.TempPathFactory) -> dro.ObjectModel:
    """A board between the home position and the object."""
    board = trimesh.creation.box(extents=(0.02, 0.2, 0.3))
    board.apply_translation((0.33, 0.1, 0.16))
    path = tmp_path_factory.mktemp("wall") / "wall.obj"
    board.export(path)
    return dro.load_object(str(path))


@pytest.fixture(scope="session")
def standing() -> tuple[dro.ObjectModel, np.ndarray]:
    obj, T = dro.load_object("can"), np.eye(4)
    T[:3, 3] = *PLACE, -float(obj.cloud[:, 2].min())
    return obj, T


@pytest.fixture(scope="session")
def planned(robot: dro.Robot, wall: dro.ObjectModel, standing: tuple[dro.ObjectModel, np.ndarray]) -> MotionPlan:
    return plan(robot, *standing, obstacles=[wall], config=PlanConfig(num=12), seed=0)


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[mujoco.MjSpec]:
    """Scenes with an arm that MuJoCo compiled; settling grasps compiles that of hand and object alone."""
    found, compiling = [], mujoco.MjSpec.compile

    def counted(spec: mujoco.MjSpec) -> mujoco.MjModel:
        if any(body.name.startswith(ARM) for body in spec.bodies):
            found.append(spec)
        return compiling(spec)

    monkeypatch.setattr(mujoco.MjSpec, "compile", counted)
    return found
