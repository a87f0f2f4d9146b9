"""Contacts of grasps as they are labelled, without any step of time: penetration, links that touch, analytic metrics.

The metrics are those of DexGraspBench; definitions, scales and tangents are those of its evaluation, so that values compare. Q1
is Ferrari and Canny's, the least wrench that breaks the grasp.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from dro_grasp.devices import Rows, over_cores
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.description.compiling import collide
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.piercing import pierced
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS, Protocol
from dro_grasp.simulation.scene import PREFIX, TrialScene, scene_of

Result = TypeVar("Result")


@dataclass(frozen=True)
class Penetration(Rows):
    """Penetration in n grasps."""

    object: Float[np.ndarray, " n"]  # of hand and object, or how far a finger pierces it [m]; zero without contact
    own: Float[np.ndarray, " n"]  # summed over pairs of hand links, the deepest contact of each pair [m]

    @staticmethod
    def join(parts: Sequence[Penetration]) -> Penetration:
        """One after the other."""
        return Penetration(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("object", "own")))


def measure_penetration(scene: TrialScene, grasps: GraspBatch) -> Penetration:
    """Penetration of the collision shapes in the labelled pose, without any step of time."""
    def depths(contacts: Contacts) -> tuple[float, float]:
        inside, bodies = np.maximum(-contacts.distance, 0.0), contacts.bodies
        with_object = (bodies == scene.object_body).any(1)
        deepest: dict[tuple[int, int], float] = {}
        for (a, b), d in zip(np.sort(bodies[~with_object], axis=1), inside[~with_object], strict=True):
            deepest[a, b] = max(deepest.get((a, b), 0.0), float(d))
        return inside[with_object].max(initial=0.0), sum(deepest.values())

    qpos = scene.qpos(grasps.T_object_wrist, grasps.joints)
    depth, own = np.array(of_contacts(scene.model, qpos, depths)).reshape(-1, 2).T
    return Penetration(np.maximum(depth, pierced(scene, qpos)), own)


def deepest_penetration(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = DEFAULT_PROTOCOL
) -> Float[Tensor, " n"]:
    """Penetration of hand and object, or summed over pairs of the hand's links, the deeper one, in the labelled pose [m].

    Pregrasp, squeeze and the protocol's forces play no role. Errors are those of `simulate`.
    """
    found = measure_penetration(scene_of(hand, obj, grasps, protocol), grasps)
    return torch.as_tensor(np.maximum(found.object, found.own), dtype=torch.float32)


def find_contact_links(scene: TrialScene, qpos: Float[np.ndarray, "n nq"]) -> tuple[tuple[str, ...], ...]:
    """Names of the links that touch the object in each configuration, sorted."""
    names = [scene.model.body(i).name.removeprefix(PREFIX) for i in range(scene.model.nbody)]

    def links(contacts: Contacts) -> tuple[str, ...]:
        involved = contacts.bodies[(contacts.bodies == scene.object_body).any(1)]
        return tuple(sorted({names[i] for i in involved[involved != scene.object_body]}))

    return tuple(of_contacts(scene.model, qpos, links))


def contact_mask(hand: Hand, contact_links: Sequence[Sequence[str]]) -> Bool[Tensor, "n n_links"]:
    """Which links of the hand are among each grasp's contact links."""
    names = {name: i for i, name in enumerate(hand.tree.link_names)}
    mask = torch.zeros(len(contact_links), hand.tree.n_links, dtype=torch.bool)
    for row, links in zip(mask, contact_links, strict=True):
        row[[names[link] for link in links if link in names]] = True
    return mask


def count_fingers(hand: Hand, contact_links: Sequence[Sequence[str]]) -> Int[Tensor, " n"]:
    """Number of fingers with at least one contact link, in each grasp."""
    mask = contact_mask(hand, contact_links)
    fingers = [mask[:, list(finger.links)].any(1) for finger in hand.fingers]
    return torch.stack(fingers).sum(0) if fingers else mask.new_zeros(len(mask), dtype=torch.int64)


@dataclass(frozen=True)
class Contacts:
    """k contacts of one configuration."""

    bodies: Int[np.ndarray, "k 2"]
    distance: Float[np.ndarray, " k"]  # negative inside [m]
    position: Float[np.ndarray, "k 3"]
    normal: Float[np.ndarray, "k 3"]  # from the first body to the second


def of_contacts(
    model: mujoco.MjModel, qpos: Float[np.ndarray, "n nq"], work: Callable[[Contacts], Result]
) -> list[Result]:
    """What work makes of the contacts of each configuration."""
    return over_cores(lambda rows: [work(contacts) for contacts in find_contacts(model, qpos[rows])], len(qpos))


