"""Animations of attempts, drawn without a browser or OpenGL: robot, table and object at each moment, as GIF or WebP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.arm.robot_check import robot_meshes, table_meshes
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.attempts import Attempt
from dro_grasp.arm.tabletop.experiment import Watcher, attempt
from dro_grasp.arm.tabletop.run import TabletopRun
from dro_grasp.arm.tabletop.table_scene import PickedObject
from dro_grasp.errors import OutputError
from dro_grasp.files import check_output, replacing
from dro_grasp.geometry.rendering.rasterizer import OBJECT_COLOUR, Camera, Colour, Mesh, render
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pictures.appearance import object_meshes
from dro_grasp.predict.predictor import GraspPredictor

FORMATS = {".gif": "GIF", ".webp": "WEBP"}  # Endings of animation files
RATE = 10  # Frames per second (ours)
SIZE = (480, 360)  # Width and height [pixels]
VIEW = (0.9, -1.25, 0.75)  # Direction from the robot towards the camera, in the world
FIXTURE_COLOUR: Colour = (0.55, 0.60, 0.68)  # Grey blue of what does not move
OTHER_COLOUR: Colour = (0.62, 0.68, 0.55)  # Green of other objects on the table
THING_COLOURS: tuple[Colour, ...] = (
    OBJECT_COLOUR, (0.36, 0.60, 0.47), (0.80, 0.36, 0.36), (0.55, 0.45, 0.70), (0.90, 0.75, 0.35), (0.35, 0.58, 0.72),
    (0.72, 0.52, 0.42), (0.55, 0.62, 0.35))
"""Of objects on a table none of which is asked for, in turn."""


@dataclass
class Recorder(Watcher):
    """Keeps what a scene looks like, and the plans that are carried out in it."""

    rate: float = RATE  # Pictures a second
    frames: list[tuple[Float[np.ndarray, " n_arm"], Float[np.ndarray, " n_dof"], Float[np.ndarray, "o 4 4"]]] = field(
        default_factory=list)  # Arm, hand [rad or m], and the objects' poses [m]
    objects: tuple[ObjectModel, ...] = ()  # The objects in the scene, the one that is asked for first
    fixtures: tuple[ObjectModel, ...] = ()  # What does not move, in the world
    plans: list[tuple[int, MotionPlan]] = field(default_factory=list)  # Each with the number of its first frame
    next_time: float | None = None  # Simulated time of the next frame [s]

    def planned(self, seen: PickedObject, made: MotionPlan) -> None:
        """Keep the plan."""
        self.plans.append((len(self.frames), made))

    def moved(self, scene: LiftScene) -> None:
        """Look at the scene."""
        if self.next_time is None or scene.data.time >= self.next_time:
            self.objects, self.fixtures = scene.objects, scene.fixtures
            self.frames.append((*scene.joints(), np.stack([scene.pose(i) for i in range(len(scene.objects))])))
            self.next_time = scene.data.time + 1 / self.rate - scene.model.opt.timestep / 2


def draw_animation(robot: Robot, recorder: Recorder, path: Path) -> None:
    """Write the animation of a recorded attempt.

    Raises:
        OutputError: Nothing was recorded, the ending is unknown, or the path cannot be written.
    """
    check_output(path, *FORMATS)
    if not recorder.frames:
        raise OutputError(f"no motion to draw into {path}: the attempt ended before the robot moved")
    camera = _camera(robot, recorder)
    still = [Mesh(mesh.vertices, mesh.faces, FIXTURE_COLOUR) for thing in recorder.fixtures for mesh in object_meshes(thing)]
    colours = [colour_of(i, bool(recorder.plans)) for i in range(len(recorder.objects))]
    things = list(zip(recorder.objects, colours, strict=True))
    pictures = [Image.fromarray(_frame(robot, things, still, camera, *frame)) for frame in recorder.frames]
    lengths = [1000 // RATE] * (len(pictures) - 1) + [1000]
    kind = FORMATS[path.suffix.lower()]
    options = {"quality": 70, "method": 4} if kind == "WEBP" else {"optimize": True}
    if kind == "GIF":
        pictures = [p.quantize(64) for p in pictures]
    with replacing(path, "animation") as temporary:
        pictures[0].save(temporary, format=kind, save_all=True, append_images=pictures[1:], duration=lengths, loop=0, **options)


def draw_attempt(run: TabletopRun, chosen: Attempt, path: Path) -> Attempt:
    """Repeat an attempt of a run, and write its animation."""
    robot, obj, recorder = load_robot(run.robot), load_object(chosen.object_file), Recorder()
    result = attempt(robot, obj, chosen.number, run.seed, GraspPredictor(run.weights), run.config, recorder)
    draw_animation(robot, recorder, path)
    return result


def colour_of(number: int, asked: bool) -> Colour:
    """Of an object by its number, where the first one is asked for, or none is."""
    if not asked:
        return THING_COLOURS[number % len(THING_COLOURS)]
    return OTHER_COLOUR if number else OBJECT_COLOUR


def _frame(
    robot: Robot, objects: Sequence[tuple[ObjectModel, Colour]], still: Sequence[Mesh], camera: Camera,
    arm: Float[np.ndarray, " n_arm"], hand: Float[np.ndarray, " n_dof"], poses: Float[np.ndarray, "o 4 4"],
) -> UInt8[np.ndarray, "height width 3"]:
    things = []
    for (obj, colour), T in zip(objects, poses, strict=True):
        assert obj.vertices is not None
        assert obj.faces is not None
        things.append(Mesh(obj.vertices @ T[:3, :3].T + T[:3, 3], obj.faces, colour))
    return render([*table_meshes(robot.table), *robot_meshes(robot, arm, hand), *still, *things], camera, *SIZE)


def _camera(robot: Robot, recorder: Recorder) -> Camera:
    """A camera that has the whole motion in its picture, and the part of the table around it."""
    moved = [mesh.vertices for arm, hand, _ in recorder.frames[:: max(1, len(recorder.frames) // 8)]
             for mesh in robot_meshes(robot, arm, hand)]
    things = [obj.vertices @ T[:3, :3].T + T[:3, 3] for row in (0, -1)
              for obj, T in zip(recorder.objects, recorder.frames[row][2], strict=True) if obj.vertices is not None]
    things += [thing.cloud.astype(np.float64) for thing in recorder.fixtures]
    square = 0.15 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])  # around the first object [m] (ours)
    around = recorder.frames[0][2][:1, :2, 3] + square
    corners = np.column_stack([around, np.full(len(around), robot.usual_table.height)])
    return Camera.around(np.concatenate([*moved, *things, corners]), VIEW, aspect=SIZE[0] / SIZE[1], margin=0.03)
