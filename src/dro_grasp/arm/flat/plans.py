"""What to do about a flat thing: take it where it overhangs, push it to an edge otherwise, or grasp it as other things.

One call makes one motion. After a push, look again and call again. Ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from dro_grasp.arm.flat.grips import flat_grasps, overhangs
from dro_grasp.arm.flat.sliding import AT_TABLE, SlideConfig, slide
from dro_grasp.arm.flat.things import height_of, lies_flat, width_of
from dro_grasp.arm.planning.motion import MotionPlan, grasps_and_dropped
from dro_grasp.arm.planning.placing import Place, PlaceLike
from dro_grasp.arm.planning.planner import Tries, first_trusted, plan
from dro_grasp.arm.planning.task import PlanConfig, Task, around
from dro_grasp.arm.planning.workcell import moved
from dro_grasp.arm.robots.robot import JointsLike, Robot
from dro_grasp.errors import NoGraspError, OptionError, PlanError
from dro_grasp.extras import require_extra
from dro_grasp.frames import motion_fault
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.kinds import checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.predictor import GraspPredictor

REHEARSED = 24  # Grasps at an edge whose lift is simulated (ours): one takes a tenth of a second
UNLIKELY = 0.02
"""Height up to which grasps from above are not looked for before a push [m] (ours): round fingertips slip off such edges."""
WIDEST = 0.09
"""Width up to which they are looked for at all [m] (ours): hands of a person's size clasp nothing flat that is wider."""


def may_slide(robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"]) -> bool:
    """Whether an object lies flat on the robot's table, and the hand has a thumb and two fingers to take it at an edge."""
    if robot.table is None or robot.hand.thumb is None or len(robot.hand.fingers) < 3:
        return False
    return lies_flat(obj.cloud @ T_world_object[:3, :3].T + T_world_object[:3, 3], robot.table.height)


@checked
def plan_or_slide(
    robot: Robot, obj: ObjectModel, T_world_object: Float[np.ndarray, "4 4"] | None = None,
    obstacles: Sequence[ObjectModel] = (), predictor: GraspPredictor | None = None, config: PlanConfig | None = None,
    seed: int = 0, start: JointsLike | None = None,
    place: PlaceLike | None = None,
) -> MotionPlan:
    """As `plan`; but what lies flat is taken where it overhangs the table's edge, or pushed there if no grasp is trusted.

    A plan whose `notes.slide` is not None pushes: carry it out, look again, and call again with what is seen then. Where the
    edges are, the robot's table says.

    Examples:
        >>> made = plan_or_slide(robot, obj)
        >>> if made.notes.slide is not None:  # push, look, and plan again
        ...     obj = look_again(made)

    Args:
        robot: Arm, hand and table.
        obj: A mesh, or a camera's cloud.
        T_world_object: Where it stands [m]; its frame is the world's by default.
        obstacles: As for `plan`.
        predictor: As for `plan`.
        config: As for `plan`.
        seed: As for `plan`.
        start: As for `plan`.
        place: As for `plan`; a push ignores it.

    Raises:
        PlanError: As for `plan`; the message tells why it was not pushed, either.
        RobotError: As for `plan`.
        OptionError: As for `plan`.
    """
    require_extra("arm")
    T = np.eye(4) if T_world_object is None else T_world_object
    if (fault := motion_fault(torch.as_tensor(T).float())) is not None:
        raise OptionError(f"T_world_object is no pose of '{obj.name}' in metres; {fault}")
    config = config or PlanConfig()

    def usual() -> MotionPlan:
        return plan(robot, obj, T, obstacles, predictor, config, seed, start=start, place=place)

    if not may_slide(robot, obj, T):
        return usual()
    faults = list[str]()
    for way in _ways(robot, moved(obj, T), obstacles, predictor, config, seed, start, place, usual):
        try:
            return way()
        except (PlanError, NoGraspError) as error:
            faults.append(str(error))
    raise PlanError("; ".join(dict.fromkeys(faults)))


def _ways(
    robot: Robot, obj: ObjectModel, obstacles: Sequence[ObjectModel], predictor: GraspPredictor | None, config: PlanConfig,
    seed: int, start: JointsLike | None, place: PlaceLike | None,
    usual: Callable[[], MotionPlan],
) -> list[Callable[[], MotionPlan]]:
    """What is tried for a flat thing in the world, one after the other; each makes a motion, or says why it cannot."""
    table, points = robot.table, np.asarray(obj.cloud, np.float64)
    assert table is not None

    def trusted_of(config: PlanConfig, grasps: GraspBatch | None = None) -> Callable[[], MotionPlan]:
        return lambda: _trusted(robot, obj, obstacles, predictor, config, seed, start, place, grasps)

    def pushed() -> MotionPlan:
        if config.constraints.keep_out or config.constraints.contact_region:
            raise PlanError(f"'{obj.name}' lies flat, and is not pushed: fingers would touch it anywhere, against keep_out or "
                            "contact_region")
        slides = SlideConfig(rehearsed=config.rehearsals > 0, friction=config.friction)
        things = [*obstacles, *around(robot, obj, config.constraints)]
        return slide(robot, obj, things, slides, seed, None if start is None else robot.require_start(start))

    if overhangs(points, table):
        at_edge = replace(config, reach=replace(AT_TABLE, lift=config.reach.lift), rehearsals=config.rehearsals and REHEARSED)
        grasps = flat_grasps(robot.hand, obj, table, seed)
        return [trusted_of(at_edge, grasps), pushed,
                lambda: plan(robot, obj, None, obstacles, predictor, at_edge, seed, grasps, start, place)]
    from_above = height_of(points, table.height) > UNLIKELY and width_of(points) < WIDEST
    return [*([trusted_of(config)] if from_above else []), pushed, usual]


def _trusted(
    robot: Robot, obj: ObjectModel, obstacles: Sequence[ObjectModel], predictor: GraspPredictor | None, config: PlanConfig,
    seed: int, start: JointsLike | None, place: PlaceLike | None,
    grasps: GraspBatch | None = None,
) -> MotionPlan:
    """The motion to a grasp, of these or of the first predicted batch, that holds in most of its rehearsals.

    Raises:
        PlanError: There is none.
    """
    wanted = None if place is None else Place.of(place)
    task = Task.of(robot, obj, np.eye(4), obstacles, replace(config, batches=1), seed, start, wanted)
    tries = Tries(grasps is None)
    task.check_start()
    made = first_trusted(task, tries, grasps, predictor)
    if made is None:
        raise PlanError(f"no grasp of '{obj.name}' is trusted: {grasps_and_dropped(tries.made, tries.counts)}")
    return made
