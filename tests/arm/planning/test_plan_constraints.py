"""What grasps have to respect, in plans: checked on shapes that the planner does not read, and in the world's frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import dro_grasp as dro
from dro_grasp.arm.planning.candidates import grasps_in_world
from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.planning.planner import plan
from dro_grasp.arm.planning.workcell import Workcell, arm_addresses, robot_spec
from dro_grasp.arm.tabletop.experiment import TabletopConfig
from dro_grasp.errors import NoGraspError, OptionError
from dro_grasp.predict.predictor import Prediction
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.scene import joint_addresses
from tests.helpers.clouds import cloud_of
from tests.helpers.weights import untrained_weights

SHELF = ((0.62, 0.1, 0.5), (0.02, 2.0, 2.0))
"""Centre and size of a board beside the object, larger than any object that is loaded [m]."""


CONE = 0.6


@pytest.fixture(scope="module")
def standing() -> tuple[dro.ObjectModel, np.ndarray]:
    can, T = dro.load_object("can"), np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 2.0).as_matrix()
    T[:3, 3] = 0.5, 0.1, -float(can.cloud[:, 2].min())
    return can, T


@pytest.fixture(scope="module")
def wanted(standing: tuple[dro.ObjectModel, np.ndarray]) -> dro.Constraints:
    (x, y), top = standing[1][:2, 3].tolist(), float(np.ptp(standing[0].cloud[:, 2]))
    board = trimesh.creation.box(extents=SHELF[1])
    board.apply_translation(SHELF[0])
    region = ((x, y, top, 0.07),)
    return dro.Constraints((0.0, 0.0, -1.0), max_tilt=CONE, obstacles=dro.load_scene(board), contact_region=region)


@pytest.fixture(scope="module")
def planned(robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], wanted: dro.Constraints) -> MotionPlan:
    return plan(robot, *standing, config=dro.PlanConfig(num=8, rehearsals=0, trusted_score=-5, constraints=wanted))


def test_the_palm_is_in_the_cone_and_fingers_touch_the_place_alone(
    planned: MotionPlan, robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], wanted: dro.Constraints
) -> None:
    hand, closed = robot.hand, planned.part("close")
    assert hand.description is not None
    wrist = robot.T_world_wrist(planned.arm.position[closed.start])
    palm = hand.palm_directions(torch.from_numpy(wrist).float()[None])[0]
    assert math.acos(-float(palm[2])) <= CONE + 1e-3
    grasp = torch.from_numpy(planned.scene.joints[planned.notes.chosen])
    links = wrist @ hand.tree.forward(grasp.float()).double().numpy()
    shapes = np.concatenate([shape.vertices @ links[shape.link, :3, :3].T + links[shape.link, :3, 3]
                             for shape in hand.description.geometry if shape.collides])
    (x, y, z, radius), (can, T) = wanted.contact_region[0], standing
    apart = KDTree(can.cloud @ T[:3, :3].T + T[:3, 3]).query(shapes)[0]
    beyond = np.linalg.norm(shapes - (x, y, z), axis=1) - radius
    assert (apart < 0.01).any()
    assert apart[beyond > 0.004].min() > 0.001, "where the hand is out of the ball, it is off the object [m]"


def test_hand_and_arm_stay_clear_of_the_scene(planned: MotionPlan, robot: dro.Robot) -> None:
    """The board is one box in MuJoCo; the planner has cells around points of its surface."""
    spec = robot_spec(robot, PROTOCOLS["dro"], None)
    for a, b in Workcell(robot).excluded:
        spec.add_exclude(bodyname1=a, bodyname2=b)
    spec.worldbody.add_geom(name="board", type=mujoco.mjtGeom.mjGEOM_BOX, pos=SHELF[0], size=np.array(SHELF[1]) / 2)
    model = spec.compile()
    data, tree = mujoco.MjData(model), robot.hand.tree
    fingers, moving = joint_addresses(model, robot.hand)
    full = planned.hand.position @ tree.coupling.double().numpy().T + tree.offset.double().numpy()

    def hits(arm: np.ndarray, joints: np.ndarray) -> bool:
        data.qpos[arm_addresses(model, robot)], data.qpos[fingers] = arm, joints[moving]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        return any("board" in {model.geom(g).name for g in contact.geom} for contact in data.contact if contact.dist < 0)

    assert not any(hits(arm, joints) for arm, joints in zip(planned.arm.position, full, strict=True))
    draws = np.random.default_rng(0).uniform(-1.5, 1.5, (50, len(robot.home)))
    assert any(hits(arm, full[0]) for arm in draws), "the check sees an arm that is in the board"


def test_a_frame_turns_directions_and_places_and_lifts_the_table() -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", 0.7).as_matrix(), (1.0, 2.0, 3.0)
    ball, direction = (0.1, -0.2, 0.3, 0.04), (0.6, 0.0, -0.8)
    scene = dro.load_scene(np.random.default_rng(0).uniform(0, 1, (50, 3)))
    there = dro.Constraints(direction, 0.5, 0.3, scene, (ball,), (ball,), 0.01).moved(T)
    turn = Rotation.from_euler("z", 0.7)
    np.testing.assert_allclose(there.direction or (), turn.apply(direction))
    np.testing.assert_allclose(there.contact_region[0], [*np.add(turn.apply(ball[:3]), T[:3, 3]), 0.04])
    assert (there.table, there.max_tilt, there.pregrasp_clearance, there.keep_out) == (3.5, 0.3, 0.01, there.contact_region)
    assert there.obstacles is not None
    np.testing.assert_allclose(there.obstacles.points, np.add(turn.apply(scene.points), T[:3, 3]))
    T[:3, :3] = Rotation.from_euler("x", 0.7).as_matrix()
    with pytest.raises(OptionError, match="the other frame's z axis points elsewhere"):
        dro.Constraints(table=0.0).moved(T)


def test_what_grasps_are_given_is_checked_as_well(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    request = dro.GraspRequest(4, candidates=1)
    grasps = grasps_in_world(dro.GraspPredictor(), robot.hand, *standing, request, dro.Constraints(table=0.0))
    x, y = standing[1][:2, 3].tolist()
    config = dro.PlanConfig(constraints=dro.Constraints(keep_out=((x, y, 0.06, 0.06),)))
    with pytest.raises(dro.DroGraspError, match=r"4 grasps: 4 in a place to spare, .* keep_out or pregrasp_clearance"):
        plan(robot, *standing, config=config, grasps=grasps)


def test_what_says_nothing_or_says_it_twice_is_refused(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray]
) -> None:
    with pytest.raises(OptionError, match="state its height in the robot file"):
        dro.PlanConfig(constraints=dro.Constraints(table=0.0))
    with pytest.raises(OptionError, match="both direction and directions 'paper'"):
        dro.PlanConfig(directions="paper", constraints=dro.Constraints((0, 0, -1)))
    with pytest.raises(OptionError, match=r"contact_region is not on the object: .* z = 0.0"):
        plan(robot, *standing, config=dro.PlanConfig(constraints=dro.Constraints(contact_region=((0.0, 0.0, 0.0, 0.05),))))
    with pytest.raises(OptionError, match="objects of attempts come to rest anywhere"):
        TabletopConfig(plan=dro.PlanConfig(constraints=dro.Constraints(keep_out=((0.0, 0.0, 0.0, 0.05),))))


class Listener(dro.GraspPredictor):
    """Notes the least confidence of every request, and the room that it wants between fingers and object; makes nothing."""

    def __init__(self) -> None:
        self.device, self.asked, self.room = "cpu", list[float | None](), list[float | None]()

    def run(self, problem: GraspProblem, request: dro.GraspRequest) -> Prediction:
        self.asked.append(request.least_confidence)
        self.room.append(problem.constraints.pregrasp_clearance)
        raise NoGraspError("nothing is made")

    def rounds(self, problem: GraspProblem, request: dro.GraspRequest) -> Iterator[dro.GraspBatch]:
        self.run(problem, request)
        yield from ()


@pytest.mark.parametrize(("directions", "each"), [("all", 1), ("paper", 2)])
@pytest.mark.parametrize("least", [0.0, 0.6, None])
def test_every_batch_is_asked_for_with_the_least_confidence(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], directions: Literal["all", "paper"], each: int,
    least: float | None
) -> None:
    listener = Listener()
    config = dro.PlanConfig(num=2, batches=2, directions=directions, least_confidence=least)
    with pytest.raises(dro.DroGraspError, match="nothing is made"):
        plan(robot, *standing, predictor=listener, config=config)
    assert listener.asked == [config.doubtful if least is None else least] * each + [least or 0.0] * each


@pytest.mark.parametrize(("guessed", "config", "room"), [
    (True, {}, [0.015, None, None]), (False, {}, [None] * 3), (True, {"batches": 1}, [None]),
    (True, {"guess_clearance": 0.0}, [None] * 3), (True, {"guess_clearance": 0.02, "batches": 2}, [0.02, None]),
    (True, {"constraints": dro.Constraints(pregrasp_clearance=0.007)}, [0.007] * 3)])
def test_the_first_grasps_of_what_was_partly_guessed_leave_room_between_the_fingers(
    robot: dro.Robot, guessed: bool, config: dict[str, Any], room: list[float | None]
) -> None:
    mesh = trimesh.creation.icosphere(4, 0.04)
    mesh.apply_translation((0.45, 0.0, 0.04))
    ball = cloud_of(mesh, "ball")
    listener, obj = Listener(), replace(ball, seen=ball.cloud[ball.cloud_normals[:, 0] < 0]) if guessed else ball
    with pytest.raises(dro.DroGraspError, match="nothing is made"):
        plan(robot, obj, predictor=listener, config=dro.PlanConfig(num=2, **config))
    assert listener.room == room


@pytest.mark.parametrize("room", [-0.01, 0.3])
def test_room_that_no_hand_leaves_is_refused(room: float) -> None:
    with pytest.raises(OptionError, match=f"guess_clearance is {room}; give metres from 0 to 0.2"):
        dro.PlanConfig(guess_clearance=room)


def test_grasps_below_the_least_confidence_are_not_tried(
    robot: dro.Robot, standing: tuple[dro.ObjectModel, np.ndarray], tmp_path: Path
) -> None:
    """Untrained weights alone make none that surely holds; the same grasps are tried where nothing is demanded."""
    predictor = dro.GraspPredictor(str(untrained_weights(tmp_path)))
    config = dro.PlanConfig(num=2, batches=1, rehearsals=0, source="network", best_seconds=30, planner_seconds=30)
    with pytest.raises(dro.DroGraspError, match=r"only 0 of \d+ candidates .* probability below 99 %"):
        plan(robot, *standing, predictor=predictor, config=replace(config, least_confidence=0.99))
    made = plan(robot, *standing, predictor=predictor, config=replace(config, least_confidence=0.0))
    assert made.notes.grasps == 2
    assert torch.tensor(made.notes.score).sigmoid() < 0.99


def test_where_no_grasp_respects_the_constraints_the_plan_says_so(robot, standing) -> None:
    """Not that the object is out of reach, or that nothing was dropped."""
    wanted = dro.PlanConfig(num=2, batches=1, rehearsals=0, constraints=dro.Constraints(pregrasp_clearance=0.19))
    with pytest.raises(dro.DroGraspError, match=r"only 0 of \d+ candidates .* too close in pregrasp.* less pregrasp_clearance"):
        plan(robot, *standing, config=wanted)


@pytest.mark.parametrize(("name", "value"), [
    ("rehearsals", -1), ("candidates", -1), ("closing_seconds", -1.0), ("grip_seconds", math.nan), ("best_seconds", math.inf)])
def test_plans_of_impossible_numbers_are_refused(name: str, value: float) -> None:
    with pytest.raises(OptionError, match=f"{name} is {value}; give"):
        dro.PlanConfig(**{name: value})
