"""Payload: the largest mass that a squeezing hand holds whichever way gravity pulls, without simulating it.

Servos are springs that pull joints to their targets, so a hand that squeezes answers a load by itself, as far as it gives way.
Contact forces within their friction cones make the energy least that the springs store, and what still stays of the load moves
the object. Source: Cutkosky and Kao 1989 for springs of a grasp, Moreau's least energy for dry friction; ours otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.devices import Rows
from dro_grasp.geometry.contact_forces import GRAVITY, LEVER, friction_cone
from dro_grasp.hands.effort import find_efforts
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.simulation.outcome import FORCES
from dro_grasp.simulation.pressure import Pressing, by_link
from dro_grasp.simulation.protocols import Protocol


@dataclass(frozen=True)
class PayloadConfig(Checked):
    """How payloads are predicted (ours)."""

    friction: float = 0.5
    """Coefficient of friction. Source: protocol `carry`."""
    torsion: float = 0.005
    """Torsional friction [m]. Source: protocol `carry`."""
    contacts: int = 20
    """Most contacts of a grasp that count, those that press hardest: with 12, the ranks of payloads agree less."""
    edges: int = 6
    """Edges of the pyramid that stands for a friction cone, of the same area across."""
    least: float = 0.01
    """Smallest mass that is tried [kg]; a grasp that does not hold it has a payload of 0."""
    most: float = 20.0
    """Largest mass that is tried [kg], and largest payload."""
    masses: int = 12
    """Masses that are tried, each a multiple of the one before."""
    servo: float = 3.0
    """Stiffness of the servos [Nm/rad]."""
    give: float = 0.02
    """Farthest that the object may move [m]. Source: protocol `carry`."""
    turn: float = math.radians(15)
    """Farthest that it may turn [rad]. Source: protocol `carry`."""
    remainder: float = 30.0
    """What of the load the contacts leave, moves the object as a spring of this stiffness would [N/m]."""
    unheld: float = 0.3
    """Largest share of the load that the contacts may leave."""
    softness: float = 2e-4
    """How far contacts give way [m/N]."""
    iterations: int = 80
    """Steps of the solver."""
    penalty: float = 0.2
    """Penalty of the solver beside the mean curvature."""


@dataclass(frozen=True)
class Squeezes(Rows):
    """How hard each of n hands squeezes for whatever mass: as it does anyhow, and in addition for the weight."""

    hand: Hand
    joints: Float[Tensor, "n n_dof"]  # of the closed hands [rad or m]
    base: Float[Tensor, "n n_dof"]  # targets that squeeze anyhow [rad or m]
    torques: Float[Tensor, "n n_dof"]  # for each kilogram [Nm or N]
    forces: Float[Tensor, "n k"]  # normal forces of the contacts for each kilogram [N]
    contacts: Pressing
    stiffness: float  # of the servos [Nm/rad]
    max_force: float = math.inf  # of the contacts of a link [N]

    def rows(self, index: Bool[Tensor, " n"]) -> Squeezes:
        """Some of the hands."""
        own = {name: getattr(self, name)[index] for name in ("joints", "base", "torques", "forces")}
        return replace(self, contacts=self.contacts.rows(index), **own)

    def targets(self, mass: Float[Tensor, "n m"]) -> Float[Tensor, "n m n_dof"]:
        """Targets for these masses [kg] of each hand.

        As little is added as keeps every joint within its effort and every link's force under `max_force`. All torques
        shrink alike, as others would not balance.
        """
        unit, tree = self.hand.tree.joint_unit**2 / self.stiffness, self.hand.tree
        base, anyhow = self.base, self.contacts.pressure
        left = (find_efforts(self.hand).limit - ((base - self.joints) / unit).abs()).clamp_min(0)
        share = (left[:, None] / (mass[..., None] * self.torques.abs()[:, None]).clamp_min(1e-9)).amin(-1)
        if math.isfinite(self.max_force):
            before, added = (by_link(x, self.contacts) for x in (anyhow, self.forces))
            spare = (self.max_force - before).clamp_min(0)
            share = torch.minimum(share, (spare[:, None] / (mass[..., None] * added[:, None]).clamp_min(1e-9)).amin(-1))
        added_torques = mass[..., None] * share.clamp_max(1)[..., None] * self.torques[:, None]
        return (base[:, None] + added_torques * unit).clamp(tree.lower, tree.upper)


def servo_torques(
    hand: Hand, joints: Float[Tensor, "*n n_dof"], targets: Float[Tensor, "*n n_dof"], rules: Protocol
) -> Float[Tensor, "*n n_dof"]:
    """What the servos of a protocol's scene exert with the hand at these joints, at rest [Nm or N]."""
    limit = find_efforts(hand).limit if rules.effort else rules.force_limit / hand.tree.joint_unit
    return _springs(hand, joints, targets, rules.stiffness, limit)


def _springs(
    hand: Hand, joints: Float[Tensor, "*n n_dof"], targets: Float[Tensor, "*n n_dof"], stiffness: float,
    limit: Float[Tensor, " n_dof"],
) -> Float[Tensor, "*n n_dof"]:
    return ((targets - joints) * stiffness / hand.tree.joint_unit**2).clamp(-limit, limit) * hand.movable


