"""A page that plays how a robot cleared its table: looks, picks, hold checks, and what became of each thing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dro_grasp.apps.viewer.robot_view import HoldSign, RobotView, require_joints, robot_of
from dro_grasp.apps.viewer.scene_view import HOST, POINT_SIZE, Page, ServedPage, SharedPage, escaped, move, rgb
from dro_grasp.arm.clearing.record import ClearRecord, Event, Judgement, Look, Picked
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.animation import FIXTURE_COLOUR, VIEW, colour_of
from dro_grasp.geometry.mesh_files import trimesh
from dro_grasp.geometry.rendering.rasterizer import Camera
from dro_grasp.grasps.hold import HoldState
from dro_grasp.pictures.appearance import SOLVED_COLOUR

SPEEDS = ("1 x", "2 x", "4 x", "8 x")  # How fast it can be played (ours)
SEEN = 12_000  # Most points of a look that are drawn (ours)
ABOVE = 0.008  # Points lower than this above the table are its own, and not drawn [m] (ours)
ANYWHERE = "..."  # What the list of beginnings shows; each can be chosen again
AT_START = "start"  # Choice of the beginning


class ClearPage(SharedPage):
    """A running page; `stop()` ends it.

    Examples:
        >>> page = ClearPage(ClearRecord.load("cleared.npz"), load_robot("xarm7_leaphand"))
    """

    def __init__(
        self, record: ClearRecord, robot: Robot, port: int = 8080, host: str = HOST, token: str | None = None
    ) -> None:
        """Start serving, at the first moment."""
        self.record, self.robot = record, robot
        ServedPage.__init__(self, port, host, token)
        Page.__init__(self, self.server)
        self.arm_view = RobotView(self.server)
        self._sign = HoldSign(self.arm_view)
        self._look = -1
        self._add_controls()
        self.arm_view.put(robot)
        self._add_things()
        points = [self.arm_view.swept(record.arm, record.hand), record.poses[0, :, :3, 3], *(v for v, _ in record.fixtures)]
        self.view.aim(Camera.around(np.concatenate([p.reshape(-1, 3) for p in points]), VIEW, aspect=4 / 3))
        self.film = record
        self.moment.max, self.moment.disabled, self.play.disabled = len(record.arm) - 1, False, False
        self.show_moment(0)

    def _add_controls(self) -> None:
        gui, record = self.server.gui, self.record
        changed = "" if record.robot_sha256 == self.robot.sha256 else (
            "  \n**The robot's files have changed since**; joints may mean something else.")
        gui.add_markdown(f"**{escaped(self.robot.name)}** clears its table: {summary(record)}{changed}")
        self._add_player("Play")
        self.speed = gui.add_dropdown("Speed", SPEEDS, initial_value=SPEEDS[2])
        self.starts = {AT_START: 0} | {
            f"pick {i}: {outcome(pick)}": begin for i, (begin, pick) in enumerate(picks(record), 1)}
        self.part = gui.add_dropdown("Go to", (ANYWHERE, *self.starts), initial_value=ANYWHERE)
        self.cloud = gui.add_checkbox("What the camera saw", True, hint="Above the table, at the last look before the moment.")
        self.text = self.status = gui.add_markdown("")
        with gui.add_folder("All that happened", expand_by_default=False):
            gui.add_markdown(diary(record))
        self.part.on_update(lambda event: None if event.client is None else self._go())
        self.cloud.on_update(lambda _: self._show_look())

    def _add_things(self) -> None:
        scene, record = self.server.scene, self.record
        for i, (vertices, faces) in enumerate(record.fixtures):
            scene.add_mesh_simple(f"/fixture/{i}", vertices, faces, color=rgb(FIXTURE_COLOUR), side="double")
        self._things = [
            scene.add_mesh_simple(f"/things/{i}", vertices, faces, color=rgb(colour_of(i, False)), side="double")
            for i, (vertices, faces) in enumerate(record.objects)]

    def _go(self) -> None:
        """Show the beginning of what was picked."""
        if (moment := self.starts.get(self.part.value)) is not None:
            self._seek(moment)
            self.moment.value = moment
        self.part.value = ANYWHERE

    def show_moment(self, moment: int) -> None:
        """Show one moment of the run."""
        record, moment = self.record, min(moment, len(self.record.arm) - 1)
        with self.server.atomic():
            self.arm_view.place(record.arm[moment], record.hand[moment])
            for handle, T in zip(self._things, record.poses[moment], strict=True):
                move(handle, T)
            self._sign.show(record.arm[moment], judged_at(record, moment))
            self.text.content = f"{moment / record.rate:.1f} s  \n{now(record, moment)}"
        look = max((e.cloud for e in record.events if isinstance(e, Look) and e.moment <= moment), default=-1)
        if look != self._look:
            self._look = look
            self._show_look()

    def _show_look(self) -> None:
        """Show what the camera saw last."""
        scene, camera = self.server.scene, self.robot.camera
        scene.remove_by_name("/look")
        if not self.cloud.value or camera is None or not 0 <= self._look < len(self.record.clouds):
            return
        points = trimesh.transform_points(self.record.clouds[self._look], camera.T_world_camera)
        points = points[points[:, 2] > self.robot.usual_table.height + ABOVE]
        points = points[:: max(1, len(points) // SEEN)]
        if not len(points):
            return
        scene.add_point_cloud("/look", points.astype(np.float32), rgb(SOLVED_COLOUR), point_size=POINT_SIZE,
                              point_shape="circle", precision="float32")

    def _play(self) -> None:
        record, fast = self.record, float(self.speed.value.split()[0])
        self._roll(record, len(record.arm), 1 / (record.rate * fast))


def clear_page(
    file: Path, robot: str | None = None, port: int = 8080, host: str = HOST, token: str | None = None
) -> ClearPage:
    """A page for what `dro-grasp clear --record` wrote; the robot is given where the record's own is not meant."""
    record = ClearRecord.load(file)
    own = robot_of(file, robot, record.robot)
    require_joints(own, record.arm.shape[1], record.hand.shape[1], f"the record in {file}")
    return ClearPage(record, own, port, host, token)


