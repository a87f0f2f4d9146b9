"""The choice of kernels: fused ones where a CUDA device and Triton are, PyTorch's elsewhere."""

from __future__ import annotations

import sys
from functools import cache
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


def fused_kernels(values: Float[Tensor, "..."]) -> Any:
    """The module `network.fused` for single-precision tensors on the current CUDA device, if Triton runs there; else None."""
    if values.device.type != "cuda" or values.dtype != torch.float32 or values.device.index != torch.cuda.current_device():
        return None
    return _fused()


@cache
def _fused() -> ModuleType | None:
    try:
        from dro_grasp.network import fused

        fused.try_out()
    except Exception as error:  # there may be no Triton, no compiler for it, or a card that it does not know
        print(f"Triton is of no use here ({type(error).__name__}: {str(error)[:200]}); a GPU then trains several times slower",
              file=sys.stderr)
        return None
    return fused
