"""Flat things on a table: what a camera's pixels say of them, how a hand takes hold of them, and pushes to the table's edge."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import dro_grasp as dro
from dro_grasp.apps.viewer.lift_page import Film
from dro_grasp.arm.flat import plans
from dro_grasp.arm.flat.grips import flat_grasps, overhangs
from dro_grasp.arm.flat.plans import plan_or_slide
from dro_grasp.arm.flat.postures import AHEAD, OVER, WorkingHand, flat_grips
from dro_grasp.arm.flat.sliding import SlideConfig, _Pusher, pushes, slide
from dro_grasp.arm.flat.things import flat_object, overhang, seen_flat, width_of
from dro_grasp.arm.planning.motion import SLIDING, MotionPlan
from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Robot, Table
from dro_grasp.arm.tabletop.experiment import TabletopConfig, attempt, carry_out
from dro_grasp.cli.given_scene import SceneOptions, find_on_table
from dro_grasp.cli.robots import Plan
from dro_grasp.errors import ObjectError, OptionError, PlanError
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.perception.scene_files import SceneCamera
from dro_grasp.objects.scenery import load_scene

TABLE = Table(0.02, (0.45, 0.0), (1.2, 0.6))
EYE = np.array([0.95, 0.0, 0.8])


def card_points(draw: np.random.Generator, turn: float = 0.5, noise: float = 0.001) -> np.ndarray:
    """Points of the top of a card of 86 x 54 x 1 mm on the table, with noise along the camera's rays."""
    flat = draw.uniform((-0.043, -0.027), (0.043, 0.027), (1500, 2))
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    points = np.column_stack([flat @ R.T + (0.5, 0.1), np.full(len(flat), TABLE.height + 0.001)])
    ray = points - EYE
    return points + draw.normal(0, noise, (len(flat), 1)) * ray / np.linalg.norm(ray, axis=1, keepdims=True)


