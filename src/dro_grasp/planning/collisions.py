"""Which configurations of the robot collide, with itself, the table, obstacles, and the object that it grasps or carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from dro_grasp.descriptions.collision import collide
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.robot_file import Table
from dro_grasp.planning.workcell import ARM, add_solids, arm_addresses, robot_spec, wxyz
from dro_grasp.simulation.hand_part import PREFIX, joint_addresses
from dro_grasp.simulation.protocols import PROTOCOLS

ARM_PART = 0
"""Geoms of the arm."""
HAND_PART = 1
"""Geoms of the hand."""
SURROUNDINGS = 2
"""Table and obstacles."""
OBJECT = 3
"""The object that is grasped."""
BITS = {ARM_PART: (1, 15), HAND_PART: (2, 13), SURROUNDINGS: (4, 11), OBJECT: (8, 7)}
"""MuJoCo's contype and conaffinity by part: only the arm collides with itself. Fingers that meet are the grasp's affair."""
CLEARANCE = 0.005
"""Distance that the robot keeps from everything else while it travels [m] (ours)."""
SAMPLES = 100
"""Random configurations in which links that always collide are looked for (ours)."""
SINK = 0.002
"""How much deeper than at the start a carried object may be in what it stood on or against [m]; clouds are not exact (ours)."""
ALWAYS = 0.95
"""Share of these in which they collide (ours)."""
TARGET = "target"
"""Name of the object that is grasped."""
OBSTACLE = "obstacle"
"""What obstacles are called in contacts."""


@dataclass(frozen=True)
class Contact:
    """Two bodies that are too close."""

    first: str
    second: str
    distance: float
    """Negative where they penetrate [m]."""


class CollisionChecker:
    """One MuJoCo model of robot, table, obstacles and object, asked about one configuration after the other."""

    def __init__(
        self, robot: Robot, table: Table | None = None, obstacles: Sequence[ObjectModel] = (),
        target: ObjectModel | None = None, T_world_target: Float[np.ndarray, "4 4"] | None = None,
    ) -> None:
        """Build the model.

        Args:
            robot: Arm and hand; contacts that they always have are excluded.
            table: Where it stands; None for no table.
            obstacles: Things in the world's frame; clouds count as small boxes.
            target: The object; a bare cloud counts as its convex hull.
            T_world_target: Where it stands [m]; its frame is the world's by default.
        """
        self.robot, self.T_world_target = robot, np.eye(4) if T_world_target is None else T_world_target
        scene = robot_spec(robot, PROTOCOLS["dro"], table)
        add_solids(scene, scene.worldbody, obstacles)
        if target is not None:
            body = scene.worldbody.add_body(name=TARGET)
            body.add_freejoint(name=TARGET)  # MuJoCo lets no fixed body collide with another
            add_solids(scene, body, [target], hull=True)
        self._set_bits(scene)
        self.excluded = exclude_constant_contacts(scene, robot)
        """Pairs of links that collide at home or nearly everywhere; they are not checked."""
        self.model = scene.compile()
        self.data = mujoco.MjData(self.model)
        self.arm_qpos, (self.hand_qpos, self.hand_moving) = arm_addresses(self.model, robot), joint_addresses(
            self.model, robot.hand)
        self.part = np.array([part_of(self.model, g) for g in range(self.model.ngeom)])
        tree = robot.hand.tree
        self._coupling, self._offset = (t.double().numpy()[self.hand_moving] for t in (tree.coupling, tree.offset))
        start = None if target is None else int(self.model.jnt_qposadr[self.model.joint(TARGET).id])
        self._target_qpos = slice(0) if start is None else slice(start, start + 7)
        self._standing = np.concatenate([self.T_world_target[:3, 3], wxyz(self.T_world_target[:3, :3])])

    def _set_bits(self, scene: mujoco.MjSpec) -> None:
        for geom in scene.geoms:
            if not geom.contype and not geom.conaffinity:
                continue
            part = _part(geom.parent.name if geom.parent is not None else "")
            geom.contype, geom.conaffinity = BITS[part]
            geom.margin = CLEARANCE if part in {ARM_PART, HAND_PART} else 0.0

    def contacts(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], clearance: float = 0.0,
        moved: Float[np.ndarray, "4 4"] | None = None, touch: bool = False,
    ) -> list[Contact]:
        """What collides.

        Args:
            arm: Joints of the arm [rad or m].
            hand: Independent joints of the hand [rad or m].
            clearance: Distance below which robot and surroundings count as colliding [m], at most CLEARANCE.
            moved: Motion of the object from where it stands, in the world, if the hand carries it.
            touch: The hand may touch the object.
        """
        pairs, distance = self._detect(arm, hand, moved)
        bad = self._bad(pairs, distance, clearance, moved is not None, touch)
        return [Contact(self._name(a), self._name(b), d)
                for (a, b), d in zip(pairs[bad].tolist(), distance[bad].tolist(), strict=True)]

    def free(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], clearance: float = CLEARANCE,
        moved: Float[np.ndarray, "4 4"] | None = None, touch: bool = False,
    ) -> bool:
        """Whether nothing collides; arguments as for `contacts`."""
        return not self._bad(*self._detect(arm, hand, moved), clearance, moved is not None, touch).any()

    def _name(self, geom: int) -> str:
        body = int(self.model.geom_bodyid[geom])
        return self.model.body(body).name if body else self.model.geom(geom).name or OBSTACLE

    def _detect(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], moved: Float[np.ndarray, "4 4"] | None
    ) -> tuple[Int[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        model, data = self.model, self.data
        data.qpos[self.arm_qpos] = arm
        data.qpos[self.hand_qpos] = self._coupling @ hand + self._offset
        if self._target_qpos.stop:
            T = self.T_world_target if moved is None else moved @ self.T_world_target
            data.qpos[self._target_qpos] = self._standing if moved is None else [*T[:3, 3], *wxyz(T[:3, :3])]
        collide(model, data)
        return data.contact.geom.copy(), data.contact.dist.copy()

    def _bad(
        self, pairs: Int[np.ndarray, "k 2"], distance: Float[np.ndarray, " k"], clearance: float, moved: bool, touch: bool
    ) -> Bool[np.ndarray, " k"]:
        low, high = np.sort(self.part[pairs], axis=1).reshape(-1, 2).T
        bad = distance < np.where(high <= HAND_PART, 0.0, clearance)
        if touch:
            bad &= (high != OBJECT) | (low != HAND_PART)
        beside = (high == OBJECT) & (low == SURROUNDINGS)
        return np.where(beside, moved & (distance < self._resting - SINK), bad)

    @cached_property
    def _resting(self) -> float:
        """Signed distance of the object, where it stands, to the nearest of table and obstacles, at most zero [m]."""
        pairs, distance = self._detect(self.robot.home, open_hand(self.robot), None)
        beside = (np.sort(self.part[pairs], axis=1).reshape(-1, 2) == (SURROUNDINGS, OBJECT)).all(1)
        return min(0.0, float(distance[beside].min(initial=0.0)))


def part_of(model: mujoco.MjModel, geom: int) -> int:
    """Which part of the scene a geom is of."""
    return _part(model.body(int(model.geom_bodyid[geom])).name)


def _part(body: str) -> int:
    if body.startswith(ARM):
        return ARM_PART
    return HAND_PART if body.startswith(PREFIX) else OBJECT if body == TARGET else SURROUNDINGS


def exclude_constant_contacts(scene: mujoco.MjSpec, robot: Robot) -> tuple[tuple[str, str], ...]:
    """Exclude contacts between links that collide at home with the open hand or nearly everywhere, and of fixed neighbours."""
    model = scene.compile()
    data = mujoco.MjData(model)
    arm, (hand, moving) = arm_addresses(model, robot), joint_addresses(model, robot.hand)
    tree = robot.hand.tree
    opened = (tree.coupling @ robot.hand.canonical_joints() + tree.offset).double().numpy()[moving]
    draws = np.random.default_rng(0).uniform(robot.lower, robot.upper, (SAMPLES, len(robot.home)))
    count: dict[tuple[str, str], int] = {}
    for i, q in enumerate([robot.home, *draws]):
        data.qpos[arm], data.qpos[hand] = q, opened
        collide(model, data)
        touching = data.contact.geom[data.contact.dist < 0].tolist()
        for pair in {_robot_pair(model, a, b) for a, b in touching}:
            if pair is not None and pair[0] != pair[1]:
                count[pair] = count.get(pair, 0) + (SAMPLES if i == 0 else 1)
    excluded = {pair for pair, n in count.items() if n >= ALWAYS * SAMPLES} | set(_neighbours(model))
    for first, second in sorted(excluded):
        scene.add_exclude(bodyname1=first, bodyname2=second)
    return tuple(sorted(excluded))


def _robot_pair(model: mujoco.MjModel, a: int, b: int) -> tuple[str, str] | None:
    """The two links of a contact of the robot with itself."""
    if max(part_of(model, a), part_of(model, b)) > HAND_PART:
        return None
    first, second = sorted(model.body(int(model.geom_bodyid[g])).name for g in (a, b))
    return first, second


def _neighbours(model: mujoco.MjModel) -> list[tuple[str, str]]:
    """Links next to each other; MuJoCo's own filter ignores those of a fixed parent, and looks past fixed links."""
    pairs = []
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        names = sorted((model.body(body).name, model.body(parent).name))
        if parent > 0 and all(n.startswith((ARM, PREFIX)) for n in names):
            pairs.append((names[0], names[1]))
    return pairs


def open_hand(robot: Robot) -> Float[np.ndarray, " n_dof"]:
    """The posture in which the hand travels [rad or m]."""
    with torch.no_grad():
        return robot.hand.canonical_joints().double().numpy()
