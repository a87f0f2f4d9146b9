"""The queue of a grasp server, and the one process that works it off."""

from __future__ import annotations

import itertools
import json
import math
import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import CancelledError, Future, InvalidStateError, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Any, NamedTuple

from pebble import ProcessExpired, ProcessPool

from dro_grasp.errors import DroGraspError, OptionError, ServerError
from dro_grasp.workers import end_with_parent


class Reply(NamedTuple):
    """What a request comes to: a status of HTTP and a JSON object."""

    status: int
    body: bytes
    retry_after: float | None = None  # When it is worth while to ask again [s]


def refused(status: HTTPStatus, why: str, retry_after: float | None = None) -> Reply:
    """A reply that says why there is no answer."""
    return Reply(status, json.dumps({"error": why}).encode(), retry_after)


TICKETS = 8  # Most refused requests whose turn is remembered, as a multiple of the queue's length (ours)
LATE_SECONDS = 3.0  # How much later than it was told a refused request may come without losing its turn [s] (ours)
USUAL_SECONDS = 2.0  # Computing time of a request, before any is known [s] (ours)
STOP_SECONDS = 1.0  # How long a process that was terminated waits to hear whether the server stops [s] (ours)
TERMINATED = (-signal.SIGTERM, signal.SIGTERM)
"""Codes with which a process ends that was terminated: before and while its pool takes the signal, which exits with it."""
STOPPED = refused(HTTPStatus.SERVICE_UNAVAILABLE, "the server is stopping; ask another one, or ask again once it runs")
"""The reply to a request that a stopping server does not answer any more."""
CANCELLED = refused(HTTPStatus.CONFLICT, "the request was cancelled")  # The reply to a request that is no longer wanted


class Ready(NamedTuple):
    """What the process says once it has loaded what it computes with: names that can be asked for, and its own number."""

    hands: list[str]
    objects: list[str]
    process: int


class Cancelled(Exception):
    """The request is no longer wanted."""


