"""A page that shows grasps of one hand on one object: filters, postures, contacts, trials, downloads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, cast, get_args

import numpy as np
import torch
import viser
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.apps.viewer.constraint_panel import ANY
from dro_grasp.apps.viewer.scene_view import HOST, Client, Page, ServedPage, SharedPage, escaped, serve
from dro_grasp.errors import OptionError
from dro_grasp.frames import HALF_AXES, half_axis
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import CONTACT_LINKS, REASON
from dro_grasp.grasps.controller import complete
from dro_grasp.grasps.export.formats import FORMATS, ExportJob
from dro_grasp.grasps.export.writers import Frame
from dro_grasp.grasps.forces import forces_in_words, known
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import checked
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pictures.sheets import after_closing, contact_points, outcome, protocol_name, shows_held
from dro_grasp.simulation.trial import record

Posture = Literal["held", "open", "pregrasp", "grasp", "squeeze"]
"""Stages of closing the hand; the first is that after closing in a trial."""
GRASP_FILE = "grasp file (Parquet)"  # Choice of the grasp file itself among the formats that can be downloaded
EXPORTS = (GRASP_FILE, *(form.title for form in FORMATS.values() if not form.file_per_grasp))  # What can be downloaded


@dataclass(frozen=True)
class ShownGrasps:
    """Grasps on the page, with the outcome of their trials; bare clouds have none."""

    hand: Hand
    obj: ObjectModel
    raw: GraspBatch  # As the network proposed them, in the order of the refined ones
    refined: GraspBatch  # Best score first
    protocol: str  # Protocol of the trials
    shortage: str | None = None  # Why there are fewer than were asked for
    on_table: bool = False  # Whether a table is shown below them
    predicted: Float[Tensor, "n n_points 3"] | None = None
    """Hand points multilaterated from D(R,O), before the solver [m]; files do not store them."""


class Film(NamedTuple):
    """A trial that was played: the grasp's wrist, the object's poses in the wrist's frame [m], and the hand's joints."""

    T_object_wrist: Float[Tensor, "4 4"]
    poses: Float[Tensor, "frames 4 4"]
    joints: Float[Tensor, "frames n_dof"]


class GraspPage(Page):
    """A page with a folder of controls for the grasps that it shows."""

    frame_seconds = 0.04  # Time between two pictures of a trial [s] (ours)

    def __init__(self, client: Client) -> None:
        super().__init__(client)
        self.made: ShownGrasps | None = None
        self.shown: list[int] = []
        with client.atomic():  # the browser gets no control before all are connected
            self._add_choices()
            self.status = client.gui.add_markdown("")
            self._add_display()

    def _add_choices(self) -> None:
        """Add controls above those of the grasps."""

    def _add_display(self) -> None:
        gui = self.client.gui
        with gui.add_folder("Display"):
            self.success = gui.add_dropdown("Show", ("all", "succeeded", "failed"), initial_value="all")
            self.palm = gui.add_dropdown("Palm along", (ANY, *HALF_AXES), initial_value=ANY)
            self.slider = gui.add_slider("Grasp", 0, 1, 1, 0, disabled=True, hint="Best score first.")
            self.stage_of = gui.add_button_group("Stage", ("network", "refined"))
            self.posture = gui.add_dropdown("Posture", get_args(Posture), initial_value="held", hint="held: after closing.")
            self.shapes = gui.add_checkbox("Hand shapes", True)
            self.points = gui.add_checkbox("Hand points", False, hint="The hand's surface points.")
            self.predicted = gui.add_checkbox("Predicted points", False, hint="As the network saw the hand; files lack them.")
            self.contacts = gui.add_checkbox("Contacts", False, hint="Points of the hand within 2 mm of the object.")
            self._add_player("Play the trial")
            self.text = gui.add_markdown("")
        with gui.add_folder("Download"):
            self.format = gui.add_dropdown("Format", EXPORTS, initial_value=GRASP_FILE)
            self.download = gui.add_button("Download the shown grasps", disabled=True)
        self.stage_of.value = "refined"
        for choice in (self.success, self.palm):
            choice.on_update(lambda _: self._filter())
        self.slider.on_update(lambda _: self._show())
        self.stage_of.on_click(lambda _: self._show())
        for shown in (self.posture, self.shapes, self.points, self.predicted, self.contacts):
            shown.on_update(lambda _: self._show())
        self.download.on_click(lambda event: self._guarded(lambda: self._send(event)))

    def _present(self) -> None:
        """Put the pair of the grasps on the stage, and show the first grasp."""
        assert self.made is not None
        if len(first := self.made.refined):
            joints, T = first.joints[0].float(), first.T_object_wrist[0].float()
            self.view.set_pair(self.made.hand, self.made.obj, joints, T, self.made.on_table)
        self._filter()

    def _filter(self) -> None:
        """Show the grasps that pass the filters."""
        if self.made is None:
            return
        keep = chosen(self.made.hand, self.made.refined, self.success.value, self.palm.value)
        self.shown = keep.nonzero()[:, 0].tolist()
        some = bool(self.shown)
        self.slider.max = max(1, len(self.shown) - 1)
        self.slider.disabled = len(self.shown) < 2
        self.play.disabled = not some or self.made.obj.is_cloud
        self.download.disabled = not some
        self.slider.value = 0
        if some:
            self._show()
        else:
            self._forget_film()
            self.text.content = "No grasp passes these filters."

    def _picked(self) -> int | None:
        """Row of the picked grasp; None if none passes the filters."""
        return self.shown[min(int(self.slider.value), len(self.shown) - 1)] if self.shown else None

    def _batch(self) -> GraspBatch:
        assert self.made is not None
        return self.made.raw if self.stage_of.value == "network" else self.made.refined

    def _show(self) -> None:
        """Move the hand to the picked grasp."""
        index = self._picked()
        if self.made is None or index is None:
            return
        hand, obj, grasps, posture = self.made.hand, self.made.obj, self._batch(), self.posture.value
        grasp = grasps[index]
        if posture == "held":
            grasp = after_closing(hand, obj, grasp) if shows_held(hand, None) else grasp
            joints = grasp.joints[0].float()
        else:
            joints = postures_of(hand, obj, grasp)[posture][0]
        T = grasp.T_object_wrist[0].float()
        if self.made is None or self._picked() != index or self._batch() is not grasps or self.posture.value != posture:
            return  # something else was chosen meanwhile, which is shown
        self._forget_film()
        with self.client.atomic():
            self.view.show(joints, T)
            self.view.show_shapes(self.shapes.value)
            self.view.solved.visible = self.points.value
            self.view.contacts.visible = self.contacts.value
            self.view.predicted.visible = self.predicted.value and self.made.predicted is not None
            if self.made.predicted is not None:
                self.view.predicted.points = self.made.predicted[index].numpy().astype(np.float32)
            if self.contacts.value:
                self.view.contacts.points = contact_points(hand, obj, joints, T).astype(np.float32)
            self.view.colour_grid(outcome(grasps, index))
            self.text.content = f"{describe(grasps, index)}  \nposture: {posture}"

    def _play(self) -> None:
        """Play the trial of the picked grasp, until another choice is made."""
        index = self._picked()
        if self.made is None or index is None:
            return
        grasps, protocol = self._batch(), self.made.protocol
        self._say(f"Playing the trial under *{escaped(protocol)}*.")
        if (film := self.film) is None:
            film = Film(grasps.T_object_wrist[index].float(), *record(self.made.hand, self.made.obj, grasps, index, protocol))
            self.film, self.moment.max, self.moment.disabled = film, len(film.poses) - 1, False
            if self._picked() != index or self._batch() is not grasps:  # while it was recorded
                self._forget_film()
        if self._roll(film, len(film.poses), self.frame_seconds):
            self._say("Played. Move *Moment* to see any moment again.")
        else:
            self._say("Stopped: something else was picked.")

    def show_moment(self, moment: int) -> None:
        """Show a moment of the trial that was played."""
        if (film := self.film) is None:
            return
        self.view.contacts.visible = self.view.predicted.visible = False
        self.view.show(film.joints[moment], film.T_object_wrist, film.T_object_wrist @ film.poses[moment])

    def _forget_film(self) -> None:
        """No trial was played of what is shown now."""
        self.film, self.moment.disabled, self.moment.value = None, True, 0

    def _send(self, event: viser.GuiEvent) -> None:
        """Send the shown grasps to the browser."""
        assert self.made is not None
        name, content = exported(self.made.hand, self.made.obj, self._batch()[self.shown], self.format.value)
        if event.client is not None:
            event.client.send_file_download(name, content, save_immediately=True)
        self._say(f"{escaped(name)}: {len(self.shown)} grasps.")


def exported(hand: Hand, obj: ObjectModel, grasps: GraspBatch, kind: str) -> tuple[str, bytes]:
    """Name and content of a file with grasps, in one of EXPORTS.

    A grasp file has what they state; for other software, the controller makes the pregrasps and squeezes that they lack.
    """
    stem = f"{Path(hand.name).name}_{Path(obj.name).name}"
    if kind == GRASP_FILE:
        return f"{stem}.parquet", grasps.to_bytes()
    grasps = complete(hand, grasps, torch.as_tensor(obj.centre_of_mass, dtype=grasps.joints.dtype))
    name, form = next((name, form) for name, form in FORMATS.items() if form.title == kind)
    content = form.content(ExportJob(grasps, Frame(), hand, obj.name, obj=obj))
    return f"{stem}_{name}{form.suffix}", cast(bytes, content)


def chosen(hand: Hand, grasps: GraspBatch, success: str, palm: str) -> Bool[Tensor, " n"]:
    """Grasps with an outcome (`all`, `succeeded`, `failed`) whose palm points along a half-axis (or `any`)."""
    keep = torch.ones(len(grasps), dtype=torch.bool)
    if success != "all":
        keep &= grasps.evaluated & (grasps.trial_success == (success == "succeeded"))
    if palm != ANY:
        keep &= half_axis(hand.palm_directions(grasps.T_object_wrist)) == HALF_AXES.index(palm)
    return keep


class GraspViewer(SharedPage, GraspPage):
    """The page of given grasps, served; `stop()` ends it.

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
            raise OptionError("there is no grasp to view; generate at least one")
        grasps.require_hand(hand)
        ServedPage.__init__(self, port, host)
        GraspPage.__init__(self, self.server)
        self.posture.value = "grasp"
        protocol = protocol_name(next(filter(None, grasps.protocol), ""))
        self.made = ShownGrasps(hand, obj, grasps, grasps, protocol, predicted=predicted_points)
        self.status.content = f"**{escaped(hand.name)}** on **{escaped(obj.name)}**"
        self._present()

    def show(self, index: int, posture: Posture | None = None) -> None:
        """Show one of the grasps that pass the filters, in the current posture or another."""
        self.slider.value, self.posture.value = index, posture or self.posture.value
        self._show()


