"""Reduce a MuJoCo specification to the hand alone: one body tree, its couplings as joint equalities, nothing else.

A linkage, such as that of most parallel grippers, is a tree whose ends are tied together. Its ties are closed here from one
end of each leader's range to the other, and what the other joints do meanwhile becomes a linear rule. Where the ties leave
them free, the file's springs decide, as they do while nothing is touched. Ties between tendons, and joints that follow by a
polynomial, become linear rules in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from dro_grasp.errors import HandError
from dro_grasp.hands.description.body_trees import hand_tree
from dro_grasp.hands.description.compiling import MAX_JOINTS, MAX_LENGTH, MAX_TURN, Note, compile_hand
from dro_grasp.hands.description.tendon_limits import tie_by_limits

NO_LIMITS = "states no limits"  # Beginning of the note of a joint whose limits had to be assumed
CONTINUOUS_LIMIT = math.pi  # Limits of hinges that state none, both ways from zero [rad] (ours)
BALL_LIMIT = math.pi / 2  # Limits of the three hinges of a ball that states none, both ways from zero [rad] (ours)
SPECK = 0.004
"""Extent below which spheres and boxes are no part of a finger [m] (ours); stand-ins of published hands have 2 mm."""
PLAIN = {mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE,
         mujoco.mjtGeom.mjGEOM_ELLIPSOID}
"""Shapes whose size is stated."""
SLIDE_LIMIT = 0.05  # Limits of slides that state none, both ways from zero [m] (ours)


def keep_hand_only(spec: mujoco.MjSpec, path: Path, *, fixed_base: bool = False) -> tuple[Note, ...]:
    """Reduce a file, in place, to its hand, or else its largest articulated body tree, with its root at identity.

    Everything else that is not the hand is deleted, and unless the base is fixed the joints that move all of the hand, too.
    HandError: nothing moves, several trees may be the hand, a joint within the hand is free, or one follows itself.
    """
    notes: list[Note] = []
    _refuse_self_ties(spec, path)
    hand = hand_tree(spec, path, fixed_base)
    named = _name_everything(spec)
    driven = driven_joints(spec)
    _limit_joints_as_actuators(spec)
    _couple_tendons(spec, notes)
    tie_by_limits(spec, driven, notes)
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
    hand.set_frame(spec.worldbody.add_frame())  # one around the hand would move it as well
    for joint in list(hand.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    if not fixed_base:
        _free_wrist(spec, hand, notes)
    _hold_specks(spec, hand, notes)
    passive = _split_balls(spec, driven, path, notes)
    _check_joints(spec, path, notes)
    couple_closed_loops(spec, driven, path, notes, passive)
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    _keep_joint_equalities(spec, notes)
    _let_visuals_collide(spec, notes)
    kept = {item.name for item in (*spec.bodies, *spec.joints)}
    return (*notes, *(note for note in named if note.subject in kept))


def _refuse_self_ties(spec: mujoco.MjSpec, path: Path) -> None:
    """Refuse a joint that follows itself, by a HandError; longer cycles are refused when the tree is built."""
    for tie in spec.equalities:
        if tie.type == mujoco.mjtEq.mjEQ_JOINT and tie.active and tie.name1 == tie.name2:
            raise HandError(f"{path}: joint '{tie.name1}' follows itself, so nothing says where it is; name the joint that it "
                            "follows in its <mimic> or <equality>, or remove that if it moves by itself")


def _free_wrist(spec: mujoco.MjSpec, hand: mujoco.MjsBody, notes: list[Note]) -> None:
    """Delete the joints that move the whole hand, as those by which simulators let it float: a grasp's wrist is free."""
    link: mujoco.MjsBody | None = hand
    while link is not None:
        for joint in list(link.joints):
            notes.append(Note("info", joint.name, "moves the whole hand and is left out: the wrist of a grasp is free anyway"))
            spec.delete(joint)
        below = list(link.bodies)
        link = below[0] if len(below) == 1 and not list(link.geoms) else None


