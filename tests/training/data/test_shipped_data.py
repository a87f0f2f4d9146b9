"""The data set that ships: sizes, splits, what every grasp must have, and a sample evaluated again."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import pytest
import torch

from dro_grasp.grasps.batch import DUPLICATE_DISTANCE, GraspBatch
from dro_grasp.grasps.grasp_file import read_footer
from dro_grasp.objects.catalogue import object_names
from dro_grasp.simulation.protocols import changed
from dro_grasp.training.data.bundle.training_file import FEW_SHOT, HELD_OUT_HANDS
from dro_grasp.training.data.collections.checking import check
from dro_grasp.training.data.collections.collection import YIELDS, read_collection
from dro_grasp.training.data.collections.merging import file_name
from tests.helpers.loaded_hands import loaded_hand

FOLDER = Path(__file__).parents[3] / "data" / "grasps"
FILES = sorted(FOLDER.glob("*.parquet"))
PAPER_HANDS = ("assets/barrett_multidex", "assets/allegro_left", "assets/shadowhand")
VALIDATE = {
    "contactdb+apple", "contactdb+camera", "contactdb+cylinder_medium", "contactdb+door_knob", "contactdb+rubber_duck",
    "contactdb+water_bottle", "ycb+baseball", "ycb+pear", "ycb+potted_meat_can", "ycb+tomato_soup_can",
}
"""The paper's validate objects."""


@pytest.fixture(scope="module", params=FILES, ids=lambda f: f.stem)
def grasps(request) -> GraspBatch:
    return GraspBatch.load(request.param)


def test_there_is_enough_of_it_and_it_is_small():
    sizes = [f.stat().st_size for f in FILES]
    assert max(sizes) < 4_000_000
    assert sum(sizes) <= 16_000_000
    assert sum(read_footer(f)[0] for f in FILES) >= 60_000


def test_every_file_says_how_it_was_made():
    for file in FILES:
        notes = read_footer(file)[1]["notes"]
        assert notes["version"]
        assert len(notes[YIELDS]) == 58
        assert all(made["candidates"] > 0 for made in notes[YIELDS].values())


def test_only_what_may_be_trained_on_is_marked_so(grasps):
    held_out = grasps.hand in HELD_OUT_HANDS
    for obj, split in set(zip(grasps.object, grasps.split, strict=True)):
        expected = "validate" if obj in VALIDATE else FEW_SHOT if held_out else "train"
        assert split == expected, (obj, split)


def test_every_grasp_passed_strict_and_says_what_it_is_made_of(grasps):
    assert bool(grasps.success.all())
    assert set(grasps.protocol) == {"strict/1"}
    assert float(grasps.penetration.max()) < 0.005 + 1e-5  # [m], rounded
    assert float(grasps.displacement.max()) < 0.1
    assert min(map(len, grasps.extra["contact_links"])) >= 2
    assert {f"energy_{t}" for t in ("force_closure", "distance", "penetration", "self_penetration")} <= set(grasps.extra)
    assert all("synthesis 2" in p for p in set(grasps.provenance))
    assert bool(grasps.seed.bool().all())
    assert all(len(sha) == 64 for sha in set(grasps.object_sha256))
    assert len(set(zip(grasps.object, grasps.object_sha256, strict=True))) == len(set(grasps.object))


def test_no_pair_has_more_than_was_asked_for(grasps):
    fuller = [maker.endswith("idle 0.2") for maker in grasps.provenance]
    for part, most in ((False, 50 if grasps.hand in HELD_OUT_HANDS else 150), (True, 40)):
        counts = Counter(name for name, own in zip(grasps.object, fuller, strict=True) if own is part)
        assert max(counts.values(), default=0) <= most


def hand_or_skip(name: str):
    if name.startswith("assets/"):
        "DRO_GRASP_ASSETS" in os.environ or pytest.skip("needs the development assets")
    return loaded_hand(name)


def test_joints_keep_their_limits_and_no_grasp_is_there_twice(grasps):
    hand = hand_or_skip(grasps.hand)
    assert grasps.hand_sha256 == hand.sha256
    assert bool((grasps.joints >= hand.tree.lower - 1e-6).all())
    assert bool((grasps.joints <= hand.tree.upper + 1e-6).all())
    thin = hand.with_points(64)
    for name in sorted(set(grasps.object))[::7]:
        part = grasps[[i for i, o in enumerate(grasps.object) if o == name]]
        points = thin.points(part.joints, part.T_object_wrist).flatten(1)
        apart = torch.stack([(points[:, None, k::3] - points[None, :, k::3]) for k in range(3)], -1).norm(dim=-1).mean(-1)
        assert float((apart + torch.eye(len(part))).min()) > DUPLICATE_DISTANCE - 1e-4


@pytest.mark.assets
def test_objects_are_those_of_the_assets(assets_folder):
    known = object_names()
    for pair in read_collection(FOLDER):
        assert known[pair.object] in {"train", "validate"}


@pytest.mark.assets
@pytest.mark.parametrize("hand", PAPER_HANDS)
def test_a_sample_holds_again(assets_folder, hand):
    pairs = [p for p in read_collection(FOLDER / file_name(hand)) if p.object.endswith(("apple", "cup"))]
    found = check(pairs, 12, changed("strict"))
    assert found.agreed >= 11, found.reasons
