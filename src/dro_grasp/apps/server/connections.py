"""Open connections of a grasp server: how many, whose, and how long they may be silent."""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from dro_grasp.kinds import Checked

LINGER_SECONDS = 1.0  # How long a refused connection stays, so that its refusal is read before it is cut off [s] (ours)
RETRY_SECONDS = 1  # When a client that found all connections taken should come again [s] (ours)


@dataclass(frozen=True)
class Limits(Checked):
    """How many connections a server keeps open, and how long it waits for the head of a request."""

    connections: int = 128  # Most open connections (ours)
    of_address: int = 64  # Most of one address (ours): a robot needs one, a proxy as many as it has clients
    head_seconds: float = 30.0  # Time within which the head of a request must arrive [s] (ours)


class LimitedConnection(H11Protocol):
    """A connection of uvicorn's, within limits.

    uvicorn counts silent connections as any others, waits for heads for ever, and refuses as text. Here a newcomer takes the
    place of the connection that has kept the server waiting longest. Only where all of them wait for the server, it is refused.
    """

    def __init__(
        self, limits: Limits, config: Config, server_state: ServerState, app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, dict(app_state), _loop)
        self.limits = limits
        self.since = self.loop.time()  # When the other side's turn began [s]
        self._patience: asyncio.TimerHandle | None = None
        self._ended, self._heard = False, False

    @property
    def keeps_waiting(self) -> bool:
        """Whether it is the other side's turn: no request has come whole that is not answered."""
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take it, in the place of another if need be, or refuse it."""
        super().connection_made(transport)
        self._await_head()
        others = [c for c in self.connections if c is not self and isinstance(c, LimitedConnection)]
        whose = Counter(c.address for c in others)
        if whose[self.address] >= self.limits.of_address:
            self._take_place([c for c in others if c.address == self.address], "of this address")
        elif len(others) >= self.limits.connections:
            most = max(whose[c.address] for c in others)
            self._take_place([c for c in others if whose[c.address] == most] if most > 1 else others, "that the server takes")

    @property
    def address(self) -> str:
        """Where it comes from."""
        return self.client[0] if self.client else ""

    def _take_place(self, others: list[LimitedConnection], which: str) -> None:
        idle = [c for c in others if c.keeps_waiting]
        if idle:
            min(idle, key=lambda c: c.since).refuse(
                HTTPStatus.REQUEST_TIMEOUT, "others wait, and no whole request has come; connect again to ask")
        else:
            self.refuse(HTTPStatus.SERVICE_UNAVAILABLE, f"all {len(others)} connections {which} are busy; ask again later")

    def data_received(self, data: bytes) -> None:
        """Read what comes, unless the connection is refused."""
        if self._ended:
            return
        if not self._heard:
            self._heard, self.app_state["since"] = True, self.loop.time()
        super().data_received(data)

    def handle_events(self) -> None:
        """Let uvicorn read, and see that a head does not take for ever."""
        super().handle_events()
        if self.cycle is not None and not self.cycle.response_complete and self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def on_response_complete(self) -> None:
        """It is the other side's turn again."""
        self._await_head()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        if self._patience is not None:
            self._patience.cancel()
        super().connection_lost(exc)

    def _await_head(self) -> None:
        self._heard, self.since = False, self.loop.time()
        if self._patience is not None:
            self._patience.cancel()
        self._patience = self.loop.call_later(self.limits.head_seconds, self._lose_patience)

    def _lose_patience(self) -> None:
        self.refuse(HTTPStatus.REQUEST_TIMEOUT, f"the head of the request did not arrive in {self.limits.head_seconds:g} s")

    def refuse(self, status: HTTPStatus, why: str) -> None:
        """Say why, and close; a request whose body is still on its way ends."""
        if self._ended or self.transport.is_closing():
            return
        self._ended = True
        self.connections.discard(self)
        if self._patience is not None:
            self._patience.cancel()
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        body = json.dumps({"error": why}).encode()
        again = f"Retry-After: {RETRY_SECONDS}\r\n" if status == HTTPStatus.SERVICE_UNAVAILABLE else ""
        head = (f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: application/json\r\n{again}"
                f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n")
        self.transport.write(head.encode() + body)
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.loop.call_later(LINGER_SECONDS, self.transport.abort)

    def send_400_response(self, msg: str) -> None:
        """As all refusals."""
        self.refuse(HTTPStatus.BAD_REQUEST, msg)

    def _should_upgrade(self) -> bool:
        return False  # nothing here is no HTTP

    def shutdown(self) -> None:
        """Close what waits for nothing; a request that has come whole is answered first."""
        if self.cycle is not None and not self.cycle.response_complete and self.cycle.more_body:
            self.refuse(HTTPStatus.SERVICE_UNAVAILABLE, "the server is stopping; ask another one, or ask again once it runs")
        else:
            super().shutdown()


def within(limits: Limits) -> type[asyncio.Protocol]:
    """The class of connections within these limits, as uvicorn takes it."""

    class Connection(LimitedConnection):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(limits, *args, **options)

    return Connection