class Computer:
    """What the process keeps from one request to the next, and does there."""

    answerer: Any  # Answers the requests
    cancelled: Any  # Number of the request that was cancelled last, in memory that the server's process writes

    @classmethod
    def prepare(cls, cancelled: Any, folder: str) -> None:
        """Start the process, with a folder for all temporary files."""
        end_with_parent()
        cls.cancelled, tempfile.tempdir = cancelled, folder

    @classmethod
    def load(cls, answerer: Callable[[Any], Any], config: Any) -> Ready:
        """Load what the answerer needs; raises what that raises."""
        cls.answerer = answerer(config)
        return Ready(cls.answerer.hand_names(), cls.answerer.object_names(), os.getpid())

    @classmethod
    def compute(cls, call: Any, number: int) -> Reply:
        """The reply to one request."""
        def check(*_: int) -> None:
            if cls.cancelled.value == number:
                raise Cancelled

        try:
            return Reply(HTTPStatus.OK, cls.answerer.answer(call, check).model_dump_json().encode())
        except DroGraspError as error:
            return refused(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except Cancelled:
            return CANCELLED
        except Exception as error:
            return refused(HTTPStatus.INTERNAL_SERVER_ERROR, f"{type(error).__name__}: {error}; this is a fault of dro-grasp")


@dataclass(eq=False)
class Request:
    """A request on its way."""

    call: Any  # A GraspCall
    number: int  # Of all requests
    reply: Future[Reply] = field(default_factory=Future)
    turn: Future[None] | None = None  # Its place in the queue
    task: Future[Reply] | None = None  # Its computation, once it is its turn
    since: float = field(default_factory=time.monotonic)  # When it came [s]

    def abandon(self) -> None:
        """End its computation together with the process, as pebble does with a task that is cancelled while it runs."""
        if self.task is not None:
            self.task.cancel()


@dataclass
class Metrics:
    """What a queue has done."""

    replies: Counter[int] = field(default_factory=Counter)  # By the status of HTTP
    waiting_seconds: float = 0.0
    computing_seconds: float = 0.0
    starts: int = 0  # Of the process


class RequestQueue:
    """Takes requests in order, within limits; whatever a request does to the process, the next one is computed."""

    def __init__(
        self, config: Any, longest: int = 16, time_limit: float = 60.0, answerer: Callable[[Any], Any] | None = None,
        grace: float = 3.0,
    ) -> None:
        """Start the process, and wait until it has loaded what it computes with.

        Args:
            config: What that is; see `ServerConfig`.
            longest: Requests that may wait.
            time_limit: A request that is computed for longer is ended [s].
            answerer: Makes what answers, in the process; an `Answerer` by default.
            grace: Time for a cancelled request to end by itself; then its process is ended, and starts anew in some seconds
                [s] (ours).

        Raises:
            DroGraspError: A limit is out of range, or something cannot be loaded.
        """
        if longest < 1 or not 0 < time_limit < float("inf"):
            raise OptionError(f"the queue is {longest} long and the time limit {time_limit} s; give at least 1, and a positive "
                              "time")
        if answerer is None:
            from dro_grasp.apps.server.answering import Answerer as answerer
        self.config, self.longest, self.time_limit, self.answerer, self.grace = config, longest, time_limit, answerer, grace
        self.metrics, self.closed = Metrics(), False
        self._known: dict[str, Request] = {}
        self._tickets: dict[str, float] = {}
        """Refused requests by their ids, in order, and until when each keeps its turn."""
        self._hurry: Future[Reply] = Future()
        self._running: Request | None = None
        self._numbers = itertools.count(1)
        self._lock, self._ending = threading.Lock(), threading.Lock()
        self._turns = ThreadPoolExecutor(1, "requests")
        self._context = multiprocessing.get_context("spawn")
        self._cancelled = self._context.Value("Q", 0, lock=False)
        self._start()

    @property
    def computing(self) -> bool:
        """Whether a request is being computed."""
        return self._running is not None

    @property
    def waiting(self) -> int:
        """Requests in the queue."""
        return len(self._known) - self.computing

    @property
    def memory(self) -> int:
        """Memory that the process holds [bytes]; 0 where the system does not tell."""
        with suppress(OSError, AttributeError):
            return os.sysconf("SC_PAGE_SIZE") * int(Path(f"/proc/{self.ready.process}/statm").read_text().split()[1])
        return 0

    def submit(self, call: Any) -> Request:
        """Put a request into the queue.

        Where the queue is full, requests are refused in turn: each is told when to come again, and one that does so under the
        same id finds its place kept from those who come later.

        Raises:
            ServerError: The queue is full or closed, or a request of the same id is under way.
        """
        with self._lock:
            if self.closed:
                raise ServerError("the server is stopping; ask another one, or ask again once it runs")
            if call.id in self._known:
                raise ServerError(f"a request '{call.id}' is under way; give each its own id")
            if (missing := self._ahead(call.id) + 1 - (self.longest - self.waiting)) > 0:
                raise self._later(call, missing)
            self._tickets.pop(call.id, None)
            request = self._known[call.id] = Request(call, next(self._numbers))
            request.turn = self._turns.submit(self._work, request)
        return request

    def _ahead(self, name: str) -> int:
        """How many refused requests have an older turn than that of this id; the lock is held."""
        now = time.monotonic()
        self._tickets = {other: until for other, until in self._tickets.items() if until > now}
        return list(self._tickets).index(name) if name in self._tickets else len(self._tickets)

    def _later(self, call: Any, missing: int) -> ServerError:
        """A refusal that says when the missing places are free; the lock is held."""
        done = sum(self.metrics.replies[status] for status in (HTTPStatus.OK, HTTPStatus.UNPROCESSABLE_ENTITY))
        usual = self.metrics.computing_seconds / done if done else USUAL_SECONDS
        seconds = min(max(1.0, missing * usual), self.time_limit)
        # An id that nobody chose does not come again.
        if "id" in call.model_fields_set and (call.id in self._tickets or len(self._tickets) < TICKETS * self.longest):
            self._tickets[call.id] = time.monotonic() + seconds + LATE_SECONDS
        return ServerError(f"{self.waiting} requests are waiting already; ask again later, in {math.ceil(seconds)} s and "
                           "under the same id to keep your turn", seconds)

    def cancel(self, name: str) -> bool:
        """End a request, in the queue or under way; whether there is one of this id.

        One in the queue is replied to at once, and leaves its place and its id to others. One that is computed ends at its next
        step, or with its process after a while.
        """
        with self._lock:
            request = self._known.get(name)
            if request is None:
                return False
            if request.turn is None or not request.turn.cancel():
                self._cancelled.value = request.number
                patience = threading.Timer(self.grace, request.abandon)
                patience.daemon = True
                patience.start()
                return True
            self.metrics.waiting_seconds += time.monotonic() - request.since
            self._forget(request, CANCELLED)
        request.reply.set_result(CANCELLED)
        return True

    def close(self, patience: float = 0.0) -> None:
        """Refuse what waits, give what is computed some time to end [s], and end the process."""
        with self._lock:
            self.closed = True
            running = self._running
            waiting = [request for request in self._known.values() if request.turn is not None and request.turn.cancel()]
            for request in waiting:
                self._forget(request, STOPPED)
        for request in waiting:
            request.reply.set_result(STOPPED)
        if running is not None:
            if patience > 0:
                futures.wait([running.reply, self._hurry], patience, futures.FIRST_COMPLETED)
            running.abandon()
        self._turns.shutdown()
        self._end()

    def hurry(self) -> None:
        """Let `close` wait no longer."""
        with suppress(InvalidStateError):
            self._hurry.set_result(STOPPED)

    def _work(self, request: Request) -> None:
        """Reply to a request whose turn it is, and see that there is a process for the next one."""
        with self._lock:
            self._running, begin = request, time.monotonic()
            self.metrics.waiting_seconds += begin - request.since
        reply, alive = self._computed(request)
        with self._lock:
            self._running = None
            self.metrics.computing_seconds += time.monotonic() - begin
            self._forget(request, reply)
        request.reply.set_result(reply)
        if not alive:
            self._end()
            if not self.closed:
                with suppress(Exception):  # the next request tells
                    self._start()

    def _forget(self, request: Request, reply: Reply) -> None:
        """Count the reply to a request that is neither in the queue nor under way any more; the lock is held."""
        self.metrics.replies[int(reply.status)] += 1
        del self._known[request.call.id]

    def _computed(self, request: Request, again: bool = False) -> tuple[Reply, bool]:
        """The reply to a request, and whether its process is still alive.

        Where somebody else killed the process, or the system for want of memory, the request is computed once again.
        """
        try:
            if not self._pool.active:
                self._end()
                self._start()
            request.task = self._pool.schedule(Computer.compute, (request.call, request.number), timeout=self.time_limit)
            if self.closed:
                request.abandon()
            return request.task.result(), True
        except CancelledError:
            return STOPPED if self.closed else CANCELLED, False
        except TimeoutError:
            return refused(HTTPStatus.GATEWAY_TIMEOUT, f"the request took longer than {self.time_limit:g} s and was ended; ask "
                                                       "for fewer grasps or candidates"), False
        except Exception as error:  # of the process, or of a system that can start none
            if self._stops(error):
                return STOPPED, False
            if _was_killed(error) and not again:
                self._end()
                return self._computed(request, again=True)
            return refused(HTTPStatus.INTERNAL_SERVER_ERROR, f"the process died over this request ({type(error).__name__}: "
                                                             f"{error}); it starts anew"), False

    def _stops(self, error: BaseException) -> bool:
        """Whether the process ended because the server does: a service manager ends both at once."""
        if isinstance(error, ProcessExpired) and error.exitcode in TERMINATED:
            begin = time.monotonic()
            while not self.closed and time.monotonic() - begin < STOP_SECONDS:
                time.sleep(0.05)
        return self.closed

    def _start(self) -> None:
        """Start the process, and wait until it has loaded; raises what loading raises."""
        self.metrics.starts += 1
        self._folder = tempfile.TemporaryDirectory(prefix="dro-grasp-", ignore_cleanup_errors=True)
        self._pool = ProcessPool(
            1, initializer=Computer.prepare, initargs=(self._cancelled, self._folder.name), context=self._context)
        try:
            self.ready: Ready = self._pool.schedule(Computer.load, (self.answerer, self.config)).result()
        except (ProcessExpired, BrokenProcessPool) as error:
            self._end()
            raise OptionError("the process that loads weights and hands died") from error
        except BaseException:
            self._end()
            raise

    def _end(self) -> None:
        """End the process, whatever it does, and remove its temporary files.

        One caller comes after the other, as a pool's pipes may be closed by one thread only.
        """
        with self._ending:
            self._pool.stop()
            self._pool.join()
            self._folder.cleanup()


def _was_killed(error: BaseException) -> bool:
    """Whether a process was ended from outside; the code with which it ended may not be known yet."""
    return isinstance(error, BrokenProcessPool) or (
        isinstance(error, ProcessExpired) and error.exitcode in (None, -signal.SIGKILL))
