"""The experiment: one attempt to lift an object, from the depth image to the shaken object.

In one attempt an object comes to rest on the table, is seen, planned for, grasped, lifted, then held and shaken, or placed.
"""

from __future__ import annotations

import json
import math
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from dro_grasp.arm.flat.plans import may_slide, plan_or_slide
from dro_grasp.arm.planning.motion import PLACING, SLIDING, STAGES, MotionPlan
from dro_grasp.arm.planning.physics import FALLEN, FRICTION, TICK, Deviation, LiftScene, check_friction
from dro_grasp.arm.planning.planner import plan
from dro_grasp.arm.planning.reachability import ReachConfig
from dro_grasp.arm.planning.task import PlanConfig
from dro_grasp.arm.planning.workcell import Workcell, moved
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.attempts import Attempt
from dro_grasp.arm.tabletop.camera_view import depth_image
from dro_grasp.arm.tabletop.placed import draw_place, measured, place_fault
from dro_grasp.arm.tabletop.table_scene import PickedObject, pick_object
from dro_grasp.arm.tabletop.table_setup import Region, other_objects, scatter
from dro_grasp.errors import DroGraspError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.hold import HoldCheck
from dro_grasp.kinds import Checked
from dro_grasp.objects.perception.depth_noise import NoiseName, depth_noise
from dro_grasp.objects.scenery import load_scene
from dro_grasp.objects.shape import ObjectModel, check_mass, with_mass
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor

LABEL = "tabletop/15 "
"""Beginning of the settings of stored attempts; the number goes up with every change that can change an outcome."""
SETTLE_SECONDS = 1.0  # How long an object is left to itself before its place is measured [s] (ours)
PUSHES = 16  # Most pushes of a flat thing towards an edge (ours)


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
    friction: float = FRICTION
    """Coefficient of friction between hand, objects and table; what the planner assumes is in `plan`."""
    slide: bool = True
    """Whether what lies flat is pushed to an edge of the table where no grasp of it is trusted."""
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
        if not isinstance(self.plan.source, str):
            raise OptionError(f"the plan's source is {self.plan.source!r}; attempts are stored with their settings, so give a "
                              "name, such as 'network' or 'module:name'")
        depth_noise(self.noise)
        x, y, far_x, far_y = self.region
        if not (-math.inf < x < far_x < math.inf and -math.inf < y < far_y < math.inf):
            raise OptionError(f"region is {self.region}; give two corners, the lower one first: X0 Y0 X1 Y1 in metres")
        check_friction(self.friction)
        if self.mass is not None:
            check_mass(self.mass)
        if not 0 <= self.clutter <= 8:  # there is no room for more
            raise OptionError(f"clutter is {self.clutter}; give a number of other objects from 0 to 8")

    def label(self) -> str:
        """Version and every setting, as stored with results: results of other settings are not mixed."""
        # What is not asked for is left out: attempts of before it could be are not repeated.
        usual = (("mass", None), ("place", False), ("slide", True))
        given = {name: value for name, value in asdict(self).items() if (name, value) not in usual}
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
    robot.require_table(camera=config.see == "cloud")
    require_mesh(obj)
    obj = obj if config.mass is None else with_mass(obj, config.mass)
    own = seed + zlib.crc32(obj.name.encode())  # with the same draws for all objects, attempts would not be independent
    others = other_objects(obj.name, config.clutter, np.random.default_rng([own, number, 1]))
    scene = LiftScene(Workcell(robot), [obj, *others], friction=config.friction)
    result = Attempt(robot.name, obj.name, number, seed, config.label())
    draw = np.random.default_rng([own, number])
    if not scatter(scene, config.region, draw):
        return replace(result, stage="see", reason="an object rolls off the region wherever it is put")
    start, beside = scene.pose(0), [scene.centre(i) for i in range(1, len(scene.objects))]
    low, result = scene.centre(0)[2], replace(result, place=json.dumps(start.round(6).tolist()))
    try:
        while True:
            result = replace(result, stage="see")
            begin, processor = time.perf_counter(), time.process_time()
            seen, T = _see(scene, config, int(draw.integers(2**31)))
            result, begin = replace(result, stage="plan", see_seconds=time.perf_counter() - begin), time.perf_counter()
            grasps = None if proposer is None else proposer(seen, T, own + number)
            place = draw_place(scene, seen, config.region, np.random.default_rng([own, number, 2])) if config.place else None
            if grasps is None and config.slide and may_slide(seen.robot, seen.obj, T):
                made = plan_or_slide(
                    seen.robot, seen.obj, T, seen.obstacles, predictor, config.plan, own + number, place=place)
            else:
                made = plan(seen.robot, seen.obj, T, seen.obstacles, predictor, config.plan, own + number, grasps, place=place)
            if made.notes.slide is None:
                break
            if (result := _pushed(result, scene, seen, made, watch)).reason:
                return result
            start, low = scene.pose(0), scene.centre(0)[2]
    except DroGraspError as error:
        return replace(result, reason=str(error))
    notes = made.notes
    result = replace(
        result, processor_seconds=time.process_time() - processor, plan_seconds=time.perf_counter() - begin,
        grasp_seconds=notes.seconds["grasps"], score=notes.score, rehearsed=notes.rehearsed, grasps=notes.grasps,
        dropped=json.dumps(notes.dropped), motion_seconds=made.seconds)
    if watch is not None:
        watch.planned(seen, made)
    stage, reason = carry_out(scene, made, config, watch)
    if config.place and not reason:
        result = measured(result, scene, start, made)
        stage, reason = place_fault(result.place_error or 0.0, result.place_tilt or 0.0)
    raised = float(scene.centre(0)[2] - low)
    pushed = max((float(np.linalg.norm(scene.centre(i) - centre)) for i, centre in enumerate(beside, 1)), default=0.0)
    return replace(result, stage=stage, reason=reason, success=not reason, raised=raised, pushed=pushed)


