"""What holds the object once the hand has closed: the motion that is left, the contacts, and what their forces could answer.

Nothing pushes the object here, so this is no trial; it tells a squeeze that slips from one that grips. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.devices import Rows
from dro_grasp.geometry.contact_forces import friction_cone, nonnegative_least_squares
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.outcome import FORCES, LOST_DISTANCE
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol
from dro_grasp.simulation.rollout import ObjectState, Pulls, Rollout, quiet, rollouts
from dro_grasp.simulation.scene import PREFIX, TrialScene, scene_of

CONTACTS = 16  # Most contacts of a grasp that are weighed, those that press hardest (ours)
PUSH = 5.0  # Acceleration of the object that the contacts are asked to answer, along each axis and against it [m/s^2] (ours)
FRICTION_SHARE = 0.5  # Share of the friction that the answer may use (ours)
LEVER = 0.05  # Lever that makes a torque comparable with a force [m] (ours)
CHANGE = 0.3  # Cost of doubling or dropping the force of a contact, beside an unanswered push of UNIT (ours)
UNIT = 10.0  # Acceleration of the object by which pushes and the forces of contacts are measured [m/s^2] (ours)
BEARS = 0.05  # Normal force of a contact above which its slip counts [N] (ours)
EDGES = 6  # Edges of a friction cone (ours)
RIDGE = 1e-4  # Weight of the squared forces in the solver (ours)
SMALLEST = 1e-3  # Weight of the squared forces beside the weight that they hold (ours)
PAIRS = ("unanswered", "gave")  # Fields of two columns
STEPS = 80  # Steps of the solver (ours)
NO_ANSWER = 3.0  # Largest value of `unanswered`; its value without contacts, and that of `slip` without any that bears (ours)


@dataclass(frozen=True)
class GraspState(Rows):
    """How the object is held in n closed grasps."""

    shift: Float[Tensor, " n"]  # how far closing moved the object [m]
    turn: Float[Tensor, " n"]  # how far it turned the object [rad]
    speed: Float[Tensor, " n"]  # how fast the object still moves [m/s]
    spin: Float[Tensor, " n"]  # how fast it still turns [rad/s]
    contacts: Float[Tensor, " n"]  # number of contact points of hand and object
    links: Float[Tensor, " n"]  # number of links that touch the object
    pressure: Float[Tensor, " n"]  # sum of the normal forces [N]
    slip: Float[Tensor, " n"]  # largest ratio of tangential to normal force at a contact that bears; NO_ANSWER without one
    unanswered: Float[Tensor, "n 2"]
    """What is missing for contacts near their present forces to answer a push: for the worst direction, and on average."""
    gave: Float[Tensor, "n 2"]
    """How far the weight then moves the object [m] and turns it [rad], whichever way it pulls; NaN where it was not tried."""


@dataclass(frozen=True)
class ContactForces:
    """Contacts of one configuration with the object; normals point into it."""

    normal: Float[np.ndarray, "k 3"]
    arm: Float[np.ndarray, "k 3"]  # from the object's centre of mass [m]
    point: Float[np.ndarray, "k 3"]  # in the wrist frame [m]
    link: Int[np.ndarray, " k"]  # the hand's link that each is on
    pressure: Float[np.ndarray, " k"]  # normal force [N]
    tangential: Float[np.ndarray, " k"]  # tangential force [N]

    @property
    def links(self) -> int:
        """Number of links that they are on."""
        return len(np.unique(self.link))

    @property
    def slip(self) -> float:
        """As in `GraspState`."""
        bears = self.pressure > BEARS
        return float((self.tangential[bears] / self.pressure[bears]).max()) if bears.any() else NO_ANSWER


def grasp_state(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL, *,
    config: WeightConfig | None = None, workers: int | None = None
) -> tuple[GraspState, Float[Tensor, "n n_dof"]]:
    """Close hands as a trial does, and look at what holds the object then; arguments and errors are those of `simulate`.

    The second result are squeezes that press for the object's weight, too (see `weight_torques`).
    """
    scene, config = scene_of(hand, obj, grasps, protocol), config or WeightConfig()
    none = {f.name: torch.zeros(0, 2) if f.name in PAIRS else torch.zeros(0) for f in fields(GraspState)}
    parts, squeezes = [GraspState(**none)], [grasps.joints[:0]]
    for part, rollout in rollouts(scene, hand, grasps, workers):
        closed, state, found = _observed(rollout)
        joints = torch.from_numpy(rollout.poses()[0]).to(grasps.joints)
        torques = weight_torques(hand, found, joints, torch.from_numpy(rollout.mass).to(joints), config)
        offset = torques * hand.tree.joint_unit**2 / config.stiffness
        squeezes.append((part.squeeze_joints + offset).clamp(hand.tree.lower, hand.tree.upper))
        parts.append(replace(state, gave=_pulled(rollout, closed, squeezes[-1], config)))
    state = GraspState(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(GraspState)})
    return state, torch.cat(squeezes)


def _pulled(
    rollout: Rollout, closed: ObjectState, squeeze: Float[Tensor, "n n_dof"], config: WeightConfig
) -> Float[Tensor, "n 2"]:
    """How far pulls move and turn the object while the hand presses for its weight."""
    if config.pull == 0:
        return torch.full((rollout.size, 2), torch.nan)
    pressed = rollout.press(squeeze.numpy()[:, rollout.scene.actuated], config.pressing)
    alive = pressed.stable & (pressed.shift(closed) < LOST_DISTANCE)
    pulls = Pulls(config.pull * config.gravity, config.pulling, reset=True)
    moved, turned, _ = rollout.push(pressed, alive, pulls)
    gave = np.stack([np.nan_to_num(moved, nan=LOST_DISTANCE).max(1), np.nan_to_num(turned, nan=np.pi).max(1)], 1)
    return torch.from_numpy(gave).float()


def _observed(rollout: Rollout) -> tuple[ObjectState, GraspState, list[ContactForces]]:
    scene, closed = rollout.scene, rollout.close()
    first = int(scene.model.body_dofadr[scene.object_body])
    velocity = np.nan_to_num(np.array(rollout.batch.bind("qvel"))[:, first:first + 6])
    found = _contacts(rollout)
    columns = {
        "shift": closed.shift(rollout.start), "turn": closed.turn(rollout.start),
        "speed": np.linalg.norm(velocity[:, :3], axis=1), "spin": np.linalg.norm(velocity[:, 3:], axis=1),
        "contacts": [len(c.pressure) for c in found], "links": [c.links for c in found],
        "pressure": [c.pressure.sum() for c in found],
        "slip": [c.slip for c in found],
    }
    friction = FRICTION_SHARE * scene.protocol.friction
    values = {name: torch.as_tensor(np.array(column), dtype=torch.float32) for name, column in columns.items()}
    missing = unanswered(found, torch.as_tensor(rollout.mass, dtype=torch.float32), friction)
    return closed, GraspState(**values, unanswered=missing, gave=torch.full_like(missing, torch.nan)), found


def _contacts(rollout: Rollout) -> list[ContactForces]:
    """The contacts with the object in each simulation, with the forces that they bear now."""
    scene, force = rollout.scene, np.zeros(6)
    model, data = scene.model, mujoco.MjData(scene.model)
    names = ("qpos", "qvel", "ctrl", "qacc_warmstart")
    state = {name: np.nan_to_num(np.array(rollout.batch.bind(name))) for name in names}
    found, links = [], link_of_body(scene)
    for i in range(rollout.size):
        for name in names:
            getattr(data, name)[:] = state[name][i]
        with quiet():
            mujoco.mj_forward(model, data)
        bodies = model.geom_bodyid[data.contact.geom].reshape(-1, 2)
        rows = np.flatnonzero((bodies == scene.object_body).any(1))
        forces = np.zeros((len(rows), 3))
        for k, row in enumerate(rows):
            mujoco.mj_contactForce(model, data, row, force)
            forces[k] = force[:3]
        into = np.where(bodies[rows, 1] == scene.object_body, 1.0, -1.0)[:, None]
        touching = bodies[rows][bodies[rows] != scene.object_body]
        found.append(ContactForces(
            into * data.contact.frame.reshape(-1, 9)[rows, :3], data.contact.pos[rows] - data.xipos[scene.object_body],
            data.contact.pos[rows].copy(), links[touching], forces[:, 0], np.linalg.norm(forces[:, 1:], axis=1)))
    return found


def link_of_body(scene: TrialScene) -> Int[np.ndarray, " n_bodies"]:
    """The hand's link that each body of a scene is; -1 for those of no link."""
    names = {name: i for i, name in enumerate(scene.hand.tree.link_names)}
    return np.array([names.get(scene.model.body(b).name.removeprefix(PREFIX), -1) for b in range(scene.model.nbody)], int)


