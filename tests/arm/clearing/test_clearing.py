"""Clearing a table: what is chosen, tried again, given up and reported, with a rig that plays what a table would do."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.arm.clearing import loop
from dro_grasp.arm.clearing.loop import Bin, ClearConfig, Pick, clear_table
from dro_grasp.arm.clearing.trial import clear_trial
from dro_grasp.arm.planning.motion import PLACING, STAGES, MotionPlan, Trajectory
from dro_grasp.arm.planning.placing import Place
from dro_grasp.arm.planning.workcell import CLEARANCE, Workcell
from dro_grasp.errors import ObjectError, OptionError, PlanError
from dro_grasp.grasps.hold import HoldCheck

SPOTS = {"a": (0.45, 0.1), "b": (0.5, -0.15)}
RADIUS = 0.03
NOBODY = dro.GraspPredictor.__new__(dro.GraspPredictor)  # It is not asked


class Table:
    """A rig whose camera sees balls on a table; each pick takes the one that was planned for, if the hand is to hold it."""

    def __init__(self, robot: dro.Robot, holds: list[Any]) -> None:
        self.robot, self.holds, self.there = robot, list(holds), dict(SPOTS)
        self.moves, self.wanted = list[Trajectory](), None
        self.looks = 0

    def look(self) -> np.ndarray:
        self.looks += 1
        random = np.random.default_rng(self.looks)
        x, y = np.meshgrid(np.arange(0.1, 0.8, 0.004), np.arange(-0.5, 0.7, 0.004))
        parts = [np.stack([x.ravel(), y.ravel(), random.normal(0, 0.001, x.size)], 1)]
        for centre in self.there.values():
            ball = random.normal(size=(2000, 3))
            ball *= RADIUS / np.linalg.norm(ball, axis=1, keepdims=True)
            parts.append(ball + np.array([*centre, RADIUS]))
        in_bin = random.uniform([0.2, 0.42, 0.0], [0.4, 0.58, 0.05], (500, 3))
        assert self.robot.camera is not None
        T = self.robot.camera.T_world_camera
        return (np.concatenate([*parts, in_bin]) - T[:3, 3]) @ T[:3, :3]

    def move(self, arm: Trajectory, hand: Trajectory) -> None:
        assert arm.time[0] == 0
        np.testing.assert_array_equal(arm.time, hand.time)
        self.moves.append(arm)

    def joints(self) -> tuple[np.ndarray, np.ndarray]:
        return (self.moves[-1].position[-1] if self.moves else self.robot.home), self.robot.open_hand


def judged(state: Any) -> HoldCheck:
    return HoldCheck(state, 1.0, {state: 1.0})


@pytest.fixture
def placed(planned: MotionPlan) -> MotionPlan:
    """The plan of a lift, with a place of which nothing moves any more."""
    def longer(part: Trajectory) -> Trajectory:
        rest = np.zeros((len(PLACING), part.position.shape[1]))
        return Trajectory(
            np.append(part.time, part.seconds + 0.1 * np.arange(1, len(PLACING) + 1)),
            *(np.vstack([own, rest + own[-1]]) for own in (part.position, part.velocity, part.acceleration)))

    stages = np.append(planned.stage, len(STAGES) + np.arange(len(PLACING)))
    notes = replace(planned.notes, place=np.eye(4).tolist())
    return MotionPlan(notes, planned.scene, stages, longer(planned.arm), longer(planned.hand))


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, robot: dro.Robot, placed: MotionPlan) -> Any:
    """What stands in for grasping: the plan is always the same, and the hand holds as the table has it."""
    def make(holds: list[Any], fails: tuple[str, ...] = ()) -> tuple[Table, list[Any]]:
        table, asked = Table(robot, holds), list[Any]()

        def planned(robot: dro.Robot, obj: dro.ObjectModel, **given: Any) -> MotionPlan:
            middle = obj.cloud.mean(0)[:2]
            name = min(table.there, key=lambda n: float(np.linalg.norm(middle - table.there[n])))
            asked.append(SimpleNamespace(name=name, obj=obj, **given))
            if name in fails:
                raise PlanError(f"no grasp of {name}")
            table.wanted = name
            return placed

        def check(self: MotionPlan, joints: np.ndarray, *, watched: np.ndarray, seconds: float) -> Any:
            assert watched.shape == (21, len(joints))
            assert seconds == pytest.approx(0.2)
            held = table.holds.pop(0)
            if isinstance(held, str):
                table.there |= table.falls
                return judged(held)
            if held and not table.holds_twice:
                table.there.pop(table.wanted)
            table.holds_twice = held and not table.holds_twice
            return judged("held" if held else "empty")

        table.holds_twice, table.falls = False, {}
        monkeypatch.setattr(loop, "plan", planned)
        monkeypatch.setattr(MotionPlan, "check_hold", check)
        return table, asked

    return make


def test_everything_is_picked_and_dropped_above_the_bin(world: Any, robot: dro.Robot) -> None:
    table, asked = world([True] * 4)
    told, judged = list[Pick](), list[Any]()
    result = clear_table(robot, table, NOBODY, progress=told.append, judged=judged.append)
    assert [pick.stage for pick in result.picks] == ["done", "done"]
    assert (result.picks, result.left, result.done) == (tuple(told), (), 2)
    assert (table.there, table.looks, len(judged)) == ({}, 3, 4)
    for pick, name in zip(result.picks, [own.name for own in asked], strict=True):
        assert pick.place == pytest.approx(SPOTS[name], abs=0.005)
    bin = Bin()
    for own in asked:
        assert isinstance(own.place, Place)
        assert own.place.spot == pytest.approx((*bin.centre, bin.height + 0.02), abs=2e-3)
        walls = own.obstacles[-1]
        assert walls.name == "bin"
        assert len(own.obstacles) == (2 if own is asked[0] else 1), "the other thing is in the way"
    np.testing.assert_allclose(table.moves[-1].position[-1], robot.home, atol=1e-6)


def test_the_way_home_is_checked_as_it_is_timed(
    robot: dro.Robot, placed: MotionPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A spline leaves the straight edges; where that is not free, or nothing is, the arm does not follow it."""
    table, asked = Table(robot, []), list[float]()
    away = np.zeros(1), np.tile(robot.home + 0.3, (1, 1))
    table.moves.append(Trajectory(*away, 0 * away[1], 0 * away[1]))

    def free(cell: Workcell, arm: np.ndarray, hand: np.ndarray, clearance: float = CLEARANCE) -> bool:
        asked.append(clearance)
        return clearance == CLEARANCE

    monkeypatch.setattr(Workcell, "free", free)
    with pytest.raises(PlanError, match="the arm does not find its way home"):
        loop._go_home(table, Workcell(robot), placed, "lift")
    assert len(table.moves) == 1
    assert 0 == min(asked) < sorted(set(asked))[1] < CLEARANCE