def _hold_specks(spec: mujoco.MjSpec, hand: mujoco.MjsBody, notes: list[Note]) -> None:
    """Delete, in place, joints that move nothing but specks and lead nothing: links that stand for motors are no fingers."""
    tied = {name for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT for name in (e.name1, e.name2)}
    still: list[mujoco.MjsJoint] = []
    for body in [each for each in spec.bodies if each.name not in {"world", hand.name}]:
        shapes = body.find_all("geom")
        if shapes and all(shape.type in PLAIN and 2 * float(np.max(shape.size)) < SPECK for shape in shapes):
            still.extend(joint for joint in body.joints if joint.name not in tied)
    for joint in still if len(still) < len(spec.joints) else ():  # where all are so small, it is the unit
        notes.append(Note("info", joint.name, f"moves nothing but shapes of less than {1000 * SPECK:.0f} mm, as those of links "
                          "that stand for motors; taken as fixed"))
        spec.delete(joint)


def _split_balls(spec: mujoco.MjSpec, driven: set[str], path: Path, notes: list[Note]) -> set[str]:
    """Replace, in place, ball joints by three hinges; the names of those that no actuator moves, which loops may."""
    passive: set[str] = set()
    for ball in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_BALL]:
        body, name = ball.parent, ball.name
        if list(body.joints)[-1] != ball:
            raise HandError(f"{path}: joint '{name}' is a ball joint before another joint of link '{body.name}'; expected "
                            "it last, or three hinges")
        limit = float(ball.range[1]) or (math.degrees(BALL_LIMIT) if ball.compiler.degree else BALL_LIMIT)
        stated = {"pos": ball.pos.copy(), "stiffness": ball.stiffness, "range": [-limit, limit],
                  "actfrclimited": ball.actfrclimited, "actfrcrange": ball.actfrcrange.copy(),
                  "limited": mujoco.mjtLimited.mjLIMITED_TRUE}
        names = [f"{name}_{letter}" for letter in "xyz"]
        spec.delete(ball)
        for each, axis in zip(names, np.eye(3), strict=True):
            body.add_joint(name=each, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, **stated)
        if name in driven:
            driven.update(names)
        else:
            passive.update(names)
        notes.append(Note("info", name, f"is a ball joint, taken as three hinges, {', '.join(names)}"))
    return passive


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
        if tendon.name in driven and (pulled := _pulled(tendon)):
            notes.append(Note("warning", tendon.name, f"is a tendon over sites that an actuator pulls; what it moves "
                              f"({', '.join(pulled)}) is taken as free: state by <equality> how these joints follow"))
        if tendon.name not in driven or len(wraps) < 2:
            continue
        first = wraps[0]
        for other in wraps[1:]:
            tied = last_leader(other.target.name) == last_leader(first.target.name)
            if tied or other.target.name in leader or abs(other.coef) < SLACK:
                continue
            leader[other.target.name] = first.target.name
            equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=other.target.name, name2=first.target.name,
                                         objtype=mujoco.mjtObj.mjOBJ_JOINT)
            equality.data[:2] = [0.0, first.coef / other.coef]
            notes.append(Note("info", other.target.name, f"shares tendon '{tendon.name}' with "
                              f"'{first.target.name}' and moves with it"))


