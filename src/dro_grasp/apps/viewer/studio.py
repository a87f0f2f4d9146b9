"""The whole tool in a page: pick or upload a hand and an object, generate grasps, watch their trials, download them.

Every browser has a page of its own.
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import viser

from dro_grasp.apps.library import Kind, Library
from dro_grasp.apps.viewer.constraint_panel import NOTHING, OBJECT_FILES, ConstraintPanel, given_number
from dro_grasp.apps.viewer.grasp_page import GraspPage, ShownGrasps
from dro_grasp.apps.viewer.scene_view import HOST, Client, Closed, Page, ServedPage, escaped
from dro_grasp.errors import DroGraspError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.sources import made_for_another, object_of
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import hand_names
from dro_grasp.objects.catalogue import object_names
from dro_grasp.objects.shape import ObjectModel, with_mass
from dro_grasp.pictures.appearance import waiting_pose
from dro_grasp.pictures.sheets import protocol_name
from dro_grasp.predict.config import AUTO, GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.registry import source_names
from dro_grasp.predict.stages import evaluate
from dro_grasp.simulation.outcome import diagnose
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS

MAX_GRASPS = 64  # Most grasps of one click (ours)
MAX_CANDIDATES = 8  # Most candidates for each of them (ours)


class Studio(GraspPage):
    """The page of one browser, or of all; `close()` ends it.

    Examples:
        >>> studio = Studio(ServedPage(8080, HOST).server, GraspPredictor(), "allegro", "mug")
    """

    def __init__(
        self, client: Client, predictor: GraspPredictor, hand: str = "allegro", obj: str = "rubber_duck",
        turn: threading.Lock | None = None, preview: bool = True,
    ) -> None:
        """Start with a hand and an object chosen, by name or path.

        Args:
            turn: Held while grasps are made, for pages that share a machine; the predictor may be shared too.
            preview: Show hand and object at once; not needed where `open` follows.
        """
        self.predictor, self.library, self._first = predictor, Library(), (hand, obj)
        self._turn = turn or threading.Lock()
        self._batches: dict[str, GraspBatch] = {}  # grasps of a file, by the name of their object
        self._rest: dict[str, str] = {}  # names of all else of a scene, by that of the thing in it
        self._given: dict[str, Hand] = {}  # the hand that came with a file's grasps, by the name of their object
        super().__init__(client)
        if preview:
            self._guarded(self._preview)

    def close(self) -> None:
        """End what the page does, and delete its uploads."""
        super().close()
        self.library.close()

    def open(self, hand: Hand, grasps: GraspBatch, obj: ObjectModel | None = None, first: str | None = None) -> None:
        """Show the grasps of a file. Its hand and objects can be picked, and more grasps generated, like any other.

        Args:
            hand: The hand of the grasps, or another version of it, which is then said.
            grasps: Of one object or several.
            obj: Their object, where it is not the one that they name.
            first: Name of the object that is shown first.

        Raises:
            GraspFileError: The hand has other joints than the grasps.
        """
        grasps.require_hand(hand)
        for name, own in grasps.by_object() if obj is None else [(obj.name, grasps)]:
            self._batches[name], self._given[name] = own, hand
            self.library.add("object", name, partial(object_of, own, None, 1.0))
        self._choose(hand, obj)
        if obj is None:
            self.object.value = first or grasps.object[0]
        self._guarded(self._pick_object)

    def offer(self, hand: Hand | None, obj: ObjectModel | None) -> None:
        """Pick a hand, an object or both, which may be the user's own; None leaves what is picked."""
        self._choose(hand, obj)
        self._guarded(self._preview)

    def _choose(self, hand: Hand | None, obj: ObjectModel | None) -> None:
        """Add a hand, an object or both to what can be picked, and pick them."""
        choices: tuple[tuple[Kind, Hand | ObjectModel | None, viser.GuiDropdownHandle[str]], ...] = (
            ("hand", hand, self.hand), ("object", obj, self.object))
        for kind, model, choice in choices:
            if model is not None:
                self.library.add(kind, model.name, model)
            choice.options = self.library.names(kind)
            if model is not None:
                choice.value = model.name

    def _preview(self) -> None:
        """Show the chosen hand above the chosen object, before there are grasps."""
        hand, obj = self.library.hand(self.hand.value), self.library.obj(self.object.value)
        self.made, self.shown, self.text.content = None, [], ""
        self.slider.disabled = self.play.disabled = self.download.disabled = True
        self._forget_film()
        self.view.set_pair(hand, obj, hand.canonical_joints(), waiting_pose(hand, obj))
        self._say(f"{escaped(hand.name)} above {escaped(obj.name)}. Press *Generate*, or pick or upload others.")

    def _pick_object(self) -> None:
        """Show the grasps of the chosen object if a file has some of the chosen hand, and the pair alone otherwise."""
        self._pick_rest()
        grasps = self._batches.get(self.object.value)
        hand = self.library.hand(self.hand.value)
        if grasps is None or (grasps.hand_sha256 != hand.sha256 and self._given.get(self.object.value) is not hand):
            self._preview()
            return
        other = [] if grasps.hand_sha256 in {"", hand.sha256} else [f"{made_for_another(grasps.hand, hand.name)}."]
        obj, label = self.library.obj(self.object.value), next(filter(None, grasps.protocol), "")
        self.made = ShownGrasps(hand, obj, grasps, grasps, protocol_name(label))
        self._present()
        held = f", **{int(grasps.success.sum())}** held under *{escaped(label)}*" if label else ", not evaluated"
        short = "" if grasps.out_of == len(grasps) else f" ({grasps.out_of} were asked for)"
        remarks = map(escaped, [*other, *diagnose(grasps)])
        self._say("  \n".join([f"{len(grasps)} grasps of {escaped(obj.name)}{short}{held}", *remarks]))

    def _complain(self, error: DroGraspError) -> None:
        """Show an error without the folders of uploads."""
        self._say(f"**Error:** {escaped(self.library.plain(str(error)))}")

    def _add_choices(self) -> None:
        (hand, obj), gui = self._first, self.client.gui
        with gui.add_folder("Hand and object"):
            self.hand = gui.add_dropdown("Hand", tuple(dict.fromkeys([*hand_names(), hand])), initial_value=hand)
            hand_file = gui.add_upload_button("Upload a hand (URDF, MJCF, ZIP)", mime_type=".urdf,.xml,.zip")
            self.object = gui.add_dropdown("Object", tuple(dict.fromkeys([*object_names(), obj])), initial_value=obj)
            object_file = gui.add_upload_button("Upload an object (STL, OBJ, PLY)", mime_type=OBJECT_FILES)
            self.mass = gui.add_text("Mass [kg]", "", hint="Empty: as the file says, or density times volume.")
        with gui.add_folder("Generate"):
            self.num = gui.add_slider("Grasps", 1, MAX_GRASPS, 1, GraspRequest.num)
            self.source = gui.add_dropdown(
                "Source", (AUTO, *source_names()), initial_value=AUTO,
                hint="auto: the optimiser helps where the network is unsure.")
            self.candidates = gui.add_slider(
                "Candidates", 1, MAX_CANDIDATES, 1, GraspRequest.candidates,
                hint="Candidates proposed for each grasp; the best by score are kept.")
            self.usual = gui.add_checkbox("Usual diversity", True, hint="1 for a mesh, less for a bare point cloud.")
            self.temperature = gui.add_slider(
                "Diversity", 0.0, 1.0, 0.05, 1.0, disabled=True, hint="0: the likeliest grasp of each placement.")
            self.protocol = gui.add_dropdown("Trial", tuple(PROTOCOLS), initial_value=DEFAULT_PROTOCOL)
            self.button = gui.add_button("Generate", color="green")
        self.panel = panel = ConstraintPanel(self.client, lambda: self._afterwards(self._draw_constraints))
        hand_file.on_upload(lambda _: self._take(hand_file.value, "hand", self.hand, self._preview))
        object_file.on_upload(lambda _: self._take(object_file.value, "object", self.object, self._preview))
        panel.upload.on_upload(lambda _: self._take(panel.upload.value, "scene", panel.obstacles, self._draw_constraints))
        panel.under.on_click(lambda _: self._guarded(self._table_under))
        self.button.on_click(lambda _: self._guarded(self._generate))
        for choice in (self.hand, self.object):
            choice.on_update(lambda event: None if event.client is None else self._afterwards(self._pick_object))
        self.usual.on_update(lambda _: setattr(self.temperature, "disabled", self.usual.value))

    def _take(
        self, upload: viser.UploadedFile, kind: Kind, choice: viser.GuiDropdownHandle[str], show: Callable[[], None],
        patience: float = 10.0,
    ) -> None:
        """Store an upload, pick it and show it.

        Where other work, such as loading the first pair, outlasts the patience [s] (ours), it can be picked later.
        """
        with suppress(Closed), self._telling():
            if self.closed.is_set():
                return
            label = self.library.take(upload.name, upload.content, kind)
            if kind == "object":
                self._batches.pop(label, None)
            choice.options = tuple(dict.fromkeys([*choice.options, label]))
            later = f"Busy. {escaped(label)} is stored; pick it afterwards."
            self._guarded(lambda: self._pick_upload(label, choice, show), patience, later)

    def _pick_upload(self, label: str, choice: viser.GuiDropdownHandle[str], show: Callable[[], None]) -> None:
        things = self.library.add_things(label) if choice is self.panel.obstacles else {}
        if things:
            self._offer_things(things)
            return
        choice.value = label
        show()
        self._say(f"{escaped(label)} is picked. {self.status.content}")

    def _offer_things(self, things: dict[str, str]) -> None:
        """Let each thing of a scene be picked as the object, with all else around it, and pick the first."""
        self._rest |= things
        self.object.options = self.library.names("object")
        self.panel.obstacles.options = (NOTHING, *self.library.names("scene"))
        self.object.value = first = next(iter(things))
        self._pick_object()
        self._say(f"The scene shows {len(things)} things. {escaped(first)} is picked, and all else is avoided; pick another "
                  "one from the list of objects.")

    def _pick_rest(self) -> None:
        """Avoid all else of the scene that the chosen object is a thing of."""
        rest = self._rest.get(self.object.value)
        if rest in self.panel.obstacles.options:
            self.panel.obstacles.value = rest
            self.panel.draw(self.panel.constraints(self.library.scene), self.library.obj(self.object.value))
        elif self.panel.obstacles.value in self._rest.values():
            self.panel.obstacles.value = NOTHING

    def _table_under(self) -> None:
        """Put the table under the chosen object."""
        self.panel.table.value = f"{float(self.library.obj(self.object.value).cloud[:, 2].min()):.4f}"
        self._draw_constraints()

    def _draw_constraints(self) -> None:
        """Show what the controls ask for."""
        self.panel.draw(self.panel.constraints(self.library.scene), self.library.obj(self.object.value))
        self._say("Grasps of the next click respect these constraints.")

    def _generate(self) -> None:
        """Make grasps as the controls say, when it is this page's turn."""
        with self._when_it_is(self._turn):
            self._say("Generating ...")
            begin = time.perf_counter()
            made = self._generated()
        held = "" if made.obj.is_cloud else (
            f", **{int(made.refined.success.sum())}** held under *{escaped(made.protocol)}*")
        remarks = [] if made.shortage is None else [made.shortage]
        remarks += diagnose(made.refined)
        lines = [f"{len(made.refined)} grasps{held}; {time.perf_counter() - begin:.1f} s", *map(escaped, remarks)]
        self._say("  \n".join(lines))

    def _generated(self) -> ShownGrasps:
        """Predict, refine, rank and evaluate, then show the best; bare clouds get no trial."""
        def counting(what: str) -> Callable[[int, int], None]:
            return lambda done, total: self._say(f"{what}: {done} of {total}")

        wanted, protocol = self.panel.constraints(self.library.scene), self.protocol.value
        hand, obj, mass = self.library.hand(self.hand.value), self.library.obj(self.object.value), given_number(self.mass)
        obj = obj if mass is None else with_mass(obj, mass)
        problem = GraspProblem(hand, obj, self.predictor.device, wanted)
        request = GraspRequest(
            int(self.num.value), candidates=int(self.candidates.value), source=self.source.value,
            temperature=None if self.usual.value else float(self.temperature.value))
        found = self.predictor.run(problem, request, counting("proposing"))
        raw, refined = found.proposed, found.grasps
        if not obj.is_cloud:
            raw, refined = (evaluate(problem, grasps, protocol, counting("evaluating")) for grasps in (raw, refined))
        on_table = wanted.table is not None
        self.made = ShownGrasps(hand, obj, raw, refined, protocol, found.shortage, on_table, found.points)
        self._present()
        self.panel.draw(wanted, obj)
        return self.made


