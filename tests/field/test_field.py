"""The field corpus: what strangers bring is read as it is meant, or refused in words. `corpus.yaml` says what is expected."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dro_grasp.arm.robots.loading import load_robot
from dro_grasp.errors import DroGraspError
from dro_grasp.frames import read_motion
from dro_grasp.hands.description.loader import Description
from dro_grasp.hands.library import load_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.perception.scan import depth_points, scanned_object
from tests.field import inputs
from tests.field.inputs import CORPUS

Case = dict[str, Any]


def of(kind: str) -> pytest.MarkDecorator:
    """All cases of one part, named by their kinds."""
    return pytest.mark.parametrize("case", CORPUS[kind], ids=[case["kind"] for case in CORPUS[kind]])


def refused(case: Case, read: Any, *given: Any) -> bool:
    """Whether a case is to be refused; it then is, in the words expected."""
    if "refused" not in case:
        return False
    with pytest.raises(DroGraspError) as caught:
        read(*given)
    words = case["refused"]
    for said in [words] if isinstance(words, str) else words:
        assert said in str(caught.value)
    return True


def check_notes(case: Case, notes: Sequence[str]) -> None:
    """Each note has the words expected of it, in any order; there are no others."""
    left = list(notes)
    for words in case.get("notes", []):
        found = [note for note in left if words in note]
        assert found, (words, left)
        left.remove(found[0])
    assert not left


@of("hands")
def test_hands(case: Case, tmp_path: Path) -> None:
    path = inputs.written(case, tmp_path, f"claw.{case.get('base', 'claw.urdf').rpartition('.')[2]}")
    if refused(case, load_hand, path):
        return
    hand = load_hand(path)
    assert hand.description is not None
    assert list(hand.tree.joint_names) == case["joints"]
    assert len(hand.fingers) == case["fingers"]
    if case.get("palm"):
        assert float(hand.palm_direction_wrist @ torch.tensor(case["palm"], dtype=torch.float32)) > 0.95
    assert hand.wrist_link == case.get("frame", "palm")
    thumb = None if hand.thumb is None else hand.tree.link_names[hand.tips[hand.thumb]]
    assert thumb == case.get("thumb")
    check_notes(case, [f"{note.subject}: {note.text}" for note in hand.description.notes])
    check_extents(case.get("extents", {}), hand.description)


def check_extents(expected: Mapping[str, Sequence[float]], description: Description) -> None:
    for link, millimetres in expected.items():
        of_link = [g for g in description.geometry if description.tree.link_names[g.link] == link and g.collides]
        np.testing.assert_allclose(1000 * np.ptp(of_link[0].vertices, axis=0), millimetres, rtol=1e-4)


@of("objects")
def test_objects(case: Case, tmp_path: Path) -> None:
    path, scale = inputs.object_file(case, tmp_path), case.get("scale", 1.0)
    if refused(case, lambda: load_object(path, scale=scale)):
        return
    obj = load_object(path, scale=scale)
    np.testing.assert_allclose(100 * obj.extents, case["size"], rtol=0.01)
    if "volume" in case:
        assert 1e6 * obj.volume == pytest.approx(case["volume"], rel=0.02)
    check_notes(case, obj.notes)


@of("clouds")
def test_clouds(case: Case, tmp_path: Path) -> None:
    path = inputs.cloud_file(case, tmp_path)
    if refused(case, load_object, path):
        return
    obj = load_object(path)
    assert obj.is_cloud
    assert len(obj.cloud) == case.get("points", len(obj.cloud))
    if "size" in case:
        np.testing.assert_allclose(100 * np.ptp(obj.cloud, axis=0), case["size"], atol=0.6)
    check_notes(case, obj.notes)


@of("cameras")
def test_cameras(case: Case, tmp_path: Path) -> None:
    if "pose" in case:
        (tmp_path / "camera.json").write_text(json.dumps(case["pose"]))
        if not refused(case, read_motion, tmp_path / "camera.json", "T_frame_camera"):
            assert read_motion(tmp_path / "camera.json", "T_frame_camera").frame == case["frame"]
        return
    image = inputs.depth_of_a_ball() * case.get("times", 1.0)
    matrix = case.get("intrinsics", CORPUS["cameras"][0]["intrinsics"])
    if not refused(case, depth_points, image, matrix):
        ball = scanned_object("ball", depth_points(image, matrix))
        np.testing.assert_allclose(100 * np.ptp(ball.cloud, axis=0), case["size"], atol=0.6)


@of("robots")
def test_robots(case: Case, tmp_path: Path) -> None:
    path = inputs.robot_file(case, tmp_path)
    if refused(case, load_robot, path):
        return
    robot = load_robot(path)
    assert robot.home.tolist() == pytest.approx(case["home"])
    assert (None if robot.table is None else robot.table.height) == case["table"]
    assert robot.hand.name == case["hand"]


def test_the_corpus_is_small_and_every_case_expects_something() -> None:
    cases = [case for part in ("hands", "objects", "clouds", "cameras", "robots") for case in CORPUS[part]]
    assert len(cases) >= 100
    outcomes = {"refused", "joints", "size", "notes", "frame", "home"}
    assert all(outcomes & set(case) for case in cases)
    assert sum(file.stat().st_size for file in Path(__file__).parent.glob("*.*")) < 2_000_000
