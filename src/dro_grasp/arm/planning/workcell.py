"""A robot and what stands around it: its MuJoCo models, each compiled once, and which configurations collide."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property, lru_cache

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from dro_grasp.arm.robots.robot import Robot, Table
from dro_grasp.errors import PlanError, RobotError
from dro_grasp.geometry.cache import content_hash
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.geometry.table_plane import moved_plane
from dro_grasp.hands.description.compiling import collide
from dro_grasp.objects.scenery import Scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.optimize.grasp_energy import PRESSED
from dro_grasp.simulation.protocols import PROTOCOLS, Protocol
from dro_grasp.simulation.scene import HULL_VERTICES, MEMORY, PREFIX, attach, hand_spec, joint_addresses, let_touch

ARM = "arm/"  # Prefix of the arm's names
WORLD = "world"  # MuJoCo's name of the body that the table is of
TABLE = "table"  # Name of the table
TARGET = "target"  # Name of the object that is grasped
OBSTACLE = "obstacle"  # What obstacles are called in contacts
VOXEL = 0.01  # Edge of the cells that a cloud of obstacles fills [m] (ours)
BEYOND = 1e-4  # How far a joint may be beyond its limit [rad or m] (ours): drivers round more
CLEARANCE = 0.005  # Distance that the robot keeps from everything else while it travels [m] (ours)
SINK = 0.002
"""How much deeper than at the start a carried object may be in what it stood on or against [m]; clouds are not exact (ours)."""
CARRIED = 0.01
"""Distance that a carried object keeps from all but the hand [m] (ours): it shifts in the hand, and clouds are not exact."""
SAMPLES = 100  # Random configurations in which links that always collide are looked for (ours)
ALWAYS = 0.95  # Share of these in which they collide (ours)


class Part(IntEnum):
    """What a geom is of: the arm, the hand, table and obstacles, or the object that is grasped."""

    ARM, HAND, SURROUNDINGS, OBJECT = range(4)


BITS = {Part.ARM: (1, 15), Part.HAND: (2, 13), Part.SURROUNDINGS: (4, 11), Part.OBJECT: (8, 7)}
"""MuJoCo's contype and conaffinity by part: only the arm collides with itself. Fingers that meet are the grasp's affair."""


@dataclass(frozen=True)
class Contact:
    """Two bodies that are too close."""

    first: str
    second: str
    distance: float  # Negative where they penetrate [m]

    @property
    def depth(self) -> str:
        """In words."""
        return f"by {-1e3 * self.distance:.1f} mm" if self.distance < 0 else (
            f"{1e3 * self.distance:.1f} mm apart, where {1e3 * CLEARANCE:g} mm are kept")


ELSEWHERE = {"at home": "give another `home`", "at the start": "begin elsewhere (start=...)"}
"""What to do where something touches the robot as it begins."""


class Workcell:
    """A robot, its table, obstacles, and the object that it grasps.

    Each model is compiled when it is first asked for, and once; all cells of a robot share that of the arm alone, and what is
    known of links that always touch.
    """

    def __init__(
        self, robot: Robot, obstacles: Sequence[ObjectModel] = (), target: ObjectModel | None = None,
        T_world_target: Float[np.ndarray, "4 4"] | None = None,
    ) -> None:
        """Note what is there, and where the object stands [m]; its frame is the world's by default, as that of obstacles.

        A cloud counts as small boxes if it is an obstacle, and as its convex hull if it is the object.
        """
        self.robot, self.obstacles, self.target = robot, tuple(obstacles), target
        self.T_world_target = np.eye(4) if T_world_target is None else T_world_target
        self._standing = _free_pose(self.T_world_target)

    @property
    def arm(self) -> mujoco.MjModel:
        """The arm alone, with a site `wrist` at the frame that inverse kinematics aims with."""
        return _arm_model(_Key.of(self.robot))

    @cached_property
    def excluded(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies that are not checked: links that always touch, or that no joint moves off the table."""
        on_table = ((link, WORLD) for link in _fixed_to_table(self.robot))
        return tuple(sorted([*_constant_contacts(_Key.of(self.robot)), *on_table]))

    def compiled(self, scene: mujoco.MjSpec) -> mujoco.MjModel:
        """The model of a scene that began as `robot_spec`, without the contacts that are excluded."""
        for first, second in self.excluded:
            scene.add_exclude(bodyname1=first, bodyname2=second)
        return scene.compile()

    @cached_property
    def model(self) -> mujoco.MjModel:
        """Robot, table, obstacles and object, for collisions."""
        scene = robot_spec(self.robot, PROTOCOLS["dro"], self.robot.table)
        if self.obstacles:
            add_solids(scene, scene.worldbody.add_body(name=OBSTACLE), self.obstacles)
        if self.target is not None:
            body = scene.worldbody.add_body(name=TARGET)
            body.add_freejoint(name=TARGET)  # MuJoCo lets no fixed body collide with another
            add_solids(scene, body, [self.target], hull=True)
        _set_bits(scene)
        return self.compiled(scene)

    @cached_property
    def data(self) -> mujoco.MjData:
        """The configuration that was checked last."""
        return mujoco.MjData(self.model)

    def refuse_contacts(self, start: Float[np.ndarray, " n_arm"], where: str = "at home") -> None:
        """Refuse to start where something touches the robot; `where` says so in words.

        Raises:
            PlanError: The object or an obstacle touches it.
            RobotError: The table, or another link, does.
        """
        met = self.contacts(start, self.robot.open_hand, CLEARANCE)
        for contact in sorted(met, key=lambda contact: contact.distance)[:1]:
            link, other = sorted((contact.first, contact.second), key=lambda name: name in (TARGET, OBSTACLE, TABLE))
            if other == TARGET and self.target is not None:
                raise PlanError(f"object '{self.target.name}' collides with {link} while the robot is {where}; give its place "
                                f"in the robot's world frame, or {ELSEWHERE[where]}")
            if other == OBSTACLE:
                pairs, distance = self._detect(start, self.robot.open_hand, None)
                bad = pairs[self._bad(pairs, distance, CLEARANCE, False, False)].ravel().tolist()
                numbers = sorted({_number(self.model.geom(geom).name) for geom in bad if self._name(geom) == OBSTACLE})
                names = ", ".join(f"'{self.obstacles[number].name}'" for number in numbers)
                raise PlanError(f"obstacle {names} collides with {link} while the robot is {where}, "
                                f"{contact.depth}; cut the robot out of that cloud or mesh, correct its place in the robot's "
                                f"world frame, or {ELSEWHERE[where]}")
            raise RobotError(f"robot '{self.robot.name}' collides {where}: {link} and {other}, {contact.depth}; correct "
                             "`table` in the robot file, the camera's pose if the table was found in a cloud, or "
                             f"{ELSEWHERE[where]}")

    def contacts(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], clearance: float = 0.0,
        moved: Float[np.ndarray, "4 4"] | None = None, touch: bool = False, kept: float | None = None, aimed: bool = False,
    ) -> list[Contact]:
        """What collides.

        Args:
            clearance: Distance below which robot and surroundings count as colliding [m], at most CLEARANCE.
            moved: Motion of the object from where it stands, in the world, if the hand carries it or has put it down.
            touch: The hand may touch the object.
            kept: Distance that the moved object keeps from table and obstacles [m], at most CARRIED and negative where it may
                stand in them; by default as where it stood, and SINK less.
            aimed: The hand's joints are where it is told to squeeze to: it may be PRESSED deep in the table, which stops it.
        """
        pairs, distance = self._detect(arm, hand, moved)
        bad = self._bad(pairs, distance, clearance, moved is not None, touch, kept, aimed)
        return [Contact(self._name(a), self._name(b), d)
                for (a, b), d in zip(pairs[bad].tolist(), distance[bad].tolist(), strict=True)]

    def free(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], clearance: float = CLEARANCE,
        moved: Float[np.ndarray, "4 4"] | None = None, touch: bool = False, kept: float | None = None, aimed: bool = False,
    ) -> bool:
        """Whether nothing collides, within the limits of the arm's joints; arguments as for `contacts`."""
        lower, upper = self.robot.lower - BEYOND, self.robot.upper + BEYOND
        if not ((arm >= lower) & (arm <= upper)).all():
            return False
        return not self._bad(*self._detect(arm, hand, moved), clearance, moved is not None, touch, kept, aimed).any()

    def beside(self, moved: Float[np.ndarray, "4 4"] | None = None) -> list[tuple[float, str]]:
        """Signed distances of the object, here or moved, to table and obstacles near it, with their names [m]."""
        pairs, distance = self._detect(self.robot.home, self.robot.open_hand, moved)
        rows = (np.sort(self._part[pairs], axis=1).reshape(-1, 2) == (Part.SURROUNDINGS, Part.OBJECT)).all(1)
        met = [next(geom for geom in pair if self._part[geom] == Part.SURROUNDINGS) for pair in pairs[rows].tolist()]
        return list(zip(distance[rows].tolist(), map(self._thing, met), strict=True))

    def _thing(self, geom: int) -> str:
        """What a geom of the surroundings is called in errors."""
        name = self.model.geom(geom).name
        return f"'{self.obstacles[_number(name)].name}'" if self._name(geom) == OBSTACLE else "the table"

    def _name(self, geom: int) -> str:
        body = int(self.model.geom_bodyid[geom])
        return self.model.body(body).name if body else self.model.geom(geom).name

    def _detect(
        self, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], moved: Float[np.ndarray, "4 4"] | None
    ) -> tuple[Int[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        model, data = self.model, self.data
        self._joints.set(data, arm, hand)
        if self.target is not None:
            start = int(model.jnt_qposadr[model.joint(TARGET).id])
            data.qpos[start:start + 7] = self._standing if moved is None else _free_pose(moved @ self.T_world_target)
        collide(model, data)
        return data.contact.geom.copy(), data.contact.dist.copy()

    def _bad(
        self, pairs: Int[np.ndarray, "k 2"], distance: Float[np.ndarray, " k"], clearance: float, moved: bool, touch: bool,
        kept: float | None = None, aimed: bool = False,
    ) -> Bool[np.ndarray, " k"]:
        low, high = np.sort(self._part[pairs], axis=1).reshape(-1, 2).T
        bad = distance < np.where(high <= Part.HAND, 0.0, clearance)
        if touch:
            bad &= (high != Part.OBJECT) | (low != Part.HAND)
        if aimed and self.robot.table is not None:
            stops = (low == Part.HAND) & (high == Part.SURROUNDINGS) & (pairs == self.model.geom(TABLE).id).any(1)
            bad &= ~stops | (distance < -PRESSED)
        beside = (high == Part.OBJECT) & (low == Part.SURROUNDINGS)
        return np.where(beside, moved & (distance < (self.resting - SINK if kept is None else kept)), bad)

    @cached_property
    def _joints(self) -> RobotJoints:
        return RobotJoints(self.model, self.robot)

    @cached_property
    def _part(self) -> Int[np.ndarray, " n_geom"]:
        """Which part of the scene each geom is of."""
        return np.array([_part(self.model.body(int(body)).name) for body in self.model.geom_bodyid])

    @cached_property
    def resting(self) -> float:
        """Signed distance of the object, where it stands, to the nearest of table and obstacles, at most zero [m]."""
        return min([0.0, *(distance for distance, _ in self.beside())])


class RobotJoints:
    """Where a model has the joints of a robot."""

    def __init__(self, model: mujoco.MjModel, robot: Robot) -> None:
        """Look them up by name."""
        self.arm, (self._hand, moving), tree = arm_addresses(model, robot), joint_addresses(model, robot.hand), robot.hand.tree
        self._coupling, self._offset = (t.double().numpy()[moving] for t in (tree.coupling, tree.offset))

    def set(self, data: mujoco.MjData, arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"]) -> None:
        """Write a configuration [rad or m]; what follows from it is not computed yet."""
        data.qpos[self.arm] = arm
        data.qpos[self._hand] = self._coupling @ hand + self._offset


@dataclass(frozen=True)
class _Key:
    """A robot without its table and camera; equal keys have the same models."""

    sha256: str
    robot: Robot = field(compare=False)

    @staticmethod
    def of(robot: Robot) -> _Key:
        return _Key(replace(robot, table=None, camera=None).sha256, robot)


@lru_cache(maxsize=4)
def _arm_model(key: _Key) -> mujoco.MjModel:
    robot, scene = key.robot, mujoco.MjSpec()
    attach(scene, robot.arm.spec(), placed_frame(scene.worldbody, robot.T_world_base), ARM)
    frame = robot.T_link_wrist @ robot.T_wrist_aim
    scene.body(ARM + robot.mount_link).add_site(name="wrist", pos=frame[:3, 3], quat=wxyz(frame[:3, :3]))
    model = scene.compile()
    joints = [model.joint(ARM + name).id for name in robot.arm_joints]
    model.jnt_range[joints] = np.stack(robot.working_range, 1)
    model.jnt_limited[joints] = 1
    return model


@lru_cache(maxsize=4)
def _constant_contacts(key: _Key) -> tuple[tuple[str, str], ...]:
    """Links that collide at home with the open hand or nearly everywhere, and fixed neighbours."""
    robot, scene = key.robot, robot_spec(key.robot, PROTOCOLS["dro"], None)
    _set_bits(scene, fingers=True)
    model = scene.compile()
    data, joints, opened = mujoco.MjData(model), RobotJoints(model, robot), robot.open_hand
    count: Counter[tuple[str, ...]] = Counter()
    for i, q in enumerate(_draws(robot)):
        joints.set(data, q, opened)
        collide(model, data)
        touching = model.geom_bodyid[data.contact.geom[data.contact.dist < 0]].reshape(-1, 2).tolist()
        count.update(dict.fromkeys({_names(model, *pair) for pair in touching}, 1 if i else SAMPLES))
    found = {pair for pair, n in count.items() if n >= ALWAYS * SAMPLES}
    # MuJoCo's own filter ignores neighbours of a fixed parent, and looks past fixed links.
    found |= {_names(model, body, int(above)) for body, above in enumerate(model.body_parentid) if above}
    return tuple(sorted((first, second) for first, second in found if first != second))


def _names(model: mujoco.MjModel, *bodies: int) -> tuple[str, ...]:
    return tuple(sorted(model.body(body).name for body in bodies))


def _draws(robot: Robot) -> list[Float[np.ndarray, " n_arm"]]:
    """Home, and random configurations of the arm [rad or m]."""
    return [robot.home, *np.random.default_rng(0).uniform(robot.lower, robot.upper, (SAMPLES, len(robot.home)))]


def _fixed_to_table(robot: Robot) -> list[str]:
    """Bodies of the arm that touch its table, at a height and tilt that no joint changes: a foot that turns on it."""
    if (table := robot.table) is None:
        return []
    poses = robot.T_world_base @ robot.arm.tree.double.forward(torch.from_numpy(np.stack(_draws(robot)))).numpy()
    level = (np.ptp(poses[:, :, 2], axis=0).max(-1) < 1e-6) & robot.arm.tree.moves.any(-1).numpy()
    found = set()
    for shape in robot.arm.geometry:
        if shape.collides and level[shape.link]:
            T = poses[:, shape.link]
            points = np.einsum("dij,nj->dni", T[:, :3, :3], shape.vertices) + T[:, None, :3, 3]
            on = (np.abs(points[..., :2] - table.centre) < np.array(table.size) / 2).all(-1) & (
                points[..., 2] < table.height + CLEARANCE)
            if on.any(-1).mean() >= ALWAYS:
                found.add(ARM + robot.arm.tree.link_names[shape.link])
    return sorted(found)


def _number(geom: str) -> int:
    """The number of the obstacle that a geom is of, by its name."""
    return int(geom.split("solid")[1].split(".")[0])


def _part(body: str) -> Part:
    if body.startswith(ARM):
        return Part.ARM
    return Part.HAND if body.startswith(PREFIX) else Part.OBJECT if body == TARGET else Part.SURROUNDINGS


def _set_bits(scene: mujoco.MjSpec, fingers: bool = False) -> None:
    """Say what collides with what; with `fingers` a hand with itself, too."""
    for geom in scene.geoms:
        if not geom.contype and not geom.conaffinity:
            continue
        part = _part(geom.parent.name if geom.parent is not None else "")
        geom.contype, geom.conaffinity = BITS[part]
        if fingers:
            geom.conaffinity |= geom.contype
        geom.margin = {Part.SURROUNDINGS: 0.0, Part.OBJECT: CARRIED}.get(part, CLEARANCE)


def robot_spec(robot: Robot, protocol: Protocol, table: Table | None) -> mujoco.MjSpec:
    """Arm, hand and table; nothing drives them yet."""
    scene = mujoco.MjSpec()
    scene.memory = MEMORY
    option = scene.option
    option.timestep, option.impratio, option.noslip_iterations = protocol.timestep, protocol.impratio, protocol.noslip
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # the sparse Newton solver of MuJoCo 4.0.0 can be wrong
    arm = robot.arm.spec()
    for mesh in arm.meshes:
        mesh.maxhullvert = HULL_VERTICES
    for geom in arm.geoms:
        let_touch(geom)
    attach(scene, arm, placed_frame(scene.worldbody, robot.T_world_base), ARM)
    attach(scene, hand_spec(robot.hand, protocol), placed_frame(scene.body(ARM + robot.mount_link), robot.T_link_wrist))
    if table is not None:
        half = [table.size[0] / 2, table.size[1] / 2, 0.025]  # [m]: a board of 5 cm (ours)
        scene.worldbody.add_geom(
            name=TABLE, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=[0.82, 0.80, 0.76, 1],
            pos=[*table.centre, table.height - half[2]], friction=[protocol.friction, 0.005, 1e-4])
    return scene


def arm_addresses(model: mujoco.MjModel, robot: Robot) -> Int[np.ndarray, " n_arm"]:
    """Addresses in qpos of the arm's joints in a scene."""
    return np.array([model.jnt_qposadr[model.joint(ARM + name).id] for name in robot.arm_joints])


def placed_frame(body: mujoco.MjsBody, T: Float[np.ndarray, "4 4"]) -> mujoco.MjsFrame:
    """A frame of a body at a pose [m]."""
    return body.add_frame(pos=T[:3, 3], quat=wxyz(T[:3, :3]))


def wxyz(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Unit quaternion WXYZ of a rotation."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.asarray(R, np.float64).ravel())
    return quaternion / np.linalg.norm(quaternion)


def add_solids(scene: mujoco.MjSpec, body: mujoco.MjsBody, things: Sequence[ObjectModel], hull: bool = False) -> None:
    """Shapes of things in a body's frame: convex parts of meshes; of clouds, small boxes, or with `hull` the convex hull.

    Geoms are named by the number of the thing.
    """
    for i, thing in enumerate(things):
        if thing.is_cloud and not hull:
            for j, (centre, half) in enumerate(zip(*occupied(thing.cloud.astype(np.float64)), strict=True)):
                body.add_geom(name=f"{body.name}-solid{i}.{j}", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=centre)
            continue
        corners = [thing.cloud] if thing.is_cloud else [vertices for vertices, _ in thing.parts]
        for j, vertices in enumerate(corners):
            mesh = scene.add_mesh(name=f"{body.name}-solid{i}.{j}", uservert=np.asarray(vertices, np.float64).ravel())
            mesh.maxhullvert = HULL_VERTICES
            body.add_geom(name=mesh.name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)


def occupied(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Centres and half edges [m] of boxes that together are the cells of size VOXEL that hold a point."""
    low = np.floor(points[one_per_cell(points, VOXEL)] / VOXEL).astype(int)
    high = low + 1
    for axis in (2, 1, 0):  # boxes next to each other along an axis, and alike in the others, become one
        alike = np.delete(np.concatenate([low, high], 1), (axis, axis + 3), axis=1)
        order = np.lexsort((low[:, axis], *alike.T))
        low, high, alike = low[order], high[order], alike[order]
        apart = (alike[1:] != alike[:-1]).any(1) | (low[1:, axis] != high[:-1, axis])
        first = np.flatnonzero(np.r_[True, apart])
        last = np.r_[first[1:], len(low)] - 1
        low, high = low[first], np.where(np.arange(3) == axis, high[last], high[first])
    return (low + high) * (VOXEL / 2), (high - low) * (VOXEL / 2)


def _free_pose(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "7"]:
    """A pose as a free joint has it: place [m] and quaternion WXYZ."""
    return np.concatenate([T[:3, 3], wxyz(T[:3, :3])])


def scene_solid(scene: Scene, centre: Float[np.ndarray, "3"], reach: float) -> list[ObjectModel]:
    """What of a scene in the world is within `reach` [m] of the robot's base, each part as one thing; nothing if none is."""
    return [solid for part in scene.parts for solid in _solid(part, centre, reach)]


def _solid(scene: Scene, centre: Float[np.ndarray, "3"], reach: float) -> list[ObjectModel]:
    points = scene.points
    if scene.faces is not None:
        mesh = trimesh.Trimesh(scene.points, scene.faces, process=False)
        # With 16 points on each square of edge VOXEL one cell in ten million stays empty.
        count = min(5_000_000, int(16 * mesh.area / VOXEL**2) + 16)
        points = np.concatenate([points[scene.faces].reshape(-1, 3), trimesh.sample.sample_surface(mesh, count, seed=0)[0]])
    points = points[np.linalg.norm(points - centre, axis=1) < reach]
    if not len(points):
        return []
    cloud = points[one_per_cell(points, VOXEL / 2)].astype(np.float32)
    return [ObjectModel(scene.name, cloud, np.zeros_like(cloud), cloud.mean(0, dtype=np.float64), content_hash(cloud))]


def upright(obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"]) -> tuple[ObjectModel, Float[np.ndarray, "4 4"]]:
    """The same object in the same place, with a frame whose z axis points up."""
    if np.abs(T_world_object[2, :3] - (0, 0, 1)).max() < 1e-6:
        return obj, T_world_object
    turn, stand = np.eye(4), np.eye(4)
    turn[:3, :3], stand[:3, 3] = T_world_object[:3, :3], T_world_object[:3, 3]
    return moved(obj, turn), stand


def moved(obj: ObjectModel, T: Float[np.ndarray, "4 4"]) -> ObjectModel:
    """The same object, with coordinates in another frame."""
    R, t = T[:3, :3], T[:3, 3]
    cloud, normals = (obj.cloud @ R.T + t).astype(np.float32), (obj.cloud_normals @ R.T).astype(np.float32)
    vertices = None if obj.vertices is None else obj.vertices @ R.T + t
    faces = np.zeros((0, 3), np.int32) if obj.faces is None else obj.faces
    shape = cloud if vertices is None else vertices
    table = None if obj.table is None else moved_plane(obj.table, T)
    seen = None if obj.seen is None else (obj.seen @ R.T + t).astype(np.float32)
    return replace(
        obj, cloud=cloud, cloud_normals=normals, vertices=vertices, centre_of_mass=R @ obj.centre_of_mass + t,
        inertia=R @ obj.inertia @ R.T, sha256=content_hash(shape.astype(np.float32), faces.astype(np.int32)),
        seen=seen, table=table, balls=None, exact_parts=None if obj.is_cloud else tuple((v @ R.T + t, f) for v, f in obj.parts))