def board(size: tuple[float, float, float], place: tuple[float, float], turn: float = 0.0) -> dro.ObjectModel:
    """A box that lies on a table at height 0."""
    box = trimesh.creation.box(size, trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
    box.apply_translation((*place, size[2] / 2))
    return dro.load_object(box, name="board")


@pytest.fixture(scope="module")
def narrow(robot: Robot) -> Robot:
    """A robot whose table has an edge within reach."""
    return replace(robot, table=Table(0.0, (0.45, 0.0), (1.2, 0.6)))


def test_overhang_is_the_way_out_of_the_rectangle() -> None:
    draw = np.random.default_rng(0)
    points = draw.uniform((-0.5, -0.6, 0), (1.4, 0.6, 1), (200, 3))
    for point, found in zip(points, overhang(points, TABLE), strict=True):
        assert found == pytest.approx(max(-0.15 - point[0], point[0] - 1.05, -0.3 - point[1], point[1] - 0.3))


@pytest.mark.parametrize("number", [600, 2000])
@pytest.mark.parametrize(
    ("shape", "width"), [("disc", 0.12), ("square", 0.09), ("strip", 0.03), ("hammer", 0.0375), ("ring", 0.015)])
def test_the_width_is_that_of_the_largest_circle_within(shape: str, width: float, number: int) -> None:
    """Head and handle of the hammer are 3 cm wide; a circle between the face and the two inner corners is a little wider."""
    x, y = np.random.default_rng(0).uniform(-0.15, 0.15, (2, 200_000))
    away = np.hypot(x, y)
    within = {"disc": away < 0.06, "square": np.maximum(abs(x), abs(y)) < 0.045, "strip": (abs(x) < 0.1) & (abs(y) < 0.015),
              "hammer": (abs(x) < 0.12) & (abs(y) < 0.015) | (abs(x - 0.12) < 0.015) & (abs(y) < 0.05),
              "ring": (away < 0.05) & (away > 0.035)}[shape]
    points = np.column_stack([x[within], y[within], 0 * x[within]])[:number] + 0.4
    assert width_of(points) == pytest.approx(width, rel=0.15, abs=0.004)


def test_a_card_is_seen_to_a_millimetre() -> None:
    """Depth has more noise than the card is thick; its pixels know better."""
    obj = flat_object("card", card_points(np.random.default_rng(1)), EYE, TABLE.height)
    assert obj.vertices is not None
    along = np.array([math.cos(0.5), math.sin(0.5)])
    sides = obj.vertices[:, :2] @ np.stack([along, [-along[1], along[0]]]).T
    assert np.allclose(np.ptp(sides, axis=0), (0.086, 0.054), atol=0.0025)
    assert np.allclose(obj.centre_of_mass, (0.5, 0.1, TABLE.height + 0.0005), atol=0.0015)
    assert obj.vertices[:, 2].min() == pytest.approx(TABLE.height)
    assert 0.001 <= np.ptp(obj.vertices[:, 2]) < 0.0015


def test_an_outline_with_a_corner_keeps_it() -> None:
    draw = np.random.default_rng(2)
    long, foot = draw.uniform((0, 0), (0.2, 0.02), (2000, 2)), draw.uniform((0.16, 0), (0.2, 0.08), (1000, 2))
    flat = np.concatenate([long, foot])
    flat[:, 0] += 0.4
    obj = flat_object("square", np.column_stack([flat, np.full(len(flat), TABLE.height + 0.004)]), EYE, TABLE.height)
    area = 0.2 * 0.02 + 0.04 * 0.06
    assert len(obj.parts) > 1
    assert obj.volume == pytest.approx(0.004 * area, rel=0.15)


def test_a_thing_far_from_the_camera_keeps_what_overhangs() -> None:
    """Pixels that meet it at a glancing angle are 6 to 12 mm apart; stray ones beside it are left out."""
    draw = np.random.default_rng(4)
    rows = -0.05 - np.cumsum(np.linspace(0.006, 0.012, 18))
    x, y = np.meshgrid(rows, np.arange(-0.07, 0.07, 0.0065))
    flat = np.column_stack([x.ravel(), y.ravel()]) + draw.normal(0, 0.0005, (x.size, 2))
    stray = [[rows.min() - 0.04, 0.0], [rows.min() - 0.05, 0.05], [0.0, 0.03]]
    points = np.column_stack([np.concatenate([flat, stray]), np.full(x.size + 3, TABLE.height + 0.01)])
    obj = flat_object("board", points, EYE, TABLE.height)
    assert obj.vertices is not None
    assert np.allclose(obj.vertices[:, :2].min(0), flat.min(0), atol=0.004)
    assert np.allclose(obj.vertices[:, :2].max(0), flat.max(0), atol=0.004)


def test_what_is_seen_flat(narrow: Robot, tmp_path: Path) -> None:
    """Table and card, and a can beside it, which is not flat."""
    draw = np.random.default_rng(3)
    plane = np.column_stack([draw.uniform((0.2, -0.25), (0.8, 0.25), (6000, 2)), draw.normal(TABLE.height, 0.001, 6000)])
    can = np.column_stack([draw.uniform((0.4, -0.15), (0.46, -0.09), (400, 2)), draw.uniform(0.03, 0.12, 400)])
    points = np.concatenate([plane, can, card_points(draw)])
    of_card = np.arange(len(points)) >= len(plane) + len(can)
    of_can = (np.arange(len(points)) >= len(plane)) & ~of_card
    table = replace(TABLE, height=0.0)
    found = seen_flat("card", points, of_card, table, EYE)
    assert found is not None
    assert found.table == pytest.approx(TABLE.height, abs=3e-4)
    assert np.allclose(found.obj.centre_of_mass[:2], (0.5, 0.1), atol=0.002)
    assert np.allclose(found.others[0].cloud[:, :2].mean(0), (0.43, -0.12), atol=0.01)
    assert seen_flat("can", points, of_can, table, EYE) is None
    T = np.diag([1.0, -1.0, -1.0, 1.0])  # it looks down
    T[:3, 3] = EYE
    scene = load_scene(((points - EYE) @ T[:3, :3])[None], camera=SceneCamera(T, None, "world"))
    picked = dro.pick_object(scene, narrow, mask=of_card[None], name="card")
    assert np.allclose(picked.obj.centre_of_mass, found.obj.centre_of_mass, atol=1e-4)
    assert picked.robot.table is not None
    assert picked.robot.table.height == pytest.approx(TABLE.height, abs=3e-4)
    assert picked.robot.table.size == narrow.table.size  # type: ignore[union-attr]
    choice = Plan("xarm7_leaphand", seen=SceneOptions(Path("scene"), mask=tmp_path / "m.png", scene_picture=tmp_path / "s.png"))
    Image.fromarray(255 * of_card[None].astype(np.uint8)).save(tmp_path / "m.png")
    again = find_on_table(scene, narrow, choice)
    assert np.allclose(again.obj.centre_of_mass, found.obj.centre_of_mass, atol=1e-4)
    with Image.open(tmp_path / "s.png") as drawn:
        colours = np.unique(np.asarray(drawn.convert("RGB"))[:450].reshape(-1, 3).astype(int), axis=0)
    assert (colours @ (1, 0, -1)).max() > 60, "the card is orange"
    with pytest.raises(ObjectError, match="has 10 points, and at least 30 are needed"):
        flat_object("card", card_points(draw)[:10], EYE, 0.0)


@pytest.mark.parametrize("name", ["leaphand", "allegro"])
def test_thumb_and_fingers_are_on_both_sides_of_a_slab(name: str) -> None:
    """By all surface points of the hand, not the search's own costs."""
    working = WorkingHand.of(dro.load_hand(name))
    pointing = [working.tip(f, working.pointing) for f in working.fingers]
    ends = [float(tip[:, AHEAD].max()) for tip in pointing]
    assert max(ends) - min(ends) < 0.002
    thumb = working.hand.thumb
    assert thumb is not None
    assert float(working.tip(thumb, working.pointing)[:, AHEAD].max()) < min(ends) - 0.05
    axes = working.axes.double().numpy()
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(axes) == pytest.approx(1)
    grip = flat_grips(working, 0.005)[0]
    for q, gap in ((grip.grasp, 0.0), (grip.pregrasp, 0.012)):
        for finger in working.fingers:
            assert float(working.tip(finger, q)[:, OVER].min()) > grip.face + gap - 0.002
        assert float(working.tip(thumb, q)[:, OVER].max()) < grip.face - 0.005 - gap + 0.002


def test_a_hand_without_a_thumb_takes_nothing_flat() -> None:
    with pytest.raises(OptionError, match="has no thumb and two fingers beside it"):
        WorkingHand.of(dro.load_hand("gripper3"))


@pytest.mark.parametrize("radius", [0.01, 0.013])
def test_round_tips_hold_no_low_edges(radius: float) -> None:
    """Where the normal faces down by more than the angle of friction, two equal pushes have no part that lifts."""
    friction = 0.5
    for height in np.linspace(0.001, 0.99 * radius, 30):
        down = math.asin(1 - height / radius)
        normal, tangent = np.array([math.cos(down), -math.sin(down)]), np.array([math.sin(down), math.cos(down)])
        lifts = (normal + friction * tangent)[1] > 0
        assert lifts == (height > (1 - math.sin(math.atan(friction))) * radius)
    assert 1 - math.sin(math.atan(friction)) == pytest.approx(0.553, abs=1e-3)


def test_what_overhangs_does_not_creep_over_the_edge() -> None:
    config, table = SlideConfig(), Table(0.0, (0.45, 0.0), (1.2, 0.6))
    for place, some in ((0.2575, True), (0.2775, False)):  # the board overhangs by 1 cm, which is pushed on, and by 3
        thing = board((0.11, 0.11, 0.005), (0.45, place), 0.0)
        ahead = [p for p in pushes(np.asarray(thing.cloud, float), thing.centre_of_mass, table, config)
                 if p.direction[1] > 0.99]
        assert bool(ahead) == some


def test_pushes_bring_things_to_overhang() -> None:
    config, table = SlideConfig(), Table(0.0, (0.45, 0.0), (1.2, 0.6))
    card = board((0.09, 0.06, 0.002), (0.45, 0.1), 0.4)
    points = np.asarray(card.cloud, float)
    found = pushes(points, card.centre_of_mass, table, config)
    assert len(found) >= 10
    assert found[0].direction.tolist() == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)
    for push in found:
        there = points @ push.motion[:3, :3].T + push.motion[:3, 3]
        out = overhang(there, table)
        middle = push.motion[:3, :3] @ card.centre_of_mass + push.motion[:3, 3]
        assert 0.015 <= out.max() <= config.most + 1e-6
        assert overhang(middle[None], table)[0] <= -config.balance + 1e-6  # it does not tip over the edge
        assert np.allclose(middle - card.centre_of_mass, push.length * push.direction, atol=1e-9)


