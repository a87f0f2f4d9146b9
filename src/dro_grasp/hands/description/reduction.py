"""Reduce a MuJoCo specification to the hand alone: one body tree, its couplings as joint equalities, nothing else."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco

from dro_grasp.errors import HandError
from dro_grasp.hands.description.closed_loops import couple_closed_loops, driven_joints, is_linear
from dro_grasp.hands.description.compiling import MAX_JOINTS, Note

NO_LIMITS = "states no limits"  # Beginning of the note of a joint whose limits had to be assumed
CONTINUOUS_LIMIT = math.pi  # Limits of hinges that state none, both ways from zero [rad] (ours)
SLIDE_LIMIT = 0.05  # Limits of slides that state none, both ways from zero [m] (ours)


def keep_hand_only(spec: mujoco.MjSpec, path: Path, *, fixed_base: bool = False) -> tuple[Note, ...]:
    """Reduce a file, in place, to its largest articulated body tree, with its root at identity.

    Everything else that is not the hand is deleted, and unless the base is fixed the joints that move all of the hand, too.

    Raises:
        HandError: Nothing moves, or a joint is neither a hinge nor a slide.
    """
    notes: list[Note] = []
    hand = _largest_tree(spec, path)
    named = _name_everything(spec)
    driven = driven_joints(spec)
    _couple_tendons(spec, notes)
    for kind in (spec.actuators, spec.sensors, spec.keys, spec.pairs, spec.cameras, spec.lights, spec.tuples, spec.skins):
        for item in list(kind):
            spec.delete(item)
    for geom in list(spec.worldbody.geoms):
        spec.delete(geom)
    for body in list(spec.worldbody.bodies):
        if body.name != hand.name:
            notes.append(Note("info", body.name, "is not part of the hand and is left out"))
            spec.delete(body)
    hand.pos, hand.quat, hand.mocap = [0, 0, 0], [1, 0, 0, 0], False
    # A rotation stated as Euler angles or axes would take precedence over the quaternion.
    hand.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    for joint in list(hand.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    if not fixed_base:
        _free_wrist(spec, hand, notes)
    _check_joints(spec, path, notes)
    couple_closed_loops(spec, driven, path, notes)
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    _keep_joint_equalities(spec, notes)
    _let_visuals_collide(spec, notes)
    kept = {item.name for item in (*spec.bodies, *spec.joints)}
    return (*notes, *(note for note in named if note.subject in kept))


def _free_wrist(spec: mujoco.MjSpec, hand: mujoco.MjsBody, notes: list[Note]) -> None:
    """Delete the joints that move the whole hand, as those by which simulators let it float: a grasp's wrist is free."""
    link: mujoco.MjsBody | None = hand
    while link is not None:
        for joint in list(link.joints):
            notes.append(Note("info", joint.name, "moves the whole hand and is left out: the wrist of a grasp is free anyway"))
            spec.delete(joint)
        below = list(link.bodies)
        link = below[0] if len(below) == 1 and not list(link.geoms) else None


def _largest_tree(spec: mujoco.MjSpec, path: Path) -> mujoco.MjsBody:
    """The top-level body with the most moving joints below it."""
    roots = list(spec.worldbody.bodies)
    if not roots:
        raise HandError(f"{path} has no body; expected a hand with moving joints")
    counts = [sum(j.type != mujoco.mjtJoint.mjJNT_FREE for j in r.find_all("joint")) for r in roots]
    if max(counts) == 0:
        raise HandError(f"{path} has no moving joint; a hand needs at least one revolute or prismatic joint")
    return roots[counts.index(max(counts))]


def _name_everything(spec: mujoco.MjSpec) -> list[Note]:
    """Name bodies and joints that MJCF leaves unnamed: links and joints are known by their names here."""
    notes = []
    for kind, items in (("link", list(spec.bodies)[1:]), ("joint", list(spec.joints))):
        taken = {item.name for item in items}
        for number, item in enumerate(items):
            if not item.name:
                name = f"{kind}_{number}"
                while name in taken:
                    name += "_"
                item.name = name
                notes.append(Note("info", name, f"has no name in the file; this {kind} is number {number} there"))
                taken.add(name)
    return notes


