"""The squeeze of refined grasps: joint targets whose contact forces balance.

A hand that bends every joint by a share of its range pushes the object away where its fingers do not oppose each other. Here
the forces come first: at the contacts, within friction cones, without a net wrench on the object, shared by the fingers. The
joint torques that exert them become offsets of the servos' targets, on top of a part of the usual squeeze, which brings
everything into contact. Differs from the paper, whose controller knows only the object's centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.devices import at_once
from dro_grasp.geometry.contact_forces import friction_cone, nonnegative_least_squares
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.kinds import Checked
from dro_grasp.optimize.grasp_energy import GraspEnergy, NearestPoints


@dataclass(frozen=True)
class GripConfig(Checked):
    """Contacts, their forces, and servos (ours)."""

    reach: float = 0.006
    """Links nearer than this to the object are taken to touch it [m]."""
    contacts: int = 12
    """Largest number of links that touch; the nearest are taken."""
    friction: float = 0.4
    """Coefficient of friction that the forces rely on, below that of trials."""
    edges: int = 6
    """Edges of a friction cone."""
    force: float = 10.0
    """Sum of the normal forces [N]."""
    stiffness: float = 3.0
    """Stiffness of the servos [Nm/rad]: a joint torque over it is the offset of the target."""
    sharing: float = 0.05
    """Weight of equal shares of the fingers in the force, beside the net wrench."""
    smoothness: float = 1e-3
    """Weight of the squared forces themselves."""
    touching: float = 0.3
    """Share of the usual squeeze that touching fingers keep."""
    idle: float = 0.7
    """The same for fingers that do not touch, and for those that share their joints."""
    iterations: int = 200
    """Steps of the solver of forces."""
    batch_size: int | None = None
    """Grasps solved at once; None takes what suits the device."""


ON_CPU = 64  # Grasps solved at once on a CPU (ours, timed)
EACH = 1e6  # Memory of a grasp: the poses of all surface points, and the forces' matrices [bytes] (ours, counted)


@torch.no_grad()
def gripping(energy: GraspEnergy, grasps: GraspBatch, config: GripConfig | None = None) -> GraspBatch:
    """The same grasps with pregrasp and squeeze: the usual pregrasp, and a squeeze of balanced forces.

    Their fingers touch, as after refinement; a squeeze that they state is replaced.
    """
    if not len(grasps):
        return grasps
    T, q = grasps.T_object_wrist.to(energy.device), grasps.joints.to(energy.device)
    pregrasp, squeeze = (part.cpu() for part in closing_targets(energy, T, q, config or GripConfig()))
    return grasps.replace(pregrasp_joints=pregrasp, squeeze_joints=squeeze)


@torch.no_grad()
def closing_targets(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: GripConfig
) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, "n n_dof"]]:
    """Pregrasp and squeeze of wrist poses and joints on the energy's device, where they stay."""
    size = at_once(energy.device, ON_CPU, EACH, config.batch_size)
    made = [_targets(energy.rows(slice(start, start + size)), T[start : start + size], q[start : start + size], config)
            for start in range(0, len(q), size)]
    pregrasp, squeeze = (torch.cat(part) for part in zip(*made, strict=True))
    return pregrasp, squeeze


def _targets(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: GripConfig
) -> tuple[Float[Tensor, "n n_dof"], Float[Tensor, "n n_dof"]]:
    """Pregrasp and squeeze."""
    hand, tree = energy.hand, energy.hand.tree
    near = NearestPoints.of(energy, T, q)
    touches = near.gap < config.reach
    outer, inner = pregrasp_and_squeeze(hand, T, q, _middle(energy, near, touches))
    finger = hand.finger_links[:, near.links]
    involved = (touches[:, None] & finger).any(-1)
    forces = contact_forces(near, touches, finger, energy.centres, energy.lengths, config)
    jacobian = tree.point_jacobian(T[:, None] @ tree.forward(q), near.points, near.links)
    torque = torch.einsum("nlxd,nlx->nd", jacobian, forces)
    moved = hand.finger_joints
    # A joint that several fingers share goes on bringing those that do not touch yet.
    active = moved.any(0) & (involved[..., None] | ~moved).all(1)
    share = torch.where(active, config.touching, config.idle)
    target = q + share * (inner - q) + torque * hand.movable * tree.joint_unit**2 / config.stiffness
    lower, upper = torch.minimum(hand.lower, q), torch.maximum(hand.upper, q)
    return outer, target.clamp(lower, upper)


def _middle(energy: GraspEnergy, near: NearestPoints, touches: Bool[Tensor, "n l"]) -> Float[Tensor, "n 1 3"]:
    """What fingers close around [m]: the object; on a table, where they pinch a part of it, their contacts' middle."""
    around = energy.workspace.surroundings
    if around is None or not around.touch_plane:
        return energy.centres.expand(len(touches), 1, 3)
    on = touches.to(near.points)[..., None]
    return torch.where(on.sum(1) > 0, (near.points * on).sum(1) / on.sum(1).clamp_min(1), energy.centre)[:, None]


def _beside_points(length: float | Float[Tensor, "n 1"]) -> float | Float[Tensor, "n 1 1"]:
    return length[..., None] if isinstance(length, Tensor) else length


def contact_forces(
    near: NearestPoints, touches: Bool[Tensor, "n l"], finger: Bool[Tensor, "f l"],
    centre: Float[Tensor, "3"] | Float[Tensor, "#n 1 3"], length: float | Float[Tensor, "n 1"], config: GripConfig,
) -> Float[Tensor, "n l 3"]:
    """Forces of the links on the object [N]: inside their friction cones, balanced as well as possible.

    They minimise the squared net wrench, with torques about `centre` over `length` [m]; the fingers that touch share the force
    about equally, and links of no finger, such as the palm, answer with any force. `touches` says which of the contacts touch.
    """
    n, count = len(near.gap), min(config.contacts, near.gap.shape[1])
    kept = torch.where(touches, near.gap, torch.inf).topk(count, largest=False).indices
    rows = torch.arange(n, device=kept.device)[:, None]
    inward, arm = -near.object_normals[rows, kept], (near.points[rows, kept] - centre) / _beside_points(length)
    on = touches[rows, kept].to(arm)
    edges = friction_cone(inward, config.friction, config.edges)
    wrench = torch.cat([edges, torch.linalg.cross(arm[..., None, :].expand_as(edges), edges)], -1) * on[..., None, None]
    # Columns of the least squares: net wrench, share of each finger, the forces themselves, and their sum, which is 1.
    member = finger.to(arm).mT[kept] * on[..., None]
    fingers = member.amax(1)
    wanted = fingers / fingers.sum(1, keepdim=True).clamp_min(1)
    shares = member[:, :, None].expand(-1, -1, config.edges, -1).flatten(1, 2)
    weight = math.sqrt(config.sharing)
    columns = torch.cat([wrench.flatten(1, 2), weight * shares, shares.sum(-1, keepdim=True)], -1)
    target = torch.cat([torch.zeros_like(columns[:, 0, :6]), weight * wanted, torch.ones_like(columns[:, 0, :1])], -1)
    amounts = nonnegative_least_squares(columns.mT, target, config.smoothness, config.iterations)
    pressed = (amounts.unflatten(1, (count, config.edges))[..., None] * edges).sum(-2) * on[..., None]
    return torch.zeros_like(near.points).index_put((rows, kept), config.force * pressed)
