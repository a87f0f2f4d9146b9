"""Report of a data set as one self-contained web page: yields, failures, coverage, diversity, energies, pictures."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Callable, Sequence
from itertools import takewhile
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dro_grasp.files import check_output
from dro_grasp.frames import HALF_AXES
from dro_grasp.grasps.columns import ENERGY_TERM
from dro_grasp.grasps.sources import object_of
from dro_grasp.pictures.sheets import caption, contact_sheet, draw_grasp
from dro_grasp.pictures.web_page import ShadedCount, image, table, write_page
from dro_grasp.training.data.collections.coverage import ROLL_BINS, HandCoverage, PairCoverage, grasp_sizes, wrist_rolls

MAX_PICTURES = 8  # Grasps drawn for each hand, each on another object
LABEL = 14  # Most characters of a joint's label in a chart (ours)
COLOUR = "#2a788e"
"""Blue of the data in charts."""
ACCENT = "#d1713b"
"""Orange of medians and labels in charts."""


def write_report(hands: Sequence[HandCoverage], path: Path, progress: Callable[[int, int], None] | None = None) -> None:
    """Write the page; `progress` is called with (hands done, all hands)."""
    path = check_output(path)
    sections = []
    for i, hand in enumerate(hands):
        sections.append(_section(hand))
        if progress is not None:
            progress(i + 1, len(hands))
    title = f"{sum(len(h.grasps) for h in hands):,} grasps of {len(hands)} hand{'' if len(hands) == 1 else 's'}"
    write_page(path, "Grasp data set", f"<h1>{title}</h1>{_overview(hands)}{''.join(sections)}")


def _overview(hands: Sequence[HandCoverage]) -> str:
    rows = [
        [h.grasps.hand, len(h.grasps), len(h.pairs), sum(not p.grasps for p in h.pairs), y.candidates, y.evaluated,
         _percent(y.valid, y.evaluated), round(y.per_cpu_hour), *(f"{value:.3f}" for value in h.diversity.values())]
        for h, y in ((h, h.yields) for h in hands)
    ]
    head = ["hand", "grasps", "objects", "without a grasp", "candidates", "trials", "valid", "per CPU-hour",
            "diversity", "of wrist", "of joints"]
    return table(head, rows) + (
        "<p class=note>Diversity: mean over x, y, z, roll, pitch, yaw and all joints of the standard deviation over "
        "grasps. Yields are those of synthesis; the data set may hold only some of the valid grasps.</p>")


def _section(hand: HandCoverage) -> str:
    name = html.escape(hand.grasps.hand)
    parts = [f"<h2>{name}</h2>"]
    if len(hand.grasps):
        parts += [image(charts(hand), f"charts of {name}"), image(grasps_drawn(hand), f"grasps of {name}")]
    head = ["object", "grasps", "candidates", "per CPU-hour", *HALF_AXES, f"rolls of {ROLL_BINS}", "size [cm]",
            "contact links", "why no grasp"]
    return "".join([*parts, _failures(hand), table(head, [_pair_row(pair) for pair in hand.pairs])])


def charts(hand: HandCoverage) -> bytes:
    """Palm directions, rolls, sizes, energies and joints of a hand's grasps, as one PNG."""
    figure = Figure(figsize=(12, 6.2), layout="constrained")
    grid = figure.add_gridspec(2, 3)
    _directions(figure.add_subplot(grid[0, 0], projection="mollweide"), hand)
    rolls = figure.add_subplot(grid[0, 1])
    rolls.hist(torch.rad2deg(wrist_rolls(hand.hand, hand.grasps)).tolist(), bins=24, range=(0, 360), color=COLOUR)
    rolls.set(title="wrist roll about the palm direction", xlabel="[degrees]", xticks=range(0, 361, 90))
    sizes = figure.add_subplot(grid[0, 2])
    sizes.hist((100 * grasp_sizes(hand.hand, hand.grasps)).tolist(), bins=24, color=COLOUR)
    sizes.set(title="grasp size: widest fingertip distance", xlabel="[cm]")
    _energies(figure.add_subplot(grid[1, 0]), hand)
    _joints(figure.add_subplot(grid[1, 1:]), hand)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()


def _directions(axes: Axes, hand: HandCoverage) -> None:
    d = hand.hand.palm_directions(hand.grasps.T_object_wrist)
    axes.scatter(torch.atan2(d[:, 1], d[:, 0]), d[:, 2].clamp(-1, 1).asin(), s=4, alpha=0.4, color=COLOUR, linewidths=0)
    for label, (x, y) in {"+x": (0, 0), "+y": (math.pi / 2, 0), "-y": (-math.pi / 2, 0), "+z": (0, math.pi / 2.05),
                          "-z": (0, -math.pi / 2.05), "-x": (math.pi * 0.97, 0)}.items():
        box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": ACCENT, "linewidth": 0.8}
        axes.annotate(label, (x, y), color=ACCENT, weight="bold", fontsize=8, ha="center", va="center", bbox=box, zorder=5)
    axes.set(title="palm directions in the object's frame", xticklabels=[], yticklabels=[])
    axes.grid(alpha=0.3)


