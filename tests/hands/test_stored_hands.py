"""Hands that were derived before are read from the cache."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import dro_grasp as dro
from dro_grasp.hands import stored
from dro_grasp.hands.build import build_hand
from dro_grasp.hands.library import BUILTIN_FOLDER, load_hand_description


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal, bit for bit, with all that records hold."""
    if isinstance(a, Tensor):
        return a.dtype == b.dtype and a.stride() == b.stride() and torch.equal(a, b)
    if dataclasses.is_dataclass(a):
        compared = (f.name for f in dataclasses.fields(a) if f.compare)
        return type(a) is type(b) and all(same(getattr(a, name), getattr(b, name)) for name in compared)
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("name", sorted(file.stem for file in BUILTIN_FOLDER.glob("*.urdf")))
def test_a_hand_from_the_cache_is_the_one_that_is_built(name: str, own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built = build_hand(load_hand_description(name)[0], name=name)
    first = dro.load_hand(name)
    monkeypatch.setattr(stored, "build_hand", lambda *_, **__: pytest.fail("built again"))
    again = dro.load_hand(name)
    assert len(list(own_cache.glob("hand-*.npz"))) == 1
    assert same(built, first)
    assert same(built, again)
    assert again.description is not None


@pytest.mark.parametrize("changed", ["code", "seed", "n_points", "file"])
def test_it_is_built_again_where_anything_is_different(
    changed: str, own_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "own.urdf"
    file.write_bytes((BUILTIN_FOLDER / "gripper3.urdf").read_bytes())
    dro.load_hand(file)
    if changed == "code":
        monkeypatch.setattr(stored, "_code", lambda: "other")
    if changed == "file":
        file.write_bytes(file.read_bytes() + b"\n")
    dro.load_hand(file, seed=int(changed == "seed"), n_points=256 if changed == "n_points" else 512)
    assert len(list(own_cache.glob("hand-*.npz"))) == 2


def test_a_damaged_entry_is_made_again(own_cache: Path) -> None:
    before = dro.load_hand("gripper3")
    (entry,) = own_cache.glob("hand-*.npz")
    entry.write_bytes(entry.read_bytes()[:100])
    assert same(dro.load_hand("gripper3"), before)
