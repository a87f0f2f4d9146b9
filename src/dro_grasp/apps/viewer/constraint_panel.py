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
TOUCHED = (0.3, 0.65, 0.4)  # Colour of the contact region (ours)
TABLE = (0.82, 0.80, 0.76)  # Colour of the table (ours)


class ConstraintPanel:
    """A folder of controls; empty fields ask for nothing."""

    def __init__(self, client: Client, changed: Callable[[], None]) -> None:
        """Add the controls to a page; `changed` is called when one has changed."""
        self.client, gui = client, client.gui
        with gui.add_folder("Constraints", expand_by_default=False):
            self.direction = gui.add_dropdown(
                "Palm direction", (ANY, *HALF_AXES), initial_value=ANY, hint="-z grasps from above.")
            self.max_tilt = gui.add_text(
                "Largest tilt [deg]", "", hint="Largest angle from the palm direction; empty: roughly along it.")
            self.table = gui.add_text("Table z [m]", "", hint="The hand stays above this height; empty: no table.")
            self.under = gui.add_button("Table under the object")
            self.contact_region = gui.add_text(
                "Contact region", "", hint="x y z radius [m], more after a semicolon: the only places to touch.")
            self.keep_out = gui.add_text(
                "Keep-out", "", hint="x y z radius [m], more after a semicolon: places to stay out of.")
            self.pregrasp_clearance = gui.add_text(
                "Pregrasp clearance [mm]", "", hint="Least distance from closing fingers to the object, before.")
            self.obstacles = gui.add_dropdown(
                "Obstacles", tuple([NOTHING]), initial_value=NOTHING, hint="A scene without the object.")
            self.upload = gui.add_upload_button("Upload a scene of obstacles", mime_type=OBJECT_FILES)
        for control in (self.table, self.contact_region, self.keep_out, self.obstacles):
            control.on_update(lambda event: None if event.client is None else changed())

    def constraints(self, scene: Callable[[str], Scene]) -> Constraints:
        """What the controls ask for; `scene` is the scene of a name.

        Raises:
            OptionError: A field holds something else than numbers, or they are out of range.
        """
        tilt, table, clearance = (given_number(field) for field in (self.max_tilt, self.table, self.pregrasp_clearance))
        return Constraints(
            direction=None if self.direction.value == ANY else half_axis_direction(self.direction.value), table=table,
            max_tilt=None if tilt is None else math.radians(tilt),
            obstacles=None if self.obstacles.value == NOTHING else scene(self.obstacles.value),
            contact_region=_balls(self.contact_region), keep_out=_balls(self.keep_out),
            pregrasp_clearance=None if clearance is None else clearance / 1000)

    def draw(self, constraints: Constraints, obj: ObjectModel) -> None:
        """Show table, places and scene beside the object."""
        scene = self.client.scene
        scene.remove_by_name("/constraints")
        if constraints.table is not None:
            x, y, _ = obj.cloud.mean(0).tolist()
            scene.add_box("/constraints/table", rgb(TABLE), (TABLE_SIZE, TABLE_SIZE, 0.004),
                          position=(x, y, constraints.table - 0.002))
        for name, colour in (("contact_region", TOUCHED), ("keep_out", AVOIDED)):
            for i, (x, y, z, radius) in enumerate(getattr(constraints, name)):
                scene.add_icosphere(f"/constraints/{name}{i}", radius, rgb(colour), opacity=0.4, position=(x, y, z))
        if (around := constraints.obstacles) is not None and around.faces is not None:
            scene.add_mesh_simple(
                "/constraints/obstacles", around.points, around.faces, color=rgb(AVOIDED), opacity=0.6, side="double")
        elif around is not None:
            scene.add_point_cloud("/constraints/obstacles", around.points.astype(np.float32), rgb(AVOIDED), point_size=0.004)


def given_number(field: viser.GuiTextHandle) -> float | None:
    """The number of a field; None for an empty one. OptionError: it holds something else."""
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
