"""Target positions of points on links -> wrist pose and joint values, for many grasps at once.

Each iteration linearises the kinematics and takes the best step of `joint_step`; a step that does not lower the
objective is undone and damped. The wrist moves by local se(3) increments, so nothing is singular.

Layout: residuals are coordinate-major. With t targets, a row of k = 3 t numbers holds x of all targets, then all y,
then all z. The norm of each target is then a sum of three contiguous chunks, and the Jacobian, stored transposed
(p unknowns x k), is built by whole-row products. The p unknowns are wrist shift (3), wrist rotation (3) and joints.

Tensors come and go in single precision; everything between is double. The matrices are tiny, so it costs no time, and
rounding, which depends on the batch size, then decides neither which limits are active nor when a grasp stops.
Source: paper section III-D, joint configurations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import Rows
from dro_grasp.errors import OptionError
from dro_grasp.geometry.se3 import apply, compose, roma
from dro_grasp.hands.kinematics.joint_step import StepConfig, best_step, point_norms, smoothed_norms
from dro_grasp.hands.kinematics.tree import KinematicTree
from dro_grasp.kinds import Checked


@dataclass(frozen=True)
class Targets:
    """World positions for points that are fixed to links."""

    positions: Float[Tensor, "*b t 3"]  # where each point should be [m]
    links: Int[Tensor, " t"]
    local: Float[Tensor, "t 3"]  # each point in the frame of its link [m]


@dataclass(frozen=True)
class JointSolverConfig(Checked):
    """Stopping, step limits and damping. Values are ours unless a source is given."""

    max_iterations: int = 32
    step_limit: float = 0.5
    """Largest change of a joint or of a wrist coordinate per iteration [rad or m]. Source: section III-D."""
    tolerance: float = 2e-5  # a grasp is done when no coordinate changes by more than this [rad or m]
    objective_tolerance: float = 5e-4
    """A grasp is also done when a step lowers the objective by less than this share, or when two steps in a row fail
    to lower it."""
    damping: float = 1e-2  # initial damping, in units of the mean IRLS weight times `damping_length` squared
    damping_range: tuple[float, float] = (1e-6, 1e8)  # smallest and largest damping, in the same unit
    damping_length: float = 0.01
    """Lever arm that gives the damping its scale [m]: it makes 1 rad of a joint comparable to so many metres."""
    damping_decrease: float = 8.0  # divides the damping after a step that lowers the objective (Levenberg-Marquardt)
    damping_increase: float = 16.0
    """Multiplies the damping after a step that does not; larger than the decrease, so that failures do not alternate."""
    sharpness: float = 0.8  # once steps are small: share of Newton's curvature in place of IRLS's; see joint_step
    sharpen_below: float = 0.1  # steps whose largest coordinate is below this count as small [rad or m]
    step: StepConfig = field(default_factory=StepConfig)


@dataclass(frozen=True)
class JointSolution:
    """Result of the solver, per grasp."""

    T_world_wrist: Float[Tensor, "*b 4 4"]
    joints: Float[Tensor, "*b n_dof"]  # independent joints, inside their limits [rad or m]
    residual: Float[Tensor, "*b"]  # mean distance of the points from their targets [m]
    converged: Bool[Tensor, "*b"]  # whether steps or gains fell below their tolerances
    iterations: Int[Tensor, "*b"]


@dataclass(frozen=True)
class _Problem:
    """What stays the same over the iterations; a pair is a moving link and an independent joint (dof) that drives it."""

    tree: KinematicTree
    links: Int[Tensor, " t"]
    local: Float[Tensor, "t 3"]
    drive: Float[Tensor, "pairs k"]
    """Change of a pair's joint per unit of its dof where that joint moves the target, else zero; coordinate-major."""
    pair_link: Int[Tensor, " pairs"]
    pair_dof: Float[Tensor, "n_dof pairs"] | None  # sums pairs into dofs; None if pair i is dof i
    positions: Float[Tensor, "b t 3"]
    lower: Float[Tensor, "b n_dof"]
    upper: Float[Tensor, "b n_dof"]

    def rows(self, index: Bool[Tensor, " b"]) -> _Problem:
        """The problem of some of the grasps."""
        return replace(self, **{k: getattr(self, k)[index] for k in ("positions", "lower", "upper")})


