"""Axes that mean the same for every hand, however its description turns the wrist, and the network in them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import BUILTIN_FOLDER, load_hand
from dro_grasp.hands.proportions import proportions
from dro_grasp.network.network import DistanceNetwork
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.network import ProposalConfig, _placements
from tests.helpers.bracket_hand import bracket_hand, bracket_urdf
from tests.helpers.claw_urdf import joint, written
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import TINY

TURN = (0.7, -0.4, 1.9)
"""Roll, pitch and yaw of the hand on its flange [rad]."""


def on_a_flange(name: str, folder: Path) -> Hand:
    """A built-in hand whose description begins with a turned and shifted link."""
    text = (BUILTIN_FOLDER / f"{name}.urdf").read_text()
    mount = ('<link name="flange"/><joint name="mount" type="fixed"><parent link="flange"/>'
             f'<child link="{loaded_hand(name).wrist_link}"/><origin xyz="0.05 0.02 -0.03" rpy="{" ".join(map(str, TURN))}"/>'
             "</joint></robot>")
    path = folder / f"{name}.urdf"
    path.write_text(text.replace("</robot>", mount))
    return load_hand(path)


@pytest.mark.parametrize("name", ["allegro", "barrett", "gripper3", "leaphand", "shadowhand"])
def test_axes_are_right_handed_and_follow_palm_and_fingers(name: str) -> None:
    hand = loaded_hand(name)
    axes = hand.palm_axes_wrist
    torch.testing.assert_close(axes.mT @ axes, torch.eye(3), atol=1e-5, rtol=0)
    assert float(torch.linalg.det(axes)) == pytest.approx(1, abs=1e-5)
    torch.testing.assert_close(axes[:, 2], hand.palm_direction_wrist, atol=1e-6, rtol=0)
    points = hand.points(hand.canonical_joints()) @ axes
    palm = points[hand.link_index == hand.palm].mean(0)
    tips = torch.stack([points[hand.link_index == tip].mean(0) for tip in hand.tips])
    if name not in {"barrett", "gripper3"}:  # whose fingers surround the palm
        assert float((tips - palm)[:, 0].mean()) > 0.05


def test_a_palm_link_without_shape_has_the_axes_of_the_shell_on_it(tmp_path: Path) -> None:
    plain, weld = bracket_hand(tmp_path), joint("weld", "frame", "palm", "0 0 0", kind="fixed", more="")
    text = bracket_urdf().replace('<parent link="palm"/>', '<parent link="frame"/>')
    framed = load_hand(written(tmp_path, text.replace("</robot>", f'<link name="frame"/>{weld}</robot>'), "framed.urdf"))
    assert framed.tree.link_names[framed.palm] == "frame"
    torch.testing.assert_close(framed.palm_axes_wrist, plain.palm_axes_wrist, atol=0.05, rtol=0)


@pytest.mark.parametrize("name", ["gripper3", "leaphand"])
def test_the_open_hand_looks_alike_however_its_wrist_is_turned(name: str, tmp_path: Path) -> None:
    hand, turned = loaded_hand(name), on_a_flange(name, tmp_path)
    R = torch.from_numpy(Rotation.from_euler("xyz", TURN).as_matrix()).float()
    torch.testing.assert_close(R @ hand.palm_direction_wrist, turned.palm_direction_wrist, atol=0.02, rtol=0)
    # The grasp centre is found on a grid along the wrist's axes, so it may differ by a cell.
    assert float((R @ hand.grasp_centre_wrist - turned.grasp_centre_wrist + torch.tensor([0.05, 0.02, -0.03])).norm()) < 0.01
    if name == "leaphand":  # the fingers of the other surround the palm, so one axis is free
        torch.testing.assert_close(R @ hand.palm_axes_wrist, turned.palm_axes_wrist, atol=0.01, rtol=0)
        clouds = [h.points(h.canonical_joints()) @ h.palm_axes_wrist for h in (hand, turned)]
        same = [cloud - cloud.mean(0) for cloud in clouds]
        torch.testing.assert_close(*same, atol=1e-3, rtol=0)


def test_placements_put_the_grasp_centre_where_the_prior_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = DistanceNetwork(TINY)
    hand, obj = on_a_flange("leaphand", tmp_path).with_points(TINY.n_hand), load_object("mug")
    offset = torch.tensor([0.01, -0.02, 0.03])
    given: list[torch.Tensor] = []

    def sample(points, rotations, num, generator, shape):  # type: ignore[no-untyped-def]
        given.append(shape)
        return rotations[:num], offset.expand(num, 3)

    monkeypatch.setattr(network, "sample_placements", sample)
    points = torch.from_numpy(obj.cloud)
    problem = GraspProblem(hand, obj, constraints=Constraints(direction=(0.0, 1.0, 0.0)))
    T = _placements(problem, hand, network, points, 5, 1, ProposalConfig(), torch.Generator().manual_seed(0))[:, 0]
    axes = T[:, :3, :3] @ hand.palm_axes_wrist
    torch.testing.assert_close(hand.grasp_centres(T), points.mean(0) + (axes @ offset), atol=1e-5, rtol=0)
    assert float(hand.palm_directions(T)[:, 1].min()) > 0.9
    torch.testing.assert_close(given[0], proportions(hand, hand.palm_axes_wrist))
