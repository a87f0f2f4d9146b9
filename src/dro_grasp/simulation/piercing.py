"""Fingers that stick through what is thin.

A wall that runs through a joint touches the links on both sides of it by a millimetre or two, which contacts do not tell from a
firm grasp. The axis of the finger does: it crosses the wall. Ours.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import mujoco.batch
import numpy as np
from jaxtyping import Float

from dro_grasp.devices import cores
from dro_grasp.geometry.cache import Arrays, cached_arrays, content_hash
from dro_grasp.simulation.scene import OBJECT_GROUP, TrialScene

GAP = 0.015  # Way between two links that an axis may run nearer to the surface or outside [m]. Ours: Shadow's thumb has 13 mm
DEEP = 0.0025  # How far inside the shapes an axis runs elsewhere, along any coordinate [m] (ours)
SPACING = 0.001  # Distance of the points at which an axis is looked at [m] (ours)


@dataclass(frozen=True)
class Bone:
    """A straight piece of a finger's axis, between a joint and the middle of a shape, well within the hand's shapes."""

    body: int  # Body in whose frame it is fixed
    start: Float[np.ndarray, "3"]  # [m]
    end: Float[np.ndarray, "3"]  # The end that is farther from the palm [m]
    beyond: float  # How far the finger goes on from there [m]


def pierced(scene: TrialScene, qpos: Float[np.ndarray, "n nq"]) -> Float[np.ndarray, " n"]:
    """How much of a finger is behind a surface that its axis crosses, in each configuration [m]; 0 where none crosses."""
    fingers = bones(scene)
    if not fingers or not len(qpos):
        return np.zeros(len(qpos))
    batch = mujoco.batch.Batch(scene.model, nsim=len(qpos), nthread=min(cores(), len(qpos)))
    start, along = _in_place(fingers, qpos, batch)
    groups = (np.arange(mujoco.mjNGROUP) == OBJECT_GROUP).astype(np.uint8)
    hit = batch.ray(start, along, groups, False)[0]
    behind = (1 - hit) * np.linalg.norm(along, axis=2) + np.array([bone.beyond for bone in fingers])
    return np.where((hit >= 0) & (hit <= 1), behind, 0.0).max(1)


def _in_place(
    fingers: tuple[Bone, ...], qpos: Float[np.ndarray, "n nq"], batch: mujoco.batch.Batch
) -> tuple[Float[np.ndarray, "n b 3"], Float[np.ndarray, "n b 3"]]:
    """Where each bone begins in each configuration, and the way to its end [m]; the batch has the configurations then."""
    places, turns = batch.bind("xpos"), batch.bind("xmat")
    batch.bind("qpos")[:] = np.nan_to_num(qpos)
    batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS.value)
    bodies = np.array([bone.body for bone in fingers])
    turn = turns[:, bodies].reshape(len(qpos), len(fingers), 3, 3)
    start, along = (np.einsum("nbij,bj->nbi", turn, local) for local in (
        np.stack([bone.start for bone in fingers]), np.stack([bone.end - bone.start for bone in fingers])))
    return places[:, bodies] + start, along


def bones(scene: TrialScene) -> tuple[Bone, ...]:
    """The axes of the fingers, from link to link; found once for a hand, whose bodies come first in every scene."""
    return scene.hand.kept("bones", lambda: _stored(_Rest(scene)))


def _stored(rest: _Rest) -> tuple[Bone, ...]:
    """Axes from the disk, where they are cached: seeking them takes longer than a trial."""
    stored = cached_arrays(f"bones-{rest.key[:24]}", lambda: _packed(rest.bones()))
    rows = zip(stored["body"].tolist(), stored["start"], stored["end"], stored["beyond"].tolist(), strict=True)
    return tuple(Bone(*row) for row in rows)


def _packed(found: Sequence[Bone]) -> Arrays:
    """Bones as arrays."""
    return {"body": np.array([bone.body for bone in found], int), "start": np.array([bone.start for bone in found]),
            "end": np.array([bone.end for bone in found]), "beyond": np.array([bone.beyond for bone in found], float)}


class _Rest:
    """The hand at rest, in which axes are sought."""

    def __init__(self, scene: TrialScene) -> None:
        self.model, self.hand_sha256 = scene.model, scene.hand.sha256
        model = self.model
        self.data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)
        self.bodies = [b for b in range(1, model.nbody) if b != scene.object_body and model.body_mocapid[b] < 0]
        solid = (model.geom_contype | model.geom_conaffinity) > 0
        self.shapes = {b: [int(g) for g in np.nonzero((model.geom_bodyid == b) & solid)[0]] for b in self.bodies}

    @property
    def key(self) -> str:
        """Hash of all that bones come from: the files behind the shapes, what the scene makes of them, and our own numbers."""
        model, data = self.model, self.data
        shapes = [shape for body in self.bodies for shape in self.shapes[body]]
        return content_hash(
            np.frombuffer(self.hand_sha256.encode(), np.uint8), np.array([GAP, DEEP, SPACING]), np.array(self.bodies),
            model.body_parentid, model.body_jntadr, model.jnt_bodyid, model.jnt_type, data.xpos[self.bodies],
            data.xmat[self.bodies], data.xaxis, data.xanchor, np.array(shapes), model.geom_bodyid[shapes],
            model.geom_type[shapes], model.geom_size[shapes], data.geom_xpos[shapes], data.geom_xmat[shapes])

    def bones(self) -> list[Bone]:
        """The axes from each shape of a link to each of its parent's."""
        return [bone for body in self.bodies for own in self.shapes[body]
                for before in self.shapes.get(self.parent(body), ()) for bone in self.between(body, before, own)]

    def parent(self, body: int) -> int:
        return int(self.model.body_parentid[body])

    def between(self, body: int, before: int, own: int) -> tuple[Bone, ...]:
        """From the middle of a shape of the parent to that of one of the link; nothing where that way leaves the hand."""
        first, last = self.data.geom_xpos[before], self.data.geom_xpos[own]
        joint = self._joint(body, first, last)
        parent, solid = self.parent(body), [*self.shapes[self.parent(body)], *self.shapes[body]]
        if joint is None or not self._runs_within(np.stack([first, joint, last]), solid):
            return ()
        onward = self._reach(body, last)
        rest = float(np.linalg.norm(last - joint))
        near = Bone(parent, self._local(parent, first), self._local(parent, joint), rest + onward)
        far = Bone(body, self._local(body, joint), self._local(body, last), onward)
        # In a palm, which has several fingers, the way to a joint runs along the surface.
        inside = (far,) if sum(self.parent(b) == parent for b in self.bodies) > 1 else (near, far)
        return tuple(bone for bone in inside if np.linalg.norm(bone.end - bone.start) > SPACING)

    def _local(self, body: int, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        return self.data.xmat[body].reshape(3, 3).T @ (point - self.data.xpos[body])

    def _joint(
        self, body: int, first: Float[np.ndarray, "3"], last: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "3"] | None:
        """The point of a hinge's axis that is next to the line between two points; None for a slide, the middle for neither."""
        kinds = [int(self.model.jnt_type[j]) for j in np.nonzero(self.model.jnt_bodyid == body)[0]]
        if not kinds:
            return (first + last) / 2
        if kinds[0] != mujoco.mjtJoint.mjJNT_HINGE:
            return None
        hinge = int(self.model.body_jntadr[body])
        axis, anchor, line = self.data.xaxis[hinge], self.data.xanchor[hinge], last - first
        normal = np.cross(axis, line)
        if normal @ normal < 1e-6 * (line @ line):  # along each other
            return anchor + axis * (axis @ ((first + last) / 2 - anchor))
        return anchor + axis * (np.cross(first - anchor, line) @ normal / (normal @ normal))

    def _reach(self, body: int, point: Float[np.ndarray, "3"]) -> float:
        """How far the finger goes on from a point of a link, to the middle of its farthest shape [m]."""
        below = [b for b in self.bodies if self._is_below(b, body)]
        return max((float(np.linalg.norm(self.data.geom_xpos[g] - point)) for b in below for g in self.shapes[b]), default=0.0)

    def _is_below(self, body: int, other: int) -> bool:
        """Whether a body hangs from another."""
        while body > 0:
            body = self.parent(body)
            if body == other:
                return True
        return False

    def _runs_within(self, path: Float[np.ndarray, "k 3"], solid: list[int]) -> bool:
        """Whether a path is well within the shapes, but for a gap between links."""
        outside = 0.0
        for start, end in itertools.pairwise(path):
            count = max(2, math.ceil(float(np.linalg.norm(end - start)) / SPACING))
            for point in np.linspace(start, end, count):
                outside = 0.0 if any(self._is_deep(shape, point) for shape in solid) else outside + SPACING
                if outside > GAP:
                    return False
        return True

    def _is_deep(self, shape: int, point: Float[np.ndarray, "3"]) -> bool:
        """Whether a point is well inside a convex shape: there, and only there, rays to all sides go a long way."""
        return all(self._ray(shape, point, side) >= DEEP for side in SIDES)

    def _ray(self, shape: int, point: Float[np.ndarray, "3"], side: Float[np.ndarray, "3"]) -> float:
        model, data, kind = self.model, self.data, self.model.geom_type[shape]
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            return mujoco.mj_rayMesh(model, data, shape, point, side, None)
        return mujoco.mju_rayGeom(data.geom_xpos[shape], data.geom_xmat[shape], model.geom_size[shape], point, side, kind, None)


SIDES = np.concatenate([np.eye(3), -np.eye(3)])  # Both ways along each axis
