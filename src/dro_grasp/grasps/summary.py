"""A GraspBatch in words: one sentence, or an HTML table for notebooks."""

from __future__ import annotations

import html
import math
from collections import Counter
from typing import Any

from dro_grasp.grasps.columns import NOT_EVALUATED, REASON

ROWS = 10
"""Most grasps in the HTML table (ours)."""
NAMES = 3
"""Most objects that are named (ours)."""


def percent(confidence: float) -> str | None:
    """A probability for people; None for NaN, which is unknown."""
    return None if math.isnan(confidence) else f"{100 * confidence:.0f} %"


def sentence(grasps: Any) -> str:
    """Number of grasps, hand, objects, outcome and range of score or energy."""
    missing = grasps.out_of - len(grasps)
    short = f" of {grasps.out_of} asked for" if missing else ""
    parts = [f"{len(grasps)} grasp{'' if len(grasps) == 1 else 's'}{short}", f"hand '{grasps.hand}'", _objects(grasps)]
    protocols = Counter(p for p in grasps.protocol if p != NOT_EVALUATED)
    for protocol, count in protocols.items():
        held = sum(s for s, p in zip(grasps.trial_success.tolist(), grasps.protocol, strict=True) if p == protocol)
        count += missing if len(protocols) == 1 else 0
        parts.append(f"{held} of {count} hold under {protocol}")
    if not grasps.evaluated.all():
        parts.append("not evaluated" if not grasps.evaluated.any() else f"{int((~grasps.evaluated).sum())} not evaluated")
    for name in ("score", "energy"):
        known = getattr(grasps, name)
        known = known[known.isfinite()]
        if len(known):
            parts.append(f"{name} {float(known.min()):.2f} to {float(known.max()):.2f}")
    return ", ".join(part for part in parts if part)


def _objects(grasps: Any) -> str:
    names = list(dict.fromkeys(grasps.object))
    if not names:
        return ""
    named = ", ".join(f"'{name}'" for name in names[:NAMES])
    more = f" and {len(names) - NAMES} more" if len(names) > NAMES else ""
    return f"object{'s' if len(names) > 1 else ''} {named}{more}"


def html_table(grasps: Any) -> str:
    """The sentence above a table of the first grasps."""
    reasons = grasps.extra.get(REASON) or [None] * len(grasps)
    lines = []
    for i in range(min(len(grasps), ROWS)):
        outcome = ("success" if grasps.success[i] else "failure") if grasps.evaluated[i] else ""
        numbers = [float(column[i]) for column in (grasps.score, grasps.energy)]
        cells = [i, grasps.object[i], *("" if x != x else f"{x:.2f}" for x in numbers), outcome, reasons[i] or ""]
        lines.append("".join(f"<td>{html.escape(str(cell))}</td>" for cell in cells))
    heads = "".join(f"<th>{head}</th>" for head in ("grasp", "object", "score", "energy", "trial", "reason"))
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    more = f"<p>and {len(grasps) - ROWS} more</p>" if len(grasps) > ROWS else ""
    return f"<p>{html.escape(sentence(grasps))}</p><table><tr>{heads}</tr>{body}</table>{more}"
