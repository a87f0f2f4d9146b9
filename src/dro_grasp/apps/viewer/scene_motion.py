"""A page of a scene with a robot: it also plans the motion of the chosen grasp, to a place on the table, and plays it."""

from __future__ import annotations

import itertools
import math
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import viser
from jaxtyping import Float

from dro_grasp.apps.viewer.film import RATE, Film
from dro_grasp.apps.viewer.robot_view import RobotView
from dro_grasp.apps.viewer.scene_cloud import POINT, shades
from dro_grasp.apps.viewer.scene_page import STRUCTURE_THERE, Offer, ScenePage, Wish
from dro_grasp.apps.viewer.scene_view import Client, escaped, move, rgb
from dro_grasp.arm.planning.candidates import predicted
from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.planning.placing import Place, foot, height_below
from dro_grasp.arm.planning.planner import plan
from dro_grasp.arm.planning.task import PlanConfig, Task
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.animation import VIEW
from dro_grasp.arm.tabletop.table_scene import refuse_sunk, table_note
from dro_grasp.errors import OptionError, PlanError
from dro_grasp.geometry.point_clouds import one_per_cell
from dro_grasp.geometry.rendering.rasterizer import Camera, Colour
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.perception.scene_files import SceneCamera
from dro_grasp.objects.perception.segmentation import STRUCTURE
from dro_grasp.objects.scenery import THIN, FoundObject, Scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import LEAST_CONFIDENCE
from dro_grasp.predict.predictor import GraspPredictor

PLACE_COLOUR: Colour = (0.30, 0.65, 0.42)  # Green of where the thing will stand
NEAR = 0.15  # Margin of the thing in the view of its grasps [m] (ours)
TABLE_WITHIN = 0.05  # Farthest that the plane below a thing may be from the robot's table to be it [m] (ours)
TYPING = 0.5  # Pause after which what was typed is taken to be whole [s] (ours)
SEEDS = 4  # How often the motion of one grasp is tried (ours)
ON_PLANE = 0.02  # Points nearer to a plane than this are its own [m] (ours)


