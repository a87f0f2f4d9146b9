"""The D(R,O) network: open hand and object in, distances in the grasp pose out. Source: paper section III-C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dro_grasp.errors import OptionError
from dro_grasp.hands.hand import Hand
from dro_grasp.models.attention import CrossTransformer
from dro_grasp.models.distance_head import DistanceHead
from dro_grasp.models.encoder import StaticGraphEncoder
from dro_grasp.models.latent import (
    Condition,
    FlowPrior,
    GaussianPrior,
    HandMotion,
    LatentEncoder,
    sample_posterior,
    with_latent,
)
from dro_grasp.models.placement import PlacementPrior
from dro_grasp.models.precision import fast_products


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes and forms. The defaults are the paper's."""

    n_hand: int = 512
    """Points of the hand's cloud."""
    n_object: int = 512
    """Points of the object's cloud."""
    width: int = 512
    """Feature dimension D."""
    encoder_widths: tuple[int, ...] = (64, 64, 128, 256, 512)
    """Outputs of the edge layers."""
    neighbours: int = 32
    """K of the encoders' graphs."""
    heads: int = 4
    """Attention heads."""
    attention_hidden: int = 1024
    """Hidden width of the transformers' feed-forward layers."""
    latent: int = 64
    """Dimension of z."""
    latent_widths: tuple[int, ...] = (64, 64, 128, 256)
    """Edge layers of the latent encoder."""
    latent_head: tuple[int, int] = (512, 256)
    """Fully connected layers of the latent encoder."""
    latent_neighbours: int = 20
    """K of the latent encoder's graph."""
    prior: Literal["standard", "learned", "flow"] = "standard"
    """What z is drawn from at inference: N(0, I) (the paper's form), a Gaussian learned from hand and object, or any
    distribution that a flow learns from them."""
    latent_form: Literal["kernel", "motion"] = "kernel"
    """What z does: it enters the kernel alone (the paper's form), or also moves the placed open hand, which needs
    `placed` and `residual`."""
    kernel_hidden: tuple[int, int] = (300, 100)
    """Hidden layers of the kernel."""
    initial_distance: float = 0.1
    """Distance that an untrained kernel predicts [m]; softplus alone starts at 0.69."""
    frame: Literal["object", "wrist", "palm"] = "object"
    """Axes of both clouds: the object's (the paper's form), the given wrist's, which each description chooses as it likes, or
    those of the palm there, which mean the same for every hand."""
    placed: bool = False
    """Tell the network where the open hand is; the paper discards it by zero-centring."""
    residual: bool = False
    """Add the kernel to the distances of the placed open hand; needs `placed`."""
    placement_width: int = 128
    """Width of the placement prior."""
    placement_components: int = 8
    """Components of its mixture."""
    latent_temperature: float = 1.0
    """Scales z drawn at inference; 1 is the paper's form."""
    placement_temperature: float = 0.7
    """Scales the spread of placements drawn at inference."""

    def axes(self, hand: Hand) -> Float[Tensor, "3 3"]:
        """Axes that the network works in, as columns in the wrist frame; those of the wrist where it works in the object's."""
        return hand.palm_axes_wrist if self.frame == "palm" else torch.eye(3, device=hand.link_points.device)

    @staticmethod
    def paper() -> NetworkConfig:
        """The paper's network, about 14 M parameters."""
        return NetworkConfig()

    @staticmethod
    def slim() -> NetworkConfig:
        """A small one that trains on a CPU: the same code, narrower, in the palm's axes, with placement."""
        return NetworkConfig(
            n_hand=160, n_object=128, width=128, encoder_widths=(32, 32, 64, 128), neighbours=16,
            attention_hidden=256, latent=64, latent_widths=(32, 32, 64), latent_head=(128, 128), latent_neighbours=12,
            kernel_hidden=(128, 64), frame="palm", placed=True, residual=True,
            placement_temperature=0.3,
        )

    @staticmethod
    def from_dict(values: dict[str, Any]) -> NetworkConfig:
        """From plain values, as stored in a weights file; lists become tuples."""
        plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return NetworkConfig(**plain)