def test_long_things_turn_to_the_fingers() -> None:
    table, pen = Table(0.0, (0.45, 0.0), (1.2, 0.6)), board((0.15, 0.01, 0.01), (0.45, 0.1), 0.3)
    points = np.asarray(pen.cloud, float)
    found = pushes(points, pen.centre_of_mass, table, SlideConfig())
    assert found
    for push in found:
        axis = push.motion[:3, :3] @ (math.cos(0.3), math.sin(0.3), 0.0)
        assert abs(float(axis @ push.direction)) < 0.05
        assert push.motion[0, 0] > math.cos(math.pi / 2) - 1e-6  # by a quarter turn at most
        assert abs(float(push.direction @ (0, 1, 0))) < 0.99  # straight out it would lie along the edge, and not overhang


@pytest.fixture(scope="module")
def pushed(narrow: Robot) -> tuple[dro.ObjectModel, MotionPlan]:
    thing = board((0.11, 0.09, 0.005), (0.4, -0.1), 0.3)
    return thing, plan_or_slide(narrow, thing)


def test_a_push_ends_in_an_overhang(narrow: Robot, pushed: tuple[dro.ObjectModel, MotionPlan]) -> None:
    """In MuJoCo, with friction 0.5 between all: the thing overhangs, has not tipped, and the hand is home."""
    thing, made = pushed
    assert made.notes.slide is not None
    assert made.notes.robot_file == narrow.source != ""
    scene = LiftScene(Workcell(narrow), [thing])
    scene.place(0, np.eye(4))
    for stage in SLIDING:
        scene.follow(made.arm, made.hand, made.part(stage))
    T = scene.pose(0)
    out = overhang(thing.vertices @ T[:3, :3].T + T[:3, 3], narrow.table)  # type: ignore[arg-type]
    assert 0.015 < out.max() < 0.07
    assert T[2, 2] > 0.999
    assert np.abs(scene.joints()[0] - narrow.home).max() < 0.02
    assert not scene.touched(0)