def _pulled(tendon: mujoco.MjsTendon) -> list[str]:
    """Names of the joints between the sites of a spatial tendon; empty for one that runs over joints, or over one of them."""
    paths = []
    for wrap in tendon.path:
        if wrap.type != mujoco.mjtWrap.mjWRAP_SITE or wrap.target is None:
            continue
        body, path = wrap.target.parent, []
        while body is not None and body.name != "world":
            path, body = [body, *path], body.parent
        paths.append({each.name: [joint.name for joint in each.joints] for each in path})
    shared = set.intersection(*map(set, paths)) if paths else set()
    between = {joint: None for path in paths for name, joints in path.items() if name not in shared for joint in joints}
    return list(between) if len(between) > 1 else []


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
    """Give unlimited joints limits; refuse inner free joints, and more joints than any hand has."""
    if (count := len(list(spec.joints))) > MAX_JOINTS:
        raise HandError(f"{path} has {count} joints; expected at most {MAX_JOINTS}, fix those that are not the hand's")
    _hold_joints_without_range(spec, path, notes)
    led = {equality.name1 for equality in spec.equalities if equality.active and equality.name2 and is_linear(equality)}
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            raise HandError(f"{path}: joint '{joint.name}' is a free joint; expected hinges, slides and balls")
        limited = joint.limited == mujoco.mjtLimited.mjLIMITED_TRUE or (
            joint.limited == mujoco.mjtLimited.mjLIMITED_AUTO and joint.range[0] < joint.range[1])
        if not limited:
            slides = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
            if joint.name in led:  # its leader limits it
                _limit(spec, joint.name, *((-MAX_LENGTH, MAX_LENGTH) if slides else (-MAX_TURN, MAX_TURN)))
                joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
                continue
            limit = SLIDE_LIMIT if slides else CONTINUOUS_LIMIT
            vain = f" that count ({told})" if (told := _told_range(joint.range)) else ""
            _limit(spec, joint.name, -limit, limit)
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            notes.append(Note("warning", joint.name, f"{NO_LIMITS}{vain}; taken as +-{limit:.2f}"))


def _told_range(limits: Sequence[float] | Float[np.ndarray, "2"]) -> str:
    """Limits that a joint states but that do not count, in words; empty if it states none."""
    low, high = limits
    return "" if low == high == 0 else f"{low:g} to {high:g}" + ("" if low >= high else ", but limited is 'false'")


def _hold_joints_without_range(spec: mujoco.MjSpec, path: Path, notes: list[Note]) -> None:
    """Hold joints, in place, that are limited to one value, which MuJoCo refuses. HandError: no other joint moves."""
    still = [j for j in spec.joints if j.limited == mujoco.mjtLimited.mjLIMITED_TRUE and j.range[0] == j.range[1]]
    if still and len(still) == len(list(spec.joints)):
        raise HandError(f"{path} has no moving joint: both limits of {len(still)} joints are equal "
                        f"({', '.join(joint.name for joint in still[:3])}{', ...' if len(still) > 3 else ''}); "
                        "state their limits")
    led = {equality.name1 for equality in spec.equalities if is_linear(equality)}
    for joint in still:
        unit = math.degrees(1) if joint.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0
        value = float(joint.range[0])
        joint.range = [value - STILL * unit, value + STILL * unit]
        notes.append(Note("warning", joint.name, f"has both limits at {value:g} and is held there"))
        if joint.name not in led:
            tie = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1=joint.name)
            tie.data[0] = (value - float(joint.ref)) / unit


def _let_visuals_collide(spec: mujoco.MjSpec, notes: list[Note]) -> None:
    if any(g.contype or g.conaffinity for g in spec.geoms):
        return
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 1
    notes.append(Note("warning", "collision", "the description has no collision geometry; its visual shapes collide"))


Joints = Float[np.ndarray, " n"]  # a value of each joint
Sweeps = dict[int, Float[np.ndarray, "_ n"]]  # by leader, joint values while it goes through its range
SLACK = 1e-9  # Coefficient below which a tendon does not pull at a joint [m/rad or 1] (ours)
CLOSED = 1e-3  # Largest gap of a loop that counts as closed [m or rad] (ours)
STEPS = 32  # Steps from one end of a leader's range to the other (ours)
SPRING = 1e-2  # Weight of the strongest spring beside a gap, which counts in units of `CLOSED` (ours)
STAY = 1e-3  # Weight of staying where a joint was a step before, which decides where nothing else does (ours)
OFF_CENTRE = 0.1
"""Share of the way to the middle of the ranges at which freedoms are counted: at their start, some are singular (ours)."""
STRAIGHT = 0.05  # Largest distance from a linear rule that is no reason for a warning [rad or m] (ours)
STILL = 1e-3  # Motion over a leader's whole range below which a joint is held [rad or m] (ours)
MINOR = 0.1  # Share of a joint's motion that other leaders may make without a warning (ours)


