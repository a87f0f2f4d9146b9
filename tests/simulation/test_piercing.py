"""Fingers through thin walls: a sheet across a finger, at any height, beside it and before it."""

from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.simulation.contacts import measure_penetration
from dro_grasp.simulation.outcome import Failure
from dro_grasp.simulation.piercing import _Rest, bones, pierced
from dro_grasp.simulation.protocols import protocol
from dro_grasp.simulation.scene import build_scene, cached_scene
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand

HAND = loaded_hand("allegro")
STRAIGHT = torch.where(HAND.tree.lower <= 0, torch.zeros_like(HAND.tree.lower), HAND.tree.lower)[None]
FINGER = [HAND.tree.link_names.index(f"middle_link_{k}") for k in range(4)]
ORIGINS = HAND.tree.forward(STRAIGHT)[0, FINGER, :3, 3].numpy()
"""Joints of a straight finger, from the palm outwards, in the wrist's frame [m]."""
ALONG = (ORIGINS[3] - ORIGINS[1]) / np.linalg.norm(ORIGINS[3] - ORIGINS[1])


@pytest.fixture(scope="module")
def sheet() -> ObjectModel:
    """Two millimetres thick, across x and y."""
    return load_object(trimesh.creation.box((0.06, 0.018, 0.002)))


def grasp(obj: ObjectModel, centre: np.ndarray, normal: np.ndarray) -> GraspBatch:
    """The straight finger, and the sheet with its middle and its normal there, in the wrist's frame."""
    turn = trimesh.geometry.align_vectors([0, 0, 1], normal)
    T_wrist_object = torch.from_numpy(turn).float()
    T_wrist_object[:3, 3] = torch.from_numpy(np.asarray(centre)).float()
    return GraspBatch.create(HAND, obj, torch.linalg.inv(T_wrist_object)[None], STRAIGHT)


def behind(obj: ObjectModel, grasps: GraspBatch) -> float:
    scene = cached_scene(HAND, obj, protocol("strict"))
    return float(pierced(scene, scene.qpos(grasps.T_object_wrist, grasps.joints))[0])


def test_a_finger_is_as_deep_as_it_is_long_behind_a_sheet(sheet: ObjectModel) -> None:
    """From the sheet to the middle of the last shape; the analytic length is along the straight finger."""
    depths = [behind(sheet, grasp(sheet, ORIGINS[1] + s * ALONG, ALONG)) for s in (0.01, 0.02, 0.03, 0.04)]
    assert all(depth > 0.02 for depth in depths)
    np.testing.assert_allclose(-np.diff(depths), 0.01, atol=1.5e-3)


def test_what_is_beside_or_before_a_finger_is_not_pierced(sheet: ObjectModel) -> None:
    """Against the finger's side, a millimetre deep, and beyond its tip."""
    across = np.cross(ALONG, [0.0, 1.0, 0.0])
    for side in (-1.0, 1.0):
        for distance in (0.006, 0.01, 0.014):
            touching = grasp(sheet, (ORIGINS[2] + ORIGINS[3]) / 2 + side * distance * across, side * across)
            assert behind(sheet, touching) == 0
    assert behind(sheet, grasp(sheet, ORIGINS[3] + 0.08 * ALONG, ALONG)) == 0


def test_a_trial_refuses_a_pierced_sheet(sheet: ObjectModel) -> None:
    """At every place between two joints, whatever contacts show there."""
    scene = cached_scene(HAND, sheet, protocol("strict"))
    through = [grasp(sheet, ORIGINS[1] + share * (ORIGINS[3] - ORIGINS[1]), ALONG) for share in np.linspace(0.05, 0.95, 19)]
    assert all(measure_penetration(scene, grasps).object[0] > 0.02 for grasps in through)
    assert simulate(HAND, sheet, through[0], "strict", workers=1).failure == (Failure.PENETRATION,)


def test_fingers_axes_are_sought_once_for_all_objects_and_processes(
    sheet: ObjectModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another object, with a copy of the hand as in another process, finds those that are stored; another hand does not."""
    monkeypatch.setenv("DRO_GRASP_CACHE", str(tmp_path))
    rules = protocol("strict")
    first = bones(build_scene(copy(HAND), sheet, rules))
    assert len(first) > 3
    monkeypatch.setattr(_Rest, "bones", lambda _: pytest.fail("they are sought again"))
    for found, bone in zip(bones(build_scene(copy(HAND), load_object("can"), rules)), first, strict=True):
        assert (found.body, found.beyond) == (bone.body, bone.beyond)
        np.testing.assert_array_equal(np.stack([found.start, found.end]), np.stack([bone.start, bone.end]))
    with pytest.raises(pytest.fail.Exception, match="sought again"):
        bones(build_scene(copy(loaded_hand("gripper3")), sheet, rules))
