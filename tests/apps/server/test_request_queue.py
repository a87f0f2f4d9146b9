"""The queue of a grasp server: in order, within limits, and alive whatever a request does."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from dro_grasp.apps.server.request_queue import Request, RequestQueue
from dro_grasp.errors import OptionError, ServerError
from tests.helpers.quick_answers import QuickAnswerer


@pytest.fixture(scope="module")
def queue() -> Iterator[RequestQueue]:
    made = RequestQueue(None, longest=2, time_limit=1.0, answerer=QuickAnswerer)
    yield made
    made.close()
    assert not is_alive(made.ready.process)


def is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def call(name: str, what: str = "echo") -> SimpleNamespace:
    return SimpleNamespace(id=name, hand=what, model_fields_set={"id"})


def wait_for_idle(queue: RequestQueue) -> None:
    while queue.computing or queue.waiting:
        time.sleep(0.01)


def submitted(queue: RequestQueue, name: str, what: str) -> Request:
    """A request that is being computed."""
    request = queue.submit(call(name, what))
    while not queue.computing:
        time.sleep(0.005)
    return request


def test_each_request_gets_its_own_reply(queue: RequestQueue) -> None:
    wait_for_idle(queue)
    taken = [queue.submit(call(name)) for name in "ab"]
    assert [t.reply.result(5)[:2] for t in taken] == [(200, b"a"), (200, b"b")]
    assert queue.ready[:2] == (["claw"], ["can"])
    assert queue.memory > 1e6


def test_what_is_cancelled_ends_in_the_queue_and_under_way(queue: RequestQueue) -> None:
    wait_for_idle(queue)
    running, queued = submitted(queue, "running", "sleep"), queue.submit(call("queued"))
    starts = queue.metrics.starts
    assert queue.cancel("queued")
    assert queue.cancel("running")
    assert running.reply.result(5).status == queued.reply.result(5).status == 409
    assert not queue.cancel("running")
    assert queue.submit(call("next")).reply.result(5)[:2] == (200, b"next")
    assert queue.metrics.starts == starts


def test_a_full_queue_and_a_second_request_of_one_id_are_refused(queue: RequestQueue) -> None:
    wait_for_idle(queue)
    first = submitted(queue, "first", "sleep")
    with pytest.raises(ServerError, match="a request 'first' is under way"):
        queue.submit(call("first"))
    others = [queue.submit(call(name)) for name in "ab"]
    with pytest.raises(ServerError, match="2 requests are waiting already"):
        queue.submit(call("c"))
    queue.cancel("first")
    assert [r.reply.result(5).status for r in (first, *others)] == [409, 200, 200]


def test_what_is_cancelled_in_the_queue_leaves_its_place_and_its_id_at_once(queue: RequestQueue) -> None:
    wait_for_idle(queue)
    before, waited = queue.metrics.replies[409], queue.metrics.waiting_seconds
    running = submitted(queue, "running", "sleep")
    queued = [queue.submit(call(name)) for name in "bc"]
    time.sleep(0.02)
    assert [queue.cancel(name) for name in "bc"] == [True, True]
    assert [r.reply.result(0).status for r in queued] == [409, 409]
    assert not queue.cancel("b")
    assert (queue.waiting, queue.metrics.replies[409]) == (0, before + 2)
    assert queue.metrics.waiting_seconds > waited + 0.03
    again = [queue.submit(call(name)) for name in "cb"]
    assert not running.reply.done()
    assert queue.cancel("running")
    assert [r.reply.result(5)[:2] for r in again] == [(200, b"c"), (200, b"b")]
    assert running.reply.result(0).status == 409


def test_what_is_cancelled_in_the_middle_of_the_queue_leaves_the_order_of_the_others(queue: RequestQueue) -> None:
    wait_for_idle(queue)
    submitted(queue, "running", "sleep")
    order: list[str] = []
    first = queue.submit(call("first"))
    queue.submit(call("middle"))
    queue.cancel("middle")
    last = queue.submit(call("last"))
    for request in (first, last):
        request.reply.add_done_callback(lambda reply: order.append(reply.result().body.decode()))
    queue.cancel("running")
    last.reply.result(5)
    assert order == ["first", "last"]


def test_refusals_and_faults_are_told_and_cost_no_process(queue: RequestQueue) -> None:
    wait_for_idle(queue)
    starts = queue.metrics.starts
    assert queue.submit(call("a", "wrong")).reply.result(5)[:2] == (422, b'{"error": "num is 0"}')
    reply = queue.submit(call("b", "faulty")).reply.result(5)
    assert reply.status == 500
    assert b"ZeroDivisionError" in reply.body
    assert queue.metrics.starts == starts


def test_a_process_that_dies_between_requests_is_replaced(queue: RequestQueue) -> None:
    wait_for_idle(queue)
    assert queue.submit(call("first")).reply.result(10).status == 200
    os.kill(queue.ready.process, signal.SIGKILL)
    replies = [queue.submit(call(name)).reply.result(10) for name in "ab"]
    assert replies[0].status in {200, 500}, "it may be too early to know"
    assert replies[1][:2] == (200, b"b")


@pytest.mark.parametrize(("what", "status", "told"), [("die", 500, b"the process died"), ("hang", 504, b"longer than 1 s")])
def test_the_request_after_a_fatal_one_is_computed(queue: RequestQueue, what: str, status: int, told: bytes) -> None:
    wait_for_idle(queue)
    reply = queue.submit(call("fatal", what)).reply.result(5)
    assert reply.status == status
    assert told in reply.body
    assert queue.submit(call("next")).reply.result(10)[:2] == (200, b"next")


def test_a_request_that_does_not_heed_its_cancellation_is_ended() -> None:
    queue = RequestQueue(None, time_limit=10.0, answerer=QuickAnswerer, grace=0.2)
    deaf = submitted(queue, "deaf", "hang")
    queue.cancel("deaf")
    assert deaf.reply.result(5).status == 409
    assert queue.submit(call("next")).reply.result(10)[:2] == (200, b"next")
    queue.close()


def test_a_desk_refuses_a_stock_that_cannot_be_loaded_and_limits_without_sense() -> None:
    with pytest.raises(OptionError, match="the weights are broken; mend them"):
        RequestQueue("broken", answerer=QuickAnswerer)
    with pytest.raises(OptionError, match="the process that loads weights and hands died"):
        RequestQueue("deadly", answerer=QuickAnswerer)
    with pytest.raises(OptionError, match="the queue is 0 long"):
        RequestQueue(None, longest=0, answerer=QuickAnswerer)
    with pytest.raises(OptionError, match="time limit nan s"):
        RequestQueue(None, time_limit=float("nan"), answerer=QuickAnswerer)


def test_closing_refuses_what_waits() -> None:
    queue = RequestQueue(None, answerer=QuickAnswerer)
    taken = [submitted(queue, "running", "hang"), queue.submit(call("queued"))]
    queue.close()
    assert [t.reply.result(0).status for t in taken] == [503, 503]
    assert all(b"the server is stopping; ask another one" in t.reply.result(0).body for t in taken)
    assert queue.metrics.starts == 1, "nothing is loaded again for a server that stops"
    with pytest.raises(ServerError, match="stopping"):
        queue.submit(call("late"))


def test_a_queue_is_closed_from_two_sides_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    made = RequestQueue(None, answerer=QuickAnswerer)
    join, inside, most = made._pool.join, [0], [0]

    def slow_join() -> None:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        time.sleep(0.1)
        join()
        inside[0] -= 1

    monkeypatch.setattr(made._pool, "join", slow_join)
    sides = [threading.Thread(target=made.close) for _ in range(2)]
    for side in sides:
        side.start()
    for side in sides:
        side.join(20)
    assert (most, inside) == ([1], [0])
    assert not is_alive(made.ready.process)


def test_a_queue_that_closes_lets_what_is_computed_end_in_time_and_refuses_what_waits_at_once() -> None:
    queue = RequestQueue(None, answerer=QuickAnswerer)
    taken = [submitted(queue, "running", "nap"), queue.submit(call("queued"))]
    queue.close(patience=20.0)
    assert [t.reply.result(0).status for t in taken] == [200, 503]


def test_a_queue_in_a_hurry_waits_no_longer() -> None:
    queue = RequestQueue(None, answerer=QuickAnswerer)
    running = submitted(queue, "running", "hang")
    threading.Timer(0.3, queue.hurry).start()
    begin = time.monotonic()
    queue.close(patience=50.0)
    assert running.reply.result(0).status == 503
    assert time.monotonic() - begin < 20


def test_what_is_computed_when_the_process_is_killed_from_outside_is_computed_again() -> None:
    queue = RequestQueue(None, answerer=QuickAnswerer)
    running, waiting = submitted(queue, "running", "nap"), queue.submit(call("waiting"))
    os.kill(queue.ready.process, signal.SIGKILL)
    assert running.reply.result(20)[:2] == (200, b"running")
    assert waiting.reply.result(20)[:2] == (200, b"waiting")
    assert queue.metrics.starts == 2
    fatal = queue.submit(call("fatal", "killed")).reply.result(30)
    assert fatal.status == 500
    assert b"the process died over this request" in fatal.body
    assert queue.submit(call("next")).reply.result(20)[:2] == (200, b"next")
    queue.close()


def test_a_process_that_is_terminated_with_its_server_says_so() -> None:
    queue = RequestQueue(None, answerer=QuickAnswerer)
    running = submitted(queue, "running", "hang")
    os.kill(queue.ready.process, signal.SIGTERM)
    time.sleep(0.3)  # it is known by then how the process ended, and not yet that the server stops
    queue.close(patience=20.0)
    assert running.reply.result(0).status == 503


def test_a_system_that_starts_no_process_is_told_and_the_next_request_tries_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(24, "Too many open files")

    queue = RequestQueue(None, answerer=QuickAnswerer)
    os.kill(queue.ready.process, signal.SIGKILL)
    while queue._pool.active:
        time.sleep(0.01)
    monkeypatch.setattr("dro_grasp.apps.server.request_queue.ProcessPool", refused)
    for name in "ab":
        reply = queue.submit(call(name)).reply.result(10)
        assert reply.status == 500
        assert b"Too many open files" in reply.body
    monkeypatch.undo()
    assert queue.submit(call("c")).reply.result(20)[:2] == (200, b"c")
    queue.close()


def test_a_process_that_is_ended_leaves_no_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    queue = RequestQueue(None, answerer=QuickAnswerer, grace=0.1)
    files = submitted(queue, "files", "file")
    while not list(tmp_path.rglob("mesh.stl")):
        time.sleep(0.01)
    queue.cancel("files")
    assert files.reply.result(5).status == 409
    wait_for_idle(queue)
    queue.close()
    assert not list(tmp_path.rglob("mesh.stl"))


def test_refused_requests_are_taken_in_turn_when_they_come_again() -> None:
    queue = RequestQueue(None, longest=1, answerer=QuickAnswerer)
    submitted(queue, "running", "sleep")
    queue.submit(call("waiting", "sleep"))
    told = []
    for name in ("first", "second"):
        with pytest.raises(ServerError, match=r"1 requests are waiting already.*same id") as refused:
            queue.submit(call(name))
        told.append(refused.value.retry_after)
    assert told == [2.0, 4.0], "each is told a time of its own"
    queue.cancel("waiting")
    for late in ("second", "late"):
        with pytest.raises(ServerError):
            queue.submit(call(late))
    assert queue.submit(call("first"))
    queue.close()


def test_who_does_not_come_again_keeps_no_place(monkeypatch: pytest.MonkeyPatch) -> None:
    queue = RequestQueue(None, longest=1, answerer=QuickAnswerer)
    submitted(queue, "running", "sleep")
    queue.submit(call("waiting", "sleep"))
    nameless = SimpleNamespace(id="chance", hand="echo", model_fields_set={"hand"})
    for other in (nameless, call("gone")):
        with pytest.raises(ServerError):
            queue.submit(other)
    queue.cancel("waiting")
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 30)
    assert queue.submit(call("late"))
    monkeypatch.undo()
    queue.close()
