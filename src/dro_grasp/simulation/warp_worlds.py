"""Simulations on a device by MuJoCo Warp: thousands of worlds of one scene, in single precision.

What a rollout reads and writes stays on the processor. For each call of `step`, the state of the worlds goes to the device and
what became of it comes back, so worlds that do not step keep theirs. That is a thousandth of the time that the steps take.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, fields as fields_of, replace
from functools import cache, lru_cache
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from dro_grasp.extras import require_extra
from dro_grasp.simulation.scene import CACHED_SCENES, TrialScene
from dro_grasp.simulation.worlds import STATE, WARP, ProcessorWorlds

INPUTS = (*STATE, "ctrl", "xfrc_applied", "mocap_pos", "mocap_quat")  # Fields of MjData that steps depend on
MOST = 4096  # Worlds that step together. Ours: with 16,384, an H100 has no memory for 128 contacts each
FEWEST = 128  # Worlds of the smallest graph; others have powers of two. Ours: fewer are no faster
LARGEST = 1e10  # Positions and velocities above it count as exploded. Source: mjMAXVAL of MuJoCo
SPARE = 0.01  # Share of worlds that may have more constraints than fit; they run on the processor (ours)
LARGEST_ROOM = 1024  # Most contacts, and most constraints, that a world gets memory for (ours)
CACHED = 12  # Graphs that are kept, with the memory of their worlds (ours)


@dataclass(frozen=True)
class Room:
    """Memory for what touches in a world."""

    contacts: int = 64  # pairs of shapes that are near each other, on average. Ours: 32 of Allegro about a duck
    rows: int = 128  # constraints, at most. Ours: 46 there, 122 of Shadow about a mug

    def twice(self, name: str) -> Room:
        """Twice as much of one, up to a limit."""
        return replace(self, **{name: min(2 * getattr(self, name), LARGEST_ROOM)})


class WarpWorlds:
    """Worlds on a device, and on the processor the same ones for what is read and written, and for those that overflow."""

    def __init__(self, scene: TrialScene, own: ProcessorWorlds, device: str) -> None:
        _modules()
        self._scene, self._own, self._device = scene, own, "cpu" if device == WARP else device
        self._exploded = np.zeros(len(own.bind("qpos")), bool)
        self.bind, self.expand, self.set_const = own.bind, own.expand, own.set_const

    @property
    def unsound(self) -> Bool[np.ndarray, " n"]:
        """As of `Worlds`."""
        return self._own.unsound | self._exploded

    def step(self, rows: Int[np.ndarray, " k"], count: int) -> None:
        """As of `Worlds`."""
        rows = rows[~self.unsound[rows]]
        for begin in range(0, len(rows), MOST):
            self._step(rows[begin:begin + MOST], count)

    def _step(self, rows: Int[np.ndarray, " k"], count: int) -> None:
        fields = {name: values for name, values in self._own.expanded().items() if name in _batched()}
        graphs = _graphs(self._scene, self._device, tuple(sorted(fields)))
        inputs = {name: self.bind(name)[rows] for name in INPUTS}
        after, missed = graphs.step(inputs, {name: values[rows] for name, values in fields.items()}, count)
        fits = ~missed
        with np.errstate(invalid="ignore"):
            sane = np.all([(np.abs(values) < LARGEST).all(1) for values in after.values()], 0)
        self._exploded[rows[fits & ~sane]] = True
        for name, values in after.items():
            self.bind(name)[rows[fits]] = values[fits]
        if missed.any():
            self._own.step(rows[missed], count)


_ROOMS: dict[str, Room] = {}
"""What hands have needed, by their hashes: another object asks for about as much."""


class _Graphs:
    """Steps of one scene on one device, for several numbers of worlds."""

    def __init__(self, scene: TrialScene, device: str, fields: tuple[str, ...]) -> None:
        self._scene, self._device, self._fields = scene, device, fields
        self._lock, self._number = threading.Lock(), 0

    def step(
        self, inputs: dict[str, Float[np.ndarray, "k *_"]], fields: dict[str, Float[np.ndarray, "k *_"]], count: int
    ) -> tuple[dict[str, Float[np.ndarray, "k _"]], Bool[np.ndarray, " k"]]:
        """What becomes of the worlds, and which of them had no room; the room grows where those are many."""
        worlds = len(inputs["qpos"])
        with self._lock:
            number = self.number(worlds)
            while True:
                room = _ROOMS.get(hand := self._scene.hand.sha256, Room())
                graph = _graph(self._scene, self._device, self._fields, number, room)
                after, overflow = graph.step(inputs, fields, count)
                _ROOMS[hand] = _larger(room, overflow[:worlds])
                if _ROOMS[hand] == room:
                    return {name: values[:worlds] for name, values in after.items()}, overflow[:worlds] != 0

    def number(self, worlds: int) -> int:
        """Worlds of the graph for so many: the last one, unless it is too small, or four times as large as it must be."""
        if not self._number / 4 < worlds <= self._number:
            self._number = max(FEWEST, 1 << (worlds - 1).bit_length())
        return self._number


def _larger(room: Room, overflow: Int[np.ndarray, " k"]) -> Room:
    """The room that these overflows ask for: contacts share theirs, so all worlds lack it together."""
    kinds = _modules()[1].OverflowType
    shared = kinds.BROADPHASE | kinds.NARROWPHASE | kinds.CCD
    if (overflow & shared).any():
        return room.twice("contacts")
    if (overflow != 0).mean() > SPARE:
        return room.twice("rows")
    return room


class _Graph:
    """A number of worlds, and on CUDA their time step as one graph."""

    def __init__(self, model: mujoco.MjModel, device: str, number: int, fields: tuple[str, ...], room: Room) -> None:
        self._wp, self._mjw = _modules()
        self._device = self._wp.get_device(device)
        with self._wp.ScopedDevice(self._device):
            self._model = self._mjw.put_model(model, dict.fromkeys(fields, number))
            self._model.opt.warn_overflow = 0
            self._data = self._mjw.put_data(
                model, mujoco.MjData(model), nworld=number, nconmax=room.contacts, njmax=room.rows)
            self._graph = self._captured() if self._device.is_cuda else None

    def _captured(self) -> Any:
        self._mjw.step(self._model, self._data)  # compiles, which a capture cannot
        with self._wp.ScopedCapture() as capture:
            self._mjw.step(self._model, self._data)
        return capture.graph

    def step(
        self, inputs: dict[str, Float[np.ndarray, "k *_"]], fields: dict[str, Float[np.ndarray, "k *_"]], count: int
    ) -> tuple[dict[str, Float[np.ndarray, "n _"]], Int[np.ndarray, " n"]]:
        """State and overflows of all worlds after some steps; worlds beyond the k repeat them."""
        rows = np.resize(np.arange(len(inputs["qpos"])), self._data.nworld)
        with self._wp.ScopedDevice(self._device):
            for record, values in ((self._data, inputs), (self._model, fields)):
                for name, own in values.items():
                    getattr(record, name).assign(own[rows].astype(np.float32))
            self._data.overflow.zero_()
            for _ in range(count):
                self._step()
            after = {name: getattr(self._data, name).numpy().astype(np.float64) for name in STATE}
            return after, self._data.overflow.numpy() & int(_counted())

    def _step(self) -> None:
        if self._graph is None:
            self._mjw.step(self._model, self._data)
        else:
            self._wp.capture_launch(self._graph)


@lru_cache(maxsize=CACHED_SCENES)
def _graphs(scene: TrialScene, device: str, fields: tuple[str, ...]) -> _Graphs:
    return _Graphs(scene, device, fields)


@lru_cache(maxsize=CACHED)
def _graph(scene: TrialScene, device: str, fields: tuple[str, ...], number: int, room: Room) -> _Graph:
    return _Graph(scene.model, device, number, fields, room)


@cache
def _batched() -> frozenset[str]:
    """Fields of Warp's model that may differ between worlds; it reads no others of those that follow from masses."""
    kinds = {one.name: getattr(one.type, "shape", ()) for one in fields_of(_modules()[1].Model)}
    return frozenset(name for name, shape in kinds.items() if shape and shape[0] == "*")


def _counted() -> int:
    """The overflows after which a step is wrong; that a solver ends at its limit, or nearly, is not among them."""
    kinds = _modules()[1].OverflowType
    return kinds.NEFC | kinds.NJMAX_NNZ | kinds.BROADPHASE | kinds.NARROWPHASE | kinds.CCD


@cache
def _modules() -> tuple[ModuleType, ModuleType]:
    """Warp, which tells nothing of what it compiles, and MuJoCo Warp; OptionError: the extra is missing."""
    require_extra("gpu")
    import warp

    warp.config.log_level = warp.LOG_WARNING
    import mujoco_warp

    return warp, mujoco_warp