class StudioServer(ServedPage):
    """A server that gives every browser a page of its own; `stop()` ends it.

    Examples:
        >>> server = StudioServer(lambda client, turn: Studio(client, predictor, turn=turn))
    """

    def __init__(
        self, make: Callable[[Client, threading.Lock], Page], port: int = 8080, host: str = HOST,
        token: str | None = None,
    ) -> None:
        """Start serving; `make` makes the page of a browser, with a lock that is the same for all."""
        super().__init__(port, host, token)
        self._make, self._turn = make, threading.Lock()
        self.studios: dict[int, Page] = {}
        """Pages that are open, by the browser's number."""
        self.server.on_client_connect(self.enter)
        self.server.on_client_disconnect(self.leave)

    def stop(self) -> None:
        """Stop serving; all pages end."""
        super().stop()
        for number in list(self.studios):
            self._close(number)

    def enter(self, client: viser.ClientHandle) -> None:
        """A browser has come: it gets its page."""
        self.studios[client.client_id] = self._make(client, self._turn)
        if client.client_id not in self.server.get_clients():  # it left meanwhile
            self._close(client.client_id)

    def leave(self, client: viser.ClientHandle) -> None:
        """A browser has gone: its page ends."""
        self._close(client.client_id)

    def _close(self, number: int) -> None:
        if (studio := self.studios.pop(number, None)) is not None:
            studio.close()
            del studio
            gc.collect()  # pages refer to themselves, and hold meshes; Python alone looks for such waste rarely
