"""A headless browser on a page that a process of its own serves."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import pytest
from playwright.sync_api import Page, sync_playwright
from viser import GuiEvent

HOST = "127.0.0.1"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = ["--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]


def use(control: Any, value: Any = None) -> None:
    """Press a button, or change a control, as a browser does."""
    if value is not None:
        control.value = value
    event = GuiEvent(client=cast(Any, object()), client_id=0, target=control)
    for called in list(control._impl.update_cb):
        called(event)


@contextmanager
def page_of(*arguments: str, size: tuple[int, int]) -> Iterator[Page]:
    """The page that `dro-grasp view` serves with these arguments; its console must stay without errors.

    The server runs in a process of its own: its event loop and playwright's do not share one well.
    """
    if CHROMIUM is None:
        pytest.skip("needs a browser: install chromium")
    port = free_port()
    command = [sys.executable, "-m", "dro_grasp", "view", *arguments, "--port", str(port)]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr is not None
        while "viewer: http" not in server.stderr.readline():
            assert server.poll() is None
        with sync_playwright() as play:
            browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            page = browser.new_page(viewport={"width": size[0], "height": size[1]})
            errors: list[str] = []
            page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
            page.goto(f"http://{HOST}:{port}")
            page.wait_for_selector("canvas", timeout=60_000)
            yield page
            browser.close()
        assert errors == []
    finally:
        server.terminate()
        server.communicate(timeout=20)
