"""Files that Git LFS has not fetched: a few lines of text in place of a mesh, a hand or an object."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from dro_grasp.errors import HandError, ObjectError
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from tests.helpers.claw_urdf import claw, link, meshed, written

POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0f' * 32}\nsize 7172784\n"
MESH = '<mesh filename="{}"/>'
MJCF = ("<mujoco><asset><mesh name='tip' file='tip.stl'/></asset><worldbody><body name='palm'><geom size='.04'/>"
        "<body name='left' pos='-.035 0 .01'><joint name='a' axis='0 1 0' range='0 90'/><geom type='mesh' mesh='tip'/></body>"
        "</body></worldbody></mujoco>")


def all_meshes() -> str:
    """A claw of nothing but meshes."""
    text = claw(links=link("left", MESH.format("tip.stl")) + link("right", MESH.format("more.dae")))
    return text.replace('<box size="0.08 0.08 0.02"/>', MESH.format("palm.obj"))


@pytest.mark.parametrize("name", ["tip.stl", "tip.STL", "tip.dae", "tip.obj"])
def test_a_mesh_that_was_not_fetched_is_left_out_and_told(tmp_path: Path, name: str) -> None:
    written(tmp_path, POINTER, name)
    report = check_hand(written(tmp_path, meshed(name)))
    told = [note.text for note in report.notes if note.subject == "left"]
    assert f"collision mesh '{name}' is a pointer of Git LFS and is left out; fetch the file itself: git lfs pull, in its " \
        "repository" in told


def test_a_hand_of_pointers_is_refused_with_the_reason(tmp_path: Path) -> None:
    for name in ("tip.stl", "more.dae", "palm.obj"):
        written(tmp_path, POINTER, name)
    with pytest.raises(HandError, match=r"none of its 3 meshes can be read: 3 are pointers of Git LFS.*git lfs pull"):
        load_hand(written(tmp_path, all_meshes()))


def test_meshes_of_an_mjcf_and_descriptions_are_told_as_well(tmp_path: Path) -> None:
    written(tmp_path, POINTER, "tip.stl")
    with pytest.raises(HandError, match=r"1 files of meshes are pointers of Git LFS.*tip\.stl.*git lfs pull"):
        load_hand(written(tmp_path, MJCF, "hand.xml"))
    with pytest.raises(HandError, match=r"claw\.urdf is a pointer of Git LFS, not the hand; .*git lfs pull"):
        load_hand(written(tmp_path, POINTER))


@pytest.mark.parametrize("name", ["cup.stl", "cup.obj", "cup.ply", "cup.glb", "cup.npy", "cup.pcd"])
def test_objects_that_were_not_fetched_are_told(tmp_path: Path, name: str) -> None:
    with pytest.raises(ObjectError, match="is a pointer of Git LFS; fetch the file itself: git lfs pull"):
        load_object(written(tmp_path, POINTER, name))


def test_meshes_that_were_fetched_are_read(tmp_path: Path) -> None:
    trimesh.creation.box((0.012, 0.012, 0.06)).export(tmp_path / "tip.stl")
    description = load_hand(written(tmp_path, meshed("tip.stl"))).description
    assert description is not None
    left = description.tree.link_names.index("left")
    sizes = [np.ptp(g.vertices, axis=0).round(4).tolist() for g in description.geometry if g.link == left]
    assert sizes == [[0.012, 0.012, 0.06]] * 2
