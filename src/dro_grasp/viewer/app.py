"""The browser viewer: a hand on an object, one grasp at a time. Served to this machine only."""

from __future__ import annotations

import contextlib
import sys
from typing import Literal, cast

import numpy as np
import torch
import viser
import viser.transforms
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.geometry.rasterizer import Colour
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.viewer.scene import (
    OBJECT_COLOUR,
    PREDICTED_COLOUR,
    SOLVED_COLOUR,
    best_camera,
    link_colours,
    link_shapes,
    object_meshes,
    success_colour,
)

HOST = "127.0.0.1"
"""Nobody else on the network can connect."""
POSTURES = ("open", "pregrasp", "grasp", "squeeze")
Posture = Literal["open", "pregrasp", "grasp", "squeeze"]
POINT_SIZE = 0.0022
"""[m]"""
CAMERA_DISTANCE = 1.15
"""How much farther than a picture's camera the viewer starts."""


class GraspViewer:
    """A running viewer; `stop()` ends it.

    Example:
        >>> viewer = GraspViewer(hand, obj, grasps)
        >>> viewer.show(3, "squeeze")
    """

    def __init__(
        self,
        hand: Hand,
        obj: ObjectModel,
        grasps: GraspBatch,
        predicted_points: Float[Tensor, "n n_points 3"] | None = None,
        port: int = 8080,
    ) -> None:
        """Start serving.

        Args:
            hand: The hand of the grasps.
            obj: Their object.
            grasps: At least one grasp, tried or not.
            predicted_points: The hand's points as the network placed them, before links and joints were solved [m].
            port: Port on localhost; the next free one is taken.

        Raises:
            OptionError: There is no grasp.
            GraspFileError: The grasps are of another hand.
        """
        if len(grasps) == 0:
            raise OptionError("there is no grasp to look at; generate at least one, or leave out --only-successful")
        grasps.require_hand(hand)
        self.hand, self.obj, self.grasps, self.predicted_points = hand, obj, grasps, predicted_points
        self.index = 0
        self.posture: Posture = "grasp"
        self._joints = _postures(hand, obj, grasps)
        # The server prints a banner on stdout, where commands promise a table or one JSON object.
        with contextlib.redirect_stdout(sys.stderr):
            self.server = viser.ViserServer(host=HOST, port=port, verbose=False)
        self._add_scene()
        self._add_controls()
        self.show(0, "grasp")

    @property
    def url(self) -> str:
        """Where to point the browser."""
        return f"http://{HOST}:{self.server.get_port()}"

    def show(self, index: int, posture: Posture | None = None) -> None:
        """Show one grasp, in the current posture or another."""
        self.index = index
        self.posture = posture or self.posture
        T, q = self.grasps.T_object_wrist[index].float(), self._joints[self.posture][index]
        with torch.no_grad():
            poses = (T @ self.hand.tree.forward(q)).double().numpy()
            points = self.hand.points(q, T).numpy()
        with self.server.atomic():
            for frame, pose in zip(self._frames, poses, strict=True):
                frame.position = pose[:3, 3]
                frame.wxyz = viser.transforms.SO3.from_matrix(pose[:3, :3]).wxyz
            self._solved.points = points.astype(np.float32)
            if self._predicted is not None and self.predicted_points is not None:
                self._predicted.points = self.predicted_points[index].numpy().astype(np.float32)
            colour = _rgb(success_colour(self._outcome(index)))
            self._grid.cell_color = self._grid.section_color = colour
            self._text.content = describe(self.grasps, index)

    def stop(self) -> None:
        """Stop serving and free the port."""
        self.server.stop()

    def _outcome(self, index: int) -> bool | None:
        success = self.grasps.success
        return bool(success[index]) if success is not None and bool(self.grasps.tried[index]) else None

    def _add_scene(self) -> None:
        scene = self.server.scene
        scene.set_up_direction("+z")
        for i, mesh in enumerate(object_meshes(self.obj)):
            scene.add_mesh_simple(f"/object/{i}", mesh.vertices, mesh.faces, color=_rgb(OBJECT_COLOUR), side="double")
        colours = link_colours(self.hand)
        self._frames = [scene.add_frame(f"/hand/{i}", show_axes=False) for i in range(self.hand.tree.n_links)]
        for k, (link, vertices, faces) in enumerate(link_shapes(self.hand)):
            scene.add_mesh_simple(f"/hand/{link}/{k}", vertices, faces, color=_rgb(colours[link]), side="double")
        self._solved = self._cloud("/solved", np.zeros((1, 3)), SOLVED_COLOUR)
        self._predicted = None
        if self.predicted_points is not None:
            self._predicted = self._cloud("/predicted", self.predicted_points[0].numpy(), PREDICTED_COLOUR)
        low = self.obj.cloud.min(0)
        position = (*self.obj.cloud.mean(0)[:2].tolist(), float(low[2]) - 0.12)
        self._grid = scene.add_grid("/grid", width=0.4, height=0.4, cell_size=0.05, section_size=0.1, position=position)
        camera = best_camera(self.hand, self._joints["grasp"][0], self.grasps.T_object_wrist[0].float(), self.obj)
        start, target = np.asarray(camera.position), np.asarray(camera.target)
        self.server.initial_camera.position = tuple((target + CAMERA_DISTANCE * (start - target)).tolist())
        self.server.initial_camera.look_at = camera.target
        self.server.initial_camera.fov = camera.field_of_view

    def _cloud(self, name: str, points: np.ndarray, colour: Colour) -> viser.PointCloudHandle:
        return self.server.scene.add_point_cloud(
            name, points.astype(np.float32), colors=_rgb(colour), point_size=POINT_SIZE, point_shape="circle",
            precision="float32", visible=False,
        )

    def _add_controls(self) -> None:
        gui = self.server.gui
        gui.add_markdown(f"**{self.hand.name}** on **{self.obj.name}**")
        last = max(1, len(self.grasps) - 1)
        slider = gui.add_slider("Grasp", 0, last, 1, 0, disabled=len(self.grasps) == 1, hint="Best score first.")
        postures = gui.add_button_group("Posture", POSTURES)
        self._text = gui.add_markdown("")
        shapes = gui.add_checkbox("Hand shapes", True)
        solved = gui.add_checkbox("Solved hand points", False, hint="The hand's surface points in this posture.")
        missing = self._predicted is None
        hint = "Only right after generating: files do not hold them." if missing else "As multilaterated from D(R,O)."
        predicted = gui.add_checkbox("Predicted points", False, disabled=missing, hint=hint)
        slider.on_update(lambda _: self.show(int(slider.value)))
        postures.on_click(lambda _: self.show(self.index, cast(Posture, postures.value)))
        shapes.on_update(lambda _: self._set_visible(shapes.value))
        solved.on_update(lambda _: setattr(self._solved, "visible", solved.value))
        predicted.on_update(lambda _: setattr(self._predicted, "visible", predicted.value))

    def _set_visible(self, visible: bool) -> None:
        with self.server.atomic():
            for frame in self._frames:
                frame.visible = visible


