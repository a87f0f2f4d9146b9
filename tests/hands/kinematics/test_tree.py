"""Forward kinematics against MuJoCo, Jacobians against finite differences."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from dro_grasp.hands.description.loader import Description, load_description
from dro_grasp.hands.kinematics.tree import KinematicTree
from dro_grasp.hands.library import ASSET_FILES, BUILTIN_FOLDER
from tests.helpers.operators import Operators
from tests.helpers.toy_hand import toy_tree

BUILTIN = [str(file) for file in sorted(BUILTIN_FOLDER.glob("*.urdf"))]
AWKWARD = """<mujoco><compiler angle="radian"/><worldbody><body name="root" pos="1 2 3" euler="0.3 0 0">
<geom size="0.02"/>
<body name="arm" pos="0 0.1 0" euler="0.2 0.4 0.1">
  <joint name="turn" axis="0 1 1" pos="0.01 0.02 0.03" range="-1 1" ref="0.3"/>
  <joint name="push" type="slide" axis="1 0 0" range="-0.1 0.1" ref="0.02"/><geom size="0.02"/>
  <body name="tip" pos="0 0 0.05"><joint name="bend" axis="1 0 0" pos="0 0 -0.01" range="-2 2" ref="-0.2"/>
  <geom size="0.01"/></body></body>
<body name="other" pos="0 -0.1 0"><joint name="swing" axis="0 0 1" range="-3 3"/><geom size="0.02"/></body></body></worldbody>
<equality><joint joint1="bend" joint2="turn" polycoef="0.1 1.5 0 0 0"/></equality></mujoco>"""


@cache
def described(file: str) -> Description:
    return load_description(Path(file))


@pytest.fixture(scope="module")
def awkward(tmp_path_factory: pytest.TempPathFactory) -> Description:
    """Two joints on one body, anchors off the origin, reference values, a coupling with offset."""
    file = tmp_path_factory.mktemp("hand") / "awkward.xml"
    file.write_text(AWKWARD)
    return load_description(file)


def mujoco_poses(model: mujoco.MjModel, values: np.ndarray) -> np.ndarray:
    """Poses of all bodies but the world, at values of all joints."""
    data = mujoco.MjData(model)
    data.qpos[:] = values
    mujoco.mj_kinematics(model, data)
    T = np.tile(np.eye(4), (model.nbody - 1, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = data.xmat[1:].reshape(-1, 3, 3), data.xpos[1:]
    return T


def random_joints(tree: KinematicTree, count: int) -> torch.Tensor:
    share = torch.rand(count, tree.n_dof, generator=torch.Generator().manual_seed(0))
    share[0], share[-1] = 0.0, 1.0
    return tree.lower + share * (tree.upper - tree.lower)


def check_against_mujoco(description: Description) -> None:
    tree, model = description.tree, description.model
    q = random_joints(tree, 6)
    poses = tree.forward(q).numpy()
    bodies = [tree.link_names.index(model.body(b).name) for b in range(1, model.nbody)]
    for row, pose in zip(q, poses, strict=True):
        expected = mujoco_poses(model, (tree.coupling @ row + tree.offset).numpy())
        np.testing.assert_allclose(pose[bodies], expected, atol=1e-5)


def check_couplings_hold(description: Description) -> None:
    """MuJoCo's own joint equalities are satisfied by what the tree makes of the independent joints."""
    tree, model = description.tree, description.model
    data = mujoco.MjData(model)
    for row in random_joints(tree, 6):
        data.qpos[:] = (tree.coupling @ row + tree.offset).numpy()
        mujoco.mj_forward(model, data)
        equality = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert equality.sum() == model.neq
        np.testing.assert_allclose(data.efc_pos[: data.nefc][equality], 0, atol=1e-5)


def check_jacobian(tree: KinematicTree) -> None:
    tree = tree.double
    q = random_joints(tree, 3).double()
    links = torch.arange(tree.n_links).repeat(2)
    local = torch.rand(len(links), 3, generator=torch.Generator().manual_seed(1)).double() * 0.1

    def place(values: torch.Tensor) -> torch.Tensor:
        T = tree.forward(values)[:, links]
        return (T[..., :3, :3] @ local[..., None])[..., 0] + T[..., :3, 3]

    jacobian = tree.point_jacobian(tree.forward(q), place(q), links)
    for j in range(tree.n_dof):
        step = torch.zeros(tree.n_dof, dtype=torch.float64)
        step[j] = 1e-6
        torch.testing.assert_close(jacobian[..., j], (place(q + step) - place(q - step)) / 2e-6, atol=1e-7, rtol=0)