def driven_joints(spec: mujoco.MjSpec) -> set[str]:
    """Names of the joints that actuators move, by themselves or through a fixed tendon."""
    wrapped = {t.name: [w.target.name for w in t.path if w.type == mujoco.mjtWrap.mjWRAP_JOINT and w.target is not None]
               for t in spec.tendons}
    driven: set[str] = set()
    for actuator in spec.actuators:
        through_tendon = actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON
        driven.update(wrapped.get(actuator.target, ()) if through_tendon else (actuator.target,))
    return driven & {joint.name for joint in spec.joints}


def _limit_joints_as_actuators(spec: mujoco.MjSpec) -> None:
    """State, in place, the largest effort of each driven joint at the joint, where it outlives the actuators."""
    tendons = {t.name: t for t in spec.tendons}
    joints = {j.name: j for j in spec.joints}
    for actuator in spec.actuators:
        if not (force := _largest_force(actuator)):
            continue
        shares = {actuator.target: float(np.abs(actuator.gear[:3]).max())}  # a ball's gear has three numbers
        if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON and actuator.target in tendons:
            wraps = [w for w in tendons[actuator.target].path
                     if w.type == mujoco.mjtWrap.mjWRAP_JOINT and w.target is not None and abs(w.coef) >= SLACK]
            # Whichever joint leads the others does the work of all: by one length of the tendon, it works as much at each.
            shares = {w.target.name: len(wraps) * abs(w.coef * actuator.gear[0]) for w in wraps}
        for name, share in shares.items():
            if name in joints and share and joints[name].actfrclimited != mujoco.mjtLimited.mjLIMITED_TRUE:
                most = min(share * force, _stated_effort(joints[name]))
                joints[name].actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
                joints[name].actfrcrange = [-most, most]


def _stated_effort(joint: mujoco.MjsJoint) -> float:
    """Largest effort that a joint states without saying that it is limited [N or Nm]; infinite where it states none."""
    auto = joint.actfrclimited == mujoco.mjtLimited.mjLIMITED_AUTO and joint.actfrcrange[0] < joint.actfrcrange[1]
    return float(np.abs(joint.actfrcrange).max()) if auto else math.inf


def _largest_force(actuator: mujoco.MjsActuator) -> float:
    """Largest force that an actuator exerts [N or Nm]; 0 where it states none."""
    if np.diff(actuator.forcerange)[0] > 0:
        return float(np.abs(actuator.forcerange).max())
    motor = actuator.biastype == mujoco.mjtBias.mjBIAS_NONE and np.diff(actuator.ctrlrange)[0] > 0
    return float(abs(actuator.gainprm[0]) * np.abs(actuator.ctrlrange).max()) if motor else 0.0


def couple_closed_loops(
    spec: mujoco.MjSpec, driven: Collection[str], path: Path, notes: list[Note], passive: Collection[str] = ()
) -> None:
    """Replace, in place, ties of closed loops by joint equalities that driven joints lead; ties that cannot be closed stay.

    Passive joints lead nothing: what ties leave free of them stays as it is.
    """
    if not spec.joints or not any(e.active and not is_linear(e) for e in spec.equalities):
        return
    linkage, ties = Linkage(spec, path), [e for e in spec.equalities if e.active]
    for group in linkage.groups():
        motors = linkage.sweeps(group, driven, passive)
        balls = len(motors) > 1 and linkage.names(group) & set(passive)
        sweeps = _led_by_fingers(linkage, group, motors, driven, passive, notes) if balls else motors
        if sweeps and all(len(sweep) > 1 for sweep in sweeps.values()):
            for tie in group.ties:
                spec.delete(ties[tie])
            drives = set() if sweeps is motors else {*driven, *passive}
            _state(spec, linkage, group, sweeps, notes, _without_drives(spec, linkage.names(group), drives, notes))
    _hold_spinning(spec, passive)


