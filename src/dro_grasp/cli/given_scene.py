"""Options of a scene: which thing of what a camera saw is meant, and the picture of what was taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.output import say_aside
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.files import check_output

if TYPE_CHECKING:
    from dro_grasp.arm.robots.robot import Robot
    from dro_grasp.arm.tabletop.table_scene import PickedObject
    from dro_grasp.cli.generate import Generate
    from dro_grasp.cli.robots import Plan
    from dro_grasp.objects.perception.choosing import Chosen
    from dro_grasp.objects.perception.scene_files import SceneCamera
    from dro_grasp.objects.scenery import FoundObject, Scene

CHOICES = ("--at", "--pixel", "--mask", "--nearest")  # Options that say which thing of a scene is meant


ROBOT = "robot"  # Instead of a camera's file: the camera of the robot


@dataclass(frozen=True)
class SceneOptions:
    """What a camera saw, instead of an object alone, and which thing of it is meant."""

    scene: Annotated[Path | None, optional("CLOUD|DEPTH", "an object alone")] = None
    """Instead of --object: what a camera saw, a cloud or a depth image (PNG, TIFF, NPY). One thing in it is the object, the
    plane on which it stands its table, and nothing touches all else."""
    pixel: Annotated[tuple[float, float] | None, optional("U V", "the only thing")] = None
    """Which thing of the scene: the one that this pixel shows, by column and row."""
    mask: Annotated[Path | None, optional("PNG", "the only thing")] = None
    """Which thing of the scene: the pixels that are not black in this image."""
    nearest: Flag = False  # Which thing of the scene: the one nearest to the camera.
    part: Flag = False  # Of things that touch: the one side at --at or --pixel.
    scene_picture: Annotated[Path | None, optional("PNG", "no picture")] = None
    """Picture of what was taken for the object, for tables and walls, and for obstacles, before anything is grasped."""


def check_choice(command: Generate | Plan, own: tuple[str, ...] = ()) -> None:
    """Refuse options that contradict one another, by an OptionError; `own` ones mean something without a scene, too."""
    if (command.object is None) == (command.seen.scene is None):
        raise OptionError("give --object NAME|PATH, or --scene CLOUD|DEPTH with the thing that is meant "
                          f"({', '.join(CHOICES)}); {'neither is' if command.object is None else 'both are'} given")
    values = vars(command.seen) | {"at": command.at}
    given = [option for option in CHOICES if values[option[2:]] not in (None, False)]
    if command.seen.scene is None:
        concern = [option for option in given if option not in own]
        concern += ["--part"] * command.seen.part + ["--scene-picture"] * (command.seen.scene_picture is not None)
        if concern:
            verb = "concerns" if len(concern) == 1 else "concern"
            raise OptionError(f"{' and '.join(concern)} {verb} a scene; give it by --scene instead of --object")
    elif len(given) > 1:
        raise OptionError(f"{' and '.join(given)} each say which thing of the scene is meant; give one of them")
    if command.seen.scene_picture is not None:
        check_output(command.seen.scene_picture, ".png")


def seen_from(camera: str | None, robot: Robot) -> SceneCamera | None:
    """The camera in the world, of a file or the robot's; None if what is given is in the world's frame."""
    from dro_grasp.objects.perception.scene_files import as_camera

    if camera is None:
        return None
    if camera != ROBOT:
        return as_camera(camera)
    if robot.camera is None:
        raise OptionError(f"robot '{robot.name}' has no camera; state it in the robot file, or give --camera JSON")
    return robot.camera.as_seen()


def find_thing(
    scene: Scene, command: Generate | Plan, find: Callable[..., FoundObject] | None = None
) -> FoundObject:
    """The one thing of the scene that is meant, by `object_at` or by `find`; the picture is drawn even where none is."""
    seen = command.seen
    with _picture_if_refused(scene, seen.scene_picture):
        found = (find or scene.object_at)(
            command.at, pixel=seen.pixel, mask=seen.mask, nearest=seen.nearest, part=seen.part)
    _picture(scene, found, seen.scene_picture)
    return found


def find_on_table(scene: Scene, robot: Robot, command: Plan) -> PickedObject:
    """The thing on a robot's table that is meant, flat or not; the picture is drawn in either case."""
    from dro_grasp.arm.tabletop.table_scene import as_picked, found_on_table, picked_flat
    from dro_grasp.objects.perception.choosing import all_within

    with _picture_if_refused(scene, command.seen.scene_picture):
        flat = None if command.seen.mask is None else picked_flat(scene, robot, command.seen.mask)
    if flat is None:
        return as_picked(find_thing(scene, command, partial(found_on_table, scene, robot)), robot, scene)
    if command.seen.scene_picture is not None:
        assert scene.sight is not None
        _picture(scene, all_within(scene.name, scene.sight, scene.segments, command.seen.mask), command.seen.scene_picture)
    return flat


@contextmanager
def _picture_if_refused(scene: Scene, path: Path | None) -> Iterator[None]:
    """Draw what the scene shows where nothing of it can be taken."""
    try:
        yield
    except ObjectError:
        if scene.sight is not None:
            _picture(scene, None, path)
        raise


def _picture(scene: Scene, found: FoundObject | Chosen | None, path: Path | None) -> None:
    """Draw the scene, and what was taken of it, if there is a path to draw to."""
    from dro_grasp.pictures.scene import draw_scene

    if path is not None:
        draw_scene(scene, found, path)
        say_aside(f"{'what the scene shows' if found is None else 'what was taken for the object'}: {path}")
