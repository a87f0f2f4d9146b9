"""Coverage of a data set, against rotations whose coverage is known, and the page about it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dro_grasp.cli.main import main
from dro_grasp.compare.metrics import diversity
from dro_grasp.errors import GraspFileError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import HAND_FILE
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.training.data.collections.collection import YIELDS, PairGrasps
from dro_grasp.training.data.collections.coverage import grasp_sizes, measure_coverage, wrist_rolls
from dro_grasp.training.data.engine.shards import Yield
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import made_up_grasps


@pytest.fixture(scope="module")
def hand() -> Hand:
    return loaded_hand("barrett")


def turned(hand: Hand, rotations: Rotation) -> GraspBatch:
    """Grasps in the given wrist rotations."""
    grasps = made_up_grasps(hand, "can", len(rotations)).replace(object_sha256=(load_object("can").sha256,) * len(rotations))
    T = grasps.T_object_wrist.clone()
    T[:, :3, :3] = torch.from_numpy(rotations.as_matrix()).float()
    return grasps.replace(T_object_wrist=T)


@pytest.mark.parametrize("seed", range(5))
def test_rolls_are_turns_about_the_palm_direction(hand, seed):
    generator = np.random.default_rng(seed)
    start, axis = Rotation.random(random_state=seed), hand.palm_direction_wrist.double().numpy()
    angles = generator.uniform(0, 2 * math.pi, 20)
    rolled = Rotation.concatenate([start, *[start * Rotation.from_rotvec(a * axis) for a in angles]])
    rolls = wrist_rolls(hand, turned(hand, rolled)).double()
    difference = (rolls[1:] - rolls[0] - torch.from_numpy(angles) + math.pi) % (2 * math.pi) - math.pi
    assert difference.abs().max() < 1e-3
    assert ((rolls >= 0) & (rolls <= 2 * math.pi)).all()


def test_the_shortest_way_has_no_roll(hand):
    axis = hand.palm_direction_wrist.double().numpy()
    side = np.cross(axis, [0.3, 0.5, 0.7])
    tilts = [Rotation.from_rotvec(a * side / np.linalg.norm(side)) for a in (0.0, 0.4, 1.5, 3.0)]
    rolls = wrist_rolls(hand, turned(hand, Rotation.concatenate(tilts)))
    assert ((rolls + 0.5) % (2 * math.pi) - 0.5).abs().max() < 1e-3


def test_sizes_are_fingertip_distances(hand):
    grasps = made_up_grasps(hand, "can", 6)
    sizes = grasp_sizes(hand, grasps)
    poses = hand.tree.forward(grasps.joints[3])
    tips = [(poses[t, :3, :3] @ o + poses[t, :3, 3]).numpy() for t, o in zip(hand.tips, hand.tip_offsets, strict=True)]
    assert float(sizes[3]) == pytest.approx(max(np.linalg.norm(a - b) for a in tips for b in tips), abs=1e-5)
    assert len(grasp_sizes(hand, grasps[0:0])) == 0


@pytest.fixture
def pairs(hand) -> list[PairGrasps]:
    grasps = turned(hand, Rotation.random(60, random_state=0))
    n = len(grasps)
    grasps = grasps.replace(
        success=torch.ones(n, dtype=torch.bool), protocol=("strict/1",) * n,
        extra={"contact_links": [["base", "tip"][: 1 + i % 2] for i in range(n)], "energy_distance": torch.rand(n)})
    made = Yield(candidates=400, ranked_out=250, deep=20, failures={"slipped": 70}, valid=n, cpu_seconds=10)
    nothing = Yield(candidates=64, failures={"lost": 20})
    return [PairGrasps("barrett", "can", grasps, made), PairGrasps("barrett", "wall", grasps[0:0], nothing)]


def test_a_hand_is_measured_object_by_object(hand, pairs):
    (found,) = measure_coverage(pairs)
    can, wall = found.pairs
    assert sum(can.half_axes) == 60
    assert min(can.half_axes) > 0
    assert can.rolls == 8
    assert can.contact_links == (1, 2)
    assert can.reason == ""
    assert wall.reason == "lost (100% of the tested candidates)"
    assert wall.half_axes == (0,) * 6
    assert found.yields.candidates == 464
    assert found.diversity == diversity(pairs[0].grasps.T_object_wrist, pairs[0].grasps.joints)
    assert measure_coverage([]) == []


def test_two_hands_of_one_name_are_refused(pairs, tmp_path, capsys):
    can = pairs[0].grasps
    other = can.replace(hand_sha256="new", extra=can.extra | {HAND_FILE: ("right/barrett.urdf",) * len(can)})
    reason = (rf"grasps on can are of a hand 'barrett' \(right/barrett\.urdf, hash new\), not that of the grasps on can "
              rf"\(barrett, hash {can.hand_sha256[:12]}\): .*Rename one file .*or handle them apart")
    with pytest.raises(GraspFileError, match=reason):
        measure_coverage([pairs[0], replace(pairs[0], grasps=other)])
    with pytest.raises(GraspFileError, match=r"\(barrett, hash unknown\)"):
        measure_coverage([pairs[0], replace(pairs[1], grasps=pairs[1].grasps.replace(hand_sha256=""))])
    can.save(tmp_path / "a.parquet")
    other.save(tmp_path / "b.parquet")
    assert main(["dataset", "report", str(tmp_path / "a.parquet"), str(tmp_path / "b.parquet")]) == 2
    said = capsys.readouterr().err
    for words in ("on can in", "a.parquet", "b.parquet", "right/barrett.urdf", "Rename one file and make its grasps again"):
        assert words in said


def test_the_page_names_everything_and_holds_its_pictures(pairs, tmp_path, capsys):
    pairs[0].grasps.save(tmp_path / "barrett.parquet", {YIELDS: {p.object: p.made.to_dict() for p in pairs}})
    page = tmp_path / "report.html"
    assert main(["dataset", "report", str(tmp_path / "barrett.parquet"), "--output", str(page), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["hands"][0]["grasps"] == 60
    assert {o["object"]: o["reason"] for o in told["hands"][0]["objects"]}["wall"].startswith("lost")
    text = page.read_text()
    assert "60 grasps of 1 hand<" in text
    assert text.count("data:image/png;base64,") == 2
    for word in ("barrett", "can", "wall", "slipped", "not evaluated: energy too high", "lost (100% of the tested candidates)"):
        assert word in text
    assert main(["dataset", "report", str(tmp_path / "barrett.parquet"), "--output", str(tmp_path / "no" / "x.html")]) == 2
    assert "create it first" in capsys.readouterr().err
    assert main(["dataset", "report", str(tmp_path)]) == 0
    out = capsys.readouterr()
    assert "barrett on wall: no grasp, lost" in out.err


def test_the_page_can_be_made_of_a_hand_without_any_grasp(pairs, tmp_path):
    from dro_grasp.training.data.collections.report import write_report

    write_report(measure_coverage(pairs[1:]), Path(tmp_path / "none.html"))
    assert "lost" in (tmp_path / "none.html").read_text()


def test_a_hand_by_file_without_any_grasp_ends_no_report(pairs):
    """Only grasps name their hand's file."""
    unknown = [replace(pair, grasps=replace(pair.grasps, hand="hand_00100")) for pair in pairs[1:]]
    assert [found.hand.name for found in measure_coverage([*pairs, *unknown])] == [pairs[0].hand]
