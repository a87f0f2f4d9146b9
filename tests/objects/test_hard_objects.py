"""Hard built-in objects: two halves of the same kinds, sound solids, as all built-in ones, with exact parts and masses."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh

from dro_grasp.cli.main import main
from dro_grasp.geometry.cache import content_hash
from dro_grasp.objects.builtin import BUILTIN, HARD, make_builtin, usual
from dro_grasp.objects.builtin.construction import HARD_TEST, HARD_TRAIN, STEEL
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.convex_parts import pack
from dro_grasp.objects.shape import DENSITY, ObjectModel
from dro_grasp.objects.solids import Solid, bar, circle, placed, rectangle, ring, slab, spar, swept, vessel, washer
from dro_grasp.simulation.protocols import protocol
from dro_grasp.simulation.scene import add_object
from dro_grasp.training.data.bundle.training_file import SPLITS
from tests.helpers.exact_parts import require_exact_parts

ROOT = Path(__file__).parents[2]
NAMES = [name for kind in HARD.values() for name in kind]
TESTED = [name for name in NAMES if BUILTIN[name].split == HARD_TEST]


@pytest.fixture(scope="module")
def made() -> dict[str, ObjectModel]:
    return {name: make_builtin(name) for name in BUILTIN}


def test_every_kind_is_in_both_halves_and_no_name_is_there_twice() -> None:
    for kind, members in HARD.items():
        assert {each.split for each in members.values()} == {HARD_TRAIN, HARD_TEST}, kind
    assert len(BUILTIN) == len(usual.OBJECTS) + sum(map(len, HARD.values()))
    halves = [sum(each.split == split for each in BUILTIN.values()) for split in (HARD_TRAIN, HARD_TEST)]
    assert min(halves) >= 16
    assert not {each.split for each in usual.OBJECTS.values()} & {HARD_TRAIN, HARD_TEST}


def test_no_member_of_one_half_is_another_size_of_one_of_the_other(made: dict[str, ObjectModel]) -> None:
    def form(obj: ObjectModel) -> np.ndarray:
        """Unchanged by scale: extents relative to the largest, and the share of the box that is filled."""
        extents = np.sort(obj.extents)
        return np.array([*extents[:2] / extents[2], obj.volume / extents.prod()])

    for kind, members in HARD.items():
        halves = [[name for name in members if BUILTIN[name].split == split] for split in (HARD_TRAIN, HARD_TEST)]
        for first, second in product(*halves):
            a, b = form(made[first]), form(made[second])
            assert np.abs(np.log(a / b)).max() > 0.1, (kind, first, second)
    assert np.abs(np.log(form(made["parcel"]) / form(load_object("parcel", scale=0.5)))).max() < 1e-6


@pytest.mark.parametrize("name", BUILTIN)
def test_each_is_one_watertight_solid_that_needs_no_repair(name: str, made: dict[str, ObjectModel]) -> None:
    obj = made[name]
    assert obj.vertices is not None
    mesh = trimesh.Trimesh(obj.vertices, obj.faces, process=False)
    assert mesh.is_volume
    assert mesh.body_count == 1
    assert obj.notes == ()
    assert obj.split == BUILTIN[name].split
    assert obj.volume == pytest.approx(mesh.volume)


@pytest.mark.parametrize("name", BUILTIN)
def test_the_convex_parts_are_the_object(name: str, made: dict[str, ObjectModel]) -> None:
    require_exact_parts(made[name])


def test_the_check_of_parts_sees_one_that_is_missing_or_too_large(made: dict[str, ObjectModel]) -> None:
    cup = made["tea_cup"]
    whole = replace(cup, exact_parts=cup.parts[:20] + cup.parts[21:])
    wide = replace(cup, exact_parts=((cup.parts[0][0] * 1.01, cup.parts[0][1]), *cup.parts[1:]))
    for wrong in (whole, wide):
        with pytest.raises(AssertionError):
            require_exact_parts(wrong)


@pytest.mark.parametrize("name", BUILTIN)
def test_parts_are_convex_and_coarse_ones_are_fewer_solids(name: str, made: dict[str, ObjectModel]) -> None:
    obj = made[name]
    for part in obj.parts:
        hull = trimesh.Trimesh(*part)
        assert hull.is_volume
        assert hull.volume == pytest.approx(trimesh.convex.convex_hull(part[0]).volume, rel=1e-6)
    coarse = obj.coarse.parts
    assert len(coarse) == (len(obj.parts) + 1) // 2
    assert min(trimesh.convex.convex_hull(vertices).volume for vertices, _ in coarse) > 1e-10
    assert obj.coarse.mass == obj.mass


@pytest.mark.parametrize("name", NAMES)
def test_each_is_made_in_a_second(name: str) -> None:
    def seconds() -> float:
        begin = time.process_time()
        make_builtin(name)
        return time.process_time() - begin

    assert min(seconds() for _ in range(3)) < 1.5  # 0.2 s on a fast machine, 0.6 s on the slowest so far


@pytest.mark.parametrize(("name", "mass"), [
    ("frying_pan", (0.8, 1.3)), ("bank_card", (0.004, 0.006)), ("ballpoint_pen", (0.008, 0.015)), ("hex_nut", (0.05, 0.07)),
    ("dinner_plate", (0.4, 0.8)), ("table_fork", (0.03, 0.07)), ("football", (0.41, 0.45)), ("hex_dumbbell", (3, 4)),
    ("hex_bolt", (0.05, 0.08)), ("tea_cup", (0.08, 0.2)), ("iron_ingot", (2, 2.5)), ("chopping_board", (0.3, 0.5)),
])
def test_masses_are_those_of_such_things(name: str, mass: tuple[float, float], made: dict[str, ObjectModel]) -> None:
    assert mass[0] <= made[name].mass <= mass[1]


def test_heavy_ones_are_heavy_and_no_other_is_a_load(made: dict[str, ObjectModel]) -> None:
    for name in NAMES:
        heavy = name in HARD["heavy"]
        assert (1.5 if heavy else 0.002) <= made[name].mass <= (4 if heavy else 2), name


def test_a_scaled_object_keeps_its_density() -> None:
    whole, half = load_object("frying_pan"), load_object("frying_pan", scale=0.5)
    assert whole.mass == pytest.approx(1.0)
    assert half.density == pytest.approx(whole.density)
    assert half.mass == pytest.approx(whole.mass / 8)
    assert load_object("table_fork").density == STEEL
    assert load_object("mug").density == DENSITY


def test_the_hash_of_what_is_simulated_knows_the_mass_and_is_as_before_without_one() -> None:
    mug = load_object("mug")
    heavy = replace(mug, density=2 * DENSITY)
    assert heavy.sha256 == mug.sha256
    assert heavy.solid_sha256 != mug.solid_sha256
    shape = np.frombuffer(mug.sha256.encode(), np.uint8)
    unit = np.array([mug.volume, *mug.centre_of_mass, *mug.inertia.ravel()])
    assert mug.solid_sha256 == content_hash(shape, unit, *pack(mug.parts).values())


@pytest.mark.parametrize("name", NAMES)
def test_the_simulator_takes_it_with_its_mass(name: str, made: dict[str, ObjectModel]) -> None:
    """Of the object alone, without any hand."""
    obj, scene = made[name], mujoco.MjSpec()
    add_object(scene, obj, protocol("strict"))
    model = scene.compile()
    assert model.body_mass.sum() == pytest.approx(obj.mass)
    principal = np.sort(np.linalg.eigvalsh(obj.inertia) * obj.density)
    np.testing.assert_allclose(np.sort(model.body_inertia[-1]), principal, rtol=1e-6)
    assert model.ngeom == len(obj.parts)


def test_groups_and_list_name_both_halves(capsys: pytest.CaptureFixture[str]) -> None:
    assert resolve_objects(["builtin:hard_test"]) == sorted(TESTED)
    assert resolve_objects(["builtin:hard_train"]) == sorted(set(NAMES) - set(TESTED))
    assert not set(resolve_objects(["builtin:test", "builtin:train"])) & set(NAMES)
    assert main(["objects", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["objects"]
    assert {name: listed[name] for name in NAMES} == {name: BUILTIN[name].split for name in NAMES}


def named(text: str) -> set[str]:
    """Objects by which nothing may be chosen, and their group, where a text names them."""
    return {name for name in (*TESTED, HARD_TEST) if re.search(rf"(?<![A-Za-z]){name}(?![A-Za-z])", text)}


RECIPES = sorted([ROOT / "Makefile", *(ROOT / "scripts").glob("train_*"), *(ROOT / "lab" / "recipe").glob("*.py"),
                  *(ROOT / "lab" / "studies").glob("*.py"),
                  *(ROOT / "src" / "dro_grasp" / "training").rglob("*.py")])


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_recipe_of_data_training_or_ranking_names_the_half_for_tests(path: Path) -> None:
    assert not named(path.read_text())


def test_a_name_in_a_recipe_would_be_seen() -> None:
    assert named("--object mug builtin:hard_test") == {HARD_TEST}
    assert named('OBJECTS = ("cube", "towel_ring")') == {"towel_ring"}
    assert not named("key, pen and book; footballer")
    assert {"Makefile", "ranking.py", "holding.py", "completion.py", "steps.py"} <= {path.name for path in RECIPES}


def test_shipped_grasps_are_of_none_of_them() -> None:
    files = sorted((ROOT / "data" / "grasps").glob("*.parquet"))
    assert files
    for file in files:
        assert not set(pq.read_table(file, columns=["object"])["object"].unique().to_pylist()) & set(NAMES), file.name


def test_no_bundle_takes_grasps_on_the_half_for_tests() -> None:
    assert [name for name, allowed in SPLITS.items() if HARD_TRAIN in allowed] == ["train"]
    assert not any(HARD_TEST in allowed for allowed in SPLITS.values())


def solid_volume(solid: Solid) -> float:
    """Of the mesh, which the parts fill."""
    assert solid.mesh.is_volume
    assert sum(part.volume for part in solid.parts) == pytest.approx(solid.mesh.volume, rel=1e-6)
    return float(solid.mesh.volume)


def test_volume_of_a_bar_is_its_section_times_the_length_of_its_middle_line() -> None:
    """Holds for mitred bars: what a corner adds outside it takes away inside."""
    corner = np.array([(0, 0, 0), (0.1, 0, 0), (0.1, 0.08, 0), (0.1, 0.08, 0.05)])
    assert solid_volume(bar(corner, rectangle((0.004, 0.002)))) == pytest.approx(0.008 * 0.004 * 0.23)
    frame = np.array([(0, 0, 0), (0.2, 0, 0), (0.2, 0.1, 0), (0, 0.1, 0)])
    assert solid_volume(bar(frame, rectangle((0.004, 0.002)), closed=True)) == pytest.approx(0.008 * 0.004 * 0.6)
    upward = bar(np.array([(0, 0, 0), (0.1, 0, 0)]), rectangle((0.004, 0.002)))
    np.testing.assert_allclose(upward.mesh.extents, (0.1, 0.008, 0.004))


def test_volume_of_vessels_and_washers() -> None:
    pot = solid_volume(vessel(lambda r: circle(r, 96), [(0.05, 0), (0.05, 0.08)], [(0.047, 0.004), (0.047, 0.08)]))
    assert pot == pytest.approx(np.pi * (0.05**2 * 0.08 - 0.047**2 * 0.076), rel=2e-3)
    crate = vessel(lambda r: rectangle((0.1, 0.06), r), [(0.01, 0), (0.01, 0.1)], [(0.005, 0.003), (0.005, 0.1)])
    assert solid_volume(crate) == pytest.approx(0.22 * 0.14 * 0.1 - 0.21 * 0.13 * 0.097)
    nut = solid_volume(washer(circle(0.02, 96), circle(0.01, 96), 0, 0.01))
    assert nut == pytest.approx(np.pi * 3e-4 * 0.01, rel=2e-3)


def test_flat_pieces_and_tapered_ones() -> None:
    assert slab(rectangle((0.04, 0.02), 0.005, 24), 0, 0.01).volume == pytest.approx(
        0.01 * (0.09 * 0.05 - (4 - np.pi) * 0.005**2), rel=1e-3)
    pieces = spar([(0, 0.02, 0.01, 0), (0.1, 0.02, 0.01, 0), (0.2, 0.0, 0.01, 0.03)])
    assert [piece.volume for piece in pieces] == pytest.approx([0.02 * 0.01 * 0.1, 0.01 * 0.01 * 0.1])


def test_a_placed_piece_is_stretched_turned_and_moved_with_its_parts() -> None:
    wheel = placed(ring(0.05, 0.01), (0.3, 0, 0), (90, 0, 0), (1, 2, 1))
    np.testing.assert_allclose(wheel.mesh.bounds.mean(0), (0.3, 0, 0), atol=1e-3)
    np.testing.assert_allclose(wheel.mesh.extents, (0.12, 0.02, 0.24), rtol=0.05)
    assert solid_volume(wheel) == pytest.approx(2 * ring(0.05, 0.01).mesh.volume)
    through = swept([np.array([(x, y, z) for y, z in circle(0.01, 6)]) for x in (0.0, 0.1, 0.3)])
    assert len(through.parts) == 2
    assert solid_volume(through) == pytest.approx(0.3 * 1.5 * np.sqrt(3) * 1e-4)
