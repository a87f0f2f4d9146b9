"""Things that are put down on a simulated table, each at a random place, until they rest."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from dro_grasp.arm.planning.physics import LiftScene
from dro_grasp.geometry.se3 import random_rotations
from dro_grasp.objects.builtin.usual import OBJECTS
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel

APART = 0.03  # Distance between the outlines of objects as they are put down [m] (ours)

Region = tuple[float, float, float, float]  # Least x and y, greatest x and y, from the arm's base [m]


def other_objects(name: str, count: int, draw: np.random.Generator) -> list[ObjectModel]:
    """Some of the usual built-in objects, without the one that is asked for."""
    return [load_object(str(other)) for other in draw.permutation(sorted(set(OBJECTS) - {name}))[:count]]


def scatter(scene: LiftScene, region: Region, draw: np.random.Generator, apart: float = APART) -> bool:
    """Put all objects down, the first one in the region and others up to 10 cm around it; False if one never comes to rest."""
    wide = (region[0] - 0.05, region[1] - 0.10, region[2] + 0.10, region[3] + 0.10)
    return all(rest(scene, index, wide if index else region, draw, apart) for index in range(len(scene.objects)))


def rest(scene: LiftScene, index: int, region: Region, draw: np.random.Generator, apart: float = APART) -> bool:
    """Drop an object in a random orientation at a random place, and wait until it rests there; False if it never does."""
    low, high = np.array(region[:2]), np.array(region[2:])
    table, obj = scene.robot.usual_table, scene.objects[index]
    assert obj.vertices is not None
    for _ in range(20):  # it is put down anew if it rolls off the region
        generator = torch.Generator().manual_seed(int(draw.integers(2**31)))
        T = np.eye(4)
        T[:3, :3] = random_rotations(1, generator)[0].double().numpy()
        T[:2, 3] = _free_place(scene, index, T[:3, :3], region, draw, apart)
        T[2, 3] = table.height + 0.005 - float((obj.vertices @ T[2, :3]).min())
        scene.place(index, T)
        resting = False
        for _ in range(8):  # half seconds in which it comes to rest
            scene.advance(0.5)
            if resting := scene.speed(index) < 0.002:
                break
        place = scene.centre(index)[:2] - scene.robot.T_world_base[:2, 3]
        if resting and (place > low - 0.05).all() and (place < high + 0.05).all():
            return True
    return False


def _free_place(
    scene: LiftScene, index: int, R: Float[np.ndarray, "3 3"], region: Region, draw: np.random.Generator, apart: float,
) -> Float[np.ndarray, "2"]:
    """Where the origin of an object is that stands so far from those before it [m], or as far as any place that was tried.

    Its centre of mass is in the region.
    """
    base, obj = scene.robot.T_world_base[:2, 3], scene.objects[index]
    outline, offset = (obj.cloud - obj.centre_of_mass) @ R[:2].T, R[:2] @ obj.centre_of_mass
    poses = [scene.pose(i) for i in range(index)]
    others = [obj.cloud @ T[:2, :3].T + T[:2, 3] for obj, T in zip(scene.objects, poses, strict=False)]
    tree, best = KDTree(np.concatenate(others)) if others else None, (-1.0, base)
    for _ in range(100):
        place = base + draw.uniform(region[:2], region[2:])
        distance = np.inf if tree is None else float(tree.query(outline + place)[0].min())
        if distance > best[0]:
            best = distance, place
        if distance > apart:
            break
    return best[1] - offset