def find_contacts(model: mujoco.MjModel, qpos: Float[np.ndarray, "n nq"]) -> Iterator[Contacts]:
    """The contacts of one configuration after the other, without any step of time."""
    data = mujoco.MjData(model)
    for q in qpos:
        data.qpos[:] = np.nan_to_num(q)
        collide(model, data)
        found, bodies = data.contact, model.geom_bodyid[data.contact.geom].reshape(-1, 2)
        yield Contacts(bodies, found.dist.copy(), found.pos.copy(), found.frame[:, :3].copy())


EDGES = 8  # Edges of the pyramid that stands for a friction cone in Q1. Source: DexGraspBench
DISTURBANCE = 0.1  # Force to be resisted, of the largest normal force of a contact [1]. Source: DexGraspBench
ALONG_Y = 0.99  # Cosine to the y axis from which tangents are taken from the z axis instead [1]. Source: DexGraspBench
HARD = 1e4  # Weight of an equation that must hold, beside one of weight 1 (ours): it is off by about its inverse square


def q1(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float) -> float:
    """Radius of the largest ball about the origin within the wrenches of contacts whose normal forces are at most 1 each.

    The wrench space is the convex hull of the contacts' wrenches and of none. Torques are about the mean of the points [m],
    with their mean distance to it as the unit of length. Zero: some wrench cannot be resisted at all. Normals have length 1 and
    point from hand to object.
    """
    offset = points - points.mean(0)
    grasp = _grasp_maps(offset / (np.linalg.norm(offset, axis=1).mean() + 1e-6), normals)
    angles = 2 * np.pi * np.arange(EDGES) / EDGES
    cone = np.stack([np.ones(EDGES), friction * np.sin(angles), friction * np.cos(angles)])
    wrenches = (grasp[:, :, :3] @ cone).transpose(0, 2, 1).reshape(-1, 6)
    try:
        hull = ConvexHull(np.concatenate([wrenches, np.zeros((1, 6))]))
    except QhullError:
        # Flat: there are wrenches that no force resists.
        return 0.0
    return float(np.abs(hull.equations[:, 6]).min())


def wrench_error(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, torsional: float
) -> float:
    """What the best contact forces leave of a force along each half-axis, averaged: the QP form of force closure.

    Forces obey friction, torsional too [m]; no contact presses with more than 1, all together press with at least 1. The error
    is the length of the remaining wrench, its torque about the mean of the points in metres of lever arm. Points as in `q1`.
    """
    from scipy.optimize import nnls  # slow to load, and rarely wanted

    n = len(points)
    edges = np.zeros((6, 6))
    edges[0] = 1.0
    edges[1, :2] = edges[2, 2:4] = friction, -friction
    edges[3, 4:] = torsional, -torsional
    columns = (_grasp_maps(points - points.mean(0), normals) @ edges).transpose(1, 0, 2).reshape(6, 6 * n)
    # Inequalities become equations with slacks; all unknowns are then non-negative.
    system = np.zeros((6 + n + 1, 6 * n + n + 1))
    system[:6, : 6 * n] = columns
    system[6:-1, : 6 * n] = HARD * np.kron(np.eye(n), np.ones(6))
    system[6:-1, 6 * n : -1] = HARD * np.eye(n)
    system[-1, : 6 * n] = HARD
    system[-1, -1] = -HARD
    target, errors = np.zeros(len(system)), []
    target[6:] = HARD
    for force in DISTURBANCE * np.concatenate([np.eye(3), -np.eye(3)]):
        target[:3] = force
        errors.append(np.linalg.norm(columns @ nnls(system, target)[0][: 6 * n] - target[:6]))
    return float(np.mean(errors))


