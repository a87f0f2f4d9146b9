"""Training in several processes, as torchrun starts them: ranks, and sums over all of them."""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, distributed

from dro_grasp.errors import OptionError


@dataclass(frozen=True)
class Processes:
    """This process, by its number, among those that train together; a process alone by default."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and reports."""
        return self.rank == 0

    def add_up(self, tensors: Iterable[Float[Tensor, "..."]]) -> None:
        """Replace every tensor by its sum over all processes, in one message."""
        tensors = list(tensors)
        if self.count == 1 or not tensors:
            return
        message = torch.cat([t.flatten() for t in tensors])
        distributed.all_reduce(message)
        for tensor, part in zip(tensors, message.split([t.numel() for t in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def from_first(self, value: Any) -> Any:
        """The first process's value, in all processes; the others may lack its disk."""
        if self.count == 1:
            return value
        box = [value]
        distributed.broadcast_object_list(box)
        return box[0]


def is_first() -> bool:
    """Whether this process writes files and reports, according to torchrun; true without torchrun."""
    return os.environ.get("RANK", "0") == "0"


def process_count() -> int:
    """Number of processes that torchrun started; one without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def join(device: str) -> tuple[Processes, str]:
    """Join the processes that torchrun started, if any, and take a device of one's own.

    Processes stay joined until they end, so a second stage of training finds them joined. Device `cuda` stands for the GPU
    with this process's number on its machine.
    """
    if process_count() == 1:
        return Processes(), device
    if device == "cuda":
        number, there = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
        if number >= there:
            raise OptionError(f"process {number} finds no GPU of its own, there are {there} here; use --nproc-per-node {there}")
        device = f"cuda:{number}"
        torch.cuda.set_device(number)
    if not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        atexit.register(distributed.destroy_process_group)
    return Processes(distributed.get_rank(), distributed.get_world_size()), device
