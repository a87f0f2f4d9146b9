"""ManiFM-style grasps: contacts from the network, all assignments of fingertips to them, and a joint descent.

Differs from ManiFM, whose weights and data are not to be had. The network is smaller and trained on this package's grasps. The
assignments are solved by this package's joint solver. Contact, wrench and joints descend together in its refinement instead of
by a convex programme a step. ManiFM's controller was tuned for point contacts; here the squeeze balances the contacts'
forces, as that of every refined grasp.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations, permutations
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.geometry.se3 import apply, register, rotate
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics.joint_solver import Targets, solve_joints
from dro_grasp.kinds import Checked
from dro_grasp.network.checkpoints import load_small, locate_weights
from dro_grasp.optimize.refinement import RefineConfig, refine_grasps
from dro_grasp.optimize.squeeze import gripping
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import Progress, Source
from lab.methods import EXPECTED, WEIGHTS
from lab.methods.manifm.contact_network import LATENT, ContactNetwork
from lab.methods.manifm.contact_training import open_hand_cloud
from lab.methods.manifm.fingertip_contacts import Pads, contacts_of


@dataclass(frozen=True)
class ContactMethodConfig(Checked):
    """From contacts to grasps; the numbers are ManiFM's, unless stated otherwise."""

    points: int = 256
    """Object points, as many as in training (ManiFM: 2,048)."""
    contacts: int = 3
    """Contacts of a grasp; fewer for a hand with fewer fingers."""
    radius: float = 0.02
    """Least distance of two contacts [m]."""
    stalk: float = 0.02
    """Distance behind a pad of a second point that the solver places on the object's normal, and pads face it [m] (ours)."""
    depth: float = 1.0
    """Weight of the deepest penetration beside the distance of pads from their contacts, to choose an assignment (ours)."""
    descent: RefineConfig = field(default_factory=lambda: RefineConfig(steps=100))
    """The joint descent; ManiFM has 100 steps."""


class ContactMethod(Source):
    """One draw of z a grasp; of all assignments the best reached. Nothing is ranked or settled."""

    name = "manifm"

    def __init__(self, weights: Path = WEIGHTS / "manifm.safetensors", config: ContactMethodConfig | None = None) -> None:
        """Load the weights.

        Raises:
            WeightsError: They are missing or of another network.
        """
        self.config = config or ContactMethodConfig()
        self.network = load_small(locate_weights(weights), lambda _: ContactNetwork(), EXPECTED)

    @torch.no_grad()
    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        """Draw contacts, reach for them, descend, and balance the squeeze."""
        config, hand, generator = self.config, problem.hand, torch.Generator().manual_seed(seed)
        cloud, outward = torch.from_numpy(problem.obj.cloud), torch.from_numpy(problem.obj.cloud_normals)
        rows = torch.randint(len(cloud), (config.points,), generator=generator)
        points, normals = cloud[rows], outward[rows]
        obj = torch.cat([points - cloud.mean(0), normals], -1).expand(num, -1, -1)
        told = open_hand_cloud(hand).expand(num, -1, -1)
        maps = self.network.decode(obj, told, torch.randn(num, LATENT, generator=generator))
        pads = Pads.of(hand)
        chosen = contacts_of(points, maps.heat, min(config.contacts, len(pads.links)), config.radius)
        T, q = reached(problem, pads, points[chosen], normals[chosen], config)
        grasps = GraspBatch.create(hand, problem.obj, T, q, seed=seed, provenance=f"ManiFM-style {self.name}")
        energy = problem.energy(config.descent.energy)
        return gripping(energy, refine_grasps(energy, grasps, config.descent), config.descent.grip)


def reached(
    problem: GraspProblem, pads: Pads, spots: Float[Tensor, "n k 3"], normals: Float[Tensor, "n k 3"],
    config: ContactMethodConfig,
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n n_dof"]]:
    """Hands whose pads come nearest to contacts, over all fingers and orders."""
    hand, count = problem.hand, spots.shape[1]
    orders = list(permutations(range(count)))
    wanted = torch.cat([spots, spots + config.stalk * normals], 1)
    order = torch.tensor([[*each, *(i + count for i in each)] for each in orders])
    positions = wanted[:, order].flatten(0, 1)  # (n orders) (2 k) 3
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for fingers in combinations(range(len(pads.links)), count):
        T, q = _solved(hand, pads, list(fingers), positions, config)
        body = problem.thinned(min(hand.n_points, 200)).points(q.to(problem.device), T.to(problem.device))
        depth = (-problem.field.distances(body)[0].amin(-1)).clamp_min(0).cpu()
        links = pads.links[list(fingers)]
        placed = apply(T[:, None] @ hand.tree.forward(q)[:, links], pads.points[list(fingers)])
        cost = (placed - positions[:, :count]).norm(dim=-1).mean(-1) + config.depth * depth
        found.append((T, q, cost))
    T, q, cost = (torch.cat([part.unflatten(0, (len(spots), -1)) for part in parts], 1) for parts in zip(*found, strict=True))
    rows, best = torch.arange(len(spots)), cost.argmin(1)
    return T[rows, best], q[rows, best]


def _solved(
    hand: Hand, pads: Pads, fingers: list[int], positions: Float[Tensor, "b t 3"], config: ContactMethodConfig
) -> tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b n_dof"]]:
    """Wrist and joints that bring pads, and the points behind them, to positions; registration gives the start."""
    local = torch.cat([pads.points[fingers], pads.points[fingers] - config.stalk * pads.normals[fingers]])
    links = torch.cat([pads.links[fingers]] * 2)
    half = hand.canonical_joints(0.5)
    poses = hand.tree.forward(half)[links]
    opened = rotate(poses[:, :3, :3], local) + poses[:, :3, 3]
    start, _ = register(opened.expand_as(positions), positions)
    q = half.expand(len(positions), -1)
    solution = solve_joints(hand.tree, Targets(positions, links, local), start, q, hand.movable)
    return solution.T_world_wrist, solution.joints
