"""Forces of closed hands: what presses where, what joints exert, and what mass each grasp carries.

Three answers to the last. What a squeezing hand holds by itself is predicted (see `payload`), or weighed in simulation (see
`weighing`). A linear program says what the contacts as they are allow at most, with forces that suit each direction
of gravity. Source of the program: Kerr and Roth 1986, with gravity from all sides; ours otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.contact_forces import GRAVITY
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import complete
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel, solid_of
from dro_grasp.simulation.grasp_state import WeightConfig, squeezes_of
from dro_grasp.simulation.outcome import FORCES
from dro_grasp.simulation.payload import PayloadConfig, Squeezes, generators, payloads, servo_torques
from dro_grasp.simulation.pressure import ContactForces, contact_forces
from dro_grasp.simulation.protocols import Protocol, protocol as find_protocol
from dro_grasp.simulation.rollout import Rollout, rollouts
from dro_grasp.simulation.scene import scene_of
from dro_grasp.simulation.weighing import weighed


@dataclass(frozen=True)
class GraspForces:
    """Forces of n grasps of one object."""

    grasp_contacts: tuple[ContactForces, ...]
    """Contacts with the object where the servos' targets are the joints of the grasp."""
    squeeze_contacts: tuple[ContactForces, ...]
    """The same at the squeeze."""
    grasp_torque: Float[Tensor, "n n_dof"]
    """Torques of the joints there [Nm, N where they slide]."""
    squeeze_torque: Float[Tensor, "n n_dof"]
    """The same at the squeeze."""
    payload: Float[Tensor, " n"]
    """Largest mass that each grasp holds whichever way gravity pulls, where it squeezes as stated and for its weight [kg]."""
    largest_payload: Float[Tensor, " n"]
    """What the contacts as they are, friction and efforts allow, if every contact pressed as it should [kg]."""

    @property
    def squeeze_force(self) -> Float[Tensor, " n"]:
        """Sum of the normal forces on the object at the squeeze [N]."""
        return torch.tensor([c.pressure.sum() for c in self.squeeze_contacts], dtype=torch.float32)


def find_forces(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, protocol: str | Protocol = "carry", *, config: WeightConfig | None = None,
    weigh: bool = False, workers: int | None = None,
) -> GraspForces:
    """Close hands gradually in simulation and read the forces.

    Args:
        hand: The hand of the grasps.
        obj: Their object; balls stand for a bare cloud.
        grasps: The controller makes each pregrasp and squeeze that a grasp does not state.
        protocol: Physics of the closing.
        config: How grasps squeeze for a weight; by default as usual, with the protocol's stiffness.
        weigh: Try a few masses in simulation, instead of predicting the payload: nearer to what trials say, in ten times the
            time.
        workers: Threads; all cores by default.

    Raises:
        HandError: The hand came without its description.
        GraspFileError: The grasps are of another hand.
        OptionError: The protocol does not exist.
    """
    obj, rules = solid_of(obj), replace(find_protocol(protocol), gradual=True, closing=True)
    config = config or WeightConfig(stiffness=rules.stiffness)
    whole = complete(hand, grasps, torch.as_tensor(obj.centre_of_mass, dtype=torch.float32))
    nothing, none = grasps.joints[:0], grasps.joints.new_zeros(0)
    parts = [GraspForces((), (), nothing, nothing, none, none)]
    for part, rollout in rollouts(scene_of(hand, obj, whole, rules), hand, whole, workers):
        parts.append(_forces(rollout, part, config, weigh))
    return GraspForces(
        tuple(one for part in parts for one in part.grasp_contacts),
        tuple(one for part in parts for one in part.squeeze_contacts),
        torch.cat([part.grasp_torque for part in parts]), torch.cat([part.squeeze_torque for part in parts]),
        torch.cat([part.payload for part in parts]), torch.cat([part.largest_payload for part in parts]))


def _forces(rollout: Rollout, grasps: GraspBatch, config: WeightConfig, weigh: bool) -> GraspForces:
    """Both halves of the closing, and what is read after each."""
    hand, begin, seen, rules = rollout.scene.hand, rollout.start, [], rollout.scene.protocol
    for first, last, wanted in ((0, 1, grasps.joints), (1, None, grasps.squeeze_joints)):
        closed, joints = rollout.close(first, last), torch.from_numpy(rollout.poses()[0]).to(grasps.joints)
        seen.append((tuple(contact_forces(rollout)), servo_torques(hand, joints, wanted, rules)))
    (before, weak), (after, firm) = seen
    chosen = squeezes_of(hand, list(after), joints, grasps.squeeze_joints, config)
    shift, turn = (torch.from_numpy(x).to(joints) for x in (closed.shift(begin), closed.turn(begin)))
    payload = payloads(chosen, shift, turn, config.payload)
    if weigh:
        payload = weighed(rollout, chosen, payload, config)
    return GraspForces(before, after, weak, firm, payload, largest_payloads(chosen, config.payload).to(payload))


def largest_payloads(chosen: Squeezes, config: PayloadConfig) -> Float[Tensor, " n"]:
    """The largest mass that forces of contacts balance along each of FORCES, whatever forces these are [kg]."""
    wrench, torque, _ = (x.double().numpy() for x in generators(chosen.contacts, config))
    effort = find_efforts(chosen.hand).limit.double().numpy()
    on = (np.abs(wrench).sum(1) > 0)
    return torch.tensor([largest_payload(w[:, g], t[:, g], effort) for w, t, g in zip(wrench, torque, on, strict=True)])


def largest_payload(
    wrench: Float[np.ndarray, "6 g"], torque: Float[np.ndarray, "n_dof g"], effort: Float[np.ndarray, " n_dof"]
) -> float:
    """The largest mass that g forces of any amounts balance along each of FORCES, within the efforts [kg]; 0 without any.

    Amounts are scaled to a weight of 1 N per direction; then the largest share of an effort is least.
    """
    from scipy.optimize import linprog  # slow to load, and rarely wanted
    from scipy.sparse import block_diag, csr_matrix, hstack

    g, n, count = wrench.shape[1], len(effort), len(FORCES)
    if g == 0:
        return 0.0
    shares = torque / effort[:, None]
    # Variables: amounts for each direction, effort's share t.
    equal = hstack([block_diag([csr_matrix(wrench)] * count), csr_matrix((6 * count, 1))])
    load = np.concatenate([np.concatenate([-f, np.zeros(3)]) for f in FORCES])
    both = np.vstack([shares, -shares])
    bound = hstack([block_diag([csr_matrix(both)] * count), csr_matrix(-np.ones((2 * n * count, 1)))])
    cost = np.zeros(g * count + 1)
    cost[-1] = 1
    done = linprog(cost, bound, np.zeros(2 * n * count), equal, load, method="highs")
    return 1 / (GRAVITY * max(done.x[-1], 1e-9)) if done.status == 0 else 0.0
