"""The moving part of a trial: close the hand on the object, then push the object, under the conditions of one trial."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from dro_grasp.devices import Rows, cores
from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import table_planes
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.conditions import Conditions
from dro_grasp.simulation.joint_model import joins
from dro_grasp.simulation.outcome import FORCES, LOST_DISTANCE
from dro_grasp.simulation.quiet import quiet
from dro_grasp.simulation.resting import RESTS, lowest_points, stands
from dro_grasp.simulation.scene import TABLE_AWAY, TrialScene, object_mass
from dro_grasp.simulation.worlds import STATE, WARP, Share, on_processor, worlds

Moment = dict[str, Float[np.ndarray, "n _"]]  # What it takes to go on from a moment, in each of n trials
RAMP = 10  # Number of stages in which a gradual protocol moves the servos' targets from one posture to the next. Ours
CHUNK = 64  # Grasps simulated together. Ours: bounds memory; the result does not depend on it
DEVICE_CHUNK = 4096  # The same on a device. Ours: a step takes 1.6 ms for 1,024 worlds and 2.0 for 2,048 on an H100
FEW = 64  # Fewer grasps run on the processor, which is done before a device has begun (ours)
CLOSINGS = 1024
"""Closings that a scene keeps (ours), each of some hundred bytes: grasps repeat theirs as they are weighed and tried."""


@dataclass(frozen=True)
class ObjectState(Rows):
    """The object in n trials, in the wrist frame."""

    position: Float[np.ndarray, "n 3"]  # centre of mass [m]
    rotation: Float[np.ndarray, "n 3 3"]
    stable: Bool[np.ndarray, " n"]  # whether the simulation is sound so far

    def shift(self, other: ObjectState) -> Float[np.ndarray, " n"]:
        """Distance to another state [m]."""
        return np.linalg.norm(self.position - other.position, axis=1)

    def turn(self, other: ObjectState) -> Float[np.ndarray, " n"]:
        """Angle to another state [rad]."""
        relative = np.einsum("nij,nik->njk", self.rotation, other.rotation)
        # The skew part has the length 2 sin(angle), the trace is 1 + 2 cos(angle).
        skew = relative - relative.transpose(0, 2, 1)
        sine = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1), axis=1)
        return np.arctan2(sine, np.trace(relative, axis1=1, axis2=2) - 1)


@dataclass(frozen=True)
class Pulls:
    """Forces on the object along six directions, one after the other."""

    acceleration: float  # force per mass of the object [m/s^2]
    seconds: float  # duration of each [s]
    reset: bool  # whether each starts where the first one started; otherwise where the one before ended
    from_start: bool = False  # whether motion counts from the labelled grasp, not from where the first one started
    farthest: float = LOST_DISTANCE  # an object that moves so far is not pulled again [m]
    largest_turn: float = math.inf  # nor one that turns so far [rad]


class Rollout:
    """Trials of several grasps side by side; each hand waits at its start."""

    def __init__(
        self, scene: TrialScene, grasps: GraspBatch, workers: int, stride: int | None = None,
        conditions: Conditions | None = None, device: str = "cpu", shares: Sequence[Share] = (),
    ) -> None:
        """Place hands and objects.

        Grasps, one at least, state pregrasp and squeeze if the protocol closes the hand. A frame is recorded every `stride`
        time steps, none by default; `workers` are threads, and `conditions` differ from the protocol. The device is as of
        `worlds`. On one that is not the processor, `shares` may be scenes of further objects, of which the grasps are in turn.
        """
        rules = scene.protocol
        start, target = grasps.joints, grasps.joints
        if rules.closing:
            start, target = grasps.pregrasp_joints, grasps.squeeze_joints
        self.scene, self.stride, self.workers = scene, stride, workers
        self.size = len(grasps)
        self.shares = shares or (Share(scene, self.size),)
        self.mass = self._of_object(lambda scene, rows: np.full(rows.stop - rows.start, object_mass(scene.obj, rules)))
        if conditions is not None:
            grasps = GraspBatch.concatenate([
                conditions.rows(rows).displaced(grasps[rows], own.obj.centre_of_mass) for own, rows in self.parts()])
        self.device, self.altered = device, conditions is not None
        self.batch = worlds(self.shares, workers, device)
        if conditions is not None:
            self._change(conditions)
        self.qpos, self.ctrl, self.force = (self.batch.bind(n) for n in ("qpos", "ctrl", "xfrc_applied"))
        self.qpos[:] = self._of_object(lambda scene, rows: scene.qpos(grasps.T_object_wrist[rows], start[rows]))
        postures = [start, grasps.joints, target] if rules.gradual else [target]
        self.targets = [joints.numpy()[:, scene.actuated] for joints in postures]
        self.ctrl[:] = self.targets[0]
        self.start = self.observe()
        if scene.table:
            for own, rows in self.parts():
                self._lay(own.obj, grasps[rows], rows.start)
        self.frames = [] if stride is None else [self.poses()]

    def parts(self) -> Iterator[tuple[TrialScene, slice]]:
        """Each scene, and which trials are in it."""
        begin = 0
        for scene, size in self.shares:
            yield scene, slice(begin, begin + size)
            begin += size

    def _of_object(self, values: Callable[[TrialScene, slice], Float[np.ndarray, "k *_"]]) -> Float[np.ndarray, "n *_"]:
        return np.concatenate([values(scene, rows) for scene, rows in self.parts()])

    @property
    def place(self) -> torch.device:
        """Where tensors are that belong to many grasps."""
        return torch.device("cpu" if self.device == WARP or on_processor(self.device) else self.device)

    def close(self, first: int = 0, last: int | None = None) -> ObjectState:
        """Move to the target for the protocol's closing time; a table is there until then, and gone afterwards.

        What has closed in the same way before, in this scene, is not simulated again.

        Args:
            first: Number of the target from which the hand moves, of those of a gradual closing.
            last: Number of the target where it ends, with the table still there; by default the last one.
        """
        targets = self.targets[first:None if last is None else last + 1]
        begun, steps = self._beginnings(targets), self._steps(self.scene.protocol.closing_time)
        before = [self.scene.closings.get(key) for key in begun] if begun else [None] * self.size
        rows = np.flatnonzero([moment is None for moment in before])
        if len(self.targets) == 1:
            self._advance(rows, steps)
        for begin, end in pairwise(targets):
            for i in range(RAMP):
                self.ctrl[:] = begin + (i + 1) / RAMP * (end - begin)
                self._advance(rows, steps // (RAMP * (len(targets) - 1)))
        for name in STATE:
            for row, moment in enumerate(before):
                if moment is not None:
                    self.batch.bind(name)[row] = moment[name]
        if begun:
            self._remember({begun[row]: row for row in rows.tolist()})
        if self.scene.table and last is None:
            self.batch.bind("mocap_pos")[:] = TABLE_AWAY
            self.batch.bind("mocap_quat")[:] = [1.0, 0.0, 0.0, 0.0]  # as it is turned now, it may lie over the hand
            self.force[:] = 0.0
        return self.observe()

    def _beginnings(self, targets: Sequence[Float[np.ndarray, "n n_actuators"]]) -> list[bytes]:
        """What decides where each hand ends as it closes; nothing where more than that decides, or frames are recorded."""
        if self.altered or self.scene.table or self.stride is not None or not on_processor(self.device):
            return []
        columns = [*(np.array(self.batch.bind(name)) for name in STATE), *targets]
        return [b"".join(column[row].tobytes() for column in columns) for row in range(self.size)]

    def _remember(self, rows: dict[bytes, int]) -> None:
        """Keep where hands have ended, of sound simulations."""
        closings, unsound = self.scene.closings, self.batch.unsound
        if len(closings) + len(rows) > CLOSINGS:
            closings.clear()
        closings.update({key: {name: np.array(self.batch.bind(name)[row]) for name in STATE}
                         for key, row in rows.items() if not unsound[row]})

    def press(self, targets: Float[np.ndarray, "n n_servos"], seconds: float) -> ObjectState:
        """Move on to other targets for a time [s]."""
        self.ctrl[:] = targets
        self._advance(np.arange(self.size), self._steps(seconds))
        return self.observe()

    def load(
        self, targets: Float[np.ndarray, "n n_servos"], force: Float[np.ndarray, "n 3"], seconds: float
    ) -> ObjectState:
        """Press towards targets under a force on each object [N], in the frame that it had at the start, for a time [s]."""
        self.force[:, self.scene.object_body, :3] = np.einsum("nij,nj->ni", self.start.rotation, force)
        return self.press(targets, seconds)

    def moment(self) -> Moment:
        """What it takes to go on from here later; see `go_back`."""
        return {name: np.array(self.batch.bind(name)) for name in STATE}

    def go_back(self, moment: Moment) -> None:
        """Return all trials to an earlier moment, without forces."""
        self.force[:] = 0
        for name, values in moment.items():
            self.batch.bind(name)[:] = values

    def pull(
        self, rows: Int[np.ndarray, " k"], force: Float[np.ndarray, "k 3"], seconds: float, begin: Moment | None = None
    ) -> ObjectState:
        """Let a force on each object, as of `load`, act in some of the trials for a time [s], from a moment if one is given."""
        for name, values in (begin or {}).items():
            self.batch.bind(name)[rows] = values[rows]
        self.force[rows, self.scene.object_body, :3] = np.einsum("nij,nj->ni", self.start.rotation[rows], force)
        self._advance(rows, self._steps(seconds))
        return self.observe(rows)

    def pulled(
        self, rows: Int[np.ndarray, " k"], force: Float[np.ndarray, "k 3"], seconds: float, begin: Moment
    ) -> tuple[ObjectState, Moment]:
        """What a force on each object, as of `load`, would do to some of the trials in a time [s], and the moment after it.

        The trials stay as they are, so a row may come several times. The moment before is of the same rows.
        """
        forces = self.force[rows]
        forces[:, self.scene.object_body, :3] = np.einsum("nij,nj->ni", self.start.rotation[rows], force)
        with quiet():
            after, sound = self.batch.ahead(rows, {**begin, "xfrc_applied": forces}, self._steps(seconds))
        return self._state(after["qpos"], sound), after

    def make_heavy(self, mass: Float[np.ndarray, " n"]) -> None:
        """Give each object another mass [kg], and inertia in proportion; go back to a moment afterwards."""
        factor, self.altered = mass / self.mass, True
        self.batch.expand("body_mass")[:, self.scene.object_body] *= factor
        self.batch.expand("body_inertia")[:, self.scene.object_body] *= factor[:, None]
        self.batch.set_const()
        self.mass = mass.copy()

    def push(
        self, closed: ObjectState, alive: Bool[np.ndarray, " n"], pulls: Pulls | None = None
    ) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6"], Bool[np.ndarray, " n"]]:
        """Apply all forces in turn to the trials that are alive; a lost object is left alone. Forces are the protocol's.

        Displacement [m] and rotation [rad] after each force, NaN where none was applied; whether the simulation stayed sound.
        """
        displacement, rotation = np.full((self.size, 6), np.nan), np.full((self.size, 6), np.nan)
        stable, alive = closed.stable.copy(), alive & closed.stable
        rules = self.scene.protocol
        pulls = pulls or Pulls(rules.force, rules.force_time, rules.reset, from_start=rules.reset)
        origin = self.start if pulls.from_start else closed
        state = self.moment() if pulls.reset else {}
        ahead = self._pushed(np.flatnonzero(alive), pulls, state) if pulls.reset and self.spreads else None
        for k, axis in enumerate(FORCES):
            rows = np.flatnonzero(alive)
            if not len(rows):
                break
            if ahead is not None:
                now = ahead.rows(k * self.size + rows)
            else:
                for name, values in state.items():
                    self.batch.bind(name)[rows] = values[rows]
                self._set_force(axis, pulls.acceleration, rows)
                self._advance(rows, self._steps(pulls.seconds))
                now = self.observe(rows)
            # Later columns keep these values unless the trial goes on.
            displacement[rows, k:] = now.shift(origin.rows(rows))[:, None]
            rotation[rows, k:] = now.turn(origin.rows(rows))[:, None]
            stable[rows] = now.stable
            alive[rows] = now.stable & (displacement[rows, k] < pulls.farthest) & (rotation[rows, k] < pulls.largest_turn)
        return displacement, rotation, stable

    @property
    def spreads(self) -> bool:
        """Whether all directions of a pull are tried at once: a device takes as long for many trials as for few.

        On the processor they follow each other, and what fails is pulled no more, unless there are fewer trials than threads.
        """
        return self.stride is None and (not on_processor(self.device) or self.size < self.workers)

    def _pushed(self, rows: Int[np.ndarray, " k"], pulls: Pulls, begin: Moment) -> ObjectState:
        """What each force does to some of the trials, from one moment on; it has as many rows for each as there are trials."""
        everyone, many = np.tile(np.arange(self.size), len(FORCES)), np.tile(rows, len(FORCES))
        newtons = pulls.acceleration * self.mass[many, None] * FORCES.repeat(len(rows), 0)
        found, _ = self.pulled(many, newtons, pulls.seconds, {name: values[many] for name, values in begin.items()})
        whole = self.observe(everyone)
        place = (np.arange(len(FORCES))[:, None] * self.size + rows).ravel()
        for name in ("position", "rotation", "stable"):
            getattr(whole, name)[place] = getattr(found, name)
        return whole

    def observe(self, rows: Int[np.ndarray, " k"] | None = None) -> ObjectState:
        """The object now, in some of the trials or in all."""
        rows = np.arange(self.size) if rows is None else rows
        return self._state(self.qpos[rows], ~self.batch.unsound[rows])

    def _state(self, qpos: Float[np.ndarray, "k nq"], sound: Bool[np.ndarray, " k"]) -> ObjectState:
        pose = qpos[:, self.scene.object_qpos]
        return ObjectState(pose[:, :3].copy(), _matrices(pose[:, 3:]), sound & np.isfinite(qpos).all(1))

    def poses(self) -> tuple[Float[np.ndarray, "n n_dof"], Float[np.ndarray, "n 4 4"]]:
        """Independent joints [rad or m] and object poses in the wrist frame [m] now."""
        tree = self.scene.hand.tree
        joints = np.tile(self.scene.hand.rest.numpy().astype(float), (self.size, 1))
        for address, moving in zip(*self.scene.hand_qpos, strict=True):
            if (name := tree.moving_names[moving]) in tree.joint_names:
                joints[:, tree.joint_names.index(name)] = self.qpos[:, address]
        pose = self.qpos[:, self.scene.object_qpos]
        poses = np.tile(np.eye(4), (self.size, 1, 1))
        rotation = _matrices(pose[:, 3:])
        from_centre = self._of_object(lambda scene, rows: rotation[rows] @ scene.obj.centre_of_mass)
        poses[:, :3, :3], poses[:, :3, 3] = rotation, pose[:, :3] - from_centre
        return joints, poses

    def _lay(self, obj: ObjectModel, grasps: GraspBatch, begin: int) -> None:
        """Put each table where an object lies on it, and its weight on the table, in the trials from one on."""
        # An object that stands elsewhere than the hand expects takes the table along.
        found = table_planes(grasps)
        if found is None:
            return
        planes, T = found.double().numpy(), grasps.T_object_wrist.double().numpy()
        laid = np.flatnonzero(np.isfinite(planes).all(1))
        up, level, rotation = planes[laid, :3], planes[laid, 3], T[laid, :3, :3]
        lowest = lowest_points(obj, up)
        height = np.minimum(level, lowest) - np.einsum("ni,ni->n", up, T[laid, :3, 3])
        normal = np.einsum("nij,ni->nj", rotation, up)
        turned = np.zeros((len(laid), 4))
        for quaternion, direction in zip(turned, normal, strict=True):
            mujoco.mju_quatZ2Vec(quaternion, direction)
        rests = (lowest - level < RESTS) & stands(obj, up)
        laid = laid + begin
        self.batch.bind("mocap_pos")[laid, 0] = height[:, None] * normal
        self.batch.bind("mocap_quat")[laid, 0] = turned
        weight = GRAVITY * self.mass[laid] * rests
        self.force[laid, self.scene.object_body, :3] = -weight[:, None] * normal

    def _change(self, conditions: Conditions) -> None:
        """Give each trial its own friction, mass and servos; the scene is compiled once for all."""
        self.mass *= conditions.mass
        self.batch.expand("geom_friction")[:] *= conditions.friction[:, None, None]
        for name in ("actuator_gainprm", "actuator_biasprm"):
            self.batch.expand(name)[:] *= conditions.gain[:, None, None]
        self.batch.expand("body_mass")[:, self.scene.object_body] *= conditions.mass
        self.batch.expand("body_inertia")[:, self.scene.object_body] *= conditions.mass[:, None]
        self.batch.set_const()

    def _steps(self, seconds: float) -> int:
        return round(seconds / self.scene.protocol.timestep)

    def _set_force(self, axis: Float[np.ndarray, "3"], acceleration: float, rows: Int[np.ndarray, " k"]) -> None:
        """Apply a force per mass [m/s^2] along an axis of the object's frame, as the object was oriented at the start."""
        newtons = acceleration * self.mass[rows, None]
        self.force[rows, self.scene.object_body, :3] = newtons * (self.start.rotation[rows] @ axis)

    def _advance(self, rows: Int[np.ndarray, " k"], steps: int) -> None:
        """Let time pass in some of the trials, and record it if asked to; recording does not change the motion."""
        stride = steps if self.stride is None else self.stride
        with quiet():
            for done in range(0, steps, max(1, stride)):
                self.batch.step(rows, min(stride, steps - done))
                if self.stride is not None:
                    self.frames.append(self.poses())


