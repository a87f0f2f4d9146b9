"""Target positions of points on links -> wrist pose and joint values, for many grasps at once.

Each iteration linearises the kinematics and takes the best step of `joint_step`; a step that does not lower the
objective is undone and damped. The wrist moves by local se(3) increments, so nothing is singular.

Tensors come and go in single precision; in between everything is double. The matrices are tiny, so it costs no time,
and rounding, which depends on the batch size, then decides neither which limits are active nor when a grasp stops.
Source: paper section III-D, joint configurations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import roma
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.kinematics.joint_step import StepConfig, best_step, point_norms, smoothed_norms
from dro_grasp.kinematics.tree import KinematicTree


@dataclass(frozen=True)
class JointSolverConfig:
    """Stopping, step limits and damping."""

    max_iterations: int = 32
    """Linearisations per grasp."""
    step_limit: float = 0.5
    """Largest change of a joint or of a wrist coordinate per iteration [rad or m]. Source: section III-D."""
    tolerance: float = 2e-5
    """A grasp is done when no coordinate changes by more than this [rad or m]."""
    objective_tolerance: float = 5e-4
    """A grasp is also done when a step lowers the objective, but by a smaller share than this, or when two steps in a
    row fail to lower it."""
    damping: float = 1e-2
    """First damping, relative to the normal equations' mean weight times a square centimetre."""
    damping_range: tuple[float, float] = (1e-6, 1e8)
    """Smallest and largest damping, likewise."""
    sharpness: float = 0.8
    """Once steps are small: share of Newton's curvature in place of IRLS's; see joint_step."""
    sharpen_below: float = 0.1
    """Steps whose largest coordinate is below this count as small [rad or m]."""
    step: StepConfig = field(default_factory=StepConfig)
    """How each step is solved."""


@dataclass(frozen=True)
class JointSolution:
    """Where the solver ended, per grasp."""

    T_world_wrist: Float[Tensor, "*b 4 4"]
    """Pose of the root link."""
    joints: Float[Tensor, "*b n_dof"]
    """Independent joints, inside their limits [rad or m]."""
    residual: Float[Tensor, "*b"]
    """Weighted mean distance of the points from their targets [m]."""
    converged: Bool[Tensor, "*b"]
    """Steps or gains had become smaller than their tolerances."""
    iterations: Int[Tensor, "*b"]
    """Linearisations taken."""


@dataclass(frozen=True)
class _Problem:
    """What stays the same over the iterations; tensors lead with the grasps."""

    tree: KinematicTree
    links: Int[Tensor, " t"]
    points: Float[Tensor, "t 3"]
    drive: Float[Tensor, "pairs k"]
    """Change of a link's own joint per unit of a dof, where the joint lies above the target's link, else zero."""
    pair_link: Int[Tensor, " pairs"]
    pair_dof: Float[Tensor, "n_dof pairs"] | None
    """Sums pairs into dofs; None where they are the same."""
    targets: Float[Tensor, "b t 3"]
    weights: Float[Tensor, "b t"]
    lower: Float[Tensor, "b n_dof"]
    upper: Float[Tensor, "b n_dof"]

    def rows(self, index: Tensor) -> _Problem:
        """The problem of some of the grasps."""
        return replace(self, **{k: getattr(self, k)[index] for k in ("targets", "weights", "lower", "upper")})


