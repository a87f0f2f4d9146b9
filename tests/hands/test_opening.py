"""Fingers that fold back behind the palm are open where they span the most; all others are open at their limits."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

import dro_grasp as dro
from dro_grasp.errors import HandError
from dro_grasp.grasps.controller import pregrasp_and_squeeze
from dro_grasp.hands.check import check_hand, picture
from dro_grasp.hands.closing import EARLY_CLOSINGS, Closing, ClosingFinder
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import hand_names
from dro_grasp.optimize.starts import StartConfig, start_joints
from tests.helpers.bracket_hand import bracket_urdf
from tests.helpers.claw_urdf import LIMIT, claw, joint, link, written
from tests.helpers.folding_hands import folding_bracket, folding_claw, rolling_ring, swinging_ring
from tests.helpers.loaded_hands import loaded_hand


def load(folder: Path, text: str) -> Hand:
    return dro.load_hand(written(folder, text, "hand.urdf"))


@pytest.mark.parametrize("back", [math.pi, 1.5 * math.pi - 0.1])
def test_fingers_that_fold_by_90_and_by_180_degrees_are_open_when_flat(tmp_path: Path, back: float) -> None:
    """They stand at zero and lie flat in the plane of the palm's face at -pi/2."""
    hand = load(tmp_path, folding_claw(back))
    assert hand.opening_signs.tolist() == [-1, -1]
    assert hand.open_ends.tolist() == pytest.approx([-math.pi / 2] * 2, abs=0.1)
    assert float(hand.palm_direction_wrist[2]) > 0.99


def test_fingers_that_lie_flat_at_their_limits_are_open_there(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_claw(math.pi / 2))
    assert torch.equal(hand.open_ends, hand.open_limits)


@pytest.mark.parametrize(("back", "side"), [(1.0, 1.0), (1.5, -1.0), (2.2, 1.0)])
def test_straight_fingers_that_roll_up_on_both_sides_open_straight(tmp_path: Path, side: float, back: float) -> None:
    """With limits of 1.5 rad both ways, nothing but the thumb tells the palm's side."""
    straight, hand = load(tmp_path, bracket_urdf(side)), load(tmp_path, folding_bracket(back, side))
    assert float(hand.palm_direction_wrist @ straight.palm_direction_wrist) > 0.99
    assert torch.equal(hand.opening_signs, straight.opening_signs)
    assert hand.open_ends.tolist() == pytest.approx([0.0] * 7, abs=0.05)
    assert hand.thumb == straight.thumb


def test_one_joint_that_folds_its_finger_back_is_cut(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_bracket(1.5, pattern="base"))
    assert hand.open_ends.tolist() == pytest.approx([0.0] * 7, abs=0.05)


def test_fingers_that_swing_around_the_palm_open_outwards_and_alike(tmp_path: Path) -> None:
    """Bent outwards by 90 degrees at the knuckle they lie flat; swinging closes nothing, and more bending rolls them up."""
    hand = load(tmp_path, swinging_ring(1.57))
    names = hand.tree.joint_names
    assert [name for name, spreads in zip(names, hand.abduction, strict=True) if spreads] == ["swing0", "swing1", "swing2"]
    opened = dict(zip(names, hand.open_ends.tolist(), strict=True))
    assert [opened[f"knuckle{i}"] for i in range(3)] == pytest.approx([1.57] * 3, abs=0.1)
    assert [opened[f"bend{i}"] for i in range(3)] == pytest.approx([0.0] * 3, abs=0.1)
    assert [hand.canonical_joints()[names.index(f"swing{i}")] for i in range(3)] == pytest.approx([0.0] * 3, abs=0.06)
    assert float(hand.palm_direction_wrist[2]) > 0.99


def test_fingers_that_swing_but_do_not_roll_up_open_to_their_limits(tmp_path: Path) -> None:
    hand = load(tmp_path, swinging_ring(0.6))
    assert torch.equal(hand.open_ends, hand.open_limits)


def test_a_little_more_than_straight_is_kept(tmp_path: Path) -> None:
    """As many hands have it: 0.2 rad in each joint."""
    hand = load(tmp_path, folding_bracket(0.2))
    assert torch.equal(hand.open_ends, hand.open_limits)
    assert sorted(set(hand.open_ends.tolist())) == pytest.approx([-0.2, 0.0])


@pytest.mark.parametrize("name", [n for n, source in hand_names().items() if source == "builtin"])
def test_built_in_hands_open_to_their_limits(name: str) -> None:
    hand = loaded_hand(name)
    assert torch.equal(hand.open_ends, hand.open_limits)


