"""Contact quality of grasps as they are labelled, without any step of time: the analytic metrics of DexGraspBench."""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.descriptions.compiling import collide
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import require_pair
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.force_closure import q1, wrench_error
from dro_grasp.simulation.hand_part import PREFIX
from dro_grasp.simulation.protocols import PROTOCOLS, Protocol, protocol as find_protocol
from dro_grasp.simulation.scene import TrialScene, cached_scene

REACH = 0.01
"""Largest distance that is measured between a finger and the object [m]. Source: DexGraspBench."""
TOUCH = 0.002
"""A link nearer than this to the surface, from outside or inside, touches the object [m]. Source: DexGraspBench."""
TIP_TOUCH = 0.005
"""The same for a fingertip, in the measures of force closure [m]. Source: DexGraspBench."""
CAUTION = 0.5
"""Share of the friction that the measures of force closure count on [1]. Source: DexGraspBench."""
NO_CONTACT = 2.0
"""Wrench error of a grasp that no fingertip touches. Source: DexGraspBench."""


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
    """The analytic metrics of each grasp.

    Args:
        hand: The hand of the grasps.
        obj: Their object; it needs a mesh.
        grasps: Any; pregrasp and squeeze play no role.
        protocol: States the friction, of which CAUTION is counted on.

    Raises:
        ObjectError: The object is a bare point cloud.
        HandError: The hand came without its description.
        GraspFileError: The grasps are of another hand.
        OptionError: The protocol does not exist.
    """
    require_pair(hand, obj)
    grasps.require_hand(hand)
    scene = cached_scene(hand, obj, find_protocol(protocol))
    rows = [_measured(scene, contacts) for contacts in _near_contacts(scene, grasps)]
    values = torch.tensor(rows, dtype=torch.float32).reshape(-1, len(NAMES))
    return ContactQuality(*values.unbind(1))


def with_contacts(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = PROTOCOLS["dexgraspbench"]
) -> GraspBatch:
    """The grasps with their analytic metrics in further columns of the same names; arguments and errors as above."""
    found = measure_contacts(hand, obj, grasps, protocol)
    return grasps.replace(extra=grasps.extra | {name: getattr(found, name) for name in NAMES})


@dataclass(frozen=True)
class _Contacts:
    """k contacts of one configuration."""

    bodies: Int[np.ndarray, "k 2"]
    distance: Float[np.ndarray, " k"]
    """Negative inside [m]."""
    position: Float[np.ndarray, "k 3"]
    normal: Float[np.ndarray, "k 3"]
    """From the first body to the second."""


def _near_contacts(scene: TrialScene, grasps: GraspBatch) -> list[_Contacts]:
    """Contacts of each grasp, those of hand and object up to REACH apart."""
    model = copy.copy(scene.model)
    model.geom_gap[model.geom_bodyid == scene.object_body] = REACH
    data, found = mujoco.MjData(model), []
    for q in scene.qpos(grasps.T_object_wrist, grasps.joints):
        data.qpos[:] = np.nan_to_num(q)
        collide(model, data)
        bodies = model.geom_bodyid[data.contact.geom].reshape(-1, 2)
        found.append(_Contacts(bodies, data.contact.dist.copy(), data.contact.pos.copy(), data.contact.frame[:, :3].copy()))
    return found


def _measured(scene: TrialScene, contacts: _Contacts) -> tuple[float, ...]:
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
