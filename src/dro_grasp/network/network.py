"""The D(R,O) network: open hand and object in, distances in the grasp pose out. Source: paper section III-C."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from dro_grasp.devices import fast_products
from dro_grasp.errors import WeightsError
from dro_grasp.network import latent
from dro_grasp.network.distance_head import DistanceHead
from dro_grasp.network.encoder import StaticGraphEncoder
from dro_grasp.network.placement import PlacementPrior
from dro_grasp.network.presets import NetworkConfig


class Attention(nn.Module):
    """Multi-head attention of queries to a memory."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.memory = nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "b n c"], memory: Float[Tensor, "b m c"]) -> Float[Tensor, "b n c"]:
        """Attended values."""
        query = self.query(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        key, value = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in self.memory(memory).chunk(2, -1))
        if query.is_cuda or not torch.is_grad_enabled():
            mixed = functional.scaled_dot_product_attention(query, key, value)
        else:
            # On a CPU at these sizes the fused kernel is faster forwards, but several times slower backwards.
            scores = query @ key.mT / query.shape[-1] ** 0.5
            mixed = scores.softmax(-1) @ value
        return self.output(mixed.transpose(1, 2).flatten(2))


class FeedForward(nn.Sequential):
    """Two linear layers."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, width))


class CrossTransformer(nn.Module):
    """Relates one cloud's features to another's; no positional encoding, since points carry none.

    The memory passes a self-attention layer, the queries a self-attention and a cross-attention layer, each with
    residual and layer normalisation.
    """

    def __init__(self, width: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.memory_attention, self.memory_forward = Attention(width, heads), FeedForward(width, hidden)
        self.self_attention, self.cross_attention = Attention(width, heads), Attention(width, heads)
        self.forward_layer = FeedForward(width, hidden)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(7))

    def forward(self, x: Float[Tensor, "b n c"], memory: Float[Tensor, "b m c"]) -> Float[Tensor, "b n c"]:
        """Features of x that know the memory; the caller adds the paper's residual."""
        memory = self.norms[0](memory + self.memory_attention(memory, memory))
        memory = self.norms[2](self.norms[1](memory + self.memory_forward(memory)))
        x = self.norms[3](x + self.self_attention(x, x))
        x = self.norms[4](x + self.cross_attention(x, memory))
        return self.norms[6](self.norms[5](x + self.forward_layer(x)))


EXACT = "donot_use_mm_for_euclid_dist"
"""Mode of `torch.cdist` for the placed hand's distances: the matrix-product form loses half of the digits."""
PLACE_SCALE = 10.0
"""Factor of the placed hand's coordinates, a tenth of a metre large, at the network's input [1/m]. Source: ours."""


@dataclass(frozen=True)
class Moves:
    """Open hands as draws of z move them, before any distance is predicted."""

    hand_features: Float[Tensor, "b n width"]
    object_features: Float[Tensor, "b m width"]
    obj: Float[Tensor, "b m 3"]  # in the network's frame [m]
    z: Float[Tensor, "b k latent"]
    points: Float[Tensor, "b k n 3"]
    """The hand that each z moves, in the network's frame [m]; where z moves nothing, the open hand."""

    def pick(self, rows: Int[Tensor, " c"], draws: Int[Tensor, " c"]) -> Moves:
        """One draw each of some of the hands."""
        return Moves(self.hand_features[rows], self.object_features[rows], self.obj[rows],
                     self.z[rows, draws][:, None], self.points[rows, draws][:, None])


