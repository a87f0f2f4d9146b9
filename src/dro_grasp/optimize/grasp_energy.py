"""The grasp energy of one hand on one object: the weighted terms and their gradient, and where the hand may be and touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import Rows, on_device
from dro_grasp.geometry import se3
from dro_grasp.geometry.distance_field import Balls, DistanceField, DistanceFields
from dro_grasp.grasps.controller_config import ControllerConfig
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize import terms as energies
from dro_grasp.optimize.contacts import (
    ContactCandidates,
    ContactConfig,
    LinkPoints,
    LinkSpheres,
    contact_candidates,
    link_spheres,
    tip_links,
)
from dro_grasp.optimize.terms import PointTerm


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Signed distances to whatever is nearest, negative inside."""

    plane: Float[Tensor, "4"] | None = None  # upward unit normal of a plane, and its height along the normal [m]
    obstacles: DistanceField | None = None  # signed distances of other things
    keep_out: Balls | None = None  # places where the hand is not wanted
    touch_plane: bool = False  # whether fingertips may touch the plane

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """Normal of the plane."""
        return None if self.plane is None else self.plane[:3]

    @property
    def parts(self) -> dict[str, Surroundings]:
        """The same one by one: plane, obstacles, keep_out."""
        return {name: Surroundings(**{name: part}, touch_plane=self.touch_plane) for name in ("plane", "obstacles", "keep_out")
                if (part := getattr(self, name)) is not None}

    def distances(
        self, points: Float[Tensor, "*b 3"], leave: Float[Tensor, "*#b"] | None = None
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient, as of a `DistanceField`; points count as `leave` farther from the plane [m]."""
        distance, gradient = torch.full_like(points[..., 0], torch.inf), torch.zeros_like(points)
        if self.plane is not None:
            distance, gradient = points @ self.plane[:3] - self.plane[3], self.plane[:3].expand_as(points)
            distance = distance if leave is None else distance + leave
        for part in (self.obstacles, self.keep_out):
            if part is not None:
                other, slope = part.distances(points)
                nearer = other < distance
                distance = torch.where(nearer, other, distance)
                gradient = torch.where(nearer[..., None], slope, gradient)
        return distance, gradient

    def lift(self, points: Float[Tensor, "*b p 3"], clear: float) -> Float[Tensor, "*b 3"]:
        """The shift up the plane's normal that brings points this far above it [m]; none where they are already."""
        if self.plane is None:
            return torch.zeros_like(points[..., 0, :])
        lowest = (points @ self.plane[:3]).amin(-1) - self.plane[3]
        return (clear - lowest).clamp_min(0)[..., None] * self.plane[:3]

    def to(self, device: torch.device | str) -> Surroundings:
        """The same on another device."""
        plane = None if self.plane is None else self.plane.to(device)
        obstacles = None if self.obstacles is None else on_device(self.obstacles, device)
        keep_out = None if self.keep_out is None else on_device(self.keep_out, device)
        return Surroundings(plane, obstacles, keep_out, self.touch_plane)


@dataclass(frozen=True)
class ContactRegionTerm:
    """A place on an object, as balls, in which all contacts are to be."""

    place: Balls
    clear: float  # distance that the hand keeps from the object elsewhere [m]

    def beside(self, points: Float[Tensor, "*b p 3"]) -> Bool[Tensor, "*b p"]:
        """Which points are outside the place."""
        return self.place.distances(points)[0] > 0

    def pull(self, contacts: Float[Tensor, "*b c 3"]) -> PointTerm:
        """Distance of each contact to the place [m]; zero inside."""
        distance, gradient = self.place.distances(contacts)
        outside = (distance > 0).to(distance.dtype)
        return PointTerm(distance * outside, gradient * outside[..., None])

    def push(
        self, points: Float[Tensor, "*b p 3"], distance: Float[Tensor, "*b p"], gradient: Float[Tensor, "*b p 3"]
    ) -> PointTerm:
        """How much nearer than `clear` each hand point outside the place is to the object [m], by its signed distance [m]."""
        near = (self.beside(points) & (distance < self.clear)).to(distance.dtype)
        return PointTerm((self.clear - distance) * near, -gradient * near[..., None])


TIP_HEIGHT = 0.0005
"""Height over a table that fingertips keep which may touch it, where other points of the hand keep `clear` [m] (ours)."""
PRESSED = 0.02
"""Depth in a table up to which such a fingertip may be told to squeeze [m] (ours): the table stops it."""


class ClearanceTerm(NamedTuple):
    """The weighted term with its gradient."""

    value: Float[Tensor, "n 1"]
    by_pose: Float[Tensor, "n 6"]
    by_joint: Float[Tensor, "n n_dof"]


class Clearance:
    """Keeps surface points, and the spheres that fill the links, out of the surroundings."""

    def __init__(
        self, hand: Hand, surroundings: Surroundings, body: LinkPoints, ball: LinkPoints, radii: Float[Tensor, " s"],
        clear: float, weight: float,
    ) -> None:
        """Surface points, centres and radii of spheres [m], distance to keep [m], weight of the summed penetration [1/m]."""
        self.hand, self.surroundings, self.weight, self.clear = hand, surroundings, weight, clear
        # Of a plane, the spheres know nothing that surface points do not know; other things may be thin or small.
        filled = surroundings.obstacles is not None or surroundings.keep_out is not None
        self.parts = ((body, torch.zeros_like(body.layout[0])), (ball, radii))[: 1 + filled]
        tips = torch.tensor(tip_links(hand) if surroundings.touch_plane else [], device=radii.device)
        self.tips = [torch.isin(points.members.argmax(-1), tips).to(radii) for points, _ in self.parts]
        config, moving = ControllerConfig(), hand.movable & ~hand.abduction
        self.postures = [
            (end, torch.where(moving, share, 0.0).to(end))
            for end, share in ((hand.open_ends, config.outer), (hand.closed_ends, config.inner))]
        """Pregrasp and squeeze: where each joint moves to from the grasp, and how much of the way."""
        low = clear - TIP_HEIGHT
        self.leaves = torch.tensor([low, low, clear + PRESSED], device=radii.device)
        """How much nearer than other points fingertips may come to a table that they may touch, in grasp, pregrasp and squeeze
        [m]."""

    def __call__(
        self, T: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], poses: Float[Tensor, "n n_links 4 4"],
        pivot: Float[Tensor, "n 3"],
    ) -> ClearanceTerm:
        """The term of n grasps, from wrist poses, joints, poses of links, and the points about which hands turn [m]."""
        tree, n = self.hand.tree, len(q)
        joints = torch.cat([q[:0], *(q + share * (end - q) for end, share in self.postures)])
        follow = torch.cat([torch.ones_like(q), *((1 - share).expand_as(q) for _, share in self.postures)])
        poses = torch.cat([poses, T.repeat(len(self.postures), 1, 1)[:, None] @ tree.forward(joints)])
        depth, wrenches = poses.new_zeros(len(poses)), poses.new_zeros(*poses.shape[:2], 6)
        leaves = self.leaves[: len(poses) // n].repeat_interleave(n)[:, None]
        for (points, radii), tips in zip(self.parts, self.tips, strict=True):
            placed = points.place(poses)
            distance, gradient = self.surroundings.distances(placed, leaves * tips)
            inside = energies.penetration(distance - radii - self.clear, gradient)
            depth = depth + inside.value.sum(-1)
            wrenches = wrenches + energies.link_wrenches(placed, self.weight * inside.by_point, points.members)
        by_pose, by_joint = energies.joint_gradient(tree, poses, wrenches, pivot.repeat(len(follow) // n, 1))
        value, by_pose, by_joint = (
            x.unflatten(0, (-1, n)).sum(0) for x in (self.weight * depth[:, None], by_pose, by_joint * follow))
        return ClearanceTerm(value, by_pose, by_joint)

    def distance(
        self, T: Float[Tensor, "*n 4 4"], q: Float[Tensor, "*n n_dof"], surroundings: Surroundings | None = None,
        leave: float = 0.0,
    ) -> Float[Tensor, "*n"]:
        """Least distance of hands to the surroundings, or to others [m].

        Fingertips that may touch a table count as `leave` farther from it [m].
        """
        poses = (T[..., None, :, :] @ self.hand.tree.forward(q)).flatten(0, -4)
        around = surroundings or self.surroundings
        nearest = [(around.distances(points.place(poses), leave * tips)[0] - radii).amin(-1)
                   for (points, radii), tips in zip(self.parts, self.tips, strict=True)]
        return torch.stack(nearest).amin(0).reshape(q.shape[:-1])


TERMS = ("force_closure", "distance", "penetration", "self_penetration", "alignment", "joints")
"""Names of the terms, in the order of every array of terms."""


@dataclass(frozen=True)
class EnergyConfig(Checked):
    """Weights and geometry of the energy. Source: DexGraspNet, unless stated otherwise."""

    force_closure: float = 1.0  # weight of the squared net wrench
    distance: float = 100.0  # weight of the contacts' distance to the surface [1/m]
    penetration: float = 100.0  # weight of the hand points' penetration into the object [1/m]
    filled: bool = False
    """Whether penetration is also measured at the spheres that fill the links, with the same weight (ours): a thin object
    finds its way between the hand points."""
    self_penetration: float = 50.0  # weight of self-penetration [1/m] (DexGraspNet: 10; its spheres are finer)
    alignment: float = 1.0  # weight of the angle between hand and object normals (ours)
    joints: float = 1.0  # weight of joints closer to their closed end than `closing_room` [1/rad or 1/m]
    closing_room: float = 0.1  # share of a joint's range that is kept for the squeeze (ours)
    hand_points: int = 200  # number of hand points at which penetration is measured
    margin: float = 0.001  # clearance that hand points keep from the object before they count as penetrating [m] (ours)
    clearance: float = 100.0
    """Weight of the hand's penetration into its surroundings, in pregrasp, grasp and squeeze, and of the distance of contacts
    and other hand points from where they may be [1/m] (ours)."""
    clearance_points: int = 120  # number of hand points at which that is measured (ours)
    clear: float = 0.005  # distance that the hand keeps from its surroundings [m] (ours)


@dataclass(frozen=True)
class Evaluation(Rows):
    """Energy and gradient of n grasps."""

    terms: Float[Tensor, "n 6"]  # weighted terms in the order of TERMS
    clearance: Float[Tensor, "n 1"]
    """Weighted penetration into the surroundings, and touch beside the contact region. It says nothing about the grasp itself,
    so it is not among the terms."""
    by_pose: Float[Tensor, "n 6"]  # derivative by the hand's translation [1/m] and rotation about its pivot [1/rad]
    by_joint: Float[Tensor, "n n_dof"]
    pivot: Float[Tensor, "n 3"]  # the hand's grasp centre [m]

    @property
    def total(self) -> Float[Tensor, " n"]:
        """Sum of the terms, the clearance included."""
        return self.terms.sum(-1) + self.clearance[:, 0]


@dataclass(frozen=True, eq=False)
class Workspace:
    """Where a hand may be, and where it may touch the object; anywhere by default."""

    surroundings: Surroundings | None = None  # what it stays clear of
    contact_region: Balls | None = None  # the only place where it touches the object

    def to(self, device: torch.device | str) -> Workspace:
        """The same on another device."""
        around = None if self.surroundings is None else self.surroundings.to(device)
        return Workspace(around, None if self.contact_region is None else on_device(self.contact_region, device))


class _HandParts(NamedTuple):
    """What an energy needs of a hand, whatever the object."""

    hand: Hand
    candidates: ContactCandidates
    spheres: LinkSpheres
    one_hot: Float[Tensor, "n_links n_links"]
    contact_points: LinkPoints
    ball: LinkPoints
    pairs: energies.SpherePairs

    @staticmethod
    def of(hand: Hand, contacts: ContactConfig | None, device: torch.device) -> _HandParts:
        """Of a hand on the CPU, on a device."""
        candidates, spheres = on_device(contact_candidates(hand, contacts), device), on_device(link_spheres(hand), device)
        own, n_links = hand.to(device), hand.tree.n_links
        return _HandParts(
            own, candidates, spheres, torch.eye(n_links, dtype=own.tree.origin.dtype, device=device),
            LinkPoints.of(candidates.points, candidates.links, n_links), LinkPoints.of(spheres.centres, spheres.links, n_links),
            energies.SpherePairs.of(spheres.radii, spheres.pairs))


class GraspEnergy:
    """The energy of a hand on an object, prepared for many evaluations."""

    def __init__(
        self, hand: Hand, field: DistanceField, centre: Float[Tensor, "3"], length: float, config: EnergyConfig | None = None,
        contacts: ContactConfig | None = None, device: torch.device | str = "cpu", workspace: Workspace | None = None,
    ) -> None:
        """Prepare everything that stays the same from step to step.

        `centre` is the object's centre of mass, `length` a typical distance of its surface from there [m]. The device is that
        of the evaluations; all that is given is on the CPU.
        """
        self._place(field, centre, length, workspace or Workspace(), device)
        parts = hand.kept(("energy", contacts, self.device), lambda: _HandParts.of(hand, contacts, self.device))
        self.source, self.hand, self.candidates, self.spheres = hand, parts.hand, parts.candidates, parts.spheres
        self.one_hot, self.contact_points, self.ball, self.pairs = parts.one_hot, parts.contact_points, parts.ball, parts.pairs
        self._weigh(config or EnergyConfig())

    def on(self, obj: ObjectModel, workspace: Workspace) -> GraspEnergy:
        """The energy of the same hand, with the same weights, on another object."""
        other, (centre, length) = copy(self), _size(obj)
        other._place(obj.distance_field, centre, length, workspace, self.device)
        other._weigh(self.config)
        return other

    def _place(
        self, field: DistanceField, centre: Float[Tensor, "3"], length: float, workspace: Workspace, device: torch.device | str
    ) -> None:
        """Keep what is known of the object and of its surroundings."""
        self.field: DistanceField | DistanceFields = on_device(field, device)
        self.centre, self.length, self.workspace = centre.to(device), length, workspace.to(device)
        self.centres: Float[Tensor, "#n 1 3"] = self.centre[None, None]
        """The centre of mass of each row's object [m]; one for all rows, unless the energy is of several objects."""
        self.lengths: float | Float[Tensor, "n 1"] = length
        """The same of `length`."""

    @staticmethod
    def of_object(
        hand: Hand, obj: ObjectModel, config: EnergyConfig | None = None, contacts: ContactConfig | None = None,
        device: torch.device | str = "cpu", workspace: Workspace | None = None,
    ) -> GraspEnergy:
        """The energy on the object's grid of signed distances."""
        return GraspEnergy(hand, obj.distance_field, *_size(obj), config, contacts, device, workspace)

    def weighted(self, config: EnergyConfig) -> GraspEnergy:
        """This energy under other weights; it shares contacts, link spheres and distance field."""
        other = copy(self)
        other._weigh(config)
        return other

    @staticmethod
    def joined(energies: Sequence[GraspEnergy], counts: Sequence[int]) -> GraspEnergy:
        """The energy of rows of several objects, so many of each, with one hand and the same weights for all.

        Its rows are those of the tensors that it is called with; `rows` tells which they are where a batch is split.

        Raises:
            ValueError: An object has surroundings or a contact region, or hands, weights or devices differ.
        """
        first = energies[0]
        if len({id(energy) for energy in energies}) == 1:
            return first
        if not all(energy.joins(first) for energy in energies):
            raise ValueError("energies of several hands, weights or workspaces cannot be joined")
        device, other = first.device, copy(first)
        number = torch.tensor(counts)
        lengths = torch.tensor([energy.length for energy in energies]).repeat_interleave(number)
        centres = torch.stack([energy.centre.cpu() for energy in energies]).repeat_interleave(number, 0)
        other.field = DistanceFields.of([energy.field for energy in energies], counts)  # type: ignore[misc]
        other.centres, other.lengths = centres.to(device)[:, None], lengths.to(device)[:, None]
        return other

    def joins(self, other: GraspEnergy) -> bool:
        """Whether rows of both can be computed as one."""
        free = all(e.workspace.surroundings is None and e.region_term is None for e in (self, other))
        same = (self.source is other.source, self.config == other.config, self.device == other.device)
        return free and all(same) and isinstance(self.field, DistanceField)

    @cached_property
    def barred(self) -> Float[Tensor, "n_slots k"]:
        """Zero where a slot may take a candidate, infinity elsewhere."""
        return torch.where(self.candidates.slot_weights > 0, 0.0, torch.inf)

    def rows(self, index: slice | Int[Tensor, " k"]) -> GraspEnergy:
        """The energy of some of the rows."""
        if isinstance(self.field, DistanceField):
            return self
        assert isinstance(self.lengths, Tensor)
        other = copy(self)
        other.field, other.centres, other.lengths = self.field.rows(index), self.centres[index], self.lengths[index]
        return other

    @property
    def device(self) -> torch.device:
        """Where it is evaluated."""
        return self.centre.device

    def touching(self, candidates: ContactCandidates) -> GraspEnergy:
        """This energy with other contact candidates."""
        other = copy(self)
        vars(other).pop("barred", None)
        other.candidates = candidates
        other.contact_points = LinkPoints.of(candidates.points, candidates.links, self.hand.tree.n_links)
        return other

    def _spread_points(self, count: int) -> LinkPoints:
        """So many of the hand's surface points, spread evenly, on the device."""
        def make() -> LinkPoints:
            thin = self.source.with_points(min(count, self.source.n_points)).to(self.device)
            return LinkPoints.of(thin.link_points, thin.link_index, thin.tree.n_links)

        return self.source.kept(("spread", count, self.device), make)

    def _weigh(self, config: EnergyConfig) -> None:
        hand = self.hand
        self.config, self.body = config, self._spread_points(config.hand_points)
        self.solid = self.source.kept(
            ("solid", config.hand_points, self.device), lambda: self.body.beside(self.ball))
        margin = config.closing_room * (hand.upper - hand.lower) * ~hand.abduction
        self.clearance = None
        if self.workspace.surroundings is not None:
            self.clearance = Clearance(
                hand, self.workspace.surroundings, self._spread_points(config.clearance_points), self.ball, self.spheres.radii,
                config.clear, config.clearance)
        place = self.workspace.contact_region
        self.region_term = None if place is None else ContactRegionTerm(place, config.clear)
        self.lower = torch.where(hand.opening_signs > 0, hand.lower + margin, hand.lower)
        self.upper = torch.where(hand.opening_signs > 0, hand.upper, hand.upper - margin)

    def __call__(
        self, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], contacts: Int[Tensor, "n c"] | None = None
    ) -> Evaluation:
        """Energy and gradient of n grasps; their contacts are candidates by index, those nearest to the surface by default."""
        poses = T_object_wrist[:, None] @ self.hand.tree.forward(q)
        return self._at(T_object_wrist, q, poses, self.nearest_contacts(poses, math.inf) if contacts is None else contacts)

    def of_nearest(
        self, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], reach: float
    ) -> Evaluation:
        """The same with the contacts of `nearest_contacts`."""
        poses = T_object_wrist[:, None] @ self.hand.tree.forward(q)
        return self._at(T_object_wrist, q, poses, self.nearest_contacts(poses, reach))

    def _at(
        self, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"], poses: Float[Tensor, "n n_links 4 4"],
        contacts: Int[Tensor, "n c"],
    ) -> Evaluation:
        """Energy and gradient of hands whose links are at these poses [m]."""
        tree, config = self.hand.tree, self.config
        contact_terms, pulled, wrenches = self._contacts(poses, contacts)
        # Surface points and spheres are placed, and their distances looked up, as one.
        (body, spheres), (distance, sphere_distance), (gradient, sphere_gradient) = self._distances(poses)
        inside = energies.penetration(distance - config.margin, gradient)
        beside, by_point = torch.zeros_like(T_object_wrist[:, :1, 0]), config.penetration * inside.by_point
        if self.region_term is not None:
            off = self.region_term.push(body, distance, gradient)
            beside, by_point = config.clearance * off.value.sum(-1, keepdim=True), by_point + config.clearance * off.by_point
            beside = beside + pulled
        wrenches = wrenches + energies.link_wrenches(body, by_point, self.body.members)
        own = energies.self_penetration(spheres, self.pairs)
        depth, by_sphere = inside.value.sum(-1), config.self_penetration * own.by_point
        if config.filled:
            pierced = energies.penetration(sphere_distance - self.spheres.radii, sphere_gradient)
            depth, by_sphere = depth + pierced.value.sum(-1), by_sphere + config.penetration * pierced.by_point
        wrenches = wrenches + energies.link_wrenches(spheres, by_sphere, self.ball.members)
        beyond, slope = energies.joint_margin(q, self.lower, self.upper)
        pivot = self.pivot(T_object_wrist)
        by_pose, by_joint = energies.joint_gradient(tree, poses, wrenches, pivot)
        closure, apart, alignment = contact_terms
        terms = torch.stack([
            config.force_closure * closure,
            config.distance * apart,
            config.penetration * depth,
            config.self_penetration * own.value.sum(-1),
            config.alignment * alignment,
            config.joints * beyond.sum(-1),
        ], -1)
        by_joint = by_joint + config.joints * slope
        if self.clearance is not None:
            near = self.clearance(T_object_wrist, q, poses, pivot)
            beside, by_pose, by_joint = beside + near.value, by_pose + near.by_pose, by_joint + near.by_joint
        return Evaluation(terms, beside, by_pose, by_joint * self.hand.movable.to(q.dtype), pivot)

    def _distances(self, poses: Float[Tensor, "n n_links 4 4"]) -> tuple[tuple[Float[Tensor, "..."], ...], ...]:
        """Surface points and centres of spheres [m], their signed distances [m], and the gradients of these."""
        placed, sizes = self.solid.place(poses), [len(self.body.members), len(self.ball.members)]
        distance, gradient = self.field.distances(placed)
        return placed.split(sizes, 1), distance.split(sizes, 1), gradient.split(sizes, 1)

    def nearest_contacts(self, poses: Float[Tensor, "n n_links 4 4"], reach: float = math.inf) -> Int[Tensor, "n c"]:
        """The candidate of each slot that is nearest to the surface, of links at these poses; slots do not share a candidate.

        A slot without a candidate within `reach` [m] takes one from the slot that is nearest to the surface.
        """
        points = self.contact_points.place(poses)
        distance = self.field.distances(points)[0].abs()
        if self.region_term is not None:
            distance = distance + self.region_term.pull(points).value
        barred = self.barred
        nearest = (distance[:, None] + barred).amin(-1)
        # A slot without a candidate takes one from the slot that is nearest.
        slot = torch.arange(len(barred), device=nearest.device)
        source = torch.where(nearest > reach, nearest.argmin(-1, keepdim=True), slot)
        apart, chosen = barred[source], []
        for k in range(len(barred)):
            index = (distance + apart[:, k]).argmin(-1, keepdim=True)
            # What is taken is one metre farther for the others.
            distance = distance.scatter_add(-1, index, torch.ones_like(nearest[:, :1]))
            chosen.append(index)
        return torch.cat(chosen, -1)

    def pivot(self, T_object_wrist: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 3"]:
        """The point about which the hand turns: its grasp centre [m]."""
        return self.hand.grasp_centres(T_object_wrist)

    def _contacts(
        self, poses: Float[Tensor, "n n_links 4 4"], contacts: Int[Tensor, "n c"]
    ) -> tuple[tuple[Float[Tensor, " n"], ...], Float[Tensor, "n 1"], Float[Tensor, "n n_links 6"]]:
        """Force closure, distance and alignment of contacts, weighted distance to the contact region, and wrenches on links."""
        config, candidates = self.config, self.candidates
        links = candidates.links[contacts]
        chosen = poses[torch.arange(len(poses), device=links.device)[:, None], links]
        points = se3.apply(chosen, candidates.points[contacts])
        outward = se3.rotate(chosen[..., :3, :3], candidates.normals[contacts])
        surface = self.field.normals(points)
        normal, bend = surface.normal, surface.bend
        closure = energies.force_closure(points - self.centres, normal, self.lengths)
        apart = energies.contact_distance(surface.distance, surface.gradient)
        align = energies.normal_alignment(outward, normal)
        # The object's normal turns with the contact's position, so its derivative joins that by position through `bend`.
        by_object_normal = config.force_closure * closure.by_normal + config.alignment * outward
        by_point = (
            config.force_closure * closure.by_point + config.distance * apart.by_point
            + (by_object_normal[..., None, :] @ bend)[..., 0, :]
        )
        moment = torch.linalg.cross(points, by_point, dim=-1)
        moment = moment + torch.linalg.cross(outward, config.alignment * normal, dim=-1)
        members = self.one_hot[links].transpose(-1, -2)
        wrenches, pulled = members @ torch.cat([by_point, moment], -1), torch.zeros_like(points[:, :1, 0])
        if self.region_term is not None:
            pull = self.region_term.pull(points)
            by_point = config.clearance * pull.by_point
            pulled = config.clearance * pull.value.sum(-1, keepdim=True)
            wrenches = wrenches + members @ torch.cat([by_point, torch.linalg.cross(points, by_point, dim=-1)], -1)
        return (closure.value.sum(-1), apart.value.sum(-1), align.sum(-1)), pulled, wrenches


def _size(obj: ObjectModel) -> tuple[Float[Tensor, "3"], float]:
    """Centre of mass of an object [m], and a typical distance of its surface from there [m]."""
    surface = torch.as_tensor(obj.cloud, dtype=torch.float32)
    centre = torch.as_tensor(obj.centre_of_mass, dtype=torch.float32)
    return centre, float((surface - centre).norm(dim=-1).mean())


@dataclass(frozen=True)
class NearestPoints:
    """For n grasps, the point nearest to the object on each of the l links that have surface points."""

    links: Int[Tensor, " l"]
    index: Int[Tensor, "n l"]  # which of the hand's surface points
    points: Float[Tensor, "n l 3"]  # where they are, in the object's frame [m]
    link_normals: Float[Tensor, "n l 3"]  # outward normals of the links there
    gap: Float[Tensor, "n l"]  # signed distance to the object [m]
    object_normals: Float[Tensor, "n l 3"]  # outward normals of the object there

    @staticmethod
    def of(energy: GraspEnergy, T_object_wrist: Float[Tensor, "n 4 4"], q: Float[Tensor, "n n_dof"]) -> NearestPoints:
        """Those of grasps on the energy's device."""
        hand = energy.hand
        points, normals = hand.points_and_normals(q, T_object_wrist)
        distance, gradient = energy.field.distances(points)
        links = hand.point_links
        # Points of other links are infinitely far away.
        index = torch.where(hand.link_index == links[:, None], distance[:, None], torch.inf).argmin(-1)
        outward = torch.nn.functional.normalize(_at(gradient, index), dim=-1)
        return NearestPoints(links, index, _at(points, index), _at(normals, index), distance.gather(1, index), outward)

    def pick(self, values: Float[Tensor, "n p 3"]) -> Float[Tensor, "n l 3"]:
        """The rows of these points among those of all surface points."""
        return _at(values, self.index)


def _at(values: Float[Tensor, "n p 3"], index: Int[Tensor, "n l"]) -> Float[Tensor, "n l 3"]:
    return values.gather(1, index[..., None].expand(-1, -1, 3))
