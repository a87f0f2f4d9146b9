"""The moving part of a trial: close the hand on the object, then push the object, under the conditions of one trial."""

from __future__ import annotations

import hashlib
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import Rows, cores
from dro_grasp.geometry import se3
from dro_grasp.geometry.se3 import roma
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import table_planes
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.outcome import FORCES, LOST_DISTANCE
from dro_grasp.simulation.protocols import Perturbations
from dro_grasp.simulation.scene import TABLE_AWAY, TrialScene, object_mass
from dro_grasp.simulation.worlds import STATE, WARP, on_processor, worlds

FACTORS = ("friction", "mass", "gain")  # Conditions that are factors, as in Perturbations

Moment = dict[str, Float[np.ndarray, "n _"]]  # What it takes to go on from a moment, in each of n trials

RESOLUTION = 1e-4  # Grasps that agree to this have the same draws [m or rad]. Ours: another machine rounds otherwise


@dataclass(frozen=True)
class Conditions(Rows):
    """What differs from the protocol in n trials; the factors are those of Perturbations."""

    shift: Float[np.ndarray, "n 3"]  # displacement of the object, in its own frame [m]
    turn: Float[np.ndarray, "n 3"]  # rotation vector of the object about its centre of mass, in its own frame [rad]
    friction: Float[np.ndarray, " n"]
    mass: Float[np.ndarray, " n"]
    gain: Float[np.ndarray, " n"]

    def displaced(self, grasps: GraspBatch, centre_of_mass: Float[np.ndarray, "3"]) -> GraspBatch:
        """The grasps with each object moved away from where it is expected; the hand does not know."""
        centre = torch.from_numpy(centre_of_mass)
        rotation = roma.rotvec_to_rotmat(torch.from_numpy(self.turn))
        T = se3.compose(rotation, centre + torch.from_numpy(self.shift) - rotation @ centre)
        moved = se3.invert(T) @ grasps.T_object_wrist.double()
        return grasps.replace(T_object_wrist=moved.to(grasps.T_object_wrist.dtype))


def draw(config: Perturbations, grasps: GraspBatch) -> Conditions:
    """Conditions of all trials but the first: the second trial of every grasp, then the third, and so on."""
    # A grasp's position and joints are the seed of its draws, so they depend neither on its company nor on a file between.
    k = config.trials - 1
    drawn = [_draw(config, k, _generator(p, q)) for p, q in zip(grasps.T_object_wrist[:, :3, 3], grasps.joints, strict=True)]
    columns = {name: np.stack([d[name] for d in drawn], 1) for name in ("shift", "turn", *FACTORS)}
    return Conditions(**{name: column.reshape(-1, *column.shape[2:]) for name, column in columns.items()})


def _generator(position: Float[Tensor, "3"], joints: Float[Tensor, " n_dof"]) -> np.random.Generator:
    content = (torch.cat([position, joints]).double() / RESOLUTION).round().long().numpy().tobytes()
    return np.random.default_rng(int.from_bytes(hashlib.sha256(content).digest()[:16], "big"))


def _draw(config: Perturbations, k: int, generator: np.random.Generator) -> dict[str, Float[np.ndarray, "k *_"]]:
    """Conditions of k trials of one grasp; each factor takes one value from each of k equal parts of its range."""
    drawn = {}
    for name, size in (("shift", config.shift), ("turn", config.turn)):
        direction = generator.normal(size=(k, 3))
        drawn[name] = size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    for name in FACTORS:
        low, high = getattr(config, name)
        share = (generator.permutation(k) + generator.random(k)) / k
        drawn[name] = low * (high / low) ** share
    return drawn


