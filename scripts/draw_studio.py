"""The picture of the viewer in the documents: the page, after generating grasps of the duck, in headless Chromium.

    python -m scripts.draw_studio docs/pictures/studio.png

Needs Chromium.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from tests.helpers.browser import page_of


def main(path: Path) -> None:
    """Serve, generate, take the picture."""
    with page_of(size=(1280, 860)) as page:
        page.add_style_tag(content=".mantine-Notifications-root { display: none }")  # that there is no graphics card
        page.get_by_role("button", name="Generate", exact=True).click(timeout=60_000)
        page.get_by_text("held under").wait_for(timeout=400_000)
        time.sleep(8)
        page.screenshot(path=path, timeout=300_000)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
