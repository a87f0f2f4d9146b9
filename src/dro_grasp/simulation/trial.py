"""Run a protocol over grasps: close the hand, push the object six ways, see whether it stays.

Source: paper, evaluation metric details; FACTS on contact settings are in `protocols`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import mujoco.batch
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.contacts import Penetration, measure_penetration, touching_links
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.protocols import protocol as find_protocol
from dro_grasp.simulation.scene import Scene, build_scene, cores

DIRECTIONS = ("+x", "+y", "+z", "-x", "-y", "-z")
"""Order of the forces, in the object's frame."""
GIVE_UP = 0.1
"""An object this far from where the hand had it will not come back [m]."""
CHUNK = 64
"""Grasps simulated together."""


@dataclass(frozen=True)
class TrialResult:
    """What became of n grasps."""

    success: Bool[Tensor, " n"]
    displacement: Float[Tensor, "n 6"]
    """Of the object's centre of mass after each force, from where it was after closing [m]."""
    rotation: Float[Tensor, "n 6"]
    """Of the object after each force, from how it was after closing [rad]."""
    closing_shift: Float[Tensor, " n"]
    """Displacement of the object while the hand closed [m]."""
    closing_rotation: Float[Tensor, " n"]
    """Rotation of the object while the hand closed [rad]."""
    contacts: Int[Tensor, " n"]
    """Hand links that touch the object after closing."""
    penetration: Float[Tensor, " n"]
    """Deepest penetration of hand and object in the grasp as labelled [m]."""
    self_penetration: Float[Tensor, " n"]
    """Summed penetration of hand links in the grasp as labelled [m]."""
    reason: tuple[str, ...]
    """Why a grasp failed; empty for a success."""
    protocol: str
    """Name and version."""

    @property
    def success_rate(self) -> float:
        """Share of successes."""
        return float(self.success.float().mean())


@dataclass(frozen=True)
class _State:
    """The object in some grasps: positions of the centre of mass (n 3), rotations (n 3 3), and stability (n)."""

    position: np.ndarray
    rotation: np.ndarray
    stable: np.ndarray


