"""Close hands on their object, without the forces of a trial."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.contacts import contact_mask, find_contact_links
from dro_grasp.simulation.outcome import LOST_DISTANCE
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol
from dro_grasp.simulation.rollout import Rollout, rollouts
from dro_grasp.simulation.scene import scene_of


def settle(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL, *, workers: int | None = None
) -> GraspBatch:
    """The same grasps, relabelled with the poses of hand and object after closing.

    A joint above a link that touches the object takes the value it reached, held back by the contact, so that the
    label touches the surface. The other joints keep their values: closing would only drive them towards a fist. A
    grasp whose simulation is unstable keeps its label. Energies and depth stay those before settling; scores and
    outcomes are dropped. Errors are those of `simulate`.
    """
    scene = scene_of(hand, obj, grasps, protocol)
    joints, poses = [grasps.joints[:0]], [grasps.T_object_wrist[:0]]
    for part, rollout in rollouts(scene, hand, grasps, workers):
        reached, T_object_wrist = _reached(part, rollout, hand, torch.from_numpy(rollout.close().stable))
        touching = contact_mask(hand, find_contact_links(scene, rollout.qpos))
        moves_contact = touching.float() @ hand.tree.moves.float() > 0  # joints that move a contact link
        joints.append(torch.where(moves_contact, reached, part.joints))
        poses.append(T_object_wrist)
    unsettled = grasps.without("pregrasp_joints", "squeeze_joints", "score").without_trial()
    return unsettled.replace(T_object_wrist=torch.cat(poses), joints=torch.cat(joints))


def hand_shift(hand: Hand, before: GraspBatch, after: GraspBatch) -> Float[Tensor, " n"]:
    """How far each hand moved relative to the object, at its grasp centre [m]."""
    return (hand.grasp_centres(after.T_object_wrist) - hand.grasp_centres(before.T_object_wrist)).norm(dim=-1)


def after_closing(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL, *, workers: int | None = None
) -> GraspBatch:
    """The same grasps, outcomes included, in the poses of hand and object after closing, from where a trial goes on.

    A grasp whose simulation is unstable, or that pushes the object farther than LOST_DISTANCE, stays as it is. Errors are
    those of `simulate`.
    """
    scene, parts = scene_of(hand, obj, grasps, protocol), [(grasps.joints[:0], grasps.T_object_wrist[:0])]
    for part, rollout in rollouts(scene, hand, grasps, workers):
        closed = rollout.close()
        sound = torch.from_numpy(closed.stable & (closed.shift(rollout.start) < LOST_DISTANCE))
        parts.append(_reached(part, rollout, hand, sound))
    joints, poses = (torch.cat(column) for column in zip(*parts, strict=True))
    return grasps.replace(joints=joints, T_object_wrist=poses)


def _reached(
    part: GraspBatch, rollout: Rollout, hand: Hand, sound: Bool[Tensor, " n"]
) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, "n 4 4"]]:
    """Joints and wrist poses relative to the object as a rollout has them now; those of the grasp where it is not sound."""
    q, T = (torch.from_numpy(x) for x in rollout.poses())
    q = q.to(part.joints.dtype).clamp(hand.tree.lower, hand.tree.upper)
    T_object_wrist = torch.linalg.inv(torch.where(sound[:, None, None], T, torch.eye(4, dtype=T.dtype))).to(q.dtype)
    return torch.where(sound[:, None], q, part.joints), torch.where(sound[:, None, None], T_object_wrist, part.T_object_wrist)
