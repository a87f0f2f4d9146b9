"""The process that computes for a grasp server: it takes one request after the other from a pipe."""

from __future__ import annotations

import json
import signal
from contextlib import suppress
from http import HTTPStatus
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from dro_grasp.errors import DroGraspError


class Reply(NamedTuple):
    """What a request comes to."""

    status: int
    """Of HTTP."""
    body: bytes
    """A JSON object."""


class Cancelled(Exception):
    """The request is no longer wanted."""


class Ready(NamedTuple):
    """What a process says once it has loaded its stock."""

    hands: list[str]
    """Names that can be asked for."""
    objects: list[str]
    """Likewise."""


def refused(status: HTTPStatus, why: str) -> Reply:
    """A reply that says why there is no answer."""
    return Reply(status, json.dumps({"error": why}).encode())


def compute(pipe: Connection, stock: Any) -> None:
    """Load the stock, say Ready or why not, and answer what comes through the pipe, until it is closed.

    What comes is a GraspCall, or None if the last one is no longer wanted; for each call, a Reply goes back.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one
    from dro_grasp.serve.answering import Answerer

    try:
        answerer = Answerer(stock)
    except DroGraspError as error:
        pipe.send(str(error))
        return
    with suppress(EOFError, OSError):  # the pipe is closed
        pipe.send(Ready(answerer.hand_names(), answerer.object_names()))
        while True:
            call = pipe.recv()
            if call is not None:  # None cancels what has ended meanwhile
                pipe.send(_reply(answerer, pipe, call))


def _reply(answerer: Any, pipe: Connection, call: Any) -> Reply:
    def check(*_: int) -> None:
        if pipe.poll():  # while a request is computed, nothing but its cancellation comes
            pipe.recv()
            raise Cancelled

    try:
        return Reply(HTTPStatus.OK, answerer.answer(call, check).model_dump_json().encode())
    except DroGraspError as error:
        return refused(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
    except Cancelled:
        return refused(HTTPStatus.CONFLICT, "the request was cancelled")
    except Exception as error:  # the server must survive a fault of ours, and the client is told that it is one
        return refused(HTTPStatus.INTERNAL_SERVER_ERROR, f"{type(error).__name__}: {error}; this is a fault of dro-grasp")
