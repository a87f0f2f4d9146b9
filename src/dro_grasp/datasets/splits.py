"""Which grasps may be trained on."""

from __future__ import annotations

HELD_OUT_HANDS = frozenset(f"assets/{name}" for name in ("inspire", "ability", "dclaw", "orca", "ezgripper"))
"""Hands that no shipped weights were trained on, so that zero-shot and few-shot results mean something."""
FEW_SHOT = "few_shot"
"""Split of a held-out hand's grasps on training objects: for fine-tuning studies, never for shipped weights."""
TRAINING = frozenset({"train", ""})
"""Splits that a training bundle takes; the empty one is an object of the user's own."""
SPLITS = {"train": TRAINING, "few_shot": frozenset({FEW_SHOT}), "validate": frozenset({"validate"})}
"""What a bundle may be made of, by name."""


def split_of(hand: str, object_split: str) -> str:
    """The split of a hand's grasps on an object of the given split.

    Args:
        hand: Name of the hand.
        object_split: "train", "validate", "test", or empty for an object of the user's own.
    """
    return FEW_SHOT if hand in HELD_OUT_HANDS and object_split in TRAINING else object_split
