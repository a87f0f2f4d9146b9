"""The picture of the page of a scene in the documents: a bottle among other things, clicked in headless Chromium.

    python -m scripts.draw_scene_page docs/pictures/scene-page.png

Needs Chromium.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.tabletop.experiment import TabletopConfig, depth_image, scatter
from dro_grasp.objects.catalogue import load_object
from tests.helpers.browser import page_of

ROBOT = "xarm7_leaphand"
OBJECTS = ("bottle", "cup", "can", "brick", "bowl")
BOTTLE, FREE = (560, 545), (150, 600)  # Where the bottle is on the page, and later a free place on the table [pixels]


def write_scene(folder: Path) -> tuple[str, str]:
    """What the robot's camera sees of some objects, as a depth image in millimetres; and the camera."""
    robot = load_robot(ROBOT)
    scene = LiftScene(Workcell(robot), [load_object(name) for name in OBJECTS])
    assert scatter(scene, TabletopConfig.region, np.random.default_rng(3))
    assert robot.camera is not None
    depth, _ = depth_image(scene, robot.camera, "stereo", 5)
    Image.fromarray((1000 * np.nan_to_num(depth)).round().astype(np.uint16)).save(folder / "depth.png")
    camera = {"frame": "world", "T_frame_camera": robot.camera.T_world_camera.tolist(),
              "intrinsics": robot.camera.intrinsics.tolist()}
    (folder / "camera.json").write_text(json.dumps(camera))
    return str(folder / "depth.png"), str(folder / "camera.json")


def main(path: Path) -> None:
    """Serve, click a thing and a place, take the picture."""
    with tempfile.TemporaryDirectory() as folder:
        scene, camera = write_scene(Path(folder))
        with page_of("--scene", scene, "--camera", camera, "--robot", ROBOT, size=(1280, 860)) as page:
            page.add_style_tag(content=".mantine-Notifications-root { display: none }")  # that there is no graphics card
            page.get_by_text("Click a thing").first.wait_for(timeout=60_000)
            time.sleep(8)
            page.mouse.click(*BOTTLE)
            page.get_by_text("The arm can carry out").wait_for(timeout=400_000)
            time.sleep(8)
            page.mouse.click(*FREE)
            page.get_by_text("grasps can put it at").wait_for(timeout=400_000)
            time.sleep(8)
            page.screenshot(path=path, timeout=300_000)
    Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