@pytest.mark.parametrize("reached", ["close", "lift", "retreat"])
def test_where_the_planner_finds_no_way_home_the_arm_goes_back_nearly_as_it_came(
    robot: dro.Robot, placed: MotionPlan, monkeypatch: pytest.MonkeyPatch, reached: str
) -> None:
    """Over the object's place, where something may lie, unless the hand is down there; and checked, like all ways."""
    table, cell = Table(robot, []), Workcell(robot)
    begin = placed.arm.position[placed.part(reached).stop - 1]
    table.moves.append(Trajectory(np.zeros(1), begin[None], 0 * begin[None], 0 * begin[None]))
    monkeypatch.setattr(loop, "free_motion", lambda *args: None)
    loop._go_home(table, cell, placed, reached)
    _, way = table.moves
    np.testing.assert_allclose(way.position[[0, -1]], [begin, robot.home], atol=1e-6)
    free = [cell.free(q, robot.open_hand, 0.0) for q in way.position]
    assert all(free[free.index(True):])
    height = robot.T_world_wrist(way.position)[:, 2, 3]
    standoff, lifted = robot.T_world_wrist(placed.arm.position[[placed.part(s).stop - 1 for s in ("reach", "lift")]])[:, 2, 3]
    assert reached == "close" or height.min() > min(standoff, lifted) - 0.02


