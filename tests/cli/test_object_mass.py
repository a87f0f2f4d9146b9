"""Grasps remember the mass that was stated of their object, and what reads their file simulates with it."""

from __future__ import annotations

from pathlib import Path

import pytest

import dro_grasp as dro
from dro_grasp.cli.main import main
from dro_grasp.cli.view import Picture, of_object
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import OBJECT_MASS
from dro_grasp.grasps.sources import object_of, recorded_mass, with_own_files
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict import stages
from dro_grasp.predict.sources.controls import palm_facing_starts
from dro_grasp.training.data.collections.collection import Sources

HAND = dro.load_hand("gripper3")


def made_for(mass: float | None, obj: str = "cube") -> GraspBatch:
    """A start of a grasp, as the predictor returns it for an object of this mass [kg]."""
    known = dro.load_object(obj, mass=mass)
    return with_own_files(palm_facing_starts(HAND, known, num=1, seed=0), HAND, known)


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Masses of the objects that trials saw [kg]."""
    seen, real = [], stages.simulate

    def simulate(hand: dro.Hand, obj: ObjectModel, *rest: object, **options: object) -> object:
        seen.append(obj.mass)
        return real(hand, obj, *rest, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(stages, "simulate", simulate)
    return seen


def test_trials_of_a_file_have_its_mass_unless_another_is_given(tried: list[float], tmp_path: Path) -> None:
    path, output = tmp_path / "heavy.parquet", tmp_path / "tried.parquet"
    made_for(0.7).save(path)
    assert main(["evaluate", str(path), "--json"]) == 0
    assert main(["evaluate", str(path), "--mass", "0.3", "--output", str(output), "--json"]) == 0
    assert main(["evaluate", str(path), "--object", "cube", "--json"]) == 0
    assert main(["evaluate", str(output), "--json"]) == 0, "outcomes stay beside the mass that they are of"
    assert tried == pytest.approx([0.7, 0.3, 0.7, 0.3], rel=1e-12)


def test_a_file_without_a_mass_is_read_as_before(tried: list[float], tmp_path: Path) -> None:
    path = tmp_path / "usual.parquet"
    made_for(None).save(path)
    assert OBJECT_MASS not in GraspBatch.load(path).extra
    assert main(["evaluate", str(path), "--json"]) == 0
    assert tried == [dro.load_object("cube").mass]


def test_generate_writes_the_mass(generate, tmp_path: Path) -> None:
    path = tmp_path / "grasps.parquet"
    generate("--output", str(path), "--protocol", "none", "--mass", "0.15", num=1)
    assert object_of(GraspBatch.load(path), None, 1.0).mass == pytest.approx(0.15, rel=1e-12)


def test_pages_and_pictures_of_a_file_show_its_mass(tmp_path: Path) -> None:
    path = tmp_path / "heavy.parquet"
    made_for(0.7).save(path)
    ((drawn, _),) = Picture(path, tmp_path / "sheet.png").pairs(GraspBatch.load(path))
    shown, _ = of_object(GraspBatch.load(path), None, 1.0)
    other, _ = of_object(GraspBatch.load(path), "can", 1.0)
    assert [drawn.mass, shown.mass, other.mass] == pytest.approx([0.7] * 3, rel=1e-12)
    assert main(["export", str(path), "--format", "csv", "--output", str(tmp_path / "heavy.csv")]) == 0, "it needs the object"


def test_grasps_of_several_masses_need_one_to_be_stated(
    tried: list[float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mixed.parquet"
    for other, named in ((0.4, "0.4 kg and 0.7 kg"), (None, "0.7 kg and none")):
        GraspBatch.concatenate([made_for(0.7), made_for(other), made_for(0.2, "can")]).save(path)
        assert main(["evaluate", str(path)]) == 2
        assert f"the grasps of 'cube' were made for several masses, {named}; state one (--mass)" in capsys.readouterr().err
    assert not tried
    assert main(["evaluate", str(path), "--mass", "0.5", "--json"]) == 0
    assert tried == pytest.approx([0.5, 0.5])


def test_objects_of_a_file_keep_their_own_masses(tried: list[float], tmp_path: Path) -> None:
    path = tmp_path / "several.parquet"
    GraspBatch.concatenate([made_for(0.7), made_for(None, "sphere"), made_for(0.2, "can")]).save(path)
    assert main(["evaluate", str(path), "--json"]) == 0
    assert tried == pytest.approx([0.7, dro.load_object("sphere").mass, 0.2])


def test_a_source_of_grasps_for_another_mass_does_not_pass_it_on() -> None:
    light = dro.load_object("cube")
    assert recorded_mass(with_own_files(made_for(0.7), HAND, light)) is None


def test_collections_tell_masses_of_one_object_apart() -> None:
    sources = Sources()
    assert [sources.of(made_for(mass))[1].mass for mass in (0.7, 0.2)] == pytest.approx([0.7, 0.2])
