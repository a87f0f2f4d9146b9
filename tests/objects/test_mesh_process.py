from __future__ import annotations

import numpy as np
import pytest

from dro_grasp.errors import ObjectError
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.mesh_process import processed_objects
from tests.helpers.bench_clone import clone_of_bars


@pytest.fixture
def clone(tmp_path):
    return clone_of_bars(tmp_path, ("b", "a"))


def test_objects_have_the_benchmarks_parts_at_the_scale(clone):
    folders = processed_objects(clone)
    assert [folder.name for folder in folders] == ["a", "b"]
    obj = load_object(folders[0], scale=0.06)
    assert obj.name == "a@0.06"
    np.testing.assert_allclose(obj.extents, [0.12, 0.06, 0.06])
    assert [sorted(np.ptp(vertices, axis=0)) for vertices, _ in obj.parts] == [[pytest.approx(0.06)] * 3] * 2
    assert [np.mean(vertices, 0)[0] for vertices, _ in obj.parts] == pytest.approx([-0.03, 0.03])
    assert resolve_objects([str(folders[0])]) == [str(folders[0])]


def test_what_it_says_it_was_loaded_from_is_the_same_object(clone):
    obj = load_object(processed_objects(clone)[1], scale=0.1)
    again = load_object(obj.file, scale=obj.scale)
    assert (again.name, again.sha256, len(again.parts)) == (obj.name, obj.sha256, 2)


def test_a_folder_without_any_is_told(clone):
    with pytest.raises(ObjectError, match="holds no object of DexGraspBench"):
        processed_objects(clone / "assets" / "empty")
    with pytest.raises(ObjectError, match="is a folder"):
        load_object(clone / "assets" / "empty")
