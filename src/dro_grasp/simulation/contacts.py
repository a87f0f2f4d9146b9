"""Contacts of a configuration: penetration of labelled grasps, links that touch the object."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import Rows
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.description.compiling import collide
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.hand_part import PREFIX
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol
from dro_grasp.simulation.scene import TrialScene, scene_of


@dataclass(frozen=True)
class Penetration(Rows):
    """Penetration in n grasps."""

    object: Float[np.ndarray, " n"]  # deepest contact of hand and object [m]; zero without contact
    own: Float[np.ndarray, " n"]  # summed over pairs of hand links, the deepest contact of each pair [m]


def measure_penetration(scene: TrialScene, grasps: GraspBatch) -> Penetration:
    """Penetration of the collision shapes in the labelled pose, without any step of time."""
    depth, own = np.zeros(len(grasps)), np.zeros(len(grasps))
    for i, contacts in enumerate(find_contacts(scene.model, scene.qpos(grasps.T_object_wrist, grasps.joints))):
        inside, bodies = np.maximum(-contacts.distance, 0.0), contacts.bodies
        with_object = (bodies == scene.object_body).any(1)
        depth[i] = inside[with_object].max(initial=0.0)
        deepest: dict[tuple[int, int], float] = {}
        for (a, b), d in zip(np.sort(bodies[~with_object], axis=1), inside[~with_object], strict=True):
            deepest[a, b] = max(deepest.get((a, b), 0.0), float(d))
        own[i] = sum(deepest.values())
    return Penetration(depth, own)


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
    found = []
    for contacts in find_contacts(scene.model, qpos):
        involved = contacts.bodies[(contacts.bodies == scene.object_body).any(1)]
        found.append(tuple(sorted({names[i] for i in involved[involved != scene.object_body]})))
    return tuple(found)


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


def find_contacts(model: mujoco.MjModel, qpos: Float[np.ndarray, "n nq"]) -> Iterator[Contacts]:
    """The contacts of one configuration after the other, without any step of time."""
    data = mujoco.MjData(model)
    for q in qpos:
        data.qpos[:] = np.nan_to_num(q)
        collide(model, data)
        found, bodies = data.contact, model.geom_bodyid[data.contact.geom].reshape(-1, 2)
        yield Contacts(bodies, found.dist.copy(), found.pos.copy(), found.frame[:, :3].copy())
