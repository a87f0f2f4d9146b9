"""Hands of MJCF files whose palm is no body: geoms of the world carry the fingers, which are its children."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from dro_grasp.hands.description.body_trees import branches
from dro_grasp.hands.description.compiling import Note, compiled, mujoco_speaks_to

APART = 0.4  # Largest distance between the bases of two fingers of a hand [m] (ours)
LARGEST_PALM = 0.3  # Largest radius of a sphere around a shape of a palm [m] (ours); tables and walls are larger
NEAR = 0.1  # Largest distance of a palm's shape from the base of a finger [m] (ours)
SCENERY = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)  # Shapes of no palm (ours)


def with_palm_of_world(spec: mujoco.MjSpec, path: Path, notes: list[Note]) -> mujoco.MjSpec:
    """The hand with a body for the geoms of the world and what stands still beside them, if fingers hang on the world."""
    fingers = [body for body in spec.worldbody.bodies if _is_finger(body)]
    if len(fingers) < 2 or any(_branches(body, spec) for body in spec.worldbody.bodies):
        return spec
    with mujoco_speaks_to([], path):
        model = _flattened(spec)
    bases = np.array([model.body(number).pos for number in _numbers_of(spec, fingers)])
    if np.linalg.norm(bases[:, None] - bases, axis=-1).max() > APART:
        return spec
    _leave_out_scenery(spec, model, fingers, bases, notes)
    taken = {body.name for body in spec.bodies}
    name = next(name for name in ("palm", "palm_of_world", *(f"palm_{i}" for i in range(len(taken)))) if name not in taken)
    whole = mujoco.MjSpec()
    whole.compiler.degree = spec.compiler.degree
    with mujoco_speaks_to([], path):  # of its options, all of which the protocol sets
        whole.attach(spec, prefix="", frame=whole.worldbody.add_body(name=name).add_frame())
    notes.append(Note("info", name, f"is a link for the shapes of the world, on which {len(fingers)} fingers hang"))
    return whole


def _is_finger(body: mujoco.MjsBody) -> bool:
    """Whether a child of the world moves, but not freely."""
    joints = body.find_all("joint")
    return bool(joints) and not body.mocap and not any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in joints)


def _branches(body: mujoco.MjsBody, spec: mujoco.MjSpec) -> bool:
    """Whether a child of the world is a hand by itself: parts of it move in branches that no tie closes."""
    inside = {b.name for b in (body, *body.find_all("body"))}
    tied = any(e.name1 in inside for e in spec.equalities if e.type in {
        mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD} and e.objtype == mujoco.mjtObj.mjOBJ_BODY)
    return branches(body) and not tied


def _flattened(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The compiled world, in which frames are resolved, without what cannot be compiled alone."""
    copied = spec.copy()
    for item in [*copied.keys, *copied.actuators, *copied.sensors]:
        copied.delete(item)
    return compiled(copied, [])


def _numbers_of(spec: mujoco.MjSpec, bodies: Sequence[mujoco.MjsBody]) -> list[int]:
    """Places of bodies among all, which they keep when compiled."""
    everyone = list(spec.bodies)
    return [next(i for i, other in enumerate(everyone) if other == body) for body in bodies]


def _leave_out_scenery(
    spec: mujoco.MjSpec, model: mujoco.MjModel, fingers: Sequence[mujoco.MjsBody], bases: Float[np.ndarray, "n 3"],
    notes: list[Note],
) -> None:
    """Delete, in place, shapes and bodies of the world that are no part of a palm: large ones, far ones, and free ones."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)

    def is_near(geom: int) -> bool:
        away = np.linalg.norm(bases - data.geom_xpos[geom], axis=1).min() - model.geom_rbound[geom]
        return bool(model.geom_type[geom] not in SCENERY and model.geom_rbound[geom] < LARGEST_PALM and away < NEAR)

    of_world = np.flatnonzero(model.geom_bodyid == 0).tolist()
    for geom, near in zip(list(spec.worldbody.geoms), map(is_near, of_world), strict=True):
        if not near:
            spec.delete(geom)
    others = [body for body in spec.worldbody.bodies if body not in fingers]
    for body, number in zip(others, _numbers_of(spec, others), strict=True):
        its = np.flatnonzero(model.body_rootid[model.geom_bodyid] == number).tolist()
        if body.find_all("joint") or body.mocap or not any(map(is_near, its)):
            notes.append(Note("info", body.name or "body", "is not part of the hand and is left out"))
            spec.delete(body)