def simulate(
    hand: Hand,
    obj: ObjectModel,
    grasps: GraspBatch,
    protocol: str | Protocol = "dro",
    *,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TrialResult:
    """Try grasps of one object in MuJoCo.

    Args:
        hand: The hand of the grasps.
        obj: Their object; it needs a mesh.
        grasps: Poses, and pregrasp and squeeze joints where they are not to be made by the controller.
        protocol: `dro`, `strict`, `dro_static`, or a Protocol of your own.
        workers: Threads; all cores by default. The result does not depend on it.
        progress: Called with (grasps tried, grasps in all).

    Raises:
        ObjectError: The object is a bare point cloud.
        OptionError: The grasps are of another hand, or the protocol does not exist.
    """
    rules = find_protocol(protocol)
    if tuple(grasps.joint_names) != tuple(hand.tree.joint_names):
        raise OptionError(f"these grasps are of hand '{grasps.hand}' with {len(grasps.joint_names)} joints; hand "
                          f"'{hand.name}' has {hand.tree.n_dof}. Load the hand that the grasps name")
    scene = _scene(hand, obj, rules)
    results = []
    for start in range(0, len(grasps), CHUNK):
        results.append(_try(scene, grasps[slice(start, start + CHUNK)], workers or cores()))
        if progress is not None:
            progress(min(start + CHUNK, len(grasps)), len(grasps))
    return _join(results, rules)


@dataclass(frozen=True)
class _Closed:
    """A chunk of grasps after closing, its simulation ready to go on."""

    batch: mujoco.batch.Batch
    views: dict[str, np.ndarray]
    before: _State
    after: _State


def _close(scene: Scene, grasps: GraspBatch, workers: int) -> _Closed:
    """Start at the pregrasp and close towards the squeeze for the protocol's closing time."""
    n = len(grasps)
    start, target = _joint_targets(scene, grasps)
    batch = mujoco.batch.Batch(scene.model, nsim=n, nthread=min(workers, n))
    views = _bind(scene, batch)
    views["qpos"][:] = scene.qpos(grasps.T_object_wrist, start)
    views["ctrl"][:] = target.numpy()[:, scene.actuated]
    before = _observe(scene, batch, views, np.arange(n))
    batch.step(nstep=round(scene.protocol.closing_time / scene.protocol.timestep))
    return _Closed(batch, views, before, _observe(scene, batch, views, np.arange(n)))


def _try(scene: Scene, grasps: GraspBatch, workers: int) -> TrialResult:
    """One chunk of grasps through the whole protocol."""
    rules = scene.protocol
    penetration = measure_penetration(scene, grasps)
    run = _close(scene, grasps, workers)
    contacts = touching_links(scene, run.views["qpos"])
    shift = np.linalg.norm(run.after.position - run.before.position, axis=1)
    turn = _angle(run.before.rotation, run.after.rotation)
    alive = run.after.stable & (contacts > 0) & (shift < GIVE_UP)
    hopeless = _hopeless(rules, shift, turn, penetration)
    displacement, rotation, stable = _push(scene, run.batch, run.views, run.before.rotation, run.after, alive & ~hopeless)
    stable &= run.after.stable
    return _judge(scene, penetration, shift, turn, contacts, stable, displacement, rotation)


def _joint_targets(scene: Scene, grasps: GraspBatch) -> tuple[Tensor, Tensor]:
    """Joints at the start and joints aimed at, (n n_dof) each."""
    if not scene.protocol.closing:
        return grasps.joints, grasps.joints
    pregrasp, squeeze = grasps.pregrasp_joints, grasps.squeeze_joints
    if pregrasp is None or squeeze is None:
        centre = torch.as_tensor(scene.obj.centre_of_mass, dtype=grasps.joints.dtype)
        made = pregrasp_and_squeeze(scene.hand, grasps.T_object_wrist, grasps.joints, centre)
        pregrasp = made[0] if pregrasp is None else pregrasp
        squeeze = made[1] if squeeze is None else squeeze
    return pregrasp, squeeze


def _bind(scene: Scene, batch: mujoco.batch.Batch) -> dict[str, np.ndarray]:
    """Live views of what is written and read; derived fields must be bound before the first step."""
    return {name: batch.bind(name) for name in ("qpos", "ctrl", "xfrc_applied")}


def _observe(scene: Scene, batch: mujoco.batch.Batch, views: dict[str, np.ndarray], rows: np.ndarray) -> _State:
    """Where the object is, from its free joint."""
    pose = views["qpos"][rows][:, scene.object_qpos]
    rotation = _matrices(pose[:, 3:])
    position = pose[:, :3] + rotation @ scene.obj.centre_of_mass
    unstable = batch.warning[rows][:, :, 1].any(1) | ~np.isfinite(pose).all(1)
    return _State(position, rotation, ~unstable)


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (n 3 3) of quaternions WXYZ (n 4)."""
    matrices = np.zeros((len(quaternions), 9))
    for quaternion, matrix in zip(quaternions, matrices, strict=True):
        mujoco.mju_quat2Mat(matrix, quaternion)
    return matrices.reshape(-1, 3, 3)


def _angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle between rotations (n 3 3) [rad]."""
    relative = np.einsum("nij,nik->njk", first, second)
    skew = relative - relative.transpose(0, 2, 1)
    sine = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1), axis=1)
    return np.arctan2(sine, np.trace(relative, axis1=1, axis2=2) - 1)


