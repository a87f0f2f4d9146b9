"""The gallery of the documents: the best grasp of each hand on each object after closing, failures included, on one sheet.

    python scripts/draw_gallery.py docs/pictures/gallery.png [--hands HAND ...] [--objects NAME ...]

The best by score of the candidates that `generate` makes for one grasp is drawn, whatever becomes of it in its trial. Needs the
development assets by default.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

import dro_grasp as dro
from dro_grasp.objects.catalogue import resolve_objects
from dro_grasp.pictures.appearance import success_colour
from dro_grasp.pictures.sheets import after_closing, draw_grasp, outcome
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL

HANDS = ("allegro", "barrett", "gripper3", "leaphand", "shadowhand",
         *(f"assets/{name}" for name in ("inspire", "ability", "dclaw", "orca", "ezgripper")))
"""The built-in hands, and hands that no training saw."""
TILE = (132, 116)
"""Width and height of a picture [pixels]."""
MARGIN = (96, 28)
"""Width of the names of hands, height of those of objects [pixels]."""
COLOURS = 128
"""Colours of the file, which keep it small."""


def main() -> None:
    """Predict, evaluate, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="PNG file")
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="rows")
    parser.add_argument("--objects", nargs="+", default=["builtin:test"], help="columns")
    options = parser.parse_args()
    objects = [dro.load_object(name) for name in resolve_objects(options.objects)]
    predictor, held, dots = dro.GraspPredictor(), 0, []
    sheet = Image.new("RGB", (MARGIN[0] + len(objects) * TILE[0], MARGIN[1] + len(options.hands) * TILE[1]), (255, 255, 255))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for column, obj in enumerate(objects):
        pen.text((MARGIN[0] + column * TILE[0] + 6, 6), obj.name, fill=(40, 44, 52), font=font)
    for row, name in enumerate(options.hands):
        hand = dro.load_hand(name)
        pen.text((6, MARGIN[1] + row * TILE[1] + 48), hand.name.removeprefix("assets/"), fill=(40, 44, 52), font=font)
        for column, obj in enumerate(objects):
            problem = dro.GraspProblem(hand, obj)
            grasps = dro.evaluate(problem, predictor.run(problem, dro.GraspRequest(1)).grasps)
            held += int(grasps.success.sum())
            x, y = MARGIN[0] + column * TILE[0], MARGIN[1] + row * TILE[1]
            if len(grasps):
                picture = draw_grasp(hand, obj, after_closing(hand, obj, grasps), 0, dro.PictureStyle(TILE))
                sheet.paste(Image.fromarray(picture), (x, y))
                dots.append((x + 4, y + 4, outcome(grasps, 0)))
        print(f"{hand.name}: {held} of {(row + 1) * len(objects)} so far hold under {DEFAULT_PROTOCOL}", flush=True)
    finished(sheet, dots).save(options.output, optimize=True)


def finished(sheet: Image.Image, dots: list[tuple[int, int, bool | None]]) -> Image.Image:
    """The sheet in few colours, and a dot in the exact colour of its outcome on each picture."""
    small = sheet.quantize(COLOURS).convert("RGB")
    pen = ImageDraw.Draw(small)
    for x, y, passed in dots:
        red, green, blue = (round(255 * c) for c in success_colour(passed))
        pen.ellipse((x, y, x + 8, y + 8), fill=(red, green, blue))
    return small.quantize(COLOURS + 8)


if __name__ == "__main__":
    main()
