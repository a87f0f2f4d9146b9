"""Faster matrix products on processors where PyTorch's quick path loses nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache

import torch

LARGEST_DEVIATION = 1e-5
"""Largest relative deviation of a test product with which the quick path is taken. Source: ours; single precision has 4e-7."""
PROBE_SIZE = 256
"""Rows and columns of the test product's matrices. Source: ours."""


@contextmanager
def fast_products() -> Iterator[None]:
    """Within the block, single-precision products on the CPU take the quick path if it is accurate here.

    The setting "medium" lets PyTorch choose another library, which is 2-4 times as fast on some processors at the same
    accuracy. On others it rounds to half precision: a test product decides, once. It is never used where CUDA is
    present, whose products it would round. The caller's setting comes back at the end.
    """
    with nullcontext() if torch.cuda.is_available() or not quick_path_is_accurate() else _quick_path():
        yield


@contextmanager
def _quick_path() -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@cache
def quick_path_is_accurate() -> bool:
    """Whether a product on the quick path agrees with double precision."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, PROBE_SIZE, PROBE_SIZE, generator=generator)
    with _quick_path():
        product = a @ b
    exact = a.double() @ b.double()
    return bool((product - exact).abs().max() <= LARGEST_DEVIATION * exact.abs().max())
