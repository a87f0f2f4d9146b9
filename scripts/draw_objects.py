"""A picture of objects, side by side on one sheet.

    python -m scripts.draw_objects docs/pictures/procedural-objects.png procedural:0-23

Names, files, folders and groups stand for objects as in commands.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from dro_grasp.geometry.rendering.rasterizer import Camera, render
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.pictures.appearance import object_meshes
from dro_grasp.pictures.sheets import contact_sheet

TILE = (200, 180)
"""Width and height of the picture of one object [pixels]."""
VIEW, UP = (1.0, -1.4, 0.9), (0.0, 0.0, 1.0)
"""Direction to the camera, and up."""
COLUMNS = 8


def main() -> None:
    """Draw and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("objects", nargs="+", help="names, files, folders or groups")
    options = parser.parse_args()
    tiles, captions = [], []
    for name in resolve_objects(options.objects):
        obj = load_object(name)
        meshes = object_meshes(obj)
        camera = Camera.around(np.concatenate([mesh.vertices for mesh in meshes]), VIEW, UP, aspect=TILE[0] / TILE[1])
        tiles.append(render(meshes, camera, *TILE))
        captions.append((f"{obj.name.removeprefix('procedural_')}   {100 * obj.extents.max():.0f} cm", None))
    contact_sheet(tiles, captions, f"{len(tiles)} objects: seed or name, largest extent", COLUMNS, outcomes=False).save(
        options.picture, optimize=True)


if __name__ == "__main__":
    main()
