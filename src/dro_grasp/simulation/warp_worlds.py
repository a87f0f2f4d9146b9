"""Simulations on a device by MuJoCo Warp: thousands of worlds of one hand and several objects, in single precision.

What a rollout reads and writes stays on the processor. For each call of `step`, the state of the worlds goes to the device and
what became of it comes back, so worlds that do not step keep theirs. That is a thousandth of the time that the steps take.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields as fields_of, replace
from functools import cache, lru_cache
from types import ModuleType
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from dro_grasp.extras import require_extra
from dro_grasp.geometry.cache import cache_folder
from dro_grasp.simulation.joint_model import JointModel, joint_model
from dro_grasp.simulation.worlds import INPUTS, STATE, WARP, Ahead, ProcessorWorlds, Share, Values

MOST = 4096  # Worlds that step together. Ours: with 16,384, an H100 has no memory for 128 contacts each
FEWEST = 128  # Worlds of a GPU's smallest graph; others have powers of two. Ours: fewer are no faster
LARGEST = 1e10  # Positions and velocities above it count as exploded. Source: mjMAXVAL of MuJoCo
SPARE = 0.01  # Share of worlds that may have more constraints than fit; they run on the processor (ours)
LARGEST_ROOM = 1024  # Most contacts, and most constraints, that a world gets memory for (ours)
_LOADING = threading.Lock()  # Two threads that load Warp at once would tell it two folders
CACHED = 12  # Graphs that are kept, with the memory of their worlds (ours)


@dataclass(frozen=True)
class Room:
    """Memory for what touches in a world: as much as the closings of ten in fifteen hands need; others get twice as much.

    Counts are of fifteen hands that close on sixty stored grasps each (lab/notebook).
    """

    contacts: int = 48  # pairs of shapes that are near each other, on average: 9 to 27 where a hand closes on many objects
    rows: int = 192  # constraints, at most: 99 % of a hand's closings have no more than 88 to 297

    def twice(self, name: str) -> Room:
        """Twice as much of one, up to a limit."""
        return replace(self, **{name: min(2 * getattr(self, name), LARGEST_ROOM)})


class WarpWorlds:
    """Worlds on a device; those that overflow step on the processor."""

    def __init__(self, shares: Sequence[Share], workers: int, device: str) -> None:
        _modules()
        scenes = tuple(dict.fromkeys(share.scene for share in shares))
        self._joint, self._workers, self._device = joint_model(scenes), workers, "cpu" if device == WARP else device
        self._scene = np.concatenate([np.full(share.size, scenes.index(share.scene)) for share in shares])
        data, size = mujoco.MjData(self._joint.model), len(self._scene)
        self._data = {name: np.repeat(getattr(data, name)[None], size, 0) for name in INPUTS}
        self._fields = {name: values[self._scene] for name, values in self._joint.fields.items()}
        self._written: set[str] = set()  # Fields that the caller asked for
        self._version, self.unsound = object(), np.zeros(size, bool)

    def bind(self, name: str) -> Float[np.ndarray, "n *_"]:
        """As of `Worlds`."""
        return self._data[name]

    def expand(self, name: str) -> Float[np.ndarray, "n *_"]:
        """As of `Worlds`."""
        if name not in self._fields:
            self._fields[name] = np.repeat(getattr(self._joint.model, name)[None], len(self._scene), 0)
        self._written.add(name)
        return self._fields[name]

    def set_const(self) -> None:
        """As of `Worlds`."""
        for number in np.unique(self._scene).tolist():
            rows = np.flatnonzero(self._scene == number)
            own = self._on_processor(number, rows)
            own.set_const()
            for name, values in own.expanded(mujoco.batch.MODEL_FIELDS).items():
                self.expand(name)[self._place(name, number, rows)] = values
        self._version = object()

    def step(self, rows: Int[np.ndarray, " k"], count: int) -> None:
        """As of `Worlds`."""
        rows = rows[~self.unsound[rows]]
        state, sound = self.ahead(rows, {}, count)
        for name, values in state.items():
            self._data[name][rows[sound]] = values[sound]
        self.unsound[rows[~sound]] = True

    def ahead(self, rows: Int[np.ndarray, " k"], given: Values, count: int) -> Ahead:
        """As of `Worlds`."""
        inputs = {name: given[name] if name in given else self._data[name][rows] for name in INPUTS}
        state, sound = {name: np.array(inputs[name]) for name in STATE}, ~self.unsound[rows]
        going = np.flatnonzero(sound)
        for begin in range(0, len(going), MOST):
            part = going[begin:begin + MOST]
            found = self._ahead(rows[part], {name: values[part] for name, values in inputs.items()}, count)
            sound[part] = found.sound
            for name, values in found.state.items():
                state[name][part] = values
        return Ahead(state, sound)

    def _ahead(self, rows: Int[np.ndarray, " k"], inputs: Values, count: int) -> Ahead:
        names = sorted(self._fields.keys() & _batched())
        graphs = _graphs(self._joint, self._device, tuple(names))
        fields = Fields((self._version, rows.tobytes()), lambda: {name: self._fields[name][rows] for name in names})
        state, missed = graphs.step(inputs, fields, count)
        with np.errstate(invalid="ignore"):
            sound = np.all([(np.abs(values) < LARGEST).all(1) for values in state.values()], 0)
        for number in np.unique(self._scene[rows[missed]]).tolist():
            part = np.flatnonzero(missed & (self._scene[rows] == number))
            own = self._on_processor(number, rows[part]).ahead(
                np.arange(len(part)), {name: values[part] for name, values in inputs.items()}, count)
            sound[part] = own.sound
            for name, values in own.state.items():
                state[name][part] = values
        return Ahead(state, sound)

    def _on_processor(self, number: int, rows: Int[np.ndarray, " k"]) -> ProcessorWorlds:
        """Worlds of a scene as simulations of that scene alone, with the fields that were written."""
        own = ProcessorWorlds(self._joint.scenes[number], len(rows), self._workers)
        for name in self._written:
            own.expand(name)[:] = self._fields[name][self._place(name, number, rows)]
        return own

    def _place(self, name: str, number: int, rows: Int[np.ndarray, " k"]) -> Any:
        """Where the values of a scene are, for some of its worlds."""
        return np.ix_(rows, self._joint.shapes[number]) if name.startswith("geom_") else rows


@dataclass(frozen=True)
class Fields:
    """Fields of the model by world, and a key that tells whether they are those of the last call."""

    key: object
    values: Callable[[], dict[str, Num[np.ndarray, "k *_"]]]


_ROOMS: dict[str, Room] = {}
"""What hands have needed, by their hashes: another object asks for about as much."""


class _Graphs:
    """Steps of one model on one device, for several numbers of worlds."""

    def __init__(self, joint: JointModel, device: str, fields: tuple[str, ...]) -> None:
        self._joint, self._device, self._fields = joint, device, fields
        self._lock, self._number = threading.Lock(), 0

    def step(self, inputs: Values, fields: Fields, count: int) -> tuple[Values, Bool[np.ndarray, " k"]]:
        """What becomes of the worlds, and which of them had no room; the room grows where those are many."""
        worlds = len(inputs["qpos"])
        with self._lock:
            number = self.number(worlds)
            while True:
                room = _ROOMS.get(hand := self._joint.scenes[0].hand.sha256, Room())
                graph = _graph(self._joint, self._device, self._fields, number, room)
                after, overflow = graph.step(inputs, fields, count)
                _ROOMS[hand] = _larger(room, overflow[:worlds])
                if _ROOMS[hand] == room:
                    return {name: values[:worlds] for name, values in after.items()}, overflow[:worlds] != 0

    def number(self, worlds: int) -> int:
        """Worlds of the graph for so many: the last one, unless it is too small, or four times as large as it must be."""
        if not self._number / 4 < worlds <= self._number:
            self._number = max(1 if self._device == "cpu" else FEWEST, 1 << (worlds - 1).bit_length())
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
        self._key: object = None
        self._shapes = {name: getattr(self._model, name).numpy().shape for name in fields}

    def _captured(self) -> Any:
        self._mjw.step(self._model, self._data)  # compiles, which a capture cannot
        with self._wp.ScopedCapture() as capture:
            self._mjw.step(self._model, self._data)
        return capture.graph

    def step(
        self, inputs: Values, fields: Fields, count: int
    ) -> tuple[dict[str, Float[np.ndarray, "n *_"]], Int[np.ndarray, " n"]]:
        """State and overflows of all worlds after some steps; worlds beyond the k repeat them."""
        rows = np.resize(np.arange(len(inputs["qpos"])), self._data.nworld)
        with self._wp.ScopedDevice(self._device):
            for name, own in inputs.items():
                getattr(self._data, name).assign(own[rows].astype(np.float32))
            if fields.key != self._key:
                for name, own in fields.values().items():
                    self._write(name, own[rows])
                self._key = fields.key
            self._data.overflow.zero_()
            for _ in range(count):
                self._step()
            after = {name: getattr(self._data, name).numpy().astype(np.float64) for name in STATE}
            return after, self._data.overflow.numpy() & int(_counted())

    def _write(self, name: str, values: Num[np.ndarray, "n *_"]) -> None:
        """Give a field of the model a value in each world."""
        kind = np.int32 if np.issubdtype(values.dtype, np.integer) else np.float32
        getattr(self._model, name).assign(values.astype(kind).reshape(self._shapes[name]))

    def _step(self) -> None:
        if self._graph is None:
            self._mjw.step(self._model, self._data)
        else:
            self._wp.capture_launch(self._graph)


@lru_cache(maxsize=CACHED)
def _graphs(joint: JointModel, device: str, fields: tuple[str, ...]) -> _Graphs:
    return _Graphs(joint, device, fields)


@lru_cache(maxsize=CACHED)
def _graph(joint: JointModel, device: str, fields: tuple[str, ...], number: int, room: Room) -> _Graph:
    return _Graph(joint.model, device, number, fields, room)


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
    """Warp, which tells nothing of what it compiles and keeps it beside derived geometry, and MuJoCo Warp.

    Raises:
        OptionError: The extra is missing.
    """
    require_extra("gpu")
    with _LOADING:
        import warp

        warp.config.log_level = warp.LOG_WARNING
        if "WARP_CACHE_PATH" not in os.environ and not warp.config.kernel_cache_dir:  # Warp adds its version, once
            warp.config.kernel_cache_dir = str(cache_folder() / "kernels")
        import mujoco_warp

        return warp, mujoco_warp