def payloads(
    squeezes: Squeezes, shift: Float[Tensor, " n"], turn: Float[Tensor, " n"], config: PayloadConfig | None = None
) -> Float[Tensor, " n"]:
    """The largest mass that each hand holds, where it squeezes for it [kg].

    Args:
        squeezes: How hard the hands squeeze.
        shift: How far closing has moved the object already [m].
        turn: How far it has turned it [rad].
        config: Physics and solver.
    """
    config = config or PayloadConfig()
    if not len(shift):
        return shift
    masses = torch.logspace(math.log10(config.least), math.log10(config.most), config.masses).to(shift)
    moved, turned = given_way(squeezes, masses, config)
    room = (config.give - shift).clamp_min(LEAST_ROOM * config.give), (config.turn - turn).clamp_min(LEAST_ROOM * config.turn)
    used = torch.maximum(moved.amax(-1) / room[0][:, None], turned.amax(-1) / room[1][:, None])
    left = config.remainder * moved.amax(-1) / (GRAVITY * masses)
    used = torch.maximum(used, left / config.unheld)
    return _crossing(masses, used)


LEAST_ROOM = 0.4  # Share of what an object may move that is left to it however far closing moved it (ours)


def given_way(
    squeezes: Squeezes, masses: Float[Tensor, " m"], config: PayloadConfig
) -> tuple[Float[Tensor, "n m 6"], Float[Tensor, "n m 6"]]:
    """How far each mass, pulled along each of FORCES, moves [m] and turns [rad] the object in each hand."""
    n, m, touch = len(squeezes.joints), len(masses), squeezes.contacts
    wrench, torque, hessian = generators(touch, config)
    soft = squeezes.hand.tree.joint_unit**2 / config.servo
    targets = squeezes.targets(masses.expand(n, m))
    joints, limit = squeezes.joints[:, None].expand_as(targets), find_efforts(squeezes.hand).limit
    springs = _springs(squeezes.hand, joints, targets, squeezes.stiffness, limit)
    pulls = torch.as_tensor(FORCES).to(masses)
    load = GRAVITY * masses[:, None, None] * torch.cat([pulls, torch.zeros_like(pulls)], 1)
    stored = (springs * soft) @ torque
    slope = stored[:, :, None] - (load.flatten(0, 1) @ wrench).unflatten(1, (m, 6)) / config.remainder
    hessian = hessian + torque.mT @ (torque * soft[:, None]) + wrench.mT @ wrench / config.remainder
    amounts = _least_energy(hessian, slope.flatten(1, 2).mT, config)
    left = (wrench @ amounts).mT.unflatten(1, (m, 6)) + load
    return left[..., :3].norm(dim=-1) / config.remainder, left[..., 3:].norm(dim=-1) / (config.remainder * LEVER)


def generators(
    touch: Pressing, config: PayloadConfig
) -> tuple[Float[Tensor, "n 6 g"], Float[Tensor, "n n_dof g"], Float[Tensor, "n g g"]]:
    """Of each edge of a cone, and of torsion either way: wrench, torques of joints, and compliance of the contacts."""
    corner = 2 * math.pi / config.edges
    cone = friction_cone(touch.normal, config.friction * math.sqrt(corner / math.sin(corner)), config.edges)
    force = torch.cat([cone, touch.normal[:, :, None].expand(-1, -1, 2, -1)], 2) * touch.on[..., None, None]
    twist = torch.zeros_like(force)
    twist[:, :, -2], twist[:, :, -1] = (sign * config.torsion * touch.on[..., None] * touch.normal for sign in (1, -1))
    moment = torch.linalg.cross(touch.arm[:, :, None].expand_as(force), force) + twist
    wrench = torch.cat([force, moment / LEVER], -1).flatten(1, 2).mT
    torque = torch.einsum("nkgc,nkcd->nkgd", force, touch.jacobian) + torch.einsum("nkgc,nkcd->nkgd", twist, touch.spin)
    own = config.softness * force @ force.mT
    g = force.shape[2]
    hessian = wrench.new_zeros(*wrench.shape[:1], wrench.shape[2], wrench.shape[2])
    for i in range(force.shape[1]):
        hessian[:, i * g:(i + 1) * g, i * g:(i + 1) * g] = own[:, i]
    return wrench, torque.flatten(1, 2).mT, hessian


def _least_energy(
    hessian: Float[Tensor, "n g g"], slope: Float[Tensor, "n g c"], config: PayloadConfig
) -> Float[Tensor, "n g c"]:
    """Minimise x H x / 2 - s x over x >= 0. Source: Boyd et al. 2011 (ADMM, over-relaxed)."""
    rho = config.penalty * hessian.diagonal(dim1=1, dim2=2).mean(-1).clamp_min(1e-9)[:, None, None]
    # With two threads, the batched LU of MKL in torch 2.13 fails from 129 unknowns on; Cholesky does not.
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(hessian + rho * torch.eye(hessian.shape[-1]).to(hessian)))
    z, dual = torch.zeros_like(slope), torch.zeros_like(slope)
    for _ in range(config.iterations):
        x = RELAXED * (inverse @ (slope + rho * (z - dual))) + (1 - RELAXED) * z
        z = (x + dual).clamp_min(0)
        dual = dual + x - z
    return z


RELAXED = 1.6  # Over-relaxation. Source: Boyd et al. 2011


def _crossing(masses: Float[Tensor, " m"], used: Float[Tensor, "n m"]) -> Float[Tensor, " n"]:
    """Where `used` exceeds 1 after the largest mass at which it does not, by logarithms; 0 where it does at all masses."""
    # A squeeze that is not quite balanced moves light objects more than their weight does, so the smallest masses may exceed.
    held, numbers, log = used <= 1, torch.arange(len(masses), device=used.device), masses.log()
    last = torch.where(held, numbers, -1).amax(1)
    rows = torch.arange(len(used), device=used.device)
    before, use = last.clamp(0, len(masses) - 2), used.clamp_min(1e-6).log()
    low, high = use[rows, before], use[rows, before + 1]
    between = (log[before] - low / (high - low).clamp_min(1e-6) * (log[before + 1] - log[before])).exp()
    found = torch.where(last == len(masses) - 1, masses[-1], between)
    return torch.where(last < 0, torch.zeros_like(found), found)
