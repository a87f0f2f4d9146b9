"""Objects drawn from a seed: the same everywhere, solid, of a size that a hand can hold, with parts that fill them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from dro_grasp.errors import ObjectError
from dro_grasp.objects.catalogue import load_object, locate_object, resolve_objects
from dro_grasp.objects.procedural import FAMILIES, SIZE, THINNEST, procedural_object
from dro_grasp.objects.solids import Solid
from dro_grasp.training.data.engine.schedule import require_distinct_names, require_known
from tests.helpers.exact_parts import require_exact_parts

SEEDS = range(16)


@pytest.fixture(scope="module")
def drawn():
    return [procedural_object(seed) for seed in SEEDS]


def test_a_seed_makes_the_same_object_and_others_make_others(drawn) -> None:
    again = [procedural_object(seed) for seed in (0, 7)]
    assert [obj.sha256 for obj in again] == [drawn[0].sha256, drawn[7].sha256]
    assert len({obj.sha256 for obj in drawn}) == len(drawn)


def test_they_are_for_training_and_of_a_size_that_a_hand_can_hold(drawn) -> None:
    extents = np.array([np.ptp(obj.vertices, axis=0) for obj in drawn])
    assert {obj.split for obj in drawn} == {"train"}
    assert extents.max(1).min() >= SIZE[0] - 1e-9
    assert extents.max(1).max() <= SIZE[1] + 1e-9
    assert extents.min() >= THINNEST - 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_the_convex_parts_fill_the_object_and_nothing_else(drawn, seed: int) -> None:
    require_exact_parts(drawn[seed])


def test_they_are_solid_and_in_one_piece(drawn) -> None:
    for seed, obj in zip(SEEDS, drawn, strict=True):
        mesh = trimesh.Trimesh(obj.vertices, obj.faces)
        assert mesh.is_watertight, seed
        assert mesh.body_count == 1, seed


def test_every_family_makes_solids() -> None:
    for family in FAMILIES:
        for piece in family(np.random.default_rng(3)):
            assert (piece.mesh if isinstance(piece, Solid) else piece).is_watertight, family.__name__


def test_a_name_and_a_range_stand_for_them(drawn) -> None:
    assert load_object("procedural_7").sha256 == drawn[7].sha256
    assert resolve_objects(["procedural:7-9", "mug"]) == ["procedural_7", "procedural_8", "procedural_9", "mug"]
    assert locate_object("procedural_7")[1] == "procedural_7"
    require_known(["barrett"], ["procedural_7"])
    require_distinct_names(["barrett"], ["procedural_7", "procedural_8"])
    half = load_object("procedural_7", scale=0.5)
    np.testing.assert_allclose(half.extents, drawn[7].extents / 2, rtol=1e-5)


@pytest.mark.parametrize(("name", "message"), [
    ("procedural:9-7", "no object is in 'procedural:9-7'; give the smaller seed first"),
    ("procedural:0-999999999", "stands for 1,000,000,000 objects; give at most 100,000"),
])
def test_a_range_that_is_none_is_refused(name: str, message: str) -> None:
    with pytest.raises(ObjectError, match=message):
        resolve_objects([name])
