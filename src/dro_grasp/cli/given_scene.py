"""Options of a scene: which thing of what a camera saw is meant, and the picture of what was taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dro_grasp.cli.output import say_aside
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.files import check_output

if TYPE_CHECKING:
    from dro_grasp.arm.robots.robot import Robot
    from dro_grasp.arm.tabletop.table_scene import PickedObject
    from dro_grasp.cli.generate import Generate
    from dro_grasp.cli.robots import Plan
    from dro_grasp.objects.perception.choosing import Chosen
    from dro_grasp.objects.scenery import FoundObject, Scene

CHOICES = ("--at", "--pixel", "--mask", "--nearest")  # Options that say which thing of a scene is meant


def check_choice(command: Generate | Plan, own: tuple[str, ...] = ()) -> None:
    """Refuse options that contradict one another, by an OptionError; `own` ones mean something without a scene, too."""
    if (command.object is None) == (command.scene is None):
        raise OptionError("give --object NAME|PATH, or --scene CLOUD|DEPTH with the thing that is meant "
                          f"({', '.join(CHOICES)}); {'neither is' if command.object is None else 'both are'} given")
    given = [option for option in CHOICES if getattr(command, option[2:]) not in (None, False)]
    if command.scene is None:
        concern = [option for option in given if option not in own]
        concern += ["--part"] * command.part + ["--scene-picture"] * (command.scene_picture is not None)
        if concern:
            verb = "concerns" if len(concern) == 1 else "concern"
            raise OptionError(f"{' and '.join(concern)} {verb} a scene; give it by --scene instead of --object")
    elif len(given) > 1:
        raise OptionError(f"{' and '.join(given)} each say which thing of the scene is meant; give one of them")
    if command.scene_picture is not None:
        check_output(command.scene_picture, ".png")


def find_thing(
    scene: Scene, command: Generate | Plan, find: Callable[..., FoundObject] | None = None
) -> FoundObject:
    """The one thing of the scene that is meant, by `object_at` or by `find`; the picture is drawn even where none is."""
    with _picture_if_refused(scene, command.scene_picture):
        found = (find or scene.object_at)(
            command.at, pixel=command.pixel, mask=command.mask, nearest=command.nearest, part=command.part)
    _picture(scene, found, command.scene_picture)
    return found


def find_on_table(scene: Scene, robot: Robot, command: Plan) -> PickedObject:
    """The thing on a robot's table that is meant, flat or not; the picture is drawn in either case."""
    from dro_grasp.arm.tabletop.table_scene import as_picked, found_on_table, picked_flat
    from dro_grasp.objects.perception.choosing import all_within

    with _picture_if_refused(scene, command.scene_picture):
        flat = None if command.mask is None else picked_flat(scene, robot, command.mask)
    if flat is None:
        return as_picked(find_thing(scene, command, partial(found_on_table, scene, robot)), robot, scene)
    if command.scene_picture is not None:
        assert scene.sight is not None
        _picture(scene, all_within(scene.name, scene.sight, scene.segments, command.mask), command.scene_picture)
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
