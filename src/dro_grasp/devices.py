"""Devices and cores of this machine: which there are, how work and records are spread over them, and what time it takes."""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache, cached_property
from itertools import pairwise
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from dro_grasp.errors import OptionError

Result = TypeVar("Result")
Record = TypeVar("Record")


def choose_device(name: str) -> str:
    """The named device; `auto` stands for CUDA if there is a GPU, and for the CPU otherwise."""
    return name if name != "auto" else "cuda" if torch.cuda.is_available() else "cpu"


def require_device(name: str) -> None:
    """Refuse a name that is no device, and a device that this machine does not have, by an OptionError."""
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or not _computes(device):
        raise OptionError(f"device is '{name}'; give cpu, cuda, cuda:1 or mps")
    count = {"cuda": torch.cuda.device_count, "mps": torch.mps.device_count}.get(device.type)
    if count is not None and count() <= (device.index or 0):
        raise OptionError(f"device is '{name}', but torch {torch.__version__} finds {count() or 'no'} such; use device='cpu', "
                          f"which always works, or install a build of torch with {device.type.upper()}")


def _computes(device: torch.device) -> bool:
    """Whether PyTorch knows a device of this kind, or says of itself how many there are."""
    if device.type in ("cpu", "cuda", "mps"):
        return True
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError):  # what PyTorch raises for kinds that it was not built with
        return False
    return True


def cores() -> int:
    """Cores this process may use: those that it is bound to, and at most OMP_NUM_THREADS, which `--threads` sets."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return min(bound, int(wanted)) if wanted.isdecimal() and int(wanted) > 0 else bound


@contextmanager
def one_thread(device: torch.device | str = "cpu") -> Iterator[None]:
    """Within the block, PyTorch computes in one thread: several add to the CPU time of a task, and wait for each other.

    Nothing changes for work on another device.
    """
    if on_accelerator(device):
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def side_by_side(work: Callable[..., Result], *parts: Iterable[Any]) -> list[Result]:
    """The results for all parts of a task, as `map` gives them, by as many threads as PyTorch may use, one for each part.

    Threads that share a part wait for each other after every operation, which costs more than they gain where operations are
    small or other programs are at work; these wait once. Parts on another device follow each other.
    """
    jobs, threads, gradients = list(zip(*parts, strict=True)), torch.get_num_threads(), torch.is_grad_enabled()
    on_cpu = all(value.device.type == "cpu" for job in jobs for value in job if isinstance(value, torch.Tensor))
    if min(len(jobs), threads) < 2 or not on_cpu:
        with one_thread() if on_cpu else nullcontext():
            return [work(*job) for job in jobs]

    def prepare() -> None:  # both settings belong to a thread
        torch.set_num_threads(1)
        torch.set_grad_enabled(gradients)

    with one_thread(), ThreadPoolExecutor(threads, initializer=prepare) as pool:
        return list(pool.map(lambda job: work(*job), jobs))


FEWEST_ROWS = 64
"""Rows for which a thread is begun (ours): fewer take less time than it."""


def over_cores(work: Callable[[slice], list[Result]], count: int) -> list[Result]:
    """The results of work on so many rows, in their order, by as many threads as there are cores.

    It is for work that gives up Python's lock, as calls of MuJoCo do.
    """
    threads = min(cores(), count // FEWEST_ROWS)
    if threads < 2:
        return work(slice(0, count))
    ends = [count * i // threads for i in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        return [one for part in pool.map(lambda own: work(slice(*own)), pairwise(ends)) for one in part]


MEMORY_SHARE = 0.25
"""Share of a device's free memory that one batch may take (ours); the rest is for what is kept, and for errors of estimates."""
UNKNOWN_MEMORY = 4 * 2**30
"""Free memory of a device that does not tell it [bytes] (ours)."""


def at_once(device: torch.device | str, on_cpu: int, each: float, given: int | None = None) -> int:
    """How many things are computed at once.

    Args:
        device: Where.
        on_cpu: How many suit the cache of a processor; at least as many are computed at once elsewhere.
        each: Memory that one of them takes [bytes].
        given: What the caller asked for, which decides.
    """
    if given is not None:
        return given
    device = torch.device(device)
    if device.type == "cpu":
        return on_cpu
    free = float(UNKNOWN_MEMORY)
    if device.type == "cuda":
        # What PyTorch holds without using it is free as well.
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        free = torch.cuda.mem_get_info(device)[0] + cached
    return max(on_cpu, int(MEMORY_SHARE * free / each))


