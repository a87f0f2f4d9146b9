"""Forces of closed hands: what presses where, what mass each grasp can carry, and how hard it has to squeeze.

A grasp carries a mass if, whichever way gravity pulls, forces within the friction cones of its contacts balance the weight, and
no joint needs more torque than its effort. That is a linear program, exact for pyramids in place of the cones; friction about
the normals counts as that of soft fingers does. Source: Kerr and Roth 1986, with gravity from all sides; ours otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import linprog
from scipy.sparse import block_diag, csr_matrix, hstack

from dro_grasp.geometry.contact_forces import friction_cone
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.contacts import find_contacts
from dro_grasp.simulation.outcome import FORCES
from dro_grasp.simulation.protocols import Protocol, protocol as find_protocol
from dro_grasp.simulation.rollout import rollouts
from dro_grasp.simulation.scene import PREFIX, TrialScene, scene_of

GRAVITY = 9.81  # [m/s^2]


@dataclass(frozen=True)
class ForceConfig(Checked):
    """How forces are computed (ours)."""

    friction: float = 0.5
    """Largest coefficient that is relied on."""
    edges: int = 8
    """Edges of the pyramid that stands for a friction cone."""
    gap: float = 5e-4
    """Contacts that are farther apart do not press [m]."""


@dataclass(frozen=True)
class Touch:
    """k contacts of one closed hand with the object, in the wrist frame, and what forces there do."""

    points: Float[np.ndarray, "k 3"]  # [m]
    inward: Float[np.ndarray, "k 3"]  # unit normals into the object
    links: Int[np.ndarray, " k"]
    wrench: Float[np.ndarray, "6 g"]
    """Force [N], and torque about the object's centre of mass [Nm], of each generator: edges of cones with a normal force of
    1 N, and the same with torsion either way."""
    torque: Float[np.ndarray, "n_dof g"]  # of the joints that exert each generator [Nm or N]


def touches(hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol, config: ForceConfig) -> Iterator[Touch]:
    """The contacts of each grasp after the protocol's closing."""
    scene = scene_of(hand, obj, grasps, protocol)
    for _, rollout in rollouts(scene, hand, grasps, workers=1):
        rollout.close()
        joints, _ = rollout.poses()
        for q, qpos in zip(joints, rollout.qpos, strict=True):
            yield _touch(scene, q, qpos, config)


def _touch(scene: TrialScene, q: Float[np.ndarray, " n_dof"], qpos: Float[np.ndarray, " nq"], config: ForceConfig) -> Touch:
    hand, names = scene.hand, [scene.model.body(i).name.removeprefix(PREFIX) for i in range(scene.model.nbody)]
    (found,) = find_contacts(scene.model, qpos[None])
    on = (found.bodies == scene.object_body).any(1) & (found.distance < config.gap)
    bodies, points, normal = found.bodies[on], found.position[on], found.normal[on]
    first = bodies[:, 0] == scene.object_body  # normals point from the first body to the second
    inward = np.where(first[:, None], -normal, normal)
    link_of = {name: i for i, name in enumerate(hand.tree.link_names)}
    links = np.array([link_of[names[b]] for b in np.where(first, bodies[:, 1], bodies[:, 0])], int)
    return _generators(scene, q, points, inward, links, qpos[scene.object_qpos][:3], config)


def _generators(
    scene: TrialScene, q: Float[np.ndarray, " n_dof"], points: Float[np.ndarray, "k 3"], inward: Float[np.ndarray, "k 3"],
    links: Int[np.ndarray, " k"], centre: Float[np.ndarray, "3"], config: ForceConfig,
) -> Touch:
    tree, rules = scene.hand.tree, scene.protocol
    edges = friction_cone(torch.from_numpy(inward), min(rules.friction, config.friction), config.edges).numpy()
    twist = rules.torsional_friction * np.stack([inward, -inward], 1)
    force = np.concatenate([edges, np.repeat(inward[:, None], 2, 1)], 1)
    moment = np.cross((points - centre)[:, None], force)
    moment[:, config.edges:] += twist
    q_ = torch.from_numpy(q).to(tree.origin)
    jacobian = tree.point_jacobian(tree.forward(q_), torch.from_numpy(points).to(tree.origin), torch.from_numpy(links)).double()
    spin = tree.motion_axes(tree.forward(q_))[1].double()  # angular velocity of each link by its own joint
    turning = torch.einsum("kl,lc,ld->kcd", tree.descends[links].double(), spin, tree.link_coupling.double())
    torque = np.einsum("kgc,kcd->dkg", force, jacobian.numpy())
    torque[:, :, config.edges:] += np.einsum("kgc,kcd->dkg", twist, turning.numpy())
    wrench = np.concatenate([force, moment], -1).transpose(2, 0, 1)
    return Touch(points, inward, links, wrench.reshape(6, -1), torque.reshape(tree.n_dof, -1))


def payloads(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = "carry", config: ForceConfig | None = None
) -> Float[np.ndarray, " n"]:
    """The largest mass that each grasp can carry in every direction of gravity [kg]."""
    effort = find_efforts(hand).limit.double().numpy()
    return np.array([payload(t, effort) for t in touches(hand, obj, grasps, find_protocol(protocol), config or ForceConfig())])


def payload(touch: Touch, effort: Float[np.ndarray, " n_dof"], compliance: float | None = None) -> float:
    """The largest mass that forces of contacts balance along each of FORCES [kg]; 0 without contact.

    Amounts of the generators are scaled to a weight of 1 N per direction; then the largest share of an effort is least.
    """
    g, n = touch.wrench.shape[1], len(effort)
    if g == 0:
        return 0.0
    count = len(FORCES)
    shares = touch.torque / effort[:, None]
    # Variables: amounts for each direction, effort's share t.
    equal = hstack([block_diag([csr_matrix(touch.wrench)] * count), csr_matrix((6 * count, 1))])
    load = np.concatenate([np.concatenate([-f, np.zeros(3)]) for f in FORCES])
    both = np.vstack([shares, -shares])
    bound = hstack([block_diag([csr_matrix(both)] * count), csr_matrix(-np.ones((2 * n * count, 1)))])
    cost = np.zeros(g * count + 1)
    cost[-1] = 1
    done = linprog(cost, bound, np.zeros(2 * n * count), equal, load, method="highs")
    return 1 / (GRAVITY * max(done.x[-1], 1e-9)) if done.status == 0 else 0.0
