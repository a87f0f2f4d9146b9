"""The experiment: attempts to lift objects, each from the depth image to the shaken object; stored as they come, with rates.

In one attempt an object comes to rest on the table, is seen, planned for, grasped, lifted, then held and shaken, or placed.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from dro_grasp.arm.motion import PLACING, STAGES, MotionPlan
from dro_grasp.arm.physics import SHAPE_GROUP, TICK, Deviation, LiftScene, object_name
from dro_grasp.arm.placing import AWAY, foot, off_table
from dro_grasp.arm.planner import PlanConfig, plan
from dro_grasp.arm.reachability import ReachConfig
from dro_grasp.arm.robot import CameraMount, Robot, Table, load_robot
from dro_grasp.arm.table_scene import PickedObject, pick_object
from dro_grasp.arm.workcell import ARM, Workcell, moved
from dro_grasp.devices import one_thread
from dro_grasp.errors import DroGraspError, GraspFileError, OptionError
from dro_grasp.extras import require_extra
from dro_grasp.files import check_output, make_folder, reading, replacing
from dro_grasp.geometry.se3 import random_rotations
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.hold import HoldCheck
from dro_grasp.kinds import Checked, checked
from dro_grasp.network.checkpoints import DEFAULT, describe_weights
from dro_grasp.objects.builtin.usual import OBJECTS
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.depth_noise import DepthView, NoiseName, depth_noise, measured_depth
from dro_grasp.objects.perception.scan import depth_points
from dro_grasp.objects.shape import ObjectModel, check_mass, with_mass
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.simulation.scene import PREFIX

LABEL = "tabletop/3 "
"""Beginning of the settings of stored attempts; the number goes up with every change that can change an outcome."""
APART = 0.03  # Distance between the outlines of objects as they are put down [m] (ours)
PLACED_WITHIN = 0.02  # Largest distance from its place of an object that is placed [m]. Source: the project's aim (ours)
PLACED_UPRIGHT = 15.0  # Largest tilt of it [degrees], likewise
FELL = 45.0  # Tilt from which on it is said to have fallen over [degrees] (ours)
SETTLE_SECONDS = 1.0  # How long an object is left to itself before its place is measured [s] (ours)
REFLECTANCES = (0.1, 0.9)  # Shares of the light that things return, the table among them [1] (ours)
STRIDE = 2  # Every so many pixels, in both directions, one ray is cast (ours)

Region = tuple[float, float, float, float]  # Least x and y, greatest x and y, from the arm's base [m]


@dataclass(frozen=True)
class TabletopConfig(Checked):
    """How an attempt runs. Values without a source are ours."""

    see: Literal["cloud", "mesh"] = "cloud"
    """What the planner is given: the cloud of the robot's camera, or, as a control, the true mesh at its true place."""
    noise: float | NoiseName = "stereo"
    """Noise of the camera's depth: that of a kind of camera, or a standard deviation alike for all pixels [m]."""
    region: Region = (0.38, -0.18, 0.58, 0.18)
    """Area where objects are put: least x and y, greatest x and y, from the arm's base [m]."""
    clutter: int = 0
    """Number of other built-in objects that stand around the one to grasp."""
    segment: Literal["cluster", "mask"] = "cluster"
    """How its points are separated from others: by distance from a place near its middle, or by the true mask."""
    hold_seconds: float = 3.0
    """How long the object is held [s]."""
    shake_seconds: float = 2.0
    """How long it is then shaken [s]."""
    plan: PlanConfig = field(default_factory=PlanConfig)
    """How motions are planned."""
    mass: float | None = None
    """Mass of the object to grasp, which the planner knows [kg]; None for density times volume."""
    place: bool = False
    """Whether the object is put down at a random free place of the region, instead of held and shaken."""

    def __post_init__(self) -> None:
        """Refuse what cannot be set up.

        Raises:
            ObjectError: The mass is not above 0, or larger than any hand holds.
            OptionError: Too many other objects, or fewer than none, noise that is none, a region that is none, or constraints
                on places.
        """
        super().__post_init__()
        wanted = self.plan.constraints
        if wanted.obstacles is not None or wanted.contact_region or wanted.keep_out:
            raise OptionError("objects of attempts come to rest anywhere, so that obstacles, contact_region and keep_out say "
                              "nothing there; leave them out, or use dro_grasp.plan for one object in its place")
        depth_noise(self.noise)
        x, y, far_x, far_y = self.region
        if not (-math.inf < x < far_x < math.inf and -math.inf < y < far_y < math.inf):
            raise OptionError(f"region is {self.region}; give two corners, the lower one first: X0 Y0 X1 Y1 in metres")
        if self.mass is not None:
            check_mass(self.mass)
        if not 0 <= self.clutter <= 8:  # there is no room for more
            raise OptionError(f"clutter is {self.clutter}; give a number of other objects from 0 to 8")

    def label(self) -> str:
        """Version and every setting, as stored with results: results of other settings are not mixed."""
        # What is not asked for is left out: attempts of before it could be are not repeated.
        given = {name: value for name, value in asdict(self).items() if (name, value) not in (("mass", None), ("place", False))}
        return LABEL + json.dumps(given, sort_keys=True)

    @staticmethod
    def from_label(label: str) -> TabletopConfig:
        """The settings that a label states.

        Raises:
            OptionError: They are of another version.
        """
        def with_tuples(values: dict[str, Any]) -> dict[str, Any]:
            return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}

        try:
            values = json.loads(label.removeprefix(LABEL), object_hook=with_tuples)
            plan = values.pop("plan")
            plan["reach"], plan["constraints"] = ReachConfig(**plan["reach"]), Constraints(**plan["constraints"])
            plan["deviations"] = tuple(Deviation(**deviation) for deviation in plan["deviations"])
            return TabletopConfig(**values, plan=PlanConfig(**plan))
        except (ValueError, TypeError, KeyError) as error:
            raise OptionError(f"the attempt was made by another version of dro-grasp ({label.split(' ')[0]}), and cannot be "
                              "repeated; run `dro-grasp tabletop` again") from error


