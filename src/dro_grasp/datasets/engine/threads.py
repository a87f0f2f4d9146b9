"""One thread for each worker process, as threads of one process would compete with the other processes.

This module imports nothing else at its top: a worker calls it before it loads a numerical library.
"""

from __future__ import annotations

import os


def use_one_thread() -> None:
    """Compute in one thread from now on, in this process."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import torch

    torch.set_num_threads(1)
