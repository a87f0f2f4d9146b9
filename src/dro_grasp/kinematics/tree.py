"""A hand's kinematic tree: batched forward kinematics and Jacobians.

Mimic joints and stated couplings are resolved once, when the tree is made: everything here takes `q`, the values of
the *independent* joints, and maps them to all joints by one affine map. Source: paper section III-D and any textbook.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

FIXED, REVOLUTE, PRISMATIC = 0, 1, 2
SLIDING_UNIT = 0.03
"""Travel of a sliding joint that moves a hand about as much as 1 rad of a turning one [m]."""


class cached_tensor(cached_property):  # type: ignore[type-arg]  # reads like the decorator it extends
    """A cached property whose tensors can be used in training even if inference asked for them first."""

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with torch.inference_mode(False):
            return super().__get__(instance, owner)


@dataclass(frozen=True)
class KinematicTree:
    """Links in topological order, root first; at most one moving joint per link."""

    link_names: tuple[str, ...]
    """Names of the n_links links. A body with several joints is split; its extra links are named `name/1`, ..."""
    joint_names: tuple[str, ...]
    """Names of the n_dof independent joints, the order of every `q`."""
    moving_names: tuple[str, ...]
    """Names of all n_joints moving joints, followers included."""
    parent: tuple[int, ...]
    """Index of each link's parent; -1 for the root; always smaller than the link's own index."""
    link_joint: tuple[int, ...]
    """Index into moving_names of the joint above each link, or -1 where the link is fixed to its parent."""
    kind: tuple[int, ...]
    """FIXED, REVOLUTE or PRISMATIC, one per link."""
    origin: Float[Tensor, "n_links 4 4"]
    """T_parent_link at joint value zero [m]."""
    axis: Float[Tensor, "n_links 3"]
    """Unit joint axis in the link frame; zero for fixed links."""
    anchor: Float[Tensor, "n_links 3"]
    """A point on a revolute joint's axis, in the link frame [m] (zero in every URDF)."""
    lower: Float[Tensor, " n_dof"]
    """Lower limits of the independent joints [rad or m]."""
    upper: Float[Tensor, " n_dof"]
    """Upper limits of the independent joints [rad or m]."""
    coupling: Float[Tensor, "n_joints n_dof"]
    """All moving joints = coupling @ q + offset."""
    offset: Float[Tensor, " n_joints"]
    """See coupling [rad or m]."""

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
        """Motion of each independent joint that counts as 1 rad: 1 rad where it turns links, SLIDING_UNIT where it slides."""
        turns = torch.zeros(self.n_dof, dtype=torch.bool, device=self.origin.device)
        for kind, joint in zip(self.kind, self.link_joint, strict=True):
            if kind == REVOLUTE:
                turns |= self.coupling[joint] != 0
        return torch.where(turns, 1.0, SLIDING_UNIT).to(self.origin)

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
        """Where each link stands when the levels are joined."""
        joined = torch.cat([self._roots, *[links for links, _ in self._levels]])
        return joined.argsort()

    @cached_tensor
    def _roots(self) -> Int[Tensor, " n"]:
        return torch.tensor([i for i, parent in enumerate(self.parent) if parent < 0], device=self.origin.device)

    @cached_tensor
    def _revolute(self) -> Bool[Tensor, " n_links"]:
        return torch.tensor(self.kind, device=self.origin.device) == REVOLUTE

    @cached_tensor
    def _motion_basis(self) -> Float[Tensor, "4 n_links 4 4"]:
        """Four constant matrices per link: the factors of 1, sin x, 1 - cos x and x in its own joint's motion.

        Rodrigues' formula about an axis through the anchor, and a slide, are linear in these.
        """
        turns = self._revolute[:, None]
        slides = torch.tensor(self.kind, device=self.axis.device)[:, None] == PRISMATIC
        k = _skew(self.axis * turns)
        basis = self.origin.new_zeros(4, self.n_links, 4, 4)
        basis[0] = torch.eye(4)
        basis[1, :, :3, :3], basis[2, :, :3, :3] = k, k @ k
        basis[1:3, :, :3, 3] = -(basis[1:3, :, :3, :3] @ self.anchor[..., None])[..., 0]
        basis[3, :, :3, 3] = self.axis * slides
        return basis

    @cached_tensor
    def _local_basis(self) -> Float[Tensor, "4 n_links 4 4"]:
        """The same for T_parent_link."""
        return self.origin @ self._motion_basis

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
        joint = torch.tensor(self.link_joint, device=self.offset.device)
        # The zero at the end is where the -1 of fixed links points.
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

    def joint_motion(self, q: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, "*batch n_links 4 4"]:
        """Motion of each link caused by its own joint, in the link's frame at joint value zero."""
        return self._combine(self._motion_basis, q)

    def _combine(
        self, basis: Float[Tensor, "4 n_links 4 4"], q: Float[Tensor, "*batch n_dof"]
    ) -> Float[Tensor, "*batch n_links 4 4"]:
        x = (q @ self.link_coupling.T + self.link_offset)[..., None, None]
        return basis[0] + torch.sin(x) * basis[1] + (1 - torch.cos(x)) * basis[2] + x * basis[3]

    def forward(self, q: Float[Tensor, "*batch n_dof"]) -> Float[Tensor, "*batch n_links 4 4"]:
        """Pose of every link in the root link's frame, T_root_link.

        Args:
            q: Values of the independent joints [rad or m].
        """
        local = self._combine(self._local_basis, q)
        levels = [local[..., self._roots, :, :]]
        for links, parents in self._levels:
            levels.append(levels[-1][..., parents, :, :] @ local[..., links, :, :])
        return torch.cat(levels, -3)[..., self._level_order, :, :]

    def motion_axes(
        self, T_world_link: Float[Tensor, "*batch n_links 4 4"]
    ) -> tuple[Float[Tensor, "*batch n_links 3"], Float[Tensor, "*batch n_links 3"]]:
        """Velocity (linear at the world origin, angular) of everything below each link per unit of its own joint.

        A point p below link j moves by linear[j] + angular[j] x p per unit of joint j.
        """
        rotation = T_world_link[..., :3, :3]
        axis = (rotation @ self.axis[..., None])[..., 0]
        anchor = (rotation @ self.anchor[..., None])[..., 0] + T_world_link[..., :3, 3]
        revolute = self._revolute[:, None]
        angular = torch.where(revolute, axis, torch.zeros_like(axis))
        linear = torch.where(revolute, _cross(anchor, axis), axis)
        return linear, angular

    def point_jacobian(
        self,
        T_world_link: Float[Tensor, "*batch n_links 4 4"],
        points: Float[Tensor, "*batch n_points 3"],
        links: Int[Tensor, " n_points"],
    ) -> Float[Tensor, "*batch n_points 3 n_dof"]:
        """Derivative of world points, each fixed to a link, by the independent joints.

        Args:
            T_world_link: Poses of all links, as `forward` gives them (in any world frame).
            points: Positions in that world frame [m].
            links: The link that each point is fixed to.
        """
        linear, angular = self.motion_axes(T_world_link)
        velocity = linear[..., None, :, :] + torch.linalg.cross(
            angular[..., None, :, :].expand(*points.shape[:-1], -1, -1), points[..., :, None, :].expand(
                *points.shape[:-1], self.n_links, 3), dim=-1
        )
        velocity = velocity * self.descends[links][:, :, None].to(points.dtype)
        return torch.einsum("...plx,ld->...pxd", velocity, self.link_coupling)


def _skew(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _cross(a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """torch.linalg.cross takes several times as long on small tensors."""
    (ax, ay, az), (bx, by, bz) = a.unbind(-1), b.unbind(-1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)