def test_awkward_joints_match_mujoco(awkward):
    assert awkward.tree.link_names == ("root", "arm/1", "arm", "tip", "other")
    check_against_mujoco(awkward)
    check_couplings_hold(awkward)
    check_jacobian(awkward.tree)


@pytest.mark.parametrize("file", BUILTIN, ids=lambda f: Path(f).stem)
def test_builtin_hands_match_mujoco(file):
    check_against_mujoco(described(file))
    check_couplings_hold(described(file))
    check_jacobian(described(file).tree)


@pytest.mark.assets
@pytest.mark.parametrize("name", sorted(ASSET_FILES))
def test_asset_hands_match_mujoco(assets_folder, name):
    description = described(str(assets_folder / "hands" / ASSET_FILES[name]))
    check_against_mujoco(description)
    check_couplings_hold(description)
    check_jacobian(description.tree)


def test_a_moved_and_turned_world_turns_the_jacobian_along():
    tree = toy_tree(torch.float64)
    q = random_joints(tree, 1)[0]
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.linalg.qr(torch.rand(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64))[0]
    T[:3, :3] *= torch.linalg.det(T[:3, :3])
    T[:3, 3] = torch.tensor([2.0, -1.0, 0.5])
    links = torch.arange(tree.n_links)
    poses = tree.forward(q)
    here = tree.point_jacobian(poses, poses[:, :3, 3] + 0.01, links)
    points = (poses[:, :3, 3] + 0.01) @ T[:3, :3].T + T[:3, 3]
    there = tree.point_jacobian(T @ poses, points, links)
    torch.testing.assert_close(there, T[:3, :3] @ here)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_any_batch_axes(batch):
    tree = toy_tree(torch.float64)
    q = torch.rand(*batch, tree.n_dof, dtype=torch.float64)
    poses = tree.forward(q)
    assert poses.shape == (*batch, tree.n_links, 4, 4)
    one = tree.forward(q.reshape(-1, tree.n_dof)[0])
    torch.testing.assert_close(poses.reshape(-1, tree.n_links, 4, 4)[0], one)


@pytest.mark.parametrize("file", [None, *BUILTIN], ids=lambda f: Path(f or "awkward").stem)
def test_the_way_of_a_device_gives_the_same_poses_and_gradients_in_fewer_operators(file, awkward):
    tree = (described(file) if file else awkward).tree.double
    q = tree.lower + torch.rand(2, 3, tree.n_dof, dtype=torch.float64) * (tree.upper - tree.lower)
    q.requires_grad_()
    few, usual = tree._forward_in_few_operators(q), tree.forward(q)
    assert few.is_contiguous()
    torch.testing.assert_close(few, usual, rtol=0, atol=1e-12)
    weight = torch.randn_like(usual)
    a, b = (torch.autograd.grad((T * weight).sum(), q)[0] for T in (few, usual))
    torch.testing.assert_close(a, b, rtol=0, atol=1e-11)
    counts = []
    for forward in (tree._forward_in_few_operators, tree.forward):
        with Operators("cpu") as seen:
            forward(q.detach())
        counts.append(seen.count)
    assert file is None or counts[0] <= 0.7 * counts[1], counts


def test_descends_follows_the_parents():
    tree = toy_tree(torch.float64)
    for i in range(tree.n_links):
        ancestors, link = set(), i
        while link >= 0:
            ancestors.add(link)
            link = tree.parent[link]
        assert set(tree.descends[i].nonzero()[:, 0].tolist()) == ancestors


def test_moves_tells_which_poses_a_joint_changes(awkward):
    for tree in (awkward.tree.double, described(BUILTIN[0]).tree.double):
        q = random_joints(tree, 3)[1]
        changed = (tree.forward(q + 0.1 * torch.eye(tree.n_dof).to(q)) - tree.forward(q)).abs().amax((-2, -1)) > 1e-9
        assert torch.equal(tree.moves, changed.T)
        assert 0 < changed.sum() < changed.numel()


def test_a_copy_in_another_precision_agrees(awkward):
    q = random_joints(awkward.tree, 2)
    precise = awkward.tree.to(dtype=torch.float64).forward(q.double())
    assert precise.dtype == torch.float64
    torch.testing.assert_close(precise.float(), awkward.tree.forward(q), atol=1e-6, rtol=0)
