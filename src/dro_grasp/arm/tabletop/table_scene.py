"""Objects on a robot's table: one of what its camera saw is picked, the table is where it was seen, all else is avoided."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from dro_grasp.arm.flat.things import overhang, seen_flat
from dro_grasp.arm.planning.placing import LEVEL, height_below
from dro_grasp.arm.planning.workcell import VOXEL
from dro_grasp.arm.robots.robot import Robot, Table
from dro_grasp.errors import DroGraspError, ObjectError, RobotError
from dro_grasp.geometry.cache import content_hash
from dro_grasp.geometry.table_plane import moved_plane
from dro_grasp.kinds import checked
from dro_grasp.objects.perception.choosing import CLOUD_EDGE, CUT_OFF, Pixel, Spot, within
from dro_grasp.objects.perception.things import place_of, size_of
from dro_grasp.objects.scenery import FoundObject, Scene
from dro_grasp.objects.shape import ObjectModel

OVERHANG = 0.1  # How far things may overhang the table [m] (ours)
APART = 0.015  # Difference between a table's seen and stated height that is told [m] (ours)
SUNK = 0.03  # Depth below its stated height from which what is seen is no table, unless that is seen as well [m] (ours)
NEAR_CUT = 0.015  # Way from a thing to what was cut off at which it may go on there [m] (ours)
LOST = 0.02  # Share of a thing's points that are cut off from which it is told [1] (ours)
CORRECT = ("Correct the table's `centre` and `size` in the robot file, or the pose of the camera, or move the thing onto the "
           "table")
"""What to do about a thing that is not on the table."""
BELOW = 0.05  # Depth below the table from which on what is beside it is something else [m] (ours)


@dataclass(frozen=True)
class PickedObject:
    """One object on a table, ready for planning."""

    obj: ObjectModel
    """In the world's frame, without what its completion put below the table."""
    obstacles: list[ObjectModel]
    """The other things, likewise, if there are any. What is below a point that was seen counts as solid."""
    robot: Robot
    """With its table at the height that was seen."""

    def noted(self, stated: Robot) -> PickedObject:
        """The same, with a note on the object if its table is elsewhere than the robot's is stated to be."""
        note = () if self.robot.table is None else table_note(stated, self.robot.table.height)
        return replace(self, obj=replace(self.obj, notes=(*self.obj.notes, *note))) if note else self


@checked
def pick_object(
    scene: Scene, robot: Robot, at: Spot | None = None, *, pixel: Pixel | None = None, mask: Any = None,
    nearest: bool = False, part: bool = False, name: str | None = None,
) -> PickedObject:
    """One object of what was seen of a robot's table; see `Scene.object_at`, which says how one is chosen.

    Examples:
        >>> scene = load_scene(depth, camera=robot.camera.as_seen())
        >>> picked = pick_object(scene, robot, (0.5, 0.1, 0.05))
        >>> made = plan(picked.robot, picked.obj, obstacles=picked.obstacles)

    Args:
        scene: What was seen, in the world's frame. What is beside the table is left out.
        robot: With a table.
        at: A place on the object or near it, in the world: x, y, z [m].
        pixel: A pixel that shows it: column and row, from the upper left.
        mask: Its pixels: an array (h, w), true or not 0 on the object, or the path of a PNG. It also shows what is too flat
            for the camera's depth, such as a card.
        nearest: Take what is nearest to the camera.
        part: Of things that touch, take the one side at the place or the pixel; the other one is avoided.
        name: What to call it; the scene's name by default.

    Raises:
        ObjectError: No level plane, nothing on it, or it is not clear which object is meant; or the table is seen below where
            the robot file states it.
        OptionError: Two choices are given, or the scene lacks what one of them needs.
        RobotError: The robot has no table.
    """
    seen = seen_on_table(scene, robot)
    if mask is not None and (flat := picked_flat(seen, robot, mask, name)) is not None:
        return flat
    found = found_on_table(seen, robot, at, pixel=pixel, mask=mask, nearest=nearest, part=part, name=name)
    return as_picked(found, robot, seen)


