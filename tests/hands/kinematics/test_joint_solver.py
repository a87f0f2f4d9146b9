from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
import torch

from dro_grasp.errors import OptionError
from dro_grasp.geometry.se3 import roma
from dro_grasp.hands.kinematics import joint_solver
from dro_grasp.hands.kinematics.joint_solver import JointSolverConfig, StepConfig, Targets, best_step, read_joints, solve_joints
from dro_grasp.hands.kinematics.tree import PRISMATIC, KinematicTree
from tests.helpers.toy_hand import toy_tree

TIP = torch.tensor([0.0, 0.0, 0.05])


def plain_tree() -> KinematicTree:
    return toy_tree(torch.float32)


def coupled_tree() -> KinematicTree:
    """Each distal joint follows its proximal one; the last finger's proximal joint slides."""
    tree = toy_tree(torch.float32)
    coupling = torch.zeros(6, 4)
    coupling[[0, 2, 4, 5], [0, 1, 2, 3]] = 1.0
    coupling[1, 0], coupling[3, 1] = 0.7, -0.5
    kind = (*tree.kind[:5], PRISMATIC, tree.kind[6])
    upper = torch.tensor([1.4, 1.4, 0.03, 1.4])
    return replace(
        tree, joint_names=tuple("abcd"), coupling=coupling, offset=torch.tensor([0, 0.1, 0, 0.2, 0, 0]), kind=kind,
        lower=torch.tensor([-0.5, -0.5, -0.01, -0.5]), upper=upper,
    )


TREES = {"plain": plain_tree, "coupled": coupled_tree}


def problem(tree: KinematicTree, n: int, noise: float = 0.0, seed: int = 0):
    """Targets on all links and tips of randomly posed hands, and the poses behind them."""
    torch.manual_seed(seed)
    q = tree.lower + torch.rand(n, tree.n_dof) * (tree.upper - tree.lower)
    T = torch.eye(4).repeat(n, 1, 1)
    T[:, :3, :3], T[:, :3, 3] = roma.random_rotmat(n), 0.2 * torch.randn(n, 3)
    links = torch.tensor([0, 1, 2, 3, 4, 5, 6, 2, 4, 6])
    points = torch.zeros(10, 3)
    points[7:] = TIP
    pose = (T[:, None] @ tree.forward(q))[:, links]
    positions = (pose[..., :3, :3] @ points[..., None])[..., 0] + pose[..., :3, 3]
    return Targets(positions + noise * torch.randn_like(positions), links, points), T, q


def middle(tree: KinematicTree, n: int) -> torch.Tensor:
    return ((tree.lower + tree.upper) / 2).expand(n, -1)


@pytest.mark.parametrize("name", TREES)
def test_round_trip(name):
    tree = TREES[name]()
    targets, T, q = problem(tree, 40)
    found = solve_joints(tree, targets, T, middle(tree, 40))
    assert found.converged.all()
    assert found.residual.max() < 1e-5  # [m]
    np.testing.assert_allclose(found.joints, q, atol=2e-3)
    np.testing.assert_allclose(found.T_world_wrist, T, atol=1e-3)
    assert (found.iterations < 15).all()


def test_wrist_may_start_a_quarter_turn_away():
    tree = plain_tree()
    targets, T, _ = problem(tree, 20)
    start = T.clone()
    start[:, :3, :3] = T[:, :3, :3] @ roma.rotvec_to_rotmat(torch.tensor([1.1, 0.8, -0.8]))
    found = solve_joints(tree, targets, start, middle(tree, 20))
    assert (found.residual < 1e-4).float().mean() > 0.9


@pytest.mark.parametrize("name", TREES)
def test_limits_are_never_violated(name):
    tree = TREES[name]()
    targets, T, _ = problem(tree, 50, noise=0.03)
    found = solve_joints(tree, targets, T, middle(tree, 50))
    assert (found.joints >= tree.lower).all()
    assert (found.joints <= tree.upper).all()
    assert ((found.joints == tree.lower) | (found.joints == tree.upper)).any()


