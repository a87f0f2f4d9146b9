"""Lifts in simulation: servos, what rests on the table, and grasps that let go, told by rehearsals from those that hold."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

import dro_grasp as dro
from dro_grasp.arm.clearing.trial import ClearTrialConfig
from dro_grasp.arm.planning.candidates import grasps_in_world
from dro_grasp.arm.planning.motion import Trajectory
from dro_grasp.arm.planning.physics import DEVIATIONS, MEMORY, Deviation, LiftScene, Rehearsal, guessed_farther
from dro_grasp.arm.planning.planner import plan
from dro_grasp.arm.planning.reachability import Fault, Feasible, Postures
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.arm.tabletop.experiment import TabletopConfig
from dro_grasp.errors import OptionError
from dro_grasp.objects.shape import GUESSED_FROM, solid_of
from tests.helpers.claw import claw_xml
from tests.helpers.clouds import cloud_of

RADIUS = 0.04


@pytest.fixture(scope="module")
def ball() -> dro.ObjectModel:
    """Stands on a table at z = 0 within reach."""
    mesh = trimesh.creation.icosphere(4, RADIUS)
    mesh.apply_translation((0.45, 0.0, RADIUS))
    return cloud_of(mesh, "ball")


def test_an_estimated_object_stands_still_on_the_table(robot: dro.Robot, ball: dro.ObjectModel) -> None:
    scene = LiftScene(Workcell(robot), [ball])
    assert scene.model.narena == MEMORY  # MuJoCo's own choice ends in a fatal error where many balls touch the hand
    scene.place(0, np.eye(4))
    scene.advance(1.0)
    assert np.abs(scene.pose(0) - np.eye(4)).max() < 2e-3
    body = scene.model.body("object0-").id
    touching = scene.model.geom_bodyid[scene.data.contact.geom].reshape(-1, 2)
    assert (touching == body).any()
    assert mujoco.mj_getTotalmass(scene.model) > scene.model.body_mass[body] == pytest.approx(500 * solid_of(ball).volume)


def test_what_lies_and_was_seen_from_one_side_stays_where_it_lies(robot: dro.Robot) -> None:
    """Its lowest known points are then on the side of the camera, and not below its middle."""
    mesh = trimesh.creation.cylinder(0.035, 0.12, transform=trimesh.transformations.rotation_matrix(math.pi / 2, (1, 0, 0)))
    mesh.apply_translation((0.45, 0.0, 0.035))
    whole = cloud_of(mesh, "roll")
    normals = whole.cloud_normals
    shown = (normals @ np.float32((0.8, 0.0, 0.6)) > -0.4) & (normals[:, 2] > -0.97) & (np.abs(normals[:, 1]) < 0.5)
    part = replace(whole, cloud=whole.cloud[shown], cloud_normals=normals[shown])
    lowest = part.cloud[part.cloud[:, 2] < part.cloud[:, 2].min() + 0.004]
    assert lowest[:, 0].min() > part.centre_of_mass[0]
    scene = LiftScene(Workcell(robot), [part])
    scene.place(0, np.eye(4))
    scene.advance(1.0)
    T = scene.pose(0)
    assert np.linalg.norm(part.cloud @ T[:3, :3].T + T[:3, 3] - part.cloud, axis=1).max() < 2e-3


@pytest.mark.parametrize("limits", ["-30 30", "10 40"], ids=["at zero", "away from zero"])
def test_joints_above_the_palm_stay_and_the_others_follow(robot: dro.Robot, tmp_path: Path, limits: str) -> None:
    """As the two of the wrist of a Shadow hand; those at zero are no joints of the scene."""
    file = tmp_path / "wrist.xml"
    forearm = '<body name="forearm"><geom type="box" size="0.03 0.03 0.03" mass="0.3" pos="0 0 -0.1"/><body name="palm">'
    xml = claw_xml().replace('<body name="palm">', f'{forearm}<joint name="wrist" axis="0 1 0" range="{limits}"/>')
    file.write_text(xml.replace("</worldbody>", "</body></worldbody>"))
    hand = dro.load_hand(file)
    assert hand.movable.tolist() == [False, *8 * [True]]
    scene, arm = LiftScene(Workcell(replace(robot, hand=hand)), []), robot.home
    before = scene.joints()[1]
    wanted = hand.canonical_joints(0.7).double().numpy()
    scene.command(arm, np.zeros_like(arm), wanted)
    scene.advance(1.0)
    np.testing.assert_allclose(scene.joints()[1], wanted, atol=0.03)
    assert scene.joints()[1][0] == pytest.approx(float(hand.rest[0]), abs=5e-3)
    assert (np.abs(wanted - before)[1:] > 0.07).all()


@pytest.mark.parametrize("friction", [0.3, 0.5])
def test_a_block_slides_on_a_table_that_is_tilted_beyond_the_angle_of_friction(robot: dro.Robot, friction: float) -> None:
    """Instead of the table, gravity is tilted: the block slides where the tangent of the angle is above the coefficient."""
    block, slid = dro.load_object("flat_box"), []
    for factor in (0.9, 1.15):
        scene = LiftScene(Workcell(robot), [block], friction=friction)
        T = np.eye(4)
        T[:3, 3] = 0.5, 0.0, -float(block.cloud[:, 2].min())
        scene.place(0, T)
        scene.advance(0.3)
        start, angle = scene.pose(0)[:3, 3], math.atan(factor * friction)
        scene.model.opt.gravity[:] = 9.81 * np.array([0.0, math.sin(angle), -math.cos(angle)])
        scene.advance(0.4)
        slid.append(float(np.linalg.norm(scene.pose(0)[:3, 3] - start)))
    # From rest, along a = g (sin - mu cos).
    angle = math.atan(1.15 * friction)
    assert slid[0] < 1e-3
    assert slid[1] == pytest.approx(9.81 * (math.sin(angle) - friction * math.cos(angle)) * 0.4**2 / 2, rel=0.15)


def test_what_is_no_friction_is_refused() -> None:
    for settings in (TabletopConfig, ClearTrialConfig, PlanConfig):
        with pytest.raises(OptionError, match=r"friction is 0\.0; give a coefficient above 0, such as 0\.5"):
            settings(friction=0.0)


@pytest.fixture(scope="module")
def grasps(robot: dro.Robot, ball: dro.ObjectModel) -> dro.GraspBatch:
    request = dro.GraspRequest(12, candidates=1)
    return grasps_in_world(dro.GraspPredictor(), robot.hand, ball, np.eye(4), request, dro.Constraints(table=0.0))


def evenly(robot: dro.Robot, rows: np.ndarray, distance: float) -> np.ndarray:
    """Configurations along the same line whose wrists are this far apart [m]."""
    places = robot.T_world_wrist(rows)[:, :3, 3]
    way = np.linalg.norm(places - places[0], axis=1)
    wanted = np.linspace(0, way[-1], round(float(way[-1]) / distance) + 1)
    return np.stack([np.interp(wanted, way, column) for column in rows.T], 1)


def test_the_chosen_grasp_holds_and_one_that_never_closes_does_not(
    robot: dro.Robot, ball: dro.ObjectModel, grasps: dro.GraspBatch
) -> None:
    planned = plan(robot, ball, grasps=grasps)
    rows, closed, hand = planned.part("approach"), planned.part("close"), planned.hand.position
    chosen = Feasible(planned.notes.chosen, planned.arm.position[rows][:: max(1, (rows.stop - rows.start) // 10)],
                      planned.arm.position[planned.part("lift")][::10])
    postures = Postures.of(robot, grasps, chosen.index)
    assert np.allclose(postures.squeeze, hand[closed.stop - 1], atol=1e-6)
    cell = Workcell(robot, (), ball)
    rehearsal = Rehearsal(cell)
    first = rehearsal.rehearse(chosen, postures)
    assert first.share > 0
    never = rehearsal.rehearse(chosen, replace(postures, grasp=postures.pregrasp, squeeze=postures.pregrasp))
    assert (never.share, never.T_world_wrist) == (0, None)
    assert rehearsal.rehearse(chosen, postures).share == first.share  # nothing is left from the one before
    assert planned.notes.seconds["rehearsal"] > 0
    for distance in (0.005, 0.02):  # between the poses that were solved; nothing depends on it
        line = replace(chosen, approach=evenly(robot, chosen.approach, distance), lift=evenly(robot, chosen.lift, distance))
        assert rehearsal.grip(line, postures, DEVIATIONS[0]) is not None
    rehearsal = Rehearsal(cell, few_contacts=12)
    seen, scene = [], rehearsal.scene(DEVIATIONS[0])
    honest = scene.advance

    def advance(*arguments: float, **options: float) -> None:
        seen.append((scene.data.ncon > 12, scene.model.opt.noslip_iterations == 0))
        honest(*arguments, **options)

    scene.advance = advance
    rehearsal.grip(chosen, postures, DEVIATIONS[0])
    assert set(seen) == {(False, False), (True, True)}  # many contacts cost no more than in proportion


@pytest.mark.parametrize("timestep", [0.002, 0.003, 0.004])
def test_a_trajectory_takes_its_own_time_whatever_the_time_step(robot: dro.Robot, timestep: float) -> None:
    scene, time = LiftScene(Workcell(robot), []), np.arange(31) * 0.0095
    scene.model.opt.timestep = timestep
    arm, hand = np.tile(robot.home, (31, 1)), np.tile(robot.open_hand, (31, 1))
    before = scene.data.time
    scene.follow(Trajectory(time, arm, 0 * arm, 0 * arm), Trajectory(time, hand, 0 * hand, 0 * hand), slice(2, 31))
    assert scene.data.time - before == pytest.approx(time[30] - time[2], abs=timestep)


@pytest.mark.parametrize("distance", [-0.01, 0.005])
def test_what_was_not_seen_is_guessed_farther_as_far_as_the_table_leaves_room(
    robot: dro.Robot, ball: dro.ObjectModel, distance: float
) -> None:
    seen = ball.cloud[ball.cloud_normals @ np.float32((0.6, 0.0, 0.8)) > 0]
    assert robot.table is not None
    height = robot.table.height
    guess = replace(ball, seen=seen)
    farther = guessed_farther(guess, distance, robot.table)
    radius = np.linalg.norm(farther.cloud - (0.45, 0.0, RADIUS), axis=1)
    away = np.linalg.norm(ball.cloud[:, None] - seen[None, ::7], axis=2).min(1)  # to some of them: never nearer than to all
    hidden = (away > GUESSED_FROM + 0.005) & (farther.cloud[:, 2] > height + 1e-4)
    shown = ball.cloud_normals @ np.float32((0.6, 0.0, 0.8)) > 0
    assert hidden.sum() > 100 < shown.sum()
    np.testing.assert_allclose(radius[hidden], RADIUS + distance, atol=1e-3)
    np.testing.assert_allclose(radius[shown], RADIUS, atol=1e-3)
    assert farther.cloud[:, 2].min() >= min(height, float(ball.cloud[:, 2].min())) - 1e-6
    assert farther.sha256 != guess.sha256


def test_only_guesses_are_rehearsed_as_lying_farther(robot: dro.Robot, ball: dro.ObjectModel) -> None:
    deviations = Deviation(), Deviation(weight=2.0), Deviation(unseen=0.01)
    assert Rehearsal(Workcell(robot, (), ball), deviations).deviations == list(deviations[:2])
    guess = replace(ball, seen=ball.cloud[ball.cloud_normals[:, 0] < 0])
    rehearsal = Rehearsal(Workcell(robot, (), guess), deviations)
    assert rehearsal.deviations == list(deviations)
    usual, heavy, thick = map(rehearsal.scene, deviations)
    assert usual is heavy
    body = "object0-"
    assert thick.model.body(body).mass[0] > 1.05 * usual.model.body(body).mass[0]


def test_where_none_holds_the_best_score_is_taken_all_the_same(
    robot: dro.Robot, ball: dro.ObjectModel, grasps: dro.GraspBatch
) -> None:
    heavy = Deviation(weight=100.0)
    made = plan(robot, ball, config=PlanConfig(deviations=(heavy,)), grasps=grasps)
    assert made.notes.chosen == plan(robot, ball, config=PlanConfig(rehearsals=0), grasps=grasps).notes.chosen
    sometimes = PlanConfig(deviations=(Deviation(), heavy, Deviation()))
    assert Fault.LOSES not in plan(robot, ball, config=sometimes, grasps=grasps).notes.dropped


def test_servos_follow_a_trajectory_within_a_degree(robot: dro.Robot) -> None:
    scene = LiftScene(Workcell(robot), [dro.load_object("can")])
    hand, worst = scene.joints()[1], 0.0
    for k in range(100):
        target, velocity = robot.home.copy(), np.zeros(7)
        target[0] += 0.3 * (1 - np.cos(np.pi * k / 50))
        velocity[0] = 0.3 * np.pi * np.sin(np.pi * k / 50)
        scene.command(target, velocity, hand)
        scene.advance(0.02)
        worst = max(worst, float(np.abs(scene.joints()[0] - target).max()))
    assert worst < np.radians(2)
