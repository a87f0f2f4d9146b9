"""A page that shows grasps of one hand on one object: filters, postures, contacts, trials, downloads."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, cast

import torch
import viser
from jaxtyping import Bool, Float
from torch import Tensor

from dro_grasp.errors import DroGraspError
from dro_grasp.export.formats import FORMATS, ExportJob
from dro_grasp.export.writers import Frame
from dro_grasp.frames import HALF_AXES, half_axis
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.controller import completed
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.trial import record
from dro_grasp.viewer.app import POSTURES, Posture, describe, postures_of
from dro_grasp.viewer.constraint_panel import ANY
from dro_grasp.viewer.pictures import after_closing, contact_points, outcome, shows_held
from dro_grasp.viewer.scene_view import Client, SceneView, escaped

FRAME_TIME = 0.04
"""Time between two pictures of a trial [s] (ours)."""
HELD = "held"
"""The posture after closing."""
GRASP_FILE = "grasp file (Parquet)"
"""Choice of the grasp file itself among the formats that can be downloaded."""
EXPORTS = (GRASP_FILE, *(form.title for form in FORMATS.values() if not form.file_per_grasp))
"""What can be downloaded."""


@dataclass(frozen=True)
class ShownGrasps:
    """Grasps on the page, with the outcome of their trials; bare clouds have none."""

    hand: Hand
    obj: ObjectModel
    raw: GraspBatch
    """As the network proposed them, in the order of the refined ones."""
    refined: GraspBatch
    """Best score first."""
    protocol: str
    """Protocol of the trials."""
    shortage: str | None = None
    """Why there are fewer than were asked for."""
    on_table: bool = False
    """Whether a table is shown below them."""


class Film(NamedTuple):
    """A trial that was played."""

    T_object_wrist: Float[Tensor, "4 4"]
    """Wrist pose of its grasp [m]."""
    poses: Float[Tensor, "frames 4 4"]
    """Of the object, in the wrist's frame [m]."""
    joints: Float[Tensor, "frames n_dof"]
    """Of the hand [rad or m]."""


class Closed(Exception):
    """The page was closed while it worked."""


