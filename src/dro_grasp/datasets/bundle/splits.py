"""Splits: the grasps that training may use."""

from __future__ import annotations

HELD_OUT_HANDS = frozenset(f"assets/{name}" for name in ("inspire", "ability", "dclaw", "orca", "ezgripper"))
"""Hands that no shipped weights were trained on, for zero-shot and few-shot results. Ours."""
FEW_SHOT = "few_shot"
"""Split of a held-out hand's grasps on training objects: for fine-tuning studies, never for shipped weights."""
TRAINING = frozenset({"train", ""})
"""Splits of a training bundle; the empty one stands for an object of the user's own."""
SPLITS = {"train": TRAINING, "few_shot": frozenset({FEW_SHOT}), "validate": frozenset({"validate"})}
"""Splits that a bundle may hold, by the bundle's own split."""


def split_of(hand: str, object_split: str) -> str:
    """The split of a hand's grasps on an object of the given split.

    Args:
        hand: Name of the hand.
        object_split: "train", "validate", "test", or empty for an object of the user's own.
    """
    return FEW_SHOT if hand in HELD_OUT_HANDS and object_split in TRAINING else object_split
