"""How far the side that is added to what was seen of an object lies from its surface, beside a mirror where the seen side ends.

    python benchmarks/completion.py [--views N] [--picture PNG] [--json]

The picture shows depth images of the validate objects from the side: blue was seen, orange was added, grey is the object.
Needs the development assets.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from report import emit
from scipy.spatial import KDTree

from dro_grasp.evaluation.views import seen_side
from dro_grasp.geometry.rasterizer import Camera, Mesh, dots, render
from dro_grasp.objects.completion import completed
from dro_grasp.objects.library import load_object, resolve_objects
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.viewer.pictures import contact_sheet

GROUPS = ("assets:train", "assets:validate")
TILE, COLUMNS, DRAWN = (260, 240), 5, 500
"""Size of a picture [pixels], pictures in a row, points drawn of each side."""
GREY, SEEN, ADDED = (0.82, 0.83, 0.85), (0.16, 0.38, 0.78), (0.93, 0.50, 0.13)


def mirrored(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "n 3"]:
    """The naive other side."""
    view = normals.mean(0) if camera is None else camera - points.mean(0)
    view = view / np.linalg.norm(view)
    along = points @ view
    return points + 2 * (np.quantile(along, 0.02) - along)[:, None] * view


def draw(path: Path) -> None:
    """One depth image of each validate object, seen with the camera to the left."""
    tiles, captions = [], []
    for name in resolve_objects(["assets:validate"]):
        obj = load_object(name)
        tiles.append(tile(obj))
        captions.append((obj.name.rpartition("+")[2], None))
    sheet = contact_sheet(tiles, captions, "what a camera on the left saw (blue), and what symmetry adds (orange)", COLUMNS)
    Image.Image.save(sheet, path)


def tile(obj: ObjectModel) -> np.ndarray:
    """One object, half transparent, with the points that were seen and added."""
    points, normals, camera = seen_side(obj, "depth", 0)
    assert camera is not None
    both, _ = completed(points, normals, camera)
    towards = (camera - points.mean(0)) / np.linalg.norm(camera - points.mean(0))
    across = np.cross(towards, np.eye(3)[np.abs(towards).argmin()])
    across /= np.linalg.norm(across)
    n = len(points)
    rng = np.random.default_rng(0)
    marks = [dots(part[rng.permutation(n)[:DRAWN]], colour, radius=0.0012)
             for part, colour in ((both[:n], SEEN), (both[n:], ADDED))]
    view = Camera.around(
        np.concatenate([obj.cloud, both]), tuple(across), up=tuple(np.cross(towards, across)), aspect=TILE[0] / TILE[1])
    assert obj.vertices is not None
    assert obj.faces is not None
    solid, clear = (render([*more, *marks], view, *TILE).astype(float) for more in ([Mesh(obj.vertices, obj.faces, GREY)], []))
    return (0.5 * solid + 0.5 * clear).astype(np.uint8)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=3, help="views of each object")
    parser.add_argument("--picture", type=Path, default=None, help="PNG to draw")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if options.picture is not None:
        draw(options.picture)
    rows = []
    for view in ("half", "depth"):
        for group in GROUPS:
            found, naive, seconds = [], [], 0.0
            for name in resolve_objects([group]):
                obj = load_object(name)
                surface = KDTree(obj.cloud)
                for seed in range(options.views):
                    points, normals, camera = seen_side(obj, view, seed)
                    begin = time.perf_counter()
                    both, _ = completed(points, normals, camera)
                    seconds += time.perf_counter() - begin
                    found.append(1e3 * surface.query(both[len(points):])[0].mean())
                    naive.append(1e3 * surface.query(mirrored(points, normals, camera))[0].mean())
            rows.append([view, group, len(found), float(np.mean(naive)), float(np.mean(found)), float(np.median(found)),
                         1e3 * seconds / len(found)])
    columns = ["view", "objects", "views", "mirror, mean [mm]", "symmetry, mean [mm]", "symmetry, median [mm]", "time [ms]"]
    emit("distance of the added side from the surface", rows, columns,
         {f"{row[0]} {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
