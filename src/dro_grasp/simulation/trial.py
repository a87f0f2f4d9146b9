"""Run a protocol over grasps: close the hand, push the object six ways, see whether it stays.

Source: paper, evaluation metric details.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.contacts import measure_penetration, touching_links
from dro_grasp.simulation.outcome import DIRECTIONS, GIVE_UP, Measured, TrialResult
from dro_grasp.simulation.protocols import Protocol
from dro_grasp.simulation.protocols import protocol as find_protocol
from dro_grasp.simulation.rollout import FORCES, Rollout, quiet
from dro_grasp.simulation.scene import Scene, build_scene, cores

__all__ = ["DIRECTIONS", "TrialResult", "record", "settle", "simulate"]

CHUNK = 64
"""Grasps simulated together."""


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
        protocol: `dro`, `strict`, `dro_static`, `dexgraspbench`, or a Protocol of your own.
        workers: Threads; all cores by default. The result does not depend on it.
        progress: Called with (grasps tried, grasps in all).

    Raises:
        ObjectError: The object is a bare point cloud.
        HandError: The hand came without its description.
        OptionError: The grasps are of another hand, or the protocol does not exist.
    """
    scene = _scene(hand, obj, grasps, protocol)
    results = []
    for start in range(0, len(grasps), CHUNK):
        results.append(_try(scene, hand, grasps[slice(start, start + CHUNK)], workers or cores()))
        if progress is not None:
            progress(min(start + CHUNK, len(grasps)), len(grasps))
    return TrialResult.join(results, scene.protocol.label)


def settle(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = "dro", *, workers: int | None = None
) -> GraspBatch:
    """The same grasps relabelled with where hand and object are after closing.

    Joints below which a link touches the object take the values reached, held back by the contact, so that a label
    touches the surface instead of guessing; all others keep theirs, which the closing only drives towards a fist. A
    grasp whose simulation is unstable keeps its label.

    Raises:
        ObjectError: The object is a bare point cloud.
        OptionError: The grasps are of another hand, or the protocol does not exist.
    """
    scene = _scene(hand, obj, grasps, protocol)
    joints, poses = [grasps.joints[:0]], [grasps.T_object_wrist[:0]]
    for start in range(0, len(grasps), CHUNK):
        chunk = grasps[slice(start, start + CHUNK)]
        rollout = Rollout(scene, hand, chunk, workers or cores())
        stable = torch.from_numpy(rollout.close().stable)
        q, T = (torch.from_numpy(x) for x in rollout.poses())
        reached = q.to(grasps.joints.dtype).clamp(hand.tree.lower, hand.tree.upper)
        held = stable[:, None] & _holding_joints(hand, touching_links(scene, rollout.qpos))
        T_object_wrist = torch.linalg.inv(torch.where(stable[:, None, None], T, torch.eye(4, dtype=T.dtype)))
        joints.append(torch.where(held, reached, chunk.joints))
        poses.append(torch.where(stable[:, None, None], T_object_wrist.to(reached.dtype), chunk.T_object_wrist))
    unsettled = grasps.without("pregrasp_joints", "squeeze_joints")
    return unsettled.replace(T_object_wrist=torch.cat(poses), joints=torch.cat(joints))


def _holding_joints(hand: Hand, contact_links: Sequence[Sequence[str]]) -> Bool[Tensor, "n n_dof"]:
    """Joints that move a link which touches the object."""
    names = {name: i for i, name in enumerate(hand.tree.link_names)}
    touching = torch.zeros(len(contact_links), hand.tree.n_links)
    for row, links in zip(touching, contact_links, strict=True):
        row[[names[link] for link in links if link in names]] = 1
    moves = hand.tree.descends.float() @ (hand.tree.link_coupling != 0).float()
    return touching @ moves > 0


def record(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, index: int, protocol: str | Protocol = "dro", *, stride: int = 10
) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames n_dof"]]:
    """One grasp's trial as frames: object poses in the wrist frame [m], and joints [rad or m], every `stride` steps.

    Raises:
        ObjectError: The object is a bare point cloud.
        OptionError: The grasps are of another hand, or the protocol does not exist.
    """
    scene = _scene(hand, obj, grasps, protocol)
    rollout, only = Rollout(scene, hand, grasps[index], workers=1), np.arange(1)
    rules, frames = scene.protocol, [rollout.poses()]

    def advance(steps: int) -> None:
        for _ in range(math.ceil(steps / stride)):
            with quiet():
                rollout.batch.step(nstep=min(stride, steps))
            frames.append(rollout.poses())

    for steps in rollout.closing():
        advance(steps)
    closed = rollout.state() if rules.reset else {}
    for axis in FORCES:
        rollout.restore(closed, only)
        rollout.set_force(axis, only)
        advance(rollout.steps(rules.force_time))
    joints, poses = (torch.from_numpy(np.concatenate(part).astype(np.float32)) for part in zip(*frames, strict=True))
    return poses, joints


def _try(scene: Scene, hand: Hand, grasps: GraspBatch, workers: int) -> TrialResult:
    """Some grasps through the whole protocol."""
    rules = scene.protocol
    penetration = measure_penetration(scene, grasps)
    rollout = Rollout(scene, hand, grasps, workers)
    closed = rollout.close()
    contacts = touching_links(scene, rollout.qpos)
    shift, turn = closed.shift(rollout.start), closed.turn(rollout.start)
    # What the protocol fails whatever the forces do needs no forces.
    failed = ((shift > min(rules.max_closing_shift, GIVE_UP)) | (turn > rules.max_closing_rotation)
              | (penetration.object > rules.max_penetration) | (penetration.own > rules.max_self_penetration))
    displacement, rotation, stable = rollout.push(closed, ~failed)
    return Measured(penetration, shift, turn, contacts, stable, displacement, rotation).judged(rules)


_SCENES: dict[tuple[str, str, Protocol], Scene] = {}
_MOST_SCENES = 8


def _scene(hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol) -> Scene:
    """The scene of a pair, kept while the same few pairs are tried again and again."""
    rules = find_protocol(protocol)
    if tuple(grasps.joint_names) != tuple(hand.tree.joint_names):
        raise OptionError(f"these grasps are of hand '{grasps.hand}' with {len(grasps.joint_names)} joints; hand "
                          f"'{hand.name}' has {hand.tree.n_dof}. Load the hand that the grasps name")
    key = (hand.sha256, obj.sha256, rules)
    if key not in _SCENES:
        while len(_SCENES) >= _MOST_SCENES:
            _SCENES.pop(next(iter(_SCENES)))
        _SCENES[key] = build_scene(hand, obj, rules)
    return _SCENES[key]
