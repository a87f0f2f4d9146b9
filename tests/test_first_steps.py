"""What somebody meets in Python first: help, short descriptions of everything, and errors that say what is wanted."""

from __future__ import annotations

import pydoc
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import dro_grasp as dro
from dro_grasp.grasps.sources import hand_of, object_of, require_pair
from dro_grasp.hands.library import BUILTIN_FOLDER
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL


@pytest.fixture(scope="module")
def hand() -> dro.Hand:
    return dro.load_hand("gripper3")


@pytest.fixture(scope="module")
def obj() -> dro.ObjectModel:
    return dro.load_object("sphere")


@pytest.fixture(scope="module")
def predictor(weights: str) -> dro.GraspPredictor:
    return dro.GraspPredictor(weights)


def test_help_opens_with_an_example_that_runs() -> None:
    text = pydoc.plain(pydoc.render_doc(dro))
    assert text.index("import dro_grasp as dro") < 400
    lines = [line[4:] for line in (dro.__doc__ or "").splitlines() if line.startswith("    ")]
    assert lines[0] == "import dro_grasp as dro"
    assert len([line for line in lines[1:] if line]) == 5
    names = [word for line in lines for word in line.replace("(", " ").split() if word.startswith("dro.")]
    assert names
    assert all(hasattr(dro, name[4:].split(".")[0]) for name in names)


def test_everything_describes_itself_in_one_or_two_lines(hand, obj, predictor) -> None:
    request = dro.GraspRequest(2, candidates=1, source="network", refine=False)
    problem = dro.GraspProblem(hand, obj)
    made = predictor.run(problem, request)
    trial = dro.simulate(hand, obj, made.grasps)
    told = [repr(value) for value in (
        hand, obj, hand.tree, problem, predictor, made, made.grasps, trial, dro.check_hand("gripper3"), dro.make_hand(0))]
    assert max(map(len, told)) < 256, max(told, key=len)
    assert told[0] == f"Hand('gripper3', {hand.tree.n_dof} joints, 3 fingers, 512 surface points)"
    assert told[1].startswith("ObjectModel('sphere', mesh of ")
    assert f"of 2 hold under {DEFAULT_PROTOCOL}/1" in told[7]


def test_a_name_or_swapped_arguments_say_what_is_wanted(hand, obj) -> None:
    for wrong, word in (((obj, hand), "swapped"), (("allegro", obj), "hand is 'allegro'; load it first: dro_grasp.load_hand("),
                        ((hand, Path("mug.stl")), "load_object('mug.stl')"), ((hand, None), "the object is a NoneType")):
        with pytest.raises(dro.DroGraspError, match=word.replace("(", r"\(").replace(")", r"\)")):
            require_pair(*wrong)


@pytest.mark.usefixtures("as_users_have_it")
def test_so_do_the_functions_that_take_a_pair(hand, obj) -> None:
    grasps = dro.palm_facing_starts(hand, obj, num=1, seed=0)
    predictor: Any = SimpleNamespace(device="cpu")
    calls: list[tuple[Callable[[], object], str]] = [
        (lambda: dro.GraspPredictor.predict(predictor, "allegro", obj),
         r"^the hand is 'allegro'; load it first: dro_grasp.load_hand\('allegro'\)$"),
        (lambda: dro.simulate(obj, hand, grasps), "swapped"),
        (lambda: dro.draw_grasps(hand, "mug", grasps, "a.png"), r"load_object\('mug'\)")]
    for call, told in calls:
        with pytest.raises(dro.DroGraspError, match=told):
            call()


def test_successes_are_not_asked_of_grasps_without_a_trial(hand, obj) -> None:
    grasps = dro.palm_facing_starts(hand, obj, num=2, seed=0)
    with pytest.raises(dro.DroGraspError, match=r"have not been tried.*run trials first"):
        grasps[grasps.success]
    assert len(grasps[torch.zeros(2, dtype=torch.bool)]) == 0
    assert len(grasps[:0][grasps[:0].success]) == 0
    tried = grasps.with_trial(dro.simulate(hand, obj, grasps))
    assert len(tried[tried.success]) == int(tried.success.sum())


def test_saved_grasps_find_the_users_own_files_again(predictor, tmp_path: Path) -> None:
    shutil.copy(BUILTIN_FOLDER / "gripper3.urdf", tmp_path / "mine.urdf")
    import trimesh

    trimesh.creation.box((50, 50, 80)).export(tmp_path / "block.stl")
    hand, obj = dro.load_hand(tmp_path / "mine.urdf"), dro.load_object(tmp_path / "block.stl", scale=0.001)
    predictor.predict(hand, obj, num=1, candidates=1, source="network", refine=False).save(tmp_path / "grasps.parquet")
    grasps = dro.GraspBatch.load(tmp_path / "grasps.parquet")
    assert hand_of(grasps, None).sha256 == hand.sha256
    assert object_of(grasps, None, 1.0).sha256 == obj.sha256 == grasps.object_sha256[0]


def test_names_are_not_saved_as_files(hand, obj, predictor) -> None:
    grasps = predictor.predict(hand, obj, num=1, candidates=1, source="network", refine=False)
    assert not {"hand_file", "object_file"} & grasps.extra.keys()


def test_grasps_are_saved_under_their_own_suffix(hand, obj, tmp_path: Path) -> None:
    grasps = dro.palm_facing_starts(hand, obj, num=1, seed=0)
    with pytest.raises(dro.DroGraspError, match=r"such as grasps\.parquet"):
        grasps.save(tmp_path / "grasps.csv")
    assert not list(tmp_path.iterdir())


def test_wrist_poses_are_attributes(hand, obj) -> None:
    from scipy.spatial.transform import Rotation

    grasps = dro.palm_facing_starts(hand, obj, num=3, seed=0)
    assert torch.equal(grasps.wrist_position, grasps.T_object_wrist[:, :3, 3])
    matrices = Rotation.from_quat(grasps.wrist_quaternion_wxyz.numpy(), scalar_first=True).as_matrix()
    torch.testing.assert_close(torch.from_numpy(matrices).float(), grasps.T_object_wrist[:, :3, :3].float(), atol=1e-5, rtol=0)
