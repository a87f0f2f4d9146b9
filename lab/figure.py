"""Figures of results: success by method and protocol, and confidence beside what held."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dro_grasp.compare.metrics import success_rate
from dro_grasp.compare.rows import average
from lab.benchmarks.report import ROOT
from lab.reading import MissingResult, Results, confidence_bins, select

METHODS = {"auto": "dro-grasp", "optimiser": "optimiser alone", "mean-grasp": "mean grasp of the training set",
           "start": "unoptimised starts"}
"""Methods of equal time, and what they are called."""
CONTROLS = {name: f"{text}, equal time" for name, text in METHODS.items() if name != "auto"}
"""Those that no network takes part in."""
DRAWN = ("carry", "dexgraspbench", "strict")
"""Protocols in the figure: those of all of its methods."""


@dataclass(frozen=True)
class Figure:
    """A picture in docs that follows from results."""

    path: Path
    found: Callable[[Results], Any]  # what it shows; plain values
    drawn: Callable[[Any, Any], None]  # on the axes of a figure, where anything was measured
    size: tuple[float, float]  # [inch]

    def data(self, results: Results) -> Any:
        """What it shows; nothing where it was not measured."""
        try:
            return self.found(results)
        except MissingResult:
            return {}

    def draw(self, data: Any, path: Path) -> None:
        """Write it; the file names the data that it was drawn from."""
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=self.size, dpi=150)
        if data:
            self.drawn(data, axes)
        else:
            axes.set_title("not measured")
        axes.spines[["top", "right"]].set_visible(False)
        figure.tight_layout()
        figure.savefig(path, metadata={"Description": digest(data)})
        plt.close(figure)

    def is_old(self) -> bool:
        """Whether it was drawn from other data, or is missing."""
        from PIL import Image

        if not self.path.exists():
            return True
        with Image.open(self.path) as image:
            return image.text.get("Description") != digest(self.data(Results()))  # type: ignore[attr-defined]


def success(results: Results) -> dict[str, dict[str, Sequence[float]]]:
    """Success and interval of each method under each protocol."""
    rows, stages = (results.rows("headline", "validate", ending) for ending in ("returned", "stages"))
    controls = results.rows("headline", "validate", "controls")
    found = {"network alone": average(select(stages, "network", "raw")), "returned by generate": average(rows)}
    found |= {text: average(select(controls, name, "equal-time")) for name, text in CONTROLS.items()}
    return {name: {p: row.success[p] for p in DRAWN} for name, row in found.items()}


def digest(data: object) -> str:
    """Of what a figure shows."""
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()[:16]


def bars(data: dict[str, dict[str, Sequence[float]]], axes: Any) -> None:
    """A group of bars for each protocol, with intervals."""
    width = 0.8 / len(data)
    for i, (name, rates) in enumerate(data.items()):
        middles = [100 * rate[0] for rate in rates.values()]
        spread = [[100 * abs(rate[0] - rate[k]) for rate in rates.values()] for k in (1, 2)]
        places = [j + (i - (len(data) - 1) / 2) * width for j in range(len(rates))]
        axes.bar(places, middles, 0.92 * width, yerr=spread, capsize=2, label=name, error_kw={"linewidth": 0.8})
    axes.set_xticks(range(len(DRAWN)), DRAWN)
    axes.set_ylabel("held [%], 95 % interval")
    axes.set_ylim(0, 105)
    axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3)


def calibration(results: Results) -> dict[str, list[list[float]]]:
    """Of each tenth of confidence: predicted, held, its interval, and how many grasps."""
    found = {}
    for name, in_part in (("unseen hands", False), ("objects in one depth image", True)):
        try:
            found[name] = [[b.predicted, *success_rate(b.held, b.n), b.n] for b in confidence_bins(results, in_part)]
        except MissingResult:
            continue
    return found


def against_the_diagonal(data: dict[str, list[list[float]]], axes: Any) -> None:
    """What held over what was predicted; areas grow with the number of grasps."""
    axes.plot([0, 100], [0, 100], color="0.7", linewidth=0.8)
    for name, bins in data.items():
        predicted, held, low, high = (np.array([100 * row[k] for row in bins]) for k in range(4))
        bar = axes.errorbar(predicted, held, yerr=[held - low, high - held], fmt="none", capsize=2, linewidth=0.8)
        axes.scatter(predicted, held, s=[6 + 4 * math.sqrt(row[4]) for row in bins], label=name,
                     color=bar.lines[2][0].get_color())
    axes.set_xlabel("confidence [%]")
    axes.set_ylabel("held under carry [%], 95 % interval")
    axes.set_xlim(0, 102)
    axes.set_ylim(0, 102)
    axes.set_aspect("equal")
    axes.legend(frameon=False, fontsize=8, loc="upper left")


FIGURES = (
    Figure(ROOT / "docs" / "pictures" / "results.png", success, bars, (8, 3.6)),
    Figure(ROOT / "docs" / "pictures" / "confidence.png", calibration, against_the_diagonal, (4.2, 4.2)),
)
"""All of them."""