@dataclass(frozen=True)
class _State:
    """A working point of each grasp, with the kinematics linearised there."""

    T: Float[Tensor, "b 4 4"]
    q: Float[Tensor, "b n_dof"]
    residual: Float[Tensor, "b k"]
    jacobian: Float[Tensor, "b p k"]
    cost: Float[Tensor, " b"]
    damping: Float[Tensor, " b"]
    sharpness: Float[Tensor, " b"]
    stalled: Int[Tensor, " b"]
    """Since the last real gain: 2 for each step that gained little, 1 for each that was undone."""

    def rows(self, index: Tensor) -> _State:
        """Some of the grasps."""
        return _State(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def where(self, mask: Bool[Tensor, " b"], other: _State) -> _State:
        """This state where the mask holds, the other elsewhere."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return _State(*(torch.where(mask.view(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))


@dataclass(frozen=True)
class _Result:
    """Filled row by row as grasps finish."""

    T: Float[Tensor, "b 4 4"]
    q: Float[Tensor, "b n_dof"]
    residual: Float[Tensor, "b k"]
    converged: Bool[Tensor, " b"]
    iterations: Int[Tensor, " b"]

    @staticmethod
    def empty(state: _State) -> _Result:
        """Room for the results of these grasps, as if no step were taken."""
        none = torch.zeros_like(state.stalled)
        return _Result(state.T.clone(), state.q.clone(), state.residual.clone(), none.bool(), none)

    def put(self, rows: Int[Tensor, " r"], state: _State, converged: Bool[Tensor, " r"], iterations: int) -> None:
        """Store finished grasps."""
        self.T[rows], self.q[rows], self.residual[rows] = state.T, state.q, state.residual
        self.converged[rows], self.iterations[rows] = converged, iterations


@torch.no_grad()
def solve_joints(
    tree: KinematicTree,
    targets: Float[Tensor, "*b t 3"],
    target_links: Int[Tensor, " t"],
    target_points: Float[Tensor, "t 3"],
    T_world_wrist: Float[Tensor, "*b 4 4"],
    q: Float[Tensor, "*b n_dof"],
    lower: Float[Tensor, " n_dof"] | None = None,
    upper: Float[Tensor, " n_dof"] | None = None,
    weights: Float[Tensor, "*b t"] | None = None,
    movable: Bool[Tensor, " n_dof"] | None = None,
    config: JointSolverConfig | None = None,
) -> JointSolution:
    """Wrist pose and joints that bring points on links closest to target positions.

    Minimises the weighted sum of un-squared distances within the joint limits. Every grasp stops by itself, and what
    comes out for it does not depend on the others in the batch.

    Args:
        tree: The hand's kinematic tree; its couplings hold exactly.
        targets: Wanted world positions [m].
        target_links: The link that each point is fixed to.
        target_points: The points in their links' frames [m].
        T_world_wrist: Where the root link starts.
        q: Where the independent joints start; clamped to the limits.
        lower: Limits other than the tree's [rad or m].
        upper: Likewise.
        weights: Weight of each target; 1 by default, 0 leaves one out.
        movable: False for joints that stay where they start.
        config: See JointSolverConfig.

    Raises:
        OptionError: There is no target.
    """
    config = config or JointSolverConfig()
    if len(target_links) == 0:
        raise OptionError("the joint solver got no target; give at least one point on a link with its position")
    batch, t, dtype = q.shape[:-1], len(target_links), q.dtype
    weights = torch.ones_like(targets[..., 0]) if weights is None else weights
    q = q.reshape(-1, tree.n_dof).double()
    movable = torch.ones_like(tree.lower, dtype=torch.bool) if movable is None else movable
    low = torch.where(movable, (tree.lower if lower is None else lower).double(), q)
    high = torch.where(movable, (tree.upper if upper is None else upper).double(), q)
    problem = _problem(
        tree.double, target_links, target_points.double(), targets.reshape(-1, t, 3).double(),
        weights.reshape(-1, t).double(), low, high,
    )
    T = T_world_wrist.reshape(-1, 4, 4).double()
    start = _state(problem, T, torch.minimum(torch.maximum(q, low), high), config)
    final = _iterate(problem, start, config)
    total = problem.weights.sum(-1).clamp(min=1e-12)
    residual = (point_norms(final.residual) * problem.weights).sum(-1) / total
    # Rounding to single precision may step over a limit by half a unit: clamp once more.
    joints = torch.minimum(torch.maximum(final.q.to(dtype), low.to(dtype)), high.to(dtype))
    return JointSolution(
        _orthonormal(final.T).to(dtype).reshape(*batch, 4, 4), joints.reshape(*batch, tree.n_dof),
        residual.to(dtype).reshape(batch), final.converged.reshape(batch), final.iterations.reshape(batch),
    )


def _iterate(problem: _Problem, state: _State, config: JointSolverConfig) -> _Result:
    """Iterate until every grasp is done; the rows of finished grasps leave the computation."""
    result = _Result.empty(state)
    rows = torch.arange(len(state.q), device=state.q.device)
    for iteration in range(1, config.max_iterations + 1):
        state, change = _advance(problem, state, config)
        done = (change < config.tolerance) | (state.stalled >= 2)
        last = iteration == config.max_iterations
        if last or bool(done.any()):
            leaving = torch.ones_like(done) if last else done
            result.put(rows[leaving], state.rows(leaving), done[leaving], iteration)
            problem, state, rows = problem.rows(~leaving), state.rows(~leaving), rows[~leaving]
        if len(rows) == 0:
            break
    return result


def _advance(problem: _Problem, state: _State, config: JointSolverConfig) -> tuple[_State, Float[Tensor, " b"]]:
    """One step per grasp, kept where it lowers the objective; and the largest change it makes or would make."""
    limit = config.step_limit
    wrist = torch.full_like(state.T[:, :3, :2].flatten(1), limit)
    low = torch.cat([-wrist, (problem.lower - state.q).clamp(-limit, limit)], -1)
    high = torch.cat([wrist, (problem.upper - state.q).clamp(-limit, limit)], -1)
    scale = (problem.weights / smoothed_norms(state.residual, config.step.norm_floor)).mean(-1) * 1e-4
    step = best_step(
        state.jacobian, state.residual, problem.weights, low, high, state.damping * scale, state.sharpness, config.step
    )
    T, q = _move(state, step)
    q = torch.minimum(torch.maximum(q, problem.lower), problem.upper)
    tried = _state(problem, T, q, config)
    better = tried.cost <= state.cost
    change = step.abs().amax(-1)
    damping = torch.where(better, state.damping / 8, state.damping * 16).clamp(*config.damping_range)
    sharpness = torch.where(better & (change < config.sharpen_below), config.sharpness, 0.0).to(damping)
    little = tried.cost > state.cost * (1 - config.objective_tolerance)
    stalled = torch.where(little, state.stalled + 1 + better.long(), 0)
    return replace(tried.where(better, state), damping=damping, sharpness=sharpness, stalled=stalled), change


def _move(state: _State, step: Float[Tensor, "b p"]) -> tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b n_dof"]]:
    local = torch.zeros_like(state.T)
    local[:, :3, :3] = roma.rotvec_to_rotmat(step[:, 3:6])
    local[:, :3, 3] = step[:, :3]
    local[:, 3, 3] = 1
    return state.T @ local, state.q + step[:, 6:]


def _problem(
    tree: KinematicTree, links: Tensor, points: Tensor, targets: Tensor, weights: Tensor, lower: Tensor, upper: Tensor
) -> _Problem:
    coupling = tree.link_coupling
    pair_link, dof = coupling.nonzero(as_tuple=True)
    drive = (tree.descends[links][:, pair_link].to(coupling.dtype) * coupling[pair_link, dof]).T.repeat(1, 3)
    gather = torch.zeros(tree.n_dof, len(dof), dtype=coupling.dtype, device=coupling.device)
    gather[dof, torch.arange(len(dof), device=dof.device)] = 1
    same = gather.shape[0] == gather.shape[1] and bool((gather.diagonal() == 1).all())
    return _Problem(tree, links, points, drive, pair_link, None if same else gather, targets, weights, lower, upper)


def _state(
    problem: _Problem, T: Float[Tensor, "b 4 4"], q: Float[Tensor, "b n_dof"], config: JointSolverConfig
) -> _State:
    """Kinematics, residuals and their derivative, all in the wrist frame, where wrist increments are simplest."""
    poses = problem.tree.forward(q)
    chosen = poses[:, problem.links]
    points = (chosen[..., :3, :3] @ problem.points[..., None])[..., 0] + chosen[..., :3, 3]
    wanted = (problem.targets - T[:, None, :3, 3]) @ T[:, :3, :3]
    residual = (points - wanted).mT.flatten(1)
    cost = (smoothed_norms(residual, config.step.norm_floor) * problem.weights).sum(-1)
    damping = torch.full_like(cost, config.damping)
    none = torch.zeros_like(cost)
    return _State(T, q, residual, _jacobian(problem, poses, points), cost, damping, none, none.long())


def _jacobian(
    problem: _Problem, poses: Float[Tensor, "b n_links 4 4"], points: Float[Tensor, "b t 3"]
) -> Float[Tensor, "b p k"]:
    """Transposed derivative of the points by wrist shift, wrist rotation and joints.

    A twist (v, w) moves a point p by v + w x p: that is one 6 x 3 block per point, which serves the wrist and, after
    multiplication by the joints' axes, the joints.
    """
    zero, one = torch.zeros_like(points[..., 0]), torch.ones_like(points[..., 0])
    x, y, z = points.unbind(-1)
    rows = [one, zero, zero, zero, one, zero, zero, zero, one, zero, -z, y, z, zero, -x, -y, x, zero]
    twist = torch.stack(rows, 1).unflatten(1, (6, 3)).flatten(2)
    linear, angular = problem.tree.motion_axes(poses)
    axes = torch.cat([linear, angular], -1)[:, problem.pair_link]
    joints = (axes @ twist) * problem.drive
    if problem.pair_dof is not None:
        joints = problem.pair_dof @ joints
    return torch.cat([twist, joints], 1)


def _orthonormal(T: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 4 4"]:
    """Remove the rounding that repeated products leave in a rotation."""
    clean = T.clone()
    clean[:, :3, :3] = roma.special_gramschmidt(T[:, :3, :2])
    return clean
