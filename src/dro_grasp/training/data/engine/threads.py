"""Threads of a worker process: one, as threads of one process would compete with the other processes.

Where candidates are made on a device, few processes feed it, and each simulates on its share of the cores.

This module imports nothing else at its top: a worker calls it before it loads a numerical library.
"""

from __future__ import annotations

import os
import signal


def use_one_thread(simulating: int = 1) -> None:
    """Compute in one thread from now on, in this process, and leave Ctrl-C to the process that started it.

    Simulations may take more threads.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = str(simulating)  # whatever it was: simulations count their threads by it
    import torch

    torch.set_num_threads(1)