def rollouts(
    scene: TrialScene, hand: Hand, grasps: GraspBatch, workers: int | None, stride: int | None = None, device: str = "cpu"
) -> Iterator[tuple[GraspBatch, Rollout]]:
    """The grasps in parts that are simulated together, with pregrasp and squeeze; each part's rollout at its start."""
    yield from rollouts_of_all([scene], hand, [grasps], workers, stride, device)


def rollouts_of_all(
    scenes: Sequence[TrialScene], hand: Hand, batches: Sequence[GraspBatch], workers: int | None, stride: int | None = None,
    device: str = "cpu",
) -> Iterator[tuple[GraspBatch, Rollout]]:
    """The same for several objects of a hand, in their order; on a device, those that join are simulated together."""
    for numbers in _groups(scenes, [len(grasps) for grasps in batches], device):
        count = sum(len(batches[i]) for i in numbers)
        where = "cpu" if count < FEW and device != WARP else device
        if on_processor(where):
            for i in numbers:
                for part in batches[i].in_parts(CHUNK):
                    part = _ready(scenes[i], hand, part)
                    yield part, Rollout(scenes[i], part, workers or cores(), stride, device=where)
            continue
        own = [_ready(scenes[i], hand, batches[i]) for i in numbers]
        of = np.repeat(numbers, [len(grasps) for grasps in own])
        whole = own[0] if len(own) == 1 else GraspBatch.concatenate(own)
        for begin in range(0, count, DEVICE_CHUNK):
            rows = slice(begin, begin + DEVICE_CHUNK)
            shares = [Share(scenes[i], len(list(same))) for i, same in groupby(of[rows].tolist())]
            yield whole[rows], Rollout(shares[0].scene, whole[rows], workers or cores(), stride, device=where, shares=shares)


def _groups(scenes: Sequence[TrialScene], counts: Sequence[int], device: str) -> list[list[int]]:
    """Numbers of scenes that are simulated together, without those that have no grasps."""
    groups: list[list[int]] = []
    for i in np.flatnonzero(counts).tolist():
        if groups and not on_processor(device) and joins(scenes[groups[-1][-1]], scenes[i]):
            groups[-1].append(i)
        else:
            groups.append([i])
    return groups


def _ready(scene: TrialScene, hand: Hand, grasps: GraspBatch) -> GraspBatch:
    """The grasps with pregrasp and squeeze, if the hand closes."""
    if not scene.protocol.closing:
        return grasps
    return complete(hand, grasps, torch.as_tensor(scene.obj.centre_of_mass), scene.protocol.controller)


def _matrices(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices of unit quaternions WXYZ."""
    w, x, y, z = quaternions.T
    # The sums are in the order of MuJoCo's mju_quat2Mat. roma rounds otherwise, and the last bit can decide a trial.
    rows = [
        [(w * w - y * y) + (x * x - z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), (w * w + y * y) - (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), (w * w - y * y) + (z * z - x * x)],
    ]
    return np.array(rows).transpose(2, 0, 1).copy()
