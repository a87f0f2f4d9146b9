"""The joint solver against CVXPY + Clarabel, and its convergence on exact targets.

Speed and objective: targets of random grasps with 5 mm of noise on every coordinate, both solvers from the canonical
joints and the registered palm, on one thread. CVXPY solves each linearised problem with step limit 0.5 to its optimum,
as in the paper. The problem is built once with parameters; its compilation and kinematics are not counted. Both stop at
the same objective tolerance. Times are processor times of one thread.

Convergence: exact targets, joints uniform within the limits, wrist uniform on SO(3), canonical initial guess.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cvxpy as cp
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp import distance_matrix
from dro_grasp.geometry.se3 import compose, roma
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.kinematics import joint_solver
from dro_grasp.hands.kinematics.joint_solver import JointSolution, JointSolverConfig, Targets, solve_joints
from dro_grasp.hands.library import load_hand
from lab.benchmarks.report import emit, options_of

ASSET_HANDS = (
    "barrett_multidex", "allegro_left", "shadowhand", "barrett", "leaphand", "inspire", "ability", "dclaw", "orca",
    "ezgripper",
)
"""Hands of the development assets."""
BUILTIN_HANDS = ("barrett", "allegro", "shadowhand", "leaphand", "gripper3")
"""Hands without the assets."""
BATCH = 64
"""Grasps that are solved together."""
RUNS = 5
"""Repetitions, of which the median time counts."""
NOISE = 5e-3
"""Standard deviation of the targets' noise [m]."""
GOOD = 1e-3
"""Largest mean link error of a converged grasp [m]."""


@dataclass(frozen=True)
class Task:
    """Targets of one hand and where both solvers start."""

    hand: Hand
    targets: Targets
    T_start: Float[Tensor, "n 4 4"]
    q_start: Float[Tensor, "n n_dof"]


def random_poses(hand: Hand, n: int, seed: int) -> distance_matrix.LinkPoses:
    """Exact link poses of random grasps: a perfect D(R,O) decodes to them."""
    torch.manual_seed(seed)
    q = hand.random_joints(n, torch.Generator().manual_seed(seed))
    T = compose(roma.random_rotmat(n), 0.1 * torch.randn(n, 3))
    poses = T[:, None] @ hand.tree.forward(q)
    return distance_matrix.LinkPoses(poses, torch.zeros(poses.shape[:2]), hand.registrable, hand.points(q, T))


def canonical_task(hand: Hand, poses: distance_matrix.LinkPoses, noise: float) -> Task:
    """The canonical joints, with the palm where it was registered."""
    targets = distance_matrix.targets(hand, poses)
    noisy = replace(targets, positions=targets.positions + noise * torch.randn_like(targets.positions))
    q = hand.canonical_joints().expand(len(noisy.positions), -1)
    T = poses.T_world_link[:, hand.palm] @ torch.linalg.inv(hand.T_wrist_palm(q))
    return Task(hand, noisy, T, q)


def ours(task: Task) -> JointSolution:
    """The whole batch at once."""
    return solve_joints(task.hand.tree, task.targets, task.T_start, task.q_start, task.hand.movable)


class ConvexStep:
    """One linearised problem as a parametrised CVXPY program."""

    def __init__(self, n_targets: int, n_unknowns: int) -> None:
        self.jacobian = cp.Parameter((3 * n_targets, n_unknowns))
        self.residual = cp.Parameter(3 * n_targets)
        self.low, self.high = cp.Parameter(n_unknowns), cp.Parameter(n_unknowns)
        self.step = cp.Variable(n_unknowns)
        left = cp.reshape(self.jacobian @ self.step + self.residual, (3, n_targets), order="C")
        self.problem = cp.Problem(
            cp.Minimize(cp.sum(cp.norm(left, axis=0))), [self.step >= self.low, self.step <= self.high]
        )
        assert self.problem.is_dpp()

    def solve(
        self, jacobian: Float[np.ndarray, "m k"], residual: Float[np.ndarray, " m"], low: Float[np.ndarray, " k"],
        high: Float[np.ndarray, " k"],
    ) -> Float[np.ndarray, " k"]:
        """The optimal step."""
        self.jacobian.value, self.residual.value, self.low.value, self.high.value = jacobian, residual, low, high
        self.problem.solve(solver=cp.CLARABEL)
        assert self.step.value is not None
        return self.step.value


def theirs(task: Task, row: int, convex: ConvexStep) -> tuple[float, float, int]:
    """CVXPY on one grasp: mean distance from the targets [m], seconds inside CVXPY, steps."""
    config, tree = JointSolverConfig(), task.hand.tree.double
    q, T = task.q_start[row : row + 1].double(), task.T_start[row : row + 1].double()
    low = torch.where(task.hand.movable, tree.lower, q)
    high = torch.where(task.hand.movable, tree.upper, q)
    targets = replace(task.targets, positions=task.targets.positions[row : row + 1])
    problem = joint_solver._problem(tree, targets, low, high)
    state, seconds, stalled = joint_solver._state(problem, T, q, config), 0.0, 0
    steps = 0
    while steps < config.max_iterations and stalled < 2:
        steps += 1
        limit = config.step_limit
        bounds = [torch.full((1, 6), s * limit, dtype=q.dtype) for s in (-1, 1)]
        step_low = torch.cat([bounds[0], (low - state.q).clamp(-limit, 0)], 1)[0].numpy()
        step_high = torch.cat([bounds[1], (high - state.q).clamp(0, limit)], 1)[0].numpy()
        jacobian, residual = state.jacobian[0].T.numpy(), state.residual[0].numpy()
        start = time.process_time()
        step = convex.solve(jacobian, residual, step_low, step_high)
        seconds += time.process_time() - start
        moved = joint_solver._state(problem, *joint_solver._move(state, torch.from_numpy(step)[None]), config)
        little = mean_distance(moved) > mean_distance(state) * (1 - config.objective_tolerance)
        better = mean_distance(moved) <= mean_distance(state)
        stalled = stalled + 1 + better if little else 0
        state = moved if better else state
    return mean_distance(state), seconds, steps


