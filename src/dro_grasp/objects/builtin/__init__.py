"""Objects made in code, with exact convex parts, in a fixed split: usual ones, and hard ones, one file a kind."""

from __future__ import annotations

from dro_grasp.objects.builtin import flat, heavy, large, long, racks, small, usual, vessels
from dro_grasp.objects.builtin.construction import BuiltinObject
from dro_grasp.objects.shape import ObjectModel

HARD: dict[str, dict[str, BuiltinObject]] = {
    kind.__name__.rpartition(".")[2]: kind.OBJECTS for kind in (long, flat, vessels, racks, small, large, heavy)}
"""Objects that are hard to carry, by kind. Each kind has members in both splits, which differ in more than size."""
BUILTIN: dict[str, BuiltinObject] = usual.OBJECTS | {
    name: each for kind in HARD.values() for name, each in kind.items()}
"""Every built-in object. Test objects and hard objects never enter a training bundle."""


def make_builtin(name: str, *, scale: float = 1.0) -> ObjectModel:
    """Build one of the built-in objects."""
    return BUILTIN[name].build(name, scale)