def _energies(axes: Axes, hand: HandCoverage) -> None:
    terms = {k.removeprefix(ENERGY_TERM): v for k, v in hand.grasps.extra.items() if k.startswith(ENERGY_TERM)}
    if not terms:
        axes.text(0.5, 0.5, "energies not recorded", ha="center", transform=axes.transAxes)
        return
    names = list(terms)
    axes.boxplot([terms[n].tolist() for n in names], orientation="horizontal", showfliers=False, tick_labels=names,
                 medianprops={"color": ACCENT})
    axes.set(title="energy terms, weighted")


def _joints(axes: Axes, hand: HandCoverage) -> None:
    tree, q = hand.hand.tree, hand.grasps.joints
    low, high = tree.lower.tolist(), tree.upper.tolist()
    places = range(tree.n_dof)
    axes.vlines(places, low, high, color="#ccd", linewidth=7, label="limits")
    quantiles = torch.quantile(q, torch.tensor([0.1, 0.5, 0.9]), dim=0)
    axes.vlines(places, quantiles[0].tolist(), quantiles[2].tolist(), color=COLOUR, linewidth=4, label="10 to 90 %")
    axes.plot(places, quantiles[1].tolist(), "o", color=ACCENT, markersize=4, label="median")
    axes.set_xticks(list(places), short_names(tree.joint_names), rotation=60, ha="right", fontsize=7)
    axes.set(title=f"joints; mean standard deviation {hand.diversity['joints']:.2f}", ylabel="[rad or m]")
    axes.legend(fontsize=7, loc="lower right")


def short_names(names: Sequence[str]) -> list[str]:
    """Names without what all begin with, cut to their last LABEL characters unless two would be the same."""
    parts = [re.split("(?<=[/:])", name) for name in names]  # of which the last is the joint's own
    shared = list(takewhile(lambda part: len(set(part)) == 1, zip(*(part[:-1] for part in parts), strict=False)))
    own = ["".join(part[len(shared):]) for part in parts]
    cut = [name if len(name) <= LABEL else f"…{name[1 - LABEL:]}" for name in own]
    return cut if len(set(cut)) == len(cut) else own


def grasps_drawn(hand: HandCoverage) -> bytes:
    """One grasp on each of some objects, evenly chosen from the alphabet, as one PNG."""
    names = [p.object for p in hand.pairs if p.grasps]
    chosen = [names[i * len(names) // min(MAX_PICTURES, len(names))] for i in range(min(MAX_PICTURES, len(names)))]
    tiles, captions = [], []
    for name in chosen:
        row = hand.grasps.object.index(name)
        grasps = hand.grasps[row]
        tiles.append(draw_grasp(hand.hand, object_of(grasps, None, 1.0), grasps, 0))
        captions.append((name, caption(grasps, 0)[1]))
    sheet, file = contact_sheet(tiles, captions, f"{hand.grasps.hand}: grasps as stored"), io.BytesIO()
    sheet.save(file, format="PNG")
    return file.getvalue()


def _failures(hand: HandCoverage) -> str:
    yields = hand.yields
    if not yields.candidates:
        return ""
    rows = [["candidates", yields.candidates, "100 %"], ["not evaluated: energy too high", yields.ranked_out, None],
            ["not evaluated: penetration too deep", yields.deep, None],
            ["not evaluated: closing moved the object too far", yields.moved, None],
            *[[reason, n, None] for reason, n in sorted(yields.failures.items(), key=lambda item: -item[1])],
            ["near-duplicates", yields.duplicates, None], ["valid", yields.valid, None]]
    if yields.judged:
        rows.append(["passed on a device, judged again by the CPU", yields.judged, None])
    return table(["outcome of candidates", "number", "share"], [
        [name, n, share or _percent(n, yields.candidates)] for name, n, share in rows
    ])


def _pair_row(pair: PairCoverage) -> list[object]:
    size = "" if math.isnan(pair.size[0]) else f"{100 * pair.size[0]:.0f}-{100 * pair.size[1]:.0f}"
    links = f"{pair.contact_links[0]}-{pair.contact_links[1]}" if pair.contact_links[1] else ""
    cells = [ShadedCount(n, max(pair.half_axes)) for n in pair.half_axes]
    return [pair.object, pair.grasps, pair.yields.candidates or None, round(pair.yields.per_cpu_hour) or None, *cells,
            pair.rolls, size, links, pair.reason]


def _percent(part: int, whole: int) -> str:
    return f"{part / whole:.0%}" if whole else ""
