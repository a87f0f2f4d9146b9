"""A sheet of attempts to lift objects with an arm, failures included: the closed hand, and the end of each attempt.

    python scripts/draw_attempts.py RESULTS PLANS docs/pictures/attempts.png [--count 12]

RESULTS and PLANS are what `dro-grasp tabletop --output RESULTS --plans PLANS` stores, for one robot. All failures are drawn, up
to half of the sheet, and successes beside them, in the order in which they were made; each plan is carried out once more.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dro_grasp.arm.planning.motion import MotionPlan
from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.arm.planning.workcell import Workcell
from dro_grasp.arm.robot_check import robot_meshes, table_meshes
from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.arm.robots.robot import Robot
from dro_grasp.arm.tabletop.animation import OBJECT_COLOUR, Recorder
from dro_grasp.arm.tabletop.attempts import Attempt, read_attempts
from dro_grasp.arm.tabletop.experiment import TabletopConfig, carry_out
from dro_grasp.geometry.rendering.rasterizer import Camera, Mesh, render
from dro_grasp.objects.catalogue import load_object

TILE = (170, 150)
"""Width and height of a picture [pixels]; each attempt has two."""
CAPTION = 18
"""Height of the line below [pixels]."""
COLUMNS = 3
"""Attempts side by side."""
VIEW = (1.0, -0.9, 0.45)
"""Direction from the object towards the camera, in the world."""
AROUND = 0.13
"""What is farther from the object is cut off [m]."""
HELD, LOST = (34, 139, 74), (200, 60, 50)
"""Colours of the captions of successes and failures."""
COLOURS = 128
"""Colours of the file, which keep it small."""


def pictures(robot: Robot, one: Attempt, made: MotionPlan) -> tuple[list[Image.Image], str]:
    """The hand once it has closed and at the end, and what became of it; the attempt is carried out once more."""
    obj, recorder = load_object(one.object_file), Recorder()
    scene = LiftScene(Workcell(robot), [obj])
    scene.place(0, np.array(json.loads(one.place)))
    stage, reason = carry_out(scene, made, TabletopConfig(), recorder)
    closed = round(float(made.arm.time[made.part("close").stop - 1]) * recorder.rate)
    drawn = []
    for arm, hand, poses in (recorder.frames[min(closed, len(recorder.frames) - 1)], recorder.frames[-1]):
        T = poses[0]
        assert obj.vertices is not None
        assert obj.faces is not None
        thing = Mesh(obj.vertices @ T[:3, :3].T + T[:3, 3], obj.faces, OBJECT_COLOUR)
        middle = thing.vertices.mean(0)
        camera = Camera.around(middle + AROUND * np.array([np.eye(3), -np.eye(3)]).reshape(6, 3), VIEW,
                               aspect=TILE[0] / TILE[1], margin=0.0)
        everything = [*table_meshes(robot.table), *robot_meshes(robot, arm, hand), thing]
        drawn.append(Image.fromarray(render(everything, camera, *TILE)))
    return drawn, "held" if stage == "done" else reason


def main() -> None:
    """Carry out, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="Parquet file of attempts")
    parser.add_argument("plans", type=Path, help="folder of their plans")
    parser.add_argument("output", type=Path, help="PNG file")
    parser.add_argument("--count", type=int, default=12, help="attempts on the sheet")
    options = parser.parse_args()
    done = [a for a in read_attempts(options.results)
            if a.processor_seconds > 0 and TabletopConfig.from_label(a.settings) == TabletopConfig()]
    failed = [a for a in done if not a.success][:options.count // 2]
    held = [a for a in done if a.success]
    held = held[:: max(1, len(held) // max(1, options.count - len(failed)))][:options.count - len(failed)]
    rows = -(-len(held + failed) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * 2 * TILE[0], rows * (TILE[1] + CAPTION)), (255, 255, 255))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for i, one in enumerate([*held, *failed]):
        made = MotionPlan.load(options.plans / f"{one.robot}-{one.object}-{one.number}.npz")
        drawn, ended = pictures(load_robot(one.robot_file), one, made)
        x, y = i % COLUMNS * 2 * TILE[0], i // COLUMNS * (TILE[1] + CAPTION)
        for k, picture in enumerate(drawn):
            sheet.paste(picture, (x + k * TILE[0], y))
        colour = HELD if ended == "held" else LOST
        pen.text((x + 4, y + TILE[1] + 2), f"{one.object} {one.number}: {ended}", fill=colour, font=font)
        print(f"{one.object}, attempt {one.number}: {ended}" + ("" if (ended == "held") == one.success else ", unlike before"),
              flush=True)
    sheet.quantize(COLOURS).save(options.output, optimize=True)


if __name__ == "__main__":
    main()
