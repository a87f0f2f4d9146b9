"""Training samples, drawn in batches from a bundle: tensors alone, without files and loader processes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dro_grasp import graphs
from dro_grasp.distance_matrix import Segments, segments_of, together
from dro_grasp.errors import BundleError
from dro_grasp.geometry.multilateration import THIN, thin_rows
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


@dataclass(frozen=True)
class Batch:
    """Samples of several hands, as tensors alone; fields are those of `HandSamples`."""

    placed: Float[Tensor, "b n 3"]
    grasp: Float[Tensor, "b n 3"]
    obj: Float[Tensor, "b m 3"]
    normals: Float[Tensor, "b m 3"]
    local: Float[Tensor, "b n 3"]  # the hands' points in the frames of their links [m]
    segments: Segments
    T_frame_link: Float[Tensor, "b l 4 4"]  # true poses of the segments' links
    obj_hand: Float[Tensor, "b m 3"]
    obj_random: Float[Tensor, "b m 3"]
    position: Float[Tensor, "b 3"]
    proportions: Float[Tensor, "b f"]
    thin: Int[Tensor, " k"] | None = None
    """Rows among which all thin clouds are, where a device would have to be waited for to find them."""

    @classmethod
    def of(cls, groups: Sequence[HandSamples], thin: Int[Tensor, " k"] | None = None) -> Batch:
        """The samples of some hands, one after the other."""
        def joined(name: str) -> Float[Tensor, "b ..."]:
            return torch.cat([getattr(group, name) for group in groups])

        return cls(
            **{name: joined(name) for name in ("placed", "grasp", "obj", "normals", "obj_hand", "obj_random", "position")},
            local=torch.cat([group.hand.link_points.expand(len(group.placed), -1, -1) for group in groups]),
            segments=together([group.segments for group in groups]),
            T_frame_link=torch.cat([group.T_frame_link[:, group.segments.links[0]] for group in groups]),
            proportions=torch.cat([group.proportions.expand(len(group.placed), -1) for group in groups]), thin=thin)


@dataclass(frozen=True)
class _Numbers:
    """Random numbers of samples, and constants of their hands; those of several hands are joined."""

    T: Float[Tensor, "b 4 4"]  # wrists of stored grasps in their objects' frames
    index: Int[Tensor, " b"]  # of the objects
    picks: Int[Tensor, "b m2"]  # points of the object, twice as many as are kept
    direction: Float[Tensor, "b 3"]  # from which half of the object is seen
    partial: Float[Tensor, "b 1"]  # uniform: small where half is seen
    noise: Float[Tensor, "b m 3"]  # normal, as are axis, shift and quaternion
    axis: Float[Tensor, "b 3"]
    angle: Float[Tensor, "b 1"]  # uniform: a share of the largest
    shift: Float[Tensor, "b 3"]  # unused where no placement is known
    axes: Float[Tensor, "b 3 3"]  # the network's axes in the wrist frame
    grasp_centre: Float[Tensor, "b 3"]  # in the wrist frame [m]
    quaternion: Float[Tensor, "b 4"]


NEARLY = 2.0  # Objects this many times as thick as a thin cloud may be thin as they are drawn. Source: ours


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
        self.axes = {name: network.axes(self.hands[name].palm_axes_wrist) for name in self.names}
        self.proportions = {name: proportions(self.hands[name], self.axes[name]) for name in self.names}
        self.points = torch.stack([cloud.points for cloud in bundle.objects.values()]).to(device)
        self.normals = torch.stack([cloud.normals for cloud in bundle.objects.values()]).to(device)
        self.centres = self.points.mean(1)
        spread = torch.linalg.eigvalsh(torch.stack([torch.cov(cloud.T) for cloud in self.points.cpu()]))[:, 0]
        thin = (spread < (NEARLY * THIN) ** 2).float()
        self.thin_share = max(float(thin[self.grasps[name].object_index.cpu()].mean()) for name in self.names)

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

    def draw_batch(
        self, hands: int, count: int, by_count: float, columns: int | None, generator: torch.Generator
    ) -> Batch:
        """So many samples of each of the hands of one step, whose first object points `columns` are decoded, if any are."""
        groups, thin = self.draw_all(self.draw_hands(hands, generator, by_count), count, generator), None
        if columns is not None and graphs.captures(generator.device):
            thin = thin_rows(torch.cat([group.obj[:, :columns] for group in groups]), self.thin_room(hands * count))
        return Batch.of(groups, thin)

    def thin_room(self, count: int) -> int:
        """How many of so many samples are of thin objects at most: four standard deviations more than are expected."""
        expected = self.thin_share * count
        return min(count, math.ceil(expected + 4 * math.sqrt(expected)))

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
        return self.draw_all([name], count, generator)[0]

    def draw_all(self, names: Sequence[str], count: int, generator: torch.Generator) -> list[HandSamples]:
        """So many samples of each of some hands; what does not depend on the hand is computed for all at once."""
        drawn = [self._numbers(name, count, generator) for name in names]
        n = _Numbers(*(torch.cat(values) for values in zip(*(vars(each).values() for each, _, _ in drawn), strict=True)))
        points, normals = self._objects(n)
        own, T, centre = n.axes, n.T, points.mean(1)
        T_placed = self._placed(n) if self.network.placed else self._centred(n, centre)
        axes = T_placed[:, :3, :3] @ own if self.network.placed else torch.eye(3, device=T.device).expand_as(own)
        T_frame_object = invert(compose(axes, centre))
        about_centre, rotation = points - centre[:, None], T[:, :3, :3] @ own
        values = {
            "obj": about_centre @ axes, "normals": normals @ axes, "obj_hand": about_centre @ rotation,
            "obj_random": about_centre @ roma.unitquat_to_rotmat(functional.normalize(n.quaternion, dim=-1)),
            "position": ((apply(T, n.grasp_centre) - centre)[:, None] @ rotation)[:, 0],
            "open": T_frame_object @ T_placed, "grasp": T_frame_object @ T,
        }
        parts = ({key: value[i * count: (i + 1) * count] for key, value in values.items()} for i in range(len(names)))
        return [self._posed(name, *joints, **part) for name, (_, *joints), part in zip(names, drawn, parts, strict=True)]

    def _numbers(
        self, name: str, count: int, generator: torch.Generator
    ) -> tuple[_Numbers, Float[Tensor, "b n_dof"], Float[Tensor, "b n_dof"]]:
        """Random numbers of a hand's samples, its constants, and the joints of the open hands and of the grasps."""
        hand, device, m = self.hands[name], generator.device, self.network.n_object
        T, q, index = self._grasps(name, count, generator)

        def normal(*shape: int) -> Float[Tensor, "..."]:
            return torch.randn(count, *shape, generator=generator, device=device)

        numbers = _Numbers(
            T=T, index=index, picks=torch.randint(self.points.shape[1], (count, 2 * m), generator=generator, device=device),
            direction=normal(3), partial=torch.rand(count, 1, generator=generator, device=device), noise=normal(m, 3),
            axis=normal(3), angle=torch.rand(count, 1, generator=generator, device=device),
            shift=normal(3) if self.network.placed else T[:, :3, 3], axes=self.axes[name].expand(count, 3, 3),
            grasp_centre=hand.grasp_centre_wrist.expand(count, 3), quaternion=T[:, 0])
        opened = hand.random_open_joints(count, generator)
        return dataclasses.replace(numbers, quaternion=normal(4)), opened, q

    def _posed(
        self, name: str, opened: Float[Tensor, "b n_dof"], q: Float[Tensor, "b n_dof"], **values: Float[Tensor, "b ..."]
    ) -> HandSamples:
        """Samples of one hand, whose links are posed in one pass for the open hands and the grasps."""
        hand, row = self.hands[name], self.names.index(name)
        wrists = torch.cat([values.pop("open"), values.pop("grasp")])
        links = wrists[:, None] @ hand.tree.forward(torch.cat([opened, q]))
        placed, grasp = apply(links[:, hand.link_index], hand.link_points).chunk(2)
        return HandSamples(
            hand=hand, placed=placed, grasp=grasp, T_frame_link=links[len(q):], proportions=self.proportions[name],
            segments=self.segments.rows(slice(row, row + 1)).spread(len(q)), **values)

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
        toward = functional.normalize(centre - T[:, :3, 3], dim=-1)
        return random_turns(len(T), self.augmentation.tilt, generator, toward) @ T[:, :3, :3]

    def _centred(self, n: _Numbers, centre: Float[Tensor, "b 3"]) -> Float[Tensor, "b 4 4"]:
        """Tilted wrists with the grasp centre in the object's, as at inference: a position that tells nothing of the grasp."""
        toward = functional.normalize(centre - n.T[:, :3, 3], dim=-1)
        rotation = turns(n.axis, n.angle * self.augmentation.tilt, toward) @ n.T[:, :3, :3]
        return compose(rotation, centre - rotate(rotation, n.grasp_centre))

    def _objects(self, n: _Numbers) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 3"]]:
        m, index = self.network.n_object, n.index[:, None]
        half = nearer_half(self.points[index, n.picks], n.direction)
        partial = n.partial < self.augmentation.partial
        picks = n.picks.gather(1, torch.where(partial, half, torch.arange(m, device=half.device)))
        points, normals = self.points[index, picks], self.normals[index, picks]
        return points + n.noise * self.augmentation.object_noise, normals

    def _placed(self, n: _Numbers) -> Float[Tensor, "b 4 4"]:
        turn = turns(n.axis, n.angle * self.augmentation.placement_rotation)
        return _moved(n.T, n.grasp_centre, turn, n.shift * self.augmentation.placement_shift)

    def _placements(self, hand: Hand, T: Float[Tensor, "b 4 4"], generator: torch.Generator) -> Float[Tensor, "b 4 4"]:
        """Wrist poses near the true ones: turned about the grasp centre, and shifted."""
        turn = random_turns(len(T), self.augmentation.placement_rotation, generator)
        shift = torch.randn(len(T), 3, generator=generator, device=generator.device) * self.augmentation.placement_shift
        return _moved(T, hand.grasp_centre_wrist, turn, shift)


