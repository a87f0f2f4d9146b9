"""What presses where: the contacts of closed hands with the object, the forces that they bear, and what those ask of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from dro_grasp.devices import Rows, over_cores
from dro_grasp.hands.hand import Hand
from dro_grasp.simulation.quiet import quiet
from dro_grasp.simulation.rollout import Rollout
from dro_grasp.simulation.scene import PREFIX, TrialScene

BEARS = 0.05  # Normal force of a contact above which its slip counts [N] (ours)
NO_ANSWER = 3.0  # Largest value of `unanswered`; its value without contacts, and that of `slip` without any that bears (ours)


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
    def hardest_link(self) -> float:
        """Largest sum of the normal forces of a link [N]."""
        return float(np.bincount(self.link - self.link.min(), self.pressure).max()) if len(self.link) else 0.0

    @property
    def slip(self) -> float:
        """As in `GraspState`."""
        bears = self.pressure > BEARS
        return float((self.tangential[bears] / self.pressure[bears]).max()) if bears.any() else NO_ANSWER


STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart")  # Fields of MjData on which contact forces depend


def contact_forces(rollout: Rollout) -> list[ContactForces]:
    """The contacts with the object in each simulation, with the forces that they bear now."""
    state = {name: np.nan_to_num(np.array(rollout.batch.bind(name))) for name in STATE}
    found: list[ContactForces] = []
    for scene, own in rollout.parts():
        part, links = {name: values[own] for name, values in state.items()}, link_of_body(scene)
        found += over_cores(
            lambda rows, scene=scene, part=part, links=links: _forces(
                scene, {name: values[rows] for name, values in part.items()}, links), own.stop - own.start)
    return found


def _forces(
    scene: TrialScene, state: dict[str, Float[np.ndarray, "n _"]], links: Int[np.ndarray, " n_bodies"]
) -> list[ContactForces]:
    """Those of some simulations of a scene."""
    model, data, force, found = scene.model, mujoco.MjData(scene.model), np.zeros(6), []
    for i in range(len(state["qpos"])):
        for name, values in state.items():
            getattr(data, name)[:] = values[i]
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
class Pressing(Rows):
    """At most k contacts of each of n closed hands with the object, and what a force there asks of the joints."""

    normal: Float[Tensor, "n k 3"]  # into the object
    arm: Float[Tensor, "n k 3"]  # from its centre of mass [m]
    on: Float[Tensor, "n k"]  # 1 where there is a contact, else 0
    link: Int[Tensor, "n k"]
    pressure: Float[Tensor, "n k"]  # normal force [N]
    jacobian: Float[Tensor, "n k 3 n_dof"]  # motion of the point by each joint
    spin: Float[Tensor, "n k 3 n_dof"]  # rotation of its link by each joint

    def hardest(self, count: int) -> Pressing:
        """The contacts that press hardest."""
        return Pressing(**{f.name: getattr(self, f.name)[:, :count] for f in fields(self)})


def pressing(hand: Hand, contacts: Sequence[ContactForces], joints: Float[Tensor, "n n_dof"], most: int) -> Pressing:
    """The contacts that press hardest, of each grasp, with the hand at these joints."""
    tree, (normal, arm, point, link, pressure, on) = hand.tree, hardest(contacts, most)
    normal, arm, point, pressure, on = (torch.from_numpy(table).to(joints) for table in (normal, arm, point, pressure, on))
    link = torch.from_numpy(link).to(joints.device).clamp_min(0)
    pose = tree.forward(joints)
    axes = tree.motion_axes(pose)[1]
    spin = torch.einsum("nkl,nlc,ld->nkcd", tree.descends[link].to(axes), axes, tree.link_coupling)
    moves = hand.movable * on[..., None, None]
    return Pressing(normal, arm, on, link, pressure, tree.point_jacobian(pose, point, link) * moves, spin * moves)


def hardest(contacts: Sequence[ContactForces], most: int) -> tuple[Shaped[np.ndarray, "n k *_"], ...]:
    """Normal, arm, point, link, pressure and whether there is a contact, of those that press hardest in each grasp."""
    n = len(contacts)
    normal, arm, point = np.zeros((3, n, most, 3))
    normal[..., 2] = 1.0
    link, (pressure, on) = np.zeros((n, most), int), np.zeros((2, n, most))
    for i, c in enumerate(contacts):
        kept = np.argsort(-c.pressure)[:most]
        for table, values in ((normal, c.normal), (arm, c.arm), (point, c.point), (link, c.link), (pressure, c.pressure)):
            table[i, :len(kept)] = values[kept]
        on[i, :len(kept)] = 1
    return normal, arm, point, link, pressure, on


def by_link(force: Float[Tensor, "n k"], contacts: Pressing) -> Float[Tensor, "n k"]:
    """For each contact, the force of all contacts of its link."""
    same = (contacts.link[:, :, None] == contacts.link[:, None]) * contacts.on[:, None]
    return (same * force[:, None]).sum(-1) * contacts.on