def test_limits_of_the_tree_and_held_joints_are_honoured():
    tree = plain_tree()
    targets, T, _ = problem(tree, 10, noise=0.01)
    movable = torch.tensor([True, False, True, True, True, True])
    start = middle(tree, 10).clone()
    start[:, 1] = 3.0  # outside the limits, but held
    narrow = replace(tree, lower=torch.zeros(6), upper=torch.full((6,), 0.3))
    found = solve_joints(narrow, targets, T, start, movable)
    assert (found.joints[:, 1] == 3.0).all()
    assert (found.joints[:, movable] <= 0.3).all()
    assert (found.joints[:, movable] >= 0).all()


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_result_does_not_depend_on_the_batch(noise):
    tree = coupled_tree()
    targets, T, _ = problem(tree, 33, noise=noise)
    start = middle(tree, 33)
    together = solve_joints(tree, targets, T, start)
    for i in range(33):
        alone = solve_joints(tree, Targets(targets.positions[i], targets.links, targets.local), T[i], start[i])
        np.testing.assert_allclose(alone.joints, together.joints[i], atol=1e-5)  # [rad or m]
        np.testing.assert_allclose(alone.T_world_wrist, together.T_world_wrist[i], atol=1e-5)
        assert alone.iterations == together.iterations[i]


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_grasps_that_stay_in_the_batch_end_where_those_that_leave_it_do(noise, monkeypatch):
    """A device does not look which grasps are done: they all take the last step, and the finished ones stay."""
    tree = plain_tree()
    targets = problem(tree, 12, noise)[0]
    start = (torch.eye(4).expand(12, 4, 4), middle(tree, 12))
    fewer = solve_joints(tree, targets, *start)
    with monkeypatch.context() as patch:
        patch.setattr(joint_solver, "_iterate", joint_solver._iterate_all)
        every = solve_joints(tree, targets, *start)
    for name in ("T_world_wrist", "joints", "residual"):
        torch.testing.assert_close(getattr(every, name), getattr(fewer, name), atol=1e-6, rtol=0)
    assert torch.equal(every.converged, fewer.converged)
    assert torch.equal(every.iterations, fewer.iterations)
    assert len(set(every.iterations.tolist())) > 1


def test_outliers_count_once_and_not_squared():
    tree = plain_tree()
    targets, T, q = problem(tree, 30)
    targets.positions[:, 4] += 0.05
    found = solve_joints(tree, targets, T, middle(tree, 30))
    error = (found.T_world_wrist[:, None] @ tree.forward(found.joints) - T[:, None] @ tree.forward(q))[..., :3, 3]
    assert error.norm(dim=-1).median() < 2e-4  # [m], of an outlier of 87 mm
    assert error.norm(dim=-1).mean() < 2.5e-3


def test_a_grasp_with_nan_targets_does_not_disturb_the_others():
    tree = plain_tree()
    targets, T, q = problem(tree, 5)
    targets.positions[2] = torch.nan
    found = solve_joints(tree, targets, T, middle(tree, 5))
    assert found.converged.tolist() == [True, True, False, True, True]
    assert found.joints.isfinite().all()
    np.testing.assert_allclose(found.joints[[0, 1, 3, 4]], q[[0, 1, 3, 4]], atol=2e-3)


def test_no_target_is_an_error():
    tree = plain_tree()
    empty, wrist = torch.empty(0, dtype=torch.int64), torch.eye(4).repeat(2, 1, 1)
    with pytest.raises(OptionError, match="no target"):
        solve_joints(tree, Targets(torch.empty(2, 0, 3), empty, torch.empty(0, 3)), wrist, middle(tree, 2))


def random_step_problem(seed: int):
    g = torch.Generator().manual_seed(seed)
    jacobian = torch.randn(4, 9, 30, generator=g, dtype=torch.float64) * 0.1
    residual = torch.randn(4, 30, generator=g, dtype=torch.float64) * 0.05
    lower = -0.1 * torch.rand(4, 9, generator=g, dtype=torch.float64)
    upper = 0.1 * torch.rand(4, 9, generator=g, dtype=torch.float64)
    lower[:, 8] = upper[:, 8] = 0
    return jacobian, residual, lower, upper


