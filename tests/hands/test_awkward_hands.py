"""What is read of a hand does not depend on the words of its file. Oracle: the same mechanism in its usual words."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
import torch

import dro_grasp as dro
from dro_grasp.hands import closing
from dro_grasp.hands.check import check_hand
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.opening import BEHIND, FingerMotion
from dro_grasp.hands.usable_range import FARTHEST_BEND, FARTHEST_SPREAD
from dro_grasp.optimize.starts import StartConfig, start_joints
from dro_grasp.training.made_hands.making import make_hand
from tests.helpers.awkward_hands import WAYS, Words, words
from tests.helpers.bracket_hand import bracket_urdf
from tests.helpers.claw_urdf import claw, joint, link, written

MADE = (901, 904, 905, 911, 912, 913)  # of all families: rows with a thumb, facing fingers, with couplings
BUILTIN = ("gripper3", "barrett", "shadowhand")
OTHER_WORDS = ("flipped", "other zero", "wrist", "turned palm", "split")
OTHER_LIMITS = ("both ways", "4 rad")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("awkward")


@cache
def original(folder: Path, name: str | int) -> tuple[str | Path, Hand]:
    path: str | Path = written(folder, make_hand(name).urdf, f"{name}.urdf") if isinstance(name, int) else name
    return path, dro.load_hand(path)


def reworded(folder: Path, name: str | int, way: str) -> tuple[Hand, Hand, Words]:
    path, plain = original(folder, name)
    its = WAYS[way](words(str(path)))
    return plain, dro.load_hand(written(folder, its.text, f"{name} {way}.urdf")), its


def palm_cosine(plain: Hand, hand: Hand, its: Words) -> float:
    turned = torch.from_numpy(its.turned.as_matrix()).float()
    return float((turned @ hand.palm_direction_wrist) @ plain.palm_direction_wrist)


def bending(plain: Hand) -> torch.Tensor:
    """The joints that close fingers other than a thumb."""
    of_thumb = torch.zeros_like(plain.movable) if plain.thumb is None else plain.tree.moves[plain.tips[plain.thumb]]
    return plain.movable & ~plain.abduction & ~of_thumb


@pytest.mark.parametrize("way", OTHER_WORDS)
@pytest.mark.parametrize("name", ["gripper3", "barrett", *MADE])
def test_a_hand_in_other_words_is_the_same_hand(folder: Path, name: str | int, way: str) -> None:
    plain, hand, its = reworded(folder, name, way)
    names, bends = plain.tree.joint_names, plain.movable & ~plain.abduction
    assert palm_cosine(plain, hand, its) > 0.98
    assert len(hand.fingers) == len(plain.fingers)
    if name != 912:  # whose five facing fingers oppose each other alike
        assert hand.thumb == plain.thumb
    for mine, theirs in ((hand.open_ends, plain.open_ends), (hand.closed_ends, plain.closed_ends)):
        read = its.original(hand, mine, names)
        torch.testing.assert_close(read[bends], theirs[bends], atol=0.1, rtol=0)
    rows = [hand.tree.joint_names.index(joint) for joint in names]
    assert torch.equal(hand.abduction[rows], plain.abduction)
    assert sorted(hand.tree.joint_names[j] for j in (~hand.movable).nonzero()[:, 0].tolist()) == (
        ["wrist_pitch", "wrist_yaw"] if way == "wrist" else [])


@pytest.mark.parametrize("way", OTHER_LIMITS)
@pytest.mark.parametrize("name", [*BUILTIN, *MADE])
def test_a_hand_closes_to_its_palm_whatever_its_limits(folder: Path, name: str | int, way: str) -> None:
    plain, hand, its = reworded(folder, name, way)
    assert palm_cosine(plain, hand, its) > 0.9
    used, true = hand.closed_ends - hand.open_ends, plain.closed_ends - plain.open_ends
    assert bool((used * true > 0)[bending(plain)].all()), "a joint closes the wrong way"
    behind = FingerMotion.of(hand).behind(hand.open_ends, hand.movable & ~hand.abduction, hand.palm_direction_wrist)
    assert float(behind.max()) < BEHIND


@pytest.mark.parametrize("name", [*BUILTIN, *MADE])
def test_limits_without_sense_are_not_used(folder: Path, name: str | int) -> None:
    """Nothing that is proposed bends a joint farther than fingers bend."""
    _, hand, _ = reworded(folder, name, "4 rad")
    most = torch.where(hand.abduction, 2 * FARTHEST_SPREAD, 2 * FARTHEST_BEND) + 1e-4
    assert bool((hand.tree.upper - hand.tree.lower <= most).all())
    starts = start_joints(hand, 200, StartConfig(), torch.Generator().manual_seed(0))
    assert bool(((starts >= hand.tree.lower) & (starts <= hand.tree.upper)).all())
    assert hand.description is not None
    assert float(hand.description.tree.upper.max()) == pytest.approx(4.0)


def test_a_finger_closes_no_farther_than_to_its_palm(tmp_path: Path) -> None:
    """The bracket hand's fingers are long enough to touch the palm when each joint has turned by 1.4 rad."""
    text = bracket_urdf().replace('lower="0" upper="1.5"', 'lower="-4" upper="4"')
    hand = dro.load_hand(written(tmp_path, text))
    ends = dict(zip(hand.tree.joint_names, hand.closed_ends.tolist(), strict=True))
    tips = hand.tree.forward(hand.closed_ends)[list(hand.tips)[:3]] @ torch.tensor([0.0, 0.0, 0.03, 1.0])
    assert all(0.8 < ends[f"{name}{i}"] <= FARTHEST_BEND for name in ("base", "knuckle") for i in range(3))
    assert float(tips[:, 0].min()) > -0.02, "a fingertip is through the palm, whose face is at 1 cm"


