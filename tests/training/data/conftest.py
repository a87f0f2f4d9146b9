"""Grasps that several tests of data sets try again."""

from __future__ import annotations

from pathlib import Path

import pytest

from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.objects.catalogue import load_object
from dro_grasp.optimize.synthesis import SynthesisConfig, synthesize
from dro_grasp.simulation.trial import simulate
from tests.helpers.loaded_hands import loaded_hand


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of evaluated grasps of two objects, successes and failures."""
    hand, batches = loaded_hand("barrett"), []
    path = tmp_path_factory.mktemp("stored") / "barrett.parquet"
    for name in ("can", "sphere"):
        obj = load_object(name)
        grasps = synthesize(hand, obj, 12, 0, SynthesisConfig(steps=80, batch_size=12))
        grasps.save(path)
        grasps = GraspBatch.load(path)  # files round rotations, and a grasp on the edge could tip over
        batches.append(grasps.with_trial(simulate(hand, obj, grasps, "dro")))
    GraspBatch.concatenate(batches).save(path)
    return path
