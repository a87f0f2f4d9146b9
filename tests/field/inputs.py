"""Inputs of the field corpus: texts of files with words replaced, shapes, clouds and images by their steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import lzf  # type: ignore  # compiled, without types
import numpy as np
import trimesh
import yaml

CORPUS: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("corpus.yaml").read_text())
BASES: dict[str, str] = CORPUS["bases"]
SHAPE = (120, 160)


def text_of(case: Mapping[str, Any]) -> str:
    """A case's text, with words replaced that must be there."""
    text = case["text"] if "text" in case else BASES[case["base"]]
    for old, new in case.get("replace", {}).items():
        assert old in text, old
        text = text.replace(old, new)
    return text


def written(case: Mapping[str, Any], folder: Path, name: str) -> Path:
    """A case's file, and what lies beside it."""
    for other, content in case.get("files", {}).items():
        (folder / other).parent.mkdir(parents=True, exist_ok=True)
        (folder / other).write_text(BASES.get(content, content))
    (folder / name).write_text(text_of(case))
    return folder / name


def box(*sides: float) -> trimesh.Trimesh:
    return trimesh.creation.box(sides)


def ball(radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(3, radius)


def balls(count: int) -> trimesh.Trimesh:
    """Balls of 2 cm in rows of six, 3 to 4 cm apart."""
    each = [trimesh.creation.icosphere(2, 0.01) for _ in range(count)]
    for i, one in enumerate(each):
        one.apply_translation((0.036 * (i % 6), 0.03 * (i // 6), 0))
    return trimesh.util.concatenate(each)  # pyright: ignore[reportReturnType]


def sheet(side: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(side * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), [[0, 1, 2], [0, 2, 3]])


def soup(faces: int) -> trimesh.Trimesh:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (3 * faces, 3))
    return trimesh.Trimesh(points, np.arange(3 * faces).reshape(-1, 3), process=False)


def joined(mesh: trimesh.Trimesh, x: float, y: float, z: float) -> trimesh.Trimesh:
    other = mesh.copy()
    other.apply_translation((x, y, z))
    return trimesh.util.concatenate([mesh, other])  # pyright: ignore[reportReturnType]


def changed(mesh: trimesh.Trimesh, vertices: Any = None, faces: Any = None) -> trimesh.Trimesh:
    vertices, faces = mesh.vertices if vertices is None else vertices, mesh.faces if faces is None else faces
    return trimesh.Trimesh(vertices, faces, process=False)


MESHES: dict[str, Callable[..., trimesh.Trimesh]] = {
    "box": box, "ball": ball, "balls": balls, "sheet": sheet, "soup": soup, "and": joined,
    "invert": lambda mesh: changed(mesh, faces=mesh.faces[:, ::-1]),
    "twice": lambda mesh: changed(mesh, np.concatenate([mesh.vertices] * 2),
                                  np.concatenate([mesh.faces, mesh.faces + len(mesh.vertices)])),
    "without": lambda mesh, count: changed(mesh, faces=mesh.faces[count:]),
    "below": lambda mesh, z: mesh.slice_plane((0, 0, z), (0, 0, -1)),
    "stray": lambda mesh, far: changed(mesh, np.concatenate([mesh.vertices, [[far, 0, 0]]])),
    "move": lambda mesh, far: changed(mesh, mesh.vertices + far)}
"""Steps that make meshes."""


def sphere(radius: float, count: int) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def table(side: float, things: int) -> np.ndarray:
    """Cubes of 5 cm on a table, as a camera sees them, without their lower sides."""
    rng = np.random.default_rng(1)
    flat = np.column_stack([rng.uniform(-side / 2, side / 2, (4000, 2)), rng.normal(0, 0.001, 4000)])
    cubes = []
    for at in ((0, 0), (0.2, 0.1), (-0.2, 0.15))[:things]:
        points, axis = rng.uniform(-0.5, 0.5, (900, 3)), rng.integers(3, size=900)
        points[np.arange(900), axis] = np.copysign(0.5, points[np.arange(900), axis])
        cubes.append(0.05 * (points + np.array([0, 0, 0.5])) + np.array([*at, 0]))
    return np.concatenate([flat, *cubes])


def with_normals(points: np.ndarray, side: int) -> np.ndarray:
    """Normals of a ball, outward for 1, inward for -1, both for 0."""
    signs = np.random.default_rng(2).choice([-1, 1], (len(points), 1)) if side == 0 else side
    return np.column_stack([points, signs * points / np.linalg.norm(points, axis=1, keepdims=True)])


CLOUDS: dict[str, Callable[..., np.ndarray]] = {
    "sphere": sphere, "table": table, "normals": with_normals,
    "gaps": lambda points, value, count: np.concatenate([points, np.full((count, 3), float(value))]),
    "move": lambda points, far: points + far, "rows": lambda points, width: points.reshape(-1, width, 3),
    "repeat": lambda points, times: np.tile(points, (times, 1)), "times": lambda points, factor: points * factor,
    "colours": lambda points: np.column_stack([points, np.random.default_rng(0).uniform(0, 255, points.shape)]),
    "above": lambda points, z: points[points[:, 2] > z], "squash": lambda points: 0 * points + 0.1,
    "beside": lambda points, far: np.concatenate([points, points + np.array([far, 0, 0])])}
"""Steps that make clouds."""


def made(steps: list[list[Any]], makers: Mapping[str, Callable[..., Any]]) -> Any:
    """What some steps make."""
    (name, *arguments), *rest = steps
    thing = makers[name](*arguments)
    for name, *arguments in rest:
        thing = makers[name](thing, *arguments)
    return thing


def object_file(case: Mapping[str, Any], folder: Path) -> Path:
    """The file of an object."""
    if "made" not in case:
        return written(case, folder, case.get("name", case.get("base")))
    ending = case["as"].partition("_")[0]
    made(case["made"], MESHES).export(folder / f"thing.{ending}", file_type=case["as"])
    return folder / f"thing.{ending}"


def cloud_file(case: Mapping[str, Any], folder: Path) -> Path:
    """The file of a cloud."""
    if "name" in case:
        return written(case, folder, case["name"])
    points = np.array([line.split() for line in case["text"].splitlines()], float) if "text" in case else made(
        case["made"], CLOUDS)
    path = folder / f"cloud.{case['as'].rpartition('.')[2]}"
    if path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".ply":
        names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")[: points.shape[1]])
        path.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{names}end_header\n{rows(points)}\n")
    else:
        path.write_bytes(pcd(points, case["as"].partition(".")[0]))
    return path


def rows(points: np.ndarray) -> str:
    return "\n".join(" ".join(f"{x:.7f}" for x in row) for row in points)


def pcd(points: np.ndarray, packing: str) -> bytes:
    """A PCD file of x y z."""
    head = (f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
            f"POINTS {len(points)}\nDATA {'binary_compressed' if packing == 'compressed' else packing}\n").encode()
    if packing == "ascii":
        return head + rows(points).encode()
    if packing == "binary":
        return head + points.astype("<f4").tobytes()
    columns = points.T.astype("<f4").tobytes()
    packed = lzf.compress(columns, len(columns) + 100) or columns
    return head + len(packed).to_bytes(4, "little") + len(columns).to_bytes(4, "little") + packed


def depth_of_a_ball() -> np.ndarray:
    """Depth of a ball of 4 cm, half a metre off [m]; 0 beside it."""
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = (column - 79.5) / 300, (row - 59.5) / 310
    # |z (x, y, 1) - (0, 0, 0.5)| = 0.04 is quadratic in z.
    a, b, c = x**2 + y**2 + 1, -1.0, 0.25 - 0.04**2
    inside = b * b - 4 * a * c
    return np.where(inside > 0, (-b - np.sqrt(inside.clip(0))) / (2 * a), 0.0)


def robot_file(case: Mapping[str, Any], folder: Path) -> Path:
    """A robot file, and those that it names."""
    for name in ("arm.urdf", "arm.xml", "claw.urdf"):
        (folder / name).write_text(BASES[name])
    values = yaml.safe_load(yaml.safe_dump(CORPUS["robot"]))
    for place, value in case.get("change", {}).items():
        *above, last = place.split("/")
        inner = values
        for key in above:
            inner = inner[key]
        inner[last] = value
        if value is None:
            del inner[last]
    path = folder / "robot.yaml"
    path.write_text(case.get("text", yaml.safe_dump(values)))
    return path