def _moved(
    T: Float[Tensor, "b 4 4"], centre: Float[Tensor, "*#b 3"], turn: Float[Tensor, "b 3 3"], shift: Float[Tensor, "b 3"]
) -> Float[Tensor, "b 4 4"]:
    """Wrists turned about a point of theirs, and shifted in the world [m]."""
    moved = rotate(T[:, :3, :3], centre - rotate(turn, centre)) + shift
    return compose(T[:, :3, :3] @ turn, T[:, :3, 3] + moved)


def random_turns(
    count: int, largest: float, generator: torch.Generator, across: Float[Tensor, "count 3"] | None = None
) -> Float[Tensor, "count 3 3"]:
    """Rotations about random axes, perpendicular to unit vectors if given, by angles uniform up to the largest [rad]."""
    axis = torch.randn(count, 3, generator=generator, device=generator.device)
    angle = torch.rand(count, 1, generator=generator, device=generator.device) * largest
    return turns(axis, angle, across)


def turns(
    axis: Float[Tensor, "b 3"], angle: Float[Tensor, "b 1"], across: Float[Tensor, "b 3"] | None = None
) -> Float[Tensor, "b 3 3"]:
    """Rotations by angles [rad] about axes of any length, or about their parts perpendicular to unit vectors."""
    if across is not None:
        axis = axis - (axis * across).sum(-1, keepdim=True) * across
    return roma.rotvec_to_rotmat(functional.normalize(axis, dim=-1) * angle)