def test_what_is_lost_is_looked_for_and_tried_again(world: Any, robot: dro.Robot, placed: MotionPlan) -> None:
    table, asked = world([False, True, True, True, True])
    result = clear_table(robot, table, NOBODY, seed=5)
    assert [pick.stage for pick in result.picks] == ["lift", "done", "done"]
    assert result.picks[0].reason == "the hand is empty, by its joints"
    assert asked[0].name == asked[2].name != asked[1].name, "what has failed least comes first"
    assert [own.seed for own in asked] == [5, 6, 7], "another grasp each time"
    assert [len(own.avoid) for own in asked] == [0, 0, 1]
    np.testing.assert_array_equal(asked[2].avoid[0], placed.notes.T_world_wrist)
    assert (table.there, result.left) == ({}, ())


def test_a_thing_is_given_up_after_three_tries_and_the_others_are_not(world: Any, robot: dro.Robot) -> None:
    table, asked = world([True, True], fails=("b",))
    result = clear_table(robot, table, NOBODY, ClearConfig(tries=3))
    assert [own.name for own in asked].count("b") == 3
    assert [pick.stage for pick in result.picks].count("done") == 1
    assert [pick.reason for pick in result.left] == ["given up after 3 picks: no grasp of b"]
    assert [own.avoid for own in asked] == [[]] * len(asked), "nothing was grasped that failed"
    assert set(table.there) == {"b"}


def test_what_falls_elsewhere_is_the_same_thing(world: Any, robot: dro.Robot) -> None:
    """It is given up after as many picks, wherever it has fallen, and its old grasps are no longer avoided."""
    table, asked = world(["empty"] * 3)
    table.there = {"a": (0.45, 0.1)}
    table.falls = {"a": (0.55, -0.1)}
    result = clear_table(robot, table, NOBODY, ClearConfig(tries=3))
    assert [pick.stage for pick in result.picks] == ["lift"] * 3
    assert [len(own.avoid) for own in asked] == [0, 0, 1]
    (left,) = result.left
    assert left.place == pytest.approx((0.55, -0.1), abs=0.005)
    assert left.reason == "given up after 3 picks: the hand is empty, by its joints"


def test_what_slips_is_put_back_before_the_hand_opens(world: Any, robot: dro.Robot, placed: MotionPlan) -> None:
    table, _ = world(["slipping", True, True])
    table.there = {"a": (0.45, 0.1)}
    told = list[Pick]()
    result = clear_table(robot, table, NOBODY, progress=told.append)
    assert [(pick.stage, pick.reason) for pick in told] == [("lift", "the hand is slipping, by its joints"), ("done", "")]
    assert result.left == ()
    lift = placed.arm.position[placed.part("lift")]
    ends = [(way.position[0], way.position[-1]) for way in table.moves]
    assert any(np.allclose(first, lift[-1]) and np.allclose(last, lift[0]) for first, last in ends)


def test_what_is_out_of_sight_is_told(world: Any, robot: dro.Robot) -> None:
    table, _ = world(["empty"])
    table.there = {"a": (0.45, 0.1)}
    table.falls = {"a": (0.3, 0.5)}  # into the bin, of which nothing is seen
    result = clear_table(robot, table, NOBODY)
    assert [pick.reason for pick in result.left] == ["the hand is empty, by its joints; the camera sees it nowhere"]
    assert result.done == 0