class RobotScenePage(ScenePage):
    """The page of a scene in the world of a robot."""

    usual = 24
    steps = "1. Click a thing. &nbsp; 2. Choose a grasp. &nbsp; 3. Click the table, plan, play."

    def __init__(
        self, client: Client, predictor: GraspPredictor, scene: Scene, robot: Robot, turn: threading.Lock | None = None,
        camera: SceneCamera | Path | str | None = None,
    ) -> None:
        """Show a scene, in the robot's world frame, with the robot at home; further arguments as for `ScenePage`."""
        self.robot = robot
        self.made: MotionPlan | None = None
        self.robot_view = RobotView(client, table=False)
        self.robot_view.put(robot)
        super().__init__(client, predictor, scene, robot.hand, turn, camera)

    def _add_motion(self) -> None:
        gui = self.client.gui
        with gui.add_folder("3  The motion"):
            self.place = gui.add_text("Place x y [turn]", "", hint="Metres in the robot's world, and degrees about the "
                                      "vertical. Or click the table. Empty: the thing is lifted only.")
            self.one = gui.add_button("Plan the chosen grasp", disabled=True, color="green")
            self.any = gui.add_button("Plan the best that works", disabled=True)
            self._add_player("Play")
            self.words = gui.add_markdown("")
        self.place.on_update(lambda event: None if event.client is None else self._typed())
        self.one.on_click(lambda _: self._guarded(lambda: self._plan(True)))
        self.any.on_click(lambda _: self._guarded(lambda: self._plan(False)))

    def _add_downloads(self) -> None:
        self.save = self.client.gui.add_button("Download the plan", disabled=True)
        self.save.on_click(lambda event: self._guarded(lambda: self._send_plan(event)))

    def _first_view(self) -> Camera:
        robot, cloud = self.robot, self.cloud
        at_home = self.robot_view.swept(robot.home[None], robot.hand.canonical_joints().double().numpy()[None])
        things = cloud.world[cloud.labels >= 0]
        return Camera.around(np.concatenate([at_home, things]), VIEW, aspect=4 / 3)

    def _aim(self, offer: Offer) -> None:
        """Look at the thing, its grasps, and the table around, where it may be put."""
        points = offer.found.obj.cloud.astype(np.float64)
        low, high = points.min(0) - NEAR, points.max(0) + NEAR
        self.view.aim(Camera.around(np.concatenate([points, self.marks.wrists, np.stack([low, high])]), VIEW, aspect=4 / 3))

    def _on_structure(self, point: Float[np.ndarray, "3"]) -> None:
        """The table was clicked: the thing that is chosen shall stand there."""
        if self._wish is None:
            self._tell(f"{STRUCTURE_THERE} Afterwards, a click on the table says where to put it.")
            return
        turn = (self._numbers() or ())[2:]
        self.place.value = " ".join(f"{value:g}" for value in [*point[:2].round(3).tolist(), *turn])
        if self.offer is None:
            self._tell(f"It will be put at {point[0]:.2f} {point[1]:.2f} m, once there are grasps.")
            return
        self._afterwards(self._choose_place)

    def _typed(self) -> None:
        """Something was typed into the field of the place; it counts once the typing pauses."""
        text = self.place.value
        time.sleep(TYPING)
        if self.place.value == text:
            self._afterwards(self._choose_place)

    def _numbers(self) -> tuple[float, ...] | None:
        """The numbers in the field of the place, if that is what it holds."""
        try:
            numbers = tuple(float(word) for word in self.place.value.replace(",", " ").split())
        except ValueError:
            return None
        return numbers if len(numbers) in (2, 3) and all(map(math.isfinite, numbers)) else None

    def spot(self) -> tuple[float, ...] | None:
        """Where the thing is to be put: x, y, z [m], and its turn about the vertical where that is given [rad].

        Raises:
            OptionError: The field holds something else.
        """
        if not self.place.value.strip():
            return None
        if (numbers := self._numbers()) is None:
            raise OptionError(f"the place is '{self.place.value}'; give x and y in metres, and a turn in degrees where one is "
                              "wanted, such as 0.45 -0.2 90; or nothing")
        x, y, *turn = numbers
        return (x, y, self._height(x, y), *map(math.radians, turn))

    def _height(self, x: float, y: float) -> float:
        """Height of what a camera saw at a place, and of the table where it saw nothing [m]."""
        cloud = self.cloud
        flat = cloud.world[cloud.labels == STRUCTURE]
        near = flat[np.hypot(flat[:, 0] - x, flat[:, 1] - y) < ON_PLANE]
        if self.offer is not None and (table := levelled(self.robot, self.offer.found.obj, cloud.scene).table) is not None and (
            not len(near) or abs(float(np.median(near[:, 2])) - table.height) < ON_PLANE):
            return table.height
        return float(np.median(near[:, 2])) if len(near) else 0.0

    def _choose_place(self) -> None:
        """Show where the thing will stand, and which grasps can put it there."""
        self.client.scene.remove_by_name("/place")
        if (offer := self.offer) is None:
            return
        self._forget_film()
        spot = self.spot()
        if spot is not None:
            self._draw_place(offer, spot)
            self._say("Which grasps can put it there ...")
        self.offer = offer = self._ranked(offer.wish, offer.found, offer.grasps, offer.shortage)
        self._list(offer)
        usable = sum(not fault for fault in offer.faults)
        where = "lift it" if spot is None else f"put it at **{spot[0]:.2f} {spot[1]:.2f}** m"
        self._say(f"**{usable}** of {len(offer.grasps)} grasps can {where}. " + (
            "Press *Plan the chosen grasp*." if usable else "*Plan the best that works* looks for others; or click elsewhere."))

    def _draw_place(self, offer: Offer, spot: tuple[float, ...]) -> None:
        x, y, z, *turn = spot
        points = offer.found.obj.cloud.astype(np.float64)
        c, s = math.cos(turn[0] if turn else 0.0), math.sin(turn[0] if turn else 0.0)
        T = np.eye(4)
        T[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        T[:3, 3] = np.array([x, y, z]) - T[:3, :3] @ foot(points)
        self._draw_there(offer, T)

    def _draw_there(self, offer: Offer, T: Float[np.ndarray, "4 4"]) -> None:
        """Show the thing at the end of a motion of it [m]."""
        points, normals = (a.astype(np.float64) @ T[:3, :3].T for a in (offer.found.obj.cloud, offer.found.obj.cloud_normals))
        points, shade = points + T[:3, 3], shades(normals, np.asarray(self.cloud.up))[:, None]
        self.client.scene.add_point_cloud(
            "/place", points.astype(np.float32), (np.array(rgb(PLACE_COLOUR)) * shade).astype(np.uint8), point_size=POINT,
            point_shape="circle", precision="float32")

    def _offered(self, wish: Wish, found: FoundObject) -> Offer:
        """Grasps that are trusted without a rehearsal, those first that the arm can carry out."""
        task = self._task(wish, found, None)
        task = replace(task, config=replace(task.config, least_confidence=LEAST_CONFIDENCE))
        task.check_start()
        grasps = GraspBatch.concatenate([*predicted(task, self.predictor)(0)]).sorted_by_score()
        self._still(wish)
        self._say(f"**Thing {wish.number + 1}**: which of {len(grasps)} grasps the arm can carry out ...")
        return self._ranked(wish, found, grasps, None, lifted=True)

    def _ranked(
        self, wish: Wish, found: FoundObject, grasps: GraspBatch, shortage: str | None, lifted: bool = False
    ) -> Offer:
        """Grasps with why the arm cannot carry them out, or put the thing down where it is wanted."""
        reach, faults = self._task(wish, found, None if lifted else self.spot()).reach, list[str]()
        hopeless = reach.hopeless(grasps)
        for i in range(len(grasps)):
            self._still(wish)
            way = hopeless.get(i) or reach.ways(grasps, i)
            faults.append(way if isinstance(way, str) else "")
        order = sorted(range(len(grasps)), key=lambda i: (bool(faults[i]), -float(grasps.score[i])))
        return Offer(wish, found, grasps[order], tuple(faults[i] for i in order), shortage)

    def _task(self, wish: Wish, found: FoundObject, spot: tuple[float, ...] | None) -> Task:
        place, robot = None if spot is None else Place.of(spot), levelled(self.robot, found.obj, wish.cloud.scene)
        return Task.of(robot, found.obj, np.eye(4), (), self._config(wish, found), wish.seed, place=place)

    def _config(self, wish: Wish, found: FoundObject) -> PlanConfig:
        around = surroundings(wish.cloud.scene, found, self.robot)
        return PlanConfig(int(self.num.value), constraints=Constraints(obstacles=around))

    def _notes(self, wish: Wish, found: FoundObject) -> str:
        table = levelled(self.robot, found.obj, wish.cloud.scene).table
        told = () if table is None else table_note(self.robot, table.height)
        return "  \n".join([super()._notes(wish, found), *(f"⚠ {escaped(note)}." for note in told)])

    def _present(self, offer: Offer) -> None:
        super()._present(offer)
        self.one.disabled = self.any.disabled = False
        if self.place.value.strip():
            self._choose_place()
            return
        usable = sum(not fault for fault in offer.faults)
        self._say(f"{self.status.content}  \nThe arm can carry out **{usable}**. "
                  + ("Choose one, click the table where the thing shall stand, and plan." if usable else
                     "*Plan the best that works* looks for others; or move the thing nearer."))

    def _plan(self, chosen: bool) -> None:
        """Plan the chosen grasp, or the best that works, of further ones, too."""
        offer, index, spot = self.offer, self._picked(), self.spot()
        if offer is None or index is None:
            return
        self._forget_film()
        self._say("The motion is planned ..." if spot is None else "The motion to the place is planned ...")
        try:
            made = self._planned_one(offer, index, spot) if chosen else self._planned_any(offer, spot)
        except PlanError as error:
            raise PlanError(f"{error}. On this page: choose another grasp or place, or press '{self.any.label}'") from error
        if self.offer is offer:  # nothing else was clicked meanwhile
            own = made.notes.chosen
            self._project(made, index if chosen else own if own < len(offer.grasps) else None)

    def _planned_one(self, offer: Offer, index: int, spot: tuple[float, ...] | None) -> MotionPlan:
        """The motion of one grasp; postures of the arm are drawn, so several seeds are tried."""
        task = self._task(offer.wish, offer.found, spot)
        for left in reversed(range(SEEDS)):
            self._still(offer.wish)
            try:
                return plan(task.robot, offer.found.obj, predictor=self.predictor, config=task.config,
                            seed=offer.wish.seed + left, grasps=offer.grasps[[index]], place=task.place)
            except PlanError:
                if not left:
                    raise
        raise AssertionError("the last of several tries returns or raises")

    def _planned_any(self, offer: Offer, spot: tuple[float, ...] | None) -> MotionPlan:
        """The motion of the best grasp that works, of those in the list and of further ones."""
        task, numbers = self._task(offer.wish, offer.found, spot), itertools.count()
        further = predicted(task, self.predictor)

        def batch(_: int) -> GraspBatch:
            self._still(offer.wish)
            return GraspBatch.concatenate([*further(number)]) if (number := next(numbers)) else offer.grasps

        return plan(task.robot, offer.found.obj, predictor=self.predictor, config=task.config, seed=offer.wish.seed,
                    grasps=batch, place=task.place)

    def _project(self, made: MotionPlan, index: int | None) -> None:
        """Put the film of a plan on the page, of a grasp in the list or of another one."""
        if index is not None:
            self.grasp.value = self.grasp.options[index]
            self._show()
        self.made, self.film = made, (film := Film.of_plan(self.robot, made))
        if self.offer is not None and made.notes.place is not None:  # it may have been turned
            self._draw_there(self.offer, np.array(made.notes.place))
        self.hand_view.hide()
        self.marks.hide()
        self.moment.max, self.moment.value = len(film.arm) - 1, 0
        self.moment.disabled = self.play.disabled = self.save.disabled = False
        self.view.aim(Camera.around(self.robot_view.swept(film.arm, film.hand), VIEW, aspect=4 / 3))
        self.show_moment(0)
        put = "" if made.notes.place is None else " It ends with the thing on its place."
        self._say(f"**The motion of {made.seconds:.0f} s is planned.**{put} Press *Play*, or move *Moment*.")

    def show_moment(self, moment: int) -> None:
        """Show one picture of the motion."""
        if (film := self.film) is None:
            return
        moment = min(moment, len(film.arm) - 1)
        with self.client.atomic():
            self.robot_view.place(film.arm[moment], film.hand[moment])
            move(self.cloud.movable, film.poses[moment, 0])
            self.words.content = f"{moment / RATE:.1f} s {film.words[moment]}"

    def _play(self) -> None:
        if (film := self.film) is not None:
            self._roll(film, len(film.arm), 1 / RATE)

    def _forget(self) -> None:
        self.client.scene.remove_by_name("/place")
        self.one.disabled = self.any.disabled = True
        super()._forget()

    def _forget_film(self) -> None:
        """The robot is at home, and the thing where it was seen."""
        before, self.made, self.film = self.film, None, None
        if before is not None:
            move(self.cloud.movable, np.eye(4))
            self.robot_view.place(self.robot.home, self.robot.hand.canonical_joints().double().numpy())
            if self.offer is not None:
                self.marks.show(self.hand, self.offer.grasps, [not fault for fault in self.offer.faults])
        self.moment.disabled = self.play.disabled = self.save.disabled = True
        self.words.content = ""

    def _send_plan(self, event: viser.GuiEvent) -> None:
        """Send the plan to the browser."""
        if self.made is None:
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "plan.npz"
            self.made.save(path)
            if event.client is not None:
                event.client.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        self._say("plan.npz: `dro-grasp view plan.npz` plays it.")


def levelled(robot: Robot, obj: ObjectModel, scene: Scene) -> Robot:
    """The robot with its table at the height that was seen below an object of a scene, if that is its table.

    ObjectError: hands would go through the table that the robot file states.
    """
    height = height_below(obj)
    if robot.table is None or height is None or abs(height - robot.table.height) > TABLE_WITHIN:
        return robot
    refuse_sunk(robot, height, scene)
    return replace(robot, table=replace(robot.table, height=height))


def surroundings(scene: Scene, found: FoundObject, robot: Robot) -> Scene | None:
    """All else that was seen, with the plane on which the object stands where that is not the robot's table."""
    height, around = height_below(found.obj), found.obstacles
    on_table = robot.table is None or (height is not None and abs(height - robot.table.height) <= TABLE_WITHIN)
    if on_table or found.chosen.below is None or scene.sight is None:
        return around
    plane = scene.segments.planes[found.chosen.below]
    own = (scene.segments.labels == STRUCTURE) & (np.abs(scene.sight.points @ plane[:3] - plane[3]) < ON_PLANE)
    points = scene.sight.world()[own]
    points = points[one_per_cell(points, THIN)] if len(points) else points
    return Scene(f"what else '{scene.name}' shows", points if around is None else np.concatenate([around.points, points]))
