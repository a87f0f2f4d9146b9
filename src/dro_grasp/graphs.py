"""Work that CUDA records once and then repeats, launched as one: for steps of many small operations."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Int, Shaped
from torch import Tensor

State = TypeVar("State")
Result = TypeVar("Result")

FEWEST_CAPTURED = 4
"""Fewer repetitions than these are not captured (ours): to capture a step takes as long as to launch it twice."""


def repeat(step: Callable[[State, Int[Tensor, "1"]], State], state: State, times: int) -> State:
    """The state after a step that is taken many times, and is told its number.

    The step computes with tensors alone and waits for none of them. CUDA launches it once, as it is captured in a graph, and
    then repeats the graph, so that launches cost nothing. What cannot be captured is launched each time.
    """
    first = _leaves(state)[0]
    if captures(first.device) and times >= FEWEST_CAPTURED and (graph := _captured(step, state)) is not None:
        for _ in range(times):
            graph.replay()
        return graph.state
    # Small operations take a sixth less time without what gradients need. What is cached was so by the first step, since
    # tensors that are made without can never be differentiated.
    bare = not torch.is_grad_enabled() and not torch.is_inference_mode_enabled() and first.device.type == "cpu"
    for number in range(times):
        with torch.inference_mode() if bare and number else nullcontext():
            state = step(state, torch.full((1,), number, device=first.device))
    return _copied(state) if bare else state


def captures(device: torch.device) -> bool:
    """Whether a device knows graphs."""
    return device.type == "cuda"


@dataclasses.dataclass(frozen=True)
class _Graph:
    """A captured step, which takes what is in `state` and leaves its result there."""

    state: Any
    replay: Callable[[], None]


_WARM: set[Any] = set()  # Code of the steps that ran before: libraries set themselves up at first use, which is not captured
_CAPTURING = threading.Lock()  # What another thread launches on the stream meanwhile would become part of the graph
_LAST: dict[torch.cuda.Stream, torch.cuda.CUDAGraph] = {}
"""The last graph of `repeat` on each stream. It is kept, so that the next one takes over its memory: what graphs leave is given
back to nobody before the GPU is full."""


def _captured(step: Callable[[State, Int[Tensor, "1"]], State], state: State) -> _Graph | None:
    """The step as a graph, which begins at a state; None if CUDA refuses."""
    kept = _copied(state)
    number = torch.zeros(1, dtype=torch.int64, device=_leaves(kept)[0].device)

    def run() -> None:
        for old, new in zip(_leaves(kept), _leaves(step(kept, number)), strict=True):
            old.copy_(new)
        number.add_(1)

    def warm() -> None:
        if step.__code__ not in _WARM:
            step(kept, number)
            _WARM.add(step.__code__)

    replay = recorded(run, number.device, warm, once=True)
    return None if replay is None else _Graph(kept, replay)


def recorded(
    run: Callable[[], None], device: torch.device, warm: Callable[[], object] = lambda: None,
    generator: torch.Generator | None = None, once: bool = False,
) -> Callable[[], None] | None:
    """What repeats the work that CUDA is given by a call, which is not done yet; None if CUDA refuses.

    Args:
        run: Launches the work.
        warm: Work that is done before on the same stream.
        generator: Source of the work's random numbers, if it has any: each repetition goes on from its state.
        once: Whether all repetitions come before the next work on the current stream: such works share their memory.
    """
    here, stream, graph = torch.cuda.current_stream(device), _capture_stream(device), torch.cuda.CUDAGraph()
    stream.wait_stream(here)
    try:
        with _CAPTURING, torch.cuda.stream(stream):
            warm()
            last = _LAST.pop(here, None) if once else None
            with _capture(graph, torch.cuda.graph_pool_handle() if last is None else last.pool(), stream, generator):
                run()
            if once:
                _LAST[here] = graph
    except RuntimeError:
        replay = None
    else:
        replay = graph.replay
    here.wait_stream(stream)  # in any case for what `warm` did
    return replay


@contextmanager
def _capture(
    graph: torch.cuda.CUDAGraph, pool: Any, stream: torch.cuda.Stream, generator: torch.Generator | None
) -> Iterator[None]:
    """Capture what the block launches, in memory of a pool; one that fails leaves generators and memory as they were.

    PyTorch ends what it has begun only once CUDA has accepted a capture. Otherwise generators (in 2.11), always the device's
    own too, refuse to draw from then on, and the pool's memory (in 2.13 still) is lost.
    """
    device = stream.device.index
    generators = [torch.cuda.default_generators[device], *([] if generator is None else [generator])]
    states = [one.clone_state() for one in generators]
    if generator is not None:
        graph.register_generator_state(generator)
    try:
        graph.capture_begin(pool=pool, capture_error_mode="thread_local")
        try:
            yield
        finally:
            graph.capture_end()
    except BaseException:
        for one, state in zip(generators, states, strict=True):
            one.graphsafe_set_state(state)
        with suppress(RuntimeError):  # raised where PyTorch has ended it
            _end_allocation()(device, pool)
            torch._C._cuda_releasePool(device, pool)
        with suppress(RuntimeError):  # what CUDA still has to tell of the failure comes with the next launch
            torch.zeros(1, device=stream.device)
        raise


def _end_allocation() -> Callable[[int, Any], None]:
    """PyTorch's end of allocating in a pool, by its name until 2.7 or since then."""
    names = ("_cuda_endAllocateToPool", "_cuda_endAllocateCurrentStreamToPool")
    return next(getattr(torch._C, name) for name in names if hasattr(torch._C, name))