def _couple_tendons(spec: mujoco.MjSpec, notes: list[Note]) -> None:
    """Couple the joints of each actuated fixed tendon: they move together, each by the same tendon length."""
    driven = {a.target for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_TENDON}
    leader = {e.name1: e.name2 for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT and e.active}

    def last_leader(name: str) -> str:
        for _ in leader:  # as often as there are followers; a cycle is reported when the tree is built
            name = leader.get(name) or name
        return name

    for tendon in spec.tendons:
        wraps = [w for w in tendon.path if w.type == mujoco.mjtWrap.mjWRAP_JOINT and w.target is not None]
        if tendon.name not in driven or len(wraps) < 2:
            continue
        first = wraps[0]
        for other in wraps[1:]:
            tied = last_leader(other.target.name) == last_leader(first.target.name)
            if tied or other.target.name in leader or abs(other.coef) < 1e-9:
                continue
            leader[other.target.name] = first.target.name
            equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=other.target.name, name2=first.target.name,
                                         objtype=mujoco.mjtObj.mjOBJ_JOINT)
            equality.data[:2] = [0.0, first.coef / other.coef]
            notes.append(Note("info", other.target.name, f"shares tendon '{tendon.name}' with "
                              f"'{first.target.name}' and moves with it"))


def _keep_joint_equalities(spec: mujoco.MjSpec, notes: list[Note]) -> None:
    """Keep only couplings that the kinematic tree can state, so simulation and kinematics agree."""
    joints, bodies = {joint.name for joint in spec.joints}, {body.name for body in list(spec.bodies)[1:]}
    for equality in list(spec.equalities):
        inside = equality.name1 in joints and (not equality.name2 or equality.name2 in joints)
        if equality.type == mujoco.mjtEq.mjEQ_JOINT and equality.active and inside:
            if not is_linear(equality):
                equality.data[2:5] = 0.0
                notes.append(Note("warning", equality.name1, f"follows '{equality.name2}' by a polynomial; only its linear "
                                  "part is kept"))
            continue
        lost = ""
        if equality.type == mujoco.mjtEq.mjEQ_TENDON:
            lost = "is a tendon whose length cannot stay"
        elif equality.type in {mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD} and (
                equality.objtype != mujoco.mjtObj.mjOBJ_BODY or {equality.name1, equality.name2} <= bodies):
            lost = f"is tied to '{equality.name2}' in a loop that cannot close"
        if lost and equality.active:
            text = f"{lost} within its joints' limits; it is left out, and they move freely"
            notes.append(Note("warning", equality.name1, text))
        spec.delete(equality)


def _check_joints(spec: mujoco.MjSpec, path: Path, notes: list[Note]) -> None:
    """Give unlimited joints limits; refuse ball joints, inner free joints, and more joints than any hand has."""
    if (count := len(list(spec.joints))) > MAX_JOINTS:
        raise HandError(f"{path} has {count} joints; expected at most {MAX_JOINTS}, fix those that are not the hand's")
    for joint in spec.joints:
        if joint.type in {mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_FREE}:
            kind = "ball" if joint.type == mujoco.mjtJoint.mjJNT_BALL else "free"
            raise HandError(f"{path}: joint '{joint.name}' is a {kind} joint; expected hinges and slides (use three hinges)")
        limited = joint.limited == mujoco.mjtLimited.mjLIMITED_TRUE or (
            joint.limited == mujoco.mjtLimited.mjLIMITED_AUTO and joint.range[0] < joint.range[1])
        if not limited:
            slides = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
            limit = SLIDE_LIMIT if slides else CONTINUOUS_LIMIT
            # Angles are in the unit of the file, and compiled from there.
            stated = math.degrees(limit) if spec.compiler.degree and not slides else limit
            joint.range = [-stated, stated]
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            notes.append(Note("warning", joint.name, f"{NO_LIMITS}; taken as +-{limit:.2f}"))


def _let_visuals_collide(spec: mujoco.MjSpec, notes: list[Note]) -> None:
    if any(g.contype or g.conaffinity for g in spec.geoms):
        return
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 1
    notes.append(Note("warning", "collision", "the description has no collision geometry; its visual shapes collide"))