@dataclass(frozen=True)
class NetworkOutput:
    """Result of one forward pass in training."""

    distances: Float[Tensor, "b n columns"]  # D(R,O) [m]
    mean: Float[Tensor, "b latent"]  # of the posterior of z, as its log-variance
    log_variance: Float[Tensor, "b latent"]
    flow_error: Float[Tensor, " b"]  # squared velocity error of the flow to z; zero in the paper's form
    moved: Float[Tensor, "b n 3"]  # the placed hand, moved by z if z moves it [m]


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
        latent_width = c.latent_head[0]
        self.motion = latent.HandMotion(c.width, c.latent, latent_width) if c.placed else None
        self.latent_encoder = None if c.placed else latent.LatentEncoder(
            c.width, c.latent, c.latent_widths, c.latent_head, c.latent_neighbours)
        self.condition = latent.Condition(c.width, latent_width) if c.placed else None
        self.prior = latent.FlowPrior(c.latent, latent_width) if c.placed else None
        self.head = DistanceHead(c.width + c.latent, c.kernel_hidden, c.initial_distance)
        self.place = nn.Linear(3, c.width) if c.placed else None
        self.placement = PlacementPrior(c.placement_width, c.placement_components) if c.placed else None

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
        """Features that know the other cloud, and the place of the hand [m] if the network knows it."""
        if self.place is not None:
            hand_features = hand_features + self.place(hand * PLACE_SCALE)
        with self._products(hand):
            related = self.hand_transformer(hand_features, obj_features), self.object_transformer(obj_features, hand_features)
        return related[0].float() + hand_features, related[1].float() + obj_features

    def _products(self, like: Float[Tensor, "..."]) -> AbstractContextManager[object]:
        """bfloat16 products if they are asked for; not every kind of device knows them."""
        return torch.autocast(like.device.type, torch.bfloat16) if self.mixed else nullcontext()

    def forward(
        self, hand: Float[Tensor, "b n 3"], obj: Float[Tensor, "b m 3"], grasp: Float[Tensor, "b n 3"],
        generator: torch.Generator, columns: int | None = None,
    ) -> NetworkOutput:
        """One training pass: z comes from the true grasp. All clouds are in the frame of the configuration [m].

        Args:
            hand: The open hand.
            generator: Source of the draws of z, on the clouds' device.
            columns: Compute distances to this many leading object points only; the order must be random.
        """
        phi_hand, phi_object = self.encode(hand, obj)
        psi = None  # in the paper's form z moves nothing, so the clouds are related before z is known
        if self.motion is not None:
            mean, log_variance = self.motion.encode(phi_hand, hand, grasp)
        else:
            psi = self.relate(phi_hand, phi_object, hand)
            assert self.latent_encoder is not None
            with self._products(hand):
                mean, log_variance = self.latent_encoder(torch.cat([grasp, obj], 1), torch.cat(psi, 1))
            mean, log_variance = mean.float(), log_variance.float()
        z = latent.sample_posterior(mean, log_variance, generator)
        moved = self._moved(phi_hand, hand, z[:, None])[:, 0]
        psi_hand, psi_object = psi or self.relate(phi_hand, phi_object, moved)
        distances = self._distances(psi_hand, psi_object[:, :columns], z, moved, obj[:, :columns])
        flow_error = z.new_zeros(len(z))
        if self.prior is not None and self.condition is not None:
            flow_error = self.prior.loss(z, self.condition(phi_hand, phi_object, hand, obj), generator)
        return NetworkOutput(distances, mean, log_variance, flow_error, moved)

    def _moved(
        self, features: Float[Tensor, "b n width"], hand: Float[Tensor, "b n 3"], z: Float[Tensor, "b k latent"]
    ) -> Float[Tensor, "b k n 3"]:
        if self.motion is None:  # z moves nothing
            return hand[:, None].expand(-1, z.shape[1], -1, -1)
        return self.motion(features, hand, z)

    @property
    def z_moves(self) -> bool:
        """Whether z moves the hand, so that draws can be told apart before distances are predicted."""
        return self.motion is not None

    def predict(
        self, hand: Float[Tensor, "b n 3"], obj: Float[Tensor, "b m 3"], noise: Float[Tensor, "b latent"]
    ) -> Float[Tensor, "b n m"]:
        """D(R,O) [m] of one z for each hand, which the prior makes of draws of `sample_latent`."""
        return self.distances(self.move(hand, obj, noise[:, None]))

    def move(
        self, hand: Float[Tensor, "b n 3"], obj: Float[Tensor, "b m 3"], noise: Float[Tensor, "b k latent"]
    ) -> Moves:
        """The open hand as each z moves it; arguments as those of `predict`, with k draws for each hand."""
        with fast_products():
            phi_hand, phi_object = self.encode(hand, obj)
            z = noise
            if self.condition is not None and self.prior is not None:
                condition = self.condition(phi_hand, phi_object, hand, obj)[:, None].expand(-1, noise.shape[1], -1)
                z = self.prior(noise.flatten(0, 1), condition.flatten(0, 1)).unflatten(0, noise.shape[:2])
            return Moves(phi_hand, phi_object, obj, z, self._moved(phi_hand, hand, z))

    def distances(self, moves: Moves) -> Float[Tensor, "b n m"]:
        """D(R,O) [m] of hands with one draw of z each."""
        z, points = moves.z[:, 0], moves.points[:, 0]
        with fast_products():
            psi_hand, psi_object = self.relate(moves.hand_features, moves.object_features, points)
            return self._distances(psi_hand, psi_object, z, points, moves.obj)

    def _distances(
        self, psi_hand: Float[Tensor, "b n width"], psi_object: Float[Tensor, "b m width"], z: Float[Tensor, "b latent"],
        hand: Float[Tensor, "b n 3"], obj: Float[Tensor, "b m 3"],
    ) -> Float[Tensor, "b n m"]:
        base = torch.cdist(hand, obj, compute_mode=EXACT) if self.config.placed else None
        with_z = (torch.cat([psi, z[:, None].expand(-1, psi.shape[1], -1)], -1) for psi in (psi_hand, psi_object))
        return self.head(*with_z, base)

    def to_frame(
        self, points: Float[Tensor, "b n 3"], centre: Float[Tensor, "b 3"], rotation: Float[Tensor, "b 3 3"]
    ) -> Float[Tensor, "b n 3"]:
        """Points of the object's frame in the network's frame, about the centre of the object's cloud [m].

        `rotation` are the hand's axes (`NetworkConfig.axes`) in the object's frame.
        """
        centred = points - centre[:, None]
        return centred @ rotation if self.config.placed else centred

    def sample_latent(self, num: int, generator: torch.Generator, temperature: float = 1.0) -> Float[Tensor, "num latent"]:
        """Draws that `predict` and `move` turn into z, on the network's device; in the paper's form they are z.

        Their standard deviation is `temperature`: 1 as in training, 0 for the likeliest z.
        """
        noise = torch.randn(num, self.config.latent, generator=generator, device=generator.device) * temperature
        return noise.to(self.head.first.weight.device)

    def sample_placements(
        self, obj: Float[Tensor, "m 3"], rotations: Float[Tensor, "r 3 3"], num: int, generator: torch.Generator,
        proportions: Float[Tensor, " f"],
    ) -> tuple[Float[Tensor, "num 3 3"], Float[Tensor, "num 3"]]:
        """Rotations of the hand's axes, and positions of the grasp centre in them about the object's centre [m].

        A network that knows the placement chooses by its prior among `rotations` of the hand's axes (`NetworkConfig.axes`),
        which are in random order. The paper's takes the first, centred on the object: it has no prior, and does not see the
        position.

        Args:
            obj: The object's cloud in its own frame [m].
            generator: Source of randomness, on the CPU.
            proportions: Of the hand in these axes.
        """
        if self.placement is None:
            return rotations[:num], rotations.new_zeros(num, 3)
        return self.placement.sample(
            obj - obj.mean(0), proportions, rotations, num, generator, self.config.placement_temperature)


