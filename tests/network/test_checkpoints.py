"""Weights files: round trip, precision, damage, pickles, names, places that cannot be written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from dro_grasp.cli.main import main
from dro_grasp.errors import OutputError, WeightsError
from dro_grasp.network import checkpoints
from dro_grasp.network.checkpoints import (
    CHECKSUMS,
    DEFAULT,
    KEY,
    SHIPPED_FOLDER,
    SMALL,
    describe_weights,
    history_of,
    load_weights,
    locate_weights,
    save_weights,
    verify_weights,
    weights_names,
)
from dro_grasp.network.network import DistanceNetwork, untrained_network
from dro_grasp.network.presets import NetworkConfig
from tests.helpers.tiny_bundle import TINY

HALF_ROUNDING = 2.0**-11
"""Largest relative rounding error of half precision."""


@pytest.fixture
def network() -> DistanceNetwork:
    """Untrained, with statistics that half precision could not hold."""
    torch.manual_seed(0)
    made = DistanceNetwork(TINY)
    made.hand_encoder.final.norm.running_var.fill_(1e-9)
    made.hand_encoder.final.norm.running_mean.fill_(1.0001)
    return made


@pytest.fixture
def path(tmp_path: Path, network: DistanceNetwork) -> Path:
    save_weights(network, tmp_path / "mine.safetensors", {"stage": "test"})
    return tmp_path / "mine.safetensors"


def test_weights_may_be_named_from_home(tmp_path: Path, network: DistanceNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    save_weights(network, "~/mine.safetensors")
    assert (tmp_path / "mine.safetensors").is_file()
    assert load_weights("~/mine.safetensors").config == TINY


def test_weights_come_back_in_half_precision(path: Path, network: DistanceNetwork) -> None:
    read = load_weights(path)
    assert (read.config, read.name, read.training) == (TINY, "mine", False)
    given = network.state_dict()
    assert list(read.state_dict()) == list(given)
    for name, value in read.state_dict().items():
        assert value.dtype == given[name].dtype, name
        if "running" in name or "tracked" in name:
            assert torch.equal(value, given[name]), name
        else:
            torch.testing.assert_close(value, given[name], rtol=HALF_ROUNDING, atol=6e-8)


def test_a_second_round_trip_changes_nothing(path: Path, tmp_path: Path) -> None:
    read = load_weights(path)
    save_weights(read, tmp_path / "again.safetensors")
    again = load_weights(tmp_path / "again.safetensors")
    assert all(torch.equal(a, b) for a, b in zip(read.state_dict().values(), again.state_dict().values(), strict=True))


def test_rounding_hardly_changes_the_prediction(path: Path, network: DistanceNetwork) -> None:
    generator = torch.Generator().manual_seed(0)
    hand, obj = (torch.randn(2, n, 3, generator=generator) * 0.1 for n in (TINY.n_hand, TINY.n_object))
    network.hand_encoder.final.norm.reset_running_stats()
    save_weights(network, path)
    z = network.sample_latent(2, generator)
    before, after = network.eval().predict(hand, obj, z), load_weights(path).predict(hand, obj, z)
    torch.testing.assert_close(after, before, rtol=1e-2, atol=1e-4)


CHANGED = {
    "unknown setting": {"magic": 1}, "hand not placed": {"placed": False},
    "contradiction": {"frame": "object", "latent_form": "motion"},
    "wrist": {"frame": "wrist"}, "gaussian": {"prior": "learned"}, "features": {"placement_hand": "features"},
}
"""Settings that a file may not have."""


def change(path: Path, how: str) -> None:
    whole = path.read_bytes()
    with safe_open(path, "pt") as file:
        header = json.loads(file.metadata()[KEY])
        tensors = {key: file.get_tensor(key) for key in file.keys()}
    path.unlink()
    if how == "cut short":
        path.write_bytes(whole[:-100])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "foreign":
        save_file(tensors, path)
    elif how == "strange header":
        save_file(tensors, path, metadata={KEY: "[1]"})
    elif how == "no configuration":
        save_file(tensors, path, metadata={KEY: json.dumps({"format_version": 1})})
    elif how == "another version":
        save_file(tensors, path, metadata={KEY: json.dumps(header | {"format_version": 99})})
    elif how == "other sizes":
        header["config"]["width"] = 20
        save_file(tensors, path, metadata={KEY: json.dumps(header)})
    elif how == "impossible sizes":
        header["config"]["latent_head"] = [1]
        save_file(tensors, path, metadata={KEY: json.dumps(header)})
    elif how in CHANGED:
        save_file(tensors, path, metadata={KEY: json.dumps(header | {"config": header["config"] | CHANGED[how]})})
    else:
        torch.save(tensors, path, _use_new_zipfile_serialization=how == "zipped pickle")


@pytest.mark.parametrize(
    ("how", "word"),
    [
        ("cut short", "cut short"), ("empty", "cut short"), ("foreign", "not of dro-grasp"),
        ("strange header", "not of dro-grasp"), ("no configuration", "expected weights of this version"),
        ("other sizes", "has shape|of shape"),
        ("impossible sizes", "expected weights of this version"), ("unknown setting", "unknown settings magic"),
        ("hand not placed", "unknown settings placed"),
        ("contradiction", "latent_form is no longer a choice; in frame 'object' it is kernel now, and motion in the file"),
        ("wrist", "expected weights of this version of the network"),
        ("gaussian", "prior is no longer a choice; in frame 'palm' it is flow now, and learned in the file"),
        ("features", "placement_hand is no longer a choice; in frame 'palm' it is proportions now, and features in the file"),
        ("another version", "version 99, expected 1"), ("zipped pickle", "can run code"), ("bare pickle", "can run code"),
    ],
)
def test_a_damaged_or_foreign_file_is_refused(path: Path, how: str, word: str) -> None:
    change(path, how)
    with pytest.raises(WeightsError, match=word):
        load_weights(path)


def test_unknown_names_list_the_shipped_ones(tmp_path: Path) -> None:
    for name in ("nothing", str(tmp_path), str(tmp_path / "no.safetensors")):
        with pytest.raises(WeightsError, match=", ".join(weights_names())):
            load_weights(name)


def test_a_folder_that_cannot_be_written_is_told(
    network: DistanceNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="cannot write weights"):
        save_weights(network, tmp_path / "none" / "mine.safetensors")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="cannot write weights"):
        save_weights(network, tmp_path / "folder")
    monkeypatch.setattr(checkpoints, "save_file", full)
    with pytest.raises(OutputError, match="No space left"):
        save_weights(network, tmp_path / "mine.safetensors")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_description_counts_and_names(path: Path, network: DistanceNetwork) -> None:
    about = describe_weights(path)
    assert about["parameters"] == sum(v.numel() for v in network.state_dict().values())
    assert (about["name"], about["bytes"], about["about"]) == ("mine", path.stat().st_size, {"stage": "test"})
    assert about["history"] == []
    assert NetworkConfig.from_dict(about["config"]) == TINY
    assert path.stat().st_mode & 0o777 == 0o644


def test_weights_remember_every_training_before(path: Path, network: DistanceNetwork, tmp_path: Path) -> None:
    later = tmp_path / "later.safetensors"
    save_weights(network, later, {"stage": "second"}, history_of(path))
    assert describe_weights(later)["about"] == {"stage": "second"}
    assert describe_weights(later)["history"] == [{"stage": "test"}]
    save_weights(torch.nn.Linear(2, 1), tmp_path / "small.safetensors", {"stage": "third"}, history_of(later))
    stages = [entry["stage"] for entry in history_of(tmp_path / "small.safetensors")]
    assert stages == ["test", "second", "third"]
    assert [entry["stage"] for entry in history_of(locate_weights())][-1] == "training"
    small = {"ranking/quality": "ranking", "ranking/holding": "ranking of settled grasps", "completion/surface": "completion"}
    for name, stage in small.items():
        assert {entry["stage"] for entry in history_of(SHIPPED_FOLDER / f"{name}.safetensors")} == {stage}


def test_shipped_weights_load() -> None:
    assert weights_names() == [DEFAULT]
    assert locate_weights(None) == locate_weights(DEFAULT) == SHIPPED_FOLDER / f"{DEFAULT}.safetensors"
    assert load_weights().name == DEFAULT
    assert all(bool(v.isfinite().all()) for v in load_weights().state_dict().values())


@pytest.mark.parametrize("name", ["multi", "more_hands"])
def test_weights_that_shipped_before_are_refused_with_the_state_that_had_them(name: str, tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(WeightsError, match=f"'{name}' no longer ship.* commit e1ba941.*use 'more_objects'"):
        load_weights(name)
    monkeypatch.chdir(tmp_path)
    save_weights(untrained_network(TINY, 0), Path(name))
    assert load_weights(name).config == TINY, "a file of yours with this name"


def test_shipped_weights_are_as_they_were_shipped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    lines = dict(reversed(line.split()) for line in (SHIPPED_FOLDER / CHECKSUMS).read_text().splitlines())
    assert set(lines) == {f.relative_to(SHIPPED_FOLDER).as_posix() for f in SHIPPED_FOLDER.rglob("*.safetensors")}
    assert set(lines) == {f"{name}.safetensors" for name in (*weights_names(), *SMALL)}
    for name in weights_names():
        assert verify_weights(name) == lines[f"{name}.safetensors"] == describe_weights(name)["sha256"]
    for name in SMALL:
        assert verify_weights(name) == lines[f"{name}.safetensors"]
    folder = tmp_path / "weights"
    shutil.copytree(SHIPPED_FOLDER, folder)
    monkeypatch.setattr(checkpoints, "SHIPPED_FOLDER", folder)
    save_weights(load_weights(), folder / f"{DEFAULT}.safetensors", {"about": "made anew"})
    with pytest.raises(WeightsError, match="shipped was"):
        verify_weights(DEFAULT)
    harmed = bytearray((folder / "ranking" / "quality.safetensors").read_bytes())
    harmed[-1] ^= 1
    (folder / "ranking" / "quality.safetensors").write_bytes(harmed)
    with pytest.raises(WeightsError, match="shipped was"):
        verify_weights("ranking/quality")
    (folder / "completion" / "surface.safetensors").unlink()
    with pytest.raises(WeightsError, match="No such file"):
        verify_weights("completion/surface")


def test_verify_checks_files_of_the_user_as_well(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["weights", "verify", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["weights"][0]["sha256"] == describe_weights(path)["sha256"]
    path.write_bytes(path.read_bytes()[:-100])
    assert main(["weights", "verify", str(path), DEFAULT]) == 2
    said = capsys.readouterr()
    assert "cut short" in said.err
    assert DEFAULT in said.out
    assert main(["weights", "verify"]) == 0


def rewritten(path: Path, change: Any) -> Path:
    """The weights with a changed entry and changed tensors."""
    with safe_open(path, "pt") as file:
        entry, tensors = json.loads(file.metadata()[KEY]), {key: file.get_tensor(key) for key in file.keys()}
    change(entry, tensors)
    save_file(tensors, path, metadata={KEY: json.dumps(entry)})
    return path


@pytest.mark.parametrize("config", [
    None, 5, [], {}, {"width": None}, {"width": 0}, {"width": 10_000}, {"width": "64"}, {"width": True}, {"encoder_widths": []},
    {"encoder_widths": [8, None]}, {"encoder_widths": 8}, {"latent_head": [16]}, {"frame": "moon"},
    {"frame": None}, {"heads": 3}, {"neighbours": 4000}, {"placement_temperature": float("nan")},
    {"initial_distance": -1.0}, {"kernel_hidden": [16, 4096]},
])
def test_a_configuration_that_no_network_has_is_refused(tmp_path: Path, config: Any) -> None:
    path = tmp_path / "w.safetensors"
    save_weights(untrained_network(TINY, 0), path)

    def change(entry: dict[str, Any], _: dict[str, torch.Tensor]) -> None:
        entry["config"] = entry["config"] | config if isinstance(config, dict) and config else config

    with pytest.raises(WeightsError):
        load_weights(rewritten(path, change))


@pytest.mark.parametrize(
    ("value", "name"), [(torch.nan, "head.last.bias"), (torch.inf, "head.last.weight"), (-1.0, "running_var")])
def test_weights_that_are_not_finite_are_refused(tmp_path: Path, value: float, name: str) -> None:
    path = tmp_path / "w.safetensors"
    save_weights(untrained_network(TINY, 0), path)

    def change(_: dict[str, Any], tensors: dict[str, torch.Tensor]) -> None:
        tensors[next(key for key in tensors if name in key)].view(-1)[0] = value

    with pytest.raises(WeightsError, match=f"{name}.* holds NaN, infinity, or a negative variance"):
        load_weights(rewritten(path, change))


@pytest.mark.parametrize("entry", [{"about": 5}, {"history": {}}, {"history": [1]}, {"config": []}])
def test_an_entry_of_other_types_is_refused_by_every_reader(tmp_path: Path, entry: dict[str, Any]) -> None:
    path = tmp_path / "w.safetensors"
    save_weights(untrained_network(TINY, 0), path)
    rewritten(path, lambda old, _: old.update(entry))
    for read in (load_weights, describe_weights, history_of, verify_weights):
        with pytest.raises(WeightsError, match="must be objects"):
            read(path)


def test_a_name_that_is_too_long_for_a_file_beside_the_shipped_ones_is_unknown() -> None:
    with pytest.raises(WeightsError, match="shipped weights are"):
        load_weights("a" * 250)
