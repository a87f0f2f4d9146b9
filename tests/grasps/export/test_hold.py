"""What to expect of a hold, in the files of other programs."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
import torch
import yaml

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import HOLD_COLUMNS, WEIGHT_COLUMN
from dro_grasp.grasps.export.writers import Frame, csv_table, dexgraspbench, isaac_grasp, moveit_grasps
from dro_grasp.hands.hand import Hand
from tests.grasps.export.test_forces import posed
from tests.helpers.loaded_hands import loaded_hand


@pytest.fixture(scope="module")
def hand() -> Hand:
    return loaded_hand("allegro")


@pytest.fixture
def told(hand: Hand) -> GraspBatch:
    """Two grasps of which one's hold has been simulated."""
    grasps = posed(hand, 2)
    rows = {name: 0.1 * (k + 1) + torch.zeros(2, hand.tree.n_dof) for k, name in enumerate(HOLD_COLUMNS)}
    for column in rows.values():
        column[1] = torch.nan
    return grasps.replace(extra={**grasps.extra, **rows, WEIGHT_COLUMN: torch.tensor([1.5, torch.nan])})


def test_expected_joints_and_efforts_are_in_every_file_that_has_a_place_for_them(hand: Hand, told: GraspBatch) -> None:
    first, second = yaml.safe_load(isaac_grasp(told, Frame(), hand))["grasps"].values()
    names = list(told.joint_names)
    for k, name in enumerate(HOLD_COLUMNS[:4]):
        assert first[name] == dict.fromkeys(names, pytest.approx(0.1 * (k + 1)))
        assert name not in second
    assert first["held_weight"] == 1.5
    assert "held_weight" not in second
    known, unknown = dexgraspbench(told, Frame(), "", 1.0, hand)
    np.testing.assert_allclose(known["empty_joints"], 0.3)
    assert known["held_weight"] == 1.5
    assert not {"held_joints", "held_weight"} & set(unknown)
    text = csv_table(told, Frame(), hand)
    one, other = csv.DictReader(line for line in io.StringIO(text) if not line.startswith("#"))
    assert [float(one[f"held_torque:{joint}"]) for joint in names] == [0.2] * len(names)
    assert (one["held_weight"], other["held_weight"]) == ("1.5", "")
    assert {other[f"held_torque:{joint}"] for joint in names} == {""}
    text = moveit_grasps(told, hand, Frame())
    lines = [line for line in text.splitlines() if line.startswith("# grasp_")]
    assert lines == [f"# grasp_0 {name}: {', '.join([str(round(0.1 * (k + 1), 7))] * len(names))}"
                     for k, name in enumerate(HOLD_COLUMNS[:4])] + ["# grasp_0 held_weight: 1.5"]
    usual = yaml.safe_load(moveit_grasps(posed(hand, 2), hand, Frame()))
    assert [set(message) for message in yaml.safe_load(text)] == [set(message) for message in usual]


def test_files_of_grasps_that_nobody_simulated_say_nothing(hand: Hand) -> None:
    grasps = posed(hand, 2)
    assert "held_joints" not in isaac_grasp(grasps, Frame(), hand) + csv_table(grasps, Frame(), hand) + moveit_grasps(
        grasps, hand, Frame())