@dataclass(frozen=True)
class NetworkOutput:
    """What training needs of one forward pass."""

    distances: Float[Tensor, "b n columns"]
    """D(R,O) [m]."""
    mean: Float[Tensor, "b latent"]
    """Mean of the posterior of z."""
    log_variance: Float[Tensor, "b latent"]
    """Its log-variance."""
    prior_mean: Float[Tensor, "b latent"]
    """Mean of the prior of z; zero in the paper's form."""
    prior_log_variance: Float[Tensor, "b latent"]
    """Its log-variance; zero in the paper's form."""
    flow_error: Float[Tensor, " b"]
    """Squared velocity error of the flow to z; zero without a flow."""
    moved: Float[Tensor, "b n 3"]
    """The placed hand, moved as z says where z says so [m]."""
    hand_feature: Float[Tensor, "b width"]
    """Mean feature of the open hand, for the placement prior."""


class DistanceNetwork(nn.Module):
    """Encoders, cross-attention both ways, CVAE latent, symmetric kernel."""

    def __init__(self, config: NetworkConfig, name: str = "untrained") -> None:
        super().__init__()
        self.config, self.name = config, name
        self.mixed = False
        """Whether encoders and transformers multiply in bfloat16; distances are always computed in single precision."""
        c = config
        self.hand_encoder = StaticGraphEncoder(c.encoder_widths, c.width, c.neighbours)
        self.object_encoder = StaticGraphEncoder(c.encoder_widths, c.width, c.neighbours)
        self.hand_transformer = CrossTransformer(c.width, c.heads, c.attention_hidden)
        self.object_transformer = CrossTransformer(c.width, c.heads, c.attention_hidden)
        if c.latent_form == "motion" and not (c.placed and c.residual):
            raise OptionError("latent_form 'motion' moves the placed open hand, of which this network is not told; use the "
                              "size slim, or set placed and residual")
        latent_width = c.latent_head[0]
        self.motion = HandMotion(c.width, c.latent, latent_width) if c.latent_form == "motion" else None
        self.latent_encoder = None if self.motion is not None else LatentEncoder(
            c.width, c.latent, c.latent_widths, c.latent_head, c.latent_neighbours)
        self.condition = None if c.prior == "standard" else Condition(c.width, latent_width)
        self.prior = (
            FlowPrior(c.latent, latent_width) if c.prior == "flow"
            else GaussianPrior(c.latent, latent_width) if c.prior == "learned" else None)
        self.head = DistanceHead(c.width + c.latent, c.kernel_hidden, c.initial_distance)
        self.place = nn.Linear(3, c.width) if c.placed else None
        self.placement = PlacementPrior(c.width, c.placement_width, c.placement_components)

    def encode(
        self, hand: Float[Tensor, "b n 3"], obj: Float[Tensor, "b m 3"]
    ) -> tuple[Float[Tensor, "b n width"], Float[Tensor, "b m width"]]:
        """Features of the points of each cloud by itself."""
        with self._products(hand):
            features = self.hand_encoder(hand - hand.mean(1, keepdim=True)), self.object_encoder(obj)
        return features[0].float(), features[1].float()

    def relate(
        self, hand_features: Float[Tensor, "b n width"], obj_features: Float[Tensor, "b m width"], hand: Float[Tensor, "b n 3"]
    ) -> tuple[Float[Tensor, "b n width"], Float[Tensor, "b m width"]]:
        """Features that know of the other cloud, and of where the hand [m] is if the configuration says so."""
        if self.place is not None:
            hand_features = hand_features + self.place(hand * 10)
        with self._products(hand):
            related = self.hand_transformer(hand_features, obj_features), self.object_transformer(obj_features, hand_features)
        return related[0].float() + hand_features, related[1].float() + obj_features

    def _products(self, like: Tensor) -> torch.autocast:
        return torch.autocast(like.device.type, torch.bfloat16, enabled=self.mixed)

    def forward(
        self,
        hand: Float[Tensor, "b n 3"],
        obj: Float[Tensor, "b m 3"],
        grasp: Float[Tensor, "b n 3"],
        columns: int | None = None,
    ) -> NetworkOutput:
        """One training pass: z comes from the true grasp.

        Args:
            hand: The open hand [m], in the frame of the configuration.
            obj: The object in the same frame [m].
            grasp: The hand in the grasp pose, in the same frame [m].
            columns: Compute distances to this many leading object points only; the order must be random.
        """
        phi_hand, phi_object = self.encode(hand, obj)
        if self.motion is not None:
            mean, log_variance = self.motion.encode(phi_hand, hand, grasp)
            z = sample_posterior(mean, log_variance)
            moved = self.motion(phi_hand, hand, z)
            psi_hand, psi_object = self.relate(phi_hand, phi_object, moved)
        else:
            psi_hand, psi_object = self.relate(phi_hand, phi_object, hand)
            assert self.latent_encoder is not None
            with self._products(hand):
                mean, log_variance = self.latent_encoder(
                    torch.cat([grasp, obj], 1), torch.cat([psi_hand, psi_object], 1))
            mean, log_variance = mean.float(), log_variance.float()
            z, moved = sample_posterior(mean, log_variance), hand
        distances = self._distances(psi_hand, psi_object[:, :columns], z, moved, obj[:, :columns])
        prior_mean, prior_log_variance, flow_error = torch.zeros_like(z), torch.zeros_like(z), z.new_zeros(len(z))
        if self.condition is not None:
            condition = self.condition(phi_hand, phi_object, hand, obj)
            if isinstance(self.prior, FlowPrior):
                flow_error = self.prior.loss(z, condition)
            elif self.prior is not None:
                prior_mean, prior_log_variance = self.prior.moments(condition)
        return NetworkOutput(
            distances, mean, log_variance, prior_mean, prior_log_variance, flow_error, moved, phi_hand.mean(1))

    def predict(
        self, hand: Float[Tensor, "b n 3"], obj: Float[Tensor, "b m 3"], noise: Float[Tensor, "b latent"]
    ) -> Float[Tensor, "b n m"]:
        """D(R,O) [m] for draws of `sample_latent`, which the prior turns into z; see `forward` for the clouds."""
        with fast_products():
            phi_hand, phi_object = self.encode(hand, obj)
            z = noise
            if self.condition is not None and self.prior is not None:
                z = self.prior(noise, self.condition(phi_hand, phi_object, hand, obj))
            moved = hand if self.motion is None else self.motion(phi_hand, hand, z)
            psi_hand, psi_object = self.relate(phi_hand, phi_object, moved)
            return self._distances(psi_hand, psi_object, z, moved, obj)

    def _distances(
        self, psi_hand: Tensor, psi_object: Tensor, z: Tensor, hand: Tensor, obj: Tensor
    ) -> Float[Tensor, "b n m"]:
        # The matrix-product form of cdist loses half of the digits.
        exact = "donot_use_mm_for_euclid_dist"
        base = torch.cdist(hand, obj, compute_mode=exact) if self.config.residual else None
        return self.head(with_latent(psi_hand, z), with_latent(psi_object, z), base)

    def to_frame(
        self, points: Float[Tensor, "b n 3"], centre: Float[Tensor, "b 3"], rotation: Float[Tensor, "b 3 3"]
    ) -> Float[Tensor, "b n 3"]:
        """Points of the object's frame in the frame the network works in: about the object's centre.

        Args:
            points: In the object's frame [m].
            centre: Mean of the object's cloud [m].
            rotation: Of the given hand's axes (`NetworkConfig.axes`) in the object's frame.
        """
        centred = points - centre[:, None]
        return centred if self.config.frame == "object" else centred @ rotation

    def sample_latent(
        self, num: int, generator: torch.Generator, temperature: float | None = None
    ) -> Float[Tensor, "num latent"]:
        """Draws that `predict` turns into z; in the paper's form they are z. Without a temperature, the configuration's."""
        scale = self.config.latent_temperature if temperature is None else temperature
        return torch.randn(num, self.config.latent, generator=generator) * scale

    def sample_placements(
        self,
        hand: Float[Tensor, "n 3"],
        obj: Float[Tensor, "m 3"],
        rotations: Float[Tensor, "r 3 3"],
        num: int,
        generator: torch.Generator,
    ) -> tuple[Float[Tensor, "num 3 3"], Float[Tensor, "num 3"]]:
        """Rotations of the hand's axes, and positions of the grasp centre in them about the object's centre [m].

        Args:
            hand: The open hand in its axes (`NetworkConfig.axes`) [m].
            obj: The object's cloud in its own frame [m].
            rotations: Candidate rotations of these axes.
            num: How many placements.
            generator: Source of randomness.
        """
        feature = self.hand_encoder((hand - hand.mean(0))[None]).mean(1)[0]
        return self.placement.sample(
            obj - obj.mean(0), feature, rotations, num, generator, self.config.placement_temperature
        )
