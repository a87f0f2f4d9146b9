"""The moving part of a trial: close the hand on the object, then push the object."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import mujoco.batch
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.descriptions.tree_reading import quaternion_matrix
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import completed
from dro_grasp.hands.hand import Hand
from dro_grasp.simulation.outcome import GIVE_UP
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.scene import Scene, object_mass

FORCES = np.concatenate([np.eye(3), -np.eye(3)])
"""Directions of the forces, in the object's frame."""
RAMP = 10
"""Steps in which the servos' targets are led from one pose of the hand to the next."""
STATE = ("qpos", "qvel", "qacc_warmstart")
"""What a trial must get back to go on from an earlier moment."""


@dataclass(frozen=True)
class ObjectState:
    """The object in n trials."""

    position: np.ndarray
    """Of the centre of mass (n 3) [m]."""
    rotation: np.ndarray
    """In the wrist frame (n 3 3)."""
    stable: np.ndarray
    """Whether the simulation is sound so far (n)."""

    def shift(self, other: ObjectState) -> np.ndarray:
        """Distance to another state (n) [m]."""
        return np.linalg.norm(self.position - other.position, axis=1)

    def turn(self, other: ObjectState) -> np.ndarray:
        """Angle to another state (n) [rad]."""
        relative = np.einsum("nij,nik->njk", self.rotation, other.rotation)
        skew = relative - relative.transpose(0, 2, 1)
        sine = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1), axis=1)
        return np.arctan2(sine, np.trace(relative, axis1=1, axis2=2) - 1)

    def rows(self, index: np.ndarray) -> ObjectState:
        """The state in some of the trials."""
        return ObjectState(self.position[index], self.rotation[index], self.stable[index])


