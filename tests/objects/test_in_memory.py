"""Objects from meshes and points that a program holds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.errors import ObjectError
from dro_grasp.objects.catalogue import load_object

CYLINDER = trimesh.creation.cylinder(radius=0.03, height=0.1)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("meshes") / "can.ply"
    CYLINDER.export(path)
    return path


def in_millimetres() -> trimesh.Trimesh:
    mesh = CYLINDER.copy()
    mesh.apply_scale(1000)
    mesh.units = "mm"
    return mesh


@pytest.mark.parametrize("source", [
    CYLINDER, trimesh.Scene([CYLINDER]), (CYLINDER.vertices, CYLINDER.faces), in_millimetres(),
    (torch.as_tensor(np.asarray(CYLINDER.vertices)), torch.as_tensor(np.asarray(CYLINDER.faces)))], ids=str)
def test_a_mesh_in_memory_is_the_mesh_of_its_file(source, file: Path) -> None:
    obj, stored = load_object(source, name="can"), load_object(file)
    assert (obj.name, obj.file, stored.file) == ("can", None, str(file.resolve()))
    assert obj.volume == pytest.approx(stored.volume, rel=1e-5)
    np.testing.assert_allclose(obj.centre_of_mass, stored.centre_of_mass, atol=1e-6)
    np.testing.assert_allclose(obj.extents, (0.06, 0.06, 0.1), atol=1e-3)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor, trimesh.PointCloud])
def test_points_in_memory_are_a_bare_cloud(kind) -> None:
    points = CYLINDER.sample(500, seed=0)
    obj = load_object(kind(points), scale=0.5)
    assert obj.is_cloud
    assert obj.name == "cloud"
    np.testing.assert_allclose(obj.extents, np.ptp(points, axis=0) / 2, atol=1e-6)


@pytest.mark.parametrize(("source", "word"), [
    (np.zeros((4, 2)), r"shape \(4, 2\)"),
    ((np.zeros((4, 2)), np.zeros((1, 3), int)), r"vertices have shape \(4, 2\)"),
    ((np.eye(3), np.zeros((1, 4), int)), r"faces have shape \(1, 4\)"),
    ((np.eye(3), np.array([[0.0, 1, 2]])), "faces are numbers of type float64"),
    ((np.eye(3), np.array([[0, 1, 9]])), "vertex 9"), (trimesh.creation.box((9, 9, 9)), "too large")])
def test_what_is_no_object_is_refused_in_words(source, word: str) -> None:
    with pytest.raises(ObjectError, match=word):
        load_object(source)


def test_without_shape_checks_other_types_are_refused_in_words() -> None:
    code = ("import dro_grasp as dro, numpy as np\n"
            "for given in ([1, 2], 7, np.array([['a'] * 3])):\n"
            "    try: dro.load_object(given)\n    except dro.DroGraspError as error: print(error)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    listed, number, text = done.stdout.splitlines()
    assert listed.startswith("an object cannot be loaded from a list; give a name, the path of a mesh")
    assert number.startswith("an object cannot be loaded from a int")
    assert "instead of numbers" in text
