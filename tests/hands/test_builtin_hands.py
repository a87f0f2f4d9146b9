"""The facts derived from the built-in hands, against their own geometry and against the real hands' descriptions."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch

import dro_grasp as dro
from dro_grasp.hands.hand import Hand
from tests.helpers.loaded_hands import loaded_hand

DOF = {"allegro": 16, "barrett": 4, "shadowhand": 18, "leaphand": 16, "gripper3": 6}
"""Joints that move by themselves: Barrett couples each finger's two joints and both spreads, Shadow four fingertips."""
FINGERS = {"allegro": 4, "barrett": 3, "shadowhand": 5, "leaphand": 4, "gripper3": 3}
REAL = {
    "allegro": "assets/allegro_right", "barrett": "assets/barrett_multidex", "shadowhand": "assets/shadowhand",
    "leaphand": "assets/leaphand",
}
ASSETS = ("barrett", "barrett_multidex", "allegro_left", "allegro_right", "shadowhand", "leaphand", "inspire", "ability",
          "dclaw", "orca", "ezgripper")


def tips(hand: Hand, q: torch.Tensor) -> torch.Tensor:
    """Middles of the fingertips' surfaces (n_tips 3) [m]."""
    points = hand.points(q)
    return torch.stack([points[hand.link_index == t].mean(0) for t in hand.tips])


def check_points(hand: Hand) -> None:
    """512 points, on the surfaces of their links, normals outwards."""
    assert hand.link_points.shape == (512, 3)
    assert hand.description is not None
    for link in hand.link_index.unique().tolist():
        own = hand.link_index == link
        shapes = [(g.vertices, g.faces) for g in hand.description.geometry if g.link == link and g.collides]
        points, normals = hand.link_points[own].numpy().astype(float), hand.link_normals[own].numpy()
        distance = np.min([igl.point_mesh_squared_distance(points, v, f)[0] for v, f in shapes], axis=0) ** 0.5
        assert distance.max() < 1e-5
        outside = np.min([igl.signed_distance(points + 1e-3 * normals, v, f)[0] for v, f in shapes], axis=0)
        assert (outside > -1e-4).mean() > 0.95


def check_closing(hand: Hand) -> None:
    """Closing brings the fingertips towards where an object sits, in front of the palm."""
    target = hand.grasp_centre_wrist
    opened, half = (tips(hand, hand.canonical_joints(x)) for x in (1.0, 0.5))
    nearer = (opened - target).norm(dim=-1) - (half - target).norm(dim=-1)
    assert (nearer > 0.01).float().mean() > 0.6
    T = hand.T_wrist_palm_rest
    palm = T[:3, :3] @ hand.palm_centre + T[:3, 3]
    direction = hand.palm_direction_wrist
    assert float(direction.norm()) == pytest.approx(1, abs=1e-5)
    assert float((target - palm) @ direction) > 0.7 * float((target - palm).norm())


@pytest.mark.parametrize("name", DOF)
def test_joints_and_fingers(name: str) -> None:
    hand = loaded_hand(name)
    assert hand.tree.n_dof == DOF[name]
    assert len(hand.tips) == FINGERS[name]
    assert hand.movable.all()


@pytest.mark.parametrize("name", DOF)
def test_points_lie_on_the_links(name: str) -> None:
    check_points(loaded_hand(name))


@pytest.mark.parametrize("name", DOF)
def test_the_hand_closes_in_front_of_its_palm(name: str) -> None:
    check_closing(loaded_hand(name))


def test_points_follow_the_seed() -> None:
    hand = loaded_hand("gripper3")
    again, other = dro.load_hand("gripper3"), dro.load_hand("gripper3", seed=1)
    assert torch.equal(hand.link_points, again.link_points)
    assert torch.equal(hand.link_index, again.link_index)
    assert not torch.equal(hand.link_points, other.link_points)
    # The derived facts do not depend on the draw.
    assert torch.equal(hand.opening_signs, other.opening_signs)
    assert float(hand.palm_direction_wrist @ other.palm_direction_wrist) > 0.99


def test_a_finger_joint_opens_where_the_tip_is_farthest() -> None:
    """The toy's fingers all bend alike, so brute force over the ends of one joint at a time decides."""
    hand = loaded_hand("gripper3")
    middle = hand.canonical_joints(0.5)
    for joint in range(hand.tree.n_dof):
        at_ends = []
        for end in (hand.tree.lower, hand.tree.upper):
            q = middle.clone()
            q[joint] = end[joint]
            at_ends.append(float((tips(hand, q) - hand.grasp_centre_wrist).norm(dim=-1).sum()))
        assert (at_ends[1] > at_ends[0]) == (float(hand.opening_signs[joint]) > 0)


def link_poses(hand: Hand, moving: torch.Tensor) -> torch.Tensor:
    """Poses of the links behind the last joints, given all moving joints (b n_moving)."""
    tree = hand.tree
    coupling = torch.linalg.lstsq(tree.coupling, (moving - tree.offset).T)
    q = coupling.solution.T
    torch.testing.assert_close(q @ tree.coupling.T + tree.offset, moving, atol=1e-4, rtol=0)
    links = [tree.link_joint.index(j) for j in range(moving.shape[1])]
    return tree.forward(q)[:, links]


@pytest.mark.assets
@pytest.mark.parametrize(("name", "real_name"), REAL.items())
def test_kinematics_are_the_real_hands(assets_folder, name: str, real_name: str) -> None:
    """The same motion, up to one fixed transform between the two root frames."""
    hand, real = loaded_hand(name), loaded_hand(real_name)
    q = hand.random_joints(6, torch.Generator().manual_seed(0))
    moving = q @ hand.tree.coupling.T + hand.tree.offset
    wrist = len(real.tree.moving_names) - moving.shape[1]
    ours = link_poses(hand, moving)
    theirs = link_poses(real, torch.cat([torch.zeros(len(q), wrist), moving], 1))[:, wrist:]
    between = ours[0, 0] @ torch.linalg.inv(theirs[0, 0])
    torch.testing.assert_close(between @ theirs, ours, atol=2e-4, rtol=0)


@pytest.mark.assets
@pytest.mark.parametrize("name", ASSETS)
def test_every_asset_hand_loads_and_closes(assets_folder, name: str) -> None:
    hand = loaded_hand(f"assets/{name}")
    check_points(hand)
    check_closing(hand)
