"""Training samples, drawn in batches from a bundle: tensors alone, without files and loader processes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dro_grasp.distance_matrix import Segments, segments_of
from dro_grasp.errors import BundleError
from dro_grasp.geometry.point_clouds import nearer_half
from dro_grasp.geometry.se3 import apply, compose, invert, random_rotations, roma, rotate
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.proportions import proportions
from dro_grasp.network.presets import NetworkConfig
from dro_grasp.training.config import AugmentationConfig
from dro_grasp.training.data.bundle.training_file import Bundle


@dataclass(frozen=True)
class HandSamples:
    """Samples of one hand. Everything is in the network's frame: about the object's centre."""

    hand: Hand  # thinned to the network's number of points
    placed: Float[Tensor, "b n 3"]
    """The open hand near the grasp [m]; centred on the object where the network does not know the placement."""
    grasp: Float[Tensor, "b n 3"]  # the hand in the grasp [m]
    obj: Float[Tensor, "b m 3"]  # the object [m], in random order
    normals: Float[Tensor, "b m 3"]
    T_frame_link: Float[Tensor, "b l 4 4"]  # true poses of all links in the grasp
    segments: Segments  # the hand's links, padded as those of the source's other hands are
    obj_hand: Float[Tensor, "b m 3"]  # the object in the axes of the true hand [m], for the placement prior
    obj_random: Float[Tensor, "b m 3"]  # the same in the axes of a random hand
    position: Float[Tensor, "b 3"]  # true position of the grasp centre in the hand's axes [m]
    proportions: Float[Tensor, " f"]


class SampleSource:
    """Draws samples of the bundle's hands; all randomness comes from the generator of each call."""

    def __init__(
        self, bundle: Bundle, network: NetworkConfig, augmentation: AugmentationConfig, device: torch.device | str = "cpu"
    ) -> None:
        self.network, self.augmentation = network, augmentation
        if bundle.n_grasps == 0:
            raise BundleError("the bundle holds no grasps; synthesize some first")
        self.hands = {name: hand.with_points(network.n_hand).to(device) for name, hand in bundle.hands.items()}
        self.grasps = {name: grasps.to(device) for name, grasps in bundle.grasps.items()}
        self.names = [name for name, grasps in bundle.grasps.items() if len(grasps.joints)]
        self.without = [name for name in bundle.hands if name not in self.names]  # for pretraining
        self.segments = segments_of([self.hands[name] for name in self.names], torch.device(device))
        self.proportions = {
            name: proportions(self.hands[name], network.axes(self.hands[name].palm_axes_wrist)) for name in self.names}
        self.points = torch.stack([cloud.points for cloud in bundle.objects.values()]).to(device)
        self.normals = torch.stack([cloud.normals for cloud in bundle.objects.values()]).to(device)
        self.centres = self.points.mean(1)

    def draw_hands(self, count: int, generator: torch.Generator, by_count: float = 0.0) -> list[str]:
        """Names of the hands of one step; none comes twice where there are enough.

        A hand is drawn in proportion to the number of its grasps to the power `by_count`, at 0 as often as any other.
        """
        device = generator.device
        if by_count == 0:
            order = torch.randperm(len(self.names), generator=generator, device=device).tolist()
        else:
            counts = torch.tensor([float(len(self.grasps[name].joints)) for name in self.names], device=device)
            order = torch.multinomial(counts**by_count, len(counts), generator=generator).tolist()
        return [self.names[order[i % len(order)]] for i in range(count)]

    def draw_kinematics(self, count: int, generator: torch.Generator) -> list[str]:
        """Names of the hands of one step of pretraining: half of them without grasps, where the bundle has any."""
        extra = count // 2 if self.without else 0
        order = torch.randperm(len(self.without), generator=generator, device=generator.device).tolist() if extra else []
        return self.draw_hands(count - extra, generator) + [self.without[order[i % len(order)]] for i in range(extra)]

    def draw_postures(
        self, name: str, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b n_dof"], Float[Tensor, "b 3"]]:
        """Wrist poses, joints, and centres of the objects [m] of random grasps; for a hand without, anything within limits."""
        hand = self.hands[name]
        if name in self.without:
            T = compose(random_rotations(count, generator), hand.grasp_centre_wrist.new_zeros(count, 3))
            return T, hand.random_joints(count, generator), hand.grasp_centres(T)
        T, joints, index = self._grasps(name, count, generator)
        return T, joints, self.centres[index]

    def _grasps(
        self, name: str, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b n_dof"], Int[Tensor, " b"]]:
        grasps = self.grasps[name]
        chosen = torch.randint(len(grasps.joints), (count,), generator=generator, device=generator.device)
        return grasps.T_object_wrist[chosen], grasps.joints[chosen], grasps.object_index[chosen]

    def draw(self, name: str, count: int, generator: torch.Generator) -> HandSamples:
        """Samples of one hand."""
        hand, (T, q, index) = self.hands[name], self._grasps(name, count, generator)
        points, normals = self._objects(index, generator)
        centre = points.mean(1)
        T_placed = self._placements(hand, T, generator) if self.network.placed else self._centred(hand, T, centre, generator)
        own = self.network.axes(hand.palm_axes_wrist)
        world = torch.eye(3, device=T.device).expand(count, 3, 3)
        axes = T_placed[:, :3, :3] @ own if self.network.placed else world
        T_frame_object = invert(compose(axes, centre))
        opened = hand.random_open_joints(count, generator)
        about_centre = points - centre[:, None]
        # Links of both poses in one pass: kernels are launched half as often.
        links = torch.cat([T_frame_object @ T_placed, T_frame_object @ T])[:, None] @ hand.tree.forward(torch.cat([opened, q]))
        placed, grasp = apply(links[:, hand.link_index], hand.link_points).chunk(2)
        own_row = self.names.index(name)
        return HandSamples(
            hand=hand, placed=placed, grasp=grasp, obj=about_centre @ axes, normals=normals @ axes,
            T_frame_link=links[count:], segments=self.segments.rows(slice(own_row, own_row + 1)).spread(count),
            obj_hand=about_centre @ (T[:, :3, :3] @ own),
            obj_random=about_centre @ random_rotations(count, generator),
            position=((hand.grasp_centres(T) - centre)[:, None] @ (T[:, :3, :3] @ own))[:, 0],
            proportions=self.proportions[name],
        )

    def draw_motions(
        self, name: str, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 3"]]:
        """Placed open hands, and the same hands with other joint values and a wrist pose as far off as placements are [m].

        Half of the joint values are those of grasps, the others are uniform within the limits. Axes are the network's, which
        knows the placement.
        """
        hand = self.hands[name]
        _, grasping, _ = self.draw_postures(name, count, generator)
        drawn = hand.random_joints(count, generator)
        known = torch.rand(count, 1, generator=generator, device=generator.device) < 0.5
        q = torch.where(known, grasping, drawn)
        turn = self.network.axes(hand.palm_axes_wrist).mT.expand(count, 3, 3)
        wrist = compose(turn, turn.new_zeros(3))
        near = self._placements(hand, torch.eye(4, device=generator.device).repeat(count, 1, 1), generator)
        opened = hand.random_open_joints(count, generator)
        return hand.points(opened, wrist), hand.points(q, wrist @ invert(near))

    def tilted(
        self, T: Float[Tensor, "b 4 4"], centre: Float[Tensor, "b 3"], generator: torch.Generator
    ) -> Float[Tensor, "b 3 3"]:
        """Wrist rotations of open hands near grasps with wrists T of objects about `centre` [m], if no placement is known."""
        toward = torch.nn.functional.normalize(centre - T[:, :3, 3], dim=-1)
        return random_turns(len(T), self.augmentation.tilt, generator, toward) @ T[:, :3, :3]

    def _centred(
        self, hand: Hand, T: Float[Tensor, "b 4 4"], centre: Float[Tensor, "b 3"], generator: torch.Generator
    ) -> Float[Tensor, "b 4 4"]:
        """Tilted wrists with the grasp centre in the object's, as at inference: a position that tells nothing of the grasp."""
        rotation = self.tilted(T, centre, generator)
        return compose(rotation, centre - rotation @ hand.grasp_centre_wrist)

    def _objects(
        self, index: Int[Tensor, " b"], generator: torch.Generator
    ) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 3"]]:
        m, device = self.network.n_object, generator.device
        twice = torch.randint(self.points.shape[1], (len(index), 2 * m), generator=generator, device=device)
        direction = torch.randn(len(index), 3, generator=generator, device=device)
        partial = torch.rand(len(index), 1, generator=generator, device=device) < self.augmentation.partial
        half = nearer_half(self.points[index[:, None], twice], direction)
        picks = twice.gather(1, torch.where(partial, half, torch.arange(m, device=device)))
        points, normals = self.points[index[:, None], picks], self.normals[index[:, None], picks]
        noise = torch.randn(points.shape, generator=generator, device=device) * self.augmentation.object_noise
        return points + noise, normals

    def _placements(self, hand: Hand, T: Float[Tensor, "b 4 4"], generator: torch.Generator) -> Float[Tensor, "b 4 4"]:
        """Wrist poses near the true ones: turned about the grasp centre, and shifted."""
        turn = random_turns(len(T), self.augmentation.placement_rotation, generator)
        centre = hand.grasp_centre_wrist
        shift = torch.randn(len(T), 3, generator=generator, device=generator.device) * self.augmentation.placement_shift
        moved = rotate(T[:, :3, :3], centre - rotate(turn, centre)) + shift
        return compose(T[:, :3, :3] @ turn, T[:, :3, 3] + moved)


def random_turns(
    count: int, largest: float, generator: torch.Generator, across: Float[Tensor, "count 3"] | None = None
) -> Float[Tensor, "count 3 3"]:
    """Rotations about random axes, perpendicular to unit vectors if given, by angles uniform up to the largest [rad]."""
    axis = torch.randn(count, 3, generator=generator, device=generator.device)
    if across is not None:
        axis = axis - (axis * across).sum(-1, keepdim=True) * across
    axis = torch.nn.functional.normalize(axis, dim=-1)
    angle = torch.rand(count, 1, generator=generator, device=generator.device) * largest
    return roma.rotvec_to_rotmat(axis * angle)
