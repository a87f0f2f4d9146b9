"""Which configurations of the robot collide, with itself, the table, obstacles, and the object that it grasps or carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.robot import Robot
from dro_grasp.planning.robot_file import Table
from dro_grasp.planning.workcell import ARM, add_solids, robot_spec, wxyz
from dro_grasp.simulation.protocols import PROTOCOLS
from dro_grasp.simulation.scene import PREFIX, joint_addresses

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
ALWAYS = 0.95
"""Share of these in which they collide (ours)."""
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
        self, robot: Robot, table: Table | None = None, obstacles: Sequence[ObjectModel] = (), target: ObjectModel | None = None
    ) -> None:
        """Build the model.

        Args:
            robot: Arm and hand; contacts that they always have are excluded.
            table: Where it stands; None for no table.
            obstacles: Things in the world's frame; clouds count as small boxes.
            target: The object, in the world's frame; a bare cloud counts as its convex hull.
        """
        self.robot = robot
        scene = robot_spec(robot, PROTOCOLS["dro"], table)
        add_solids(scene, scene.worldbody, obstacles)
        body = scene.worldbody.add_body(name="target", mocap=True)
        add_solids(scene, body, [] if target is None else [target], hull=True)
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
        self.checks = 0
        """Configurations asked about so far."""

    def _set_bits(self, scene: mujoco.MjSpec) -> None:
        for geom in scene.geoms:
            if not geom.contype and not geom.conaffinity:
                continue
            part = _part(geom.parent.name if geom.parent is not None else "")
            geom.contype, geom.conaffinity = BITS[part]
            geom.margin = CLEARANCE if part in {ARM_PART, HAND_PART} else 0.0

    def contacts(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], clearance: float = 0.0,
        T_world_target: Float[np.ndarray, "4 4"] | None = None, touch: bool = False,
    ) -> list[Contact]:
        """What collides.

        Args:
            arm: Joints of the arm [rad or m].
            hand: Independent joints of the hand [rad or m].
            clearance: Distance below which robot and surroundings count as colliding [m], at most CLEARANCE.
            T_world_target: Motion of the object from where it stood, if the hand carries it; see also `touch`.
            touch: The hand may touch the object, and the object the surroundings it stands on.
        """
        pairs, distance = self._detect(arm, hand, T_world_target)
        bad = self._bad(pairs, distance, clearance, touch)
        return [Contact(self._name(a), self._name(b), d)
                for (a, b), d in zip(pairs[bad].tolist(), distance[bad].tolist(), strict=True)]

    def free(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], clearance: float = CLEARANCE,
        T_world_target: Float[np.ndarray, "4 4"] | None = None, touch: bool = False,
    ) -> bool:
        """Whether nothing collides; arguments as for `contacts`."""
        return not self._bad(*self._detect(arm, hand, T_world_target), clearance, touch).any()

    def _name(self, geom: int) -> str:
        body = int(self.model.geom_bodyid[geom])
        return self.model.body(body).name if body else self.model.geom(geom).name or OBSTACLE

    def _detect(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], T_target: Float[np.ndarray, "4 4"] | None
    ) -> tuple[Int[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        self.checks += 1
        model, data = self.model, self.data
        data.qpos[self.arm_qpos] = arm
        data.qpos[self.hand_qpos] = self._coupling @ hand + self._offset
        T = np.eye(4) if T_target is None else T_target
        data.mocap_pos[0], data.mocap_quat[0] = T[:3, 3], wxyz(T[:3, :3]) if T_target is not None else (1, 0, 0, 0)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        return data.contact.geom.copy(), data.contact.dist.copy()

    def _bad(
        self, pairs: Int[np.ndarray, "k 2"], distance: Float[np.ndarray, " k"], clearance: float, touch: bool
    ) -> Bool[np.ndarray, " k"]:
        low, high = np.sort(self.part[pairs], axis=1).reshape(-1, 2).T
        least = np.where(high <= HAND_PART, 0.0, clearance)
        bad = distance < least
        if touch:
            bad &= (high != OBJECT) | (low == ARM_PART)
        return bad & ~((high == OBJECT) & (low == SURROUNDINGS))


def arm_addresses(model: mujoco.MjModel, robot: Robot) -> Int[np.ndarray, " n_arm"]:
    """Addresses in qpos of the arm's joints in a scene."""
    return np.array([model.jnt_qposadr[model.joint(ARM + name).id] for name in robot.arm_joints])


def part_of(model: mujoco.MjModel, geom: int) -> int:
    """Which part of the scene a geom is of."""
    return _part(model.body(int(model.geom_bodyid[geom])).name)


def _part(body: str) -> int:
    if body.startswith(ARM):
        return ARM_PART
    return HAND_PART if body.startswith(PREFIX) else OBJECT if body == "target" else SURROUNDINGS


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
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
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