def _grasp_maps(levers: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6 6"]:
    """Force and torque along normal and tangents of each contact, to force and torque at the origin."""
    along_y = np.abs(normals[:, 1:2]) > ALONG_Y
    tangent = np.where(along_y, [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    tangent = tangent - (tangent * normals).sum(1, keepdims=True) * normals
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    axes = np.stack([normals, tangent, np.cross(normals, tangent)], -1)
    maps = np.zeros((len(levers), 6, 6))
    maps[:, :3, :3] = maps[:, 3:, 3:] = axes
    maps[:, 3:, :3] = np.cross(levers[:, :, None], axes, axis=1)
    return maps


REACH = 0.01  # Largest distance that is measured between a finger and the object [m]. Source: DexGraspBench
TOUCH = 0.002  # A link nearer than this to the surface, from outside or inside, touches the object [m]. Source: DexGraspBench
TIP_TOUCH = 0.005  # The same for a fingertip, in the measures of force closure [m]. Source: DexGraspBench
CAUTION = 0.5  # Share of the friction that the measures of force closure count on [1]. Source: DexGraspBench
NO_CONTACT = 2.0  # Wrench error of a grasp that no fingertip touches. Source: DexGraspBench


@dataclass(frozen=True)
class ContactQuality:
    """Analytic metrics of n grasps."""

    object_penetration: Float[Tensor, " n"]
    """Deepest penetration of hand and object [m]."""
    deepest_self_penetration: Float[Tensor, " n"]
    """Deepest penetration of two links of the hand [m]."""
    touching_links: Float[Tensor, " n"]
    """Number of links whose surface is within TOUCH of the object's."""
    contact_distance: Float[Tensor, " n"]
    """Mean over fingers of their distance to the object, zero inside it and at most REACH [m]."""
    contact_spread: Float[Tensor, " n"]
    """Largest difference of two fingers' distances, negative inside the object and at most REACH [m]."""
    q1: Float[Tensor, " n"]
    """Least wrench that breaks the grip of the fingertips; larger is better, 0 without force closure."""
    wrench_error: Float[Tensor, " n"]
    """What their best forces leave of a disturbing force; smaller is better, NO_CONTACT without contact."""


NAMES = tuple(field.name for field in fields(ContactQuality))
"""Names of the metrics, which are those of the further columns of a grasp file."""


def measure_contacts(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = PROTOCOLS["dexgraspbench"]
) -> ContactQuality:
    """The analytic metrics of each grasp on an object with a mesh; pregrasp and squeeze play no role.

    The protocol states the friction, of which CAUTION is counted on. Errors are those of `simulate`.
    """
    scene = scene_of(hand, obj, grasps, protocol)
    model = copy.copy(scene.model)
    model.geom_gap[model.geom_bodyid == scene.object_body] = REACH
    rows = [_measured(scene, contacts) for contacts in find_contacts(model, scene.qpos(grasps.T_object_wrist, grasps.joints))]
    values = torch.tensor(rows, dtype=torch.float32).reshape(-1, len(NAMES))
    return ContactQuality(*values.unbind(1))


def with_contacts(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = PROTOCOLS["dexgraspbench"]
) -> GraspBatch:
    """The grasps with their analytic metrics in further columns of the same names; arguments and errors as above."""
    found = measure_contacts(hand, obj, grasps, protocol)
    return grasps.replace(extra=grasps.extra | {name: getattr(found, name) for name in NAMES})


def _measured(scene: TrialScene, contacts: Contacts) -> tuple[float, ...]:
    """The metrics of one grasp, in the order of NAMES."""
    hand, rules, obj = scene.hand, scene.protocol, scene.object_body
    on_object = (contacts.bodies == obj).any(1)
    first = contacts.bodies[on_object, 0]
    normal = np.where((first == obj)[:, None], -1.0, 1.0) * contacts.normal[on_object]
    body, distance = np.where(first == obj, contacts.bodies[on_object, 1], first), contacts.distance[on_object]
    names = {name: i for i, name in enumerate(hand.tree.link_names)}
    link = np.array([names.get(scene.model.body(int(b)).name.removeprefix(PREFIX), -1) for b in body], int)
    reach = [distance[np.isin(link, finger.links)].min(initial=REACH) for finger in hand.fingers] or [REACH]
    depths = [max(0.0, -float(d.min(initial=0.0))) for d in (distance, contacts.distance[~on_object])]
    grip = np.isin(link, hand.tips) & (np.abs(distance) <= TIP_TOUCH)
    measures = 0.0, NO_CONTACT
    if grip.any():
        points, normals = _by_link(link[grip], contacts.position[on_object][grip], normal[grip])
        friction = CAUTION * rules.friction
        measures = q1(points, normals, friction), wrench_error(points, normals, friction, CAUTION * rules.torsional_friction)
    touching = len(np.unique(link[np.abs(distance) < TOUCH]))
    return (*depths, float(touching), float(np.mean(np.maximum(reach, 0))), float(max(reach) - min(reach)), *measures)


def _by_link(
    link: Int[np.ndarray, " k"], position: Float[np.ndarray, "k 3"], normal: Float[np.ndarray, "k 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Mean contact of each link: its point, and its normal of length 1."""
    each = [link == index for index in np.unique(link)]
    normals = np.stack([normal[own].mean(0) for own in each])
    return np.stack([position[own].mean(0) for own in each]), normals / np.linalg.norm(normals, axis=1, keepdims=True)