def test_check_says_which_limits_say_nothing_and_which_side_is_a_guess(folder: Path) -> None:
    reworded(folder, 901, "4 rad")
    notes = check_hand(folder / "901 4 rad.urdf").notes
    told = {note.subject: note.text for note in notes if "more than a finger turns" in note.text}
    assert {"finger0_joint_1", "thumb_joint_2"} <= set(told)
    assert "-4.00 to 4.00" in told["finger0_joint_1"]
    assert any(note.level == "warning" and "is a guess" in note.text for note in notes)
    plain, _ = original(folder, 901)
    assert not any("guess" in note.text or "finger turns" in note.text for note in check_hand(plain).notes)


@pytest.mark.parametrize(("axis", "warned"), [("1 0 0", True), ("-1 0 0", False)])
def test_jaws_that_slide_the_same_way_are_warned_of(tmp_path: Path, axis: str, warned: bool) -> None:
    limits = '<limit lower="0" upper="0.03" effort="9" velocity="1"/>'
    left = joint("a", "palm", "left", "-0.035 0 0.01", "1 0 0", limits, "prismatic")
    follows = limits + '<mimic joint="a"/>'
    text = claw(links=link("left") + link("right"),
                joints=left + joint("b", "palm", "right", "0.035 0 0.01", axis, follows, "prismatic"))
    found = [note.text for note in check_hand(written(tmp_path, text)).notes if "slide the same way" in note.text]
    assert bool(found) == warned


@pytest.mark.parametrize(("farthest", "warned"), [(0.028, False), (0.03, False), (0.05, True), (0.08, True)])
def test_jaws_that_slide_into_each_other_are_warned_of(tmp_path: Path, farthest: float, warned: bool) -> None:
    """They meet at 2.9 cm; where they slide past each other, they are apart again when closed."""
    limits = f'<limit lower="0" upper="{farthest}" effort="9" velocity="1"/>'
    joints = joint("a", "palm", "left", "-0.035 0 0.01", "1 0 0", limits, "prismatic") + joint(
        "b", "palm", "right", "0.035 0 0.01", "-1 0 0", limits + '<mimic joint="a"/>', "prismatic")
    found = [note for note in check_hand(written(tmp_path, claw(joints=joints))).notes if "slide into each other" in note.text]
    assert [(note.level, note.subject) for note in found] == [("warning", "left, right")] * warned


def test_the_variants_are_the_same_mechanism(folder: Path) -> None:
    """Links are where they were, for values in other words; so the oracle above is one."""
    for name in ("gripper3", 911):
        for way in ("flipped", "other zero"):
            plain, hand, its = reworded(folder, name, way)
            q = hand.random_joints(8, torch.Generator().manual_seed(1))
            theirs = plain.tree.forward(its.original(hand, q, plain.tree.joint_names))
            mine = hand.tree.forward(q)
            for tip, other in zip(hand.tips, plain.tips, strict=True):
                torch.testing.assert_close(mine[:, tip, :3, 3], theirs[:, other, :3, 3], atol=1e-5, rtol=0)


def test_a_hand_limited_to_its_use_is_the_hand_but_for_its_limits(folder: Path) -> None:
    """The network's grasps are fitted within them."""
    _, hand, _ = reworded(folder, "gripper3", "both ways")
    used = hand.limited_to_use()
    assert float((used.tree.lower - hand.tree.lower).max()) > 1.0, "the outer links open straight"
    assert torch.equal(used.tree.lower, hand.lower)
    assert torch.equal(used.tree.upper, hand.upper)
    plain = original(folder, "gripper3")[1]
    assert plain.limited_to_use() is plain


def test_a_finger_as_thick_as_a_barrel_costs_no_more_than_a_finger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Places between palm and fingers are looked for on a grid, which grew with the cube of the hand.
    looked: list[int] = []
    query = closing.KDTree.query
    monkeypatch.setattr(closing.KDTree, "query", lambda tree, x, *a: looked.append(len(x)) or query(tree, x, *a))
    links = link("left") + link("right", '<sphere radius="0.4"/>')
    dro.load_hand(written(tmp_path, claw(links=links), "barrel.urdf"))
    assert max(looked) <= closing.GRID_CELLS
