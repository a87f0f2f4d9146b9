"""The queue of a grasp server, and the one process that works it off."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from dro_grasp.errors import OptionError, ServerError
from dro_grasp.serve.computing import Ready, Reply, compute, refused

TICK = 0.1
"""How often the desk looks whether a request that is being computed was cancelled, or takes too long [s] (ours)."""
GRACE = 3.0
"""Time for a cancelled request to end by itself; then its process is ended, and starts anew in some seconds [s] (ours)."""
PAGE = 4096
"""Bytes of a page of memory, as /proc counts."""


@dataclass(eq=False)
class Request:
    """A request on its way."""

    call: Any
    """A GraspCall."""
    reply: Future[Reply] = field(default_factory=Future)
    since: float = field(default_factory=time.monotonic)
    """When it came [s]."""
    ended: float | None = None
    """When it was cancelled [s]."""


@dataclass
class Tally:
    """What a desk has done."""

    replies: Counter[int] = field(default_factory=Counter)
    """By the status of HTTP."""
    waiting_seconds: float = 0.0
    computing_seconds: float = 0.0
    starts: int = 0
    """Of the process."""


class Desk:
    """Takes requests in order, within limits; whatever a request does to the process, the next one is computed."""

    def __init__(
        self, stock: Any, longest_queue: int = 16, time_limit: float = 60.0,
        work: Callable[[Connection, Any], None] = compute,
    ) -> None:
        """Start the process, and wait until it has loaded its stock.

        Args:
            stock: What it computes with; see `Stock`.
            longest_queue: Requests that may wait.
            time_limit: A request that is computed for longer is ended [s].
            work: What the process does.

        Raises:
            OptionError: A limit is out of range, or the stock cannot be loaded.
        """
        if longest_queue < 1 or not 0 < time_limit < float("inf"):
            raise OptionError(f"the queue is {longest_queue} long and the time limit {time_limit} s; give at least 1, and a "
                              "positive time")
        self.stock, self.time_limit, self.work, self.tally = stock, time_limit, work, Tally()
        self.longest_queue = longest_queue
        self._queue: deque[Request] = deque()
        self._known: dict[str, Request] = {}
        self._lock = threading.Lock()
        self._news = threading.Condition(self._lock)
        self.computing = self.closed = False
        self._start()
        self._thread = threading.Thread(target=self._work, name="desk", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Requests in the queue."""
        return len(self._queue)

    @property
    def memory(self) -> int:
        """Memory that the process holds [bytes]; 0 where the system does not tell."""
        with suppress(OSError, IndexError, ValueError):
            return PAGE * int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1])
        return 0

    def submit(self, call: Any) -> Request:
        """Put a request into the queue.

        Raises:
            ServerError: The queue is full, the desk closes, or a request of the same id is under way.
        """
        request = Request(call)
        with self._lock:
            if self.closed:
                raise ServerError("the server is stopping; ask another one")
            if call.id in self._known:
                raise ServerError(f"a request '{call.id}' is under way; give each its own id")
            if self.waiting >= self.longest_queue:
                raise ServerError(f"{self.waiting} requests are waiting already; ask again later")
            self._queue.append(request)
            self._known[call.id] = request
            self._news.notify()
        return request

    def cancel(self, name: str) -> bool:
        """End a request, in the queue or under way; whether there is one of this id.

        One in the queue is replied to at once, and leaves its place and its id to others.
        """
        with self._lock:
            request = self._known.get(name)
            if request is None:
                return False
            request.ended = request.ended or time.monotonic()
            if request not in self._queue:
                return True
            self._queue.remove(request)
            self.tally.waiting_seconds += time.monotonic() - request.since
            self._forget(request, cancelled := _cancelled())
        request.reply.set_result(cancelled)
        return True

    def close(self) -> None:
        """Refuse what waits, and end the process."""
        with self._lock:
            self.closed = True
            for request in self._known.values():
                request.ended = request.ended or time.monotonic() - GRACE
            self._news.notify()
        self._thread.join()
        self._end()

    def _work(self) -> None:
        """Reply to one request after the other."""
        while True:
            with self._lock:
                self._news.wait_for(lambda: self._queue or self.closed)
                if not self._queue:
                    return
                request = self._queue.popleft()
                begin = time.monotonic()
                self.tally.waiting_seconds += begin - request.since
            reply = self._reply(request)
            with self._lock:
                self.tally.computing_seconds += time.monotonic() - begin
                self._forget(request, reply)
            request.reply.set_result(reply)
            if not self._process.is_alive() and not self.closed:
                with suppress(OptionError):  # the next request tells
                    self._start()

    def _forget(self, request: Request, reply: Reply) -> None:
        """Count the reply to a request that is neither in the queue nor under way any more; the lock is held."""
        self.tally.replies[int(reply.status)] += 1
        del self._known[request.call.id]

    def _reply(self, request: Request) -> Reply:
        """Have a request computed, for as long as it is wanted and within the limit."""
        if request.ended is not None:
            return _cancelled()
        self.computing = True
        try:
            if not self._process.is_alive():
                self._start()
            self._pipe.send(request.call)
            told, limit = False, time.monotonic() + self.time_limit
            while not wait([self._pipe, self._process.sentinel], TICK):
                now = time.monotonic()
                if now > limit:
                    self._end()
                    return refused(HTTPStatus.GATEWAY_TIMEOUT, f"the request took longer than {self.time_limit:g} s and was "
                                                               "ended; ask for fewer grasps or candidates")
                if request.ended is not None and now > request.ended + GRACE:
                    self._end()
                    return _cancelled()
                if request.ended is not None and not told:
                    told = True
                    self._pipe.send(None)
            return self._pipe.recv()
        except (EOFError, OSError, OptionError) as error:
            self._end()
            return refused(HTTPStatus.INTERNAL_SERVER_ERROR, f"the process died over this request ({self._process.exitcode}, "
                                                             f"{type(error).__name__}); it starts anew")
        finally:
            self.computing = False

    def _start(self) -> None:
        """Start the process, and wait for it.

        Raises:
            OptionError: It cannot load its stock.
        """
        context = multiprocessing.get_context("spawn")
        own, theirs = context.Pipe()
        self._pipe: Connection = own
        self._process = context.Process(target=self.work, args=(theirs, self.stock), name="compute", daemon=True)
        self._process.start()
        theirs.close()
        self.tally.starts += 1
        try:
            said = own.recv()
        except (EOFError, OSError):
            said = "the process that loads weights and hands died"
        if isinstance(said, str):
            self._end()
            raise OptionError(said)
        self.ready: Ready = said

    def _end(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _cancelled() -> Reply:
    return refused(HTTPStatus.CONFLICT, "the request was cancelled")
