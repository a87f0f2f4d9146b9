"""How far robots get. Oracle: forward kinematics at random configurations, and at those that stretch the arm."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.distance import pdist

import dro_grasp as dro
from dro_grasp.errors import PlanError
from dro_grasp.planning import planner
from dro_grasp.planning.robot import Robot, load_robot

ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom size="0.05"/>
<body name="cart" pos="0 0 0.1"><joint name="rail" type="slide" axis="1 0 0" range="0 2"/><geom size="0.05"/>
<body name="upper" pos="0.1 0 0"><joint name="shoulder" axis="0 1 0" pos="0 0 0.3" range="-3 3"/><geom size="0.03"/>
<body name="tip" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" range="-3 3"/><geom size="0.03"/></body></body></body></body>
</worldbody></mujoco>"""
"""A rail of two metres under two joints, of which one turns about an axis off its link's origin."""


@pytest.fixture(scope="module")
def railed(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    folder = tmp_path_factory.mktemp("rail")
    (folder / "arm.xml").write_text(ARM)
    values = {"arm": "arm.xml", "hand": "gripper3", "mount": {"link": "tip", "position": [0.05, 0, 0]},
              "home": {"rail": 0.1, "shoulder": 0.2, "elbow": -0.3}, "limits": {"velocity": 1.0, "acceleration": 4.0}}
    (folder / "robot.yaml").write_text(yaml.safe_dump(values))
    return load_robot(folder / "robot.yaml")


def wrists(robot: Robot) -> torch.Tensor:
    """Poses of the wrist in the base's frame, at random and with the rail at its end."""
    arm = np.random.default_rng(0).uniform(*robot.working_range, (4000, len(robot.home)))
    arm[2000:, 0] = robot.working_range[1][0]
    return torch.from_numpy(np.linalg.inv(robot.T_world_base) @ robot.T_world_wrist(arm)).float()


def test_no_grasp_centre_and_no_fingertip_is_beyond_reach(railed: Robot, robot: dro.Robot) -> None:
    for one in (railed, robot):
        T, hand = wrists(one), one.hand
        centre = hand.grasp_centres(T).norm(dim=-1).max()
        q = hand.random_joints(len(T), torch.Generator().manual_seed(0))
        surface = hand.points(q[::20], T[::20]).norm(dim=-1).max()
        assert centre <= one.longest_reach
        assert surface <= one.full_reach
        assert centre < surface, "fingers are longer"
        assert one.longest_reach < 1.4 * centre, "the bound says something"


def test_what_an_object_in_the_hand_could_meet_is_an_obstacle(robot: dro.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    within: list[float] = []

    def noted(scene: dro.Scene, base: np.ndarray, reach: float) -> list[dro.ObjectModel]:
        within.append(reach)
        raise PlanError("enough")

    monkeypatch.setattr(planner, "scene_solid", noted)
    can = dro.load_object("can")
    config = dro.PlanConfig(constraints=dro.Constraints(avoid=dro.load_scene(np.full((10, 3), 0.9))))
    with pytest.raises(PlanError, match="enough"):
        dro.plan(robot, can, config=config)
    T = wrists(robot)[::20]
    fingers = robot.hand.points(robot.hand.canonical_joints().expand(len(T), -1), T).norm(dim=-1).max()
    assert within[0] >= float(fingers) + pdist(np.asarray(can.vertices)[::5]).max()
