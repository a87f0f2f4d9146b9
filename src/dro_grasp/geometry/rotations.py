"""roma, without PyTorch's compiler, which it would import: that takes longer than all the rest of it and of this package."""

from __future__ import annotations

import sys
from types import ModuleType

import torch  # noqa: F401  (before the stand-in)

COMPILER = "torch._dynamo"
"""Module whose `disable` roma applies to two functions as it is imported; nothing here is compiled (ours)."""

if COMPILER in sys.modules:
    import roma
else:
    sys.modules[COMPILER] = ModuleType(COMPILER)
    sys.modules[COMPILER].__dict__["disable"] = lambda function: function
    try:
        import roma
    finally:
        del sys.modules[COMPILER]

__all__ = ["roma"]
