"""Pages whose tables, numbers and figures come from data: what stands between their markers is written, never typed.

<!-- table headline.short -->      <!-- value lifts.xarm7_leaphand -->
| ... |                            97 % [92-99]<!-- end -->
<!-- end -->
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from dro_grasp.files import replacing

MARKED = re.compile(r"<!-- (table|value) ([\w.:-]+) -->(.*?)<!-- end -->", re.DOTALL)
"""A marker, its kind and name, and what stands in it."""
Writers = Mapping[str, Callable[[], str]]


def rendered(text: str, tables: Writers, values: Writers) -> str:
    """The page with everything between its markers written anew.

    Raises:
        KeyError: The page asks for what nobody writes.
    """

    def one(match: re.Match[str]) -> str:
        kind, name, _ = match.groups()
        content = f"\n{tables[name]()}\n" if kind == "table" else values[name]()
        return f"<!-- {kind} {name} -->{content}<!-- end -->"

    return MARKED.sub(one, text)


def write(page: Path, text: str) -> bool:
    """Replace a page; whether it changed."""
    if page.read_text() == text:
        return False
    with replacing(page) as temporary:
        temporary.write_text(text)
    return True


def unmarked(text: str) -> str:
    """What a person typed: the page without what stands between markers, and without code."""
    text = MARKED.sub("", text)
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]*`", "", text)
