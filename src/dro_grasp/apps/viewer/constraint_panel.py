"""Controls for what grasps have to respect, and how that looks beside the object."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import viser

from dro_grasp.apps.viewer.scene_view import Client, rgb
from dro_grasp.errors import OptionError
from dro_grasp.frames import HALF_AXES, half_axis_direction
from dro_grasp.geometry.distance_field import Ball
from dro_grasp.objects.scenery import Scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.constraints import Constraints

ANY: str = "any"  # The choice of every palm direction
NOTHING: str = "nothing"  # The choice of no scene
OBJECT_FILES = ".stl,.obj,.ply,.glb,.off,.npy,.pcd"  # Files of objects and scenes that a browser offers to upload
TABLE_SIZE = 0.5  # Edge of the table that is drawn [m] (ours)
AVOIDED = (0.75, 0.35, 0.3)  # Colour of what the hand stays clear of (ours)
HELD = (0.3, 0.65, 0.4)  # Colour of the place to hold (ours)
TABLE = (0.82, 0.80, 0.76)  # Colour of the table (ours)


class ConstraintPanel:
    """A folder of controls; empty fields ask for nothing."""

    def __init__(self, client: Client, changed: Callable[[], None]) -> None:
        """Add the controls to a page; `changed` is called when one has changed."""
        self.client, gui = client, client.gui
        with gui.add_folder("Constraints", expand_by_default=False):
            self.direction = gui.add_dropdown(
                "Palm direction", (ANY, *HALF_AXES), initial_value=ANY, hint="-z grasps from above.")
            self.cone = gui.add_text("Cone [deg]", "", hint="Largest angle from the palm direction; empty: roughly along it.")
            self.table = gui.add_text("Table z [m]", "", hint="The hand stays above this height; empty: no table.")
            self.under = gui.add_button("Table under the object")
            self.hold = gui.add_text("Hold", "", hint="x y z radius [m], more after a semicolon: the only places to touch.")
            self.spare = gui.add_text("Spare", "", hint="x y z radius [m], more after a semicolon: places to stay out of.")
            self.opening = gui.add_text("Opening [mm]", "", hint="Least distance from closing fingers to the object, before.")
            self.avoid = gui.add_dropdown("Avoid", tuple([NOTHING]), initial_value=NOTHING, hint="A scene without the object.")
            self.upload = gui.add_upload_button("Upload a scene to avoid", mime_type=OBJECT_FILES)
        for control in (self.table, self.hold, self.spare, self.avoid):
            control.on_update(lambda event: None if event.client is None else changed())

    def constraints(self, scene: Callable[[str], Scene]) -> Constraints:
        """What the controls ask for; `scene` is the scene of a name.

        Raises:
            OptionError: A field holds something else than numbers, or they are out of range.
        """
        cone, table, opening = (_number(field) for field in (self.cone, self.table, self.opening))
        return Constraints(
            None if self.direction.value == ANY else half_axis_direction(self.direction.value), table,
            None if cone is None else math.radians(cone), None if self.avoid.value == NOTHING else scene(self.avoid.value),
            _balls(self.hold), _balls(self.spare), None if opening is None else opening / 1000)

    def draw(self, constraints: Constraints, obj: ObjectModel) -> None:
        """Show table, places and scene beside the object."""
        scene = self.client.scene
        scene.remove_by_name("/constraints")
        if constraints.table is not None:
            x, y, _ = obj.cloud.mean(0).tolist()
            scene.add_box("/constraints/table", rgb(TABLE), (TABLE_SIZE, TABLE_SIZE, 0.004),
                          position=(x, y, constraints.table - 0.002))
        for name, balls, colour in (("hold", constraints.hold, HELD), ("spare", constraints.spare, AVOIDED)):
            for i, (x, y, z, radius) in enumerate(balls):
                scene.add_icosphere(f"/constraints/{name}{i}", radius, rgb(colour), opacity=0.4, position=(x, y, z))
        if (avoid := constraints.avoid) is not None and avoid.faces is not None:
            scene.add_mesh_simple(
                "/constraints/avoid", avoid.points, avoid.faces, color=rgb(AVOIDED), opacity=0.6, side="double")
        elif avoid is not None:
            scene.add_point_cloud("/constraints/avoid", avoid.points.astype(np.float32), rgb(AVOIDED), point_size=0.004)


def _number(field: viser.GuiTextHandle) -> float | None:
    """The number of a field; None for an empty one."""
    numbers = _numbers(field, field.value)
    if len(numbers) > 1:
        raise OptionError(f"{field.label} is '{field.value}'; give one number, or nothing")
    return numbers[0] if numbers else None


def _balls(field: viser.GuiTextHandle) -> tuple[Ball, ...]:
    rows = [_numbers(field, part) for part in field.value.split(";") if part.strip()]
    if any(len(row) != 4 for row in rows):
        raise OptionError(f"{field.label} is '{field.value}'; give x y z radius in metres, for example 0 0 0.1 0.03; more "
                          "balls after a semicolon")
    return tuple((x, y, z, radius) for x, y, z, radius in rows)


def _numbers(field: viser.GuiTextHandle, text: str) -> list[float]:
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError as error:
        raise OptionError(f"{field.label} is '{field.value}', which holds something else than numbers; write for example "
                          "0.1") from error