RAMP = 10  # Number of stages in which a gradual protocol moves the servos' targets from one posture to the next. Ours
CHUNK = 64  # Grasps simulated together. Ours: bounds memory; the result does not depend on it
DEVICE_CHUNK = 4096  # The same on a device. Ours: a step takes 1.6 ms for 1,024 worlds and 2.0 for 2,048 on an H100
FEW = 64  # Fewer grasps run on the processor, which is done before a device has begun (ours)
GRAVITY = 9.81  # What presses an object on a table while the hand closes [m/s^2]
CLOSINGS = 1024
"""Closings that a scene keeps (ours), each of some hundred bytes: grasps repeat theirs as they are weighed and tried."""
RESTS = 0.003  # Gap up to which an object counts as lying on a table [m]. Ours


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
        conditions: Conditions | None = None, device: str = "cpu",
    ) -> None:
        """Place hands and objects.

        Grasps, one at least, state pregrasp and squeeze if the protocol closes the hand. A frame is recorded every `stride`
        time steps, none by default; `workers` are threads, and `conditions` differ from the protocol. The device is as of
        `worlds`.
        """
        rules = scene.protocol
        start, target = grasps.joints, grasps.joints
        if rules.closing:
            start, target = grasps.pregrasp_joints, grasps.squeeze_joints
        self.scene, self.stride = scene, stride
        self.size = len(grasps)
        self.mass = np.full(self.size, object_mass(scene.obj, rules))
        if conditions is not None:
            grasps = conditions.displaced(grasps, scene.obj.centre_of_mass)
        self.device, self.altered = device, conditions is not None
        self.batch = worlds(scene, self.size, workers, device)
        if conditions is not None:
            self._change(conditions)
        self.qpos, self.ctrl, self.force = (self.batch.bind(n) for n in ("qpos", "ctrl", "xfrc_applied"))
        self.qpos[:] = scene.qpos(grasps.T_object_wrist, start)
        postures = [start, grasps.joints, target] if rules.gradual else [target]
        self.targets = [joints.numpy()[:, scene.actuated] for joints in postures]
        self.ctrl[:] = self.targets[0]
        self.start = self.observe()
        if scene.table:
            self._lay(grasps)
        self.frames = [] if stride is None else [self.poses()]

    @property
    def place(self) -> torch.device:
        """Where tensors are that belong to many grasps."""
        return torch.device("cpu" if self.device == WARP or on_processor(self.device) else self.device)

    def close(self) -> ObjectState:
        """Move to the target for the protocol's closing time; a table is there until then, and gone afterwards.

        What has closed in the same way before, in this scene, is not simulated again.
        """
        begun, steps = self._beginnings(), self._steps(self.scene.protocol.closing_time)
        before = [self.scene.closings.get(key) for key in begun] if begun else [None] * self.size
        rows = np.flatnonzero([moment is None for moment in before])
        if len(self.targets) == 1:
            self._advance(rows, steps)
        for begin, end in pairwise(self.targets):
            for i in range(RAMP):
                self.ctrl[:] = begin + (i + 1) / RAMP * (end - begin)
                self._advance(rows, steps // (RAMP * (len(self.targets) - 1)))
        for name in STATE:
            for row, moment in enumerate(before):
                if moment is not None:
                    self.batch.bind(name)[row] = moment[name]
        if begun:
            self._remember({begun[row]: row for row in rows.tolist()})
        if self.scene.table:
            self.batch.bind("mocap_pos")[:] = TABLE_AWAY
            self.batch.bind("mocap_quat")[:] = [1.0, 0.0, 0.0, 0.0]  # as it is turned now, it may lie over the hand
            self.force[:] = 0.0
        return self.observe()

    def _beginnings(self) -> list[bytes]:
        """What decides where each hand ends as it closes; nothing where more than that decides, or frames are recorded."""
        if self.altered or self.scene.table or self.stride is not None or not on_processor(self.device):
            return []
        columns = [*(np.array(self.batch.bind(name)) for name in STATE), *self.targets]
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
        state = {name: np.array(self.batch.bind(name)) for name in STATE} if pulls.reset else {}
        for k, axis in enumerate(FORCES):
            rows = np.flatnonzero(alive)
            if not len(rows):
                break
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

    def observe(self, rows: Int[np.ndarray, " k"] | None = None) -> ObjectState:
        """The object now, in some of the trials or in all."""
        rows = np.arange(self.size) if rows is None else rows
        pose = self.qpos[rows][:, self.scene.object_qpos]
        rotation = _matrices(pose[:, 3:])
        unstable = self.batch.unsound[rows] | ~np.isfinite(self.qpos[rows]).all(1)
        return ObjectState(pose[:, :3], rotation, ~unstable)

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
        poses[:, :3, :3], poses[:, :3, 3] = rotation, pose[:, :3] - rotation @ self.scene.obj.centre_of_mass
        return joints, poses

    def _lay(self, grasps: GraspBatch) -> None:
        """Put each table where the object lies on it, and the object's weight on the table."""
        # An object that stands elsewhere than the hand expects takes the table along.
        found = table_planes(grasps)
        if found is None:
            return
        planes, T = found.double().numpy(), grasps.T_object_wrist.double().numpy()
        laid = np.flatnonzero(np.isfinite(planes).all(1))
        up, level, rotation = planes[laid, :3], planes[laid, 3], T[laid, :3, :3]
        lowest = lowest_points(self.scene.obj, up)
        height = np.minimum(level, lowest) - np.einsum("ni,ni->n", up, T[laid, :3, 3])
        normal = np.einsum("nij,ni->nj", rotation, up)
        turned = np.zeros((len(laid), 4))
        for quaternion, direction in zip(turned, normal, strict=True):
            mujoco.mju_quatZ2Vec(quaternion, direction)
        self.batch.bind("mocap_pos")[laid, 0] = height[:, None] * normal
        self.batch.bind("mocap_quat")[laid, 0] = turned
        rests = (lowest - level < RESTS) & stands(self.scene.obj, up)
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


def lowest_points(obj: ObjectModel, up: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """How far the lowest point of an object, as it collides, is along each upward direction [m]."""
    if obj.balls is not None:
        return (up @ obj.balls.centres.double().numpy().T - obj.balls.radii.double().numpy()).min(1)
    return (up @ np.concatenate([vertices for vertices, _ in obj.parts]).T).min(1)


def stands(obj: ObjectModel, up: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether an estimated object stands on its lowest points, for each upward direction; what is known may fall over.

    A camera sees things at rest. Where the estimate of one has its lowest points to one side, that is an error of the estimate.
    """
    if obj.balls is None:
        return np.ones(len(up), bool)
    centres, radii = obj.balls.centres.double().numpy(), obj.balls.radii.double().numpy()
    heights = up @ centres.T - radii
    low = heights < heights.min(1, keepdims=True) + RESTS
    # The centre of mass is above the hull of what carries it if no half of the directions around it is empty.
    across = np.linalg.svd(up[:, None])[2][:, 1:]
    x, y = np.einsum("nsk,bk->snb", across, centres - obj.centre_of_mass)
    angles = np.where(low, np.arctan2(y, x), np.nan)
    angles = np.sort(np.where(low, angles, np.nanmax(angles, 1, keepdims=True)), 1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2 * math.pi)
    return gaps.max(1) < math.pi


def rollouts(
    scene: TrialScene, hand: Hand, grasps: GraspBatch, workers: int | None, stride: int | None = None, device: str = "cpu"
) -> Iterator[tuple[GraspBatch, Rollout]]:
    """The grasps in parts that are simulated together, with pregrasp and squeeze; each part's rollout at its start."""
    if len(grasps) < FEW and device != WARP:
        device = "cpu"
    centre = torch.as_tensor(scene.obj.centre_of_mass)
    for part in grasps.in_parts(CHUNK if on_processor(device) else DEVICE_CHUNK):
        if scene.protocol.closing:
            part = complete(hand, part, centre, scene.protocol.controller)
        yield part, Rollout(scene, part, workers or cores(), stride, device=device)


class _Quiet:
    """MuJoCo's handler of warnings, which is the process's: the first block sets it, the last that ends gives it back."""

    def __init__(self) -> None:
        self._lock, self._blocks, self._before = threading.Lock(), 0, None

    def __enter__(self) -> None:
        with self._lock:
            if self._blocks == 0:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(_ignore)
            self._blocks += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0:
                mujoco.set_mju_user_warning(self._before)


_QUIET = _Quiet()  # The only one


def quiet() -> _Quiet:
    """A block in which MuJoCo writes no warnings to the terminal or to a log in the working folder, in any thread."""
    return _QUIET


def _ignore(message: str) -> None:
    """Each trial counts its warnings; their text adds nothing."""


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
