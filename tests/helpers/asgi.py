"""Requests to a web application without a network: what a server would hand it, and what it hands back."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from typing import Any, NamedTuple


class Answer(NamedTuple):
    """What an application sends back."""

    status: int
    text: str
    headers: dict[str, str]

    def json(self) -> Any:
        return json.loads(self.text)


class Caller:
    """Asks an application as if it were served at 127.0.0.1:8090."""

    def __init__(self, app: Any, delay: float = 0.0) -> None:
        """Each part of a request arrives after a delay [s]."""
        self.app, self.delay = app, delay

    def __call__(
        self, method: str, page: str, content: Any = None, headers: dict[str, str] | None = None,
        parts: Sequence[bytes] | None = None,
    ) -> Answer:
        """Send JSON, or the bytes of some parts without telling their length."""
        body = [json.dumps(content).encode()] if parts is None else list(parts)
        sent = {"Host": "127.0.0.1:8090", "Content-Type": "application/json", **(headers or {})}
        sent |= {"Content-Length": str(len(body[0]))} if parts is None else {}
        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "scheme": "http",
            "path": page, "raw_path": page.encode(), "query_string": b"", "root_path": "", "state": {},
            "headers": [(name.lower().encode(), value.encode()) for name, value in sent.items()],
        }
        return asyncio.run(self._exchange(scope, body))

    async def _exchange(self, scope: dict[str, Any], body: list[bytes]) -> Answer:
        arriving, said = [*body], []

        async def receive() -> dict[str, Any]:
            if not arriving:
                await asyncio.Event().wait()  # the other side stays connected
            await asyncio.sleep(self.delay)
            return {"type": "http.request", "body": arriving.pop(0), "more_body": bool(arriving)}

        async def send(message: dict[str, Any]) -> None:
            said.append(message)

        await self.app(scope, receive, send)
        text = b"".join(message.get("body", b"") for message in said).decode()
        return Answer(said[0]["status"], text, {name.decode(): value.decode() for name, value in said[0]["headers"]})


async def live(app: Any) -> None:
    """Start an application and stop it."""
    steps, said = iter(["lifespan.startup", "lifespan.shutdown"]), []

    async def receive() -> dict[str, Any]:
        return {"type": next(steps)}

    async def send(message: dict[str, Any]) -> None:
        said.append(message["type"])

    await app({"type": "lifespan", "asgi": {"version": "3.0"}, "state": {}}, receive, send)
    assert said == ["lifespan.startup.complete", "lifespan.shutdown.complete"]