def _pushed(
    result: Attempt, scene: LiftScene, seen: PickedObject, made: MotionPlan, watch: Watcher | None
) -> Attempt:
    """An attempt after a push to the table's edge, or why there is none."""
    if result.pushes >= PUSHES:
        return replace(result, stage="slide", reason=f"the object is not ready to be taken at the edge after {PUSHES} pushes")
    if watch is not None:
        watch.planned(seen, made)
    for stage in SLIDING:
        scene.follow(made.arm, made.hand, made.part(stage), None if watch is None else lambda: watch.moved(scene))
    table, result = scene.robot.usual_table, replace(result, pushes=result.pushes + 1)
    if scene.centre(0)[2] < table.height - FALLEN:
        return replace(result, stage="slide", reason="the object fell off the table as it was pushed")
    return result


def carry_out(scene: LiftScene, made: MotionPlan, config: TabletopConfig, watch: Watcher | None = None) -> tuple[str, str]:
    """Let the servos follow a plan, then hold and shake, or put down; where it ended, and why if it failed."""
    start = scene.centre(0)
    call = None if watch is None else lambda: watch.moved(scene)
    for stage in STAGES:
        scene.follow(made.arm, made.hand, made.part(stage), call)
        if stage == "approach" and (moved := float(np.linalg.norm(scene.centre(0) - start))) > 0.03:  # [m] (ours)
            return stage, f"the hand pushed the object by {100 * moved:.1f} cm before it closed"
    lifted = float(scene.centre(0)[2] - start[2])
    if lifted < config.plan.reach.within(scene.robot).lift / 2:
        return "lift", "the object stayed on the table" if lifted < 0.02 else "the object fell during the lift"
    if made.notes.place is not None:
        return _put_down(scene, made, call)
    grip = scene.centre_in_hand(0)
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


def _slipped(scene: LiftScene, grip: Float[np.ndarray, "3"]) -> str:
    """How far the object has moved in the hand since its centre of mass was there [m], if that is too far."""
    slip = float(np.linalg.norm(scene.centre_in_hand(0) - grip))
    lost = slip > 0.05 or not scene.touched(0)  # [m] (ours)
    return f"the object slipped by {100 * slip:.0f} cm out of the hand" if lost else ""


def _put_down(scene: LiftScene, made: MotionPlan, call: Callable[[], None] | None) -> tuple[str, str]:
    """Let the servos follow the stages after the lift, and wait; where it ended, and why if it failed."""
    grip = scene.centre_in_hand(0)
    for stage in PLACING:
        scene.follow(made.arm, made.hand, made.part(stage), call)
        if stage == "carry" and (slipped := _slipped(scene, grip)):
            return stage, slipped
    scene.advance(SETTLE_SECONDS, call)
    return ("retreat", "the hand still touches the object after it has left") if scene.touched(0) else ("done", "")


def _see(scene: LiftScene, config: TabletopConfig, seed: int) -> tuple[PickedObject, Float[np.ndarray, "4 4"]]:
    """The object as it is known, with other things and the table that was seen; and where its frame is."""
    robot, T, (obj, *others) = scene.robot, scene.pose(0), scene.objects
    if config.see == "mesh":
        return PickedObject(obj, [moved(o, scene.pose(i)) for i, o in enumerate(others, 1)], robot), T
    camera = robot.camera
    assert camera is not None
    depth, mask = depth_image(scene, camera, config.noise, seed)
    view = load_scene(depth, obj.name, camera=camera.as_seen())
    if config.segment == "mask":
        seen = pick_object(view, robot, mask=mask)
    else:
        seen = pick_object(view, robot, T[:3, :3] @ obj.cloud.mean(0) + T[:3, 3])
    return seen if config.mass is None else replace(seen, obj=with_mass(seen.obj, config.mass)), np.eye(4)


def require_mesh(obj: ObjectModel) -> None:
    """Refuse a bare cloud, by an OptionError."""
    if obj.is_cloud:
        raise OptionError(f"object '{obj.name}' is a bare cloud; attempts are simulated, and need a mesh")