def test_pushes_that_end_on_the_floor_are_left_out(narrow: Robot) -> None:
    """A naive twin pushes without looking ahead: the thing falls."""
    thing = board((0.11, 0.09, 0.005), (0.4, -0.1), 0.3)
    far = SlideConfig(share=0.9, most=0.09, balance=-0.03, turns=(0.0,), rehearsed=False)
    made = slide(narrow, thing, config=far)
    scene = LiftScene(Workcell(narrow), [thing])
    scene.place(0, np.eye(4))
    scene.follow(made.arm, made.hand, slice(0, made.part("retreat").stop))
    assert scene.pose(0)[2, 3] < -0.1
    with pytest.raises(PlanError, match="falls off the table in all"):
        slide(narrow, thing, config=replace(far, rehearsed=True))


def test_a_push_as_a_plan(narrow: Robot, pushed: tuple[dro.ObjectModel, MotionPlan], tmp_path: Path) -> None:
    _, made = pushed
    assert made.stages == SLIDING
    assert sorted(set(made.stage.tolist())) == list(range(len(SLIDING)))
    assert (np.abs(made.arm.velocity) <= narrow.velocity + 1e-6).all()
    assert (np.abs(made.arm.acceleration) <= narrow.acceleration + 1e-6).all()
    assert (np.diff(made.arm.time) > 0).all()
    assert np.abs(np.diff(made.arm.position, axis=0)).max() < 0.05
    wrists = narrow.T_world_wrist(made.arm.position[made.part("slide")])
    assert np.ptp(wrists[:, 2, 3]) < 0.002  # level
    made.save(tmp_path / "push.npz")
    again = MotionPlan.load(tmp_path / "push.npz")
    assert again.stages == SLIDING
    assert again.notes.slide == made.notes.slide
    assert {row.split(",")[1] for row in dro.trajectory_csv(again).splitlines()[1:]} == set(SLIDING)
    assert "pushes object 'board'" in dro.trajectory_yaml(again)
    assert [stage["name"] for stage in dro.task_stages(again, narrow)][-3:] == ["retreat", "open again", "look again"]
    assert "then look again, and plan again" in made.lines()[0]
    T, turned = np.array(made.notes.slide), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    middle = made.scene.points.mean(0)
    T[:3, :3], T[:3, 3] = turned, middle + np.array([0.2, 0, 0]) - turned @ middle
    assert "pushed by 20 cm" in replace(made, notes=replace(made.notes, slide=T.tolist())).lines()[0], "however it turns"
    film = Film.of_plan(narrow, again)
    assert np.array_equal(film.poses[0, 0], np.eye(4))
    assert np.allclose(film.poses[-1, 0], np.array(made.notes.slide))
    with pytest.raises(PlanError, match="plan again"):
        again.check_hold(np.zeros(16))


