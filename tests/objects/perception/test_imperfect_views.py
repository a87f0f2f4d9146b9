"""Views as cameras and segmenters make them: masks that miss an outline, boards beside a thing, walls, and what is cut off."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from dro_grasp.errors import ObjectError
from dro_grasp.geometry.table_plane import moved_plane
from dro_grasp.objects.scenery import Scene, load_scene
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
        mask = np.asarray(ndimage.binary_erosion(own, iterations=missed), bool)
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
    board = _box(-0.25, 0.05, 0, 0.3, 0.4, thick)
    made = _made(_box(0.1, 0, 0, 0.06, 0.05, 0.1), board, _box(-0.2, 0, thick, 0.05, 0.05, 0.08))
    scene = made.load()
    for place, height in (((0.1, 0, 0.05), 0.0), ((-0.2, 0, 0.05 + thick), thick)):
        chosen = scene.chosen(at=place)
        assert chosen.below is not None
        assert scene.sight is not None
        assert moved_plane(scene.segments.planes[chosen.below], scene.sight.T)[3] == pytest.approx(height, abs=0.003)
    assert _avoided(made, scene, made.owner == 0, 1) > 0.9 * (made.owner == 1).sum(), "hands keep off it"


@pytest.mark.parametrize("noise", [0.003, 0.005])
def test_low_things_are_found_in_sharp_noisy_images(noise: float) -> None:
    """The tails of the noise are no layer over the table that takes low things in."""
    made = _made(_box(-0.1, 0, 0, 0.08, 0.06, 0.015), _box(0.1, 0.05, 0, 0.08, 0.06, 0.02), noise=noise, width=720)
    scene = made.load()
    for k, middle in enumerate(made.middles):
        assert overlap(made, k, scene.chosen(at=tuple(middle)).pixels) > 0.8


def test_a_wall_larger_than_the_table_is_not_what_things_stand_on() -> None:
    wall = _box(0, 0.18, -0.6, 3, 0.02, 2.8)
    made = _made(_box(-0.02, -0.06, 0, 0.06, 0.06, 0.1), _box(0, 0.04, 0, 0.06, 0.06, 0.16), wall)
    scene = made.load()
    for k in (0, 1):
        assert overlap(made, k, scene.chosen(at=tuple(made.middles[k])).pixels) > 0.9


def test_an_arm_above_a_thing_is_no_part_of_it() -> None:
    arm = trimesh.creation.cylinder(0.035, segment=((0, 0, 0.15), (0.4, 0.1, 0.45)))
    made = _made(_box(0, 0, 0, 0.06, 0.06, 0.1), arm)
    assert overlap(made, 0, made.load().chosen(at=(0, 0, 0.05)).pixels) > 0.9


def test_what_ends_at_a_blind_band_is_cut_off() -> None:
    made = _made(_box(0, 0, 0, 0.1, 0.1, 0.1))
    assert not any("cut off" in note for note in made.load().chosen().notes)
    made.depth[:, :int(np.median(np.nonzero(made.owner == 0)[1]))] = np.nan
    assert any("where the image's depths end and may be cut off" in note for note in made.load().chosen().notes)
    made.depth[made.owner != 0] = np.nan
    assert not any("depths end" in note for note in made.load().chosen().notes), "the depths of a thing alone end where it does"


def test_depths_in_another_unit_and_of_no_return_are_told() -> None:
    made = _made(_box(0, 0, 0, 0.06, 0.06, 0.1))
    tenths = np.round(np.nan_to_num(made.depth) * 10_000).astype(np.uint16)
    with pytest.raises(ObjectError, match=r"Half of what it shows is farther away than \d.* m.*depth_unit"):
        load_scene(tenths, camera=made.camera).object_at(at=(0, 0, 0.05))
    made.depth[:20] = 1e10
    with pytest.raises(ObjectError, match=r"6400 of its \d+ points.*farther away than 100 m.*0 or NaN"):
        load_scene(made.depth, camera=made.camera)
