"""A page of a scene: click a thing, and see grasps of it with all else as obstacles, the best first."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import viser
from jaxtyping import Float

from dro_grasp.apps.library import Library
from dro_grasp.apps.viewer.constraint_panel import OBJECT_FILES
from dro_grasp.apps.viewer.grasp_page import GRASP_FILE, exported
from dro_grasp.apps.viewer.hand_view import GraspMarks, HandView, colour_of
from dro_grasp.apps.viewer.scene_cloud import LEGEND, SceneCloud
from dro_grasp.apps.viewer.scene_view import Client, Closed, Page, escaped, rgb
from dro_grasp.errors import DroGraspError, OptionError
from dro_grasp.geometry.rendering.rasterizer import Camera
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.forces import known
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.perception.scene_files import SceneCamera
from dro_grasp.objects.perception.segmentation import STRUCTURE
from dro_grasp.objects.perception.things import place_of, size_of
from dro_grasp.objects.scenery import FoundObject, Scene, load_scene
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem

NO_THING = "none"  # Choice of no thing
NO_GRASP = "none yet"  # Choice of no grasp
USUAL = 12  # Grasps that are asked for at first (ours)
MOST = 32  # Most grasps of one thing (ours)
AROUND = 0.06  # Margin of a thing in the view of its grasps [m] (ours)
LISTED = 6  # Grasps in the table (ours)
UPRIGHT = 0.999  # Cosine of the scene's upward direction to z below which browsers have to turn the world first (ours)
TURNING = 1.5  # Time that browsers get for that, since they place the camera in the world as it is turned then [s] (ours)
HAND_OVER = 0.3  # Time that work which ends has to take up what was asked for meanwhile [s] (ours)
STEEP = 0.8  # Cosine of a palm to the vertical from which on it looks from above [1] (ours)
FLAT = 0.4  # The same up to which it looks from the side [1] (ours)
CAMERA_FILES = ".json"  # Files of cameras that a browser offers to upload
FIRST = "**Click a thing** (blue), or pick it from the list."  # What to do first
NO_THINGS = ("no thing: nothing of 4 cm² or more and at most 60 cm stands out of its tables and walls. Bring the camera "
             "nearer, or put things apart from walls, and look again.")
"""What is said of a scene without things."""
NOTHING_THERE = ("**Nothing is there:** your click meets no point. Click a blue thing, or pick it from the list; drag to turn "
                 "the view.")
"""What is said of a click that meets no point."""
STRUCTURE_THERE = "**That is a table, wall or board,** and no thing. Click a blue thing."  # What is said of a click on it
UNKNOWN_THERE = ("**That was taken for no thing:** it is smaller than 4 cm², longer than 60 cm, or far away. Bring the camera "
                 "nearer and look again, or click a blue thing.")
"""What is said of a click on points that are no thing's."""


@dataclass(frozen=True, eq=False)
class Wish:
    """What was asked for last."""

    cloud: SceneCloud
    number: int  # of the thing
    seed: int = 0
    side: Float[np.ndarray, "3"] | None = None  # A place on the side that is meant [m]; all of the thing if there is none


@dataclass(frozen=True, eq=False)
class Offer:
    """Grasps of one thing, the best first."""

    wish: Wish
    found: FoundObject
    grasps: GraspBatch  # In the scene's frame
    faults: tuple[str, ...]  # Why the arm cannot carry out each; empty where it can, or where there is none
    shortage: str | None = None  # Why there are fewer than were asked for


class Superseded(Exception):
    """Something else was asked for meanwhile."""