def view_grasps(
    hand: Hand,
    obj: ObjectModel,
    grasps: GraspBatch,
    predicted_points: Float[Tensor, "n n_points 3"] | None = None,
    port: int = 8080,
) -> None:
    """Serve the viewer until Ctrl-C; arguments as for `GraspViewer`."""
    viewer = GraspViewer(hand, obj, grasps, predicted_points, port)
    print(f"viewer: {viewer.url} (Ctrl-C ends it)", file=sys.stderr, flush=True)
    try:
        viewer.server.sleep_forever()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.stop()


def describe(grasps: GraspBatch, index: int) -> str:
    """What is known of one grasp, as Markdown."""
    lines = [f"**Grasp {index}** of {len(grasps)}"]
    tried = grasps.success is not None and bool(grasps.tried[index])
    if tried and grasps.success is not None and grasps.protocol is not None:
        lines.append(f"**{'success' if grasps.success[index] else 'failed'}** under {grasps.protocol[index]}")
    else:
        lines.append("not tried")
    values = {"score": (grasps.score, 1.0, ""), "displacement": (grasps.displacement, 1e3, " mm"),
              "rotation": (grasps.rotation, 180 / np.pi, "°"), "penetration": (grasps.penetration, 1e3, " mm")}
    for name, (column, factor, unit) in values.items():
        if column is not None and bool(column[index].isfinite()):
            lines.append(f"{name} {float(column[index]) * factor:.2f}{unit}")
    return "  \n".join(lines)


def _postures(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> dict[Posture, Float[Tensor, "n n_dof"]]:
    """Joints of every posture; the controller makes those that the grasps lack."""
    joints = grasps.joints.float()
    before, after = grasps.pregrasp_joints, grasps.squeeze_joints
    if before is None or after is None or not bool(before.isfinite().all() and after.isfinite().all()):
        centre = torch.as_tensor(obj.centre_of_mass, dtype=torch.float32)
        before, after = pregrasp_and_squeeze(hand, grasps.T_object_wrist.float(), joints, centre)
    opened = hand.canonical_joints().expand_as(joints)
    return {"open": opened, "pregrasp": before.float(), "grasp": joints, "squeeze": after.float()}


def _rgb(colour: Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in colour)
    return red, green, blue