@dataclass(frozen=True)
class Attempt:
    """What became of one attempt; plain values."""

    robot: str
    object: str
    number: int
    """Number of the attempt with this object, from 0."""
    seed: int
    """Seed of all draws."""
    settings: str
    """Version and every setting, as `TabletopConfig.label`."""
    success: bool = False
    """Whether the object was held to the end, or stands at its place."""
    stage: str = "see"
    """Where it ended: see, plan, one of the motion's stages, hold, shake, place, or done."""
    reason: str = ""
    """Why it failed."""
    place: str = "[]"
    """JSON: the object's pose at rest in the world [m]."""
    raised: float = 0.0
    """How much higher the object was at the end than at rest [m]."""
    score: float = float("nan")
    """Score of the grasp [log-odds of holding]."""
    grasps: int = 0
    """Grasps to choose from."""
    dropped: str = "{}"
    """JSON: how many were dropped, by reason."""
    see_seconds: float = 0.0
    """From the depth image to the object's cloud [s]."""
    plan_seconds: float = 0.0
    """From the cloud to the timed plan [s]."""
    grasp_seconds: float = 0.0
    """Part of `plan_seconds` for proposing and refining grasps [s]."""
    processor_seconds: float = 0.0
    """Time of one core from the depth image to the timed plan [s]; the other times are by the clock."""
    motion_seconds: float = 0.0
    """Duration of the planned motion [s]."""
    place_error: float | None = None
    """Distance of the placed object's centre of mass from where it should be [m]; None if it was not placed."""
    place_tilt: float | None = None
    """Angle between the placed object's upright and the one it had [degrees], likewise."""
    place_turn: float | None = None
    """How far it is turned about the vertical from what was planned [degrees], likewise."""
    pushed: float = 0.0
    """Largest displacement of another object [m]."""
    robot_file: str = ""
    """Name or file that the robot was loaded from."""
    object_file: str = ""
    """Name or file that the object was loaded from."""
    weights: str = ""
    """Name or file of the weights."""
    robot_sha256: str = ""
    """Hash of the robot with its arm and hand. All four hashes are empty where attempts are made one by one."""
    object_sha256: str = ""
    """Hash of the mesh."""
    weights_sha256: str = ""
    """Hash of the weights file."""
    solid_sha256: str = ""
    """Hash of what was simulated of the object. The same mesh may be cut into other convex parts."""


