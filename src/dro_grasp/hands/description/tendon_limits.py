"""Fixed tendons that hardly may change their length tie the two joints that they run over, as an equality would."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from dro_grasp.hands.description.compiling import Note

SLACK = 0.02  # Largest play of a tied joint [rad or m] (ours); rolling joints of published hands have 0.002 rad


def tie_by_limits(spec: mujoco.MjSpec, driven: set[str], notes: list[Note]) -> None:
    """Add, in place, the equality of each such tendon. The joint that an actuator moves leads, or else the one nearer to it."""
    waiting = [ties for tendon in spec.tendons if (ties := _tied(tendon)) is not None]
    followers = {e.name1 for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT and e.active}
    while waiting:
        moved = driven | followers
        tendon, first, second = next((t for t in waiting if (t[1] in moved) != (t[2] in moved)), waiting[0])
        waiting.remove((tendon, first, second))
        leader, follower = (second, first) if second in moved and first not in moved else (first, second)
        if follower in moved:
            continue  # both are led or driven already, and no joint follows two
        followers.add(follower)
        _tie(spec, tendon, follower, leader)
        notes.append(Note("info", follower, f"follows '{leader}', as the length of tendon '{tendon.name}' is limited to one "
                          "value"))


def _tied(tendon: mujoco.MjsTendon) -> tuple[mujoco.MjsTendon, str, str] | None:
    """A tendon and the two joints that it ties; None if it ties none."""
    wraps = list(tendon.path)
    joints = [w.target.name for w in wraps if w.type == mujoco.mjtWrap.mjWRAP_JOINT and w.target is not None]
    limited = tendon.limited != mujoco.mjtLimited.mjLIMITED_FALSE and tendon.range[1] > tendon.range[0]
    if not limited or len(wraps) != 2 or len(set(joints)) != 2:
        return None
    least = min(abs(wrap.coef) for wrap in wraps)
    play = float(np.diff(tendon.range)[0])
    return (tendon, joints[0], joints[1]) if play <= SLACK * least else None


def _tie(spec: mujoco.MjSpec, tendon: mujoco.MjsTendon, follower: str, leader: str) -> None:
    """The equality by which one joint follows another so that the tendon keeps the middle of its lengths."""
    share = {wrap.target.name: wrap.coef for wrap in tendon.path}
    rest = {j.name: j.ref * (math.radians(1) if j.compiler.degree and j.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0)
            for j in spec.joints if j.name in share}
    length = float(np.mean(tendon.range)) - sum(share[name] * rest[name] for name in share)
    equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=follower, name2=leader, objtype=mujoco.mjtObj.mjOBJ_JOINT)
    equality.data[:2] = [length / share[follower], -share[leader] / share[follower]]
