"""The one-call interface: a hand and an object in, ranked grasps out.

Source: paper section III; the order of the steps is that of figure 2, with a placement of the open hand chosen
first (by the caller's direction or by the learned placement prior).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp import distance_matrix
from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.hands.hand import Hand
from dro_grasp.models.checkpoints import load_weights
from dro_grasp.models.network import DistanceNetwork
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimization.refinement import refine_grasps
from dro_grasp.ranking.score import score_grasps

PREDICTED = "predicted_points"
"""Column that carries the multilaterated points through selection and sorting; no file holds it."""


MOST = 100_000
"""Most grasps predicted in one call, those that ranking drops included."""
HOTTEST = 2.0
"""Largest temperature that is taken."""
CLOUD_TEMPERATURE = 0.5
"""Of bare clouds, unless another is asked for: where the object is less sure, grasps should be surer."""


@dataclass(frozen=True)
class PredictorConfig:
    """How grasps are sampled and decoded."""

    rotations_per_grasp: int = 16
    """Wrist rotations offered to the placement prior for each grasp, when no direction is asked for."""
    rolls_per_grasp: int = 8
    """The same with a direction: rolls about it."""
    direction_spread: float = math.radians(5.0)
    """Standard deviation of the palm direction around the one asked for [rad]."""
    temperature: float | None = None
    """Spread of z: at 0 the likeliest grasp of each placement, at 1 as varied as the training grasps; None leaves it to the
    weights, but takes at most CLOUD_TEMPERATURE for a bare cloud."""
    batch_size: int = 16
    """Grasps that are decoded at once."""
    network_batch_size: int = 4
    """Grasps of these that go through the network at once; more do not fit a processor's cache."""
    table_rounds: int = 20
    """How often sampling goes on when a table plane rejects grasps."""