class Watcher:
    """Is told what happens in an attempt; does nothing with it by itself."""

    def planned(self, seen: PickedObject, made: MotionPlan) -> None:
        """There is a plan for what was seen."""

    def moved(self, scene: LiftScene) -> None:
        """Time has passed; called at least fifty times a second of simulated time."""

    def looked(self, points: Float[np.ndarray, "n 3"]) -> None:
        """A camera has seen these points, in its frame [m]; only told where a table is cleared, as the next one."""

    def judged(self, check: HoldCheck, held: bool | None = None) -> None:
        """The joints were asked whether the hand holds something; whether it really does, where that is known."""


def attempt(
    robot: Robot, obj: ObjectModel, number: int, seed: int, predictor: GraspPredictor, config: TabletopConfig | None = None,
    watch: Watcher | None = None, proposer: Callable[[PickedObject, Float[np.ndarray, "4 4"], int], GraspBatch] | None = None,
) -> Attempt:
    """Run one attempt from beginning to end; each number draws another place of the object.

    Args:
        proposer: Makes complete grasps with scores, in the world, of what was seen, the pose of its frame and a seed, instead
            of the predictor.

    Raises:
        OptionError: The robot lacks a table or a camera, or the object is a bare cloud.
    """
    config = config or TabletopConfig()
    _check(robot, obj, config)
    obj = obj if config.mass is None else with_mass(obj, config.mass)
    others = other_objects(obj.name, config.clutter, np.random.default_rng([seed, number, 1]))
    scene = LiftScene(Workcell(robot), [obj, *others])
    result = Attempt(robot.name, obj.name, number, seed, config.label())
    draw = np.random.default_rng([seed, number])
    if not scatter(scene, config.region, draw):
        return replace(result, stage="see", reason="an object rolls off the region wherever it is put")
    start, *beside = (scene.pose(i) for i in range(len(scene.objects)))
    result = replace(result, place=json.dumps(start.round(6).tolist()))
    begin, processor = time.perf_counter(), time.process_time()
    try:
        seen, T = _see(scene, config, int(draw.integers(2**31)))
        see_seconds = time.perf_counter() - begin
        result, begin = replace(result, stage="plan", see_seconds=see_seconds), time.perf_counter()
        grasps = None if proposer is None else proposer(seen, T, seed + number)
        place = draw_place(scene, seen, config.region, np.random.default_rng([seed, number, 2])) if config.place else None
        made = plan(seen.robot, seen.obj, T, seen.obstacles, predictor, config.plan, seed + number, grasps, place=place)
    except DroGraspError as error:
        return replace(result, reason=str(error))
    notes = made.notes
    result = replace(
        result, processor_seconds=time.process_time() - processor, plan_seconds=time.perf_counter() - begin,
        grasp_seconds=notes.seconds["grasps"], score=notes.score, grasps=notes.grasps, dropped=json.dumps(notes.dropped),
        motion_seconds=made.seconds)
    if watch is not None:
        watch.planned(seen, made)
    stage, reason = carry_out(scene, made, config, watch)
    if config.place and not reason:
        result = measured(result, scene, start, made)
        stage, reason = place_fault(result.place_error or 0.0, result.place_tilt or 0.0)
    raised = float(scene.pose(0)[2, 3] - start[2, 3])
    pushed = max((_apart(scene.pose(i), T) for i, T in enumerate(beside, 1)), default=0.0)
    return replace(result, stage=stage, reason=reason, success=not reason, raised=raised, pushed=pushed)


