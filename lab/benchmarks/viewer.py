"""Waiting times of the viewer in headless Chromium: for its first page, and for sixteen grasps with their trials.

    python -m lab.benchmarks.viewer [--runs N] [--json]

Needs Chromium. The object is in the cache, as after its first use.
"""

from __future__ import annotations

import argparse
import time
from statistics import median

from lab.benchmarks.report import emit
from tests.helpers.browser import page_of

TARGETS = (3.0, 15.0)
"""Of the page and of the grasps [s]."""


def waits(runs: int) -> tuple[list[float], list[float]]:
    """Seconds until the page can be used, and until the grasps are there."""
    pages, grasps = [], []
    for _ in range(runs):
        with page_of(size=(1280, 860)) as page:
            assert page.context.browser is not None
            # Nothing is kept from the page that showed that the server is up.
            fresh = page.context.browser.new_context().new_page()
            begin = time.perf_counter()
            fresh.goto(page.url)
            generate = fresh.get_by_role("button", name="Generate", exact=True)
            generate.wait_for(timeout=60_000)
            pages.append(time.perf_counter() - begin)
            begin = time.perf_counter()
            generate.click()
            fresh.get_by_text("held under").wait_for(timeout=180_000)
            grasps.append(time.perf_counter() - begin)
    return pages, grasps


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="servers that are started")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    found = dict(zip(("first page", "16 grasps, evaluated under strict"), waits(options.runs), strict=True))
    rows = [[what, median(seconds), max(seconds), target]
            for (what, seconds), target in zip(found.items(), TARGETS, strict=True)]
    emit(f"the viewer, {options.runs} servers", rows, ["wait for", "median [s]", "longest [s]", "target [s]"],
         {what: median(seconds) for what, seconds in found.items()}, options.json)


if __name__ == "__main__":
    main()
