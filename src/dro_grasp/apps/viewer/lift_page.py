"""A page that plays motions of an arm: a plan, or attempts to lift objects, with the camera's cloud and all grasps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import viser

from dro_grasp.apps.viewer.film import RATE, Film
from dro_grasp.apps.viewer.robot_view import HoldSign, RobotView, require_joints, robot_of
from dro_grasp.apps.viewer.scene_view import HOST, PATIENCE, POINT_SIZE, Page, ServedPage, SharedPage, escaped, move, rgb
from dro_grasp.arm.planning.motion import CHOSEN, READY, WAITING, MotionPlan
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.animation import VIEW, Recorder, colour_of
from dro_grasp.arm.tabletop.attempts import Attempt, read_attempts
from dro_grasp.arm.tabletop.experiment import TabletopConfig, attempt
from dro_grasp.errors import DroGraspError, OptionError
from dro_grasp.geometry.rendering.rasterizer import Camera, Colour
from dro_grasp.network.checkpoints import describe_weights
from dro_grasp.objects.catalogue import load_object
from dro_grasp.pictures.appearance import SOLVED_COLOUR, SUCCESS_COLOUR
from dro_grasp.predict.predictor import GraspPredictor

DROPPED_COLOUR: Colour = (0.62, 0.62, 0.62)  # Grey of grasps that were dropped
WAITING_COLOUR: Colour = (0.93, 0.80, 0.35)  # Yellow of grasps that were not tried
ELSEWHERE = 5e-3  # Distance of wrists that are not the same [m] (ours)
TURNED = 1e-2  # Difference of their rotation matrices [1] (ours)
NONE = "none"  # Choice of no grasps
EVERY = "all"  # Choice of every grasp


class LiftPage(SharedPage):
    """A running page; `stop()` ends it.

    Examples:
        >>> page = LiftPage(robot)
        >>> page.show(Film.of_plan(robot, MotionPlan.load("plan.npz")))
    """

    def __init__(
        self, robot: Robot, attempts: Sequence[Attempt] = (), weights: str | None = None, port: int = 8080, host: str = HOST,
        make: Callable[..., Attempt] = attempt, token: str | None = None,
    ) -> None:
        """Start serving with the robot at home.

        Args:
            attempts: Stored attempts, which can be picked and are run once more to be played, each with its own robot.
            weights: Name or file, where those that they were made with are not meant.
            make: Runs them.
        """
        self.robot, self.attempts, self.weights, self.make = robot, list(attempts), weights, make
        ServedPage.__init__(self, port, host, token)
        Page.__init__(self, self.server)
        self.arm_view = RobotView(self.server)
        self._sign = HoldSign(self.arm_view)
        self._add_controls()
        self._put(robot)

    def _put(self, robot: Robot) -> None:
        """Show a robot at home beside its table, in the place of another one."""
        self.robot = robot
        self.name.content = f"**{escaped(robot.name)}**"
        self.arm_view.put(robot)

    def _add_controls(self) -> None:
        gui = self.server.gui
        self.name = gui.add_markdown("")
        if self.attempts:
            self.shown = 0
            self.labels = [f"{i}: {a.object}, {'held' if a.success else a.stage}" for i, a in enumerate(self.attempts)]
            self.picked = gui.add_dropdown("Attempt", self.labels, initial_value=self.labels[0])
            self.picked.on_update(lambda event: None if event.client is None else self._pick())
        self._add_player("Play")
        self.cloud = gui.add_checkbox("Camera's cloud", True, hint="What was planned for, its unseen side estimated.")
        self.shapes = gui.add_checkbox("Objects", True, hint="As they were simulated.", disabled=not self.attempts)
        self.grasps: viser.GuiDropdownHandle[str] = gui.add_dropdown(
            "Grasps", [str(NONE), str(EVERY)], initial_value=NONE, hint="Lines from wrist to fingertips.")
        self.text = self.status = gui.add_markdown("")
        for choice in (self.cloud, self.shapes, self.grasps):
            choice.on_update(lambda _: self._show_layers())

    def _pick(self) -> None:
        """Repeat the attempt that was picked, once what plays has stopped; the one before stays where that fails."""
        before, self.film = self.film, None

        def work() -> None:
            try:
                self.repeat(self.labels.index(self.picked.value))
            except DroGraspError:
                self.film, self.picked.value = before, self.labels[self.shown]
                raise

        self._guarded(work, PATIENCE)

    def repeat(self, index: int) -> None:
        """Run a stored attempt once more with its own robot and weights, and show it, and what of these has changed since.

        Raises:
            OptionError: There is no such attempt, it is of another version, or the robot did not move.
            DroGraspError: The robot, the object or the weights cannot be used any more.
        """
        if not 0 <= index < len(self.attempts):
            raise OptionError(f"attempt is {index}; give one of 0 to {len(self.attempts) - 1}")
        stored, recorder = self.attempts[index], Recorder(RATE)
        config = TabletopConfig.from_label(stored.settings)
        self.text.content = f"Running attempt {index} once more: seeing, planning, lifting ..."
        same = stored.robot_sha256 == self.robot.sha256
        robot = self.robot if same else load_robot(stored.robot_file or stored.robot)
        obj = load_object(stored.object_file or stored.object)
        weights = self.weights or stored.weights or None
        made = self.make(robot, obj, stored.number, stored.seed, GraspPredictor(weights), config, recorder)
        film, self.film = Film.of_attempt(recorder), None
        if robot is not self.robot:
            self._put(robot)
        of_object = ((stored.solid_sha256, obj.solid_sha256) if stored.solid_sha256 else (stored.object_sha256, obj.sha256))
        others = [name for name, then, now in (
            ("robot", stored.robot_sha256, robot.sha256), ("object", *of_object),
            ("weights", stored.weights_sha256, describe_weights(weights)["sha256"])) if then not in {"", now}]
        changed = f"**Not as stored**: with other content than then: {', '.join(others)}. " if others else ""
        self.shown, self.picked.value = index, self.labels[index]
        self.show(film, changed + ("held" if made.success else f"**{escaped(made.stage)}**: {escaped(made.reason)}"))

    def show(self, film: Film, outcome: str = "") -> None:
        """Put a film on the page, and show its first picture."""
        scene, self.film = self.server.scene, film
        for name in ("/things", "/seen", "/grasps"):
            scene.remove_by_name(name)
        self._things = []
        for i, obj in enumerate(film.objects):
            assert obj.vertices is not None
            assert obj.faces is not None
            self._things.append(scene.add_mesh_simple(
                f"/things/{i}", obj.vertices, obj.faces, color=rgb(colour_of(i, True)), side="double"))
        self._clouds, said = [], [outcome]
        if film.plan is not None:
            for name, points, colour in (("object", film.plan.scene.points, SOLVED_COLOUR),
                                         ("others", film.plan.scene.others, DROPPED_COLOUR)):
                if len(points):
                    self._clouds.append(scene.add_point_cloud(
                        f"/seen/{name}", points.astype(np.float32), rgb(colour), point_size=POINT_SIZE, point_shape="circle",
                        precision="float32"))
            self.grasps.options = (NONE, EVERY, *dict.fromkeys(film.plan.scene.fate))
            said += map(escaped, film.plan.lines())
        self._said = "  \n".join(filter(None, said))
        self.moment.max, self.moment.value = len(film.arm) - 1, 0
        self.moment.disabled = self.play.disabled = False
        self._aim()
        self._show_layers()
        self.show_moment(0)

    def show_moment(self, moment: int) -> None:
        """Show one picture of the film."""
        film = self.film
        if film is None:
            return
        with self.server.atomic():
            self.arm_view.place(film.arm[moment], film.hand[moment])
            moving = self._things or self._clouds[:1]
            for handle, T in zip(moving, film.poses[moment], strict=False):
                move(handle, T)
            self._sign.show(film.arm[moment], film.held[moment] if film.held else None)
            words = f" {film.words[moment]}" if film.words else ""
            self.text.content = f"{moment / RATE:.1f} s{words}  \n\n{self._said}"

    def _play(self) -> None:
        assert self.film is not None
        self._roll(self.film, len(self.film.arm), 1 / RATE)

    def _show_layers(self) -> None:
        """Show and hide what the controls say."""
        if self.film is None:
            return
        for handles, visible in ((self._clouds, self.cloud.value), (self._things, self.shapes.value)):
            for handle in handles:
                handle.visible = visible
        self.server.scene.remove_by_name("/grasps")
        if self.film.plan is None or self.grasps.value == NONE:
            return
        scene, hand = self.film.plan.scene, self.robot.hand
        kept = [i for i, fate in enumerate(scene.fate) if self.grasps.value in {EVERY, fate}]
        T = scene.T_world_wrist[kept]
        ends = np.stack([T[:, :3, 3], hand.grasp_centres(torch.from_numpy(T).float()).double().numpy()], 1)
        colours = {CHOSEN: SUCCESS_COLOUR, READY: SOLVED_COLOUR, WAITING: WAITING_COLOUR}
        rows = np.array([rgb(colours.get(scene.fate[i], DROPPED_COLOUR)) for i in kept], np.uint8)
        self.server.scene.add_line_segments(
            "/grasps", ends.astype(np.float32), np.repeat(rows[:, None], 2, 1), thickness=2.0, thickness_units="screen")

    def _aim(self) -> None:
        """Look at the whole motion."""
        assert self.film is not None
        points = self.arm_view.swept(self.film.arm, self.film.hand)
        self.view.aim(Camera.around(points, VIEW, aspect=4 / 3))


def _require_same(robot: Robot, plan: MotionPlan, file: Path) -> None:
    """Refuse a robot whose wrist is elsewhere in the grasp than that of the plan, by an OptionError."""
    row = plan.part("press" if plan.notes.slide is not None else "approach").stop - 1
    planned, own = (T @ robot.T_wrist_aim for T in (
        np.array(plan.notes.T_world_wrist), robot.T_world_wrist(plan.arm.position[row])))
    far = np.linalg.norm(own[:3, 3] - planned[:3, 3]) > ELSEWHERE
    if far or (not robot.has_few_joints and np.abs(own[:3, :3] - planned[:3, :3]).max() > TURNED):
        raise OptionError(f"robot '{robot.name}' is not the one of the plan in {file}: its wrist is elsewhere; give the file "
                          "of that robot (robot=...)")


def lift_page(
    file: Path, chosen: int = 0, robot: str | None = None, weights: str | None = None, port: int = 8080, host: str = HOST,
    make: Callable[..., Attempt] = attempt, token: str | None = None,
) -> LiftPage:
    """A page for what `dro-grasp plan` or `dro-grasp tabletop` wrote; of attempts, the chosen one is shown first.

    Robot and weights are given, by name or file, where the file's own are not meant.
    """
    if file.suffix.lower() == ".npz":
        plan = MotionPlan.load(file)
        own = robot_of(file, robot, plan.notes.robot_file or plan.notes.robot)
        require_joints(own, len(plan.notes.arm_joints), len(plan.notes.hand_joints), f"the plan in {file}")
        _require_same(own, plan, file)
        page = LiftPage(own, (), weights, port, host, token=token)
        page.show(Film.of_plan(page.robot, plan))
        return page
    attempts = read_attempts(file)
    if not 0 <= chosen < len(attempts):
        raise OptionError(f"{file} has attempts 0 to {len(attempts) - 1}; attempt={chosen} is none of them")
    if robot is not None:
        attempts = [replace(a, robot_file=robot, robot_sha256="") for a in attempts]
    first = robot_of(file, robot, attempts[chosen].robot_file or attempts[chosen].robot)
    page = LiftPage(first, attempts, weights, port, host, make, token)
    with page._busy:  # a browser may be there already
        page.repeat(chosen)
    return page
