"""The network as a source: placements of the open hand, z by choice, D(R,O), link poses, joints.

Source: paper section III, figure 2. Differs from the paper: a placement of the open hand is chosen first, by the caller's
direction or by the learned placement prior. Networks of the paper's form have no such prior: their wrists are turned at
random, or face the caller's direction at a random roll.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp import distance_matrix
from dro_grasp.devices import Stopwatch, one_thread, side_by_side
from dro_grasp.errors import OptionError
from dro_grasp.geometry.se3 import apply_to_cloud, compose, rotate
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.proportions import proportions
from dro_grasp.kinds import Checked
from dro_grasp.network.network import DistanceNetwork, Moves
from dro_grasp.optimize.starts import CHOICES, CLEAR, Spread, approach_cost, wrist_rotations
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import ChoiceConfig, choice_scores
from dro_grasp.predict.sources.source import Candidates, Progress, Source

HIGHEST_TEMPERATURE = 2.0  # Highest temperature that is accepted; 1 is what the weights were trained for (ours)


@dataclass(frozen=True)
class ProposalConfig(Checked):
    """How candidates are sampled and decoded."""

    rotations_per_grasp: int = 16
    """Wrist rotations offered to the placement prior for each placement, when no direction is given."""
    rolls_per_grasp: int = 8
    """Rolls about the direction that are offered instead, when one is given."""
    direction_spread: float = math.radians(5.0)
    """Standard deviation of the palm direction around the given one [rad]."""
    temperature: float | None = None
    """Spread of z: 0 proposes the likeliest grasp of each placement, 1 is as diverse as the training grasps. None takes 1,
    and `cloud_temperature` for a bare cloud."""
    cloud_temperature: float = 0.5
    """Default temperature for a bare cloud: where less of the object is known, likelier grasps are proposed."""
    prior_choices: int = 2
    """Wrist rotations among which the placement prior chooses each of those that it offers, at least."""
    choice: ChoiceConfig = field(default_factory=ChoiceConfig)
    """How one of several placements and z is chosen for each candidate."""
    batch_size: int = 16
    """Candidates that are decoded at once."""
    network_batch_size: int = 4
    """Candidates that pass the network at once; more do not fit a processor's cache."""

    def __post_init__(self) -> None:
        """Refuse a temperature out of range."""
        super().__post_init__()
        check_temperature(self.temperature)


class NetworkSource(Source):
    """The D(R,O) network with one set of weights."""

    name = "network"

    def __init__(self, network: DistanceNetwork, config: ProposalConfig | None = None) -> None:
        """Keep the two.

        Args:
            network: In evaluation mode, on the device of the problems.
            config: Sampling and batches.
        """
        self.network, self.config = network, config or ProposalConfig()

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> Candidates:
        """See `propose`."""
        generator, watch = torch.Generator().manual_seed(seed), Stopwatch("network", "choose", "decode")
        made = propose(problem, self.network, num, generator, self.config, watch, progress)
        return replace(made, seconds=watch.seconds)


def propose(
    problem: GraspProblem, network: DistanceNetwork, num: int, generator: torch.Generator,
    config: ProposalConfig | None = None, watch: Stopwatch | None = None, progress: Progress | None = None,
) -> Candidates:
    """Candidates from the network.

    Args:
        problem: Hand, object and constraints.
        network: In evaluation mode, on the problem's device.
        num: How many.
        generator: Source of randomness, on the CPU; its seed is recorded with the grasps.
        config: Sampling and batches.
        watch: Counts the seconds of `network`, `choose` and `decode`.
        progress: Called with (candidates decoded, candidates wanted).
    """
    config = config or ProposalConfig()
    watch = watch or Stopwatch()
    hand = problem.thinned(network.config.n_hand)
    cloud = problem.cloud(network.config.n_object, generator)
    rivals, draws = (config.choice.placements, config.choice.draws) if network.z_moves else (1, 1)
    with watch("network"):
        placement = _placements(problem, hand, network, cloud, num, rivals, config, generator)
        joints = hand.random_open_joints(num, generator)
        noise = network.sample_latent(num * rivals * draws, generator, _temperature(problem, config)).to(problem.device)
        noise = noise.unflatten(0, (num, rivals, draws))
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for start in range(0, num, config.batch_size):
        part = slice(start, min(start + config.batch_size, num))
        distances = _distances(problem, network, cloud, placement[part], joints[part], noise[part], config, watch)
        with watch("decode"), one_thread():
            links = distance_matrix.decode(hand, distances, cloud.expand(len(distances), -1, -1))
            solution = distance_matrix.solve(hand.limited_to_use(), links, joints[part])
            found.append((solution.T_world_wrist, solution.joints, links.points))
        if progress is not None:
            progress(part.stop, num)
    T, q, points = (torch.cat(part).cpu() for part in zip(*found, strict=True))
    grasps = GraspBatch.create(
        problem.hand, problem.obj, T, q, seed=generator.initial_seed(), provenance=f"network {network.name}")
    return Candidates(grasps, points)


