"""The queue of a grasp server, and the one process that works it off."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Any, NamedTuple

from pebble import ProcessExpired, ProcessPool

from dro_grasp.errors import DroGraspError, OptionError, ServerError


class Reply(NamedTuple):
    """What a request comes to: a status of HTTP and a JSON object."""

    status: int
    body: bytes


def refused(status: HTTPStatus, why: str) -> Reply:
    """A reply that says why there is no answer."""
    return Reply(status, json.dumps({"error": why}).encode())


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
    def prepare(cls, cancelled: Any) -> None:
        """Start the process."""
        cls.cancelled = cancelled

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
        self._running: Request | None = None
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
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

        Raises:
            ServerError: The queue is full or closed, or a request of the same id is under way.
        """
        with self._lock:
            if self.closed:
                raise ServerError("the server is stopping; ask another one")
            if call.id in self._known:
                raise ServerError(f"a request '{call.id}' is under way; give each its own id")
            if self.waiting >= self.longest:
                raise ServerError(f"{self.waiting} requests are waiting already; ask again later")
            request = self._known[call.id] = Request(call, next(self._numbers))
            request.turn = self._turns.submit(self._work, request)
        return request

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

    def close(self) -> None:
        """Refuse what waits, and end the process."""
        with self._lock:
            self.closed = True
            names, running = list(self._known), self._running
        for name in names:
            self.cancel(name)
        if running is not None:  # only now, so that none that waits takes its place
            running.abandon()
        self._turns.shutdown()
        self._end()

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
                with suppress(DroGraspError):  # the next request tells
                    self._start()

    def _forget(self, request: Request, reply: Reply) -> None:
        """Count the reply to a request that is neither in the queue nor under way any more; the lock is held."""
        self.metrics.replies[int(reply.status)] += 1
        del self._known[request.call.id]

    def _computed(self, request: Request) -> tuple[Reply, bool]:
        """The reply to a request, and whether its process is still alive."""
        try:
            if not self._pool.active:
                self._end()
                self._start()
            request.task = self._pool.schedule(Computer.compute, (request.call, request.number), timeout=self.time_limit)
            if self.closed:
                request.abandon()
            return request.task.result(), True
        except CancelledError:
            return CANCELLED, False
        except TimeoutError:
            return refused(HTTPStatus.GATEWAY_TIMEOUT, f"the request took longer than {self.time_limit:g} s and was ended; ask "
                                                       "for fewer grasps or candidates"), False
        except (ProcessExpired, BrokenProcessPool, RuntimeError, DroGraspError) as error:
            return refused(HTTPStatus.INTERNAL_SERVER_ERROR, f"the process died over this request ({type(error).__name__}: "
                                                             f"{error}); it starts anew"), False

    def _start(self) -> None:
        """Start the process, and wait until it has loaded; raises what loading raises."""
        self.metrics.starts += 1
        self._pool = ProcessPool(1, initializer=Computer.prepare, initargs=(self._cancelled,), context=self._context)
        try:
            self.ready: Ready = self._pool.schedule(Computer.load, (self.answerer, self.config)).result()
        except (ProcessExpired, BrokenProcessPool) as error:
            self._end()
            raise OptionError("the process that loads weights and hands died") from error
        except BaseException:
            self._end()
            raise

    def _end(self) -> None:
        """End the process, whatever it does."""
        self._pool.stop()
        self._pool.join()