@dataclass
class GraspPredictor:
    """Predicts grasps of any object by any hand with one set of weights.

    Example:
        >>> import dro_grasp as dro
        >>> hand, obj = dro.load_hand("allegro"), dro.load_object("mug")
        >>> grasps = dro.GraspPredictor().predict(hand, obj, num=16)
    """

    weights: str | None = None
    """Name of shipped weights or path of a weights file; None takes the default."""
    device: str = "cpu"
    """Where the network runs."""
    config: PredictorConfig = field(default_factory=PredictorConfig)
    timings: dict[str, float] = field(default_factory=dict, init=False)
    """Seconds of the last call: network, decode, refine, rank."""
    candidates: int = field(default=0, init=False)
    """Grasps decoded in the last call, those below a table included."""
    predicted_points: Float[Tensor, "n n_hand 3"] | None = field(default=None, init=False)
    """Hand points as multilaterated in the last call [m], in the order of its grasps; the solved hand differs."""

    def __post_init__(self) -> None:
        """Load the weights once."""
        self.network: DistanceNetwork = load_weights(self.weights).to(self.device).eval()
        self.weights_name: str = self.network.name

    # no_grad, not inference_mode: roma caches a tensor at first use, which training could then not use.
    @torch.no_grad()
    def predict(
        self,
        hand: Hand,
        obj: ObjectModel,
        num: int = 16,
        seed: int = 0,
        direction: tuple[float, float, float] | None = None,
        table: float | None = None,
        refine: bool = True,
        progress: Callable[[int, int], None] | None = None,
        candidates: int = 1,
    ) -> GraspBatch:
        """Predict grasps, best score first.

        Args:
            hand: The hand, from `load_hand`.
            obj: The object, from `load_object`: a mesh or a bare point cloud.
            num: How many grasps to return.
            seed: The same seed gives the same grasps.
            direction: Palm direction asked for, in the object's frame; any length but zero.
            table: Height [m] of a plane in the object's frame; grasps whose hand goes below it in the pregrasp or
                in the grasp are dropped and sampling goes on.
            refine: Polish the network's grasps on the object's geometry, near where they were predicted.
            progress: Called with (grasps decoded, grasps wanted).
            candidates: Grasps that are predicted for each one returned; the best by score are kept.

        Returns:
            `num` grasps with pregrasp, squeeze and score. Results do not depend on the batch size.

        Raises:
            OptionError: `num` or `candidates` is not positive, `direction` is zero, the temperature is out of range, or too
                few grasps stay above the table.
        """
        check_request(num, direction, self.config.temperature, candidates)
        if table is not None and not table < float(obj.cloud[:, 2].max()):
            raise OptionError(f"a table at {table} m leaves nothing of the object, which ends at z = "
                              f"{float(obj.cloud[:, 2].max()):.3f} m; give --table in metres in the frame of the grasps")
        wanted, num = num, num * candidates
        self.timings = {"network": 0.0, "decode": 0.0, "refine": 0.0, "rank": 0.0}
        self.candidates = 0
        generator = torch.Generator().manual_seed(seed)
        kept: list[GraspBatch] = []
        for _ in range(self.config.table_rounds if table is not None else 1):
            batch = self._sample(hand, obj, num, seed, direction, generator, progress)
            self.candidates += len(batch)
            if refine:
                with _timed(self.timings, "refine"):
                    batch = refine_grasps(hand, obj, batch)
            kept.append(batch if table is None else batch[above_table(hand, batch, table)])
            if sum(map(len, kept)) >= num:
                break
        found = GraspBatch.concatenate(kept)[slice(0, num)]
        if len(found) < wanted:
            raise OptionError(
                f"only {len(found)} of {self.candidates} grasps keep the hand above table {table} m, {wanted} were asked "
                f"for; lower --table (the object spans z = {float(obj.cloud[:, 2].min()):.3f} to "
                f"{float(obj.cloud[:, 2].max()):.3f} m), or ask for a --direction from above (0 0 -1)"
            )
        with _timed(self.timings, "rank"):
            scored = found.replace(score=score_grasps(hand, obj, found))
        ranked = scored.sorted_by_score()[slice(0, wanted)]
        self.predicted_points = ranked.extra[PREDICTED].unflatten(1, (-1, 3))
        return ranked.replace(extra={k: v for k, v in ranked.extra.items() if k != PREDICTED})

    def _sample(
        self,
        hand: Hand,
        obj: ObjectModel,
        num: int,
        seed: int,
        direction: tuple[float, float, float] | None,
        generator: torch.Generator,
        progress: Callable[[int, int], None] | None,
    ) -> GraspBatch:
        """Decode `num` grasps and complete them with pregrasp and squeeze."""
        network, config = self.network, self.network.config
        small = hand.with_points(config.n_hand)
        points = obj.sample_points(config.n_object, generator)
        with _timed(self.timings, "network"):
            T_object_wrist = self._placements(small, points, num, direction, generator)
            joints = small.random_open_joints(num, generator)
            temperature = self.config.temperature
            if temperature is None and obj.is_cloud:
                temperature = CLOUD_TEMPERATURE
            latent = network.sample_latent(num, generator, 1.0 if temperature is None else temperature)
        poses, solved, predicted = [], [], []
        for start in range(0, num, self.config.batch_size):
            part = slice(start, min(start + self.config.batch_size, num))
            with _timed(self.timings, "network"):
                placed = small.points(joints[part], T_object_wrist[part])
                rotation = T_object_wrist[part, :3, :3] @ network.config.axes(small.palm_axes_wrist)
                distances = self._distances(placed, points, rotation, latent[part])
            with _timed(self.timings, "decode"):
                anchors = points.expand(len(placed), -1, -1)
                links = distance_matrix.decode(small, distances, anchors)
                solution = distance_matrix.solve(small, links, joints[part])
            poses.append(solution.T_world_wrist)
            solved.append(solution.joints)
            predicted.append(links.points.flatten(1))
            if progress is not None:
                progress(part.stop, num)
        T, q = torch.cat(poses), torch.cat(solved)
        pregrasp, squeeze = pregrasp_and_squeeze(hand, T, q, torch.as_tensor(obj.centre_of_mass, dtype=q.dtype))
        return GraspBatch.create(
            hand, obj, T, q, pregrasp_joints=pregrasp, squeeze_joints=squeeze,
            seed=torch.full((num,), seed, dtype=torch.int64), provenance=(f"network {self.weights_name}",) * num,
            extra={PREDICTED: torch.cat(predicted)},
        )

    def _placements(
        self,
        hand: Hand,
        points: Float[Tensor, "m 3"],
        num: int,
        direction: tuple[float, float, float] | None,
        generator: torch.Generator,
    ) -> Float[Tensor, "num 4 4"]:
        """Wrist poses near which grasps are asked for, in the object's frame."""
        per_grasp = self.config.rotations_per_grasp if direction is None else self.config.rolls_per_grasp
        axes = self.network.config.axes(hand.palm_axes_wrist)
        candidates = self._rotations(hand, num * per_grasp, direction, generator) @ axes
        opened = hand.points(hand.canonical_joints()) @ axes
        rotation, position = self.network.sample_placements(opened, points, candidates, num, generator)
        T = torch.eye(4).repeat(num, 1, 1)
        T[:, :3, :3] = rotation @ axes.mT
        T[:, :3, 3] = points.mean(0) + (rotation @ (position - hand.grasp_centre_wrist @ axes)[..., None])[..., 0]
        return T

    def _distances(
        self,
        placed: Float[Tensor, "b n 3"],
        points: Float[Tensor, "m 3"],
        rotation: Float[Tensor, "b 3 3"],
        latent: Float[Tensor, "b latent"],
    ) -> Float[Tensor, "b n m"]:
        """D(R,O) of a batch of placed hands whose axes are turned so; distances are the same in every frame."""
        found = []
        size = self.config.network_batch_size
        for clouds, axes, z in zip(placed.split(size), rotation.split(size), latent.split(size), strict=True):
            centre = points.mean(0).expand(len(clouds), 3)
            hand = self.network.to_frame(clouds, centre, axes)
            obj = self.network.to_frame(points.expand(len(clouds), -1, -1), centre, axes)
            found.append(self.network.predict(hand, obj, z).float())
        return torch.cat(found)

    def _rotations(
        self, hand: Hand, count: int, direction: tuple[float, float, float] | None, generator: torch.Generator
    ) -> Float[Tensor, "count 3 3"]:
        """Wrist rotations to choose from: uniform, or with the palm near `direction` and any roll."""
        if direction is None:
            quaternions = torch.randn(count, 4, generator=generator)
            return roma.unitquat_to_rotmat(quaternions / quaternions.norm(dim=-1, keepdim=True))
        palm = hand.palm_direction_wrist
        wanted = torch.tensor(direction) / torch.tensor(direction).norm()
        align = rotation_between(palm, wanted)
        roll = torch.rand(count, generator=generator) * 2 * math.pi
        tilt = torch.randn(count, 3, generator=generator) * self.config.direction_spread
        tilt = tilt - (tilt @ wanted)[:, None] * wanted
        return roma.rotvec_to_rotmat(tilt) @ roma.rotvec_to_rotmat(roll[:, None] * wanted) @ align


