"""The whole tool in a page: pick or upload a hand and an object, generate grasps, watch their trials, download them."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import torch
import viser
from jaxtyping import Bool
from torch import Tensor

from dro_grasp.errors import DroGraspError
from dro_grasp.export.contents import Frame
from dro_grasp.export.formats import FORMATS, ExportJob
from dro_grasp.frames import HALF_AXES, half_axis, half_axis_direction
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import hand_names, load_hand
from dro_grasp.objects.catalogue import load_object, object_names
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pipeline.constraints import Constraints
from dro_grasp.pipeline.problem import GraspProblem
from dro_grasp.pipeline.stages import evaluate
from dro_grasp.predictor import GraspPredictor, GraspRequest, Method
from dro_grasp.simulation.diagnosis import diagnose
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS
from dro_grasp.simulation.trial import record
from dro_grasp.viewer.app import POSTURES, Posture, describe, postures_of
from dro_grasp.viewer.pictures import outcome
from dro_grasp.viewer.stage import HOST, ServedPage
from dro_grasp.viewer.uploads import store_upload

FRAME_TIME = 0.04
"""Time between two pictures of a trial [s] (ours)."""
ANY = "any"
"""The choice of every palm direction."""
GRASP_FILE = "grasp file (Parquet)"
"""Choice of the grasp file itself among the formats that can be downloaded."""
EXPORTS = (GRASP_FILE, *(form.title for form in FORMATS.values() if not form.file_per_grasp))
"""What can be downloaded."""
LARGEST_CALL = 64
"""Most grasps of one click (ours)."""
MOST_CANDIDATES = 8
"""Most candidates for each of them (ours)."""


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


class Studio(ServedPage):
    """A running page; `stop()` ends it.

    Example:
        >>> studio = Studio()
        >>> studio.generate("allegro", "mug", num=8)
    """

    def __init__(
        self, hand: str = "allegro", obj: str = "rubber_duck", weights: str | None = None, port: int = 8080, host: str = HOST,
        device: str = "cpu",
    ) -> None:
        """Start serving with a hand and an object chosen.

        Args:
            hand: Name or path; the object likewise.
            weights: As `GraspPredictor` takes them; the device likewise.
            port: As `ServedPage` takes it; the host likewise.
        """
        self.predictor = GraspPredictor(weights, device)
        self.made: ShownGrasps | None = None
        self.shown: list[int] = []
        self._folder = tempfile.TemporaryDirectory(prefix="dro-grasp-")
        self._busy = threading.Lock()
        self._uploads = 0
        super().__init__(port, host)
        self._add_choices(hand, obj)
        self._add_display()
        self._say("Pick a hand and an object, or upload your own, and press *Generate*.")

    def stop(self) -> None:
        """Stop serving and delete the uploads."""
        super().stop()
        self._folder.cleanup()

    def generate(
        self, hand: str, obj: str, num: int = GraspRequest.num, direction: str = ANY, temperature: float | None = None,
        protocol: str = DEFAULT_PROTOCOL, candidates: int = GraspRequest.candidates,
        method: Method = GraspRequest.method,
    ) -> ShownGrasps:
        """Predict, refine, rank and evaluate, then show the best; bare clouds get no trial.

        Args:
            direction: One of HALF_AXES, or `any`.
            temperature: Of z; the weights' own by default.
            candidates: Proposed for each grasp.
            method: Their source, as in `GraspRequest`.

        Raises:
            DroGraspError: An argument cannot be used.
        """
        along = None if direction == ANY else half_axis_direction(direction)
        problem = GraspProblem(load_hand(hand), load_object(obj), self.predictor.device, Constraints(along))
        request = GraspRequest(num, candidates=candidates, temperature=temperature, method=method)
        found = self.predictor.run(problem, request)
        raw, refined = found.proposed, found.grasps
        if not problem.obj.is_cloud:
            raw, refined = (evaluate(problem, grasps, protocol) for grasps in (raw, refined))
        self.made = ShownGrasps(problem.hand, problem.obj, raw, refined, protocol)
        self.stage.set_pair(problem.hand, problem.obj, refined.joints[0].float(), refined.T_object_wrist[0].float())
        self._filter()
        return self.made

    def _add_choices(self, hand: str, obj: str) -> None:
        gui = self.server.gui
        with gui.add_folder("Hand and object"):
            self.hand = gui.add_dropdown("Hand", tuple(hand_names()), initial_value=hand)
            hand_file = gui.add_upload_button("Upload a hand (URDF, MJCF, ZIP)", mime_type=".urdf,.xml,.zip")
            self.object = gui.add_dropdown("Object", tuple(object_names()), initial_value=obj)
            kinds = ".stl,.obj,.ply,.glb,.off,.npy,.pcd"
            object_file = gui.add_upload_button("Upload an object (STL, OBJ, PLY)", mime_type=kinds)
        with gui.add_folder("Generate"):
            self.num = gui.add_slider("Grasps", 1, LARGEST_CALL, 1, GraspRequest.num)
            self.method = gui.add_dropdown(
                "Method", get_args(Method), initial_value=GraspRequest.method,
                hint="auto: the optimiser helps where the network is unsure.")
            self.candidates = gui.add_slider(
                "Candidates", 1, MOST_CANDIDATES, 1, GraspRequest.candidates,
                hint="Candidates proposed for each grasp; the best by score are kept.")
            self.direction = gui.add_dropdown(
                "Palm direction", (ANY, *HALF_AXES), initial_value=ANY, hint="-z grasps from above.")
            self.usual = gui.add_checkbox("Usual diversity", True, hint="1 for a mesh, less for a bare point cloud.")
            self.temperature = gui.add_slider(
                "Diversity", 0.0, 1.0, 0.05, 1.0, disabled=True, hint="0: the likeliest grasp of each placement.")
            self.protocol = gui.add_dropdown("Trial", tuple(PROTOCOLS), initial_value=DEFAULT_PROTOCOL)
            self.button = gui.add_button("Generate", color="green")
        self.status = gui.add_markdown("")
        hand_file.on_upload(lambda _: self._guarded(lambda: self._take(hand_file.value, self.hand)))
        object_file.on_upload(lambda _: self._guarded(lambda: self._take(object_file.value, self.object)))
        self.button.on_click(lambda _: self._guarded(self._generate))
        self.usual.on_update(lambda _: setattr(self.temperature, "disabled", self.usual.value))

    def _add_display(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Display"):
            self.success = gui.add_dropdown("Show", ("all", "succeeded", "failed"), initial_value="all")
            self.palm = gui.add_dropdown("Palm along", (ANY, *HALF_AXES), initial_value=ANY)
            self.slider = gui.add_slider("Grasp", 0, 1, 1, 0, disabled=True, hint="Best score first.")
            self.stage_of = gui.add_button_group("Stage", ("network", "refined"))
            self.posture = gui.add_button_group("Posture", POSTURES)
            self.play = gui.add_button("Play the trial", disabled=True)
            self.text = gui.add_markdown("")
        with gui.add_folder("Download"):
            self.format = gui.add_dropdown("Format", EXPORTS, initial_value=GRASP_FILE)
            self.download = gui.add_button("Download the shown grasps", disabled=True)
        self.stage_of.value = "refined"
        self.posture.value = "grasp"
        for choice in (self.success, self.palm):
            choice.on_update(lambda _: self._filter())
        self.slider.on_update(lambda _: self._show())
        self.stage_of.on_click(lambda _: self._show())
        self.posture.on_click(lambda _: self._show())
        self.play.on_click(lambda _: self._guarded(self._play))
        self.download.on_click(lambda event: self._guarded(lambda: self._send(event)))

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do one thing at a time, and show errors on the page."""
        if not self._busy.acquire(blocking=False):
            self._say("Busy; wait a moment.")
            return
        try:
            work()
        except DroGraspError as error:
            self._say(f"**Error:** {error}")
        finally:
            self._busy.release()

    def _say(self, text: str) -> None:
        self.status.content = text

    def _take(self, upload: viser.UploadedFile, choice: viser.GuiDropdownHandle[str]) -> None:
        """Store an upload and pick it."""
        self._uploads += 1
        folder = Path(self._folder.name) / str(self._uploads)
        folder.mkdir()
        path = store_upload(upload.name, upload.content, folder)
        choice.options = (*choice.options, str(path))
        choice.value = str(path)
        self._say(f"{upload.name} is picked.")

    def _generate(self) -> None:
        self._say("Generating ...")
        begin = time.perf_counter()
        temperature = None if self.usual.value else float(self.temperature.value)
        made = self.generate(
            self.hand.value, self.object.value, int(self.num.value), self.direction.value, temperature, self.protocol.value,
            int(self.candidates.value), self.method.value)
        held = "" if made.obj.is_cloud else (
            f", **{int(made.refined.success.sum())}** held under *{self.protocol.value}*")
        lines = [f"{len(made.refined)} grasps{held}; {time.perf_counter() - begin:.1f} s", *diagnose(made.refined)]
        self._say("  \n".join(lines))

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
            self.text.content = "No grasp passes these filters."

    def _batch(self) -> GraspBatch:
        assert self.made is not None
        return self.made.raw if self.stage_of.value == "network" else self.made.refined

    def _show(self) -> None:
        """Move the hand to the picked grasp."""
        if self.made is None or not self.shown:
            return
        index, grasps = self.shown[min(int(self.slider.value), len(self.shown) - 1)], self._batch()
        joints = postures_of(self.made.hand, self.made.obj, grasps[index])[cast(Posture, self.posture.value)][0]
        with self.server.atomic():
            self.stage.show(joints, grasps.T_object_wrist[index].float())
            self.stage.colour_grid(outcome(grasps, index))
            self.text.content = describe(grasps, index)

    def _play(self) -> None:
        """Play the trial of the picked grasp."""
        assert self.made is not None
        index, grasps = self.shown[int(self.slider.value)], self._batch()
        self._say(f"Playing the trial under *{self.made.protocol}*.")
        poses, joints = record(self.made.hand, self.made.obj, grasps, index, self.made.protocol)
        T = grasps.T_object_wrist[index].float()
        for pose, q in zip(poses, joints, strict=True):
            self.stage.show(q, T, T @ pose)
            time.sleep(FRAME_TIME)
        self._show()
        self._say("Played.")

    def _send(self, event: viser.GuiEvent) -> None:
        """Send the shown grasps to the browser."""
        name, content = self.exported(self.format.value)
        if event.client is not None:
            event.client.send_file_download(name, content, save_immediately=True)
        self._say(f"{name}: {len(self.shown)} grasps.")

    def exported(self, kind: str) -> tuple[str, bytes]:
        """Name and content of a file with the shown grasps, in one of EXPORTS."""
        assert self.made is not None
        grasps = self._batch()[self.shown]
        stem = f"{Path(self.made.hand.name).name}_{Path(self.made.obj.name).name}"
        if kind == GRASP_FILE:
            return f"{stem}.parquet", grasps.to_bytes()
        name, form = next((name, form) for name, form in FORMATS.items() if form.title == kind)
        content = form.content(ExportJob(grasps, Frame(), self.made.hand))
        return f"{stem}_{name}{form.suffix}", cast(bytes, content)


def chosen(hand: Hand, grasps: GraspBatch, success: str, palm: str) -> Bool[Tensor, " n"]:
    """Grasps with an outcome (`all`, `succeeded`, `failed`) whose palm points along a half-axis (or `any`)."""
    keep = torch.ones(len(grasps), dtype=torch.bool)
    if success != "all":
        keep &= grasps.success if success == "succeeded" else grasps.evaluated & ~grasps.success
    if palm != ANY:
        keep &= half_axis(hand.palm_directions(grasps.T_object_wrist)) == HALF_AXES.index(palm)
    return keep