def found_on_table(
    scene: Scene, robot: Robot, at: Spot | None = None, *, pixel: Pixel | None = None, mask: Any = None,
    nearest: bool = False, part: bool = False, name: str | None = None,
) -> FoundObject:
    """The object that is meant of what `seen_on_table` left; arguments as for `pick_object`.

    Raises:
        ObjectError: There is none, or it is beside the table, which the message then says.
    """
    try:
        return scene.object_at(at, pixel=pixel, mask=mask, nearest=nearest, part=part, name=name)
    except ObjectError as error:
        if (whole := scene.whole) is None or (at is None and pixel is None and mask is None and not nearest):
            raise
        try:
            chosen = whole.chosen(at, pixel, mask, nearest, part)
        except DroGraspError:
            raise error from None
        points, table = whole.points_seen()[chosen.own], _table(robot, scene.name)
        beyond = 100 * overhang(points, table)
        if beyond.max() <= 0:
            raise
        lies = "is beside" if beyond.min() > 0 else f"reaches {beyond.max():.0f} cm over the edge of"
        raise ObjectError(f"'{scene.name}' shows a thing there, of {size_of(points)} at {place_of(points)}, but it {lies} the "
                          f"{_stated(robot)}. {CORRECT}. On the table: {error}") from error


def as_picked(found: FoundObject, robot: Robot, scene: Scene) -> PickedObject:
    """An object that was found in a scene on a robot's table; see `pick_object`."""
    others = np.zeros((0, 3)) if found.obstacles is None else found.obstacles.points
    level = at_seen_height(robot, found.obj, scene)
    assert level.table is not None
    cut, notes = _cut_note(robot, scene, found.chosen.pixels), found.obj.notes
    if cut:  # the camera saw all of it
        notes = tuple(note for note in notes if not note.startswith(CUT_OFF.format(CLOUD_EDGE)))
    obj = replace(found.obj, notes=(*notes, *cut))
    return PickedObject(obj, _solid(others, level.table.height), level).noted(robot)


def _cut_note(robot: Robot, scene: Scene, pixels: Int[np.ndarray, " k"], mask: Any = None) -> tuple[str, ...]:
    """A note where an object with these pixels, or rows, goes on beside the table, where `seen_on_table` cut it off."""
    whole = scene.whole
    if whole is None or whole.sight is None or scene.sight is None:
        return ()
    world, seen = whole.points_seen(), whole.sight.pixels
    cut, own = ~np.isin(seen, scene.sight.pixels), np.isin(seen, pixels)
    if not cut.any() or KDTree(world[own]).query(world[cut], distance_upper_bound=NEAR_CUT)[0].min() > NEAR_CUT:
        return ()
    if mask is not None:
        thing = within(whole.name, whole.sight, mask)
    else:
        labels = whole.segments.labels
        if not (labels[own] >= 0).any():
            return ()
        thing = labels == np.bincount(labels[own & (labels >= 0)]).argmax()
    if (thing & cut).sum() <= LOST * thing.sum():
        return ()
    beyond = 100 * float(overhang(world[thing], _table(robot, scene.name)).max())
    return (f"it reaches {beyond:.0f} cm over the edge of the {_stated(robot)}, and what is more than {100 * OVERHANG:.0f} cm "
            f"beyond the edge, or hangs below it, is left out: {size_of(world[own])} of the {size_of(world[thing])} that are "
            f"seen are taken. {CORRECT}",)


def _stated(robot: Robot) -> str:
    """The table of a robot in words, as its file states it."""
    assert robot.table is not None
    (x, y), (width, depth) = robot.table.centre, robot.table.size
    return f"table of robot '{robot.name}', which its file states to be {width:g} x {depth:g} m about x = {x:g}, y = {y:g} m"


def picked_flat(scene: Scene, robot: Robot, mask: Any, name: str | None = None) -> PickedObject | None:
    """An object of which the pixels are known, if it lies flat on the table; None for others, and where no camera saw it."""
    table, sight = _table(robot, scene.name), scene.sight
    if sight is None or not sight.from_camera:
        return None
    flat = seen_flat(name or scene.name, sight.world(), within(scene.name, sight, mask), table, sight.T[:3, 3])
    if flat is None:
        return None
    refuse_sunk(robot, flat.table, scene)
    note = _cut_note(robot, scene, sight.pixels[within(scene.name, sight, mask)], mask)
    obj = replace(flat.obj, notes=(*flat.obj.notes, *note))
    return PickedObject(obj, flat.others, replace(robot, table=replace(table, height=flat.table))).noted(robot)


