"""One model of a hand with several objects, of which each simulation has one: MuJoCo Warp steps them all together.

The model's object has as many shapes as the object with most of them. Which mesh a shape is, where it is, and the object's mass
differ by simulation. A shape too many has no mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from jaxtyping import Int, Num

from dro_grasp.simulation.scene import FAR_AWAY, TrialScene, add_parts, compiled, touching

OF_SHAPES = ("geom_dataid", "geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound")
"""Fields of MjModel that differ between the shapes of an object."""
OF_OBJECT = ("body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_iquat", "body_invweight0", "dof_invweight0")
"""Fields of MjModel that differ between the scenes of a hand."""
ABSENT = -1  # Mesh of a shape that is not there. Source: MuJoCo Warp
CACHED = 8  # Models that are kept (ours)


@dataclass(frozen=True, eq=False)
class JointModel:
    """A model for several scenes."""

    model: mujoco.MjModel
    scenes: tuple[TrialScene, ...]
    fields: dict[str, Num[np.ndarray, "scenes *_"]]
    """What differs, by name; nothing for one scene."""
    shapes: tuple[Int[np.ndarray, " _"], ...]
    """For each scene, which shapes of the model its own are."""


def joins(scene: TrialScene, other: TrialScene) -> bool:
    """Whether two scenes have a joint model: that of one hand, protocol and table, with objects that are meshes."""
    same = scene.hand.sha256 == other.hand.sha256 and scene.protocol == other.protocol and scene.table == other.table
    return scene is other or (same and scene.obj.balls is None and other.obj.balls is None)


@lru_cache(maxsize=CACHED)
def joint_model(scenes: tuple[TrialScene, ...]) -> JointModel:
    """The model of scenes that join."""
    first = scenes[0]
    if len(scenes) == 1:
        return JointModel(first.model, scenes, {}, (np.arange(first.model.ngeom),))
    model = compiled(first.hand, first.protocol, first.table, lambda scene: _add_objects(scene, scenes))
    body, of_object = model.body("object").id, model.geom_bodyid == model.body("object").id
    shapes = []
    for scene in scenes:
        own = np.zeros(scene.model.ngeom, int)
        mine = scene.model.geom_bodyid == body
        own[mine] = np.flatnonzero(of_object)[:mine.sum()]
        own[~mine] = np.flatnonzero(~of_object)
        shapes.append(own)
    fields = {name: np.stack([getattr(scene.model, name) for scene in scenes]) for name in OF_OBJECT}
    for name in OF_SHAPES:
        fields[name] = np.repeat(getattr(model, name)[None], len(scenes), 0)
        for values, scene, own in zip(fields[name], scenes, shapes, strict=True):
            values[own] = getattr(scene.model, name)
    for i, (scene, own) in enumerate(zip(scenes, shapes, strict=True)):
        meshes = np.full(model.ngeom, ABSENT)
        meshes[~of_object] = model.geom_dataid[~of_object]
        mine = scene.model.geom_bodyid == body
        meshes[own[mine]] = [model.mesh(_name(i) + str(part)).id for part in range(mine.sum())]
        fields["geom_dataid"][i] = meshes
    return JointModel(model, scenes, fields, tuple(shapes))


def _name(number: int) -> str:
    """What the names of an object's meshes begin with."""
    return f"object{number}_"


def _add_objects(scene: mujoco.MjSpec, scenes: tuple[TrialScene, ...]) -> mujoco.MjsBody:
    """The meshes of all objects, and a body with the shapes of the one that has most."""
    body = scene.worldbody.add_body(name="object", pos=FAR_AWAY)
    body.add_freejoint(name="object")
    for mesh in max([add_parts(scene, one.obj, _name(i)) for i, one in enumerate(scenes)], key=len):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, **touching(scenes[0].protocol))
    # Its axes are not those of its inertia, or MuJoCo would leave no room for the products of inertia of the others.
    body.explicitinertial, body.mass, body.ipos, body.fullinertia = True, 1.0, [0, 0, 0], [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]
    return body
