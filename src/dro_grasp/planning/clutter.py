"""Clutter: other objects that stand on the table around the one that is asked for."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from dro_grasp.geometry.se3 import random_rotations
from dro_grasp.objects.builtin import BUILTIN
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.planning.physics import LiftScene
from dro_grasp.planning.robot_file import Table

DROP = 0.005
"""Height above the table from which an object comes to rest [m] (ours)."""
REST_SECONDS = 4.0
"""Longest time in which it comes to rest [s] (ours)."""
REST_SPEED = 0.002
"""Speed below which it rests [m/s] (ours)."""
DRAWS = 20
"""How often it is put down anew if it rolls off the region (ours)."""
PLACES = 100
"""Places that are tried until one is free (ours)."""
APART = 0.03
"""Distance between the outlines of objects as they are put down [m] (ours)."""
MOST_CLUTTER = 8
"""Most other objects that there is room for (ours)."""
AROUND = 0.10
"""Other objects stand at most this far beyond the region of the one that is asked for [m] (ours)."""


Region = tuple[float, float, float, float]
"""Least x and y, greatest x and y, from the arm's base [m]."""


def other_objects(name: str, count: int, draw: np.random.Generator) -> list[ObjectModel]:
    """Some of the built-in objects, without the one that is asked for."""
    return [load_object(str(other)) for other in draw.permutation(sorted(set(BUILTIN) - {name}))[:count]]


def scatter(scene: LiftScene, region: Region, draw: np.random.Generator) -> bool:
    """Put all objects down, the first one in the region and the others around it; False if one of them never comes to rest."""
    wide = (region[0] - AROUND / 2, region[1] - AROUND, region[2] + AROUND, region[3] + AROUND)
    return all(rest(scene, index, wide if index else region, draw) for index in range(len(scene.objects)))


def rest(scene: LiftScene, index: int, region: Region, draw: np.random.Generator) -> bool:
    """Drop an object in a random orientation at a random place, and wait until it rests there; False if it never does."""
    low, high = np.array(region[:2]), np.array(region[2:])
    table, obj = scene.robot.table or Table(), scene.objects[index]
    assert obj.vertices is not None
    for _ in range(DRAWS):
        generator = torch.Generator().manual_seed(int(draw.integers(2**31)))
        T = np.eye(4)
        T[:3, :3] = random_rotations(1, generator)[0].double().numpy()
        T[:2, 3] = _free_place(scene, index, T, region, draw)
        T[2, 3] = table.height + DROP - float((obj.vertices @ T[2, :3]).min())
        scene.place(index, T)
        for _ in range(round(REST_SECONDS / 0.5)):
            scene.advance(0.5)
            if scene.speed(index) < REST_SPEED:
                break
        place = scene.pose(index)[:2, 3] - scene.robot.T_world_base[:2, 3]
        if scene.speed(index) < REST_SPEED and (place > low - 0.05).all() and (place < high + 0.05).all():
            return True
    return False


def _free_place(
    scene: LiftScene, index: int, T: Float[np.ndarray, "4 4"], region: Region, draw: np.random.Generator
) -> Float[np.ndarray, "2"]:
    """Where an object in this orientation stands APART from those before it; the last place that was tried if there is none."""
    base, outline = scene.robot.T_world_base[:2, 3], scene.objects[index].cloud @ T[:2, :3].T
    poses = [scene.pose(i) for i in range(index)]
    others = [obj.cloud @ T[:2, :3].T + T[:2, 3] for obj, T in zip(scene.objects, poses, strict=False)]
    tree, place = KDTree(np.concatenate(others)) if others else None, base
    for _ in range(PLACES):
        place = base + draw.uniform(region[:2], region[2:])
        if tree is None or tree.query(outline + place)[0].min() > APART:
            break
    return place