def carry_out(scene: LiftScene, made: MotionPlan, config: TabletopConfig, watch: Watcher | None = None) -> tuple[str, str]:
    """Let the servos follow a plan, then hold and shake, or put down; where it ended, and why if it failed."""
    start = scene.pose(0)
    call = None if watch is None else lambda: watch.moved(scene)
    for stage in STAGES:
        _follow(scene, made, stage, call)
        if stage == "approach" and (moved := _apart(scene.pose(0), start)) > 0.03:  # [m] (ours)
            return stage, f"the hand pushed the object by {100 * moved:.1f} cm before it closed"
    lifted = float(scene.pose(0)[2, 3] - start[2, 3])
    if lifted < config.plan.reach.within(scene.robot).lift / 2:
        return "lift", "the object stayed on the table" if lifted < 0.02 else "the object fell during the lift"
    if made.notes.place is not None:
        return _put_down(scene, made, call)
    grip = scene.in_hand(0)
    arm, hand = made.arm.position[-1], made.hand.position[-1]
    for stage, seconds in (("hold", config.hold_seconds), ("shake", config.shake_seconds)):
        for k in range(round(seconds / TICK)):
            target, velocity = arm.copy(), np.zeros_like(arm)
            if stage == "shake":  # the arm's first joint, at 1.5 Hz: 2 cm at half a metre, 1.8 m/s^2 (ours)
                phase, angle = 2 * np.pi * 1.5, 0.04
                target[0] += angle * np.sin(phase * TICK * k)
                velocity[0] = angle * phase * np.cos(phase * TICK * k)
            scene.command(target, velocity, hand)
            scene.advance(TICK, call)
        if (slipped := _slipped(scene, grip)):
            return stage, slipped
    return "done", ""


def _follow(scene: LiftScene, made: MotionPlan, stage: str, call: Callable[[], None] | None) -> None:
    """Let the servos follow one stage of a plan."""
    rows = made.part(stage)
    for i in range(rows.start + 1, rows.stop):
        scene.command(made.arm.position[i], made.arm.velocity[i], made.hand.position[i])
        scene.advance(float(made.arm.time[i] - made.arm.time[i - 1]), call)


def _slipped(scene: LiftScene, grip: Float[np.ndarray, "4 4"]) -> str:
    """How far the object has moved in the hand since it was held there, if that is too far."""
    slip = _apart(scene.in_hand(0), grip)
    lost = slip > 0.05 or not scene.touched(0)  # [m] (ours)
    return f"the object slipped by {100 * slip:.0f} cm out of the hand" if lost else ""


def _put_down(scene: LiftScene, made: MotionPlan, call: Callable[[], None] | None) -> tuple[str, str]:
    """Let the servos follow the stages after the lift, and wait; where it ended, and why if it failed."""
    grip = scene.in_hand(0)
    for stage in PLACING:
        _follow(scene, made, stage, call)
        if stage == "carry" and (slipped := _slipped(scene, grip)):
            return stage, slipped
    scene.advance(SETTLE_SECONDS, call)
    return ("retreat", "the hand still touches the object after it has left") if scene.touched(0) else ("done", "")


def measured(result: Attempt, scene: LiftScene, start: Float[np.ndarray, "4 4"], made: MotionPlan) -> Attempt:
    """An attempt with the errors of the placed object, which stood somewhere at the start [m]."""
    wanted, found, centre = np.array(made.notes.place) @ start, scene.pose(0), scene.objects[0].centre_of_mass
    off = (found - wanted)[:3, :3] @ centre + (found - wanted)[:3, 3]
    turn = found[:3, :3] @ wanted[:3, :3].T
    tilt = math.degrees(math.acos(min(1.0, max(-1.0, turn[2, 2]))))
    return replace(
        result, place_error=float(np.linalg.norm(off)), place_tilt=tilt,
        place_turn=math.degrees(math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))


def place_fault(error: float, tilt: float) -> tuple[str, str]:
    """Where an attempt with a place ended, and why if the object does not stand there, so far off [m] and tilted [degrees]."""
    if tilt > FELL:
        return "place", f"the object fell over: it is tilted by {tilt:.0f} degrees"
    if tilt > PLACED_UPRIGHT:
        return "place", f"the object stands tilted by {tilt:.0f} degrees"
    return ("place", f"placed {100 * error:.1f} cm off") if error > PLACED_WITHIN else ("done", "")


