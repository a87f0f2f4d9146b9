"""Training samples, made in batches from a bundle: no files, no loader processes, nothing but tensors."""

from __future__ import annotations

from dataclasses import dataclass

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.datasets.bundle.training_file import Bundle
from dro_grasp.errors import BundleError
from dro_grasp.geometry.point_clouds import nearer_half
from dro_grasp.hands.hand import Hand
from dro_grasp.models.network import NetworkConfig
from dro_grasp.training.config import AugmentationConfig


@dataclass(frozen=True)
class HandSamples:
    """Samples of one hand. Everything is in the network's frame: about the object's centre."""

    hand: Hand
    """Thinned to the network's number of points."""
    placed: Float[Tensor, "b n 3"]
    """The open hand near the grasp [m]."""
    grasp: Float[Tensor, "b n 3"]
    """The hand in the grasp [m]."""
    obj: Float[Tensor, "b m 3"]
    """The object [m], in random order."""
    normals: Float[Tensor, "b m 3"]
    """Its normals."""
    T_frame_link: Float[Tensor, "b l 4 4"]
    """True poses of all links in the grasp."""
    obj_hand: Float[Tensor, "b m 3"]
    """The object in the axes of the true hand [m], for the placement prior."""
    obj_random: Float[Tensor, "b m 3"]
    """The object in the axes of a random hand [m], for the placement prior."""
    position: Float[Tensor, "b 3"]
    """True position of the grasp centre in the hand's axes [m]."""


class SampleSource:
    """Draws samples of the bundle's hands; all randomness comes from one generator."""

    def __init__(
        self,
        bundle: Bundle,
        network: NetworkConfig,
        augmentation: AugmentationConfig,
        device: torch.device | str = "cpu",
    ) -> None:
        """Put everything on the device where samples are made.

        Args:
            bundle: Hands, objects and grasps.
            network: Numbers of points, and the frame.
            augmentation: How a sample differs from the stored grasp.
            device: Generators that samples are drawn with must be of the same device.

        Raises:
            BundleError: The bundle holds no grasps.
        """
        self.network, self.augmentation = network, augmentation
        if bundle.n_grasps == 0:
            raise BundleError("the bundle holds no grasps; synthesise some first")
        self.hands = {name: hand.with_points(network.n_hand).to(device) for name, hand in bundle.hands.items()}
        self.grasps = {name: grasps.to(device) for name, grasps in bundle.grasps.items()}
        self.names = [name for name, grasps in bundle.grasps.items() if len(grasps.joints)]
        self.points = torch.stack([cloud.points for cloud in bundle.objects.values()]).to(device)
        self.normals = torch.stack([cloud.normals for cloud in bundle.objects.values()]).to(device)

    def draw_hands(self, count: int, generator: torch.Generator) -> list[str]:
        """Names of the hands of one step, each as often as any other in the long run."""
        order = torch.randperm(len(self.names), generator=generator, device=generator.device).tolist()
        return [self.names[order[i % len(order)]] for i in range(count)]

    def draw(self, name: str, count: int, generator: torch.Generator) -> HandSamples:
        """Samples of one hand."""
        hand, grasps = self.hands[name], self.grasps[name]
        chosen = torch.randint(len(grasps.joints), (count,), generator=generator, device=generator.device)
        T, q = grasps.T_object_wrist[chosen], grasps.joints[chosen]
        points, normals = self._objects(grasps.object_index[chosen], generator)
        centre = points.mean(1)
        T_placed = self._placements(hand, T, generator)
        own = self.network.axes(hand)
        world = torch.eye(3, device=T.device).expand(count, 3, 3)
        axes = world if self.network.frame == "object" else T_placed[:, :3, :3] @ own
        T_frame_object = _frame(axes, centre)
        opened = hand.random_open_joints(count, generator)
        T_frame_wrist = T_frame_object @ T
        about_centre = points - centre[:, None]
        centre_of_grasp = (T[:, :3, :3] @ hand.grasp_centre_wrist) + T[:, :3, 3]
        return HandSamples(
            hand=hand, placed=hand.points(opened, T_frame_object @ T_placed), grasp=hand.points(q, T_frame_wrist),
            obj=about_centre @ axes, normals=normals @ axes,
            T_frame_link=T_frame_wrist[:, None] @ hand.tree.forward(q),
            obj_hand=about_centre @ (T[:, :3, :3] @ own),
            obj_random=about_centre @ random_rotations(count, generator),
            position=((centre_of_grasp - centre)[:, None] @ (T[:, :3, :3] @ own))[:, 0],
        )

    def draw_motions(
        self, name: str, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 3"]]:
        """Placed open hands, and the same hands with other joint angles and a wrist as far off as placements are [m].

        Half of the joint angles are those of grasps, the others uniform within the limits. Axes are those that the network
        works in, random ones where these are the object's.
        """
        hand, grasps = self.hands[name], self.grasps[name]
        chosen = torch.randint(len(grasps.joints), (count,), generator=generator, device=generator.device)
        drawn = hand.random_joints(count, generator)
        known = torch.rand(count, 1, generator=generator, device=generator.device) < 0.5
        q = torch.where(known, grasps.joints[chosen], drawn)
        wrist = torch.eye(4, device=generator.device).repeat(count, 1, 1)
        moved = torch.linalg.inv(self._placements(hand, wrist, generator))
        turn = random_rotations(count, generator) if self.network.frame == "object" else self.network.axes(hand).mT
        for T in (wrist, moved):
            T[:, :3] = turn @ T[:, :3]
        opened = hand.random_open_joints(count, generator)
        return hand.points(opened, wrist), hand.points(q, moved)

    def _objects(self, index: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Random object points with noise, and their normals (b m 3)."""
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
        placed = T.clone()
        placed[:, :3, :3] = T[:, :3, :3] @ turn
        placed[:, :3, 3] += (T[:, :3, :3] @ (centre - turn @ centre)[..., None])[..., 0] + shift
        return placed


def _frame(axes: Float[Tensor, "b 3 3"], centre: Float[Tensor, "b 3"]) -> Float[Tensor, "b 4 4"]:
    """T_frame_object of a frame with these axes at this place."""
    T = torch.eye(4, device=axes.device).repeat(len(axes), 1, 1)
    T[:, :3, :3] = axes.mT
    T[:, :3, 3] = -(axes.mT @ centre[..., None])[..., 0]
    return T


def random_turns(count: int, largest: float, generator: torch.Generator) -> Float[Tensor, "count 3 3"]:
    """Rotations about random axes by angles uniform up to the largest [rad]."""
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, device=generator.device), dim=-1)
    angle = torch.rand(count, 1, generator=generator, device=generator.device) * largest
    return roma.rotvec_to_rotmat(axis * angle)


def random_rotations(count: int, generator: torch.Generator) -> Float[Tensor, "count 3 3"]:
    """Rotations uniform on SO(3)."""
    quaternion = torch.randn(count, 4, generator=generator, device=generator.device)
    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))