@dataclass(frozen=True)
class WeightConfig(Checked):
    """How hard fingers press for the object's weight (ours)."""

    margin: float = 1.5
    """Multiple of the weight that is held whichever way gravity pulls; 0 squeezes light and heavy things alike."""
    gravity: float = 9.81
    """[m/s^2]"""
    friction: float = 0.5
    """Coefficient of friction that the forces rely on."""
    contacts: int = 12
    """Most contacts of a grasp that count, those that press hardest."""
    edges: int = 6
    """Edges of a friction cone."""
    iterations: int = 100
    """Steps of the solver."""
    missing: float = 0.3
    """Share of the weight that may stay without answer; where more does, pressing harder only ejects the object."""
    stiffness: float = 3.0
    """Stiffness of the servos [Nm/rad]; a squeeze is the torque over it."""
    pull: float = 1.0
    """Multiple of the weight that then pulls along six directions; 0 does not try."""
    pressing: float = 0.2
    """Time for which the hand presses before [s]."""
    pulling: float = 0.3
    """Time of each pull [s]."""


def weight_torques(
    hand: Hand, contacts: list[ContactForces], joints: Float[Tensor, "n n_dof"], mass: Float[Tensor, " n"],
    config: WeightConfig | None = None,
) -> Float[Tensor, "n n_dof"]:
    """Torques by which joints press so that contacts hold the weight along each axis and against it [Nm or N].

    For each way of gravity, the least forces within the friction cones that balance the weight; their mean balances itself,
    and each contact presses in it for its share of whichever weight there is. Where contacts cannot hold it, nothing is added.
    """
    config, n = config or WeightConfig(), len(contacts)
    if config.margin == 0 or n == 0:
        return torch.zeros_like(joints)
    k, tree = config.contacts, hand.tree
    normal, arm, point = (joints.new_zeros(n, k, 3) for _ in range(3))
    normal[..., 2], on, link = 1.0, joints.new_zeros(n, k), torch.zeros(n, k, dtype=torch.int64)
    for i, c in enumerate(contacts):
        kept = np.argsort(-c.pressure)[:k]
        for table, values in ((normal, c.normal), (arm, c.arm), (point, c.point), (link, c.link)):
            table[i, :len(kept)] = torch.as_tensor(values[kept]).to(table)
        on[i, :len(kept)] = 1
    cone = friction_cone(normal, config.friction, config.edges) * on[..., None, None]
    wrench = torch.cat([cone, torch.linalg.cross(arm[..., None, :].expand_as(cone) / LEVER, cone)], -1).flatten(1, 2).mT
    pulls = torch.as_tensor(FORCES).to(joints)
    goal = torch.cat([-pulls, torch.zeros_like(pulls)], -1).repeat(n, 1)
    amounts = nonnegative_least_squares(wrench.repeat_interleave(len(pulls), 0), goal, SMALLEST, config.iterations)
    missing = ((wrench.repeat_interleave(len(pulls), 0) @ amounts[..., None])[..., 0] - goal).norm(dim=-1)
    able = missing.reshape(n, len(pulls)).amax(1) < config.missing
    mean = amounts.unflatten(0, (n, len(pulls))).mean(1).unflatten(1, (k, config.edges))
    force = (config.margin * config.gravity * mass * able)[:, None, None] * (mean[..., None] * cone).sum(-2)
    jacobian = torch.stack([
        tree.point_jacobian(pose, p, at) for pose, p, at in zip(tree.forward(joints), point, link.clamp_min(0), strict=True)])
    return torch.einsum("nkc,nkcd->nd", force, jacobian) * hand.movable