def check_temperature(temperature: float | None) -> None:
    """Refuse a temperature out of range.

    Raises:
        OptionError: It is negative, not finite, or above HIGHEST_TEMPERATURE.
    """
    if temperature is not None and not 0 <= temperature <= HIGHEST_TEMPERATURE:
        raise OptionError(f"temperature is {temperature}; give 0 for the likeliest grasps, 1 for the most diverse, or a number "
                          f"between (at most {HIGHEST_TEMPERATURE:g})")


def _temperature(problem: GraspProblem, config: ProposalConfig) -> float:
    if config.temperature is not None:
        return config.temperature
    return config.cloud_temperature if problem.obj.is_cloud else 1.0


def _placements(
    problem: GraspProblem, hand: Hand, network: DistanceNetwork, cloud: Float[Tensor, "m 3"], num: int, rivals: int,
    config: ProposalConfig, generator: torch.Generator,
) -> Float[Tensor, "num rivals 4 4"]:
    """Wrist poses of the open hand near which the network is asked for grasps, in the object's frame.

    In surroundings the prior gives more of them than are wanted, those that it prefers first, and the ones with most room
    are taken; among those with all the room that they need it is the prior that chooses.
    """
    axes, surroundings = network.config.axes(hand.palm_axes_wrist), problem.surroundings
    direction, max_tilt = problem.constraints.direction, problem.constraints.max_tilt
    spread, up = Spread(config.direction_spread, max_tilt), None if surroundings is None else surroundings.up
    wanted = num * rivals
    offered = wanted if surroundings is None else max(wanted, CHOICES * num)
    count = wanted * (config.rotations_per_grasp if direction is None else config.rolls_per_grasp)
    rotations = wrist_rotations(hand, max(count, config.prior_choices * offered), direction, spread, generator, up)
    opened = hand.points(hand.canonical_joints())
    rotation, position = network.sample_placements(
        cloud, rotations @ axes, offered, generator, proportions(hand, axes))
    offset = cloud.mean(0) + rotate(rotation, position - hand.grasp_centre_wrist @ axes)
    placed = compose(rotation @ axes.mT, offset)
    if surroundings is not None:
        lack = approach_cost(hand, placed, opened, None if max_tilt else direction, surroundings)
        best = lack.argsort(stable=True)[:wanted]
        rotation, offset = rotation[best] @ axes.mT, offset[best]
        placed = compose(rotation, offset + surroundings.lift(apply_to_cloud(placed[best], opened), CLEAR))
    return placed.unflatten(0, (num, rivals))


def _distances(
    problem: GraspProblem, network: DistanceNetwork, cloud: Float[Tensor, "m 3"], placement: Float[Tensor, "b p 4 4"],
    joints: Float[Tensor, "b n_dof"], noise: Float[Tensor, "b p k latent"], config: ProposalConfig, watch: Stopwatch,
) -> Float[Tensor, "b n m"]:
    """D(R,O) of the best of p placements with k draws each of every open hand; the same in every frame."""
    hand = problem.thinned(network.config.n_hand)
    centre, size = cloud.mean(0), config.network_batch_size
    field = problem.field  # made before threads ask for it
    rivals, draws = noise.shape[1:3]
    each = side_by_side if len(placement) > size else _one_by_one  # all threads for the one part that there is

    def move(
        T: Float[Tensor, "b p 4 4"], joints: Float[Tensor, "b n_dof"], noise: Float[Tensor, "b p k latent"]
    ) -> tuple[Moves, Float[Tensor, "c 3 3"]]:
        T = T.flatten(0, 1)
        axes = T[:, :3, :3] @ network.config.axes(hand.palm_axes_wrist)
        centres = centre.expand(len(T), 3)
        opened = network.to_frame(hand.points(joints.repeat_interleave(rivals, 0), T), centres, axes)
        obj = network.to_frame(cloud.expand(len(T), -1, -1), centres, axes)
        return network.move(opened, obj, noise.flatten(0, 1)), axes

    def choose(moves: Moves, axes: Float[Tensor, "c 3 3"]) -> Moves:
        points = moves.points @ axes[:, None].mT + centre
        suits = choice_scores(hand, field, points, config.choice.penalties, problem.workspace)
        best = suits.reshape(-1, rivals * draws).argmax(-1)
        return moves.pick(torch.arange(len(best), device=best.device) * rivals + best // draws, best % draws)

    with watch("network"):
        moves, axes = zip(*each(move, placement.split(size), joints.split(size), noise.split(size)), strict=True)
    if rivals * draws > 1:
        with watch("choose"):
            moves = each(choose, moves, axes)
    with watch("network"):
        return torch.cat(each(network.distances, moves)).float()


def _one_by_one(work: Callable[..., Any], *parts: Iterable[Any]) -> list[Any]:
    """The results for all parts of a task, with all threads for each."""
    return [work(*job) for job in zip(*parts, strict=True)]
