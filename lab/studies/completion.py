"""Accuracy of the completed side of an object, beside completion by a mirror and by the best symmetry.

    python -m lab.studies.completion [--views N] [--picture PNG] [--json]

Two errors: the distance of added points from the object's surface, and of the unseen surface from the added points. The
mirror stands where the seen side ends; the symmetry is the one that agrees best with the seen side, without the network. The
picture shows depth images of the validate objects from the side: seen points in blue, added points in orange, the object in
grey. Needs the development assets.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from scipy.spatial import KDTree

from dro_grasp.geometry.rendering.rasterizer import Camera, Mesh, dots, render
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.perception.completion import complete_cloud, to_view_axes
from dro_grasp.objects.perception.partial_views import visible_side
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.pictures.sheets import contact_sheet
from lab.benchmarks.report import emit, options_of

GROUPS = ("assets:train", "assets:validate")
TILE, COLUMNS, DRAWN = (260, 240), 5, 500
"""Size of a picture [pixels], pictures in a row, points drawn of each side."""
AWAY = 0.006
"""Surface that is this far from all seen points was not seen [m]."""
GREY, SEEN, ADDED = (0.82, 0.83, 0.85), (0.16, 0.38, 0.78), (0.93, 0.50, 0.13)


def mirrored(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "n 3"]:
    """The naive other side."""
    view = normals.mean(0) if camera is None else camera - points.mean(0)
    view = view / np.linalg.norm(view)
    along = points @ view
    return points + 2 * (np.quantile(along, 0.02) - along)[:, None] * view


def likeliest(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "k 3"]:
    """The other side by the best symmetry alone."""
    side, axes, middle = to_view_axes(points, normals, camera)
    return side.guesses(1)[0].points[len(side.points):] @ axes.T + middle


def errors(
    obj: ObjectModel, seen: Float[np.ndarray, "n 3"], added: Float[np.ndarray, "k 3"]
) -> tuple[float, float]:
    """How far added points are from the surface, and the surface away from all seen points from seen and added ones [mm]."""
    unseen = obj.cloud[KDTree(seen).query(obj.cloud)[0] > AWAY]
    wrong = obj.distance_field.distances(torch.from_numpy(added).float())[0].abs() if len(added) else torch.zeros(1)
    missing = KDTree(np.concatenate([seen, added])).query(unseen)[0] if len(unseen) else np.zeros(1)
    return 1e3 * float(wrong.mean()), 1e3 * float(missing.mean())


def draw(path: Path) -> None:
    """One depth image of each validate object, seen with the camera to the left."""
    tiles, captions = [], []
    for name in resolve_objects(["assets:validate"]):
        obj = load_object(name)
        tiles.append(tile(obj))
        captions.append((obj.name.rpartition("+")[2], None))
    sheet = contact_sheet(tiles, captions, "points seen by a camera on the left (blue), and added points (orange)", COLUMNS)
    Image.Image.save(sheet, path)


def tile(obj: ObjectModel) -> np.ndarray:
    """One object, half transparent, with the points that were seen and added."""
    points, normals, camera = visible_side(obj, "depth", 0)
    assert camera is not None
    whole = complete_cloud(points, normals, camera)
    towards = (camera - points.mean(0)) / np.linalg.norm(camera - points.mean(0))
    across = np.cross(towards, np.eye(3)[np.abs(towards).argmin()])
    across /= np.linalg.norm(across)
    rng = np.random.default_rng(0)
    marks = [dots(rng.permutation(part)[:DRAWN], colour, radius=0.0012)
             for part, colour in ((points, SEEN), (whole.points[whole.added], ADDED))]
    view = Camera.around(
        np.concatenate([obj.cloud, whole.points]), tuple(across), up=tuple(np.cross(towards, across)), aspect=TILE[0] / TILE[1])
    assert obj.vertices is not None
    assert obj.faces is not None
    solid, clear = (render([*more, *marks], view, *TILE).astype(float) for more in ([Mesh(obj.vertices, obj.faces, GREY)], []))
    return (0.5 * solid + 0.5 * clear).astype(np.uint8)


def main() -> None:
    """Measure and print."""
    parser = options_of(__doc__)
    parser.add_argument("--views", type=int, default=3, help="views of each object; 0 for the picture alone")
    parser.add_argument("--picture", type=Path, default=None, help="PNG to draw")
    options = parser.parse_args()
    if options.picture is not None:
        draw(options.picture)
    if options.views < 1:
        return
    rows = []
    for view in ("half", "depth"):
        for group in GROUPS:
            found: dict[str, list[tuple[float, float]]] = {"mirror": [], "symmetry": [], "network": []}
            seconds = 0.0
            for name in resolve_objects([group]):
                obj = load_object(name)
                for seed in range(options.views):
                    points, normals, camera = visible_side(obj, view, seed)
                    begin = time.perf_counter()
                    whole = complete_cloud(points, normals, camera)
                    seconds += time.perf_counter() - begin
                    added = {"mirror": mirrored(points, normals, camera), "symmetry": likeliest(points, normals, camera),
                             "network": whole.points[whole.added]}
                    for kind, other in added.items():
                        found[kind].append(errors(obj, points, other))
            count = len(found["network"])
            cells = [value for kind in found.values() for value in np.mean(kind, axis=0).tolist()]
            rows.append([view, group, count, *cells, 1e3 * seconds / count])
    columns = ["view", "objects", "views", *(f"{kind}, {what} [mm]" for kind in ("mirror", "symmetry", "network")
                                             for what in ("added off", "missing")), "time [ms]"]
    emit("distance of added points from the surface, and of the unseen surface from them", rows, columns,
         {f"{row[0]} {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
