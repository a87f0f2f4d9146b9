"""`dro-grasp view`, `picture` and `serve`: grasps in the browser, on one sheet, and for a robot over HTTP."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from dro_grasp.cli.evaluate import compare, require_object
from dro_grasp.cli.given_scene import ROBOT, seen_from
from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.output import say_doubts, say_file
from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.extras import require_extra
from dro_grasp.files import check_output
from dro_grasp.kinds import require_positive

if TYPE_CHECKING:
    from collections.abc import Callable
    from threading import Lock

    from dro_grasp.apps.viewer.scene_view import Client, Page, ServedPage
    from dro_grasp.apps.viewer.studio import Studio
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.objects.perception.scene_files import SceneCamera
    from dro_grasp.objects.shape import ObjectModel

MAX_PIXELS = 50_000_000  # Most pixels of all pictures on a sheet together


@dataclass(frozen=True)
class View:
    """View grasps, a camera's scene, plans and runs of an arm in the browser, or make grasps there. Needs the extra `[apps]`.

    Examples: dro-grasp view grasps.parquet; dro-grasp view --scene depth.png --camera camera.json --hand allegro
    """

    file: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[FILE]")] = None
    """Grasp file, or a folder of them; a plan; attempts of `dro-grasp tabletop`; or a record of `dro-grasp clear`. Without it,
    the page lets you choose a hand and an object, generate grasps, watch trials and export."""
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Hand to use instead of the one named in the file, or, without a file, to pick first."""
    object: Annotated[str | None, optional("NAME|PATH", "the names in the file")] = None
    """Object to show first: a name in the file, or a mesh to use for the file's only object. Without a file: any object."""
    scale: Annotated[float | None, optional("FACTOR", "1, or that of the file's object")] = None
    """Factor for the coordinates of the mesh given with --object, or of --scene."""
    scene: Annotated[Path | None, optional("CLOUD|DEPTH", "none")] = None
    """What a camera saw, a cloud or a depth image: click a thing in it, and see grasps of it with all else as obstacles; with
    --robot, also plan and play the motion. Without --camera, the cloud is in the frame of the grasps."""
    camera: Annotated[str | None, optional("JSON|robot", "none")] = None
    """Camera of the scene, as for `dro-grasp generate`; or `robot` for that of the robot file."""
    port: int = 8080  # Port to serve on; if it is taken, the next free one.
    host: str = "127.0.0.1"
    """Address to serve at. By default only this machine can connect; 0.0.0.0 serves the whole network and needs a token."""
    token: Annotated[str | None, optional("TOKEN", "DRO_GRASP_TOKEN, or one made up for other machines")] = None
    """Token that browsers must know; the address that is printed holds it."""
    attempt: int = 0  # Number of the attempt in the file to run again and show first.
    robot: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Robot to use instead of the one named in a plan, an attempt or a record; or whose hand grasps in the scene."""
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights, or the attempts' own")] = None
    """Weights for grasps generated on the page, or to use instead of those of the attempts."""
    device: str = "cpu"  # Device for the network and the energies of grasps generated on the page: cpu, cuda or cuda:1.

    def run(self, show: Callable[[ServedPage], None] | None = None) -> int:
        """Serve the page, or show it in another way, with the grasps of the file if there is one."""
        require_extra("apps")
        from dro_grasp.apps.viewer.scene_view import serve

        token = self.token or os.environ.get(TOKEN) or None
        self._check_scene()
        if self.scene is not None:
            from dro_grasp.apps.viewer.studio import StudioServer

            (show or serve)(StudioServer(self._of_scene(self.scene), self.port, self.host, token))
            return 0
        motion = self.file is not None and is_motion(self.file)
        if self.file is not None and motion:
            self._refuse("grasps, and the file holds a motion", "hand", "object", "scale", "device")
            if self.file.suffix.lower() == ".npz":
                self._refuse("attempts, and the file holds none", "attempt", "weights")
        else:
            self._refuse("motions of an arm, or for --scene", "robot", "attempt")
            require_object(self.scale, self.object)
        if self.file is not None and motion:
            require_extra("arm")
            from dro_grasp.apps.viewer.clear_page import clear_page
            from dro_grasp.apps.viewer.lift_page import lift_page
            from dro_grasp.arm.clearing.record import is_record

            if is_record(self.file):
                (show or serve)(clear_page(self.file, self.robot, self.port, self.host, token))
                return 0
            (show or serve)(lift_page(self.file, self.attempt, self.robot, self.weights, self.port, self.host, token=token))
            return 0
        from dro_grasp.apps.viewer.studio import StudioServer

        (show or serve)(StudioServer(self._picked() if self.file is None else self._opened(self.file), self.port, self.host,
                                      token))
        return 0

    def _refuse(self, what: str, *options: str) -> None:
        """Refuse options that are for something else, by an OptionError."""
        usual = {field.name: field.default for field in fields(self)}
        if given := [f"--{name}" for name in options if getattr(self, name) != usual[name]]:
            raise OptionError(f"{' and '.join(given)} {'are' if given[1:] else 'is'} for {what}; leave it out")

    def _check_scene(self) -> None:
        """Refuse options that contradict one another, by an OptionError."""
        if self.scene is None:
            if self.camera is not None:
                raise OptionError("--camera is that of a scene; give the scene, too: --scene CLOUD|DEPTH")
            return
        self._refuse("attempts of an arm, which are in a file", "attempt")
        for option, value in (("FILE", self.file), ("--object", self.object)):
            if value is not None:
                raise OptionError(f"--scene and {option} are given; leave out one of them: the thing is chosen on the page")
        if self.robot is not None and self.hand is not None:
            raise OptionError("--robot and --hand are given, and the robot has a hand; leave out one of them")
        if self.camera == ROBOT and self.robot is None:
            raise OptionError("--camera robot is that of a robot file; name the robot, too: --robot NAME|PATH")

    def _of_scene(self, file: Path) -> Callable[[Client, Lock], Page]:
        """What makes the page of a scene, which is read and taken apart once for all browsers."""
        from dro_grasp.hands.library import load_hand
        from dro_grasp.objects.scenery import load_scene
        from dro_grasp.predict.predictor import GraspPredictor

        camera: SceneCamera | str | None = self.camera
        if self.robot is None:
            from dro_grasp.apps.viewer.scene_page import ScenePage

            hand = load_hand(self.hand or "allegro")
            scene = load_scene(file, scale=1.0 if self.scale is None else self.scale, camera=camera)
            made = partial(ScenePage, predictor=GraspPredictor(self.weights, self.device), scene=scene, hand=hand)
        else:
            require_extra("arm")
            from dro_grasp.apps.viewer.scene_motion import RobotScenePage
            from dro_grasp.arm.robots.loading import load_robot

            robot = load_robot(self.robot)
            camera = seen_from(self.camera, robot)
            scene = load_scene(file, scale=1.0 if self.scale is None else self.scale, camera=camera)
            made = partial(RobotScenePage, predictor=GraspPredictor(self.weights, self.device), scene=scene, robot=robot)
        _ = scene.segments  # refused before a browser comes
        return lambda client, turn: made(client, turn=turn, camera=camera)

    def _opened(self, file: Path) -> Callable[[Client, Lock], Studio]:
        """What makes a page that shows the grasps of a file."""
        from dro_grasp.grasps.batch import load_grasps
        from dro_grasp.grasps.sources import hand_of

        grasps = load_grasps(file)
        hand = hand_of(grasps, self.hand)
        grasps.require_hand(hand)
        obj, chosen = of_object(grasps, self.object, self.scale)
        given = self.object is not None and (self.scale is not None or self.object not in dict(grasps.by_object()))
        return self._pages(lambda studio: studio.open(
            hand, chosen if given else grasps, obj if given else None, self.object))

    def _picked(self) -> Callable[[Client, Lock], Studio]:
        """What makes a page without a file, on which the hand and the object that are named are picked."""
        from dro_grasp.hands.library import load_hand
        from dro_grasp.objects.catalogue import load_object

        hand = None if self.hand is None else load_hand(self.hand)
        obj = None if self.object is None else load_object(self.object, scale=1.0 if self.scale is None else self.scale)
        return self._pages(None if hand is None and obj is None else lambda studio: studio.offer(hand, obj))

    def _pages(self, fill: Callable[[Studio], None] | None) -> Callable[[Client, Lock], Studio]:
        """What makes the page of a browser, which is filled with what was given, and with a first pair otherwise."""
        from dro_grasp.apps.viewer.studio import Studio
        from dro_grasp.predict.predictor import GraspPredictor

        predictor = GraspPredictor(self.weights, self.device)

        def made(client: Client, turn: Lock) -> Studio:
            studio = Studio(client, predictor, turn=turn, preview=fill is None)
            if fill is not None:
                fill(studio)
            return studio

        return made


@dataclass(frozen=True)
class Picture:
    """Draw the grasps of a file on one sheet, without a browser or OpenGL.

    Example: dro-grasp picture grasps.parquet --output sheet.png --opacity 0.5 --contacts
    """

    file: tyro.conf.Positional[Path]  # Grasp file, or a folder of them, as `generate` fills it for a folder of objects.
    output: Path  # PNG file to write.
    count: int = 16  # Limit of grasps drawn, from the first on.
    columns: int = 4  # Pictures side by side.
    size: tuple[int, int] = (320, 280)  # Width and height of one picture [pixels], at most 4096 each.
    opacity: float = 1.0  # Opacity of the object; below 1 the hand shows through it.
    contacts: Flag = False  # Mark contacts in red.
    posture: Literal["held", "grasp"] = "held"
    """Draw hand and object after the hand has closed, or the grasp from which it closes."""
    only_successful: Flag = False  # Draw only grasps that passed their trial.
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None  # Hand to use instead of the one named in the file.
    object: Annotated[str | None, optional("NAME|PATH", "every object in the file")] = None
    """Object to draw: a name in the file, or a mesh to use for the file's only object. Several objects share the sheet."""
    scale: Annotated[float | None, optional("FACTOR", "that of the file's object")] = None
    """Factor for the coordinates of the mesh given with --object."""

    def run(self) -> int:
        """Load the file and draw."""
        from dro_grasp.grasps.batch import load_grasps
        from dro_grasp.grasps.sources import hand_of
        from dro_grasp.pictures.sheets import PictureStyle, draw_sheet

        require_object(self.scale, self.object)
        require_positive(count=self.count, columns=self.columns)
        style = PictureStyle(self.size, self.opacity, self.contacts, self.posture)
        check_output(self.output, ".png")
        grasps = load_grasps(self.file)
        hand = hand_of(grasps, self.hand)
        grasps.require_hand(hand)
        compare("hand", grasps.hand, grasps.hand_sha256, hand)
        pairs = self.pairs(grasps)
        shown = sum(len(own) for _, own in pairs)
        if (pixels := shown * self.size[0] * self.size[1]) > MAX_PIXELS:
            raise OptionError(f"{shown} pictures of {self.size[0]} x {self.size[1]} are {pixels / 1e6:.0f} million pixels; a "
                              f"sheet has at most {MAX_PIXELS // 10**6} million: give a smaller --size or --count")
        draw_sheet(hand, pairs, self.output, self.columns, style)
        say_file("picture", self.output)
        return 0

    def pairs(self, grasps: GraspBatch) -> list[tuple[ObjectModel, GraspBatch]]:
        """Objects on the sheet, each with those of its grasps that are drawn."""
        def wanted(own: GraspBatch) -> GraspBatch:
            return own if not self.only_successful else own[own.trial_success]

        names = [self.object] if self.object is not None else [
            name for name, own in grasps.by_object() if len(wanted(own))]
        share = max(1, self.count // max(1, len(names)))
        pairs = [of_object(grasps, name, self.scale) for name in names[: self.count]]
        for obj, own in pairs:
            compare("object", own.object[0], next(filter(None, own.object_sha256), ""), obj)
        pairs = [(obj, wanted(own)[:share]) for obj, own in pairs]
        if self.only_successful and not any(len(own) for _, own in pairs):
            of = "" if self.object is None else f" of {self.object}"
            raise GraspFileError(f"no grasp{of} in {self.file} has passed a trial; leave out --only-successful")
        return pairs


TOKEN = "DRO_GRASP_TOKEN"  # Environment variable of the token, which others cannot read in a list of processes


@dataclass(frozen=True)
class Serve:
    """Answer requests for grasps over HTTP, without the start-up time of a command. Needs the extra `[apps]`.

    Example: dro-grasp serve --hand my_hand.urdf --port 8090
    """

    hand: tuple[str, ...] = ()  # Names or files of hands to load at the start. Requests can name built-in hands as well.
    object: tuple[str, ...] = ()
    """Files or folders of objects that requests can name. Requests can also name built-in objects, or send their own."""
    host: str = "127.0.0.1"
    """Address to serve at. By default only this machine can connect; 0.0.0.0 serves the whole network and needs a token."""
    port: int = 8090  # Port to serve on.
    token: Annotated[str | None, optional("TOKEN", "DRO_GRASP_TOKEN, or none")] = None
    """Token that requests must carry, in the header `Authorization: Bearer TOKEN`."""
    queue: int = 16  # Requests that may wait; more are refused.
    time_limit: float = 60.0  # Longest computation of one request [s]; a longer one is ended.
    megabytes: float = 32.0  # Largest request [MB].
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Name of shipped weights or the path of a weights file."""
    device: str = "cpu"  # Device for the network and the energies: cpu, cuda or cuda:1. Trials always run on the CPU.

    def run(self) -> int:
        """Check, load, and serve until Ctrl-C or SIGTERM."""
        require_extra("apps")
        from dro_grasp.apps.server.answering import ServerConfig
        from dro_grasp.apps.server.http_server import Access, listening_socket, serve_grasps
        from dro_grasp.apps.server.request_queue import RequestQueue
        from dro_grasp.hands.library import load_hand_description

        access = Access(self.host, self.token or os.environ.get(TOKEN), self.megabytes)
        with listening_socket(self.host, self.port) as listener:
            config = ServerConfig(self.weights, self.device, self.hand, self.object)
            queue = RequestQueue(config, self.queue, self.time_limit)
            for name in self.hand:
                say_doubts(load_hand_description(name)[0])
            host, port = listener.getsockname()[:2]
            print(f"grasp server: http://{f'[{host}]' if ':' in host else host}:{port}, requests at /docs (Ctrl-C stops it)",
                  file=sys.stderr, flush=True)
            serve_grasps(queue, access, listener)
        return 0


def is_motion(file: Path) -> bool:
    """Whether a file holds a plan or attempts of an arm, and not grasps."""
    if file.suffix.lower() == ".npz":
        return True
    if file.suffix.lower() != ".parquet" or not file.is_file():
        return False
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return {"stage", "settings", "robot"} <= set(pq.read_schema(file).names)
    except (OSError, pa.ArrowInvalid):
        return False


def of_object(grasps: GraspBatch, name: str | None, scale: float | None) -> tuple[ObjectModel, GraspBatch]:
    """An object and its grasps: one that the grasps name, or a mesh to use for their only object. By default their first."""
    from dro_grasp.grasps.sources import object_of

    parts = dict(grasps.by_object())
    if name is not None and name not in parts and len(parts) > 1:
        listed = ", ".join(list(parts)[:8]) + (", ..." if len(parts) > 8 else "")
        raise OptionError(f"--object is '{name}', but the grasps are of {len(parts)} objects ({listed}); give one of these "
                          "names: another object fits only a file of one object")
    own = name if name in parts else grasps.object[0]
    return object_of(parts[own], None if name == own and scale is None else name, scale), parts[own]
