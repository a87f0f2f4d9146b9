"""Where joints come to rest when the hand closes on the object, and when nothing is there: closings in simulation."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import HOLD_COLUMNS, WEIGHT_COLUMN
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel, solid_of
from dro_grasp.simulation.payload import servo_torques
from dro_grasp.simulation.protocols import Protocol, protocol as find_protocol
from dro_grasp.simulation.rollout import Rollout, rollouts
from dro_grasp.simulation.scene import object_mass, scene_of

AWAY = 10.0  # How far the object is taken for a closing without it [m] (ours)


def expect_hold(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = "carry", *, workers: int | None = None
) -> GraspBatch:
    """The grasps with what to expect with the object in the hand, and without: HOLD_COLUMNS and WEIGHT_COLUMN.

    Each grasp closes to its squeeze twice in simulation. Gravity on the fingers is left out.

    Args:
        hand: The hand of the grasps.
        obj: Their object; balls stand for a bare cloud.
        grasps: The controller makes each pregrasp and squeeze that a grasp does not state.
        protocol: Physics of the closing.
        workers: Threads; all cores by default.

    Raises:
        HandError: The hand came without its description.
        GraspFileError: The grasps are of another hand.
        OptionError: The protocol does not exist.
    """
    obj, rules = solid_of(obj), closing_of(protocol)
    whole = complete(hand, grasps, torch.as_tensor(obj.centre_of_mass, dtype=torch.float32))
    parts = [torch.zeros(len(HOLD_COLUMNS), 0, hand.tree.n_dof)]
    for part, rollout in rollouts(scene_of(hand, obj, whole, rules), hand, whole, workers):
        alone = Rollout(rollout.scene, part, workers or 1)
        rows = [*rest(rollout, part), *rest(alone, part, empty=True), hand.tree.joint_unit.expand(len(part), -1)]
        parts.append(torch.stack([row.float() for row in rows]))
    weight = torch.full((len(whole),), GRAVITY * object_mass(obj, rules))
    return whole.replace(
        extra={**whole.extra, **dict(zip(HOLD_COLUMNS, torch.cat(parts, 1), strict=True)), WEIGHT_COLUMN: weight})


def closing_of(protocol: str | Protocol) -> Protocol:
    """A protocol that closes the hand by pregrasp, grasp and squeeze."""
    return replace(find_protocol(protocol), gradual=True, closing=True)


def rest(
    rollout: Rollout, grasps: GraspBatch, empty: bool = False
) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, "n n_dof"]]:
    """Joints [rad or m] and efforts [Nm or N] after a closing, with the object or far from it."""
    hand, rules = rollout.scene.hand, rollout.scene.protocol
    if empty:
        rollout.qpos[:, rollout.scene.object_qpos.start] += AWAY
    rollout.close()
    joints = torch.from_numpy(rollout.poses()[0])
    return joints, servo_torques(hand, joints, grasps.squeeze_joints.double(), rules)
