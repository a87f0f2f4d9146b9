"""The picture of the viewer in the documents: the page, after generating grasps of the duck, in headless Chromium.

    python scripts/draw_studio.py docs/pictures/studio.png

Needs playwright (`pip install -e '.[browser]'`) and Chromium.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

FLAGS = ["--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def main(path: Path, port: int = 8097) -> None:
    """Serve, generate, take the picture."""
    browser_path = shutil.which("chromium") or shutil.which("google-chrome")
    server = subprocess.Popen(
        [sys.executable, "-m", "dro_grasp", "view", "--port", str(port)], stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr is not None
        while "viewer: http" not in server.stderr.readline():
            assert server.poll() is None
        with sync_playwright() as play:
            browser = play.chromium.launch(executable_path=browser_path, args=FLAGS)
            page = browser.new_page(viewport={"width": 1280, "height": 860})
            page.goto(f"http://127.0.0.1:{port}")
            page.wait_for_selector("canvas", timeout=60_000)
            page.get_by_role("button", name="Generate", exact=True).click(timeout=60_000)
            page.get_by_text("held under").wait_for(timeout=180_000)
            for notice in page.get_by_role("button", name="Close").all():
                notice.click()
            time.sleep(8)
            page.screenshot(path=path)
            browser.close()
    finally:
        server.terminate()
        server.wait(timeout=20)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