class Rollout:
    """Trials of some grasps running side by side, hands at their start and not yet closed."""

    def __init__(self, scene: Scene, hand: Hand, grasps: GraspBatch, workers: int) -> None:
        """Place hands and objects.

        Args:
            scene: Of the hand and the object.
            hand: The hand, from which the controller makes the joints that the grasps do not state.
            grasps: At least one.
            workers: Threads.
        """
        start, target = joint_targets(scene, hand, grasps)
        self.scene = scene
        self.size = len(grasps)
        self.batch = mujoco.batch.Batch(scene.model, nsim=self.size, nthread=min(workers, self.size))
        self.qpos, self.ctrl, self.force = (self.batch.bind(n) for n in ("qpos", "ctrl", "xfrc_applied"))
        self.qpos[:] = scene.qpos(grasps.T_object_wrist, start)
        # Where the servos are led, one after the other.
        way = [start, grasps.joints, target] if scene.protocol.gradual else [target]
        self.way = [joints.numpy()[:, scene.actuated] for joints in way]
        self.ctrl[:] = self.way[0]
        self.start = self.observe()

    def steps(self, seconds: float) -> int:
        """Time steps of a duration."""
        return round(seconds / self.scene.protocol.timestep)

    def close(self) -> ObjectState:
        """Move to the target for the protocol's closing time."""
        for steps in self.closing():
            with quiet():
                self.batch.step(nstep=steps)
        return self.observe()

    def closing(self) -> Iterator[int]:
        """Sets the servos' targets, one after the other, and says for how many time steps each of them holds."""
        steps = self.steps(self.scene.protocol.closing_time)
        if len(self.way) == 1:
            yield steps
        for begin, end in pairwise(self.way):
            for i in range(RAMP):
                self.ctrl[:] = begin + (i + 1) / RAMP * (end - begin)
                yield steps // (RAMP * (len(self.way) - 1))

    def state(self) -> dict[str, np.ndarray]:
        """Everything that moves, as it is now."""
        return {name: np.array(self.batch.bind(name)) for name in STATE}

    def restore(self, state: dict[str, np.ndarray], rows: np.ndarray) -> None:
        """Put some trials back to an earlier state."""
        for name, values in state.items():
            self.batch.bind(name)[rows] = values[rows]

    def set_force(self, axis: np.ndarray, rows: np.ndarray) -> None:
        """Force on the object along an axis of the object's frame, as the hand was told of it."""
        rules = self.scene.protocol
        newtons = rules.force * object_mass(self.scene.obj, rules)
        self.force[rows, self.scene.object_body, :3] = newtons * (self.start.rotation[rows] @ axis)

    def push(self, closed: ObjectState, alive: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All forces in turn on the trials that are alive; objects that are gone are left alone.

        Returns:
            Displacement (n 6) [m] and rotation (n 6) [rad] after each force, NaN where none was applied; whether
            the simulation stayed sound (n).
        """
        displacement, rotation = np.full((self.size, 6), np.nan), np.full((self.size, 6), np.nan)
        stable, alive = closed.stable.copy(), alive & closed.stable
        rules, steps = self.scene.protocol, self.steps(self.scene.protocol.force_time)
        origin = self.start if rules.reset else closed
        state = self.state() if rules.reset else {}
        for k, axis in enumerate(FORCES):
            rows = np.flatnonzero(alive)
            if not len(rows):
                break
            self.restore(state, rows)
            self.set_force(axis, rows)
            with quiet():
                self.batch.step(rows.tolist(), nstep=steps)
            now = self.observe(rows)
            # Later columns keep these values unless the trial goes on.
            displacement[rows, k:] = now.shift(origin.rows(rows))[:, None]
            rotation[rows, k:] = now.turn(origin.rows(rows))[:, None]
            stable[rows] = now.stable
            alive[rows] = now.stable & (displacement[rows, k] < GIVE_UP)
        return displacement, rotation, stable

    def observe(self, rows: np.ndarray | None = None) -> ObjectState:
        """Where the object is now, in all trials or some."""
        rows = np.arange(self.size) if rows is None else rows
        pose = self.qpos[rows][:, self.scene.object_qpos]
        rotation = _matrices(pose[:, 3:])
        position = pose[:, :3] + rotation @ self.scene.obj.centre_of_mass
        # MuJoCo resets a trial that explodes and goes on; only the warning remains of it.
        unstable = self.batch.warning[rows][:, :, 1].any(1) | ~np.isfinite(self.qpos[rows]).all(1)
        return ObjectState(position, rotation, ~unstable)

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Independent joints (n n_dof) and object poses in the wrist frame (n 4 4) now."""
        tree = self.scene.hand.tree
        joints = np.tile(self.scene.hand.rest.numpy().astype(float), (self.size, 1))
        for address, moving in zip(*self.scene.hand_qpos, strict=True):
            if (name := tree.moving_names[moving]) in tree.joint_names:
                joints[:, tree.joint_names.index(name)] = self.qpos[:, address]
        pose = self.qpos[:, self.scene.object_qpos]
        poses = np.tile(np.eye(4), (self.size, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = _matrices(pose[:, 3:]), pose[:, :3]
        return joints, poses


def joint_targets(
    scene: Scene, hand: Hand, grasps: GraspBatch
) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, "n n_dof"]]:
    """Joints at the start and joints aimed at [rad or m]; the controller makes what the grasps do not state."""
    rules: Protocol = scene.protocol
    if not rules.closing:
        return grasps.joints, grasps.joints
    grasps = completed(hand, grasps, torch.as_tensor(scene.obj.centre_of_mass), rules.controller)
    return grasps.pregrasp_joints, grasps.squeeze_joints


@contextmanager
def quiet() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to the terminal and to a log in the working folder."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_ignore)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _ignore(message: str) -> None:
    """Warnings are counted per trial; their text says nothing more."""


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (n 3 3) of quaternions WXYZ (n 4)."""
    return np.array([quaternion_matrix(quaternion) for quaternion in quaternions]).reshape(-1, 3, 3)