def untrained_network(config: NetworkConfig, seed: int, name: str = "untrained") -> DistanceNetwork:
    """A network whose weights follow from the seed; PyTorch's global generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return DistanceNetwork(config, name)


def take_initial(model: DistanceNetwork, initial: DistanceNetwork) -> None:
    """Copy all weights of a network of the same configuration."""
    # Settings such as the frame change what the weights mean, but no shape.
    if other := model.config.differences(initial.config):
        told = ", ".join(f"{name} {mine} instead of {theirs}" for name, (mine, theirs) in other.items())
        raise WeightsError(f"the initial weights '{initial.name}' have another configuration than is asked for: {told}; train "
                           "with theirs, which `train --initial` does with the preset left out")
    model.load_state_dict(initial.state_dict())


def take_weights(model: nn.Module, given: nn.Module, name: str) -> None:
    """Copy the weights of a part of another network; `name` is that network's."""
    try:
        model.load_state_dict(given.state_dict())
    except RuntimeError as error:
        first = str(error).split("\n\t")[1].rstrip(". ")
        raise WeightsError(f"weights '{name}' do not fit this network: {first}; train with the configuration of these "
                           "weights") from error


def take_pretrained(model: DistanceNetwork, pretrained: DistanceNetwork) -> None:
    """Copy the hand encoder, and the motion where z moves the hand."""
    if pretrained.config.neighbours != model.config.neighbours:
        raise WeightsError(f"the hand encoder of '{pretrained.name}' sees {pretrained.config.neighbours} neighbours of each "
                           f"point, this network at {model.config.neighbours}; pretrain with the network that is trained")
    take_weights(model.hand_encoder, pretrained.hand_encoder, pretrained.name)
    if pretrained.motion is not None and model.motion is None:
        raise WeightsError(f"weights '{pretrained.name}' hold a pretrained motion, but z does not move the hand in this "
                           "network; train in frame 'palm' (preset='multi')")
    if pretrained.motion is not None and model.motion is not None:
        take_weights(model.motion, pretrained.motion, pretrained.name)
