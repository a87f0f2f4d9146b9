"""The names that people import, and what importing them costs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import dro_grasp as dro
from tests.helpers.weights import untrained_weights


@pytest.mark.parametrize("name", dro.__all__)
def test_every_public_name_exists_and_is_documented(name: str) -> None:
    value = getattr(dro, name)
    assert name == "__version__" or (value.__doc__ or "").strip()


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="nothing_such"):
        _ = dro.nothing_such


def test_importing_the_package_loads_nothing() -> None:
    code = "import sys, dro_grasp; print(sorted({'torch', 'numpy', 'mujoco', 'trimesh'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_hand_in_object_in_grasps_out(tmp_path: Path) -> None:
    hand = dro.load_hand("gripper3")
    obj = dro.load_object("sphere")
    predictor = dro.GraspPredictor(str(untrained_weights(tmp_path)))
    grasps = predictor.predict(hand, obj, num=4)
    assert predictor.predicted_points is not None
    assert predictor.predicted_points.shape == (4, 96, 3)
    result = dro.simulate(hand, obj, grasps)
    tried = grasps.with_trial(result)
    chosen = tried[tried.success]
    assert len(chosen) == int(result.success.sum())
    tried.save(tmp_path / "grasps.parquet")
    again = dro.GraspBatch.load(tmp_path / "grasps.parquet")
    assert (again.joints == tried.joints).all()
    assert len(tried.to_pandas()) == 4