def _led_by_fingers(
    linkage: Linkage, group: Group, sweeps: Sweeps, driven: Collection[str], passive: Collection[str], notes: list[Note]
) -> Sweeps:
    """Sweeps by the joints of a finger, where rods on balls let several motors move each; else those that are given."""
    own = linkage.names(group) - set(driven) - set(passive)
    rules = [Rule.of(j, sweeps, linkage.model.qpos0) for j in group.joints if linkage.model.joint(j).name in own]
    if not any(rule.also for rule in rules):
        return sweeps
    others = linkage.sweeps(group, own, passive)
    leaders = [linkage.model.joint(j).name for j in others]
    if not set(leaders) <= own or any(len(sweep) < 2 for sweep in others.values()):
        return sweeps
    motors = " and ".join(linkage.model.joint(j).name for j in sweeps)
    told = f"is moved by {motors} together; grasps state its values, not theirs"
    notes.extend(Note("warning", name, told) for name in leaders)
    return others


def _without_drives(spec: mujoco.MjSpec, group: Collection[str], drives: set[str], notes: list[Note]) -> set[str]:
    """Delete, in place, a group's motors and rods that carry no finger; their joints' names. Several joints lead each."""
    gone: set[str] = set()
    for name in sorted(group):
        if name in gone:  # with the body of another one
            continue
        body = spec.joint(name).parent
        below = {other.name for other in (*body.joints, *body.find_all("joint"))}
        if below <= drives:
            inside = {body.name, *(other.name for other in body.find_all("body"))}
            for pair in [pair for pair in spec.excludes if inside & {pair.bodyname1, pair.bodyname2}]:
                spec.delete(pair)
            notes.append(Note("info", body.name, "drives a finger together with others, and is left out"))
            gone |= below
            spec.delete(body)
    return gone


def _hold_spinning(spec: mujoco.MjSpec, passive: Collection[str]) -> None:
    """Hold hinges of passive balls, in place, that no tie moves while it moves others of the same ball: a rod's own axis."""
    led = {equality.name1 for equality in spec.equalities if is_linear(equality)}
    balls = {name[:-2] for name in led if name in passive}
    for name in (name for name in sorted(passive) if name not in led and name[:-2] in balls):
        spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1=name)


def is_linear(equality: mujoco.MjsEquality) -> bool:
    """Whether a tie is a joint that is held, or follows another by a linear rule."""
    return equality.type == mujoco.mjtEq.mjEQ_JOINT and bool((np.abs(equality.data[2:5]) < 1e-9).all())


@dataclass(frozen=True)
class Group:
    """Joints that ties connect."""

    joints: tuple[int, ...]  # their numbers, shallow ones first
    ties: tuple[int, ...]  # numbers of the ties