def rotation_between(a: Float[Tensor, "3"], b: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes unit vector a to unit vector b (any half turn when they are opposite)."""
    axis = torch.linalg.cross(a, b)
    if axis.norm() < 1e-6:
        helper = torch.eye(3)[a.abs().argmin()]
        axis = torch.linalg.cross(a, helper)
    angle = torch.atan2(torch.linalg.cross(a, b).norm(), a @ b)
    return roma.rotvec_to_rotmat(axis / axis.norm() * angle)


def above_table(hand: Hand, grasps: GraspBatch, table: float) -> Tensor:
    """Mask (n) of the grasps whose hand stays above the plane z = table [m] in the grasp and in the pregrasp."""
    lowest = hand.points(grasps.joints, grasps.T_object_wrist)[..., 2].amin(-1)
    before = hand.points(grasps.pregrasp_joints, grasps.T_object_wrist)[..., 2].amin(-1)
    return torch.fmin(lowest, before) > table


def check_request(
    num: int, direction: tuple[float, float, float] | None, temperature: float | None = None, candidates: int = 1
) -> None:
    """Refuse impossible requests before any work.

    Raises:
        OptionError: `num` or `candidates` is not positive, `direction` is zero or not finite, or `temperature` is out of range.
    """
    if num < 1:
        raise OptionError(f"num is {num}; ask for at least one grasp (--num 16)")
    if candidates < 1:
        raise OptionError(f"candidates is {candidates}; predict at least one for each grasp")
    if num * candidates > MOST:
        raise OptionError(f"{num} grasps of {candidates} candidates each do not fit memory; predict at most {MOST} at once, "
                          "with another --seed for more")
    if direction is not None:
        length = math.sqrt(sum(x * x for x in direction))
        if not math.isfinite(length) or length < 1e-9:
            raise OptionError(
                f"direction {direction} has no direction; give the palm direction in the object's frame, for example "
                "--direction 0 0 -1 to grasp from above"
            )
    if temperature is not None and not 0 <= temperature <= HOTTEST:
        raise OptionError(f"temperature is {temperature}; give 0 for the likeliest grasps, 1 for the most varied, or a number "
                          f"between (at most {HOTTEST:g})")


class _timed:
    """Adds the time spent in a block to a dictionary entry."""

    def __init__(self, timings: dict[str, float], key: str) -> None:
        self.timings, self.key = timings, key

    def __enter__(self) -> None:
        self.begin = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.timings[self.key] += time.perf_counter() - self.begin
