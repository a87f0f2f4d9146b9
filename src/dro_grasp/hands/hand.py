"""A robot hand as the method sees it: tree, surface points, anatomy, palm. Everything is derived, nothing annotated."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import cached_tensor, on_device
from dro_grasp.errors import OptionError
from dro_grasp.geometry import se3
from dro_grasp.geometry.point_clouds import farthest_points
from dro_grasp.hands.anatomy import PALM, THUMB_CLOSING, Finger, find_fingers, find_thumb, measure_opposition, rigid_groups
from dro_grasp.hands.kinematics.tree import KinematicTree
from dro_grasp.hands.names import named_thumb

if TYPE_CHECKING:
    from dro_grasp.hands.description.loader import Description

MIN_FINGER_OFFSET = 0.005  # Fingers whose middle is nearer than this to the palm's axis surround it [m] (ours)
MIN_REGISTRATION_POINTS = 4  # Fewest points that determine a link's pose, if they are not collinear
POINTS_PER_LINK = 6  # Points that each link keeps, if it has them, when a hand is thinned (ours)
STORED_AS = {"opening_signs": "opening", "contact_links": "touching"}  # Fields that training bundles hold under another name
DERIVED = {"fingers", "rigid_group", "thumb"}  # Fields that follow from the others; training bundles do not hold them


@dataclass(frozen=True)
class Hand:
    """A hand and everything that was derived from its description."""

    name: str
    """`allegro`, `assets/allegro_left`, or a file's stem."""
    tree: KinematicTree
    """Links, joints, limits, couplings."""
    link_points: Float[Tensor, "n_hand 3"]
    """Surface points in their links' frames [m], grouped by link."""
    link_normals: Float[Tensor, "n_hand 3"]
    """Outward unit normals of link_points, in their links' frames."""
    link_index: Int[Tensor, " n_hand"]
    """The link of each point, ascending."""
    fingers: tuple[Finger, ...]
    """The fingers, in the order of their tips in the tree."""
    rigid_group: tuple[int, ...]
    """For each link the topmost link that it is fixed to; links with the same one move together."""
    tip_offsets: Float[Tensor, "n_tips 3"]
    """Extra target beyond each fingertip, in its link's frame [m]. Source: appendix, URDF file preprocessing."""
    palm: int
    """The palm link: the last common ancestor of the fingertips."""
    palm_centre: Float[Tensor, "3"]
    """Middle of the palm's inner face, in the palm frame [m]."""
    palm_direction: Float[Tensor, "3"]
    """Unit vector out of the palm towards the object, in the palm frame."""
    grasp_centre: Float[Tensor, "3"]
    """Centre of the volume that the half-closed hand encloses, in the palm frame [m]."""
    opening_signs: Float[Tensor, " n_dof"]
    """+1 for joints that open towards their upper limit, -1 for those that open towards their lower limit."""
    open_ends: Float[Tensor, " n_dof"]
    """Where each joint is open [rad or m]: at a limit, or at the widest span of a finger that folds back beyond it."""
    movable: Bool[Tensor, " n_dof"]
    """False for joints above the palm, which are held at rest."""
    rest: Float[Tensor, " n_dof"]
    """Zero, or the nearest limit: the value of held joints [rad or m]."""
    abduction: Bool[Tensor, " n_dof"]
    """Joints that spread fingers and hardly close them."""
    contact_links: tuple[int, ...]
    """Links that can touch an object: the palm and links below it, if they have collision geometry."""
    sha256: str
    """Hash of the description."""
    thumb: int | None = None
    """Index of the finger that opposes the others; None for hands of up to three fingers (see `with_thumb`)."""
    description: Description | None = field(default=None, repr=False, compare=False)
    """The file behind the hand; None for a hand from a training bundle."""

    def __repr__(self) -> str:
        return f"Hand('{self.name}', {self.tree.n_dof} joints, {len(self.fingers)} fingers, {self.n_points} surface points)"

    @property
    def tips(self) -> tuple[int, ...]:
        """Fingertip links, one per finger."""
        return tuple(finger.tip for finger in self.fingers)

    @cached_tensor
    def finger_of_link(self) -> Int[Tensor, " n_links"]:
        """Index of the finger that each link belongs to, or PALM."""
        owner = torch.full((self.tree.n_links,), PALM, device=self.link_points.device)
        for index, finger in enumerate(self.fingers):
            owner[list(finger.links)] = index
        return owner

    @cached_tensor
    def thumb_opposition(self) -> Float[Tensor, " n_tips"]:
        """How much each finger closes against the others: -1 if all close alike, 1 if the others all close the opposite way."""
        rate = (self.closed_ends - self.open_ends) * (self.movable & ~self.abduction)
        return measure_opposition(self.tree, self.canonical_joints(1 - THUMB_CLOSING), rate, self.tips, self.tip_offsets)

    def with_thumb(self) -> Hand:
        """The same hand with its thumb found."""
        named = named_thumb([[self.tree.link_names[link] for link in finger.links] for finger in self.fingers])
        return dataclasses.replace(self, thumb=find_thumb(self.thumb_opposition, named))

    @cached_tensor
    def closed_ends(self) -> Float[Tensor, " n_dof"]:
        """The limit towards which each joint closes [rad or m]."""
        return torch.where(self.opening_signs > 0, self.tree.lower, self.tree.upper)

    @cached_tensor
    def open_limits(self) -> Float[Tensor, " n_dof"]:
        """The limit towards which each joint opens [rad or m]; it opens that far unless its finger folds back."""
        return torch.where(self.opening_signs > 0, self.tree.upper, self.tree.lower)

    @cached_tensor
    def lower(self) -> Float[Tensor, " n_dof"]:
        """Least value of each joint in use [rad or m]: its lower limit, or its open end."""
        return torch.minimum(self.open_ends, self.closed_ends)

    @cached_tensor
    def upper(self) -> Float[Tensor, " n_dof"]:
        """Greatest value of each joint in use [rad or m]: its upper limit, or its open end."""
        return torch.maximum(self.open_ends, self.closed_ends)

    @cached_tensor
    def neutral(self) -> Float[Tensor, " n_dof"]:
        """Zero, or what is nearest to it a quarter of a joint's range inside its limits [rad or m]."""
        margin = 0.25 * (self.tree.upper - self.tree.lower)
        return torch.zeros_like(margin).clamp(self.tree.lower + margin, self.tree.upper - margin)

    @property
    def n_points(self) -> int:
        """Number of surface points."""
        return len(self.link_points)

    @property
    def wrist_link(self) -> str:
        """Name of the description's root link, whose pose is the wrist pose of a grasp."""
        return self.tree.link_names[0]

    @cached_tensor
    def registrable(self) -> Bool[Tensor, " n_links"]:
        """Links whose pose their own points determine."""
        mask = torch.zeros(self.tree.n_links, dtype=torch.bool, device=self.link_points.device)
        for link in self.link_index.unique().tolist():
            points = self.link_points[self.link_index == link]
            if len(points) >= MIN_REGISTRATION_POINTS:
                spread = torch.linalg.svdvals(points - points.mean(0))
                mask[link] = bool(spread[1] > 1e-4)
        return mask

    def limited_to_use(self) -> Hand:
        """The same hand, whose joints have their open and closed ends as limits; this hand if they do already."""
        if torch.equal(self.lower, self.tree.lower) and torch.equal(self.upper, self.tree.upper):
            return self
        return dataclasses.replace(self, tree=dataclasses.replace(self.tree, lower=self.lower, upper=self.upper))

    def canonical_joints(self, openness: float = 0.75) -> Float[Tensor, " n_dof"]:
        """Open-hand joints [rad or m]: this share of the way from the closed to the open end; held joints at rest."""
        return self._opened(self.rest.new_full((self.tree.n_dof,), openness))

    def random_open_joints(self, n: int, generator: torch.Generator) -> Float[Tensor, "n n_dof"]:
        """Open hands like those the network is trained on: openness uniform in 0.65 to 0.85, one draw per hand."""
        share = 0.65 + 0.2 * torch.rand(n, 1, generator=generator, device=generator.device).to(self.rest)
        return self._opened(share.expand(n, self.tree.n_dof))

    def random_joints(self, n: int, generator: torch.Generator) -> Float[Tensor, "n n_dof"]:
        """Joints uniform between their open and closed ends [rad or m]; held joints at rest."""
        share = torch.rand(n, self.tree.n_dof, generator=generator, device=generator.device).to(self.rest)
        return torch.where(self.movable, self.lower + share * (self.upper - self.lower), self.rest)

    def _opened(self, share: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, "*batch n_dof"]:
        """Joints this share of the way from closed to open; held joints at rest, those that only spread fingers neutral."""
        q = torch.where(self.movable, self.open_ends * share + self.closed_ends * (1 - share), self.rest)
        return torch.where(self.abduction & self.movable, self.neutral, q)

    def points(
        self, q: Float[Tensor, "*batch n_dof"], T_world_wrist: Float[Tensor, "*batch 4 4"] | None = None
    ) -> Float[Tensor, "*batch n_hand 3"]:
        """Surface points of the posed hand [m], in the world frame, or in the wrist frame if no wrist pose is given."""
        return se3.apply(self._point_poses(q, T_world_wrist), self.link_points)

    def points_and_normals(
        self, q: Float[Tensor, "*batch n_dof"], T_world_wrist: Float[Tensor, "*batch 4 4"] | None = None
    ) -> tuple[Float[Tensor, "*batch n_hand 3"], Float[Tensor, "*batch n_hand 3"]]:
        """The same points, and the outward unit normals there."""
        T = self._point_poses(q, T_world_wrist)
        return se3.apply(T, self.link_points), se3.rotate(T[..., :3, :3], self.link_normals)

    def _point_poses(
        self, q: Float[Tensor, "*batch n_dof"], T_world_wrist: Float[Tensor, "*batch 4 4"] | None
    ) -> Float[Tensor, "*batch n_hand 4 4"]:
        poses = self.tree.forward(q)
        if T_world_wrist is not None:
            poses = T_world_wrist[..., None, :, :] @ poses
        return poses[..., self.link_index, :, :]

    def T_wrist_palm(self, q: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, "*batch 4 4"]:
        """Pose of the palm link in the wrist (root link) frame."""
        return self.tree.forward(q)[..., self.palm, :, :]

    @cached_tensor
    def T_wrist_palm_rest(self) -> Float[Tensor, "4 4"]:
        """The same for held joints at rest: a constant of the hand, as no movable joint lies above the palm."""
        return self.T_wrist_palm(self.canonical_joints())

    @cached_tensor
    def grasp_centre_wrist(self) -> Float[Tensor, "3"]:
        """grasp_centre in the wrist frame [m]."""
        return se3.apply(self.T_wrist_palm_rest, self.grasp_centre)

    @cached_tensor
    def palm_centre_wrist(self) -> Float[Tensor, "3"]:
        """palm_centre in the wrist frame [m]."""
        return se3.apply(self.T_wrist_palm_rest, self.palm_centre)

    @cached_tensor
    def palm_direction_wrist(self) -> Float[Tensor, "3"]:
        """palm_direction in the wrist frame."""
        return se3.rotate(self.T_wrist_palm_rest[:3, :3], self.palm_direction)

    @cached_tensor
    def palm_axes_wrist(self) -> Float[Tensor, "3 3"]:
        """Axes that every hand has, as columns in the wrist frame: along the fingers, across them, and the palm direction.

        The first axis points from the middle of the palm to that of the open fingers. If the fingers surround the palm evenly,
        as those of some grippers do, it is one of many that would serve.
        """
        points = self.points(self.canonical_joints())
        palm = self.link_index == self.palm
        if not palm.any():
            palm = self.finger_of_link[self.link_index] == PALM
        # Not `finger_of_link`: the shipped weights learned axes for which links fixed to the palm count among the fingers.
        fingers = torch.isin(self.link_index, torch.tensor(self.contact_links, device=points.device)) & ~palm
        z = torch.nn.functional.normalize(self.palm_direction_wrist, dim=0)
        offset = points[fingers].mean(0) - points[palm].mean(0)
        helper = torch.eye(3, device=z.device)[z.abs().argmin()]
        along = offset - (offset @ z) * z
        along = along if float(along.norm()) > MIN_FINGER_OFFSET else helper - (helper @ z) * z
        x = torch.nn.functional.normalize(along, dim=0)
        return torch.stack([x, torch.linalg.cross(z, x), z], -1)

    def to(self, device: torch.device | str) -> Hand:
        """The same hand with its tensors on another device; this hand if they are there already."""
        if torch.empty(0, device=device).device == self.link_points.device:  # "cuda" is the current one of several
            return self
        return on_device(self, device)

    def grasp_centres(self, T_world_wrist: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 3"]:
        """The grasp centre of hands at the given wrist poses [m]."""
        return se3.apply(T_world_wrist, self.grasp_centre_wrist)

    def palm_directions(self, T_world_wrist: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 3"]:
        """The palm direction of hands at the given wrist poses."""
        return se3.rotate(T_world_wrist[..., :3, :3], self.palm_direction_wrist)

    def with_points(self, count: int) -> Hand:
        """The same hand with fewer points, spread evenly; each link keeps POINTS_PER_LINK if it has them.

        Raises:
            OptionError: More points are asked for than the hand has, or none.
        """
        if not 0 < count <= self.n_points:
            raise OptionError(f"hand '{self.name}' has {self.n_points} points, {count} were asked for")
        if count == self.n_points:
            return self
        rank = self.spread_rank
        per_link = max(1, min(POINTS_PER_LINK, count // max(1, len(self.link_index.unique()))))
        first = torch.zeros(self.n_points, dtype=torch.bool, device=rank.device)
        for link in self.link_index.unique().tolist():
            members = (self.link_index == link).nonzero()[:, 0]
            first[members[rank[members].argsort()[:per_link]]] = True
        priority = torch.where(first, rank - self.n_points, rank)
        keep = priority.argsort()[:count].sort().values
        return dataclasses.replace(self, link_points=self.link_points[keep], link_normals=self.link_normals[keep],
                                   link_index=self.link_index[keep])

    @cached_tensor
    def spread_rank(self) -> Int[Tensor, " n_hand"]:
        """Place of each point in a farthest point sampling of the open hand: points of low rank are spread evenly."""
        order = farthest_points(self.points(self.canonical_joints()), self.n_points)
        return torch.empty_like(order).index_copy(0, order, torch.arange(self.n_points, device=order.device))

    def to_tensors(self) -> dict[str, Any]:
        """Tensors and plain values that `from_tensors` turns back into this hand, without its description."""
        own = {f.name for f in dataclasses.fields(self)} - {"tree", "description"} - DERIVED
        stored = {STORED_AS.get(name, name): getattr(self, name) for name in own}
        return {**stored, "tips": self.tips, **{f"tree.{k}": v for k, v in self.tree.fields().items()}}

    @staticmethod
    def from_tensors(values: dict[str, Any]) -> Hand:
        """The inverse of `to_tensors`; takes lists for tuples."""
        plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        tree = KinematicTree(**{k.removeprefix("tree."): plain.pop(k) for k in list(plain) if k.startswith("tree.")})
        fingers = find_fingers(tree, plain.pop("tips"), plain["palm"])
        named = {stored: name for name, stored in STORED_AS.items()}
        own = {named.get(k, k): v for k, v in plain.items()}
        # Bundles made before hands had open ends hold hands that open as far as they go.
        own.setdefault("open_ends", torch.where(own["opening_signs"] > 0, tree.upper, tree.lower))
        return Hand(tree=tree, fingers=fingers, rigid_group=rigid_groups(tree), **own).with_thumb()
