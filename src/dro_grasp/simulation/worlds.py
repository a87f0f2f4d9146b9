"""Simulations side by side, as a rollout needs them: MuJoCo's on the processor, MuJoCo Warp's on a device."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Bool, Float, Int

from dro_grasp.extras import require_extra
from dro_grasp.simulation.scene import TrialScene

STATE = ("qpos", "qvel", "qacc_warmstart")  # Quantities that a simulation needs to continue from an earlier moment
INPUTS = (*STATE, "ctrl", "xfrc_applied", "mocap_pos", "mocap_quat")  # Fields of MjData that steps depend on
WARP = "warp"  # In place of a device: MuJoCo Warp on the processor, which is slow and shows what a device would do


Values = dict[str, Float[np.ndarray, "k *_"]]  # Fields of k simulations


class Share(NamedTuple):
    """A scene, and how many simulations in a row are of it."""

    scene: TrialScene
    size: int


class Ahead(NamedTuple):
    """What would become of k simulations."""

    state: Values  # their STATE
    sound: Bool[np.ndarray, " k"]


@runtime_checkable
class Worlds(Protocol):
    """Simulations; arrays have a row for each and are written in place."""

    def bind(self, name: str) -> Float[np.ndarray, "n *_"]:
        """A field of MjData in all simulations."""
        ...

    def expand(self, name: str) -> Float[np.ndarray, "n *_"]:
        """A field of MjModel, from now on with a value of its own in each simulation."""
        ...

    def set_const(self) -> None:
        """Derive what follows from masses; it ends every change of the fields of MjModel."""
        ...

    def step(self, rows: Int[np.ndarray, " k"], count: int) -> None:
        """Take some of the simulations this many time steps further; the others stay as they are."""
        ...

    def ahead(self, rows: Int[np.ndarray, " k"], given: Values, count: int) -> Ahead:
        """What so many time steps would make of some of the simulations if they had these INPUTS; all stay as they are.

        A row may come several times, as for several forces.
        """
        ...

    @property
    def unsound(self) -> Bool[np.ndarray, " n"]:
        """Which simulations have exploded, or had more contacts than fit into memory."""
        ...


def worlds(shares: Sequence[Share], workers: int, device: str) -> Worlds:
    """Simulations on a device; those of several scenes, which must be of one hand, only where `on_processor` is false."""
    if on_processor(device):
        (scene, size), = shares
        return ProcessorWorlds(scene, size, workers)
    from dro_grasp.simulation.warp_worlds import WarpWorlds  # it needs an extra

    return WarpWorlds(shares, workers, device)


def on_processor(device: str) -> bool:
    """Whether simulations that belong to a device run on the processor: wherever Warp has no part to play."""
    return device != WARP and not device.startswith("cuda")


def require_worlds(device: str) -> None:
    """Refuse a device on which nothing can be simulated, as the extra is missing, by an OptionError."""
    if not on_processor(device):
        require_extra("gpu")


class ProcessorWorlds:
    """MuJoCo's batch of simulations of one scene."""

    def __init__(self, scene: TrialScene, size: int, workers: int) -> None:
        self._scene, self._workers = scene, workers
        self._batch = mujoco.batch.Batch(scene.model, nsim=size, nthread=min(workers, size))
        self._overflowed = np.zeros(size, bool)
        self.bind, self.expand, self.set_const = self._batch.bind, self._batch.expand, self._batch.set_const

    @property
    def unsound(self) -> Bool[np.ndarray, " n"]:
        """As of `Worlds`."""
        # MuJoCo resets a trial that explodes and continues; only the warning tells.
        return self._batch.warning[:, :, 1].any(1) | self._overflowed

    def step(self, rows: Int[np.ndarray, " k"], count: int) -> None:
        """As of `Worlds`."""
        try:
            self._batch.step(rows[~self._overflowed[rows]].tolist(), nstep=count)
        except mujoco.batch.SimulationError as error:  # more contacts than fit into memory; the others went on
            self._overflowed[error.ids] = True

    def ahead(self, rows: Int[np.ndarray, " k"], given: Values, count: int) -> Ahead:
        """As of `Worlds`."""
        if not len(rows):
            return Ahead({name: np.array(self.bind(name)[rows]) for name in STATE}, np.ones(0, bool))
        others = ProcessorWorlds(self._scene, len(rows), self._workers)
        for name in INPUTS:
            others.bind(name)[:] = given[name] if name in given else self.bind(name)[rows]
        for name, values in self.expanded(mujoco.batch.MODEL_FIELDS).items():
            others.expand(name)[:] = values[rows]
        others.step(np.arange(len(rows)), count)
        return Ahead({name: np.array(others.bind(name)) for name in STATE}, ~(others.unsound | self.unsound[rows]))

    def expanded(self, names: Collection[str]) -> Values:
        """Those of the fields of the model that have a value of their own in each simulation."""
        found = {name: self._batch.expanded(name) for name in names}
        return {name: values for name, values in found.items() if values is not None}
