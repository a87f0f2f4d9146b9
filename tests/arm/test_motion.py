"""Plan files, and what drivers and controllers get."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import dro_grasp as dro
from dro_grasp.arm.motion import STAGES, MotionPlan, Trajectory
from dro_grasp.errors import PlanError


def test_a_plan_file_gives_the_plan_back_and_other_files_are_refused(planned: MotionPlan, tmp_path: Path) -> None:
    path = tmp_path / "plan.npz"
    planned.save(path)
    again = MotionPlan.load(path)
    assert again.notes == planned.notes
    assert (again.hand.velocity == planned.hand.velocity).all()
    assert again.lines() == planned.lines()
    (tmp_path / "half.npz").write_bytes(path.read_bytes()[:5000])
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name in ("half.npz", "other.npz", "none.npz"):
        with pytest.raises(PlanError, match=f"{name} cannot be read .* expected a plan file"):
            MotionPlan.load(tmp_path / name)


@pytest.mark.parametrize(("change", "told"), [
    (lambda header: [], "cannot be read .*expected a plan file"), (lambda header: 3, "cannot be read .*expected a plan file"),
    (lambda header: {k: v for k, v in header.items() if k != "arm_joints"}, "'arm_joints'"),
    (lambda header: {k: v for k, v in header.items() if k != "seed"}, "'seed'"),
    (lambda header: header | {"unknown": 1}, "'unknown'"), (lambda header: header | {"hand_joints": 3}, "'int'"),
    (lambda header: header | {"format_version": 1}, "another version; plan again"), (lambda header: {}, "another version"),
], ids=["list", "number", "no arm_joints", "no seed", "unknown entry", "joints of no list", "version 1", "empty"])
def test_a_plan_file_with_another_header_is_refused(
    planned: MotionPlan, tmp_path: Path, change: Callable[[dict[str, Any]], Any], told: str
) -> None:
    planned.save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz") as file:
        arrays = dict(file)
    arrays["header"] = np.array(json.dumps(change(json.loads(str(arrays["header"])))))
    np.savez(tmp_path / "changed.npz", **arrays)
    with pytest.raises(PlanError, match=rf"changed\.npz .*{told}"):
        MotionPlan.load(tmp_path / "changed.npz")


def test_drivers_get_every_target_and_controllers_the_same_motion(planned: MotionPlan) -> None:
    points = list(planned.points(rate=50))
    assert len(points) == int(np.ceil(planned.seconds * 50)) + 1
    assert [p.stage for p in points][0::len(points) - 1] == ["reach", "lift"]
    assert np.allclose(points[-1].arm, planned.arm.position[-1])
    messages = yaml.load(dro.trajectory_yaml(planned), yaml.CSafeLoader)
    assert messages["arm"]["joint_names"] == list(planned.notes.arm_joints)
    last = messages["hand"]["points"][-1]
    assert np.allclose(last["positions"], planned.hand.position[-1], atol=1e-6)
    end = last["time_from_start"]
    assert end["sec"] + 1e-9 * end["nanosec"] == pytest.approx(planned.seconds, abs=1e-6)
    late = replace(planned, arm=replace(planned.arm, time=planned.arm.time - planned.arm.time[-1] + 2 - 4e-10))
    stamps = [p["time_from_start"] for p in yaml.load(dro.trajectory_yaml(late), yaml.CSafeLoader)["arm"]["points"]]
    assert stamps[-1] == {"sec": 2, "nanosec": 0}, "a second has 10^9 nanoseconds, not one more"
    rows = list(csv.DictReader(io.StringIO(dro.trajectory_csv(planned))))
    assert len(rows) == len(planned.stage)
    assert float(rows[-1]["arm/joint1"]) == pytest.approx(planned.arm.position[-1, 0], abs=1e-6)


def test_a_plan_file_in_which_a_stage_has_no_rows_is_read(planned: MotionPlan) -> None:
    """As they were written before."""
    rows = planned.stage != STAGES.index("shape")
    arm, hand = (Trajectory(t.time[rows], t.position[rows], t.velocity[rows], t.acceleration[rows])
                 for t in (planned.arm, planned.hand))
    old = replace(planned, stage=planned.stage[rows], arm=arm, hand=hand)
    assert "shape 0.0 s" in old.lines()[2]
    assert old.part("shape") == slice(old.part("reach").stop - 1, old.part("reach").stop)
