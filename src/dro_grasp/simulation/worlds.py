"""Simulations of one scene side by side, as a rollout needs them: MuJoCo's on the processor, MuJoCo Warp's on a device."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Bool, Float, Int

from dro_grasp.simulation.scene import TrialScene

STATE = ("qpos", "qvel", "qacc_warmstart")  # Quantities that a simulation needs to continue from an earlier moment
WARP = "warp"  # In place of a device: MuJoCo Warp on the processor, which is slow and shows what a device would do


@runtime_checkable
class Worlds(Protocol):
    """Simulations of one scene; arrays have a row for each and are written in place."""

    def bind(self, name: str) -> Float[np.ndarray, "n *_"]:
        """A field of MjData in all simulations."""
        ...

    def expand(self, name: str) -> Float[np.ndarray, "n *_"]:
        """A field of MjModel, from now on with a value of its own in each simulation."""
        ...

    def set_const(self) -> None:
        """Derive what follows from masses, after they were written."""
        ...

    def step(self, rows: Int[np.ndarray, " k"], count: int) -> None:
        """Take some of the simulations this many time steps further; the others stay as they are."""
        ...

    @property
    def unsound(self) -> Bool[np.ndarray, " n"]:
        """Which simulations have exploded, or had more contacts than fit into memory."""
        ...


def worlds(scene: TrialScene, size: int, workers: int, device: str) -> Worlds:
    """That many simulations of a scene, on a device; see `on_processor` for which devices have none."""
    own = ProcessorWorlds(scene, size, workers)
    if on_processor(device):
        return own
    from dro_grasp.simulation.warp_worlds import WarpWorlds  # it needs an extra

    return WarpWorlds(scene, own, device)


def on_processor(device: str) -> bool:
    """Whether simulations that belong to a device run on the processor: wherever Warp has no part to play."""
    return device != WARP and not device.startswith("cuda")


class ProcessorWorlds:
    """MuJoCo's batch of simulations."""

    def __init__(self, scene: TrialScene, size: int, workers: int) -> None:
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

    def expanded(self) -> dict[str, Float[np.ndarray, "n *_"]]:
        """The fields of the model that have a value of their own in each simulation."""
        found = {name: self._batch.expanded(name) for name in mujoco.batch.MODEL_FIELDS}
        return {name: values for name, values in found.items() if values is not None}
