"""Weights of the small networks that ship beside the main one: half precision, no configuration."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from dro_grasp.files import replacing

SHIPPED_FOLDER = Path(__file__).parent.parent / "weights"
"""Where weights ship."""


def save_small(network: nn.Module, path: Path) -> None:
    """Write weights in half precision.

    Raises:
        OutputError: The file cannot be written.
    """
    with replacing(path, "weights") as temporary:
        save_file({name: value.half().contiguous() for name, value in network.state_dict().items()}, temporary)


def load_small(path: Path) -> dict[str, Tensor]:
    """The tensors of a file in single precision."""
    return {name: value.to(torch.float32) for name, value in load_file(path).items()}