@cache
def _capture_stream(device: torch.device) -> torch.cuda.Stream:
    """The stream on which steps are captured: each stream keeps memory of its own."""
    return torch.cuda.Stream(device)


class Repeated(Generic[State, Result]):
    """Work on a record of tensors, which CUDA records at the first call and then repeats, launched as one.

    What the work computes follows from these tensors, from others that stay where they are, such as weights, and from a
    generator; it waits for none of them, and all that it makes has shapes that follow from those it is given. Given other
    shapes, or where CUDA refuses to record it, it is launched piece by piece.
    """

    def __init__(self, work: Callable[[State], Result], generator: torch.Generator) -> None:
        self._work, self._generator, self._begun = work, generator, False
        self._replay: Callable[[], None] | None = None
        self._given: Any = None  # where the recorded work finds its tensors, and where it leaves its result
        self._result: Any = None

    def __call__(self, given: State) -> Result:
        """The result, which later calls leave as it is."""
        if captures(self._generator.device) and not self._begun:
            self._begun = True
            return self._first(given)
        if self._replay is None or _shapes(given) != _shapes(self._given):
            return self._work(given)
        for kept, new in zip(_leaves(self._given), _leaves(given), strict=True):
            kept.copy_(new)
        self._replay()
        return _copied(self._result)

    def _first(self, given: State) -> Result:
        """The result of the work, which is recorded after it."""
        first, kept = list[Result](), _copied(given)

        def warm() -> None:
            first.append(self._work(given))
            if self._generator.device.type == "cuda":
                torch.cuda.empty_cache()  # A graph has memory of its own

        def run() -> None:
            self._result = self._work(kept)

        self._given, self._replay = kept, recorded(run, self._generator.device, warm, self._generator)
        if self._replay is None:
            self._given = self._result = None
        return first[0] if first else self._work(given)


def _shapes(value: Any) -> list[torch.Size]:
    return [leaf.shape for leaf in _leaves(value)]


def _copied(value: Any) -> Any:
    return _rebuilt(value, iter([leaf.clone() for leaf in _leaves(value)]))


def _leaves(value: Any) -> list[Shaped[Tensor, "..."]]:
    """The tensors of a tensor, a tuple, or a record of them, parts of which may be missing."""
    if value is None:
        return []
    if isinstance(value, Tensor):
        return [value]
    parts = value if isinstance(value, tuple) else [getattr(value, f.name) for f in dataclasses.fields(value)]
    return [leaf for part in parts for leaf in _leaves(part)]


def _rebuilt(like: Any, leaves: Iterator[Shaped[Tensor, "..."]]) -> Any:
    """Such a value of other tensors."""
    if like is None:
        return None
    if isinstance(like, Tensor):
        return next(leaves)
    if isinstance(like, tuple):
        return tuple(_rebuilt(part, leaves) for part in like)
    return type(like)(*(_rebuilt(getattr(like, f.name), leaves) for f in dataclasses.fields(like)))
