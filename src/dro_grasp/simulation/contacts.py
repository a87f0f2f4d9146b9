"""Contacts of a configuration: penetration of labelled grasps, links that touch the object."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.descriptions.compiling import collide
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import require_pair
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.hand_part import PREFIX
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, Protocol, protocol as find_protocol
from dro_grasp.simulation.scene import TrialScene, cached_scene


@dataclass(frozen=True)
class Penetration:
    """Penetration in n grasps."""

    object: Float[np.ndarray, " n"]
    """Deepest contact of hand and object [m]; zero without contact."""
    own: Float[np.ndarray, " n"]
    """Summed over pairs of hand links, the deepest contact of each pair [m]."""

    def rows(self, index: Int[np.ndarray, " k"]) -> Penetration:
        """The penetration in some of the grasps."""
        return Penetration(self.object[index], self.own[index])


def measure_penetration(scene: TrialScene, grasps: GraspBatch) -> Penetration:
    """Penetration of the collision shapes in the labelled pose, without any step of time."""
    depth, own = np.zeros(len(grasps)), np.zeros(len(grasps))
    for i, (bodies, distance) in enumerate(_contacts(scene, scene.qpos(grasps.T_object_wrist, grasps.joints))):
        inside = np.maximum(-distance, 0.0)
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

    Args:
        hand: The hand of the grasps.
        obj: Their object, with a mesh or with balls.
        grasps: Any; pregrasp and squeeze play no role.
        protocol: Of the scene; its forces play no role.

    Raises:
        ObjectError: The object is a bare point cloud, without balls that stand for it.
        HandError: The hand came without its description.
        GraspFileError: The grasps are of another hand.
        OptionError: The protocol does not exist.
    """
    require_pair(hand, obj)
    grasps.require_hand(hand)
    found = measure_penetration(cached_scene(hand, obj, find_protocol(protocol)), grasps)
    return torch.as_tensor(np.maximum(found.object, found.own), dtype=torch.float32)


def find_contact_links(scene: TrialScene, qpos: Float[np.ndarray, "n nq"]) -> tuple[tuple[str, ...], ...]:
    """Names of the links that touch the object in each configuration, sorted."""
    names = [scene.model.body(i).name.removeprefix(PREFIX) for i in range(scene.model.nbody)]
    found = []
    for bodies, _ in _contacts(scene, qpos):
        involved = bodies[(bodies == scene.object_body).any(1)]
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


def _contacts(
    scene: TrialScene, qpos: Float[np.ndarray, "n nq"]
) -> Iterator[tuple[Int[np.ndarray, "k 2"], Float[np.ndarray, " k"]]]:
    """The two bodies and the distance [m] of each contact, one configuration after the other."""
    data = mujoco.MjData(scene.model)
    for q in qpos:
        data.qpos[:] = np.nan_to_num(q)
        collide(scene.model, data)
        yield scene.model.geom_bodyid[data.contact.geom].reshape(-1, 2), data.contact.dist.copy()
