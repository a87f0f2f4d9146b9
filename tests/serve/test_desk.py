"""The queue of a grasp server: in order, within limits, and alive whatever a request does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from dro_grasp.errors import OptionError, ServerError
from dro_grasp.serve import desk as module
from dro_grasp.serve.desk import Desk, Request
from tests.helpers.desk_work import obey


@pytest.fixture(scope="module")
def desk() -> Iterator[Desk]:
    made = Desk(None, longest_queue=2, time_limit=1.0, work=obey)
    yield made
    made.close()
    assert not made._process.is_alive()


def call(name: str, what: str = "echo") -> SimpleNamespace:
    return SimpleNamespace(id=name, hand=what)


def wait_for_idle(desk: Desk) -> None:
    while desk.computing or desk.waiting:
        time.sleep(0.01)


def submitted(desk: Desk, name: str, what: str) -> Request:
    """A request that is being computed."""
    request = desk.submit(call(name, what))
    while not desk.computing:
        time.sleep(0.005)
    return request


def test_each_request_gets_its_own_reply(desk: Desk) -> None:
    wait_for_idle(desk)
    taken = [desk.submit(call(name)) for name in "ab"]
    assert [t.reply.result(5) for t in taken] == [(200, b"a"), (200, b"b")]
    assert desk.ready == (["claw"], ["can"])
    assert desk.memory > 1e6


def test_what_is_cancelled_ends_in_the_queue_and_under_way(desk: Desk) -> None:
    wait_for_idle(desk)
    running, queued = submitted(desk, "running", "sleep"), desk.submit(call("queued"))
    starts = desk.tally.starts
    assert desk.cancel("queued")
    assert desk.cancel("running")
    assert running.reply.result(5).status == queued.reply.result(5).status == 409
    assert not desk.cancel("running")
    assert desk.submit(call("next")).reply.result(5) == (200, b"next")
    assert desk.tally.starts == starts


def test_a_full_queue_and_a_second_request_of_one_id_are_refused(desk: Desk) -> None:
    wait_for_idle(desk)
    first = submitted(desk, "first", "sleep")
    with pytest.raises(ServerError, match="a request 'first' is under way"):
        desk.submit(call("first"))
    others = [desk.submit(call(name)) for name in "ab"]
    with pytest.raises(ServerError, match="2 requests are waiting already"):
        desk.submit(call("c"))
    desk.cancel("first")
    assert [r.reply.result(5).status for r in (first, *others)] == [409, 200, 200]


def test_what_is_cancelled_in_the_queue_leaves_its_place_and_its_id_at_once(desk: Desk) -> None:
    wait_for_idle(desk)
    before, waited = desk.tally.replies[409], desk.tally.waiting_seconds
    running = submitted(desk, "running", "sleep")
    queued = [desk.submit(call(name)) for name in "bc"]
    time.sleep(0.02)
    assert [desk.cancel(name) for name in "bc"] == [True, True]
    assert [r.reply.result(0).status for r in queued] == [409, 409]
    assert not desk.cancel("b")
    assert (desk.waiting, desk.tally.replies[409]) == (0, before + 2)
    assert desk.tally.waiting_seconds > waited + 0.03
    again = [desk.submit(call(name)) for name in "cb"]
    assert not running.reply.done()
    assert desk.cancel("running")
    assert [r.reply.result(5) for r in again] == [(200, b"c"), (200, b"b")]
    assert running.reply.result(0).status == 409


def test_what_is_cancelled_in_the_middle_of_the_queue_leaves_the_order_of_the_others(desk: Desk) -> None:
    wait_for_idle(desk)
    submitted(desk, "running", "sleep")
    order: list[str] = []
    first = desk.submit(call("first"))
    desk.submit(call("middle"))
    desk.cancel("middle")
    last = desk.submit(call("last"))
    for request in (first, last):
        request.reply.add_done_callback(lambda reply: order.append(reply.result().body.decode()))
    desk.cancel("running")
    last.reply.result(5)
    assert order == ["first", "last"]


@pytest.mark.parametrize(("what", "status", "told"), [("die", 500, b"the process died"), ("hang", 504, b"longer than 1 s")])
def test_the_request_after_a_fatal_one_is_computed(desk: Desk, what: str, status: int, told: bytes) -> None:
    wait_for_idle(desk)
    reply = desk.submit(call("fatal", what)).reply.result(5)
    assert reply.status == status
    assert told in reply.body
    assert desk.submit(call("next")).reply.result(10) == (200, b"next")


def test_a_request_that_does_not_heed_its_cancellation_is_ended(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    wait_for_idle(desk)
    monkeypatch.setattr(module, "GRACE", 0.2)
    deaf = submitted(desk, "deaf", "hang")
    desk.cancel("deaf")
    assert deaf.reply.result(0.9).status == 409
    assert desk.submit(call("next")).reply.result(10) == (200, b"next")


def test_a_desk_refuses_a_stock_that_cannot_be_loaded_and_limits_without_sense() -> None:
    with pytest.raises(OptionError, match="the stock is broken; mend it"):
        Desk("broken", work=obey)
    with pytest.raises(OptionError, match="the queue is 0 long"):
        Desk(None, longest_queue=0, work=obey)
    with pytest.raises(OptionError, match="time limit nan s"):
        Desk(None, time_limit=float("nan"), work=obey)


def test_closing_refuses_what_waits() -> None:
    desk = Desk(None, work=obey)
    taken = [submitted(desk, "running", "hang"), desk.submit(call("queued"))]
    desk.close()
    assert [t.reply.result(0).status for t in taken] == [409, 409]
    assert desk.tally.starts == 1, "nothing is loaded again for a server that stops"
    with pytest.raises(ServerError, match="stopping"):
        desk.submit(call("late"))
