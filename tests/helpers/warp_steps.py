"""MuJoCo in the place of Warp's graphs: it steps the same models with the same fields by world."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import mujoco.batch
import numpy as np

from dro_grasp.simulation.joint_model import ABSENT, JointModel
from dro_grasp.simulation.warp_worlds import Fields
from dro_grasp.simulation.worlds import STATE

State = dict[str, np.ndarray]


class Steps:
    """MuJoCo where Warp's graphs would be, with whatever is done to the outcome of a call."""

    def __init__(self, change: Callable[[State, np.ndarray], None] = lambda state, missed: None) -> None:
        self.change, self.calls, self.joints = change, list[int](), list[JointModel]()

    def __call__(self, joint: JointModel, device: str, fields: tuple[str, ...]) -> Steps:
        self.joints.append(joint)
        self.fields = fields
        return self

    def step(self, inputs: State, fields: Fields, count: int) -> tuple[State, np.ndarray]:
        number, joint = len(inputs["qpos"]), self.joints[-1]
        self.calls.append(number)
        batch, missed = mujoco.batch.Batch(joint.model, nsim=number, nthread=1), np.zeros(number, bool)
        for name, values in inputs.items():
            batch.bind(name)[:] = values
        for name, values in fields.values().items():
            batch.expand(name)[:] = values
        if len(joint.scenes) > 1:
            take_absent_shapes_away(batch)
        batch.step(nstep=count)
        state = {name: np.array(batch.bind(name)) for name in STATE}
        self.change(state, missed)
        return state, missed


def take_absent_shapes_away(batch: mujoco.batch.Batch) -> None:
    """In MuJoCo, a shape must have a mesh, and a body's bounds are those that it was compiled with."""
    meshes = batch.expand("geom_dataid")
    absent = (meshes == ABSENT) & (batch.model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    meshes[absent] = 0
    for name in ("geom_contype", "geom_conaffinity"):
        batch.expand(name)[absent] = 0
    batch.expand("bvh_aabb")[:] = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
