"""Why grasps are missing: opening, gap and strength of hands against analytic ones, and words for pairs that are hopeless."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dro_grasp.errors import NoGraspError
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.hands.variants import vary_hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.scenery import Scene, load_scene
from dro_grasp.objects.shape import ObjectModel
from dro_grasp.predict import finish
from dro_grasp.predict.config import GraspRequest, PredictorConfig
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.finish import FinishConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.settling import AWAY, GIVES_WAY, HARSH
from dro_grasp.predict.shortage import Tally, find_misfits, fingertip_forces, fingertip_range, principal_axes
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.weights import untrained_weights

LEAST = 0.2  # The default, which tests of other things do without
JAWS = """<robot name="jaws">
<link name="base"><collision><origin xyz="0 0 -0.02"/><geometry><box size="0.04 0.2 0.04"/></geometry></collision></link>
{fingers}
</robot>"""
FINGER = """<link name="{name}">
<collision><origin xyz="0 0 0.03"/><geometry><box size="0.02 0.01 0.06"/></geometry></collision></link>
<joint name="{name}_slides" type="prismatic"><parent link="base"/><child link="{name}"/><origin xyz="0 {y} 0"/>
<axis xyz="0 {axis} 0"/><limit lower="0" upper="0.03" effort="{effort}" velocity="1"/></joint>"""
"""A jaw of 1 cm thickness that slides 3 cm outwards; between the two there are 2 cm when they are closed."""


@pytest.fixture(scope="module")
def jaws(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    path = tmp_path_factory.mktemp("jaws") / "jaws.urdf"
    fingers = (FINGER.format(name=name, y=0.015 * side, axis=side, effort=25) for name, side in (("left", 1), ("right", -1)))
    path.write_text(JAWS.format(fingers="".join(fingers)))
    return load_hand(path)


def box(folder: Path, *sides: float) -> ObjectModel:
    path = folder / f"box_{'_'.join(map(str, sides))}.ply"
    trimesh.creation.box(sides).export(path)
    return load_object(str(path))


def test_jaws_open_and_close_as_far_as_their_joints_slide(jaws: Hand) -> None:
    opening, gap = fingertip_range(jaws)
    assert opening == pytest.approx(0.08, abs=2e-3)
    assert gap == pytest.approx(0.02, abs=2e-3)


def test_jaws_press_with_the_effort_of_their_joints(jaws: Hand) -> None:
    assert fingertip_forces(jaws) == pytest.approx(50.0, rel=1e-4)


def test_jaws_on_one_joint_share_its_effort(tmp_path: Path) -> None:
    """A servo that moves two jaws as far as itself does the work of both."""
    left, right = (FINGER.format(name=name, y=0.015 * side, axis=side, effort=25)
                   for name, side in (("left", 1), ("right", -1)))
    follows = right.replace("</joint>", '<mimic joint="left_slides"/></joint>')
    (tmp_path / "coupled.urdf").write_text(JAWS.format(fingers=left + follows))
    hand = load_hand(tmp_path / "coupled.urdf")
    assert hand.tree.n_dof == 1
    assert fingertip_forces(hand) == pytest.approx(25.0, rel=1e-4)


def test_fingertips_press_as_far_as_the_weakest_joint_lets_them() -> None:
    """By finite differences of the fingertips' places."""
    from dro_grasp.geometry import se3
    from dro_grasp.hands.effort import find_efforts

    hand = loaded_hand("gripper3")
    q, limit = hand.canonical_joints(0.5), find_efforts(hand).limit

    def tips(joints: torch.Tensor) -> torch.Tensor:
        return se3.apply(hand.tree.forward(joints.double().float())[list(hand.tips)], hand.tip_offsets)

    total = 0.0
    for row in range(len(hand.tips)):
        forces = []
        for joint in range(len(q)):
            step = torch.zeros_like(q)
            step[joint] = 1e-2
            lever = float((tips(q + step) - tips(q - step))[row].norm()) / 2e-2
            if lever > 1e-3 and hand.movable[joint] and not hand.abduction[joint]:
                forces.append(float(limit[joint]) / lever)
        total += min(forces)
    assert fingertip_forces(hand) == pytest.approx(total, rel=1e-2)