def seen_on_table(scene: Scene, robot: Robot) -> Scene:
    """What of a scene in the world is over or under the rectangle of the table, or overhangs it.

    Raises:
        ObjectError: Nothing is.
        RobotError: The robot has no table.
    """
    table = _table(robot, scene.name)
    if scene.sight is None:
        return scene  # which says of itself that it is a mesh
    world = scene.sight.world()
    beyond = overhang(world, table)
    kept = (beyond < 0) | ((beyond < OVERHANG) & (world[:, 2] > table.height - BELOW))
    if not kept.any():
        raise ObjectError(f"'{scene.name}' shows nothing of the table at {table.centre} m; correct the camera's pose in the "
                          "robot file, or the table's place")
    return scene if kept.all() else scene.of(kept)


def at_seen_height(robot: Robot, obj: ObjectModel, scene: Scene | None = None) -> Robot:
    """The robot with its table at the height of the plane on which an object in the world stands, below its middle.

    Raises:
        ObjectError: There is no such plane, it is not level, or it is below the table that the robot file states, which the
            scene does not show there.
        RobotError: The robot has no table.
    """
    table, plane, height = _table(robot, obj.name), obj.table, height_below(obj)
    if plane is None or height is None:
        tilt = "" if plane is None else f": the plane is tilted by {np.degrees(np.arccos(plane[2])):.0f} degrees"
        raise ObjectError(f"the camera sees no level table below '{obj.name}'{tilt}; correct its pose in the robot file, or "
                          "the table's place")
    refuse_sunk(robot, height, scene)
    return replace(robot, table=replace(table, height=height))


def refuse_sunk(robot: Robot, height: float, scene: Scene | None = None) -> None:
    """Refuse a plane below the table that a robot file states [m], through which hands would go, by an ObjectError.

    What is lower than the table is another surface where the scene shows the table at its height.
    """
    if (table := robot.table) is None or height >= table.height - SUNK:
        return
    if scene is not None and scene.sight is not None:
        planes = [moved_plane(plane, scene.sight.T) for plane in scene.segments.planes]
        levels = [(plane[3] - plane[:2] @ np.array(table.centre)) / plane[2] for plane in planes if abs(plane[2]) > LEVEL]
        if any(abs(level - table.height) < APART for level in levels):
            return
    raise ObjectError(f"the table is seen at z = {height:.3f} m, and the file of robot '{robot.name}' states "
                      f"{table.height:.3f} m: hands would go through it. Correct the pose of the camera or of the object, or "
                      "the `height` of the table in the robot file")


def table_note(robot: Robot, height: float) -> tuple[str, ...]:
    """A note where an object stands on a plane at another height than the table that the robot file states [m]."""
    if robot.table is None or abs(way := height - robot.table.height) < APART:
        return ()
    return (f"it stands on a level plane {100 * abs(way):.1f} cm {'above' if way > 0 else 'below'} the table of robot "
            f"'{robot.name}', and that plane counts as the table. If it stands on the table itself, correct the pose of the "
            "camera, or the table's `height` in the robot file",)


def _table(robot: Robot, name: str) -> Table:
    if robot.table is None:
        raise RobotError(f"robot '{robot.name}' has no table to look for in '{name}'; state it in the robot file, or give the "
                         "object's points alone")
    return robot.table


def _solid(points: Float[np.ndarray, "n 3"], table: float) -> list[ObjectModel]:
    """What stands above a table of this height [m], solid down to it, as one thing; nothing for no points."""
    points = points[points[:, 2] > table]
    if not len(points):
        return []
    cells, column = np.unique(np.floor(points[:, :2] / VOXEL).astype(int), axis=0, return_inverse=True)
    tops = np.full(len(cells), -np.inf)
    np.maximum.at(tops, column.ravel(), points[:, 2])
    heights = [np.arange(top, min(table, top - VOXEL), -VOXEL) for top in tops]
    rows = [np.column_stack([np.tile((cell + 0.5) * VOXEL, (len(z), 1)), z]) for cell, z in zip(cells, heights, strict=True)]
    solid = np.concatenate(rows).astype(np.float32)  # of any size, unlike what is grasped
    return [ObjectModel("other things", solid, np.zeros_like(solid), solid.mean(0, dtype=np.float64), content_hash(solid))]
