"""A folder of grasps remembers the settings that it was begun with."""

from __future__ import annotations

import json

import pytest

from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.optimize.contacts import ContactConfig
from dro_grasp.optimize.synthesis import SynthesisConfig
from dro_grasp.training.data.engine.schedule import SETTINGS
from dro_grasp.training.data.engine.worker import EngineConfig
from tests.helpers.engine_work import GRASPS
from tests.helpers.here_pool import run


@pytest.mark.parametrize(("options", "told"), [
    ({"config": EngineConfig("dro", scale=0.5)}, r"with protocol carry, scale 1\.0, protocol dro, scale 0\.5 was asked for"),
    ({"seed": 3}, "begun with seed 0, seed 3 was asked for; use the same to go on, or name another folder"),
    ({"config": EngineConfig(synthesis=SynthesisConfig(steps=9))}, r"synthesis\.steps 120, synthesis\.steps 9 was asked for"),
    ({"config": EngineConfig(synthesis=SynthesisConfig(contacts=ContactConfig(level_weights=(1.0,))))}, "level_weights"),
])
def test_a_folder_goes_on_only_with_the_settings_that_it_was_begun_with(tmp_path, options, told):
    run(tmp_path, ["a"], ["x"], 5)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    for goal in (5, 10):
        with pytest.raises(OptionError, match=told):
            run(tmp_path, ["a"], ["x"], goal, **options)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()} == before
    more = EngineConfig(candidates=64, seconds=60.0, shard=(1, 2), max_crashes=9, synthesis=SynthesisConfig(device="cpu"))
    assert run(tmp_path, ["a"], ["x"], 10, config=more)[0].added == GRASPS


def test_a_folder_of_an_earlier_version_goes_on_with_any_settings(tmp_path):
    run(tmp_path, ["a"], ["x"], 5)
    (tmp_path / SETTINGS).unlink()
    for seed in (1, 2):
        assert run(tmp_path, ["a"], ["x"], 5 * (seed + 1), seed=seed)[0].added == GRASPS
    assert not (tmp_path / SETTINGS).exists()


def test_settings_are_noted_where_the_file_system_has_no_links(tmp_path, monkeypatch):
    def no_link(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("os.link", no_link)
    run(tmp_path, ["a"], ["x"], 5)
    assert json.loads((tmp_path / SETTINGS).read_text())["seed"] == 0
    assert sorted(path.name for path in tmp_path.glob("*.*")) == [".lock", SETTINGS]


def test_damaged_settings_are_named(tmp_path):
    run(tmp_path, ["a"], ["x"], 5)
    (tmp_path / SETTINGS).write_text('{"seed": ')
    with pytest.raises(GraspFileError, match=r"settings\.json cannot be read .* remove it to go on with any"):
        run(tmp_path, ["a"], ["x"], 5)