def test_widths_along_principal_axes_are_those_of_a_turned_box(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((0.02, 0.05, 0.11))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    points = mesh.sample(20_000, seed=0)
    np.testing.assert_allclose(np.ptp(points @ principal_axes(points).T, axis=0), [0.11, 0.05, 0.02], atol=3e-3)


@pytest.mark.parametrize(("sides", "density", "said"), [
    ((0.1, 0.11, 0.12), 500.0, ["The object is 10.0 cm wide where it is narrowest, and 'jaws' opens 8.0 cm"]),
    ((0.004, 0.01, 0.012), 500.0, ["The object is 1.0 cm thick", "come no nearer to each other than 2.0 cm"]),
    ((0.05, 0.05, 0.2), 20_000.0, ["weighs 98.1 N (10 kg)", "hold no more than 25 N by friction"]),
    ((0.05, 0.05, 0.2), 500.0, []),
])
def test_what_does_not_fit_a_hand_is_told_by_measures(
    jaws: Hand, tmp_path: Path, sides: tuple[float, ...], density: float, said: list[str]
) -> None:
    misfits = list(find_misfits(GraspProblem(jaws, replace(box(tmp_path, *sides), density=density))))
    assert len(misfits) == min(1, len(said))
    text = " ".join(misfit.fact for misfit in misfits)
    assert all(words in text for words in said), text
    assert all(misfit.remedy for misfit in misfits)


def test_what_is_too_wide_from_one_direction_alone_is_told_so(jaws: Hand, tmp_path: Path) -> None:
    """A tray: from above it is wide on all sides, from the side it is thin."""
    tray = box(tmp_path, 0.2, 0.2, 0.02)
    above, side, free = (list(find_misfits(GraspProblem(jaws, tray, constraints=Constraints(direction=d)))) for d in (
        (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), None))
    assert len(above) == 1
    assert "Seen from this direction" in above[0].fact
    assert "another direction (direction=...)" in above[0].remedy
    assert side == free == []


def test_words_count_what_became_of_candidates(jaws: Hand, tmp_path: Path) -> None:
    problem = GraspProblem(jaws, box(tmp_path, 0.05, 0.05, 0.2))
    doubted = Counter({GIVES_WAY: 2, AWAY: 5, "": 1})
    words = Tally(3, 20, {}, doubted, 0.1).in_words(problem, 4, alone=False)
    assert "only 3 of 20 candidates" in words
    assert "8 hold with a probability below 10 % (fingers 5 push it away as they close, 2 give way under its weight)" in words
    assert "Try another seed" in words
    assert "least_confidence=0" in words
    plain = Tally(3, 20, {}, {}, 0.1).in_words(problem, 4, alone=True)
    assert "probability" not in plain
    assert "--least-confidence" not in plain
    assert "use the source 'auto'" in plain
    loaded = replace(problem, obj=replace(problem.obj, density=20_000.0))
    heavy = Tally(0, 20, {}, doubted, 0.1).in_words(loaded, 4, alone=False)
    assert "Try another seed" not in heavy
    assert "Take a stronger hand" in heavy


def test_limits_of_forces_are_named_where_grasps_give_way(jaws: Hand, tmp_path: Path) -> None:
    limits = Constraints(max_force=1.0, margin=5.0)
    problem = GraspProblem(jaws, box(tmp_path, 0.05, 0.05, 0.2), constraints=limits)
    words = Tally(0, 20, {}, {GIVES_WAY: 9}, 0.1).in_words(problem, 4, alone=False)
    assert "or allow more max_force (now 1 N); or ask for a smaller margin (now 5)" in words
    assert "allow more max_force" in Tally(0, 20, {}, {HARSH: 9}, 0.1).in_words(problem, 4, alone=False)
    assert "max_force" not in Tally(0, 20, {}, {AWAY: 9}, 0.1).in_words(problem, 4, alone=False)


def test_counts_of_a_shortage_add_up(jaws: Hand, tmp_path: Path) -> None:
    problem = GraspProblem(jaws, box(tmp_path, 0.2, 0.2, 0.2), constraints=Constraints(direction=(0.0, 0.0, -1.0)))
    with pytest.raises(NoGraspError) as caught:
        GraspPredictor(untrained_weights(tmp_path), config=PredictorConfig(finish=FinishConfig(least_confidence=LEAST))).run(
            problem, GraspRequest(4, candidates=8, source="network"))
    words = str(caught.value)
    patterns = {"made": r"of (\d+) candidates", "found": r"only (\d+) of", "doubted": r"(\d+) hold with a probability",
                "unsettled": r"The (\d+) that ranked lowest were not closed in simulation"}
    counts = {name: sum(map(int, re.findall(pattern, words))) for name, pattern in patterns.items()}
    reasons = " ".join(re.findall(r"\(dropped: (.*?)\)", words))
    dropped = sum(map(int, re.findall(r"\d+(?= [a-z])", reasons)))
    assert counts["made"] == counts["found"] + counts["doubted"] + counts["unsettled"] + dropped, words
    assert counts["unsettled"] > 0


@pytest.fixture(scope="module")
def predictor(tmp_path_factory: pytest.TempPathFactory) -> GraspPredictor:
    path = untrained_weights(tmp_path_factory.mktemp("weights"))
    return GraspPredictor(str(path), config=PredictorConfig(finish=FinishConfig(least_confidence=LEAST)))


def pairs(folder: Path) -> dict[str, tuple[Hand, ObjectModel, str]]:
    """What no hand can carry, and what is said of it."""
    huge = folder / "huge.urdf"
    huge.write_text(vary_hand("barrett", factor=1.9))
    small = loaded_hand("gripper3")
    return {
        "a nut and a huge hand": (load_hand(huge), box(folder, 0.004, 0.006, 0.006), "probability below"),
        "a large box and a small gripper": (small, box(folder, 0.3, 0.3, 0.3), "30.0 cm wide where it is narrowest"),
        "5 kg": (small, replace(box(folder, 0.06, 0.06, 0.06), density=5 / 0.06**3), "weighs 49 N (5 kg)"),
    }


@pytest.mark.parametrize("name", ["a nut and a huge hand", "a large box and a small gripper", "5 kg"])
def test_no_hopeless_grasp_is_returned(predictor: GraspPredictor, tmp_path: Path, name: str) -> None:
    hand, obj, said = pairs(tmp_path)[name]
    with pytest.raises(NoGraspError, match="only 0 of") as caught:
        predictor.predict(hand, obj, num=2, seed=1)
    assert said in str(caught.value)
    every = predictor.predict(hand, obj, num=2, seed=1, least_confidence=0.0)
    assert (len(every), every.asked) == (2, 2)
    assert float(every.confidence.max()) < LEAST


def test_commands_tell_the_default() -> None:
    stated = float(re.search(r"^LEAST_CONFIDENCE = ([\d.]+)", Path(finish.__file__).read_text(), re.MULTILINE)[1])
    assert stated == LEAST
    for file in ("generate", "robots", "benchmark"):
        text = (Path(finish.__file__).parents[1] / "cli" / f"{file}.py").read_text()
        assert f'optional("P", "{LEAST:g}' in text


@pytest.mark.parametrize(("source", "advised"), [("auto", False), ("optimiser", True)])
def test_the_source_auto_is_advised_only_where_another_was_asked_for(
    predictor: GraspPredictor, tmp_path: Path, source: str, advised: bool
) -> None:
    """Beside what lies flat the network is not asked, so that the optimiser is alone either way."""
    plate = box(tmp_path, 0.3, 0.3, 0.01)
    hand = loaded_hand("gripper3")
    assert GraspProblem(hand, plate, constraints=Constraints(table=-0.005)).lies_flat
    with pytest.raises(NoGraspError) as caught:
        predictor.predict(hand, plate, num=1, table=-0.005, candidates=1, source=source)
    assert ("use the source 'auto'" in str(caught.value)) == advised


def test_frames_of_obstacles_are_doubted_only_where_they_were_given(jaws: Hand, tmp_path: Path) -> None:
    obj, points = box(tmp_path, 0.05, 0.05, 0.2), np.random.default_rng(0).uniform(0.1, 0.2, (50, 3))
    given = load_scene(points)
    rest = Scene("what else is seen", points)
    told = {name: Tally(0, 20).in_words(GraspProblem(jaws, obj, constraints=Constraints(obstacles=obstacles)), 4, alone=False)
            for name, obstacles in (("given", given), ("seen", rest), ("both", given.joined(rest)))}
    assert {name: "check that obstacles is in the object's frame" in text for name, text in told.items()} == {
        "given": True, "seen": False, "both": True}
    assert "or make room around the object" in told["seen"].lower()
