"""What can be asked for by name: built-in, the user's own, and uploads."""

from __future__ import annotations

from copy import copy

import numpy as np
import pytest
import trimesh

from dro_grasp.web import library as module
from dro_grasp.web.library import Library
from tests.helpers.toy_hand import toy_hand


def test_a_scene_does_not_take_the_place_of_an_object_of_its_file_name() -> None:
    def box(*size: float) -> bytes:
        return trimesh.creation.box(size).export(file_type="stl")

    library = Library()
    assert library.take("part.stl", box(0.05, 0.05, 0.05), "object") == "part.stl"
    assert library.take("part.stl", box(0.5, 0.5, 0.02), "scene") == "part (2).stl"
    assert np.ptp(library.obj("part.stl").vertices, axis=0) == pytest.approx([0.05] * 3)
    assert library.scene("part (2).stl") is not None
    assert library.take("part.stl", box(0.06, 0.06, 0.06), "object") == "part.stl"
    assert np.ptp(library.obj("part.stl").vertices, axis=0) == pytest.approx([0.06] * 3), "the newer one of its kind"
    library.close()


def test_only_what_was_used_last_stays_loaded_and_what_was_added_loaded_stays_besides(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(module.MAX_LOADED, "hand", 2)
    loads: list[str] = []
    monkeypatch.setattr(module, "load_hand", lambda source: loads.append(source) or copy(toy_hand()))
    library, own = Library(), toy_hand()
    library.add("hand", "mine", own)
    library.add("hand", "file", "folder/file.urdf")
    seen = {name: library.hand(name) for name in ("a", "b", "a", "file")}
    assert library.hand("a") is seen["a"]
    assert library.hand("b") is not seen["b"]
    assert library.hand("mine") is own
    assert loads == ["a", "b", "folder/file.urdf", "b"]
    assert library.names("hand")[:2] == ("mine", "file")
    library.add("hand", "b", "folder/other.urdf")
    library.hand("b")
    assert loads[-1] == "folder/other.urdf", "the newer one of its name"