def mean_distance(state: joint_solver._State) -> float:
    """Mean distance of the first grasp from its targets [m]."""
    return float(joint_solver.point_norms(state.residual[0]).mean())


def median_seconds(run: Callable[[], object]) -> float:
    """Median of RUNS runs, after one to warm up."""
    run()
    times = []
    for _ in range(RUNS):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return float(np.median(times))


@dataclass(frozen=True)
class Comparison:
    """One hand's row."""

    seconds_ours: float
    seconds_theirs: float
    objective_ours: float
    objective_theirs: float
    steps_ours: float
    steps_theirs: float


def compare(hand: Hand, grasps: int, seed: int) -> Comparison:
    """Both solvers on the same noisy targets; CVXPY on the first few of the batch."""
    task = canonical_task(hand, random_poses(hand, BATCH, seed), NOISE)
    per_grasp = median_seconds(lambda: ours(task)) / BATCH
    solution = ours(task)
    convex = ConvexStep(len(task.targets.links), 6 + hand.tree.n_dof)
    theirs(task, 0, convex)
    results = [[theirs(task, row, convex) for _ in range(RUNS)] for row in range(grasps)]
    return Comparison(
        per_grasp, float(np.mean([np.median([r[1] for r in runs]) for runs in results])),
        float(solution.residual[:grasps].mean()), float(np.mean([runs[0][0] for runs in results])),
        float(solution.iterations[:grasps].double().mean()), float(np.mean([runs[0][2] for runs in results])),
    )


def reached(hand: Hand, n: int, seed: int) -> tuple[float, float]:
    """Share of clean targets reached: as `distance_matrix.solve` starts, and from the canonical joints alone."""
    poses = random_poses(hand, n, seed)
    solutions = (distance_matrix.solve(hand, poses, hand.canonical_joints().expand(n, -1)),
                 ours(canonical_task(hand, poses, 0.0)))
    shares = []
    for solution in solutions:
        solved = solution.T_world_wrist[:, None] @ hand.tree.forward(solution.joints)
        error = (solved - poses.T_world_link)[:, hand.registrable, :3, 3].norm(dim=-1).mean(-1)
        shares.append(float((error < GOOD).double().mean()))
    return shares[0], shares[1]


def main() -> None:
    """Run and print."""
    parser = options_of(__doc__)
    parser.add_argument("--full", action="store_true", help="all 64 grasps through CVXPY, 10,000 clean targets a hand")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    assets = Path(os.environ.get("DRO_GRASP_ASSETS", "/nowhere")).is_dir()
    names = [f"assets/{name}" for name in ASSET_HANDS] if assets else list(BUILTIN_HANDS)
    grasps, clean = (BATCH, 10_000) if arguments.full else (4, 1_000)
    rows, found, shares = [], [], []
    for name in names:
        hand = load_hand(name)
        found.append(c := compare(hand, grasps, arguments.seed))
        shares.append(share := reached(hand, clean, arguments.seed + 1))
        rows.append([name, 1e3 * c.seconds_ours, 1e3 * c.seconds_theirs, c.seconds_theirs / c.seconds_ours,
                     f"{c.objective_ours / c.objective_theirs:.4f}", c.steps_ours, c.steps_theirs,
                     *(f"{100 * s:.1f}" for s in share)])
    ratios = [c.objective_ours / c.objective_theirs for c in found]
    result = {
        "speedup": sum(c.seconds_theirs for c in found) / sum(c.seconds_ours for c in found),
        "objective_ratio": sum(c.objective_ours for c in found) / sum(c.objective_theirs for c in found),
        "converged_fraction": float(np.mean([s[0] for s in shares])),
        "speedup_worst_hand": min(c.seconds_theirs / c.seconds_ours for c in found),
        "objective_ratio_worst_hand": max(ratios),
        "converged_fraction_worst_hand": min(s[0] for s in shares),
        "converged_fraction_canonical_joints_alone": float(np.mean([s[1] for s in shares])),
        "seed": arguments.seed, "batch": BATCH, "cvxpy_grasps_per_hand": grasps, "clean_targets_per_hand": clean,
        "hands": ", ".join(names),
    }
    title = f"Joint solver, batch {BATCH}; CVXPY on {grasps} grasps a hand, {clean} clean targets a hand, " \
            f"seed {arguments.seed}, one thread"
    columns = ["hand", "ours [ms]", "CVXPY [ms]", "speedup", "objective", "steps", "CVXPY steps", "< 1 mm [%]",
               "canonical alone [%]"]
    emit(title, rows, columns, result, arguments.json)


if __name__ == "__main__":
    main()
