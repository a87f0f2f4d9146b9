"""Hands that several tests read: each is built once per process."""

from __future__ import annotations

from functools import cache

from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand


@cache
def loaded_hand(name: str) -> Hand:
    """`load_hand`, remembered."""
    return load_hand(name)
