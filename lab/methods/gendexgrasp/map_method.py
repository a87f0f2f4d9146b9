"""GenDexGrasp as a method: maps from the network, sharpened, and a hand fitted to each; any hand, nothing annotated."""

from __future__ import annotations

from pathlib import Path

import torch

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.network.checkpoints import load_small, locate_weights
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import Progress, Source
from lab.methods import EXPECTED, WEIGHTS
from lab.methods.gendexgrasp.contact_maps import sharpened
from lab.methods.gendexgrasp.map_fitting import FittingConfig, MapTarget, fit
from lab.methods.gendexgrasp.map_network import LATENT, ContactMapNetwork

POINTS = 256
"""Object points of a map, as many as in training (GenDexGrasp: 2,048)."""


class GenDexGrasp(Source):
    """GenDexGrasp: one map a grasp; of its particles the one of lowest energy. Nothing is refined, ranked or settled."""

    name = "gendexgrasp"

    def __init__(self, weights: Path = WEIGHTS / "gendexgrasp.safetensors", config: FittingConfig | None = None) -> None:
        """Load the weights.

        Raises:
            WeightsError: They are missing or of another network.
        """
        self.config = config or FittingConfig()
        self.network = load_small(locate_weights(weights), lambda _: ContactMapNetwork(), EXPECTED)

    def propose(self, problem: GraspProblem, num: int, seed: int, progress: Progress | None = None) -> GraspBatch:
        """Draw maps of the object, and fit the hand."""
        generator = torch.Generator().manual_seed(seed)
        cloud, outward = torch.from_numpy(problem.obj.cloud), torch.from_numpy(problem.obj.cloud_normals)
        rows = torch.randint(len(cloud), (POINTS,), generator=generator)
        points, normals = cloud[rows].float(), outward[rows].float()
        centred = (points - cloud.float().mean(0)).expand(num, -1, -1)
        with torch.no_grad():
            goals = sharpened(self.network.decode(centred, torch.randn(num, LATENT, generator=generator)))
        hand = problem.hand.with_points(min(self.config.hand_points, problem.hand.n_points))
        T, q, energy = fit(hand, MapTarget(points, normals, goals, problem.obj.distance_field), self.config, generator)
        return GraspBatch.create(
            problem.hand, problem.obj, T, q, energy=energy, seed=seed, provenance=f"GenDexGrasp {self.name}")