class Linkage:
    """A hand with its ties, and the joint values at which they are closed."""

    def __init__(self, spec: mujoco.MjSpec, path: Path) -> None:
        """Compile a copy of the hand, in which nothing but ties acts."""
        spec, off = spec.copy(), mujoco.mjtDisableBit
        for equality in [e for e in spec.equalities if not e.active]:
            spec.delete(equality)
        self.ties = list(spec.equalities)
        self.model = compile_hand(spec, path, [])
        self.model.eq_solref[:] = 0.02, 1.0  # MuJoCo's own; it prints what it finds wrong with others
        self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.model.opt.disableflags = int(off.mjDSBL_CONTACT | off.mjDSBL_LIMIT | off.mjDSBL_FRICTIONLOSS)
        self.data = mujoco.MjData(self.model)
        self.lower, self.upper = self.model.jnt_range.T
        self.start = self.model.qpos0.clip(self.lower, self.upper)
        springs = self.model.jnt_stiffness.reshape(self.model.njnt, -1)[:, 0].clip(0)
        self.springs = SPRING * np.sqrt(springs / max(springs.max(initial=0.0), 1e-12))

    def gaps(self, q: Joints, ties: Sequence[int]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
        """Gaps of some ties [m or rad], and their derivatives by the joints."""
        self.data.qpos[:] = q
        for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_makeConstraint):
            step(self.model, self.data)
        n, of_these = self.data.nefc, np.isin(self.data.efc_id, ties)
        # Gaps that no joint moves are left out, but room for their derivatives may be there.
        return self.data.efc_pos[of_these], self.data.efc_J.reshape(-1, self.model.nv)[:n][of_these]

    def groups(self) -> list[Group]:
        """The groups of joints that ties connect, those without any but linear rules left out."""
        places = (self.start, self._off_centre())
        jacobians = [np.concatenate([self.gaps(q, [tie])[1] for q in places]) for tie in range(len(self.ties))]
        moved = [np.abs(jacobian).sum(0) > 1e-9 for jacobian in jacobians]
        connected = np.eye(self.model.njnt, dtype=bool)
        for its in moved:
            connected |= its[:, None] & its
        for _ in range(self.model.njnt.bit_length()):
            connected = connected @ connected
        found = []
        for its in np.unique(connected, axis=0):
            joints = sorted(np.flatnonzero(its).tolist(), key=lambda j: (self._depth(j), j))
            ties = tuple(tie for tie, by in enumerate(moved) if (by & its).any())
            if any(not is_linear(self.ties[tie]) for tie in ties):
                found.append(Group(tuple(joints), ties))
        return found

    def leaders(self, group: Group, driven: Collection[str], passive: Collection[str]) -> list[int]:
        """The joints of a group that lead: driven ones, then others that neither a tie nor a spring determines."""
        jacobian = self.gaps(self.close(group, self._off_centre(), {}), group.ties)[1][:, list(group.joints)]
        following = {self.ties[tie].name1 for tie in group.ties}
        names = {j: self.model.joint(j).name for j in group.joints}
        moved = sorted((j for j in group.joints if names[j] in driven), key=lambda j: names[j] in following)
        sprung = any(self.springs[j] > 0 for j in group.joints)
        others, found = [j for j in group.joints if j not in moved and names[j] not in passive], list[int]()
        for joint in moved if moved and sprung else [*moved, *others]:
            held = np.array([[float(j == k) for j in group.joints] for k in [*found, joint]])
            if np.linalg.matrix_rank(np.vstack([jacobian, held]), 1e-4) == np.linalg.matrix_rank(jacobian, 1e-4) + len(held):
                found.append(joint)
        return found

    def names(self, group: Group) -> set[str]:
        """Names of a group's joints."""
        return {self.model.joint(j).name for j in group.joints}

    def sweeps(self, group: Group, driven: Collection[str], passive: Collection[str]) -> Sweeps:
        """Joint values while each leader of a group goes through its range, by leader."""
        leaders = self.leaders(group, driven, passive)
        return {leader: self.sweep(group, leaders, leader) for leader in leaders}

    def close(self, group: Group, q: Joints, held: Mapping[int, float]) -> Joints:
        """The joint values near some at which the loops of a group close and its springs rest, with some joints held."""
        from scipy.optimize import least_squares  # slow to load, and few hands have loops

        free = [j for j in group.joints if j not in held and self.upper[j] - self.lower[j] > 1e-9]
        q = q.copy()
        q[list(held)] = list(held.values())
        if not free:
            return q
        before, rest = q[free].clip(self.lower[free], self.upper[free]), self.model.qpos_spring[free]

        def full(x: Float[np.ndarray, " k"]) -> Joints:
            q[free] = x
            return q

        def errors(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, " e"]:
            gaps = self.gaps(full(x), group.ties)[0]
            return np.concatenate([gaps / CLOSED, self.springs[free] * (x - rest), STAY * (x - before)])

        def slopes(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "e k"]:
            jacobian = self.gaps(full(x), group.ties)[1][:, free]
            return np.vstack([jacobian / CLOSED, np.diag(self.springs[free]), STAY * np.eye(len(free))])

        bounds = self.lower[free], self.upper[free]
        # The stubs know no function as jac.
        return full(least_squares(errors, before, slopes, bounds, xtol=1e-12, ftol=1e-12).x)  # pyright: ignore[reportArgumentType]

    def sweep(self, group: Group, leaders: Sequence[int], leader: int) -> Float[np.ndarray, "k n"]:
        """Joint values while one leader goes through its range and the others stay, as far as the loops close."""
        others = {j: self.start[j] for j in leaders if j != leader}
        first = self.close(group, self.start, {**others, leader: self.start[leader]})
        values, ways = np.linspace(self.lower[leader], self.upper[leader], STEPS + 1), []
        for further in (values[values < self.start[leader]][::-1], values[values >= self.start[leader]]):
            q, way = first, []
            for value in further:
                q = self.close(group, q, {**others, leader: value})
                if np.abs(self.gaps(q, group.ties)[0]).max() > CLOSED:
                    break
                way.append(q)
            ways.append(way)
        return np.array([*ways[0][::-1], *ways[1]]).reshape(-1, self.model.njnt)

    def _depth(self, joint: int) -> int:
        depth, body = 0, int(self.model.jnt_bodyid[joint])
        while body:
            depth, body = depth + 1, int(self.model.body_parentid[body])
        return depth

    def _off_centre(self) -> Joints:
        return self.start + OFF_CENTRE * ((self.lower + self.upper) / 2 - self.start)


