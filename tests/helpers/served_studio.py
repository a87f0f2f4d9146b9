"""The page that makes grasps, without a browser, or with what a page needs of one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import viser

from dro_grasp.apps.viewer.scene_view import HOST, ServedPage
from dro_grasp.apps.viewer.studio import Studio, StudioServer
from dro_grasp.errors import NoGraspError
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import Progress
from tests.helpers.browser import free_port
from tests.helpers.weights import untrained_weights


class Listener(GraspPredictor):
    """Notes what it is asked for, and makes nothing."""

    asked: list[tuple[GraspProblem, GraspRequest]]

    def run(self, problem: GraspProblem, request: GraspRequest, progress: Progress | None = None) -> Prediction:
        self.asked = [(problem, request)]
        raise NoGraspError("nothing is made")


@contextmanager
def served_studio(folder: Path, predictor: type[GraspPredictor] = GraspPredictor) -> Iterator[Studio]:
    """A page with a hand and an object, and weights in the folder."""
    served = ServedPage(free_port(), HOST)
    studio = Studio(served.server, predictor(str(untrained_weights(folder))), "gripper3", "sphere")
    studio.frame_seconds = 0.0
    try:
        yield studio
    finally:
        studio.close()
        served.stop()


def asked(studio: Studio) -> tuple[GraspProblem, GraspRequest]:
    """What a click on Generate asks of a `Listener`."""
    assert isinstance(studio.predictor, Listener)
    with pytest.raises(NoGraspError):
        studio._generate()
    return studio.predictor.asked[0]


class Browser(viser.ClientHandle):
    """What a page needs of a browser: a number, a camera, and controls and a scene."""

    def __init__(self, number: int, server: viser.ViserServer) -> None:
        self.client_id, self.gui, self.scene, self._server = number, server.gui, server.scene, server
        self.camera = SimpleNamespace(aspect=1.5)  # type: ignore[assignment]

    def atomic(self):
        return self._server.atomic()


def visited(served: StudioServer, count: int) -> list[Browser]:
    """Browsers that have opened their pages."""
    browsers = [Browser(number, served.server) for number in range(count)]
    served.server.get_clients = lambda: {b.client_id: b for b in browsers}  # type: ignore[method-assign]
    for browser in browsers:
        served.enter(browser)
    return browsers
