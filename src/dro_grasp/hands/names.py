"""What the names of links and joints say: hints, which geometry judges."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

SIDES = {"left": ({"left", "lh", "lft", "links"}, "l"), "right": ({"right", "rh", "rgt", "rechts"}, "r")}
"""Words that name a side, and the letter that does where most links begin or end with it (ours)."""
THUMB = {"thumb", "th", "daumen", "pouce", "pollex"}  # Words that name a thumb (ours)
MOST = 0.5  # Share of links that must have a side's letter (ours)


def words_of(name: str) -> list[str]:
    """The words of a name in small letters: `leftPalm_2` has left and palm."""
    apart = re.sub(r"([a-z0-9])([A-Z])|([A-Z])([A-Z][a-z])", r"\1\3_\2\4", name)
    return [word for word in re.split(r"[^a-z]+", apart.lower()) if word]


def named_side(links: Sequence[str], others: Iterable[str] = ()) -> str | None:
    """The side that names of links, or of the file, tell of; None where they tell of both or of none."""
    told = [words_of(name) for name in (*links, *others)]
    by_word = {side for side, (words, _) in SIDES.items() if any(words & set(its) for its in told)}
    ends = [{its[0], its[-1]} for its in told[: len(links)] if its]
    by_letter = {side for side, (_, letter) in SIDES.items() if sum(letter in its for its in ends) > MOST * len(links)}
    found = by_word or by_letter
    return found.pop() if len(found) == 1 else None


def named_thumb(fingers: Sequence[Sequence[str]]) -> int | None:
    """The one finger one of whose own links is called a thumb; None if there is none, or several."""
    found = [number for number, links in enumerate(fingers) if any(THUMB & set(words_of(link)) for link in links)]
    return found[0] if len(found) == 1 else None