class GraspPage:
    """A page with a folder of controls for the grasps that it shows."""

    def __init__(self, client: Client) -> None:
        """Put scene and controls on a page."""
        self.client, self.view = client, SceneView(client)
        self.closed = threading.Event()
        """Whether nobody sees the page any more."""
        self.made: ShownGrasps | None = None
        self.shown: list[int] = []
        self.film: Film | None = None
        self._busy = threading.Lock()
        with client.atomic():  # the browser gets no control before all are connected
            self._add_choices()
            self.status = client.gui.add_markdown("")
            self._add_display()

    def _add_choices(self) -> None:
        """Controls above those of the grasps: none."""

    def _plain(self, text: str) -> str:
        """A message as it is shown."""
        return text

    def _add_display(self) -> None:
        gui = self.client.gui
        with gui.add_folder("Display"):
            self.success = gui.add_dropdown("Show", ("all", "succeeded", "failed"), initial_value="all")
            self.palm = gui.add_dropdown("Palm along", (ANY, *HALF_AXES), initial_value=ANY)
            self.slider = gui.add_slider("Grasp", 0, 1, 1, 0, disabled=True, hint="Best score first.")
            self.stage_of = gui.add_button_group("Stage", ("network", "refined"))
            self.posture = gui.add_dropdown("Posture", (HELD, *POSTURES), initial_value=HELD, hint="held: after closing.")
            self.points = gui.add_checkbox("Hand points", False, hint="The hand's surface points.")
            self.contacts = gui.add_checkbox("Contacts", False, hint="Points of the hand within 2 mm of the object.")
            self.play = gui.add_button("Play the trial", disabled=True)
            self.moment = gui.add_slider("Moment", 0, 1, 1, 0, disabled=True, hint="Of the trial, once it was played.")
            self.text = gui.add_markdown("")
        with gui.add_folder("Download"):
            self.format = gui.add_dropdown("Format", EXPORTS, initial_value=GRASP_FILE)
            self.download = gui.add_button("Download the shown grasps", disabled=True)
        self.stage_of.value = "refined"
        for choice in (self.success, self.palm):
            choice.on_update(lambda _: self._filter())
        self.slider.on_update(lambda _: self._show())
        self.stage_of.on_click(lambda _: self._show())
        for shown in (self.posture, self.points, self.contacts):
            shown.on_update(lambda _: self._show())
        self.moment.on_update(lambda event: None if event.client is None else self._show_moment(int(self.moment.value)))
        self.play.on_click(lambda _: self._guarded(self._play))
        self.download.on_click(lambda event: self._guarded(lambda: self._send(event)))

    def _guarded(self, work: Callable[[], None], patience: float = 0.0, otherwise: str = "Busy; wait a moment.") -> None:
        """Do one thing at a time, and show errors on the page.

        Args:
            work: What to do.
            patience: Time to wait for the end of other work [s].
            otherwise: What is said if it does not end.
        """
        with suppress(Closed):
            if not self._busy.acquire(timeout=patience):
                self._say(otherwise)
                return
            try:
                work()
            except DroGraspError as error:
                self._complain(error)
            finally:
                self._busy.release()

    def _complain(self, error: DroGraspError) -> None:
        """Show an error."""
        self._say(f"**Error:** {escaped(self._plain(str(error)))}")

    def _say(self, text: str) -> None:
        """Show a line.

        Raises:
            Closed: Nobody sees it any more; whatever goes on ends here.
        """
        if self.closed.is_set():
            raise Closed
        self.status.content = text

    def _present(self) -> None:
        """Put the pair of the grasps on the stage, and show the first grasp."""
        assert self.made is not None
        first = self.made.refined
        if len(first):
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
        shown = self.shown
        return shown[min(int(self.slider.value), len(shown) - 1)] if shown else None

    def _batch(self) -> GraspBatch:
        assert self.made is not None
        return self.made.raw if self.stage_of.value == "network" else self.made.refined

    def _show(self) -> None:
        """Move the hand to the picked grasp."""
        index = self._picked()
        if self.made is None or index is None:
            return
        hand, obj, grasps = self.made.hand, self.made.obj, self._batch()
        grasp, posture = grasps[index], self.posture.value
        if posture == HELD:
            grasp = after_closing(hand, obj, grasp) if shows_held(hand, None) else grasp
            joints = grasp.joints[0].float()
        else:
            joints = postures_of(hand, obj, grasp)[cast(Posture, posture)][0]
        T = grasp.T_object_wrist[0].float()
        self._forget_film()
        with self.client.atomic():
            self.view.show(joints, T)
            self.view.solved.visible = self.points.value
            self.view.contacts.visible = self.contacts.value
            if self.contacts.value:
                self.view.contacts.points = contact_points(hand, obj, joints, T).astype("float32")
            self.view.colour_grid(outcome(grasps, index))
            self.text.content = f"{describe(grasps, index)}  \nposture: {posture}"

    def _play(self) -> None:
        """Play the trial of the picked grasp, until another choice is made."""
        index = self._picked()
        if self.made is None or index is None:
            return
        grasps, protocol = self._batch(), self.made.protocol
        self._say(f"Playing the trial under *{escaped(protocol)}*.")
        film = Film(grasps.T_object_wrist[index].float(), *record(self.made.hand, self.made.obj, grasps, index, protocol))
        last = len(film.poses) - 1
        self.film, self.moment.max, self.moment.disabled = film, last, False
        if self._picked() != index:  # while it was recorded
            self._forget_film()
        for moment in range(last + 1):
            if self.film is not film:
                self._say("Stopped: something else was picked.")
                return
            self._show_moment(moment)
            self.moment.value = moment
            time.sleep(FRAME_TIME)
        self._say("Played. Move *Moment* to see any moment again.")

    def _show_moment(self, moment: int) -> None:
        """Show a moment of the trial that was played."""
        if (film := self.film) is None:
            return
        self.view.contacts.visible = False
        self.view.show(film.joints[moment], film.T_object_wrist, film.T_object_wrist @ film.poses[moment])

    def _forget_film(self) -> None:
        """No trial was played of what is shown now."""
        self.film, self.moment.disabled, self.moment.value = None, True, 0

    def _send(self, event: viser.GuiEvent) -> None:
        """Send the shown grasps to the browser."""
        name, content = self.exported(self.format.value)
        if event.client is not None:
            event.client.send_file_download(name, content, save_immediately=True)
        self._say(f"{escaped(name)}: {len(self.shown)} grasps.")

    def exported(self, kind: str) -> tuple[str, bytes]:
        """Name and content of a file with the shown grasps, in one of EXPORTS.

        A grasp file has what they state; for other software, the controller makes the pregrasps and squeezes that they lack.
        """
        assert self.made is not None
        grasps = self._batch()[self.shown]
        stem = f"{Path(self.made.hand.name).name}_{Path(self.made.obj.name).name}"
        if kind == GRASP_FILE:
            return f"{stem}.parquet", grasps.to_bytes()
        centre = torch.as_tensor(self.made.obj.centre_of_mass, dtype=grasps.joints.dtype)
        grasps = completed(self.made.hand, grasps, centre)
        name, form = next((name, form) for name, form in FORMATS.items() if form.title == kind)
        content = form.content(ExportJob(grasps, Frame(), self.made.hand))
        return f"{stem}_{name}{form.suffix}", cast(bytes, content)


def chosen(hand: Hand, grasps: GraspBatch, success: str, palm: str) -> Bool[Tensor, " n"]:
    """Grasps with an outcome (`all`, `succeeded`, `failed`) whose palm points along a half-axis (or `any`)."""
    keep = torch.ones(len(grasps), dtype=torch.bool)
    if success != "all":
        keep &= grasps.evaluated & (grasps.trial_success == (success == "succeeded"))
    if palm != ANY:
        keep &= half_axis(hand.palm_directions(grasps.T_object_wrist)) == HALF_AXES.index(palm)
    return keep