@checked
def view_grasps(
    hand: Hand, obj: ObjectModel, grasps: GraspBatch, predicted_points: Float[Tensor, "n n_points 3"] | None = None,
    port: int = 8080, host: str = HOST,
) -> None:
    """Serve a page of grasps until Ctrl-C.

    Args:
        hand: The hand of the grasps.
        obj: Their object.
        grasps: One at least.
        predicted_points: Hand points multilaterated from D(R,O), before the solver [m].
        port: If it is taken, the next free one is used.
        host: Address to serve at; by default only this machine can connect.

    Raises:
        OptionError: There is no grasp, or port or host is invalid.
        GraspFileError: The grasps are of another hand.
    """
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
    if told := forces_in_words(known(grasps.payload[index]), known(grasps.squeeze_force[index])):
        lines.append(told)
    if links := (grasps.extra.get(CONTACT_LINKS) or [None] * len(grasps))[index]:
        lines.append(f"touched by {escaped(', '.join(links))}")
    if bool(grasps.fingers_in_contact[index].isfinite()):
        lines.append(f"fingers in contact {int(grasps.fingers_in_contact[index])}")
    return "  \n".join(lines)


def postures_of(hand: Hand, obj: ObjectModel, grasps: GraspBatch) -> dict[str, Float[Tensor, "n n_dof"]]:
    """Joints of every posture; the controller completes those that the grasps lack."""
    joints = grasps.joints.float()
    grasps = complete(hand, grasps, torch.as_tensor(obj.centre_of_mass, dtype=torch.float32))
    opened = hand.canonical_joints().expand_as(joints)
    return {"open": opened, "pregrasp": grasps.pregrasp_joints.float(), "grasp": joints,
            "squeeze": grasps.squeeze_joints.float()}
