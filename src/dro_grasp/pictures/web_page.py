"""Self-contained web pages: tables, embedded pictures, one style."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dro_grasp._version import __version__
from dro_grasp.files import replacing

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #282c34; max-width: 1180px; margin: 2em auto; padding: 0 1em }
h1, h2 { font-weight: 600 } h2 { margin-top: 2.2em; border-top: 1px solid #ddd; padding-top: 1em }
table { border-collapse: collapse; font-size: 13px; margin: 1em 0 } td, th { padding: 2px 8px; text-align: right }
td:first-child, th:first-child, td:last-child.words { text-align: left } tr:nth-child(even) { background: #f6f7f8 }
pre { white-space: pre-wrap } pre, p, td.words { overflow-wrap: anywhere }
table { display: block; overflow-x: auto; max-width: 100% }
td.cell { min-width: 2.2em } img { max-width: 100% } p.note { color: #666 }
"""
"""CSS of every page."""


def write_page(path: Path, title: str, body: str) -> None:
    """Write a page of an HTML body, whose window has the title."""
    with replacing(path) as temporary:
        temporary.write_text(f"<!doctype html><meta charset=utf-8><title>{html.escape(title)}</title><style>{STYLE}</style>"
                             f"{body}<p class=note>dro-grasp {__version__}</p>", encoding="utf-8")


@dataclass(frozen=True)
class ShadedCount:
    """A count whose cell is shaded by its share of the largest count."""

    count: int
    largest: int


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; text of several words is left-aligned, and None is an empty cell."""
    body = "".join(f"<tr>{''.join(_cell(value) for value in row)}</tr>" for row in rows)
    return f"<table><tr>{''.join(f'<th>{html.escape(h)}</th>' for h in head)}</tr>{body}</table>"


def _cell(value: object) -> str:
    if isinstance(value, ShadedCount):
        colour = f"rgba(42,120,142,{0.65 * value.count / value.largest:.2f})" if value.count else "#f3d9cc"
        return f'<td class=cell style="background:{colour}">{value.count}</td>'
    if isinstance(value, str) and " " in value:
        return f"<td class=words>{html.escape(value)}</td>"
    text = "" if value is None else f"{value:,}" if isinstance(value, int) else html.escape(str(value))
    return f"<td>{text}</td>"


def image(png: bytes, description: str) -> str:
    """A picture embedded in the page."""
    return f'<p><img alt="{html.escape(description)}" src="data:image/png;base64,{base64.b64encode(png).decode()}"></p>'
