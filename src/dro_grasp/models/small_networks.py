"""Weights of the small networks that ship beside the main one: half precision, and a note on how they were made."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from dro_grasp.files import replacing

SHIPPED_FOLDER = Path(__file__).parent.parent / "weights"
"""Folder of the shipped weights."""
KEY = "dro_grasp_weights"
"""Metadata entry that marks a safetensors file as weights of this package; JSON."""
FORMAT_VERSION = 1
"""Version of that entry."""


def header(about: dict[str, Any] | None, history: Sequence[dict[str, Any]] = (), **more: Any) -> dict[str, str]:
    """Metadata of a weights file.

    Args:
        about: How the weights were made, and on what data.
        history: The same of the weights that they began with, oldest first.
        more: What else the entry holds.
    """
    entry = {"format_version": FORMAT_VERSION, **more, "about": about or {}, "history": list(history)}
    return {KEY: json.dumps(entry)}


def save_small(
    network: nn.Module, path: Path, about: dict[str, Any] | None = None, history: Sequence[dict[str, Any]] = ()
) -> None:
    """Write weights in half precision; `header` explains the last two."""
    tensors = {name: value.half().contiguous() for name, value in network.state_dict().items()}
    with replacing(path, "weights") as temporary:
        save_file(tensors, temporary, metadata=header(about, history))


def load_small(path: Path) -> dict[str, Float[Tensor, "..."]]:
    """The tensors of a file in single precision."""
    return {name: value.to(torch.float32) for name, value in load_file(path).items()}


def history_of(path: Path) -> list[dict[str, Any]]:
    """How the weights of a file were made: one entry a training, oldest first; empty where the file does not say."""
    with safe_open(path, "pt") as file:
        entry = json.loads((file.metadata() or {}).get(KEY, "{}"))
    return [*entry.get("history", []), *([entry["about"]] if entry.get("about") else [])]