def _closed_pose(scene: Scene, views: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Independent joints (n n_dof) and object poses (n 4 4) in the wrist frame now."""
    qpos = views["qpos"]
    tree = scene.hand.tree
    addresses, moving = scene.hand_qpos
    joints = np.tile(scene.hand.rest.numpy(), (len(qpos), 1))
    for address, index in zip(addresses, moving, strict=True):
        name = tree.moving_names[index]
        if name in tree.joint_names:
            joints[:, tree.joint_names.index(name)] = qpos[:, address]
    poses = np.tile(np.eye(4), (len(qpos), 1, 1))
    poses[:, :3, :3] = _matrices(qpos[:, scene.object_qpos][:, 3:])
    poses[:, :3, 3] = qpos[:, scene.object_qpos][:, :3]
    return joints, poses


def _hopeless(rules: Protocol, shift: np.ndarray, turn: np.ndarray, penetration: Penetration) -> np.ndarray:
    """Grasps that the protocol fails whatever the forces do; they need no forces."""
    return ((shift > rules.max_closing_shift) | (turn > rules.max_closing_rotation)
            | (penetration.object > rules.max_penetration) | (penetration.own > rules.max_self_penetration))


def _push(
    scene: Scene, batch: mujoco.batch.Batch, views: dict[str, np.ndarray], frame: np.ndarray, closed: _State,
    alive: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force along each axis of the object's frame in turn, without reset.

    Returns:
        Displacement (n 6) [m] and rotation (n 6) [rad] after each force, infinite from where a grasp was given up;
        stability (n).
    """
    n, rules = len(alive), scene.protocol
    displacement, rotation = np.full((n, 6), np.inf), np.full((n, 6), np.inf)
    stable = np.ones(n, bool)
    steps = round(rules.force_time / rules.timestep)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    alive = alive.copy()
    for k, axis in enumerate(axes):
        rows = np.flatnonzero(alive)
        if not len(rows):
            break
        views["xfrc_applied"][rows, scene.object_body, :3] = rules.force * scene.obj.mass * (frame[rows] @ axis)
        batch.step(rows.tolist(), nstep=steps)
        now = _observe(scene, batch, views, rows)
        displacement[rows, k] = np.linalg.norm(now.position - closed.position[rows], axis=1)
        rotation[rows, k] = _angle(closed.rotation[rows], now.rotation)
        stable[rows] = now.stable
        alive[rows] = now.stable & (displacement[rows, k] < GIVE_UP)
    return displacement, rotation, stable


def _judge(
    scene: Scene, penetration: Penetration, shift: np.ndarray, turn: np.ndarray, contacts: np.ndarray,
    stable: np.ndarray, displacement: np.ndarray, rotation: np.ndarray,
) -> TrialResult:
    """Success and the first reason against it."""
    rules = scene.protocol
    reasons = []
    for i in range(len(shift)):
        lost = np.flatnonzero(~(displacement[i] < GIVE_UP))
        if not stable[i]:
            reasons.append("simulation unstable")
        elif penetration.object[i] > rules.max_penetration:
            reasons.append(f"hand penetrates object by {penetration.object[i] * 1e3:.0f} mm")
        elif penetration.own[i] > rules.max_self_penetration:
            reasons.append(f"hand penetrates itself by {penetration.own[i] * 1e3:.0f} mm")
        elif contacts[i] == 0 or shift[i] >= GIVE_UP:
            reasons.append("no contact after closing")
        elif shift[i] > rules.max_closing_shift or turn[i] > rules.max_closing_rotation:
            reasons.append("object pushed away while closing")
        elif len(lost):
            reasons.append(f"lost under force {DIRECTIONS[lost[0]]}")
        elif displacement[i, -1] >= rules.max_displacement:
            reasons.append(f"slipped by {displacement[i, -1] * 1e3:.0f} mm")
        else:
            reasons.append("")
    tensor = lambda a: torch.from_numpy(np.asarray(a, np.float32))  # noqa: E731
    return TrialResult(
        success=torch.tensor([not r for r in reasons]), displacement=tensor(displacement), rotation=tensor(rotation),
        closing_shift=tensor(shift), closing_rotation=tensor(turn), contacts=torch.from_numpy(contacts.astype(np.int64)),
        penetration=tensor(penetration.object), self_penetration=tensor(penetration.own), reason=tuple(reasons),
        protocol=rules.label,
    )


def _join(results: list[TrialResult], rules: Protocol) -> TrialResult:
    if not results:
        empty = torch.zeros
        return TrialResult(empty(0, dtype=torch.bool), empty(0, 6), empty(0, 6), empty(0), empty(0),
                           empty(0, dtype=torch.int64), empty(0), empty(0), (), rules.label)
    joined = {}
    for name in TrialResult.__dataclass_fields__:
        values = [getattr(r, name) for r in results]
        if name == "protocol":
            joined[name] = rules.label
        elif name == "reason":
            joined[name] = tuple(x for v in values for x in v)
        else:
            joined[name] = torch.cat(values)
    return TrialResult(**joined)


def settle(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = "dro", *, workers: int | None = None
) -> GraspBatch:
    """The same grasps relabelled with where hand and object are after closing.

    The joints are those reached, held back by the contact, so that a label touches the surface instead of guessing.
    """
    scene = _scene(hand, obj, find_protocol(protocol))
    joints, poses = [], []
    for start in range(0, len(grasps), CHUNK):
        run = _close(scene, grasps[slice(start, start + CHUNK)], workers or cores())
        q, T = _closed_pose(scene, run.views)
        joints.append(torch.from_numpy(q))
        poses.append(torch.from_numpy(T))
    reached = torch.cat(joints).float().nan_to_num().clamp(hand.tree.lower, hand.tree.upper)
    T_object_wrist = torch.linalg.inv(torch.cat(poses).nan_to_num()).float()
    return grasps.replace(T_object_wrist=T_object_wrist, joints=reached, pregrasp_joints=None, squeeze_joints=None)


def record(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, index: int, protocol: str | Protocol = "dro", stride: int = 10
) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames n_dof"]]:
    """Object poses in the wrist frame, and joints, every `stride` steps of one grasp's trial."""
    rules = find_protocol(protocol)
    scene = _scene(hand, obj, rules)
    chosen = grasps[index]
    start, target = _joint_targets(scene, chosen)
    batch = mujoco.batch.Batch(scene.model, nsim=1, nthread=1)
    views = _bind(scene, batch)
    views["qpos"][:] = scene.qpos(chosen.T_object_wrist, start)
    views["ctrl"][:] = target.numpy()[:, scene.actuated]
    frame = _observe(scene, batch, views, np.arange(1)).rotation
    frames = []
    axes = [np.zeros(3), *np.concatenate([np.eye(3), -np.eye(3)])]
    for axis, seconds in zip(axes, [rules.closing_time, *[rules.force_time] * 6], strict=True):
        views["xfrc_applied"][:, scene.object_body, :3] = rules.force * scene.obj.mass * (frame @ axis)
        for _ in range(math.ceil(seconds / rules.timestep / stride)):
            frames.append(_closed_pose(scene, views))
            batch.step(nstep=stride)
    joints = torch.from_numpy(np.concatenate([j for j, _ in frames]).astype(np.float32))
    return torch.from_numpy(np.concatenate([p for _, p in frames]).astype(np.float32)), joints


_SCENES: dict[tuple[str, str, int, Protocol], Scene] = {}
_MOST_SCENES = 8


def _scene(hand: Hand, obj: ObjectModel, rules: Protocol) -> Scene:
    """The scene of a pair, kept while the same few pairs are tried again and again."""
    key = (hand.sha256, obj.sha256, len(obj.parts), rules)
    if key not in _SCENES:
        while len(_SCENES) >= _MOST_SCENES:
            _SCENES.pop(next(iter(_SCENES)))
        _SCENES[key] = build_scene(hand, obj, rules)
    return _SCENES[key]
