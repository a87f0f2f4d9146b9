"""The score of grasps whose closing was simulated: the calibrated log-odds that they hold under `carry`.

A small model on what is known of each grasp for nothing once its closing was simulated. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from dro_grasp.devices import Rows
from dro_grasp.network.checkpoints import SHIPPED_FOLDER, load_small
from dro_grasp.simulation.grasp_state import GraspState
from dro_grasp.simulation.protocols import CARRY

SHIPPED_HOLDING = SHIPPED_FOLDER / "ranking" / "holding.safetensors"  # The model that ships
LEAST_MOTION = 1e-4  # Motions below this look alike [m, rad, m/s, rad/s] (ours)
MOST_MOTION = 0.1  # Motions of an object above this look alike: it is lost [m] (ours)
LEAST_TURN = 1e-3  # Turns under the weight below this look alike [rad] (ours)
LEAST_MASS = 1e-3  # Masses below this look alike [kg] (ours)
DEEP = 0.01  # Depths above this look alike [m] (ours)
FEATURES = 20  # Numbers of each grasp that the model sees; see `holding_features`


@dataclass(frozen=True)
class Evidence(Rows):
    """What the simulated closing of n grasps showed; NaN where it was not simulated or lost the object at once."""

    moved: Float[Tensor, " n"]
    """How far the first closing moved the object [m]."""
    stable: Bool[Tensor, " n"]
    """Whether the grasp settled: it holds still, and no link is too deep."""
    depth: Float[Tensor, " n"]
    """Deepest penetration before the last closing [m]."""
    effort: Float[Tensor, " n"]
    """Largest share of its effort with which a joint squeezes."""
    mass: Float[Tensor, " n"]
    """The object's mass [kg]."""
    state: GraspState
    """How the object is held after the last closing."""

    def rows(self, index: Int[Tensor, " k"] | Bool[Tensor, " n"]) -> Evidence:
        """Some of the rows."""
        own = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "state"}
        return Evidence(**own, state=self.state.rows(index))

    @staticmethod
    def none(n: int, mass: float) -> Evidence:
        """Nothing is known of n grasps but the object's mass [kg]."""
        unknown = torch.full((n,), torch.nan)
        pair = torch.full((n, 2), torch.nan)
        state = GraspState(**{f.name: unknown for f in fields(GraspState)} | {"unanswered": pair, "gave": pair})
        return Evidence(unknown, torch.zeros(n, dtype=torch.bool), unknown, unknown, torch.full((n,), mass), state)

    def known(
        self, rows: Int[Tensor, " k"], depth: Float[Tensor, " k"], effort: Float[Tensor, " k"], state: GraspState,
    ) -> Evidence:
        """The same with what the last closing showed of some rows."""
        def put(old: Float[Tensor, "n *rest"], new: Float[Tensor, "k *rest"]) -> Float[Tensor, "n *rest"]:
            found = old.clone()
            found[rows] = new.to(old)
            return found

        filled = GraspState(**{f.name: put(getattr(self.state, f.name), getattr(state, f.name)) for f in fields(GraspState)})
        return replace(self, depth=put(self.depth, depth), effort=put(self.effort, effort), state=filled)


def gives_way(state: GraspState) -> Bool[Tensor, " n"]:
    """Which objects the weight moves or turns farther than `carry` allows; those that were not pulled do not count."""
    return (state.gave[:, 0] > CARRY.max_displacement) | (state.gave[:, 1] > CARRY.max_rotation)


def holding_features(score: Float[Tensor, " n"], known: Evidence) -> Float[Tensor, "n features"]:
    """The model's inputs, from what the ranking network says of grasps [log-odds] and what closing showed; NaN: unknown."""
    state, limits = known.state, torch.tensor([CARRY.max_displacement, CARRY.max_rotation])
    # What gives way is not pulled on, so that how far it would have gone plays no role.
    gave = torch.where(gives_way(state)[:, None], limits, state.gave).clamp_min(torch.tensor([LEAST_MOTION, LEAST_TURN])).log()
    motion = torch.stack([state.shift, state.turn, state.speed, state.spin], 1).clamp_min(LEAST_MOTION).log()
    amounts = torch.stack([state.contacts, state.links, state.pressure, known.effort], 1).log1p()
    moved = known.moved.clamp(LEAST_MOTION, MOST_MOTION).log()
    flags = torch.stack([known.stable, known.moved.isfinite(), state.shift.isfinite()], 1).to(score)
    single = torch.stack([score, moved, known.depth.clamp(0, DEEP) / DEEP, known.mass.clamp_min(LEAST_MASS).log(),
                          state.slip.clamp_max(2)], 1)
    return torch.cat([single, motion, amounts, state.unanswered, gave, flags], 1)


class HoldingScore(nn.Module):
    """A small network on some twenty numbers of each grasp, and the calibration of what it says."""

    mean: Float[Tensor, " features"]  # of each number over the training grasps, as their `deviation`
    deviation: Float[Tensor, " features"]
    weight: Float[Tensor, " trials"]  # of each kind of trial in the rank of a grasp
    calibration: Float[Tensor, "3"]
    """Offset, and what a unit of rank is worth below zero and above it; neither is negative."""

    def __init__(self, trials: int, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(FEATURES, width), nn.SiLU(), nn.Linear(width, trials))
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))
        self.register_buffer("weight", torch.full((trials,), 1 / trials))
        self.register_buffer("calibration", torch.tensor([0.0, 1.0, 1.0]))

    def forward(self, features: Float[Tensor, "n features"]) -> Float[Tensor, "n trials"]:
        """Log-odds of success in each kind of trial; for the argument see `holding_features`. Unknown numbers are as usual."""
        return self.layers(((features - self.mean) / self.deviation).nan_to_num(0.0))

    def rank(self, features: Float[Tensor, "n features"]) -> Float[Tensor, " n"]:
        """Weighted mean of the log-odds, by which grasps are compared."""
        return self(features) @ self.weight

    def calibrated(self, rank: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Log-odds of holding under `carry` of a grasp that is returned with this rank: monotone, so the order stays."""
        offset, below, above = self.calibration
        return offset + below * rank.clamp_max(0) + above * rank.clamp_min(0)


@torch.no_grad()
def holding_score(score: Float[Tensor, " n"], known: Evidence) -> Float[Tensor, " n"]:
    """Calibrated log-odds of holding under `carry`; comparable among hands and objects. Arguments as above."""
    model = shipped_holding_score()
    return model.calibrated(model.rank(holding_features(score, known)))


def load_holding_score(path: Path) -> HoldingScore:
    """Read a model."""
    return load_small(
        path, lambda tensors: HoldingScore(len(tensors["layers.2.bias"]), len(tensors["layers.0.bias"])),
        "a score of settled grasps; train it again (`python -m lab.recipe.holding`)")


@cache
def shipped_holding_score() -> HoldingScore:
    """The model that ships, loaded once per process."""
    return load_holding_score(SHIPPED_HOLDING)