def on_accelerator(device: torch.device | str) -> bool:
    """Whether a device is not the CPU."""
    return torch.device(device).type != "cpu"


def where_any(mask: Bool[Tensor, " n"]) -> Int[Tensor, " k"] | slice:
    """Rows for which a mask holds; on a device, which would have to be waited for, all of them."""
    return mask.nonzero()[:, 0] if mask.device.type == "cpu" else slice(None)


def may_hold(mask: Bool[Tensor, "*n"]) -> bool:
    """Whether a mask holds anywhere; on a device, which would have to be waited for, yes."""
    return bool(mask.any()) if mask.device.type == "cpu" else True


def fast_products() -> AbstractContextManager[None]:
    """Within the block, single-precision products on the CPU take the quick path if it is accurate here.

    The setting "medium" lets PyTorch choose another library, which is 2-4 times as fast on some processors at the same
    accuracy. On others it rounds to half precision: a test product decides, once. CUDA's products it would round. It is a
    setting of the process: a block belongs around all that threads compute beside each other, or these round as the blocks of
    other threads begin and end.
    """
    return nullcontext() if torch.cuda.is_available() or not quick_path_is_accurate() else _QUICK_PATH


class _QuickPath(AbstractContextManager[None]):
    """The setting, which is the process's: the first block that begins sets it, the last that ends gives the caller's back."""

    def __init__(self) -> None:
        self._lock, self._blocks, self._before = threading.Lock(), 0, ""

    def __enter__(self) -> None:
        with self._lock:
            if self._blocks == 0:
                self._before = torch.get_float32_matmul_precision()
                torch.set_float32_matmul_precision("medium")
            self._blocks += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0:
                torch.set_float32_matmul_precision(self._before)


_QUICK_PATH = _QuickPath()  # The only one


@cache
def quick_path_is_accurate() -> bool:
    """Whether a product on the quick path agrees with double precision."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 256, 256, generator=generator)
    with _QUICK_PATH:
        product = a @ b
    exact = a.double() @ b.double()
    return bool((product - exact).abs().max() <= 1e-5 * exact.abs().max())  # (ours); single precision deviates by 4e-7


def on_device(record: Record, device: torch.device | str) -> Record:
    """A frozen dataclass on a device, with its tensors and its records that have a `to`; itself, if all of it is there.

    So what a record has derived of itself is not derived again.
    """
    values = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}  # type: ignore[arg-type]
    moved = {name: new for name, value in values.items() if hasattr(value, "to") and (new := value.to(device)) is not value}
    return dataclasses.replace(record, **moved) if moved else record  # type: ignore[type-var]


class Rows:
    """Base of dataclasses each of whose fields has one entry a row: a tensor, an array, or such a record again."""

    def rows(self: Record, index: Any) -> Record:
        """Some of the rows."""
        return type(self)(*(getattr(self, f.name)[index] for f in dataclasses.fields(self)))  # type: ignore[arg-type]

    def where(self: Record, mask: Bool[Tensor, " n"], other: Record) -> Record:
        """These rows where the mask holds, the other's elsewhere."""
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self))  # type: ignore[arg-type]
        return type(self)(*(
            a.where(mask, b) if isinstance(a, Rows) else torch.where(mask.view(-1, *[1] * (a.ndim - 1)), a, b)
            for a, b in pairs))


class cached_tensor(cached_property):  # type: ignore[type-arg]  # reads like the decorator it extends
    """A cached property whose tensors still work in training after inference has computed them."""

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with torch.inference_mode(False):
            return super().__get__(instance, owner)


class Stopwatch:
    """Adds up the time spent in named blocks."""

    def __init__(self, *names: str) -> None:
        """Start the named parts at zero; others appear when they run."""
        self.seconds: dict[str, float] = dict.fromkeys(names, 0.0)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count the block towards a part; CUDA, if it is in use, is waited for before the clock is read."""
        begin = time.perf_counter()
        yield
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin
