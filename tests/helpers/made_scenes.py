"""Depth images of made scenes whose labels are known: built-in training objects on a table, in a shelf, or in a bin.

`python -m tests.helpers.made_scenes` measures how much of the object that is asked for is found.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from dro_grasp.errors import ObjectError
from dro_grasp.objects.builtin import BUILTIN
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.scene_files import SceneCamera
from dro_grasp.objects.scenery import Scene, load_scene

Place = Literal["table", "shelf", "bin"]
TRAINING = tuple(sorted(name for name, made in BUILTIN.items() if made.split == "train"))
GAP = 0.02  # Least gap between the bounding circles of objects [m]
TOUCH = 0.003  # Largest gap of what touches [m]
FOUND = 0.8  # Intersection over union from which an object counts as found


@dataclass(frozen=True, eq=False)
class MadeScene:
    """A depth image and what each pixel shows."""

    depth: Float[np.ndarray, "h w"]  # along z [m]; NaN for none
    owner: Int[np.ndarray, "h w"]  # the number of the object, -1 for what it stands in, -2 for nothing
    camera: SceneCamera
    middles: Float[np.ndarray, "k 3"]  # of the objects' boxes in the camera's frame's parent [m]
    names: tuple[str, ...]

    def load(self) -> Scene:
        return load_scene(self.depth, "scene", camera=self.camera)


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=(low, high))


def _rooms(place: Place) -> tuple[list[trimesh.Trimesh], tuple[float, float, float, float], tuple[float, ...]]:
    """What things stand in, the rectangle for them [m], and the camera's place [m] for three views."""
    table = _box((-0.5, -0.4, -0.03), (0.5, 0.4, 0.0))
    floor = _box((-3, -3, -0.75), (3, 3, -0.73))
    if place == "table":
        return [table, floor], (-0.32, -0.24, 0.32, 0.24), (0.0, -0.7, 0.5, 0.1, -0.45, 0.9, -0.5, -0.6, 0.7)
    if place == "bin":
        walls = [_box((-0.30, -0.22, -0.01), (0.30, 0.22, 0.0)), _box((-0.31, -0.22, 0), (-0.30, 0.22, 0.12)),
                 _box((0.30, -0.22, 0), (0.31, 0.22, 0.12)), _box((-0.31, -0.23, 0), (0.31, -0.22, 0.12)),
                 _box((-0.31, 0.22, 0), (0.31, 0.23, 0.12))]
        return [*walls, floor], (-0.24, -0.16, 0.24, 0.16), (0.0, -0.4, 0.7, 0.1, -0.15, 0.9, -0.35, -0.3, 0.7)
    boards = [_box((-0.4, -0.15, z - 0.02), (0.4, 0.2, z)) for z in (0.0, 0.38)]
    sides = [_box((s * 0.41 - 0.01, -0.15, -0.3), (s * 0.41 + 0.01, 0.2, 0.4)) for s in (-1, 1)]
    return ([*boards, *sides, _box((-0.42, 0.2, -0.3), (0.42, 0.22, 0.4)), floor], (-0.32, -0.1, 0.32, 0.14),
            (0.0, -0.8, 0.3, 0.2, -0.7, 0.25, -0.25, -0.65, 0.35))


def looking(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Pose of a camera: z forward, x right, y down [m]."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], 1), position
    return T


def make_scene(
    place: Place, count: int, seed: int, view: int = 0, width: int = 640, noise: float = 0.002, lost: float = 0.02
) -> MadeScene:
    """A scene with up to `count` objects; noise is the standard deviation at a metre, and grows with the square of depth."""
    rng = np.random.default_rng(seed)
    meshes, names = _scattered(rng, count, _rooms(place)[1], 0.3 if place == "shelf" else 1.0)
    return render_scene(place, meshes, names, rng, view, width, noise, lost)


def render_scene(
    place: Place, meshes: list[trimesh.Trimesh], names: tuple[str, ...], rng: np.random.Generator, view: int = 0,
    width: int = 640, noise: float = 0.002, lost: float = 0.02,
) -> MadeScene:
    """The same with given meshes."""
    room, _, places = _rooms(place)
    parts = [*meshes, *room]
    whole: Any = trimesh.util.concatenate(parts)
    owner = np.repeat([*range(len(meshes)), *[-1] * len(room)], [len(m.faces) for m in parts])
    position = np.array(places[3 * view : 3 * view + 3])
    T = looking(position, np.array([0.0, 0.03, 0.05]))
    height, focal = 3 * width // 4, 0.95 * width
    K = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - K[0, 2]) / focal, (v - K[1, 2]) / focal, np.ones_like(u, float)], -1).reshape(-1, 3)
    hit, ray, face = whole.ray.intersects_location(np.tile(position, (len(rays), 1)), rays @ T[:3, :3].T, multiple_hits=False)
    depth, shown = np.full(len(rays), np.nan), np.full(len(rays), -2)
    depth[ray] = (hit - position) @ T[:3, 2]
    shown[ray] = owner[face]
    depth += rng.normal(size=len(depth)) * noise * np.nan_to_num(depth) ** 2
    gone = rng.random(len(depth)) < lost
    depth[gone], shown[gone] = np.nan, -2
    middles = np.array([m.bounds.mean(0) for m in meshes])
    return MadeScene(depth.reshape(v.shape), shown.reshape(v.shape), SceneCamera(T, K, "world"), middles, names)