def draw_place(
    scene: LiftScene, seen: PickedObject, region: Region, draw: np.random.Generator
) -> tuple[float, float, float]:
    """A random free place in the region, on the table, AWAY from where the object stands; the last one tried if none is."""
    table, obj, base = seen.robot.table, scene.objects[0], scene.robot.T_world_base[:2, 3]
    assert table is not None
    now = scene.pose(0)
    points = obj.cloud @ now[:3, :3].T + now[:3, 3]
    middle = foot(points)
    half = float(np.linalg.norm(points[:, :2] - middle[:2], axis=1).max())
    others = [o.cloud @ T[:3, :3].T + T[:3, 3] for i, o in enumerate(scene.objects[1:], 1) for T in [scene.pose(i)]]
    tree, spot = KDTree(np.concatenate(others)[:, :2]) if others else None, middle[:2]
    for _ in range(1000):
        spot = base + draw.uniform(region[:2], region[2:])
        clear = tree is None or tree.query(spot)[0] > half + APART
        if np.linalg.norm(spot - middle[:2]) > AWAY and clear and off_table(table, np.array([*spot, 0.0])) < -half:
            break
    return float(spot[0]), float(spot[1]), table.height


def other_objects(name: str, count: int, draw: np.random.Generator) -> list[ObjectModel]:
    """Some of the usual built-in objects, without the one that is asked for."""
    return [load_object(str(other)) for other in draw.permutation(sorted(set(OBJECTS) - {name}))[:count]]


def scatter(scene: LiftScene, region: Region, draw: np.random.Generator) -> bool:
    """Put all objects down, the first one in the region and others up to 10 cm around it; False if one never comes to rest."""
    wide = (region[0] - 0.05, region[1] - 0.10, region[2] + 0.10, region[3] + 0.10)
    return all(rest(scene, index, wide if index else region, draw) for index in range(len(scene.objects)))


def rest(scene: LiftScene, index: int, region: Region, draw: np.random.Generator) -> bool:
    """Drop an object in a random orientation at a random place, and wait until it rests there; False if it never does."""
    low, high = np.array(region[:2]), np.array(region[2:])
    table, obj = scene.robot.table or Table(), scene.objects[index]
    assert obj.vertices is not None
    for _ in range(20):  # it is put down anew if it rolls off the region
        generator = torch.Generator().manual_seed(int(draw.integers(2**31)))
        T = np.eye(4)
        T[:3, :3] = random_rotations(1, generator)[0].double().numpy()
        T[:2, 3] = _free_place(scene, index, T, region, draw)
        T[2, 3] = table.height + 0.005 - float((obj.vertices @ T[2, :3]).min())
        scene.place(index, T)
        resting = False
        for _ in range(8):  # half seconds in which it comes to rest
            scene.advance(0.5)
            if resting := scene.speed(index) < 0.002:
                break
        place = scene.pose(index)[:2, 3] - scene.robot.T_world_base[:2, 3]
        if resting and (place > low - 0.05).all() and (place < high + 0.05).all():
            return True
    return False


def _free_place(
    scene: LiftScene, index: int, T: Float[np.ndarray, "4 4"], region: Region, draw: np.random.Generator
) -> Float[np.ndarray, "2"]:
    """Where an object in this orientation stands APART from those before it; the last place that was tried if there is none."""
    base, outline = scene.robot.T_world_base[:2, 3], scene.objects[index].cloud @ T[:2, :3].T
    poses = [scene.pose(i) for i in range(index)]
    others = [obj.cloud @ T[:2, :3].T + T[:2, 3] for obj, T in zip(scene.objects, poses, strict=False)]
    tree, place = KDTree(np.concatenate(others)) if others else None, base
    for _ in range(100):
        place = base + draw.uniform(region[:2], region[2:])
        if tree is None or tree.query(outline + place)[0].min() > APART:
            break
    return place


def thinned_intrinsics(camera: CameraMount) -> Float[np.ndarray, "3 3"]:
    """Those of the images that `depth_image` makes, whose pixels are STRIDE apart [pixels]."""
    return camera.intrinsics / np.array([[STRIDE], [STRIDE], [1.0]])