@dataclass(frozen=True)
class Rule:
    """How far a joint is from its reference value: slope * how far its leader is from its own, + offset."""

    leader: int
    slope: float
    offset: float
    error: float  # largest distance from the rule while the leader goes through its range [rad or m]
    also: tuple[int, ...]  # other leaders that move the joint

    @classmethod
    def of(cls, joint: int, sweeps: Mapping[int, Float[np.ndarray, "k n"]], reference: Joints) -> Rule:
        """The best rule for the leader that moves a joint most, by least squares."""
        moved = {leader: float(np.ptp(sweep[:, joint])) for leader, sweep in sweeps.items()}
        leader = max(moved, key=lambda k: moved[k])
        also = tuple(k for k in moved if k != leader and moved[k] > max(STILL, MINOR * moved[leader]))
        x, y = (sweeps[leader] - reference)[:, [leader, joint]].T
        slope, offset = np.polyfit(x, y, 1).round(5).tolist() if moved[leader] > STILL else (0.0, float(y.mean()))
        return cls(leader, slope, offset, float(np.abs(slope * x + offset - y).max()), also)

    def told(self, names: Sequence[str]) -> str:
        """The rule in words."""
        text = f"follows '{names[self.leader]}' {self.slope:.3g} times" if self.slope else "is held"
        text += ", as its ties make it" + (f", which miss it by up to {self.error:.2g}" if self.error > STRAIGHT else "")
        return text + "".join(f"; that it also moves with '{names[k]}' is left out" for k in self.also)


def _state(
    spec: mujoco.MjSpec, linkage: Linkage, group: Group, sweeps: Mapping[int, Float[np.ndarray, "k n"]], notes: list[Note],
    gone: Collection[str],
) -> None:
    """Add the rules of a group but for joints that are gone, and let its joints' ranges be those in which they hold."""
    names, reference = [linkage.model.joint(j).name for j in range(linkage.model.njnt)], linkage.model.qpos0
    for leader, sweep in sweeps.items():
        first, last = sweep[[0, -1], leader]
        if last - first < linkage.upper[leader] - linkage.lower[leader] - 1e-9:
            _limit(spec, names[leader], first, last)
            notes.append(Note("warning", names[leader], f"its ties hold from {first:.3g} to {last:.3g}; now its limits"))
    for joint in (j for j in group.joints if j not in sweeps and names[j] not in gone):
        rule = Rule.of(joint, sweeps, reference)
        tie = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1=names[joint],
                                name2=names[rule.leader] if rule.slope else "")
        tie.data[:2] = [rule.offset, rule.slope]
        ends = sweeps[rule.leader][[0, -1], rule.leader] - reference[rule.leader]
        reached = reference[joint] + rule.offset + rule.slope * ends
        _limit(spec, names[joint], min(*reached, linkage.lower[joint]), max(*reached, linkage.upper[joint]))
        level = "warning" if rule.error > STRAIGHT or rule.also else "info"
        notes.append(Note(level, names[joint], rule.told(names)))


def _limit(spec: mujoco.MjSpec, name: str, lower: float, upper: float) -> None:
    """Limit a joint [rad or m], in the unit of its own file, of which it is compiled."""
    joint = spec.joint(name)
    turns = joint.type == mujoco.mjtJoint.mjJNT_HINGE and joint.compiler.degree
    joint.range = [math.degrees(lower), math.degrees(upper)] if turns else [lower, upper]
