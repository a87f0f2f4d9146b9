"""How far the side that is added to what was seen of an object lies from its surface, beside a mirror where the seen side ends.

    python benchmarks/completion.py [--views N] [--json]

Needs the development assets.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from jaxtyping import Float
from report import emit
from scipy.spatial import KDTree

from dro_grasp.evaluation.views import seen_side
from dro_grasp.objects.completion import completed
from dro_grasp.objects.library import load_object, resolve_objects

GROUPS = ("assets:train", "assets:validate")


def mirrored(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], towards: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "n 3"]:
    """The naive other side."""
    view = normals.mean(0) / np.linalg.norm(normals.mean(0)) if towards is None else towards
    along = points @ view
    return points + 2 * (np.quantile(along, 0.02) - along)[:, None] * view


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=3, help="views of each object")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    rows = []
    for view in ("half", "depth"):
        for group in GROUPS:
            found, naive, seconds = [], [], 0.0
            for name in resolve_objects([group]):
                obj = load_object(name)
                surface = KDTree(obj.cloud)
                for seed in range(options.views):
                    points, normals, towards = seen_side(obj, view, seed)
                    begin = time.perf_counter()
                    both, _ = completed(points, normals, towards)
                    seconds += time.perf_counter() - begin
                    found.append(1e3 * surface.query(both[len(points):])[0].mean())
                    naive.append(1e3 * surface.query(mirrored(points, normals, towards))[0].mean())
            rows.append([view, group, len(found), float(np.mean(naive)), float(np.mean(found)), float(np.median(found)),
                         1e3 * seconds / len(found)])
    columns = ["view", "objects", "views", "mirror, mean [mm]", "symmetry, mean [mm]", "symmetry, median [mm]", "time [ms]"]
    emit("distance of the added side from the surface", rows, columns,
         {f"{row[0]} {row[1]}": dict(zip(columns[2:], row[2:], strict=True)) for row in rows}, options.json)


if __name__ == "__main__":
    main()