def depth_image(
    scene: LiftScene, camera: CameraMount, noise: float | str, seed: int
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Depth along the camera's z axis [m], and which pixels show the scene's first object.

    Depth is zero where nothing is near, and where the robot's model covers the view. Objects are seen as their true meshes.
    `noise` is a preset of `depth_noise`, or the standard deviation of depth [m]. Things are dark or bright by chance.
    """
    row, column = np.meshgrid(np.arange(0, camera.height, STRIDE), np.arange(0, camera.width, STRIDE), indexing="ij")
    pixels = np.stack([column, row, np.ones_like(row)], -1).reshape(-1, 3).astype(float)
    rays = np.linalg.solve(camera.intrinsics, pixels.T).T
    length = np.linalg.norm(rays, axis=1)
    world = (rays / length[:, None]) @ camera.T_world_camera[:3, :3].T
    groups = np.array([1, 1, 1, 0, 1, 0], np.uint8)  # true shapes in, convex parts out
    assert groups[SHAPE_GROUP]
    geom, distance, normal = np.full(len(rays), -1, np.int32), np.full(len(rays), -1.0), np.zeros(rays.size)
    eye = camera.T_world_camera[:3, 3].copy()
    mujoco.mj_multiRay(
        scene.model, scene.data, eye, world.ravel().copy(), groups, True, -1, geom, distance, normal, len(rays), 3.0)
    owner = [scene.model.body(int(b)).name for b in scene.model.geom_bodyid]
    robot = np.array([name.startswith((ARM, PREFIX)) for name in owner])
    seen = (geom >= 0) & (distance > 0) & ~robot[np.maximum(geom, 0)]
    first = np.array([name == object_name(0) for name in owner])[np.maximum(geom, 0)] & seen
    light = np.random.default_rng([seed, 1]).uniform(*REFLECTANCES, scene.model.ngeom)[geom]
    view = DepthView(
        np.where(seen, distance / length, 0.0).reshape(row.shape),
        (normal.reshape(-1, 3) @ camera.T_world_camera[:3, :3]).reshape(*row.shape, 3), thinned_intrinsics(camera),
        light.reshape(row.shape))
    return measured_depth(view, depth_noise(noise), seed), first.reshape(row.shape)


def _see(scene: LiftScene, config: TabletopConfig, seed: int) -> tuple[PickedObject, Float[np.ndarray, "4 4"]]:
    """The object as it is known, with other things and the table that was seen; and where its frame is."""
    robot, T, (obj, *others) = scene.robot, scene.pose(0), scene.objects
    if config.see == "mesh":
        return PickedObject(obj, [moved(o, scene.pose(i)) for i, o in enumerate(others, 1)], robot), T
    camera = robot.camera
    assert camera is not None
    depth, mask = depth_image(scene, camera, config.noise, seed)
    x, y = (T[:2, :3] @ obj.cloud.mean(0) + T[:2, 3]).tolist()
    points = depth_points(depth, thinned_intrinsics(camera))
    known = mask[depth > 0] if config.segment == "mask" else None
    seen = pick_object(obj.name, points, robot, camera.T_world_camera, (x, y), known)
    return seen if config.mass is None else replace(seen, obj=with_mass(seen.obj, config.mass)), np.eye(4)


def _apart(first: Float[np.ndarray, "4 4"], second: Float[np.ndarray, "4 4"]) -> float:
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3]))


def _check(robot: Robot, obj: ObjectModel, config: TabletopConfig) -> None:
    if robot.table is None or (config.see == "cloud" and robot.camera is None):
        raise OptionError(f"robot '{robot.name}' has no {'table' if robot.table is None else 'camera'}; state it in the robot "
                          "file: attempts need both")
    if obj.is_cloud:
        raise OptionError(f"object '{obj.name}' is a bare cloud; attempts are simulated, and need a mesh")


@dataclass(frozen=True)
class TabletopRun(Checked):
    """What is attempted."""

    robot: str
    """Name or file."""
    objects: tuple[str, ...]
    """Names or files of meshes."""
    attempts: int = 10
    """Attempts with each object. Source: paper, real-robot experiment."""
    seed: int = 0
    """Seed of all draws."""
    weights: str | None = None
    """Name or file of weights; the shipped ones by default."""
    config: TabletopConfig = field(default_factory=TabletopConfig)
    """How attempts run."""

    def __post_init__(self) -> None:
        """Refuse what cannot be run.

        Raises:
            OptionError: No attempts, or no objects, or a seed that is none.
        """
        super().__post_init__()
        if not 0 <= self.seed < 2**31:
            raise OptionError(f"seed is {self.seed}; give an integer from 0 to 2^31 - 1")
        if self.attempts < 1 or not self.objects:
            raise OptionError(f"{self.attempts} attempts on {len(self.objects)} objects; ask for at least one of each")


@dataclass
class PlanKeeper(Watcher):
    """Stores the plan of an attempt."""

    path: Path

    def planned(self, seen: PickedObject, made: MotionPlan) -> None:
        """Write it."""
        made.save(self.path)


@checked
def run_tabletop(
    run: TabletopRun, output: Path | None = None, workers: int = 1, progress: Callable[[Attempt], None] | None = None,
    plans: Path | None = None, make: Callable[..., Attempt] | None = None,
) -> list[Attempt]:
    """Run all attempts that `output` does not hold yet; each is stored when it ends.

    Args:
        run: What is attempted.
        output: Parquet file; attempts with the same robot, objects, weights, settings and seed in it are not repeated, others
            stay. Files of the same names count as the same only if their contents are.
        workers: Processes, which share out the objects; with several, attempts are stored object by object.
        progress: Called after each attempt.
        plans: Folder for the plan of each attempt, ROBOT-OBJECT-NUMBER.npz.
        make: Makes one, instead of `attempt`, with the same arguments.

    Raises:
        OptionError: The extra is missing, something cannot be attempted, or two objects have one name.
        RobotError: The robot cannot be used.
        ObjectError: An object cannot be used.
        WeightsError: The weights cannot be used.
        GraspFileError: `output` is there and is no such file.
        OutputError: `output` or `plans` cannot be written.
    """
    require_extra("arm")
    stored = read_attempts(output) if output is not None and check_output(output, ".parquet").exists() else []
    done, names = _done(run, stored, output)
    missing = {o: [k for k in range(run.attempts) if (n, k) not in done] for o, n in names.items()}
    if plans is not None:
        make_folder(plans)
    for result in _results(run, {o: numbers for o, numbers in missing.items() if numbers}, workers, plans, make or attempt):
        stored.append(result)
        done[result.object, result.number] = result
        if output is not None:
            write_attempts(stored, output)
        if progress is not None:
            progress(result)
    return [done[n, k] for n in names.values() for k in range(run.attempts)]


def _done(
    run: TabletopRun, stored: Sequence[Attempt], output: Path | None
) -> tuple[dict[tuple[str, int], Attempt], dict[str, str]]:
    """The attempts of a run that are stored, by object and number; and the name of each object that is given, once each."""
    robot, weights, objects = load_robot(run.robot), describe_weights(run.weights)["sha256"], _objects(run.objects)
    alike = [a for a in stored if (a.robot, a.settings, a.seed) == (robot.name, run.config.label(), run.seed)]
    done = [a for a in alike if (a.robot_sha256, a.weights_sha256) == (robot.sha256, weights)]
    for a in done:
        source, sha256, solid = objects.get(a.object, ("", a.object_sha256, a.solid_sha256))
        if (a.object_sha256, a.solid_sha256) != (sha256, solid):
            raise OptionError(f"'{source}' is not the object '{a.object}' of the attempts in {output}, made with "
                              f"'{a.object_file}' as it was then; rename the file, or attempt it apart, with another "
                              "output=... and plans=...")
    return {(a.object, a.number): a for a in done}, {source: name for name, (source, *_) in objects.items()}


def _objects(given: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """What each object was given as, and its hashes, by its name."""
    found: dict[str, tuple[str, str, str]] = {}
    for source in dict.fromkeys(given):
        obj = load_object(source)
        first, _, solid = found.setdefault(obj.name, (source, obj.sha256, obj.solid_sha256))
        if obj.solid_sha256 != solid:
            raise OptionError(f"'{first}' and '{source}' are different objects of the name '{obj.name}', under which attempts "
                              "and plans are stored; rename one of the files, or attempt them apart, each with its own "
                              "output=... and plans=...")
    return found


def _results(
    run: TabletopRun, missing: dict[str, list[int]], workers: int, plans: Path | None, make: Callable[..., Attempt]
) -> Iterator[Attempt]:
    if workers <= 1 or len(missing) <= 1:
        for name, numbers in missing.items():
            yield from _attempts(run, name, numbers, plans, make)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(_all_attempts, run, *item, plans, make) for item in missing.items()]):
            yield from future.result()


def _all_attempts(*task: Any) -> list[Attempt]:
    with one_thread():
        return list(_attempts(*task))


def _attempts(
    run: TabletopRun, name: str, numbers: Sequence[int], plans: Path | None, make: Callable[..., Attempt]
) -> Iterator[Attempt]:
    robot, obj, predictor = load_robot(run.robot), load_object(name), GraspPredictor(run.weights)
    weights = describe_weights(run.weights)["sha256"]
    for number in numbers:
        keeper = None if plans is None else PlanKeeper(plans / f"{robot.name}-{obj.name}-{number}.npz")
        made = make(robot, obj, number, run.seed, predictor, run.config, keeper)
        yield replace(
            made, robot_file=str(run.robot), object_file=str(name), weights=str(run.weights or DEFAULT),
            robot_sha256=robot.sha256, object_sha256=obj.sha256, weights_sha256=weights,
            solid_sha256=obj.solid_sha256)


def write_attempts(attempts: Sequence[Attempt], path: Path) -> None:
    """Write all attempts to a Parquet file, which appears whole or not at all."""
    with replacing(path, "attempts") as temporary:
        pq.write_table(pa.Table.from_pylist([asdict(a) for a in attempts]), temporary)


def read_attempts(path: Path) -> list[Attempt]:
    """Read such a file."""
    known = {f.name for f in fields(Attempt)}
    expected = "a file of attempts; name another one, or move this one away"
    with reading(path, GraspFileError, expected, pa.ArrowException, TypeError):  # which names the columns that are missing
        return [Attempt(**{k: v for k, v in row.items() if k in known}) for row in pq.read_table(path).to_pylist()]


def lifted(attempts: Sequence[Attempt]) -> list[Attempt]:
    """Those whose object was in the air, of attempts that put it down."""
    return [a for a in attempts if a.stage in {*PLACING, "place", "done"}]


def placing_errors(attempts: Sequence[Attempt]) -> dict[str, float] | None:
    """Median errors of the placed objects [m and degrees], and the number placed; None if none was."""
    rows = [(a.place_error, a.place_tilt or 0.0) for a in attempts if a.place_error is not None]
    if not rows:
        return None
    error, tilt = np.median(rows, axis=0).tolist()
    return {"error": error, "tilt": tilt, "n": len(rows)}


def endings(attempts: Sequence[Attempt]) -> dict[str, int]:
    """How many attempts ended in each stage, the successful ones as `done`."""
    return dict(Counter(a.stage for a in attempts))


def failures(attempts: Sequence[Attempt]) -> list[str]:
    """One line for each failure."""
    return [f"{a.object}, attempt {a.number}, {a.stage}: {a.reason}" for a in attempts if not a.success]


def processor_seconds(attempts: Sequence[Attempt]) -> dict[str, float] | None:
    """Time of one core from depth image to timed plan [s], of attempts that were planned; None if none was."""
    seconds = [a.processor_seconds for a in attempts if a.processor_seconds > 0]
    if not seconds:
        return None
    return {"median": float(np.median(seconds)), "within_95": float(np.quantile(seconds, 0.95)), "n": len(seconds)}