def _scattered(
    rng: np.random.Generator, count: int, region: tuple[float, float, float, float], tallest: float
) -> tuple[list[trimesh.Trimesh], tuple[str, ...]]:
    meshes: list[trimesh.Trimesh] = []
    names, circles = [], []
    for _ in range(60 * count):
        if len(meshes) == count:
            break
        name = TRAINING[rng.integers(len(TRAINING))]
        obj = load_object(name)
        vertices = np.asarray(obj.vertices, np.float64)
        low, high = vertices.min(0), vertices.max(0)
        extents, centre = high - low, (low + high) / 2
        if extents.max() > 0.3 or extents.min() < 0.025 or extents[2] > tallest:
            continue
        angle, middle = rng.uniform(0, 2 * np.pi), rng.uniform(region[:2], region[2:])
        radius = float(np.linalg.norm(vertices[:, :2] - centre[:2], axis=1).max())
        if any(np.linalg.norm(middle - m) < radius + r + GAP for m, r in circles):
            continue
        mesh = trimesh.Trimesh(vertices - [centre[0], centre[1], low[2]], obj.faces, process=False)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(angle, [0, 0, 1]))
        mesh.apply_translation([*middle, 0.0])
        meshes.append(mesh)
        names.append(name)
        circles.append((middle, radius))
    return meshes, tuple(names)


def overlap(scene: MadeScene, wanted: int, found: Int[np.ndarray, " n"]) -> float:
    """Intersection over union of the pixels of an object and those that were found (indices of the flat image)."""
    true = np.flatnonzero(scene.owner.ravel() == wanted)
    common = len(np.intersect1d(true, found))
    return common / (len(true) + len(found) - common)


def touching(seed: int) -> MadeScene:
    """Two objects side by side in a seeded direction, the second so near to the first that 3 mm are between them at most."""
    rng = np.random.default_rng([seed, 1])
    meshes, names = _scattered(rng, 2, (-0.15, -0.1, 0.15, 0.1), 1.0)
    first, second = meshes
    points = [trimesh.sample.sample_surface(mesh, 8000, seed=1)[0] for mesh in meshes]
    tree, way = KDTree(points[0]), np.append((first.bounds - second.bounds).mean(0)[:2], 0.0)
    way, shift = way / np.linalg.norm(way), 0.0
    while (apart := float(tree.query(points[1] + shift * way)[0].min())) > TOUCH:
        shift += max(apart - TOUCH, 0.0005)
    second.apply_translation(shift * way)
    return render_scene("table", meshes, names, rng, seed % 3)


def asked(made: MadeScene, part: bool = False) -> list[float]:
    """How much of each object that shows 400 pixels is found by a place in it: intersection over union; 0 for an error."""
    scene, found = made.load(), []
    for k, middle in enumerate(made.middles):
        if (made.owner == k).sum() < 400:
            continue
        try:
            found.append(overlap(made, k, scene.chosen(at=tuple(middle), part=part).pixels))
        except ObjectError as error:
            print(f"   {made.names[k]}: {error}")
            found.append(0.0)
        if found[-1] < FOUND:
            print(f"   {made.names[k]}: {found[-1]:.2f}")
    return found


def told(found: list[float]) -> str:
    """Shares and extremes in words."""
    return (f"n {len(found)}, IoU median {np.median(found):.3f}, worst {min(found):.3f}, at least {FOUND}: "
            f"{np.mean(np.array(found) >= FOUND):.3f}")


def main() -> None:
    """Measure 24 scenes of up to six objects that stand apart, and 48 of two that touch."""
    apart, parts = list[float](), list[float]()
    for seed in range(24):
        place: Place = ("table", "shelf", "bin")[seed % 3]
        made = make_scene(place, 1 + seed % 6, seed, view=(seed // 3) % 3, noise=(0.001, 0.003, 0.005)[(seed // 6) % 3])
        apart += asked(made)
        parts += asked(made, part=True)
        begin = time.process_time()
        segments = made.load().segments
        print(f"{place} seed {seed}: {len(made.middles)} objects, {segments.count} things, {len(segments.planes)} planes, "
              f"{time.process_time() - begin:.2f} s", flush=True)
    print(f"apart: {told(apart)}; asked for as parts: {told(parts)}")
    for part in (False, True):
        print(f"touching{', as parts' * part}: {told([iou for seed in range(48) for iou in asked(touching(seed), part)])}")


if __name__ == "__main__":
    main()
