"""What the pages in the browser share: the scene of a hand and an object, work that is done once at a time, and the server."""

from __future__ import annotations

import asyncio
import contextlib
import http
import math
import re
import secrets
import signal
import socket
import sys
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterator
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
import viser
import viser.transforms
import websockets.asyncio.server
from jaxtyping import Float
from torch import Tensor
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import MultipleValuesError
from websockets.http11 import Request, Response

from dro_grasp.apps.origins import LOCAL, cookie_of, own_names, refusal, same_token, token_in_address, token_in_cookie
from dro_grasp.errors import DroGraspError, OptionError
from dro_grasp.geometry.rendering.rasterizer import OBJECT_COLOUR, Camera, Colour
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pictures import appearance

MAX_CONNECTIONS = 64  # Most open connections to one page (ours)
TOKEN_BYTES = 16  # Length of a token that is made up [bytes]
HOST = "127.0.0.1"  # Default address: only this machine can connect
POINT_SIZE = 0.0022  # Size of a drawn point [m]
CAMERA_DISTANCE = 1.15  # Initial camera distance, as a multiple of that of a picture
ASPECT = 4 / 3  # Width over height of a window from which on nothing is cut off
NARROW = 1.0  # Width over height of a window below which the panel covers its lower half, as on a phone
RAISED = 0.27  # Share of its height by which hand and object then stand above the middle (ours)
PATIENCE = 10.0  # Longest time in which work ends that is given up [s] (ours)
CLOSE_TIMEOUT = 5.0  # Time that a closed page has to end what it does [s] (ours)
TURN_POLL = 0.5  # Time after which a page that waits for another looks whether it is still wanted [s] (ours)
STOP_TIME = 0.3  # Time that a film which was stopped has to end, before it plays on [s] (ours)
GRID_DEPTH = 0.12  # Distance from the object's lowest point down to the grid [m]

Point = tuple[float, float, float]  # A place [m]
Handler = Callable[[ServerConnection], Awaitable[None]]  # What talks with one browser
Client = viser.ViserServer | viser.ClientHandle  # Whose page it is: that of all browsers, or of one


class SceneView:
    """One hand and one object on a page; `set_pair` replaces them."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.hand: Hand | None = None
        client.scene.set_up_direction("+z")
        self._camera: Camera | None = None
        if isinstance(client, viser.ViserServer):
            client.on_client_connect(self._turn)
        self._root = 0

    def set_pair(
        self, hand: Hand, obj: ObjectModel, joints: Float[Tensor, " n_dof"], T: Float[Tensor, "4 4"], on_table: bool = False
    ) -> None:
        """Replace hand and object, and move the camera to the best viewpoint, on a table from above.

        Args:
            joints: Initial joints [rad or m].
            T: Initial wrist pose in the object's frame [m].
        """
        scene, self.hand = self.client.scene, hand
        scene.remove_by_name(f"/pair{self._root}")
        self._root += 1  # what is removed late takes nothing of its successor with it
        name = f"/pair{self._root}"
        self._object = scene.add_frame(f"{name}/object", show_axes=False)
        for i, mesh in enumerate(appearance.object_meshes(obj)):
            scene.add_mesh_simple(f"{name}/object/{i}", mesh.vertices, mesh.faces, color=rgb(OBJECT_COLOUR), side="double")
        self.links = add_hand(scene, f"{name}/hand", hand)
        self.solved = self._cloud("solved", appearance.SOLVED_COLOUR)
        self.predicted = self._cloud("predicted", appearance.PREDICTED_COLOUR)
        self.contacts = self._cloud("contacts", appearance.CONTACT_COLOUR, size=0.005)
        position = (*obj.cloud.mean(0)[:2].tolist(), float(obj.cloud.min(0)[2]) - GRID_DEPTH)
        self._grid = scene.add_grid(f"{name}/grid", width=0.4, height=0.4, cell_size=0.05, section_size=0.1, position=position)
        self.aim(appearance.best_camera(hand, joints, T, obj, from_above=on_table))
        self.show(joints, T)

    def aim(self, camera: Camera) -> None:
        """Turn the cameras of all browsers that show the page, also of those that connect later."""
        self._camera = camera
        if isinstance(self.client, viser.ClientHandle):
            self._turn(self.client)
            return
        initial = self.client.initial_camera
        (initial.position, initial.look_at), initial.fov = viewpoint(camera), camera.field_of_view
        for client in self.client.get_clients().values():
            self._turn(client)

    def _turn(self, client: viser.ClientHandle) -> None:
        """Turn a client's camera to what is shown, from farther away where its window is narrow."""
        if (camera := self._camera) is not None:
            client.camera.up_direction = camera.up
            client.camera.position, client.camera.look_at = viewpoint(camera, client.camera.aspect)
            client.camera.fov = camera.field_of_view

    def _cloud(self, name: str, colour: Colour, size: float = POINT_SIZE) -> viser.PointCloudHandle:
        """Add points of a size [m], hidden until there are some to show."""
        return self.client.scene.add_point_cloud(
            f"/pair{self._root}/{name}", np.zeros((1, 3), np.float32), colors=rgb(colour), point_size=size,
            point_shape="circle", precision="float32", visible=False)

    def show(
        self, joints: Float[Tensor, " n_dof"], T: Float[Tensor, "4 4"], T_object: Float[Tensor, "4 4"] | None = None
    ) -> None:
        """Pose the hand, and the object if it has moved."""
        assert self.hand is not None
        with torch.no_grad():
            poses = (T @ self.hand.tree.forward(joints)).double().numpy()
            points = self.hand.points(joints, T).numpy()
        moved = np.eye(4) if T_object is None else T_object.double().numpy()
        with self.client.atomic():
            for frame, pose in zip([self._object, *self.links], [moved, *poses], strict=True):
                move(frame, pose)
            self.solved.points = points.astype(np.float32)

    def colour_grid(self, success: bool | None) -> None:
        """Show the trial outcome by the colour of the grid."""
        self._grid.cell_color = self._grid.section_color = rgb(appearance.success_colour(success))

    def show_shapes(self, visible: bool) -> None:
        """Show or hide the hand's shapes."""
        with self.client.atomic():
            for frame in self.links:
                frame.visible = visible


