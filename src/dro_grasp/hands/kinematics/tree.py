"""A hand's kinematic tree: batched forward kinematics and Jacobians.

Mimic joints and stated couplings are resolved once, when the tree is built: all functions take `q`, the values of the
*independent* joints, and one affine map gives all joints. Source: paper section III-D and any textbook.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import cached_tensor, on_accelerator
from dro_grasp.geometry.se3 import rotate

FIXED = 0  # Kind of a link that does not move against its parent (ours)
REVOLUTE = 1  # Kind of a link that turns about its joint's axis (ours)
PRISMATIC = 2  # Kind of a link that slides along its joint's axis (ours)
SLIDING_UNIT = 0.03  # Travel of a prismatic joint that moves a hand about as much as 1 rad of a revolute one [m] (ours)


class DrivenLinks(NamedTuple):
    """Pairs of a moving link and an independent joint (dof) that drives it."""

    link: Int[Tensor, " pairs"]
    rate: Float[Tensor, " pairs"]  # change of the link's own joint per unit of the dof
    gather: Float[Tensor, "n_dof pairs"] | None  # sums pairs into dofs; None if pair i is dof i


@dataclass(frozen=True)
class KinematicTree:
    """Links in topological order, root first; at most one moving joint per link."""

    link_names: tuple[str, ...]
    """Names of the n_links links. A body with several joints is split; its extra links are named `name/1`, ..."""
    joint_names: tuple[str, ...]  # names of the n_dof independent joints, the order of every `q`
    moving_names: tuple[str, ...]  # names of all n_joints moving joints, followers included
    parent: tuple[int, ...]  # index of each link's parent; -1 for the root; always smaller than the link's own index
    link_joint: tuple[int, ...]
    """Index into moving_names of the joint above each link, or -1 where the link is fixed to its parent."""
    kind: tuple[int, ...]  # FIXED, REVOLUTE or PRISMATIC, one per link
    origin: Float[Tensor, "n_links 4 4"]  # T_parent_link at joint value zero [m]
    axis: Float[Tensor, "n_links 3"]  # unit joint axis in the link frame; zero for fixed links
    anchor: Float[Tensor, "n_links 3"]  # a point on a revolute joint's axis, in the link frame [m] (zero in every URDF)
    lower: Float[Tensor, " n_dof"]  # lower limits of the independent joints [rad or m]
    upper: Float[Tensor, " n_dof"]  # upper limits of the independent joints [rad or m]
    coupling: Float[Tensor, "n_joints n_dof"]  # all moving joints = coupling @ q + offset
    offset: Float[Tensor, " n_joints"]  # see coupling [rad or m]

    def __repr__(self) -> str:
        return f"KinematicTree({self.n_links} links from '{self.link_names[0]}', {self.n_dof} independent joints)"

    @property
    def n_links(self) -> int:
        """Number of links, fixed ones included."""
        return len(self.link_names)

    @property
    def n_dof(self) -> int:
        """Number of independent joints."""
        return len(self.joint_names)

    @cached_tensor
    def joint_unit(self) -> Float[Tensor, " n_dof"]:
        """Motion of each independent joint that counts as 1 rad: 1 rad where it turns itself, SLIDING_UNIT where it slides.

        The kind of its followers does not count: a slide that turns fingers by rods has a servo of forces.
        """
        kinds = zip(self.link_joint, self.kind, strict=True)
        sliding = {self.moving_names[joint] for joint, kind in kinds if kind == PRISMATIC}
        return self.origin.new_tensor([SLIDING_UNIT if name in sliding else 1.0 for name in self.joint_names])

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> KinematicTree:
        """The same tree with its tensors on another device or in another precision."""
        fields: dict[str, Any] = self.fields()
        tensors = {k: v.to(device=device, dtype=dtype) for k, v in fields.items() if isinstance(v, Tensor)}
        return KinematicTree(**{**fields, **tensors})

    @cached_tensor
    def double(self) -> KinematicTree:
        """The same tree in double precision."""
        return self if self.origin.dtype == torch.float64 else self.to(dtype=torch.float64)

    def fields(self) -> dict[str, Any]:
        """The constructor's arguments by name."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @cached_tensor
    def _levels(self) -> tuple[tuple[Int[Tensor, " n"], Int[Tensor, " n"]], ...]:
        """Per depth below the root: the links there, and where their parents stand in the level above."""
        depth = [0] * self.n_links
        for link, parent in enumerate(self.parent):
            depth[link] = 0 if parent < 0 else depth[parent] + 1
        levels = [[i for i in range(self.n_links) if depth[i] == d] for d in range(max(depth) + 1)]
        above = [[levels[d].index(self.parent[i]) for i in links] for d, links in enumerate(levels[1:])]
        device = self.origin.device
        pairs = zip(levels[1:], above, strict=True)
        return tuple((torch.tensor(links, device=device), torch.tensor(at, device=device)) for links, at in pairs)

    @cached_tensor
    def _level_order(self) -> Int[Tensor, " n_links"]:
        joined = torch.cat([self._roots, *[links for links, _ in self._levels]])
        return joined.argsort()

    @cached_tensor
    def _roots(self) -> Int[Tensor, " n"]:
        return torch.tensor([i for i, parent in enumerate(self.parent) if parent < 0], device=self.origin.device)

    @cached_tensor
    def parents(self) -> Int[Tensor, " n_links"]:
        """`parent` as a tensor."""
        return torch.tensor(self.parent, device=self.origin.device)

    @cached_tensor
    def link_joints(self) -> Int[Tensor, " n_links"]:
        """`link_joint` as a tensor."""
        return torch.tensor(self.link_joint, device=self.origin.device)

    @cached_tensor
    def kinds(self) -> Int[Tensor, " n_links"]:
        """`kind` as a tensor."""
        return torch.tensor(self.kind, device=self.origin.device)

    @cached_tensor
    def _revolute(self) -> Bool[Tensor, " n_links"]:
        return self.kinds == REVOLUTE

    @cached_tensor
    def _local_basis(self) -> Float[Tensor, "4 n_links 4 4"]:
        """Four constant matrices B_k per link: T_parent_link = B_0 + sin(x) B_1 + (1 - cos(x)) B_2 + x B_3."""
        # For an axis a through the anchor c, Rodrigues' formula is R = I + sin(x) K + (1 - cos(x)) K^2, K = [a]_x, and the
        # motion is p -> R (p - c) + c: K c and K^2 c move into the translation. A slide is x a.
        turns = self._revolute[:, None]
        slides = self.kinds[:, None] == PRISMATIC
        k = _skew(self.axis * turns)
        basis = self.origin.new_zeros(4, self.n_links, 4, 4)
        basis[0] = torch.eye(4)
        basis[1, :, :3, :3], basis[2, :, :3, :3] = k, k @ k
        basis[1:3, :, :3, 3] = -rotate(basis[1:3, :, :3, :3], self.anchor)
        basis[3, :, :3, 3] = self.axis * slides
        return self.origin @ basis

    @cached_tensor
    def link_coupling(self) -> Float[Tensor, "n_links n_dof"]:
        """Change of each link's own joint per change of each independent joint (zero rows for fixed links)."""
        rows = self.origin.new_zeros(self.n_links, self.n_dof)
        for link, joint in enumerate(self.link_joint):
            if joint >= 0:
                rows[link] = self.coupling[joint]
        return rows

    @cached_tensor
    def link_offset(self) -> Float[Tensor, " n_links"]:
        """Value of each link's own joint at q = 0."""
        joint = self.link_joints
        # Fixed links have joint -1, which indexes the appended zero.
        return torch.cat([self.offset, self.offset.new_zeros(1)])[joint]

    @cached_tensor
    def descends(self) -> Bool[Tensor, "n_links n_links"]:
        """descends[i, j]: link i is link j or below it."""
        table = torch.zeros(self.n_links, self.n_links, dtype=torch.bool, device=self.origin.device)
        for link, parent in enumerate(self.parent):
            if parent >= 0:
                table[link] = table[parent]
            table[link, link] = True
        return table

    @cached_tensor
    def moves(self) -> Bool[Tensor, "n_links n_dof"]:
        """moves[i, d]: independent joint d moves link i."""
        return (self.descends.float() @ (self.link_coupling != 0).float()) > 0

    @cached_tensor
    def pairs(self) -> DrivenLinks:
        """Each moving link with each independent joint that drives it."""
        coupling = self.link_coupling
        link, dof = coupling.nonzero(as_tuple=True)
        gather = torch.zeros(self.n_dof, len(dof), dtype=coupling.dtype, device=coupling.device)
        gather[dof, torch.arange(len(dof), device=dof.device)] = 1
        same = gather.shape[0] == gather.shape[1] and bool((gather.diagonal() == 1).all())
        return DrivenLinks(link, coupling[link, dof], None if same else gather)

    def forward(self, q: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, "*batch n_links 4 4"]:
        """Pose of every link in the root link's frame, T_root_link, at values of the independent joints [rad or m]."""
        if on_accelerator(q.device):
            return self._forward_in_few_operators(q)
        x = (q @ self.link_coupling.T + self.link_offset)[..., None, None]
        basis = self._local_basis
        local = basis[0] + torch.sin(x) * basis[1] + (1 - torch.cos(x)) * basis[2] + x * basis[3]
        # One batched product per depth of the tree, not one per link.
        levels = [local.index_select(-3, self._roots)]
        for links, parents in self._levels:
            levels.append(levels[-1].index_select(-3, parents) @ local.index_select(-3, links))
        return torch.cat(levels, -3).index_select(-3, self._level_order)

    def _forward_in_few_operators(self, q: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, "*batch n_links 4 4"]:
        """The same by more products in fewer operators, which a device takes as long for as for few products."""
        coupling, offset, constant, sine, cosine, straight = self._padded
        x = torch.nn.functional.linear(q, coupling, offset)[..., None, None]
        T = torch.addcmul(torch.addcmul(torch.addcmul(constant, x.sin(), sine), x.cos(), cosine), x, straight)
        # Each round doubles the length of the way towards the root that a product covers.
        for ancestors in self._ancestors:
            T = T.index_select(-3, ancestors) @ T
        return T.narrow(-3, 0, self.n_links).contiguous()

    @cached_tensor
    def _padded(self) -> tuple[Float[Tensor, "..."], ...]:
        """Coupling, offset and constant matrices of `forward`, with an identity after the last link."""
        none = torch.zeros_like(self.origin[:1])
        at_rest, sine, cosine, straight = self._local_basis
        constant = torch.cat([at_rest + cosine, torch.eye(4).to(none)[None]])
        rows = torch.cat([self.link_coupling, torch.zeros_like(self.link_coupling[:1])])
        offset = torch.cat([self.link_offset, torch.zeros_like(self.link_offset[:1])])
        return rows, offset, constant, *(torch.cat([part, none]) for part in (sine, -cosine, straight))

    @cached_tensor
    def _ancestors(self) -> tuple[Int[Tensor, " n"], ...]:
        """Per round of `_forward_in_few_operators`, how far up the next piece of the way of each link begins."""
        rounds, now = [], [parent if parent >= 0 else self.n_links for parent in self.parent] + [self.n_links]
        while any(place != self.n_links for place in now):
            rounds.append(torch.tensor(now, device=self.origin.device))
            now = [now[place] for place in now]
        return tuple(rounds)

    @cached_tensor
    def _axes_and_anchors(self) -> Float[Tensor, "n_links 3 2"]:
        return torch.stack([self.axis, self.anchor], -1)

    def motion_axes(
        self, T_world_link: Float[Tensor, "*batch n_links 4 4"]
    ) -> tuple[Float[Tensor, "*batch n_links 3"], Float[Tensor, "*batch n_links 3"]]:
        """Twist (linear velocity at the world origin, angular velocity) of each link per unit of its own joint.

        A point p on link j or below it moves by linear[j] + angular[j] x p per unit of joint j.
        """
        axis, anchor = (T_world_link[..., :3, :3] @ self._axes_and_anchors).unbind(-1)
        anchor = anchor + T_world_link[..., :3, 3]
        revolute = self._revolute[:, None]
        angular = torch.where(revolute, axis, torch.zeros_like(axis))
        linear = torch.where(revolute, _cross(anchor, axis), axis)
        return linear, angular

    def point_jacobian(
        self, T_world_link: Float[Tensor, "*batch n_links 4 4"], points: Float[Tensor, "*batch n_points 3"],
        links: Int[Tensor, "*#batch n_points"],
    ) -> Float[Tensor, "*batch n_points 3 n_dof"]:
        """Derivative of world points [m], each fixed to a link, by the independent joints.

        The poses of all links are in the same world frame as the points.
        """
        linear, angular = self.motion_axes(T_world_link)
        velocity = linear[..., None, :, :] + torch.linalg.cross(
            angular[..., None, :, :].expand(*points.shape[:-1], -1, -1), points[..., :, None, :].expand(
                *points.shape[:-1], self.n_links, 3), dim=-1
        )
        velocity = velocity * self.descends[links][..., None].to(points.dtype)
        return torch.einsum("...plx,ld->...pxd", velocity, self.link_coupling)


def _skew(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _cross(a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Cross product; several times as fast as torch.linalg.cross on small tensors of a CPU."""
    if on_accelerator(a.device):
        return torch.linalg.cross(a, b, dim=-1)
    (ax, ay, az), (bx, by, bz) = a.unbind(-1), b.unbind(-1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)