def test_nothing_is_pushed_through_other_things(narrow: Robot) -> None:
    thing = board((0.11, 0.09, 0.005), (0.4, -0.1))
    walls = [board((0.6, 0.02, 0.1), (0.45, y)) for y in (-0.18, 0.25)]
    with pytest.raises(PlanError, match="the arm reaches no edge of the table"):
        slide(narrow, thing, walls)
    with pytest.raises(PlanError, match=r"reaches no edge .*, and things stand in the way of \d+ pushes; move them"):
        slide(replace(narrow, camera=None), thing, [*walls, board((0.02, 0.4, 0.1), (0.7, 0.0))])
    with pytest.raises(PlanError, match="has no table; state its centre and size"):
        slide(replace(narrow, table=None), thing)


def test_nothing_is_pushed_to_where_the_camera_does_not_look(narrow: Robot) -> None:
    thing = board((0.11, 0.09, 0.005), (0.4, -0.1), 0.3)
    assert narrow.camera is not None
    aside = replace(narrow.camera, T_world_camera=narrow.camera.T_world_camera + np.array([[0.0, 0, 0, 2]] + [[0] * 4] * 3))
    with pytest.raises(PlanError, match=r"no edge of the table at which the camera would see it: .* turn the camera"):
        slide(replace(narrow, camera=aside), thing)
    assert slide(replace(narrow, camera=None), thing).notes.slide is not None


@pytest.mark.parametrize("name", ["ur5e_allegro", "xarm7_leaphand"])
def test_cameras_of_built_in_robots_see_what_overhangs_beside_the_arm(name: str) -> None:
    robot = load_robot(name)
    camera, table = robot.camera, robot.table
    assert camera is not None
    assert table is not None
    edge = table.centre[0] - table.size[0] / 2
    assert camera.frames(np.array([[edge - SlideConfig().most - 0.03, y, table.height] for y in (-0.4, 0.4)])).all()


def test_what_overhangs_is_lifted(narrow: Robot) -> None:
    """In MuJoCo, to the end of the shake."""
    thing = board((0.11, 0.09, 0.005), (0.35, -0.3))
    assert overhangs(np.asarray(thing.cloud), narrow.table)  # type: ignore[arg-type]
    made = plan_or_slide(narrow, thing)
    assert made.notes.slide is None
    scene = LiftScene(Workcell(narrow), [thing])
    scene.place(0, np.eye(4))
    assert carry_out(scene, made, TabletopConfig()) == ("done", "")


