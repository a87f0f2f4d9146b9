"""The page that plays how a table was cleared: its parts called as the browser calls them."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.apps.viewer.clear_page import ClearPage, clear_page, now, picks
from dro_grasp.arm.clearing.record import ClearRecord, Judgement, Look, Picked
from dro_grasp.cli.view import View
from tests.helpers.browser import free_port, use


@pytest.fixture(scope="module")
def record(robot: dro.Robot) -> ClearRecord:
    """Two picks of ten moments each: the first ends in the bin, the second loses the thing."""
    can, count = dro.load_object("can"), 20
    poses = np.tile(np.eye(4), (count, 1, 1, 1))
    poses[:, 0, 0, 3] = np.linspace(0.5, 0.3, count)
    assert can.vertices is not None
    assert can.faces is not None
    events = (Look(0, 0), Judgement(4, "held", 0.97, True), Judgement(6, "held", 0.95, True), Picked(9, (0.5, 0.1), "done", ""),
              Look(9, 1), Judgement(14, "empty", 0.99, True),
              Picked(19, (0.4, -0.1), "lift", "the hand is empty, by its joints"), Look(19, 2))
    seen = np.random.default_rng(0).normal((0, 0, 0.8), 0.05, (50, 3))
    arm = robot.home + np.linspace(0, 0.1, count)[:, None]
    hand = np.tile(robot.hand.canonical_joints().double().numpy(), (count, 1))
    return ClearRecord(robot.name, robot.sha256, 10.0, arm, hand, poses, ("can",), ((can.vertices, can.faces),), (),
                       (seen, seen[:30], seen[:0]), events)


@pytest.fixture
def page(record: ClearRecord, robot: dro.Robot):
    made = ClearPage(record, robot, port=free_port())
    yield made
    made.stop()


def test_each_moment_shows_where_things_are_and_says_what_is_known(page: ClearPage, record: ClearRecord) -> None:
    assert page.moment.max == 19
    page.show_moment(5)
    np.testing.assert_allclose(page._things[0].position, record.poses[5, 0, :3, 3], atol=1e-6)
    assert "Carrying it to the bin" in page.text.content
    assert "hold check: **held**, 97% sure" in page.text.content
    sign = page.server.scene.get_handle_by_name("/hold/text")
    assert sign is not None
    assert sign.text == "held, 97% sure"  # type: ignore[attr-defined]
    page.show_moment(15)
    assert "hold check: **empty**, 99% sure, which is wrong" in page.text.content
    assert "The hand opens" in page.text.content
    page.show_moment(2)
    assert "Going for the thing at (0.50, 0.10) m" in page.text.content
    assert page.server.scene.get_handle_by_name("/hold") is None
    page.show_moment(99)
    assert "19" not in page.text.content.split()[0], "the last moment is shown"


def test_a_look_that_shows_nothing_and_a_part_that_is_picked(page: ClearPage) -> None:
    page.show_moment(0)
    assert page._look == 0
    page.show_moment(19)
    assert page._look == 2
    assert page.server.scene.get_handle_by_name("/look") is None
    for _ in range(2):  # it can be chosen again
        page.show_moment(0)
        pick = list(page.starts)[2]
        assert page.part.value != pick
        use(page.part, pick)
        assert "(lift)" in pick
        assert page.moment.value == 9


def test_playing_ends_at_the_last_moment_and_then_begins_anew(page: ClearPage, monkeypatch: pytest.MonkeyPatch) -> None:
    shown, show = list[int](), page.show_moment
    monkeypatch.setattr(page, "show_moment", lambda moment: (shown.append(moment), show(moment)))
    page.speed.value = "8 x"
    for _ in range(2):
        page._guarded(page._play)
        assert page.moment.value == 19
    assert shown == 2 * [*range(20)]


def played(page: ClearPage) -> threading.Thread:
    """A thread that plays slowly, and has begun."""
    page.speed.value = "1 x"
    playing = threading.Thread(target=lambda: use(page.play))
    playing.start()
    while not page.moment.value:
        time.sleep(0.01)
    return playing


def test_a_film_is_stopped_by_its_button_and_by_a_moment_that_is_chosen(page: ClearPage) -> None:
    """It would go on for two seconds, and plays on from where it was stopped."""
    playing = played(page)
    use(page.play)
    playing.join(0.5)
    assert not playing.is_alive()
    stopped = page.moment.value
    assert 0 < stopped < 19
    playing = threading.Thread(target=lambda: use(page.play))
    playing.start()
    time.sleep(0.05)
    assert page.moment.value >= stopped
    use(page.moment, 3)
    playing.join(0.5)
    assert not playing.is_alive()
    np.testing.assert_allclose(page._things[0].position, page.record.poses[3, 0, :3, 3], atol=1e-6)


def test_a_page_that_is_stopped_ends_its_film(record: ClearRecord, robot: dro.Robot) -> None:
    page = ClearPage(record, robot, port=free_port())
    playing = played(page)
    page.stop()
    playing.join(0.5)
    assert not playing.is_alive()


def test_no_picture_of_a_film_is_shown_once_there_is_another_one(page: ClearPage, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, drawing = list[object](), threading.Event()

    def show(moment: int) -> None:
        film = page.film
        drawing.set()
        time.sleep(0.05)
        drawn.append(film)

    monkeypatch.setattr(page, "show_moment", show)
    before = page.film
    playing = threading.Thread(target=lambda: page._guarded(page._play))
    playing.start()
    assert drawing.wait(5)
    page.film = None
    drawn.append(None)
    playing.join(5)
    assert drawn[-2:] == [before, None]


def test_words_know_the_pick_that_goes_on(record: ClearRecord) -> None:
    assert [(begin, pick.stage) for begin, pick in picks(record)] == [(0, "done"), (9, "lift")]
    assert "Going for the thing at (0.50, 0.10) m" in now(record, 0)
    assert "Letting it go" in now(record, 8)
    assert "Going for the thing at (0.40, -0.10) m" in now(record, 12)
    assert "Nothing is left to pick" in now(replace(record, events=record.events[:5]), 12)


def test_a_file_is_opened_by_the_command_and_another_robot_is_told(record: ClearRecord, tmp_path: Path) -> None:
    replace(record, robot_sha256="another").save(tmp_path / "cleared.npz")
    shown = list[object]()
    assert View(tmp_path / "cleared.npz", port=free_port()).run(lambda page: (shown.append(page), page.stop())) == 0
    assert isinstance(shown[0], ClearPage)
    page = clear_page(tmp_path / "cleared.npz", port=free_port())
    page.stop()
    assert page.robot.name == record.robot
