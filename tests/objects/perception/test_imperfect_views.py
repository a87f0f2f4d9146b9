"""Views as cameras and segmenters make them: masks that miss an outline, boards beside a thing, walls, and what is cut off."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from dro_grasp.geometry.table_plane import moved_plane
from dro_grasp.objects.scenery import Scene
from tests.helpers.made_scenes import MadeScene, make_scene, overlap, render_scene, touching


def _box(x: float, y: float, z: float, *extents: float) -> trimesh.Trimesh:
    """A box whose lower face has its middle at x, y, z [m]."""
    box = trimesh.creation.box(extents)
    box.apply_translation((x, y, z + extents[2] / 2))
    return box


def _made(*meshes: trimesh.Trimesh, noise: float = 0.0, width: int = 320) -> MadeScene:
    return render_scene("table", list(meshes), ("thing",) * len(meshes), np.random.default_rng(0), noise=noise, width=width)


def _avoided(made: MadeScene, scene: Scene, mask: np.ndarray, number: int) -> int:
    """How many points of an object are obstacles of what a mask means."""
    assert scene.sight is not None
    return int((made.owner.ravel()[scene.sight.pixels[scene.chosen(mask=mask).others]] == number).sum())


@pytest.mark.parametrize("missed", [1, 2, 3])
def test_the_outline_that_a_mask_misses_is_no_obstacle(missed: int) -> None:
    made = make_scene("table", 3, 9, 1)
    scene = made.load()
    for k in range(3):
        own = made.owner == k
        mask = ndimage.binary_erosion(own, iterations=missed)
        assert (own & ~mask).sum() > 100
        assert _avoided(made, scene, mask, k) < 0.005 * own.sum()
        for other in {0, 1, 2} - {k}:
            assert _avoided(made, scene, mask, other) > 0.9 * (made.owner == other).sum()


@pytest.mark.parametrize("seed", [0, 3])
def test_what_touches_a_thing_stays_an_obstacle_of_its_mask(seed: int) -> None:
    made = touching(seed)
    for k in (0, 1):
        assert _avoided(made, made.load(), made.owner == k, 1 - k) > 0.8 * (made.owner == 1 - k).sum()


@pytest.mark.parametrize("thick", [0.012, 0.018])
def test_a_thing_stands_on_what_is_below_it_and_not_on_a_board_elsewhere(thick: float) -> None:
    made = _made(_box(0.1, 0, 0, 0.06, 0.05, 0.1), _box(-0.25, 0.05, 0, 0.3, 0.4, thick), _box(-0.2, 0, thick, 0.05, 0.05, 0.08))
    scene = made.load()
    for place, height in (((0.1, 0, 0.05), 0.0), ((-0.2, 0, 0.05 + thick), thick)):
        chosen = scene.chosen(at=place)
        assert chosen.below is not None
        assert scene.sight is not None
        assert moved_plane(scene.segments.planes[chosen.below], scene.sight.T)[3] == pytest.approx(height, abs=0.003)
    board = (made.owner == 1).sum()
    assert _avoided(made, scene, made.owner == 0, 1) > 0.9 * board, "hands keep off it"


@pytest.mark.parametrize("noise", [0.003, 0.005])
def test_low_things_are_found_in_sharp_noisy_images(noise: float) -> None:
    """The tails of the noise are no layer over the table that takes low things in."""
    made = _made(_box(-0.1, 0, 0, 0.08, 0.06, 0.015), _box(0.1, 0.05, 0, 0.08, 0.06, 0.02), noise=noise, width=720)
    scene = made.load()
    for k, middle in enumerate(made.middles):
        assert overlap(made, k, scene.chosen(at=tuple(middle)).pixels) > 0.8
