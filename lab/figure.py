"""The figure of success by method and protocol, drawn from results."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from dro_grasp.compare.rows import average
from lab.benchmarks.report import ROOT
from lab.reading import MissingResult, Results, select

FIGURE = ROOT / "docs" / "pictures" / "results.png"
"""Success by method and protocol."""
METHODS = {"auto": "dro-grasp", "optimiser": "optimiser alone", "mean-grasp": "mean grasp of the training set",
           "start": "unoptimised starts"}
"""Methods of equal time, and what they are called."""
CONTROLS = {name: f"{text}, equal time" for name, text in METHODS.items() if name != "auto"}
"""Those that no network takes part in."""
DRAWN = ("carry", "dexgraspbench", "strict")
"""Protocols in the figure: those of all of its methods."""


def figure_data(results: Results) -> dict[str, dict[str, Sequence[float]]]:
    """Success and interval of each method under each protocol; nothing where it was not measured."""
    try:
        return _figure_data(results)
    except MissingResult:
        return {}


def _figure_data(results: Results) -> dict[str, dict[str, Sequence[float]]]:
    rows, stages = (results.rows("headline", "validate", ending) for ending in ("returned", "stages"))
    controls = results.rows("headline", "validate", "controls")
    found = {"network alone": average(select(stages, "network", "raw")), "returned by generate": average(rows)}
    found |= {text: average(select(controls, name, "equal-time")) for name, text in CONTROLS.items()}
    return {name: {p: row.success[p] for p in DRAWN} for name, row in found.items()}


def digest(data: object) -> str:
    """Of what a figure shows."""
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()[:16]


def draw_figure(data: dict[str, dict[str, Sequence[float]]], path: Path) -> None:
    """Bars with intervals; the file names the data that it was drawn from."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 3.6), dpi=150)
    width = 0.8 / max(1, len(data))
    for i, (name, rates) in enumerate(data.items()):
        middles = [100 * rate[0] for rate in rates.values()]
        spread = [[100 * abs(rate[0] - rate[k]) for rate in rates.values()] for k in (1, 2)]
        places = [j + (i - (len(data) - 1) / 2) * width for j in range(len(rates))]
        axes.bar(places, middles, 0.92 * width, yerr=spread, capsize=2, label=name, error_kw={"linewidth": 0.8})
    axes.set_xticks(range(len(DRAWN)), DRAWN)
    axes.set_title("" if data else "not measured")
    axes.set_ylabel("held [%], 95 % interval")
    axes.set_ylim(0, 105)
    axes.spines[["top", "right"]].set_visible(False)
    if data:
        axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3)
    figure.tight_layout()
    figure.savefig(path, metadata={"Description": digest(data)})
    plt.close(figure)


def figure_is_old() -> bool:
    """Whether the figure was drawn from other data, or is missing."""
    from PIL import Image

    with Image.open(FIGURE) as image:
        return image.text.get("Description") != digest(figure_data(Results()))  # type: ignore[attr-defined]