def unanswered(contacts: list[ContactForces], mass: Float[Tensor, " n"], friction: float) -> Float[Tensor, "n 2"]:
    """What is missing for the contacts to answer pushes: for the worst of six directions, and on average."""
    # Each contact may change its force within its friction cone; a change relative to its present pressure costs as much as a
    # share of the push that stays unanswered.
    n = len(contacts)
    normal, arm = torch.zeros(n, CONTACTS, 3), torch.zeros(n, CONTACTS, 3)
    normal[..., 2], pressure = 1.0, torch.zeros(n, CONTACTS)
    for i, c in enumerate(contacts):
        kept = np.argsort(-c.pressure)[:CONTACTS]
        for table, values in ((normal, c.normal), (arm, c.arm), (pressure, c.pressure)):
            table[i, :len(kept)] = torch.as_tensor(values[kept], dtype=torch.float32)
    on = (pressure > 0).float()
    cone = friction_cone(normal, friction, EDGES)
    scale = (pressure / (UNIT * mass[:, None]))[..., None, None]
    wrench = torch.cat([cone, torch.linalg.cross(arm[..., None, :].expand_as(cone) / LEVER, cone)], -1) * scale
    same = CHANGE * torch.eye(CONTACTS).repeat_interleave(EDGES, 1) * on.repeat_interleave(EDGES, 1)[:, None]
    matrix = torch.cat([wrench.flatten(1, 2).mT, same], 1)
    push = torch.as_tensor(FORCES, dtype=torch.float32) * PUSH / UNIT
    answer = torch.cat([-push, torch.zeros(6, 3)], 1).expand(n, 6, 6)
    goal = torch.cat([answer, (CHANGE * on)[:, None].expand(n, 6, CONTACTS)], -1).flatten(0, 1)
    matrix = matrix.repeat_interleave(6, 0)
    x = nonnegative_least_squares(matrix, goal, RIDGE, STEPS)
    missing = ((matrix @ x[..., None])[..., 0] - goal).norm(dim=-1).reshape(n, 6).clamp_max(NO_ANSWER)
    missing[on.sum(1) == 0] = NO_ANSWER
    return torch.stack([missing.amax(1), missing.mean(1)], 1)