@pytest.mark.assets
@pytest.mark.parametrize("name", ["allegro_left", "shadowhand", "leaphand", "inspire", "ability", "orca", "ezgripper"])
def test_real_hands_open_to_their_limits(assets_folder: Path, name: str) -> None:
    hand = loaded_hand(f"assets/{name}")
    assert torch.equal(hand.open_ends, hand.open_limits)


@pytest.mark.assets
def test_the_three_fingers_of_dclaw_open_alike(assets_folder: Path) -> None:
    """Seen from above they point outwards, 120 degrees apart; their first joints swing them around the palm."""
    hand = loaded_hand("assets/dclaw")
    assert [n for n, spreads in zip(hand.tree.joint_names, hand.abduction, strict=True) if spreads] == [
        "joint_f1_0", "joint_f2_0", "joint_f3_0"]
    opened = torch.where(hand.abduction, 0.0, hand.open_ends)
    tips = hand.tree.forward(opened)[list(hand.tips), :2, 3]
    angles = torch.atan2(tips[:, 1], tips[:, 0]).sort().values
    assert torch.rad2deg(angles.diff()).tolist() == pytest.approx([120, 120], abs=5)
    assert tips.norm(dim=-1).tolist() == pytest.approx([float(tips.norm(dim=-1).mean())] * 3, rel=0.05)


def test_open_closed_and_random_joints_stay_in_front_of_the_palm(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_claw(math.pi))
    assert torch.equal(hand.canonical_joints(1.0), hand.open_ends)
    assert torch.equal(hand.canonical_joints(0.0), hand.closed_ends)
    generator = torch.Generator().manual_seed(0)
    starts = start_joints(hand, 50, StartConfig(), generator)
    for joints in (hand.random_joints(50, generator), hand.random_open_joints(50, generator), starts):
        tips = hand.tree.forward(joints)[:, list(hand.tips), :3] @ torch.tensor([0.0, 0.0, 0.06, 1.0])
        assert float(tips[..., 2].min()) > 0.0


def test_a_bundle_without_open_ends_opens_to_the_limits(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_claw(math.pi))
    values = hand.to_tensors()
    assert torch.equal(Hand.from_tensors(dict(values)).open_ends, hand.open_ends)
    del values["open_ends"]
    assert Hand.from_tensors(values).open_ends.tolist() == pytest.approx([-math.pi] * 2)


def test_a_pregrasp_opens_no_farther_than_the_hand(tmp_path: Path) -> None:
    hand = load(tmp_path, folding_claw(math.pi))
    T, centre = torch.eye(4)[None].repeat(2, 1, 1), torch.tensor([0.0, 0.0, 0.03])
    joints = torch.stack([0.9 * hand.open_ends, hand.open_ends - 0.5])
    within, beyond = pregrasp_and_squeeze(hand, T, joints, centre)[0]
    assert within.tolist() == pytest.approx((0.925 * hand.open_ends).tolist(), abs=1e-5)
    assert torch.equal(beyond, joints[1]), "a grasp that is beyond already opens no farther"


def test_check_says_and_draws_what_is_left_out(tmp_path: Path) -> None:
    from PIL import Image

    report = check_hand(written(tmp_path, folding_claw(math.pi), "hand.urdf"))
    assert report.facts["open_posture"]["a"] == pytest.approx(-math.pi / 2, abs=0.1)
    told = {note.subject: note.text for note in report.notes}
    assert set(told) == {"left", "right"}
    assert "leaves out 3" in told["left"], "a third of the range"
    assert "of a (-1.5" in told["left"]
    picture(report.hand, tmp_path / "hand.png")
    with Image.open(tmp_path / "hand.png") as sheet:
        colours = {colour for _, colour in sheet.convert("RGB").getcolors(1 << 24)}
    assert any(r > 100 and g < 90 and b > 140 and r < b for r, g, b in colours), "no purple track"


SRDF = '<robot name="claw"><group_state name="{name}" group="fingers">{joints}</group_state></robot>'


def test_an_srdf_beside_the_urdf_may_state_the_open_posture(tmp_path: Path) -> None:
    path = written(tmp_path, folding_claw(math.pi), "hand.urdf")
    plain = dro.load_hand(path)
    joints = '<joint name="a" value="-1.0"/><joint name="of_the_arm" value="3"/>'
    written(tmp_path, SRDF.format(name="rest", joints=joints), "hand.srdf")
    assert dro.load_hand(path).sha256 == plain.sha256, "another state says nothing"
    written(tmp_path, SRDF.format(name="open", joints=joints), "hand.srdf")
    hand = dro.load_hand(path)
    assert hand.sha256 != plain.sha256
    assert hand.open_ends.tolist() == pytest.approx([-1.0, float(plain.open_ends[1])], abs=0.05)
    assert torch.equal(hand.opening_signs, plain.opening_signs)