def picks(record: ClearRecord) -> list[tuple[int, Picked]]:
    """All picks, each with the moment at which it began."""
    found, begin = list[tuple[int, Picked]](), 0
    for event in record.events:
        if isinstance(event, Picked):
            found.append((begin, event))
            begin = event.moment
    return found


def outcome(pick: Picked) -> str:
    """What became of a pick, in a word or two."""
    return "in the bin" if not pick.reason else f"failed ({pick.stage})"


def judged_at(record: ClearRecord, moment: int) -> tuple[HoldState, float] | None:
    """What the last hold check of the pick that goes on said, and how surely; None before it."""
    last = next((e for e in reversed(record.events) if e.moment <= moment), None)
    return (last.state, last.confidence) if isinstance(last, Judgement) else None


def summary(record: ClearRecord) -> str:
    """A run in a line."""
    every = [pick for _, pick in picks(record)]
    done, checks = sum(not pick.reason for pick in every), [e for e in record.events if isinstance(e, Judgement)]
    looks = sum(isinstance(e, Look) for e in record.events)
    return (f"{looks} looks, {len(every)} picks, of which {done} ended in the bin, and {len(checks)} hold checks, in "
            f"{len(record.arm) / record.rate:.0f} s.")


def now(record: ClearRecord, moment: int) -> str:
    """What goes on at a moment, and what has happened in this pick, in Markdown."""
    ended = [event for event in record.events if isinstance(event, Picked) and event.moment < moment]
    coming = next((pick for _, pick in picks(record) if pick.moment >= moment), None)
    since = record.events.index(ended[-1]) + 1 if ended else 0
    happened = [event for event in record.events[since:] if event.moment <= moment and not isinstance(event, Picked)]
    if coming is None:
        return "  \n".join(["**Nothing is left to pick**", *map(in_words, happened)])
    checks, (x, y) = [event for event in happened if isinstance(event, Judgement)], coming.place
    if checks and checks[-1].state in ("empty", "slipping"):
        doing = "The hand opens, and the arm goes home; then the camera looks again"
    else:
        doing = (f"Going for the thing at ({x:.2f}, {y:.2f}) m", "Carrying it to the bin", "Letting it go, and going home")[
            min(len(checks), 2)]
    return "  \n".join([f"**{doing}**", *map(in_words, happened)])


def in_words(event: Event) -> str:
    """An event, in Markdown."""
    if isinstance(event, Look):
        return f"look {event.cloud + 1} at the table"
    if isinstance(event, Judgement):
        wrong = event.held is not None and event.held != (event.state == "held")
        return f"hold check: **{event.state}**, {event.confidence:.0%} sure" + (", which is wrong" if wrong else "")
    x, y = event.place
    if not event.reason:
        return f"✓ the thing from ({x:.2f}, {y:.2f}) m is in the bin"
    return f"✗ the thing at ({x:.2f}, {y:.2f}) m, {escaped(event.stage)}: {escaped(event.reason)}"


def diary(record: ClearRecord) -> str:
    """All that happened, with its time, in Markdown."""
    return "  \n".join(f"{event.moment / record.rate:.0f} s {in_words(event)}" for event in record.events)