@dataclass(frozen=True)
class _State(Rows):
    """The iterate of each grasp, with the kinematics linearised there."""

    T: Float[Tensor, "b 4 4"]
    q: Float[Tensor, "b n_dof"]
    residual: Float[Tensor, "b k"]  # points minus targets in the wrist frame, coordinate-major [m]
    jacobian: Float[Tensor, "b p k"]
    cost: Float[Tensor, " b"]  # sum of smoothed norms [m]
    damping: Float[Tensor, " b"]
    sharpness: Float[Tensor, " b"]
    stalled: Int[Tensor, " b"]
    """Sum over the steps since the last real gain: 2 for a step that gained little, 1 for a step that was undone."""


@torch.no_grad()
def solve_joints(
    tree: KinematicTree, targets: Targets, T_world_wrist: Float[Tensor, "*b 4 4"], q: Float[Tensor, "*b n_dof"],
    movable: Bool[Tensor, " n_dof"] | None = None, config: JointSolverConfig | None = None,
) -> JointSolution:
    """Wrist pose and joints that bring points on links closest to target positions.

    Minimises the sum of un-squared distances within the joint limits; couplings hold exactly. Each grasp stops on its own
    criterion, and its result does not depend on the other grasps in the batch.

    Args:
        T_world_wrist: Initial pose of the root link.
        q: Initial independent joints; clamped to the limits [rad or m].
        movable: False for joints that keep their initial value, inside the limits or not; all move by default.

    Raises:
        OptionError: There is no target.
    """
    config = config or JointSolverConfig()
    if len(targets.links) == 0:
        raise OptionError("the joint solver got no target; give at least one point on a link with its position")
    batch, dtype = q.shape[:-1], q.dtype
    q = q.reshape(-1, tree.n_dof).double()
    movable = torch.ones_like(tree.lower, dtype=torch.bool) if movable is None else movable
    low, high = (torch.where(movable, limit.double(), q) for limit in (tree.lower, tree.upper))
    problem = _problem(tree.double, targets, low, high)
    T = T_world_wrist.reshape(-1, 4, 4).double()
    final = _iterate(problem, _state(problem, T, q.clamp(low, high), config), config)
    # Rounding to single precision may step over a limit by half a unit: clamp once more.
    joints = final.joints.to(dtype).clamp(low.to(dtype), high.to(dtype))
    # Repeated products leave rounding errors in the rotation: make it orthonormal again.
    T = compose(roma.special_gramschmidt(final.T_world_wrist[:, :3, :2]), final.T_world_wrist[:, :3, 3])
    return JointSolution(
        T.to(dtype).reshape(*batch, 4, 4), joints.reshape(*batch, tree.n_dof), final.residual.to(dtype).reshape(batch),
        final.converged.reshape(batch), final.iterations.reshape(batch),
    )


def _iterate(problem: _Problem, state: _State, config: JointSolverConfig) -> JointSolution:
    """Iterate until every grasp is done; finished grasps leave the batch for the solution, which is in double precision."""
    none = torch.zeros_like(state.stalled)
    result = JointSolution(state.T.clone(), state.q.clone(), torch.zeros_like(state.cost), none.bool(), none)
    rows = torch.arange(len(state.q), device=state.q.device)
    for iteration in range(1, config.max_iterations + 1):
        state, change = _advance(problem, state, config)
        done = (change < config.tolerance) | (state.stalled >= 2)
        last = iteration == config.max_iterations
        if last or bool(done.any()):
            leaving = torch.ones_like(done) if last else done
            gone, final = rows[leaving], state.rows(leaving)
            result.T_world_wrist[gone], result.joints[gone] = final.T, final.q
            result.residual[gone] = point_norms(final.residual).mean(-1)
            result.converged[gone], result.iterations[gone] = done[leaving], iteration
            problem, state, rows = problem.rows(~leaving), state.rows(~leaving), rows[~leaving]
        if len(rows) == 0:
            break
    return result