def test_an_open_posture_behind_the_palm_is_warned_of(tmp_path: Path) -> None:
    path = written(tmp_path, folding_claw(math.pi), "hand.urdf")
    written(tmp_path, SRDF.format(name="open", joints='<joint name="a" value="-2.9"/>'), "hand.srdf")
    warned = {note.subject: note.text for note in check_hand(path).notes if note.level == "warning"}
    assert set(warned) == {"left"}
    assert "degrees behind the palm" in warned["left"]


def test_a_stated_posture_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, folding_claw(1.5), "hand.urdf")
    written(tmp_path, SRDF.format(name="open", joints='<joint name="a" value="wide"/>'), "hand.srdf")
    with pytest.raises(HandError, match=r"joint 'a'; expected one number"):
        dro.load_hand(path)


@pytest.mark.parametrize("mass", ["", 'mass="0"'])
def test_a_keyframe_of_an_mjcf_may_state_the_open_posture(tmp_path: Path, mass: str) -> None:
    """Its values follow the joints, and begin with the seven of the free base; links may be without a mass, as elsewhere."""
    finger = """<body name="{name}" pos="{x} 0 0.01"><joint name="{name}" axis="0 {side} 0" range="-180 86"/>
      <geom type="box" size="0.006 0.006 0.03" pos="0 0 0.03" {mass}/></body>"""
    fingers = finger.format(name="a", x=-0.035, side=1, mass=mass) + finger.format(name="b", x=0.035, side=-1, mass=mass)
    key = '<keyframe><key name="{name}" qpos="0 0 0 1 0 0 0 -1.1 -1.2"/></keyframe>'
    text = """<mujoco><compiler autolimits="true"/><worldbody><body name="palm"><freejoint/>
      <geom type="box" size="0.04 0.04 0.01"/>{fingers}</body></worldbody>{key}</mujoco>"""
    ends = {}
    for name in ("open", "home"):
        hand = dro.load_hand(written(tmp_path, text.format(fingers=fingers, key=key.format(name=name)), f"{name}.xml"))
        ends[name] = hand.open_ends.tolist()
    assert ends["open"] == pytest.approx([-1.1, -1.2])
    assert ends["home"] == pytest.approx([-math.pi / 2] * 2, abs=0.1)


def test_a_tiny_fingertip_keeps_points(tmp_path: Path) -> None:
    """Inside a large finger, farthest point sampling leaves it out."""
    nails = link("nail_a", '<sphere radius="0.001"/>') + link("nail_b", '<sphere radius="0.001"/>')
    glue = "".join(joint(f"glue_{n}", parent, f"nail_{n}", "0 0 0", kind="fixed", more="")
                   for n, parent in (("a", "left"), ("b", "right")))
    path = written(tmp_path, folding_claw(1.5).replace("</robot>", nails + glue + "</robot>"))
    hand = dro.load_hand(path, n_points=64)
    assert [hand.tree.link_names[tip] for tip in hand.tips] == ["nail_a", "nail_b"]
    assert all(int((hand.link_index == tip).sum()) > 0 for tip in hand.tips)
    assert hand.n_points == 64
    assert bool((hand.link_index.diff() >= 0).all())


def test_a_finger_that_only_follows_a_held_joint_stays_as_it_is(tmp_path: Path) -> None:
    text = claw(
        links=link("left") + link("right") + link("tip"),
        joints=joint("a", "palm", "left", "-0.035 0 0.01") + joint("b", "left", "right", "0.035 0 0.01", "0 -1 0")
        + joint("c", "left", "tip", "0 0 0.06", more=LIMIT + '<mimic joint="a" multiplier="0.5" offset="0.1"/>'))
    hand = dro.load_hand(written(tmp_path, text))
    assert [hand.tree.joint_names[j] for j in hand.movable.nonzero()[:, 0]] == ["b"]
    assert bool(hand.opening_signs.isfinite().all())


@pytest.mark.parametrize("end", [1.3, math.pi])
def test_the_palm_of_a_hand_whose_limits_let_it_roll_up_is_between_its_fingers(tmp_path: Path, end: float) -> None:
    hand = load(tmp_path, rolling_ring(end))
    assert hand.palm_direction[2] > 0.95
    assert 0.02 < hand.grasp_centre[2] < 0.12
    assert (hand.opening_signs == -1).all()


def test_a_hand_that_encloses_nothing_so_early_is_not_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = ClosingFinder.find

    def refusing(finder: ClosingFinder) -> Closing:
        if finder.closings == EARLY_CLOSINGS:
            raise HandError("nothing is enclosed")
        return find(finder)

    monkeypatch.setattr(ClosingFinder, "find", refusing)
    assert load(tmp_path, rolling_ring(math.pi)).tips