def test_grasps_at_the_edge_keep_clear_of_the_table(narrow: Robot) -> None:
    """By the hand's own meshes: nothing of a grasp is in the board of the table."""
    thing, table = board((0.11, 0.09, 0.005), (0.35, -0.3)), narrow.table
    assert table is not None
    grasps = flat_grasps(narrow.hand, thing, table)
    assert len(grasps) > 50
    hand: Hand = narrow.hand
    assert hand.description is not None
    for i in range(0, len(grasps), 20):
        poses = (grasps.T_object_wrist[i] @ hand.tree.forward(grasps.joints[i])).double().numpy()
        points = np.concatenate([s.vertices @ poses[s.link, :3, :3].T + poses[s.link, :3, 3]
                                 for s in hand.description.geometry if s.collides])
        below = points[points[:, 2] < -0.001]
        assert not len(below) or overhang(below, table).min() > 0.0
    flat = board((0.11, 0.09, 0.005), (0.35, 0.0))
    assert not len(flat_grasps(hand, flat, table))
    assert torch.isfinite(grasps.score).all()


def test_an_attempt_pushes_looks_again_and_lifts(narrow: Robot) -> None:
    """From depth images, with a stereo camera's noise."""
    coaster = dro.load_object("coaster")
    config = TabletopConfig(segment="mask", region=(0.33, -0.15, 0.45, -0.05))
    done = attempt(narrow, coaster, 0, 0, dro.GraspPredictor(), config)
    assert done.pushes >= 1
    assert done.success, done.reason


def test_pushes_mind_what_the_constraints_say(narrow: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    thing, wall = board((0.11, 0.09, 0.005), (0.4, -0.1)), board((0.6, 0.02, 0.1), (0.45, -0.18))
    in_way = list[int]()

    def counted(
        robot: Robot, obj: dro.ObjectModel, obstacles: list[dro.ObjectModel], *others: object, **given: object
    ) -> MotionPlan:
        points = np.concatenate([np.zeros((0, 3)), *(o.cloud for o in obstacles)])
        in_way.append(int((np.abs(points[:, 1] + 0.18) < 0.02).sum()))
        raise PlanError("not pushed")

    def nothing(*arguments: object, **given: object) -> MotionPlan:
        raise PlanError("no grasp")

    monkeypatch.setattr(plans, "slide", counted)
    monkeypatch.setattr(plans, "plan", nothing)
    scene = dro.load_scene(trimesh.Trimesh(wall.vertices, wall.faces))
    for constraints in (dro.Constraints(), dro.Constraints(obstacles=scene)):
        with pytest.raises(PlanError, match="not pushed"):
            plan_or_slide(narrow, thing, config=dro.PlanConfig(constraints=constraints))
    assert in_way[0] == 0
    assert max(in_way) > 100
    ball = ((0.4, -0.1, 0.0, 0.05),)
    for constraints in (dro.Constraints(keep_out=ball), dro.Constraints(contact_region=ball)):
        with pytest.raises(PlanError, match="is not pushed: fingers would touch it anywhere"):
            plan_or_slide(narrow, thing, config=dro.PlanConfig(constraints=constraints))


def test_a_line_that_cannot_be_pressed_is_tried_from_another_start_as_it_was(
    narrow: Robot, pushed: tuple[dro.ObjectModel, MotionPlan]
) -> None:
    thing, _ = pushed
    pusher, heights = _Pusher(narrow, thing, (), SlideConfig(seeds=3), 0, narrow.home), list[float]()

    class Solver:
        def solve(self, T: np.ndarray, seeds: object) -> np.ndarray:
            return narrow.home

        def follow(self, poses: np.ndarray, start: np.ndarray) -> np.ndarray | None:
            heights.append(float(poses[0, 2, 3]))
            return None if len(heights) % 4 == 0 else np.tile(narrow.home, (len(poses), 1))

    pusher.solver = Solver()  # type: ignore[assignment]
    T = np.eye(4)
    T[2, 3] = 0.3
    assert pusher._solved(T, np.array([0.1, 0.0, 0.0])) is None
    assert heights[0::4] == [0.3] * 3
    assert heights[3::4] == pytest.approx([0.3 - SlideConfig().hover - SlideConfig().press] * 3)