def step_objective(jacobian, residual, step) -> float:
    return float((np.linalg.norm((residual + step @ jacobian).reshape(3, -1), axis=0)).sum())


@pytest.mark.parametrize("sharpness", [None, 0.8])
def test_steps_reach_the_objective_of_cvxpy(sharpness):
    jacobian, residual, lower, upper = random_step_problem(0)
    config = StepConfig(active_set_passes=10, norm_floor=1e-6)
    sharp = None if sharpness is None else torch.full((4,), sharpness, dtype=torch.float64)
    damping = torch.zeros(4, dtype=torch.float64)
    steps = torch.zeros_like(lower)
    for _ in range(60):  # each step reweights the norms at the place that the ones before have reached
        left = residual + (steps[:, None] @ jacobian)[:, 0]
        steps = steps + best_step(jacobian, left, lower - steps, upper - steps, damping, sharp, config)
    assert (steps >= lower - 1e-12).all()
    assert (steps <= upper + 1e-12).all()
    for i in range(4):
        j, r = jacobian[i].numpy(), residual[i].numpy()
        x = cp.Variable(9)
        left = cp.reshape(r + j.T @ x, (3, 10), order="C")
        cost = cp.sum(cp.norm(left, axis=0))
        best = cp.Problem(cp.Minimize(cost), [x >= lower[i].numpy(), x <= upper[i].numpy()]).solve(solver=cp.CLARABEL)
        np.testing.assert_allclose(step_objective(j, r, steps[i].numpy()), best, rtol=1e-4)


def test_default_step_is_near_the_optimum_and_lowers_the_objective():
    jacobian, residual, lower, upper = random_step_problem(1)
    steps = best_step(jacobian, residual, lower, upper, torch.zeros(4, dtype=torch.float64))
    for i in range(4):
        args = jacobian[i].numpy(), residual[i].numpy()
        assert step_objective(*args, steps[i].numpy()) < step_objective(*args, np.zeros(9))


def test_iterations_and_convergence_are_reported_per_grasp():
    tree = plain_tree()
    targets, T, q = problem(tree, 2)
    start = torch.stack([q[0], middle(tree, 1)[0]])
    found = solve_joints(tree, targets, T, start)
    assert found.iterations[0] < found.iterations[1]
    hurried = solve_joints(tree, targets, T, start, config=JointSolverConfig(max_iterations=2))
    assert hurried.converged.tolist() == [True, False]


@pytest.mark.parametrize("name", TREES)
@pytest.mark.parametrize("hidden", [[], [1, 5]])
def test_joints_are_read_off_link_poses(name, hidden):
    tree = TREES[name]()
    _, T, q = problem(tree, 20)
    valid = torch.ones(7, dtype=torch.bool)
    valid[hidden] = False
    poses = T[:, None] @ tree.forward(q)
    poses[:, ~valid] = torch.eye(4)
    read = read_joints(tree, poses, valid, middle(tree, 20))
    # The two axes of a finger are parallel: rotations cannot share an angle out between two hidden joints.
    sure = [2, 3] if hidden else list(range(tree.n_dof))
    if name == "plain" or not hidden:
        np.testing.assert_allclose(read[:, sure], q[:, sure], atol=1e-3)
    assert (read >= tree.lower).all()
    assert (read <= tree.upper).all()


def test_unreadable_joints_keep_their_start():
    tree = plain_tree()
    _, T, q = problem(tree, 3)
    valid = torch.tensor([True, True, True, False, False, False, False])
    start = middle(tree, 3)
    read = read_joints(tree, T[:, None] @ tree.forward(q), valid, start)
    np.testing.assert_allclose(read[:, :2], q[:, :2], atol=1e-3)
    np.testing.assert_allclose(read[:, 2:], start[:, 2:], atol=1e-6)
