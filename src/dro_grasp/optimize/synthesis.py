"""Synthesis: grasps from geometry alone, by annealed descent of the grasp energy from many starts at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp._version import __version__
from dro_grasp.devices import Rows
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.geometry.se3 import roma, turned_about
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import DEPTH, ENERGY_TERM
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked, checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.contacts import ContactConfig
from dro_grasp.optimize.grasp_energy import TERMS, EnergyConfig, Evaluation, GraspEnergy
from dro_grasp.optimize.starts import StartConfig, starts

PROVENANCE = f"dro-grasp {__version__}, synthesis 2"
"""Provenance of synthesized grasps; the number counts up when the method changes."""


@dataclass(frozen=True)
class SynthesisConfig(Checked):
    """The optimiser. Source of the scheme: DexGraspNet's annealed Langevin steps; the numbers are ours."""

    steps: int = 120
    """Steps. Longer descents lower the energy further and yield less an hour, since simulation settles the grasps."""
    batch_size: int = 128
    """Grasps optimised at once; the result of a seed depends on it."""
    translation_step: float = 0.003
    """First step of the wrist's translation [m]."""
    rotation_step: float = 0.03
    """First step of its rotation [rad]."""
    joint_step: float = 0.04
    """First step of each joint [rad; for sliding joints in their tree's unit]."""
    last_step: float = 0.15
    """Step length at the end, as a share of the first."""
    smoothing: float = 0.9
    """Memory of the mean squared gradient that scales the steps."""
    switch: float = 0.3
    """Probability that a step also moves one contact to another candidate."""
    temperature: float = 1.0
    """Energy increase accepted with probability 1/e at the start; falls to `last_temperature`."""
    last_temperature: float = 0.02
    """The temperature at the end."""
    device: str = "cpu"
    """Where energies are computed. Random numbers are drawn on the CPU, so that a seed means the same everywhere."""
    energy: EnergyConfig = field(default_factory=lambda: EnergyConfig(filled=True))
    """Weights of the energy's terms."""
    starts: StartConfig = field(default_factory=StartConfig)
    """Where hands start."""
    contacts: ContactConfig = field(default_factory=ContactConfig)
    """Which links touch."""


@dataclass(frozen=True)
class State(Rows):
    """n grasps during the optimisation."""

    T: Float[Tensor, "n 4 4"]  # T_object_wrist [m]
    q: Float[Tensor, "n n_dof"]
    contacts: Int[Tensor, "n c"]
    slots: Int[Tensor, "n c"]  # the slot that each contact draws its candidates from
    result: Evaluation


@checked
def synthesize(hand: Hand, obj: ObjectModel, num: int, seed: int = 0, config: SynthesisConfig | None = None) -> GraspBatch:
    """Synthesize grasps of an object by a hand, lowest energy first, not evaluated.

    Args:
        hand: Any hand.
        obj: An object with a mesh.
        num: Grasps to return.
        seed: The same seed gives the same grasps.
        config: The optimiser.

    Raises:
        OptionError: `num` is not positive.
        ObjectError: The object is a bare cloud; it needs a mesh.
    """
    if num < 1:
        raise OptionError(f"num is {num}; ask for at least one grasp")
    config = config or SynthesisConfig()
    if obj.is_cloud:
        raise ObjectError(f"object '{obj.name}' is a bare point cloud; synthesis needs a mesh")
    energy = GraspEnergy.of_object(hand, obj, config.energy, config.contacts, config.device)
    return synthesize_with(energy, obj, num, seed, config)


