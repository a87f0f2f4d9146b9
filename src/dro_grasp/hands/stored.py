"""Built hands on disk: to derive one takes longer than to read all else of it."""

from __future__ import annotations

import dataclasses
import hashlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dro_grasp.geometry.cache import Arrays, cached_arrays
from dro_grasp.hands.anatomy import Finger, rigid_groups
from dro_grasp.hands.build import build_hand
from dro_grasp.hands.description.loader import Description
from dro_grasp.hands.hand import Hand

LIMITS = ("lower", "upper")  # What a hand's tree has otherwise than its description's
NONE = -1  # Stands for no thumb
CODE = Path(__file__).parents[1]  # Folder of the package


def stored_hand(description: Description, name: str, seed: int, n_points: int) -> Hand:
    """As `build_hand`, from the cache where the same code has built it before; errors are the same."""
    key = hashlib.sha256(f"{description.sha256} {seed} {n_points} {_code()}".encode()).hexdigest()
    stored = cached_arrays(
        f"hand-{key[:24]}", lambda: _packed(build_hand(description, name=name, seed=seed, n_points=n_points)))
    return _unpacked(stored, description, name)


@cache
def _code() -> str:
    """Hash of the code that derives hands, and of the libraries' versions."""
    digest = hashlib.sha256(f"{torch.__version__} {np.__version__}".encode())
    for file in sorted(path for part in ("hands", "geometry") for path in (CODE / part).rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _packed(hand: Hand) -> Arrays:
    """All that does not follow quickly from the description."""
    own = {f.name: value.numpy() for f in dataclasses.fields(hand) if isinstance(value := getattr(hand, f.name), Tensor)}
    own |= {f"tree.{name}": getattr(hand.tree, name).numpy() for name in LIMITS}
    for i, finger in enumerate(hand.fingers):
        own |= {f"finger{i}.{f.name}": np.array(getattr(finger, f.name), int) for f in dataclasses.fields(finger)}
    plain = {"palm": hand.palm, "contact_links": hand.contact_links, "thumb": NONE if hand.thumb is None else hand.thumb}
    return own | {name: np.array(value, int) for name, value in plain.items()} | {"fingers": np.array(len(hand.fingers))}


def _unpacked(stored: Arrays, description: Description, name: str) -> Hand:
    """The hand."""
    limits = {name: torch.from_numpy(stored[f"tree.{name}"]) for name in LIMITS}
    tree, thumb = dataclasses.replace(description.tree, **limits), int(stored["thumb"])
    fingers = tuple(Finger(**{f.name: tuple(stored[f"finger{i}.{f.name}"].tolist()) for f in dataclasses.fields(Finger)})
                    for i in range(int(stored["fingers"])))
    own: dict[str, Any] = {f.name: torch.from_numpy(stored[f.name]) for f in dataclasses.fields(Hand) if f.name in stored}
    return Hand(**own | {
        "name": name, "tree": tree, "fingers": fingers, "rigid_group": rigid_groups(tree), "palm": int(stored["palm"]),
        "contact_links": tuple(stored["contact_links"].tolist()), "sha256": description.sha256,
        "thumb": None if thumb == NONE else thumb, "description": description})
