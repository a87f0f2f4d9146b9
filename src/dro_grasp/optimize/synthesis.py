"""Synthesis: grasps from geometry alone, by annealed descent of the grasp energy from many starts at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp._version import __version__
from dro_grasp.devices import Rows, at_once, on_device
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.geometry.se3 import roma, turned_about
from dro_grasp.graphs import repeat
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import DEPTH, ENERGY_TERM
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked, checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.contacts import ContactCandidates, ContactConfig
from dro_grasp.optimize.grasp_energy import TERMS, EnergyConfig, Evaluation, GraspEnergy
from dro_grasp.optimize.starts import Drawn, StartConfig, approach, draw_starts

PROVENANCE = f"dro-grasp {__version__}, synthesis 2"
"""Provenance of synthesized grasps; the number counts up when the method changes."""


@dataclass(frozen=True)
class SynthesisConfig(Checked):
    """The optimiser. Source of the scheme: DexGraspNet's annealed Langevin steps; the numbers are ours."""

    steps: int = 120
    """Steps. Longer descents lower the energy further and yield less an hour, since simulation settles the grasps."""
    batch_size: int = 128
    """Grasps whose random numbers are drawn at once, which the result of a seed depends on. A CPU optimises as many at once."""
    at_once: int | None = None
    """Grasps optimised at once elsewhere; None takes what suits the device. The result of a seed does not depend on it."""
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


EACH = 400e3  # Memory of a grasp in a step [bytes] (ours, counted)


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


def synthesize_with(
    energy: GraspEnergy, obj: ObjectModel, num: int, seed: int, config: SynthesisConfig,
    progress: Callable[[int, int], None] | None = None,
) -> GraspBatch:
    """The same with an energy that is there already, on its device; a bare cloud will do.

    `progress` is called with (grasps optimised, grasps wanted).
    """
    return synthesize_all([Lot(energy, obj, num, seed, config)], progress)[0]


class Lot(NamedTuple):
    """Grasps that are wanted of one object."""

    energy: GraspEnergy
    obj: ObjectModel
    num: int
    seed: int
    config: SynthesisConfig


@torch.no_grad()
def synthesize_all(lots: Sequence[Lot], progress: Callable[[int, int], None] | None = None) -> list[GraspBatch]:
    """Grasps of several objects by one hand, whose energies can be joined and whose steps are the same."""
    config, hand, wanted = lots[0].config, lots[0].energy.source, sum(lot.num for lot in lots)
    size, found, done = at_once(lots[0].energy.device, config.batch_size, EACH, config.at_once), [], 0
    for parts in _gathered((part for lot in lots for part in _drawn(lot)), size):
        energy = GraspEnergy.joined([lot.energy for lot, *_ in parts], [len(begin.gap) for _, begin, _ in parts])
        end = _optimised(energy, [begin for _, begin, _ in parts], [chances for *_, chances in parts], config)
        found.append((end.T, end.q, end.result.terms, end.result.total, depth(energy, end)))
        done += len(end.q)
        if progress is not None:
            progress(done, wanted)
    columns = [torch.cat(part).cpu().split([lot.num for lot in lots]) for part in zip(*found, strict=True)]
    return [_sorted(hand, lot, *own) for lot, *own in zip(lots, *columns, strict=True)]


def _sorted(
    hand: Hand, lot: Lot, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], terms: Float[Tensor, "n 6"],
    totals: Float[Tensor, " n"], depths: Float[Tensor, " n"],
) -> GraspBatch:
    """The grasps of one object, lowest energy first."""
    T = T.clone()
    T[:, :3, :3] = torch.as_tensor(roma.special_procrustes(T[:, :3, :3]))
    columns = {DEPTH: depths} | {f"{ENERGY_TERM}{name}": terms[:, i] for i, name in enumerate(TERMS)}
    batch = GraspBatch.create(hand, lot.obj, T, q, energy=totals, seed=lot.seed, provenance=PROVENANCE, extra=columns)
    return batch.sorted_by_energy()


Part = tuple[Lot, Drawn, "Chances"]  # Some grasps of a lot, and all that is random about them


def _gathered(parts: Iterable[Part], size: int) -> Iterator[list[Part]]:
    """Parts that are optimised at once: one at least, and no more grasps than a number."""
    kept: list[Part] = []
    for part in parts:
        if kept and sum(len(begin.gap) for _, begin, _ in (*kept, part)) > size:
            yield kept
            kept = []
        kept.append(part)
    yield kept


def _drawn(lot: Lot) -> Iterator[Part]:
    """A lot in parts of the size for which random numbers are drawn."""
    energy, obj, num, seed, config = lot
    generator, surface = torch.Generator().manual_seed(seed), torch.as_tensor(obj.cloud, dtype=torch.float32)
    surroundings, centre = energy.workspace.to("cpu").surroundings, energy.centre.cpu()
    candidates = on_device(energy.candidates, "cpu")
    for first in range(0, num, config.batch_size):
        n = min(config.batch_size, num - first)
        begin = draw_starts(energy.source, surface, centre, n, config.starts, generator, surroundings)
        yield lot, begin, Chances.draw(candidates, n, config, generator)