@torch.no_grad()
def synthesize_with(
    energy: GraspEnergy, obj: ObjectModel, num: int, seed: int, config: SynthesisConfig,
    progress: Callable[[int, int], None] | None = None,
) -> GraspBatch:
    """The same with an energy that is there already, on its device; a bare cloud will do.

    `progress` is called with (grasps optimised, grasps wanted).
    """
    hand, generator = energy.source, torch.Generator().manual_seed(seed)
    surface, centre = torch.as_tensor(obj.cloud, dtype=torch.float32), energy.centre.cpu()
    surroundings = energy.workspace.to("cpu").surroundings
    parts = []
    for begin in range(0, num, config.batch_size):
        size = min(config.batch_size, num - begin)
        start = starts(hand, obj.distance_field, surface, centre, size, config.starts, generator, surroundings)
        end = descend(energy, *start, config, generator)
        parts.append([x.cpu() for x in (end.T, end.q, end.result.terms, end.result.total, depth(energy, end))])
        if progress is not None:
            progress(begin + size, num)
    T, q, terms, totals, depths = (torch.cat(part) for part in zip(*parts, strict=True))
    T[:, :3, :3] = torch.as_tensor(roma.special_procrustes(T[:, :3, :3]))
    columns = {DEPTH: depths} | {f"{ENERGY_TERM}{name}": terms[:, i] for i, name in enumerate(TERMS)}
    batch = GraspBatch.create(hand, obj, T, q, energy=totals, seed=seed, provenance=PROVENANCE, extra=columns)
    return batch.sorted_by_energy()


def depth(energy: GraspEnergy, state: State) -> Float[Tensor, " n"]:
    """Deepest penetration of any of the hand's surface points in the object [m]."""
    points = energy.hand.points(state.q, state.T)
    return -energy.field.distances(points)[0].amin(-1).clamp_max(0)


def descend(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: SynthesisConfig,
    generator: torch.Generator,
) -> State:
    """Run n grasps from where they start, all on the CPU, to the end of the annealing."""
    n, device = len(T), energy.centre.device
    T, q = T.to(device), q.to(device)
    slots = energy.candidates.assign(n, config.contacts.idle, generator).to(device)
    contacts = energy.candidates.draw(n, generator).to(device).gather(1, slots)
    state = State(T, q, contacts, slots, energy(T, q, contacts))
    squares = _squares(state.result)
    for step in range(config.steps):
        left = 1 - step / config.steps
        pace = config.last_step + (1 - config.last_step) * left
        temperature = config.last_temperature * (config.temperature / config.last_temperature) ** left
        proposal = propose(energy, state, squares, pace, config, generator)
        rise = proposal.result.total - state.result.total
        accepted = torch.rand(n, generator=generator).to(device) < torch.exp(-rise.clamp_min(0) / temperature)
        state = proposal.where(accepted, state)
        squares = config.smoothing * squares + (1 - config.smoothing) * _squares(state.result)
    return state


def propose(
    energy: GraspEnergy, state: State, squares: Float[Tensor, "n k"], pace: float, config: SynthesisConfig,
    generator: torch.Generator,
) -> State:
    """A step down the gradient, scaled per coordinate, with some contacts moved to other candidates."""
    scale = 1 / squares.sqrt().clamp_min(1e-3)
    move, turn = (-pace * state.result.by_pose * scale[:, :6]).split(3, -1)
    bend = -pace * state.result.by_joint * scale[:, 6:]
    T = turned_about(state.T, energy.pivot(state.T), config.translation_step * move, config.rotation_step * turn)
    hand = energy.hand
    q = (state.q + config.joint_step * hand.tree.joint_unit * bend).clamp(hand.lower, hand.upper)
    contacts = switched(energy, state, config.switch, generator)
    return State(T, q, contacts, state.slots, energy(T, q, contacts))


def switched(energy: GraspEnergy, state: State, probability: float, generator: torch.Generator) -> Int[Tensor, "n c"]:
    """Contacts with one of some grasps drawn anew from its slot."""
    n, c = state.contacts.shape
    slot = torch.randint(c, (n,), generator=generator)
    chance = torch.rand(n, generator=generator) < probability
    fresh = energy.candidates.draw(n, generator).to(state.slots.device).gather(1, state.slots)
    change = (chance[:, None] & (torch.arange(c) == slot[:, None])).to(state.slots.device)
    return torch.where(change, fresh, state.contacts)


def _squares(result: Evaluation) -> Float[Tensor, "n k"]:
    """Squared gradient of each coordinate; the three of a translation or rotation share theirs."""
    move, turn = (part.square().sum(-1, keepdim=True).expand(-1, 3) for part in result.by_pose.split(3, -1))
    return torch.cat([move, turn, result.by_joint.square()], -1)
