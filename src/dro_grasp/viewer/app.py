"""The browser viewer: the grasps of one hand on one object, one at a time."""

from __future__ import annotations

from typing import Literal, cast, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CONTACT_LINKS, REASON
from dro_grasp.grasps.controller import completed
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.viewer.appearance import PREDICTED_COLOUR
from dro_grasp.viewer.pictures import outcome
from dro_grasp.viewer.scene_view import HOST, ServedPage, escaped, serve

Posture = Literal["open", "pregrasp", "grasp", "squeeze"]
"""Stages of closing the hand that the viewer shows."""
POSTURES: tuple[Posture, ...] = get_args(Posture)
"""All postures, from open to closed."""


class GraspViewer(ServedPage):
    """A running viewer; `stop()` ends it.

    Examples:
        >>> viewer = GraspViewer(hand, obj, grasps)
        >>> viewer.show(3, "squeeze")
    """

    def __init__(
        self, hand: Hand, obj: ObjectModel, grasps: GraspBatch, predicted_points: Float[Tensor, "n n_points 3"] | None = None,
        port: int = 8080, host: str = HOST,
    ) -> None:
        """Start serving.

        Args:
            predicted_points: Hand points multilaterated from D(R,O), before the solver [m].
            port: As `ServedPage` takes it; `host` likewise.

        Raises:
            OptionError: There is no grasp, or the port or host is invalid.
            GraspFileError: The grasps belong to another hand.
        """
        if len(grasps) == 0:
            raise OptionError("there is no grasp to view; generate at least one, or leave out --only-successful")
        grasps.require_hand(hand)
        self.hand, self.obj, self.grasps, self.predicted_points = hand, obj, grasps, predicted_points
        self.index = 0
        self.posture: Posture = "grasp"
        self._joints = postures_of(hand, obj, grasps)
        super().__init__(port, host)
        self.view.set_pair(hand, obj, self._joints["grasp"][0], grasps.T_object_wrist[0].float())
        self._predicted = None
        if predicted_points is not None:
            self._predicted = self.view.cloud("predicted", predicted_points[0].numpy(), PREDICTED_COLOUR)
        self._add_controls()
        self.show(0, "grasp")

    def show(self, index: int, posture: Posture | None = None) -> None:
        """Show one grasp, in the current posture or another."""
        self.index = index
        self.posture = posture or self.posture
        with self.server.atomic():
            self.view.show(self._joints[self.posture][index], self.grasps.T_object_wrist[index].float())
            if self._predicted is not None and self.predicted_points is not None:
                self._predicted.points = self.predicted_points[index].numpy().astype(np.float32)
            self.view.colour_grid(outcome(self.grasps, index))
            self._text.content = describe(self.grasps, index)

    def _add_controls(self) -> None:
        gui = self.server.gui
        gui.add_markdown(f"**{escaped(self.hand.name)}** on **{escaped(self.obj.name)}**")
        last = max(1, len(self.grasps) - 1)
        slider = gui.add_slider("Grasp", 0, last, 1, 0, disabled=len(self.grasps) == 1, hint="Best score first.")
        postures = gui.add_button_group("Posture", POSTURES)
        self._text = gui.add_markdown("")
        shapes = gui.add_checkbox("Hand shapes", True)
        solved = gui.add_checkbox("Solved hand points", False, hint="The hand's surface points in this posture.")
        missing = self._predicted is None
        hint = "Files do not store them." if missing else "Multilaterated from D(R,O)."
        predicted = gui.add_checkbox("Predicted points", False, disabled=missing, hint=hint)
        slider.on_update(lambda _: self.show(int(slider.value)))
        postures.on_click(lambda _: self.show(self.index, cast(Posture, postures.value)))
        shapes.on_update(lambda _: self.view.show_shapes(shapes.value))
        solved.on_update(lambda _: setattr(self.view.solved, "visible", solved.value))
        predicted.on_update(lambda _: setattr(self._predicted, "visible", predicted.value))


@checked
def view_grasps(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, predicted_points: Float[Tensor, "n n_points 3"] | None = None,
    port: int = 8080, host: str = HOST,
) -> None:
    """Serve the viewer until Ctrl-C; arguments as for `GraspViewer`."""
    serve(GraspViewer(hand, obj, grasps, predicted_points, port, host))


def describe(grasps: GraspBatch, index: int) -> str:
    """Summary of one grasp, in Markdown."""
    lines = [f"**Grasp {index}** of {len(grasps)}"]
    if bool(grasps.evaluated[index]):
        why = (grasps.extra.get(REASON) or [""] * len(grasps))[index]
        outcome = "success" if grasps.success[index] else "failed"
        lines.append(f"**{outcome}** under {escaped(grasps.protocol[index])}{f': {escaped(why)}' if why else ''}")
    else:
        lines.append("not evaluated")
    values = {"confidence": (grasps.confidence, 100.0, " %"), "energy": (grasps.energy, 1.0, ""),
              "displacement": (grasps.displacement, 1e3, " mm"), "rotation": (grasps.rotation, 180 / np.pi, "°"),
              "penetration": (grasps.penetration, 1e3, " mm"), "robustness": (grasps.robustness, 100.0, " %")}
    for name, (column, factor, unit) in values.items():
        if bool(column[index].isfinite()):
            lines.append(f"{name} {float(column[index]) * factor:.2f}{unit}")
    if links := (grasps.extra.get(CONTACT_LINKS) or [None] * len(grasps))[index]:
        lines.append(f"touched by {escaped(', '.join(links))}")
    if bool(grasps.fingers_in_contact[index].isfinite()):
        lines.append(f"fingers in contact {int(grasps.fingers_in_contact[index])}")
    return "  \n".join(lines)


def postures_of(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> dict[Posture, Float[Tensor, "n n_dof"]]:
    """Joints of every posture; the controller completes those that the grasps lack."""
    joints = grasps.joints.float()
    grasps = completed(hand, grasps, torch.as_tensor(obj.centre_of_mass, dtype=torch.float32))
    opened = hand.canonical_joints().expand_as(joints)
    return {"open": opened, "pregrasp": grasps.pregrasp_joints.float(), "grasp": joints,
            "squeeze": grasps.squeeze_joints.float()}
