"""The page that makes grasps, without a browser."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dro_grasp.predictor import GraspPredictor
from dro_grasp.viewer.stage import HOST, ServedPage
from dro_grasp.viewer.studio import Studio
from tests.helpers.browser import free_port
from tests.helpers.weights import untrained_weights


@contextmanager
def served_studio(folder: Path) -> Iterator[Studio]:
    """A page with a hand and an object, and weights in the folder."""
    served = ServedPage(free_port(), HOST)
    studio = Studio(served.server, GraspPredictor(str(untrained_weights(folder))), "gripper3", "sphere")
    try:
        yield studio
    finally:
        studio.close()
        served.stop()
