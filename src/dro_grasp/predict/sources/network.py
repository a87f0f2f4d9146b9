"""The network as a source: placements of the open hand, z by choice, D(R,O), link poses, joints.

Source: paper section III, figure 2. Differs from the paper: a placement of the open hand is chosen first, by the caller's
direction or by the learned placement prior. Networks of the paper's form have no such prior: their wrists are turned at
random, or face the caller's direction at a random roll.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp import distance_matrix
from dro_grasp.devices import Rows, Stopwatch, at_once, fast_products, on_accelerator, one_thread, side_by_side
from dro_grasp.errors import OptionError
from dro_grasp.geometry.distance_field import DistanceField, DistanceFields
from dro_grasp.geometry.se3 import apply_to_cloud, compose, rotate
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.proportions import proportions
from dro_grasp.kinds import Checked
from dro_grasp.network.network import DistanceNetwork, Moves
from dro_grasp.optimize.starts import CHOICES, CLEAR, Spread, approach_cost, wrist_rotations
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.choice import ChoiceConfig, choice_scores, posed_cloud
from dro_grasp.predict.sources.source import Asked, Candidates, Progress, Source

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
    batch_size: int | None = None
    """Candidates that are decoded at once; None takes what suits the device."""
    network_batch_size: int | None = None
    """Candidates that pass the network at once; None takes what suits the device."""

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

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> Candidates:
        """See `propose`."""
        return self.propose_all([Asked(problem, num, seed)], progress)[0]

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def propose_all(self, asked: Sequence[Asked], progress: Progress | None = None) -> list[Candidates]:
        """The same for several objects, whose candidates pass the network together."""
        watch = Stopwatch("network", "choose", "decode")
        generators = [torch.Generator().manual_seed(each.seed) for each in asked]
        problems, counts = [each.problem for each in asked], [each.num for each in asked]
        made = propose_all(problems, self.network, counts, generators, self.config, watch, progress)
        seconds = {name: spent / len(made) for name, spent in watch.seconds.items()}
        return [replace(each, seconds=seconds) for each in made]


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
    return propose_all([problem], network, [num], [generator], config or ProposalConfig(), watch or Stopwatch(), progress)[0]


ON_CPU = 4  # Candidates that pass the network at once on a CPU: more do not fit its cache (ours, timed)
DECODED_ON_CPU = 16  # Candidates that a CPU decodes at once (ours, timed)
COPIES = 8  # Copies of its largest tensors that the network needs (ours, counted)


@dataclass(frozen=True)
class _Inputs(Rows):
    """What the network is given for each candidate, on the device."""

    placement: Float[Tensor, "n p 4 4"]
    joints: Float[Tensor, "n n_dof"]
    noise: Float[Tensor, "n p k latent"]
    which: Int[Tensor, " n"]  # the problem of each


def propose_all(
    problems: Sequence[GraspProblem], network: DistanceNetwork, counts: Sequence[int], generators: Sequence[torch.Generator],
    config: ProposalConfig, watch: Stopwatch, progress: Progress | None = None,
) -> list[Candidates]:
    """Candidates of several objects by one hand, whose energies can be joined; arguments as of `propose`."""
    first, total = problems[0], sum(counts)
    hand, rivals, draws = first.thinned(network.config.n_hand), *_choices(network, config)
    with watch("network"):
        drawn = [_drawn(network, *each, rivals, draws, config) for each in zip(problems, counts, generators, strict=True)]
        clouds = torch.stack([cloud for cloud, _ in drawn])
        which = torch.arange(len(problems)).repeat_interleave(torch.tensor(counts)).to(first.device)
        parts = {f.name: torch.cat([getattr(own, f.name) for _, own in drawn]) for f in fields(_Inputs)}
        inputs = _Inputs(**parts | {"which": which})
        joined = first.field if len(problems) == 1 else DistanceFields.of(
            [problem.field for problem in problems], [rivals * count for count in counts])
    size = at_once(first.device, DECODED_ON_CPU, _decoding_bytes(network), config.batch_size)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for start in range(0, total, size):
        part = slice(start, min(start + size, total))
        field = joined if isinstance(joined, DistanceField) else joined.rows(slice(rivals * start, rivals * part.stop))
        own = inputs.rows(part)
        distances = _distances(first, network, clouds, own, field, config, watch)
        with watch("decode"), one_thread(first.device):
            links = distance_matrix.decode(hand, distances, clouds[own.which])
            solution = distance_matrix.solve(hand.limited_to_use(), links, own.joints)
            found.append((solution.T_world_wrist, solution.joints, links.points))
        if progress is not None:
            progress(part.stop, total)
    T, q, points = (torch.cat(part).cpu().split(list(counts)) for part in zip(*found, strict=True))
    return [Candidates(
        GraspBatch.create(problem.hand, problem.obj, T[i], q[i], seed=generators[i].initial_seed(),
                          provenance=f"network {network.name}"), points[i]) for i, problem in enumerate(problems)]


def _choices(network: DistanceNetwork, config: ProposalConfig) -> tuple[int, int]:
    """Placements and draws of z for each candidate."""
    return (config.choice.placements, config.choice.draws) if network.z_moves else (1, 1)


def _decoding_bytes(network: DistanceNetwork) -> float:
    """Memory that a candidate takes from the network's result to the joints."""
    return 4.0 * COPIES * network.config.n_hand * network.config.n_object


