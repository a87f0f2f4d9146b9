"""A clone of DexGraspBench in small."""

from __future__ import annotations

from pathlib import Path

import trimesh


def clone_of_bars(folder: Path, names: tuple[str, ...]) -> Path:
    """Objects as DexGraspBench has them: bars of 2 x 1 x 1 made of two boxes; and a folder that is none."""
    for name in names:
        own = folder / "assets" / name
        (own / "mesh").mkdir(parents=True)
        (own / "urdf" / "meshes").mkdir(parents=True)
        trimesh.creation.box((2, 1, 1)).export(own / "mesh" / "simplified.obj")
        for i in (0, 1):
            box = trimesh.creation.box((1, 1, 1)).apply_translation([i - 0.5, 0, 0])
            box.export(own / "urdf" / "meshes" / f"convex_piece_00{i}.obj")
    (folder / "assets" / "empty" / "mesh").mkdir(parents=True)
    return folder