def _advance(problem: _Problem, state: _State, config: JointSolverConfig) -> tuple[_State, Float[Tensor, " b"]]:
    """One step per grasp, undone if it raises the objective; and its largest change of a coordinate [rad or m]."""
    limit = config.step_limit
    wrist = torch.full_like(state.T[:, :3, :2].flatten(1), limit)
    low = torch.cat([-wrist, (problem.lower - state.q).clamp(-limit, limit)], -1)
    high = torch.cat([wrist, (problem.upper - state.q).clamp(-limit, limit)], -1)
    weight = smoothed_norms(state.residual, config.step.norm_floor).reciprocal().mean(-1)
    damping = state.damping * (weight * config.damping_length**2)
    step = best_step(state.jacobian, state.residual, low, high, damping, state.sharpness, config.step)
    T, q = _move(state, step)
    q = q.clamp(problem.lower, problem.upper)
    proposed = _state(problem, T, q, config)
    better = proposed.cost <= state.cost
    change = step.abs().amax(-1)
    lighter, heavier = state.damping / config.damping_decrease, state.damping * config.damping_increase
    damping = torch.where(better, lighter, heavier).clamp(*config.damping_range)
    sharpness = torch.where(better & (change < config.sharpen_below), config.sharpness, 0.0).to(damping)
    little = proposed.cost > state.cost * (1 - config.objective_tolerance)
    stalled = torch.where(little, state.stalled + 1 + better.long(), 0)
    return replace(proposed.where(better, state), damping=damping, sharpness=sharpness, stalled=stalled), change


def _move(state: _State, step: Float[Tensor, "b p"]) -> tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b n_dof"]]:
    """Apply a step: the wrist moves in its own frame."""
    local = compose(roma.rotvec_to_rotmat(step[:, 3:6]), step[:, :3])
    return state.T @ local, state.q + step[:, 6:]


def _problem(
    tree: KinematicTree, targets: Targets, lower: Float[Tensor, "b n_dof"], upper: Float[Tensor, "b n_dof"]
) -> _Problem:
    """The problem in double precision, with the batch axes of the targets flattened."""
    positions = targets.positions.reshape(-1, *targets.positions.shape[-2:]).double()
    coupling = tree.link_coupling
    pair_link, dof = coupling.nonzero(as_tuple=True)
    drive = (tree.descends[targets.links][:, pair_link].to(coupling.dtype) * coupling[pair_link, dof]).T.repeat(1, 3)
    gather = torch.zeros(tree.n_dof, len(dof), dtype=coupling.dtype, device=coupling.device)
    gather[dof, torch.arange(len(dof), device=dof.device)] = 1
    same = gather.shape[0] == gather.shape[1] and bool((gather.diagonal() == 1).all())
    return _Problem(
        tree, targets.links, targets.local.double(), drive, pair_link, None if same else gather, positions, lower, upper
    )


def _state(problem: _Problem, T: Float[Tensor, "b 4 4"], q: Float[Tensor, "b n_dof"], config: JointSolverConfig) -> _State:
    """Kinematics, residuals and their derivative, all in the wrist frame, where the wrist Jacobian is simplest."""
    poses = problem.tree.forward(q)
    points = apply(poses[:, problem.links], problem.local)
    wanted = (problem.positions - T[:, None, :3, 3]) @ T[:, :3, :3]
    residual = (points - wanted).mT.flatten(1)
    cost = smoothed_norms(residual, config.step.norm_floor).sum(-1)
    damping = torch.full_like(cost, config.damping)
    none = torch.zeros_like(cost)
    return _State(T, q, residual, _jacobian(problem, poses, points), cost, damping, none, none.long())


def _jacobian(
    problem: _Problem, poses: Float[Tensor, "b n_links 4 4"], points: Float[Tensor, "b t 3"]
) -> Float[Tensor, "b p k"]:
    """Transposed derivative of the points with respect to wrist shift, wrist rotation and joints.

    A twist (v, w) moves a point p by v + w x p. `twist` holds this map, six rows over all coordinates; it is the wrist's
    part of the Jacobian, and a joint's row is its own twist times these six rows.
    """
    zero, one = torch.zeros_like(points[..., 0]), torch.ones_like(points[..., 0])
    x, y, z = points.unbind(-1)
    # Entry 3 i + c: coordinate c of a point's velocity per unit of twist coordinate i.
    rows = [one, zero, zero, zero, one, zero, zero, zero, one, zero, -z, y, z, zero, -x, -y, x, zero]
    twist = torch.stack(rows, 1).unflatten(1, (6, 3)).flatten(2)
    linear, angular = problem.tree.motion_axes(poses)
    axes = torch.cat([linear, angular], -1)[:, problem.pair_link]
    joints = (axes @ twist) * problem.drive
    if problem.pair_dof is not None:
        joints = problem.pair_dof @ joints
    return torch.cat([twist, joints], 1)