def test_a_pick_counts_only_when_the_thing_is_gone(world: Any, robot: dro.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    table, _ = world([])
    table.there = {"a": (0.45, 0.1)}
    monkeypatch.setattr(MotionPlan, "check_hold", lambda *given, **more: judged("held"))
    result = clear_table(robot, table, NOBODY, ClearConfig(tries=2))
    assert [pick.stage for pick in result.picks] == ["look", "look"]
    assert result.left[0].reason == "given up after 2 picks: it still stands there, as the camera sees it"
    assert result.done == 0


def test_of_two_that_touch_one_is_picked_where_both_cannot_be(world: Any, robot: dro.Robot) -> None:
    table, asked = world([True] * 4)
    table.there = {"a": (0.45, 0.0), "b": (0.51, 0.0)}
    honest = loop.plan

    def planned(robot: dro.Robot, obj: dro.ObjectModel, **given: Any) -> MotionPlan:
        if np.ptp(obj.cloud[:, 0]) > 0.09:
            raise PlanError("too large")
        return honest(robot, obj, **given)

    loop.plan = planned  # taken back with the fixture's
    result = clear_table(robot, table, NOBODY)
    assert [pick.stage for pick in result.picks] == ["done", "done"]
    assert {own.name for own in asked} == {"a", "b"}
    assert table.there == {}
    assert any(thing.name == "what touches it" for thing in asked[0].obstacles)


def test_picks_have_an_end(world: Any, robot: dro.Robot) -> None:
    table, _ = world([False] * 20)
    result = clear_table(robot, table, NOBODY, ClearConfig(most=2, tries=10))
    assert len(result.picks) == 2
    assert result.done == 0


def test_a_bin_holds_what_is_above_it_and_has_four_walls() -> None:
    box = Bin((0.3, 0.5), (0.4, 0.2), 0.1)
    points = np.array([[0.3, 0.5, 0.0], [0.49, 0.59, 1.0], [0.51, 0.5, 0.0], [0.3, 0.61, 0.0]])
    assert box.holds(points).tolist() == [True, True, False, False]
    assert box.holds(points, 0.02).tolist() == [True] * 4
    walls = box.walls(0.05)
    low, high = walls.cloud.min(0), walls.cloud.max(0)
    np.testing.assert_allclose([*low, *high], [0.095, 0.395, 0.05, 0.505, 0.605, 0.15], atol=2e-3)
    assert len(walls.parts) == 4
    assert not (np.abs(walls.cloud[:, :2] - box.centre) < (0.18, 0.08)).all(1).any(), "it is open"


@pytest.mark.parametrize(("wrong", "told"), [
    (lambda: Bin(size=(0.0, 0.3)), r"size \(0.0, 0.3\)"), (lambda: Bin(height=-1.0), "walls of -1.0 m"),
    (lambda: ClearConfig(tries=0), "tries is 0; give at least 1"),
])
def test_what_is_no_bin_and_no_number_is_refused(wrong: Any, told: str) -> None:
    with pytest.raises(OptionError, match=told):
        wrong()


def test_a_bin_that_no_arm_reaches_is_refused_before_anything_moves(robot: dro.Robot) -> None:
    table = Table(robot, [])
    with pytest.raises(OptionError, match=r"above the bin's middle, is 4\.\d+ m from the base, farther than the arm and hand"):
        clear_table(robot, table, NOBODY, ClearConfig(Bin((3.0, 3.0))))
    assert table.looks == 0


@pytest.mark.parametrize("lacking", ["table", "camera"])
def test_a_table_and_a_camera_are_needed(robot: dro.Robot, lacking: str) -> None:
    can = dro.load_object("can")
    with pytest.raises(OptionError, match=f"has no {lacking}; state it in the robot file"):
        clear_trial(replace(robot, **{lacking: None}), [can], 0, 0, dro.GraspPredictor())


def test_a_can_is_cleared_from_a_table_in_simulation(robot: dro.Robot) -> None:
    """Nothing is made up: camera, plan, motion, joints and bin."""
    done = clear_trial(robot, [dro.load_object("can")], 0, 0, dro.GraspPredictor())
    assert (done.removed, done.fallen, done.reason) == ((True,), (False,), "")
    assert done.cleared.done == len(done.cleared.picks) == 1
    assert all(state == "held" and held for state, held in done.judgements)


@pytest.mark.parametrize("seen", [np.zeros((0, 3)), np.zeros((50, 3)), np.full((50, 3), np.nan)], ids=["none", "zeros", "nan"])
def test_a_blind_camera_has_not_seen_a_cleared_table(robot: dro.Robot, seen: np.ndarray) -> None:
    rig = Table(robot, [])
    rig.look = lambda: seen  # type: ignore[method-assign]
    with pytest.raises(ObjectError):
        clear_table(robot, rig, NOBODY)