class ScenePage(Page):
    """The page of one browser, or of all; `close()` ends it.

    Examples:
        >>> scene = load_scene("depth.png", camera="camera.json")
        >>> page = ScenePage(ServedPage(8080, HOST).server, GraspPredictor(), scene, load_hand("allegro"))
    """

    usual = USUAL
    steps = "1. Click a thing. &nbsp; 2. Look at its grasps, the surest first."

    def __init__(
        self, client: Client, predictor: GraspPredictor, scene: Scene, hand: Hand, turn: threading.Lock | None = None,
        camera: SceneCamera | Path | str | None = None,
    ) -> None:
        """Show a scene.

        Args:
            camera: What sees the scenes that are uploaded, until another camera is.
            turn: Held while grasps are made, for pages that share a machine; the predictor may be shared too.

        Raises:
            ObjectError: The scene is a mesh.
        """
        super().__init__(client)
        self.predictor, self.hand, self.library = predictor, hand, Library()
        self._turn, self._camera = turn or threading.Lock(), camera
        self._wish: Wish | None = None
        self._answered: Wish | None = None
        self.offer: Offer | None = None
        self.marks, self.hand_view = GraspMarks(client), HandView(client, hand)
        with client.atomic():  # the browser gets no control before all are connected
            self._add_controls()
        self.open(scene)
        client.scene.on_click()(self._clicked)

    def close(self) -> None:
        """End what the page does, and delete its uploads."""
        super().close()
        self.library.close()

    def _add_controls(self) -> None:
        gui = self.client.gui
        gui.add_html(content=legend(self.steps))
        self.status = gui.add_markdown("")
        with gui.add_folder("1  The thing"):
            self.thing = gui.add_dropdown("Thing", (str(NO_THING),), initial_value=NO_THING, hint="As labelled in the scene.")
            self.one_side = gui.add_checkbox(
                "Things touch: take one side", False,
                hint="Where things that touch are taken for one: click the one that you mean; the other is avoided.")
            self.notes = gui.add_markdown("")
        with gui.add_folder("2  Its grasps"):
            self.grasp = gui.add_dropdown("Grasp", (str(NO_GRASP),), initial_value=NO_GRASP, disabled=True,
                                          hint="The surest first; or click one of the balls in the scene.")
            self.text = gui.add_markdown("")
        self._add_motion()
        with gui.add_folder("More", expand_by_default=False):
            self.num = gui.add_slider("How many grasps", 1, MOST, 1, self.usual)
            self.again = gui.add_button("Other grasps", disabled=True)
            self.download = gui.add_button("Download the grasps", disabled=True)
            self._add_downloads()
            camera = gui.add_upload_button("Upload the camera (JSON) of another scene", mime_type=CAMERA_FILES)
            upload = gui.add_upload_button("Upload what it saw", mime_type=f"{OBJECT_FILES},.png,.tif,.tiff")
        self.thing.on_update(lambda event: None if event.client is None else self._listed())
        self.grasp.on_update(lambda event: None if event.client is None else self._show())
        self.again.on_click(lambda _: self._other())
        self.download.on_click(lambda event: self._guarded(lambda: self._send(event)))
        camera.on_upload(lambda _: self._guarded(lambda: self._take_camera(camera.value)))
        upload.on_upload(lambda _: self._take_scene(upload.value))

    def _add_motion(self) -> None:
        """Add controls below those of the grasps."""

    def _add_downloads(self) -> None:
        """Add further buttons to what is folded."""

    def open(self, scene: Scene) -> None:
        """Show a scene in the place of the one before.

        Raises:
            ObjectError: It is a mesh.
        """
        cloud = SceneCloud(self.client, scene)
        self._wish = self._answered = self.offer = None
        self.cloud = cloud
        self._forget()
        count = scene.segments.count
        self.thing.options = (NO_THING, *(self._thing_name(k) for k in range(count)))
        self.thing.value, self.notes.content = NO_THING, ""
        if abs(cloud.up[2]) < UPRIGHT:
            self.client.flush()
            time.sleep(TURNING)
        self.view.aim(self._first_view())
        shows = f"{count} thing{'s' * (count != 1)}. {FIRST}" if count else NO_THINGS
        self._say(f"**{escaped(scene.name)}** shows {shows}")

    def _first_view(self) -> Camera:
        return self.cloud.camera()

    def _thing_name(self, number: int) -> str:
        return f"{number + 1}: {size_of(self.cloud.world[self.cloud.labels == number])}"

    # What browsers ask for

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self.click(np.array(event.ray_origin, float), np.array(event.ray_direction, float))

    def click(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> None:
        """Take what a ray meets: a grasp's ball, a thing, or a place; and say so where it is none of them."""
        if self.closed.is_set():
            return
        cloud = self.cloud
        if not np.isfinite([*origin, *direction]).all() or not np.linalg.norm(direction):
            return
        if (mark := self.marks.hit(origin, direction)) is not None:
            self.grasp.value = self.grasp.options[min(mark, len(self.grasp.options) - 1)]
            self._show()
            return
        row = cloud.hit(origin, direction)
        if row is None:
            self._tell(NOTHING_THERE)
        elif (label := int(cloud.labels[row])) >= 0:
            self._again(label, cloud.world[row] if self.one_side.value else None)
        elif label == STRUCTURE:
            self._on_structure(cloud.world[row])
        else:
            self._tell(UNKNOWN_THERE)

    def _on_structure(self, point: Float[np.ndarray, "3"]) -> None:
        """A table, wall or board was clicked."""
        self._tell(STRUCTURE_THERE)

    def _again(self, number: int, side: Float[np.ndarray, "3"] | None) -> None:
        """A thing, or one side of it, was clicked, perhaps once more: then other grasps are made if there are none."""
        wish = self._wish
        if wish is None or wish.number != number or (wish.side is None) != (side is None):
            self.pick(number, side=side)
        elif self.offer is None and wish is self._answered:
            self.pick(number, wish.seed + 1, side)
        elif side is not None:  # perhaps the other one
            self.pick(number, side=side)
        else:
            self._tell(f"**Thing {number + 1}** is taken already. *Other grasps* makes further ones.")

    def _listed(self) -> None:
        """A thing was picked from the list."""
        names = list(self.thing.options)
        if self.thing.value in names[1:]:
            self.pick(names.index(self.thing.value) - 1)
        else:
            self._wish = self.offer = None
            self._forget()
            self.cloud.colour(None, None)
            self._tell(FIRST)

    def pick(self, number: int, seed: int = 0, side: Float[np.ndarray, "3"] | None = None) -> None:
        """Take a thing, or its side at a place, and make its grasps; what is made for another one is dropped."""
        cloud = self.cloud
        if not 0 <= number < cloud.scene.segments.count:
            raise OptionError(f"there is no thing {number + 1}; '{cloud.scene.name}' shows {cloud.scene.segments.count}")
        self._wish = Wish(cloud, number, seed, side)
        self.offer = None
        self._forget()
        cloud.colour(number, None)
        self.thing.value, self.notes.content = self.thing.options[number + 1], ""
        self._tell(f"**Thing {number + 1}** is taken. Its grasps are next ...")
        self._guarded(self._answer, HAND_OVER, f"**Thing {number + 1}** is taken; what goes on for another one is given up ...")

    def _other(self) -> None:
        """Make other grasps of the same thing."""
        if (wish := self._wish) is not None:
            self.pick(wish.number, wish.seed + 1, wish.side)

    # Work

    def _guarded(self, work: Callable[[], None], patience: float = 0.0, otherwise: str = "Busy; wait a moment.") -> None:
        """As of every page; what was clicked while it went on is answered afterwards, also where it failed."""
        def both() -> None:
            try:
                work()
            except Superseded:
                pass
            except DroGraspError:
                if self._wish is None or self._wish is self._answered:
                    raise
            self._answer()

        super()._guarded(both, patience, otherwise)

    def _answer(self) -> None:
        """Make what was asked for last, until nothing else was asked for meanwhile."""
        while (wish := self._wish) is not None and wish is not self._answered:
            try:
                offer = self._made(wish)
                self._still(wish)
            except Superseded:
                continue
            except DroGraspError as error:
                if self._wish is wish:
                    self._answered = wish
                    self._complain(error)
                continue
            self.offer, self._answered = offer, wish
            self._present(offer)

    def _still(self, wish: Wish) -> None:
        """Give up where something else is wanted now."""
        if self.closed.is_set():
            raise Closed
        if self._wish is not wish:
            raise Superseded

    def _made(self, wish: Wish) -> Offer:
        """Take the thing out of the scene, and make its grasps when it is this page's turn."""
        name = f"thing {wish.number + 1}"
        with self._when_it_is(self._turn, lambda: self._still(wish)):
            begin = time.perf_counter()
            self._say(f"**Thing {wish.number + 1}**: its unseen side is estimated ...")
            place = wish.cloud.scene.spot(wish.number) if wish.side is None else wish.side
            found = wish.cloud.scene.object_at(place, part=wish.side is not None, name=name)
            self._still(wish)
            wish.cloud.colour(wish.number, found.chosen, found.obj)
            self.notes.content = self._notes(wish, found)
            self._say(f"**Thing {wish.number + 1}**: grasps are made ...")
            offer = self._offered(wish, found)
            self._seconds = time.perf_counter() - begin
            return offer

    def _notes(self, wish: Wish, found: FoundObject) -> str:
        """What was taken, and what is uncertain about it, in Markdown."""
        own = wish.cloud.world[found.chosen.own]
        taken = f"{len(own)} points, {size_of(own)}, at {place_of(own)} m"
        return "  \n".join([taken, *(f"⚠ {escaped(note)}." for note in found.chosen.notes)])

    def _offered(self, wish: Wish, found: FoundObject) -> Offer:
        """Grasps of a thing with all else as obstacles."""
        def progress(done: int, total: int) -> None:
            self._still(wish)
            self._say(f"**Thing {wish.number + 1}**: candidate {done} of {total} ...")

        problem = GraspProblem(self.hand, found.obj, self.predictor.device, Constraints(obstacles=found.obstacles))
        made = self.predictor.run(problem, GraspRequest(int(self.num.value), wish.seed), progress)
        return Offer(wish, found, made.grasps, ("",) * len(made.grasps), made.shortage)

    def _present(self, offer: Offer) -> None:
        """Show grasps, and the best of them."""
        self._list(offer)
        self.grasp.disabled = self.download.disabled = self.again.disabled = False
        count = len(offer.grasps)
        short = f"  \n{escaped(offer.shortage)}" if offer.shortage else ""
        self._say(f"**{count} grasps** of thing {offer.wish.number + 1}, the surest first; {self._seconds:.0f} s.{short}")
        self._aim(offer)

    def _list(self, offer: Offer) -> None:
        """List and mark grasps, and show the best of them."""
        self.marks.show(self.hand, offer.grasps, [not fault for fault in offer.faults])
        self.grasp.options = tuple(grasp_name(offer, i) for i in range(len(offer.grasps))) or (NO_GRASP,)
        self.grasp.value = self.grasp.options[0]
        self._show()

    def _aim(self, offer: Offer) -> None:
        """Look at the thing and its grasps from near."""
        points = offer.found.obj.cloud.astype(np.float64)
        low, high = points.min(0) - AROUND, points.max(0) + AROUND
        self.view.aim(self.cloud.view_of(np.concatenate([points, self.marks.wrists, np.stack([low, high])])))

    def _picked(self) -> int | None:
        """Row of the picked grasp."""
        names = list(self.grasp.options)
        if self.offer is None or not len(self.offer.grasps) or self.grasp.value not in names:
            return None
        return names.index(self.grasp.value)

    def _show(self) -> None:
        """Move the hand to the picked grasp."""
        offer, index = self.offer, self._picked()
        if offer is None or index is None:
            return
        self._forget_film()
        grasps = offer.grasps
        self.hand_view.pose(grasps.joints[index].float(), grasps.T_object_wrist[index].float())
        self.text.content = grasp_table(self.hand, offer, index, np.asarray(self.cloud.up))

    def _forget(self) -> None:
        """Show no grasps any more."""
        self._forget_film()
        self.marks.hide()
        self.hand_view.hide()
        self.grasp.options = (NO_GRASP,)
        self.grasp.value, self.text.content = NO_GRASP, ""
        self.grasp.disabled = self.download.disabled = self.again.disabled = True

    def _forget_film(self) -> None:
        """No motion is shown any more."""

    def _tell(self, text: str) -> None:
        """Say something in answer to a click, which may come after the page was closed."""
        if not self.closed.is_set():
            self.status.content = text

    def _complain(self, error: DroGraspError) -> None:
        """Show an error without the folders of uploads."""
        self._say(f"**It did not work:** {escaped(self.library.plain(str(error)))}")

    def _take_camera(self, upload: viser.UploadedFile) -> None:
        self._camera = Path(self.library.own["scene"][self.library.take(upload.name, upload.content, "scene")])
        self._say(f"{escaped(upload.name)} is the camera of the scene that you upload next.")

    def _take_scene(self, upload: viser.UploadedFile) -> None:
        """Open an uploaded scene; what is made for the one before is given up."""
        with suppress(Closed), self._telling():
            label = self.library.take(upload.name, upload.content, "scene")
            scene = load_scene(self.library.own["scene"][label], label, camera=self._camera)
            self._say(f"{escaped(label)} shows {scene.segments.count} things; it is next.")
            self._wish = None
            self._afterwards(lambda: self.open(scene))

    def _send(self, event: viser.GuiEvent) -> None:
        """Send the grasps to the browser."""
        if (offer := self.offer) is None:
            return
        name, content = exported(self.hand, offer.found.obj, offer.grasps, GRASP_FILE)
        if event.client is not None:
            event.client.send_file_download(name, content, save_immediately=True)
        self._say(f"{escaped(name)}: {len(offer.grasps)} grasps, in the frame of the scene.")

    def show_moment(self, moment: int) -> None:
        """There is no film without a robot."""

    def _play(self) -> None:
        """There is no film without a robot."""


def grasp_name(offer: Offer, index: int) -> str:
    """A grasp in the list."""
    confidence = float(offer.grasps.confidence[index])
    rated = f"{confidence:.0%} sure" if np.isfinite(confidence) else "not rated"
    return f"{index + 1}: {rated}{', out of reach' if offer.faults[index] else ''}"


def grasp_table(hand: Hand, offer: Offer, picked: int, up: Float[np.ndarray, "3"]) -> str:
    """The grasps around the picked one, with how sure they are, what they carry, and whence they come, in Markdown."""
    first = max(0, min(picked - LISTED // 2, len(offer.grasps) - LISTED))
    rows = ["||sure|carries|from|", "|---|---|---|---|"]
    for i in range(first, min(first + LISTED, len(offer.grasps))):
        payload, confidence = known(offer.grasps.payload[i]), float(offer.grasps.confidence[i])
        cells = [f"{i + 1}", f"{confidence:.0%}" if np.isfinite(confidence) else "-",
                 "-" if payload is None else f"{payload:.1f} kg",
                 "no way" if offer.faults[i] else _whence(hand, offer.grasps, i, up)]
        rows.append("|" + "|".join(f"**{escaped(cell)}**" if i == picked else escaped(cell) for cell in cells) + "|")
    fault = f"\n\nThe arm cannot carry it out: it is {escaped(offer.faults[picked])}." if offer.faults[picked] else ""
    return "\n".join(rows) + fault


def _whence(hand: Hand, grasps: GraspBatch, index: int, up: Float[np.ndarray, "3"]) -> str:
    palm = hand.palm_directions(grasps.T_object_wrist[[index]].float())[0]
    down = -float(palm @ torch.from_numpy(up / np.linalg.norm(up)).float())
    return "above" if down > STEEP else "aslant" if down > FLAT else "the side" if down > -FLAT else "below"


def legend(steps: str) -> str:
    """What the colours mean, and what to do, in HTML."""
    dots = "".join(
        f'<span style="white-space:nowrap;margin-right:0.8em"><span style="display:inline-block;width:0.75em;height:0.75em;'
        f'border-radius:50%;background:rgb{rgb(colour)};margin-right:0.35em"></span>{text}</span> ' for text, colour in LEGEND)
    balls = "".join(f'<span style="color:rgb{rgb(colour_of(share))}">⬤</span>' for share in (0.0, 0.5, 1.0))
    return (f'<div style="font-size:0.8em;line-height:1.6;padding:0.4em 0.6em"><b>{steps}</b><br/>{dots}<br/>'
            f'<span style="font-size:0.7em">{balls}</span> a grasp\'s wrist: unsure to sure</div>')