def _network_bytes(network: DistanceNetwork, rivals: int, draws: int) -> float:
    """Memory that a candidate takes in the network: the points of all moved hands, and of both clouds with their neighbours."""
    sizes = network.config
    moved = rivals * draws * sizes.n_hand * sizes.latent_head[0]
    clouds = rivals * (sizes.n_hand + sizes.n_object) * (sizes.neighbours + 2) * sizes.width
    return 4.0 * (COPIES * moved + clouds) + _decoding_bytes(network)


def _drawn(
    network: DistanceNetwork, problem: GraspProblem, num: int, generator: torch.Generator, rivals: int, draws: int,
    config: ProposalConfig,
) -> tuple[Float[Tensor, "m 3"], _Inputs]:
    """The cloud and all that is random about the candidates of one object, on the device."""
    hand, cloud = problem.thinned(network.config.n_hand), problem.cloud(network.config.n_object, generator)
    placement = _placements(problem, hand, network, cloud, num, rivals, config, generator)
    joints = hand.random_open_joints(num, generator)
    noise = network.sample_latent(num * rivals * draws, generator, _temperature(problem, config)).to(problem.device)
    which = torch.zeros(num, dtype=torch.int64, device=noise.device)
    return cloud, _Inputs(placement, joints, noise.unflatten(0, (num, rivals, draws)), which)


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
    measures = hand.kept(("proportions", network.config.frame), lambda: proportions(hand, axes))
    rotation, position = network.sample_placements(cloud, rotations @ axes, offered, generator, measures)
    offset = cloud.mean(0) + rotate(rotation, position - hand.grasp_centre_wrist @ axes)
    placed = compose(rotation @ axes.mT, offset)
    if surroundings is not None:
        opened = hand.points(hand.canonical_joints())
        lack = approach_cost(hand, placed, opened, None if max_tilt else direction, surroundings)
        best = lack.argsort(stable=True)[:wanted]
        rotation, offset = rotation[best] @ axes.mT, offset[best]
        placed = compose(rotation, offset + surroundings.lift(apply_to_cloud(placed[best], opened), CLEAR))
    return placed.unflatten(0, (num, rivals))


def _distances(
    problem: GraspProblem, network: DistanceNetwork, clouds: Float[Tensor, "o m 3"], inputs: _Inputs,
    field: DistanceField | DistanceFields, config: ProposalConfig, watch: Stopwatch,
) -> Float[Tensor, "b n m"]:
    """D(R,O) of the best of p placements with k draws each of every open hand; the same in every frame."""
    hand, whole = problem.thinned(network.config.n_hand), problem.thinned(problem.hand.n_points)
    rivals, draws = inputs.noise.shape[1:3]
    size = at_once(problem.device, ON_CPU, _network_bytes(network, rivals, draws), config.network_batch_size)
    parts = [slice(start, start + size) for start in range(0, len(inputs.joints), size)]
    # All threads for the one part that there is; a device computes one after the other.
    each = _one_by_one if len(parts) == 1 or on_accelerator(problem.device) else side_by_side
    centres = clouds.mean(1)

    def placed(part: slice) -> tuple[Float[Tensor, "..."], ...]:
        own = inputs.rows(part)
        T, which = own.placement.flatten(0, 1), own.which.repeat_interleave(rivals)
        axes = T[:, :3, :3] @ network.config.axes(hand.palm_axes_wrist)
        centre = centres[which]
        opened = network.to_frame(hand.points(own.joints.repeat_interleave(rivals, 0), T), centre, axes)
        obj = network.to_frame(clouds[which], centre, axes)
        return opened, obj, own.noise.flatten(0, 1), axes, centre[:, None, None]

    def choose(moves: Moves, axes: Float[Tensor, "c 3 3"], centre: Float[Tensor, "c 1 1 3"], part: slice) -> Moves:
        points = moves.points @ axes[:, None].mT + centre
        own = field if isinstance(field, DistanceField) else field.rows(slice(rivals * part.start, rivals * part.stop))
        suits = choice_scores(hand, own, points, config.choice.penalties, problem.workspace).reshape(-1, rivals * draws)
        best = suits.topk(min(config.choice.finalists, rivals * draws)).indices
        if best.shape[1] > 1:
            final = posed_cloud(hand, points.reshape(*suits.shape, -1, 3).take_along_dim(best[..., None, None], 1), whole)
            own = own if isinstance(own, DistanceField) else own.rows(slice(None, None, rivals))
            suits = choice_scores(whole, own, final, config.choice.penalties, problem.workspace)
            best = best.take_along_dim(suits.argmax(-1, keepdim=True), 1)
        row = torch.arange(len(best), device=best.device) * rivals + best[:, 0] // draws
        return moves.pick(row, best[:, 0] % draws)

    with watch("network"):
        *given, axes, middles = zip(*map(placed, parts), strict=True)
        with fast_products():  # of all threads
            moves = each(network.move, *given)
    if rivals * draws > 1:
        with watch("choose"):
            moves = each(choose, moves, axes, middles, parts)
    with watch("network"), fast_products():
        return torch.cat(each(network.distances, moves)).float()


def _one_by_one(work: Callable[..., Any], *parts: Iterable[Any]) -> list[Any]:
    """The results for all parts of a task, with all threads for each."""
    return [work(*job) for job in zip(*parts, strict=True)]