def add_hand(scene: viser.SceneApi, name: str, hand: Hand) -> list[viser.FrameHandle]:
    """Add the shapes of a hand to the scene; returns the frames of its links."""
    colours = appearance.link_colours(hand)
    links = [scene.add_frame(f"{name}/{i}", show_axes=False) for i in range(hand.tree.n_links)]
    for k, (link, vertices, faces) in enumerate(appearance.link_shapes(hand)):
        scene.add_mesh_simple(f"{name}/{link}/{k}", vertices, faces, color=rgb(colours[link]), side="double")
    return links


def beside_ray(
    points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """How far points are along a ray, and how far beside it [m]."""
    away = points - origin
    depth = away @ (direction / np.linalg.norm(direction))
    return depth, np.sqrt(np.maximum((away**2).sum(1) - depth**2, 0.0))


def move(handle: viser.SceneNodeHandle, T: Float[np.ndarray, "4 4"]) -> None:
    """Put something in the scene at a pose [m]."""
    handle.position, handle.wxyz = T[:3, 3], viser.transforms.SO3.from_matrix(T[:3, :3]).wxyz


def viewpoint(camera: Camera, aspect: float = ASPECT) -> tuple[Point, Point]:
    """Where a camera stands, and where it looks, so that a window of this width over height shows all of a picture [m]."""
    start, target = np.asarray(camera.position), np.asarray(camera.target)
    position = target + CAMERA_DISTANCE * max(1.0, ASPECT / aspect) * (start - target)
    if aspect < NARROW:
        height = 2 * float(np.linalg.norm(position - target)) * math.tan(camera.field_of_view / 2)
        down = -RAISED * height * camera.axes()[1]
        position, target = position + down, target + down
    return tuple(position.tolist()), tuple(target.tolist())


def rgb(colour: Colour) -> tuple[int, int, int]:
    """Red, green and blue as whole numbers to 255."""
    red, green, blue = (round(255 * c) for c in colour)
    return red, green, blue


@contextlib.contextmanager
def guarded_server(served_at: str, token: str | None = None) -> Iterator[None]:
    """Servers of viser that start within the block refuse foreign requests, those without the token, and too many.

    viser has no switch for it; it passes a function that sees every request to websockets, and this one is put before it.
    """
    serve, own = websockets.asyncio.server.serve, own_names(served_at)

    def guarded(handler: Handler, *args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        def check(connection: ServerConnection, request: Request) -> Response | None:
            crowd = len(getattr(connection.server, "connections", ())) > MAX_CONNECTIONS
            why = "too many browsers show it; close some" if crowd else foreign(request, own)
            if why:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"This page refuses the request: {why}.\n")
            if token and (answer := asked_for_token(connection, request, token)) is not None:
                return answer
            return None if process_request is None else process_request(connection, request)

        return serve(unmoved(handler), *args, process_request=check, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def foreign(request: Request, own: frozenset[str]) -> str:
    """Why a request is refused; empty if it is not."""
    try:
        return refusal(request.headers, own)
    except MultipleValuesError:
        return "it states its Host or Origin twice"


def asked_for_token(connection: ServerConnection, request: Request, token: str) -> Response | None:
    """The answer to a request that bears the token in its address, or not at all; None if the browser has it already."""
    if same_token(token_in_address(request.path), token):
        answer = connection.respond(http.HTTPStatus.SEE_OTHER, "")
        answer.headers["Location"] = "/"
        answer.headers["Set-Cookie"] = f"{cookie_of(token)}={quote(token, safe='')}; Path=/; HttpOnly; SameSite=Lax"
        return answer
    if same_token(token_in_cookie("; ".join(request.headers.get_all("Cookie")), token), token):
        return None
    return connection.respond(http.HTTPStatus.UNAUTHORIZED, "This page needs a token: open the address that `dro-grasp view` "
                                                            "prints, which ends with it.\n")


def unmoved(handler: Handler) -> Handler:
    """A handler of connections that closes those whose messages cannot be understood, and says so in one line."""
    async def handle(connection: ServerConnection) -> None:
        asyncio.get_running_loop().set_exception_handler(_tell_misunderstood)
        try:
            await handler(connection)
        except Exception as error:
            if not came_in(error):
                raise
            _misunderstood(error)
            await connection.close(1003, "the message was not understood")

    return handle


def came_in(error: BaseException | None) -> bool:
    """Whether an error arose where viser reads messages of browsers."""
    while error is not None:
        if {"_message_consumer", "_handle_incoming_message"} & {f.name for f in traceback.extract_tb(error.__traceback__)}:
            return True
        error = error.__context__
    return False


def _tell_misunderstood(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    if came_in(error := context.get("exception")):
        _misunderstood(error)
    else:
        loop.default_exception_handler(context)


def _misunderstood(error: BaseException | None) -> None:
    print(f"viewer: a browser's message was not understood ({type(error).__name__})", file=sys.stderr, flush=True)


def escaped(text: object) -> str:
    """Text that is shown as it is within Markdown, of which viser's browser renders HTML, JSX and links."""
    return re.sub(r"[&<>{}\[\]*`\\!#|~$\n]", lambda sign: f"&#{ord(sign.group())};", str(text))


class Closed(Exception):
    """The page was closed while it worked."""


class Page(ABC):
    """A page with a stage and a film of it, which does one thing at a time and shows errors."""

    status: viser.GuiMarkdownHandle  # What the page does, and errors; whoever inherits adds it

    def __init__(self, client: Client) -> None:
        self.client, self.view = client, SceneView(client)
        self.closed = threading.Event()
        """Whether nobody sees the page any more."""
        self._busy = threading.Lock()
        self._later: list[Callable[[], None]] = []
        """What was asked for while the page was busy."""
        self._film: Any = None
        self._plays = False
        self._picture = threading.RLock()
        """Held while a picture of the film is shown."""

    @property
    def film(self) -> Any:
        """What can be played, None for nothing; once there is another one, no picture of the one before is shown any more."""
        return self._film

    @film.setter
    def film(self, film: Any) -> None:
        with self._picture:
            self._film, self._plays = film, False

    def close(self) -> None:
        """End what the page does."""
        self.closed.set()
        self._busy.acquire(timeout=CLOSE_TIMEOUT)  # never released: nothing is done on this page any more

    @abstractmethod
    def show_moment(self, moment: int) -> None:
        """Show one picture of the film, if there is one."""

    @abstractmethod
    def _play(self) -> None:
        """Play the film."""

    def _add_player(self, label: str) -> None:
        """Add the controls of the film, disabled at first."""
        gui = self.client.gui
        self.play = gui.add_button(label, disabled=True, hint="From the moment that is shown; stops what plays.")
        self.moment = gui.add_slider("Moment", 0, 1, 1, 0, disabled=True, hint="Of what was played.")
        self.play.on_click(lambda _: self._play_or_stop())
        self.moment.on_update(lambda event: None if event.client is None else self._seek(int(self.moment.value)))

    def _play_or_stop(self) -> None:
        """Stop the film if it plays, and play it otherwise."""
        with self._picture:
            plays, self._plays = self._plays, False
        if not plays:
            self._guarded(self._play, STOP_TIME)

    def _seek(self, moment: int) -> None:
        """Stop the film, and show one picture of it."""
        with self._picture:
            self._plays = False
            self.show_moment(moment)

    def _roll(self, film: Any, moments: int, interval: float) -> bool:
        """Show a film picture by picture, each for an interval [s], until it is stopped; False if another took its place.

        It begins at the moment that is shown, or at the first where that is the last one.
        """
        with self._picture:
            first, self._plays = int(self.moment.value), self.film is film
        for moment in range(first if first < moments - 1 else 0, moments):
            begin = time.monotonic()
            if self.closed.is_set():
                raise Closed
            with self._picture:
                if not self._plays:
                    break
                self.show_moment(moment)
                self.moment.value = moment
            time.sleep(max(0.0, interval - (time.monotonic() - begin)))
        with self._picture:
            self._plays = False
            return self.film is film

    def _guarded(self, work: Callable[[], None], patience: float = 0.0, otherwise: str = "Busy; wait a moment.") -> None:
        """Do one thing at a time, and show errors on the page; `otherwise` is said if other work outlasts the patience [s]."""
        with contextlib.suppress(Closed):
            if not self._busy.acquire(timeout=patience):
                self._say(otherwise)
                return
            try:
                with self._telling():
                    work()
            finally:
                self._busy.release()
            if self._later:
                self._guarded(self._catch_up)

    def _afterwards(self, work: Callable[[], None]) -> None:
        """Do something at once, or when what goes on has ended; once, however often it is asked for meanwhile."""
        if work not in self._later:
            self._later.append(work)
        self._guarded(self._catch_up, otherwise="Busy; it is next.")

    def _catch_up(self) -> None:
        """Do what was asked for meanwhile."""
        while self._later:
            self._later.pop(0)()

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        """Show errors on the page, where a fault of ours would look like work that never ends; that is raised as well."""
        try:
            yield
        except DroGraspError as error:
            self._complain(error)
        except Closed:
            raise
        except Exception as error:
            self._say(f"**Error:** {escaped(f'{type(error).__name__}: {error}')}; this is a fault of dro-grasp")
            raise

    @contextlib.contextmanager
    def _when_it_is(self, turn: threading.Lock, still: Callable[[], None] = lambda: None) -> Iterator[None]:
        """Wait for the turn of this page to make grasps; `still` raises where they are no longer wanted meanwhile."""
        while not turn.acquire(timeout=TURN_POLL):
            still()
            self._say("Grasps of another page are made; these are next.")
        try:
            yield
        finally:
            turn.release()

    def _complain(self, error: DroGraspError) -> None:
        self._say(f"**Error:** {escaped(error)}")

    def _say(self, text: str) -> None:
        """Show a line."""
        if self.closed.is_set():  # nobody sees it any more, and whatever goes on ends here
            raise Closed
        self.status.content = text


class ServedPage:
    """Pages that are being served; `stop()` ends them."""

    def __init__(self, port: int, host: str, token: str | None = None) -> None:
        """Start serving at an address of this machine, 0.0.0.0 being the whole network; a port that is taken is counted up.

        Where others can connect, their browsers must know a token; one is made up if none is given.

        Raises:
            OptionError: The port is invalid, or the host is no address of this machine.
        """
        if not 0 < port < 2**16:
            raise OptionError(f"port is {port}; give a number from 1 to 65535, for example port=8080")
        if not host:
            raise OptionError(f"host is empty; give host={HOST} for this machine only, or 0.0.0.0 for the whole network")
        try:
            # viser would search for a free port forever.
            socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
        except OSError as error:
            raise OptionError(f"this machine cannot serve at '{host}' ({error}); give host={HOST} for this machine only, or "
                              "0.0.0.0 for the whole network") from error
        # viser prints a banner to stdout, which is reserved for tables and JSON.
        self.token = token or (None if host in LOCAL else secrets.token_urlsafe(TOKEN_BYTES))
        with contextlib.redirect_stdout(sys.stderr), guarded_server(host, self.token):
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        # A panel at the side leaves the hand in sight; narrow windows get it at the bottom.
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()

    @property
    def url(self) -> str:
        """Address of the page for a browser, with the token if it needs one."""
        token = "" if self.token is None else f"/?token={quote(self.token, safe='')}"
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}{token}"

    def stop(self) -> None:
        """Stop serving and free the port."""
        self.server.stop()


class SharedPage(ServedPage, Page):
    """A page that is the same in all browsers; `stop()` ends it."""

    def stop(self) -> None:
        """End what the page does, stop serving, and free the port."""
        self.close()
        super().stop()


def serve(page: ServedPage) -> None:
    """Print the address of the page, and serve it until Ctrl-C, SIGTERM or the end of the terminal."""
    print(f"viewer: {page.url} (Ctrl-C stops it)", file=sys.stderr, flush=True)
    with signals_as_interrupts():
        try:
            page.server.sleep_forever()
        except KeyboardInterrupt:
            pass
        finally:
            page.stop()


@contextlib.contextmanager
def signals_as_interrupts() -> Iterator[None]:
    """Within the block, what would end the process at once is a KeyboardInterrupt first, and then disregarded."""
    taken = {}
    if threading.current_thread() is threading.main_thread():
        signs = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
        taken = {sign: signal.SIG_DFL for sign in signs if signal.getsignal(sign) is signal.SIG_DFL}  # nohup ignores SIGHUP

    def interrupt(*_: object) -> None:
        for sign in taken:
            signal.signal(sign, signal.SIG_IGN)
        raise KeyboardInterrupt

    for sign in taken:
        signal.signal(sign, interrupt)
    try:
        yield
    finally:
        for sign, before in taken.items():
            signal.signal(sign, before)