def depth(energy: GraspEnergy, state: State) -> Float[Tensor, " n"]:
    """Deepest penetration of any of the hand's surface points in the object [m]."""
    points = energy.hand.points(state.q, state.T)
    return -energy.field.distances(points)[0].amin(-1).clamp_max(0)


@dataclass(frozen=True)
class Chances:
    """What is random about the descents of n grasps, step by step."""

    slots: Int[Tensor, "n c"]  # the slot that each contact draws its candidates from
    contacts: Int[Tensor, "n c"]  # candidates at the start
    fresh: Int[Tensor, "steps n c"]  # candidates to which a step may move a contact
    changes: Bool[Tensor, "steps n c"]  # which contact it moves
    luck: Float[Tensor, "steps n"]  # a step is accepted whose probability is greater

    @staticmethod
    def draw(candidates: ContactCandidates, n: int, config: SynthesisConfig, generator: torch.Generator) -> Chances:
        """Draw for n grasps, from candidates on the CPU."""
        slots = candidates.assign(n, config.contacts.idle, generator)
        contacts, steps = candidates.draw(n, generator).gather(1, slots), []
        own = torch.arange(slots.shape[1])
        for _ in range(config.steps):
            slot = torch.randint(slots.shape[1], (n,), generator=generator)
            chance = torch.rand(n, generator=generator) < config.switch
            fresh = candidates.draw(n, generator).gather(1, slots)
            steps.append((fresh, chance[:, None] & (own == slot[:, None]), torch.rand(n, generator=generator)))
        return Chances(slots, contacts, *(torch.stack(part) for part in zip(*steps, strict=True)))

    @staticmethod
    def joined(parts: Sequence[Chances], device: torch.device) -> Chances:
        """Those of all parts, one after the other, on a device."""
        axes = {"slots": 0, "contacts": 0, "fresh": 1, "changes": 1, "luck": 1}
        return Chances(*(torch.cat([getattr(part, name) for part in parts], axis).to(device) for name, axis in axes.items()))


def _optimised(
    energy: GraspEnergy, begins: Sequence[Drawn], chances: Sequence[Chances], config: SynthesisConfig
) -> State:
    """Several parts from where they start to the end of the annealing, on the energy's device."""
    begin = Drawn(*(torch.cat([getattr(part, f.name) for part in begins]).to(energy.device) for f in fields(Drawn)))
    start = approach(energy.hand, energy.field, begin, config.starts, energy.workspace.surroundings)
    return anneal(energy, *start, config, Chances.joined(chances, energy.device))


@dataclass(frozen=True)
class _Annealing(Rows):
    """Grasps on their way, and the mean squared gradient of each coordinate."""

    state: State
    squares: Float[Tensor, "n k"]


def anneal(
    energy: GraspEnergy, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], config: SynthesisConfig, chances: Chances
) -> State:
    """Run n grasps from where they start to the end of the annealing; everything is on the energy's device."""
    left = [1 - step / config.steps for step in range(config.steps)]
    paces = q.new_tensor([config.last_step + (1 - config.last_step) * share for share in left])
    cold, hot = config.last_temperature, config.temperature
    temperatures = q.new_tensor([cold * (hot / cold) ** share for share in left])

    def step(now: _Annealing, number: Int[Tensor, "1"]) -> _Annealing:
        pace, temperature, fresh, changes, luck = (
            table.index_select(0, number)[0] for table in (
                paces, temperatures, chances.fresh, chances.changes, chances.luck))
        contacts = torch.where(changes, fresh, now.state.contacts)
        proposal = propose(energy, now.state, now.squares, pace, contacts, config)
        rise = proposal.result.total - now.state.result.total
        state = proposal.where(luck < torch.exp(-rise.clamp_min(0) / temperature), now.state)
        return _Annealing(state, config.smoothing * now.squares + (1 - config.smoothing) * _squares(state.result))

    state = State(T, q, chances.contacts, chances.slots, energy(T, q, chances.contacts))
    return repeat(step, _Annealing(state, _squares(state.result)), config.steps).state


def propose(
    energy: GraspEnergy, state: State, squares: Float[Tensor, "n k"], pace: Float[Tensor, ""], contacts: Int[Tensor, "n c"],
    config: SynthesisConfig,
) -> State:
    """A step down the gradient, scaled per coordinate, with these contacts."""
    scale = 1 / squares.sqrt().clamp_min(1e-3)
    move, turn = (-pace * state.result.by_pose * scale[:, :6]).split(3, -1)
    bend = -pace * state.result.by_joint * scale[:, 6:]
    T = turned_about(state.T, state.result.pivot, config.translation_step * move, config.rotation_step * turn)
    hand = energy.hand
    q = (state.q + config.joint_step * hand.tree.joint_unit * bend).clamp(hand.lower, hand.upper)
    return State(T, q, contacts, state.slots, energy(T, q, contacts))


def _squares(result: Evaluation) -> Float[Tensor, "n k"]:
    """Squared gradient of each coordinate; the three of a translation or rotation share theirs."""
    move, turn = (part.square().sum(-1, keepdim=True).expand(-1, 3) for part in result.by_pose.split(3, -1))
    return torch.cat([move, turn, result.by_joint.square()], -1)
