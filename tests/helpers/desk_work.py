"""A stand-in for the computing process of a grasp server, which starts at once and fails in its own ways."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from dro_grasp.serve.computing import Ready, Reply


def obey(pipe: Connection, stock: Any) -> None:
    """Do what each call says: `echo`, `die`, `sleep` until it is cancelled, or `hang` whatever is said."""
    if stock == "broken":
        pipe.send("the stock is broken; mend it")
        return
    with suppress(EOFError, OSError):
        pipe.send(Ready(["claw"], ["can"]))
        while True:
            call = pipe.recv()
            if call is None:
                continue
            if call.hand == "die":
                os._exit(7)
            if call.hand == "hang":
                time.sleep(60)
            cancelled = call.hand == "sleep" and pipe.poll(60)
            if cancelled:
                pipe.recv()
            pipe.send(Reply(409 if cancelled else 200, call.id.encode()))
