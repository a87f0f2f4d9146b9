"""Target positions of points on links -> wrist pose and joint values, for many grasps at once.

Each iteration linearises the kinematics and takes the best step; a step that does not lower the objective is undone and
damped. The wrist moves by local se(3) increments, so nothing is singular. Joints can be read off link poses as a first guess.

Layout: residuals are coordinate-major. With t targets, a row of k = 3 t numbers holds x of all targets, then all y,
then all z. The norm of each target is then a sum of three contiguous chunks, and the Jacobian, stored transposed
(p unknowns x k), is built by whole-row products. The p unknowns are wrist shift (3), wrist rotation (3) and joints.

Tensors come and go in single precision; everything between is double. The matrices are tiny, so it costs no time, and
rounding, which depends on the batch size, then decides neither which limits are active nor when a grasp stops.
Source: paper section III-D, joint configurations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dro_grasp.devices import Rows, where_any
from dro_grasp.errors import OptionError
from dro_grasp.geometry.se3 import apply, compose, invert, roma, rotate
from dro_grasp.graphs import repeat
from dro_grasp.hands.kinematics.tree import FIXED, REVOLUTE, KinematicTree
from dro_grasp.kinds import Checked

ROUNDS = 8  # Sweeps of coordinate descent where several joints lie between two known links (ours)
RIDGE = 1e-6  # Pull towards the given values, for joints that no pose determines [1] (ours)


@torch.no_grad()
def read_joints(
    tree: KinematicTree, T_world_link: Float[Tensor, "*b n_links 4 4"], valid: Bool[Tensor, " n_links"],
    q: Float[Tensor, "*b n_dof"],
) -> Float[Tensor, "*b n_dof"]:
    """Joints that reproduce the relative poses of neighbouring known links, inside their limits; noise is allowed.

    Each joint between two links of known pose takes the value that brings the lower one closest to its pose. Joints that no
    pair of links with a `valid` pose encloses keep the values from which the sweeps start, q [rad or m]. Source: ours; the
    paper starts from the given open hand.
    """
    segments = _segments(tree, valid)
    if not segments:
        return q
    known = torch.zeros(len(tree.moving_names), dtype=torch.bool, device=q.device)
    known[[tree.link_joint[link] for _, _, chain in segments for link in chain]] = True
    longest = max(len(chain) for _, _, chain in segments)
    places = []
    for place in range(longest):
        rows = [(top, bottom, chain[place]) for top, bottom, chain in segments if len(chain) > place]
        places.append(torch.tensor(rows).T.to(q.device))
    for _ in range(1 if longest == 1 else ROUNDS):
        for place in places:
            q = _update(tree, T_world_link, q, known, *place)
    return q


def _segments(tree: KinematicTree, valid: Bool[Tensor, " n_links"]) -> list[tuple[int, int, list[int]]]:
    """Triples: a known link, the next known link below it, and the moving links between them, topmost first."""
    found, known = [], valid.tolist()
    for bottom in [link for link, is_known in enumerate(known) if is_known]:
        chain, link = [], bottom
        while link >= 0 and (link == bottom or not known[link]):
            if tree.kind[link] != FIXED:
                chain.append(link)
            link = tree.parent[link]
        if link >= 0 and chain:
            found.append((link, bottom, chain[::-1]))
    return found


def _update(
    tree: KinematicTree, target: Float[Tensor, "*b n_links 4 4"], q: Float[Tensor, "*b n_dof"],
    known: Bool[Tensor, " n_joints"], top: Int[Tensor, " s"], bottom: Int[Tensor, " s"], moving: Int[Tensor, " s"],
) -> Float[Tensor, "*b n_dof"]:
    """Set one joint of each segment to its best value and keep the others."""
    poses = tree.forward(q)
    parent = tree.parents[moving]
    # T_top_bottom = before @ joint motion @ after: solve for the motion that gives the wanted relative pose.
    before = invert(poses[..., top, :, :]) @ poses[..., parent, :, :] @ tree.origin[moving]
    after = invert(poses[..., moving, :, :]) @ poses[..., bottom, :, :]
    wanted = invert(target[..., top, :, :]) @ target[..., bottom, :, :]
    motion = invert(before) @ wanted @ invert(after)
    x = q @ tree.coupling.T + tree.offset
    joint = tree.link_joints[moving]
    x[..., joint] = _joint_value(tree, motion, moving, x[..., joint])
    return _independent(tree, x, q, known)


def _joint_value(
    tree: KinematicTree, motion: Float[Tensor, "*b s 4 4"], moving: Int[Tensor, " s"], near: Float[Tensor, "*b s"]
) -> Float[Tensor, "*b s"]:
    """Angle about, or shift along, each joint's axis a that comes closest to a motion (R, t)."""
    # The rotation about a closest to R in the Frobenius norm maximises trace(R(x)^T R), which is sin(x) (a . v) + cos(x) (trace
    # R - a^T R a) + a^T R a, with v the axial vector of R - R^T.
    axis = tree.axis[moving]
    rotation = motion[..., :3, :3]
    turned = torch.stack([
        rotation[..., 2, 1] - rotation[..., 1, 2],
        rotation[..., 0, 2] - rotation[..., 2, 0],
        rotation[..., 1, 0] - rotation[..., 0, 1],
    ], -1)
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    along = (axis * rotate(rotation, axis)).sum(-1)
    angle = torch.atan2((axis * turned).sum(-1), trace - along)
    # Angles are equal up to whole turns: take the one nearest to the present value.
    angle = angle + 2 * math.pi * torch.round((near - angle) / (2 * math.pi))
    revolute = tree.kinds[moving] == REVOLUTE
    return torch.where(revolute, angle, (axis * motion[..., :3, 3]).sum(-1))


def _independent(
    tree: KinematicTree, x: Float[Tensor, "*b n_joints"], q: Float[Tensor, "*b n_dof"], known: Bool[Tensor, " n_joints"]
) -> Float[Tensor, "*b n_dof"]:
    """Independent joints that fit all known joints best; the fit is exact without couplings."""
    rows = tree.coupling[known]
    matrix = rows.T @ rows + RIDGE * torch.eye(tree.n_dof, dtype=q.dtype, device=q.device)
    right = (x - tree.offset)[..., known] @ rows + RIDGE * q
    fitted = torch.linalg.solve_ex(matrix, right[..., None]).result[..., 0]
    return fitted.clamp(tree.lower, tree.upper)


@dataclass(frozen=True)
class StepConfig(Checked):
    """How precisely one step is solved: a convex problem per grasp, for a whole batch at once. Values are ours.

    Minimise over d the sum of un-squared norms |r_i + J_i d|, with d inside a box. One reweighting of iteratively reweighted
    least squares (IRLS) handles the norms, an active set the box; each of its passes is one batched Cholesky factorisation.

    A norm |r| has the curvature (I - u u^T) / |r| with u = r / |r|. IRLS takes I / |r| instead: it never overshoots, but it
    converges slowly near an optimum that misses its targets. `sharpness` s in [0, 1] takes (I - s u u^T) / |r|: 0 is IRLS,
    1 is Newton's method.
    """

    active_set_passes: int = 3  # most solves with a corrected active set; they end when the set no longer changes
    norm_floor: float = 3e-4
    """Below this, norms are replaced by parabolas [m]: the weights stay finite and the optimum moves by less than this."""


@dataclass(frozen=True)
class _Quadratic(Rows):
    """d^T H d / 2 + g^T d over the box [lower, upper]."""

    matrix: Float[Tensor, "b p p"]
    gradient: Float[Tensor, "b p"]
    lower: Float[Tensor, "b p"]
    upper: Float[Tensor, "b p"]


def best_step(
    jacobian: Float[Tensor, "b p k"], residual: Float[Tensor, "b k"], lower: Float[Tensor, "b p"], upper: Float[Tensor, "b p"],
    damping: Float[Tensor, " b"], sharpness: Float[Tensor, " b"] | None = None, config: StepConfig | None = None,
) -> Float[Tensor, "b p"]:
    """The step that brings all points closest to their targets, to first order.

    The step is between `lower`, at most 0, and `upper`, at least 0 [rad or m]. `damping` times the identity is added to the
    normal equations [1/m]; `sharpness` is between IRLS (0, the default) and Newton's method (1).
    """
    config = config or StepConfig()
    matrix, gradient = _model(jacobian, residual, sharpness, config)
    matrix.diagonal(dim1=-2, dim2=-1).add_(damping[:, None])
    return _minimum_in_box(_Quadratic(matrix, gradient, lower, upper), config.active_set_passes)


def _model(
    jacobian: Float[Tensor, "b p k"], residual: Float[Tensor, "b k"], sharpness: Float[Tensor, " b"] | None, config: StepConfig
) -> tuple[Float[Tensor, "b p p"], Float[Tensor, "b p"]]:
    """Curvature H and slope g of the sum of norms."""
    # With weights w_i = 1 / |r_i|, IRLS has H = sum w_i J_i^T J_i. The correction -s w_i (J_i^T u_i)(J_i^T u_i)^T is of rank
    # one per target, so it joins the same matrix product as one more column per target.
    norms = point_norms(residual)
    floored = norms.clamp(min=config.norm_floor)
    scale = floored.reciprocal()
    weighted, plain = jacobian * scale.repeat(1, 3)[:, None], jacobian
    gradient = (weighted @ residual[..., None])[..., 0]
    if sharpness is not None:
        # Below the floor the function is a parabola, and IRLS has its exact curvature.
        share = torch.where(norms > config.norm_floor, sharpness[:, None] * scale, 0.0)
        directions = residual / floored.repeat(1, 3)
        x, y, z = (jacobian * directions[:, None]).chunk(3, -1)
        along = x + y + z
        weighted, plain = torch.cat([weighted, -along * share[:, None]], -1), torch.cat([jacobian, along], -1)
    return weighted @ plain.mT, gradient


def point_norms(residual: Float[Tensor, "*b k"]) -> Float[Tensor, "*b t"]:
    """Length of each target's residual [m]."""
    x, y, z = residual.square().chunk(3, -1)
    return (x + y + z).sqrt()


def smoothed_norms(residual: Float[Tensor, "*b k"], floor: float) -> Float[Tensor, "*b t"]:
    """Norms that IRLS with a floor minimises [m]: a parabola below the floor, joined with equal value and slope."""
    norms = point_norms(residual)
    return torch.where(norms > floor, norms, (norms.square() + floor**2) / (2 * floor))


def _minimum_in_box(quadratic: _Quadratic, passes: int) -> Float[Tensor, "b p"]:
    """Minimum of the quadratic in its box, by a primal-dual active set."""
    # Each unknown is free, held at its lower bound or held at its upper bound. A pass minimises over the free unknowns. Then a
    # free unknown beyond a bound is held there, and a held unknown is released if the slope pulls it back inside. Most sets
    # settle in two or three passes; passes after the first one see only the rows whose set has changed.
    lower, upper, gradient = quadratic.lower, quadratic.upper, quadratic.gradient
    # Joints that cannot move have equal bounds: they stay at the lower one whatever the slope.
    frozen = lower >= upper
    # First guess: a bound already reached, with the steepest descent pointing out of the box.
    at_lower, at_upper = (lower >= 0) & (gradient > 0) | frozen, (upper <= 0) & (gradient < 0) & ~frozen
    step, at_lower, at_upper, changed = _pass(quadratic, at_lower, at_upper)
    for _ in range(passes - 1):
        rows = where_any(changed)
        if isinstance(rows, Tensor) and not len(rows):
            break
        again = _pass(quadratic.rows(rows), at_lower[rows], at_upper[rows])
        step[rows], at_lower[rows], at_upper[rows], changed[rows] = again
    return step.clamp(lower, upper)


def _pass(
    quadratic: _Quadratic, at_lower: Bool[Tensor, "b p"], at_upper: Bool[Tensor, "b p"]
) -> tuple[Float[Tensor, "b p"], Bool[Tensor, "b p"], Bool[Tensor, "b p"], Bool[Tensor, " b"]]:
    """The minimum for an active set, the next active set, and the rows in which the two differ."""
    step = _solve_free(quadratic, at_lower, at_upper)
    slope = (quadratic.matrix @ step[..., None])[..., 0] + quadratic.gradient
    frozen = quadratic.lower >= quadratic.upper
    fixed = at_lower | at_upper
    next_lower = torch.where(fixed, at_lower & (slope > 0), step < quadratic.lower) | frozen
    next_upper = torch.where(fixed, at_upper & (slope < 0), step > quadratic.upper) & ~frozen
    changed = ((next_lower != at_lower) | (next_upper != at_upper)).any(-1)
    return step, next_lower, next_upper, changed


def _solve_free(quadratic: _Quadratic, at_lower: Bool[Tensor, "b p"], at_upper: Bool[Tensor, "b p"]) -> Float[Tensor, "b p"]:
    """Minimum over the free unknowns, with the others at their bounds."""
    # Rows and columns of held unknowns become those of the identity, so that all problems of the batch keep one size.
    fixed = at_lower | at_upper
    value = torch.where(at_lower, quadratic.lower, torch.where(at_upper, quadratic.upper, 0.0))
    free = (~fixed).to(value.dtype)
    matrix = quadratic.matrix * free[:, :, None] * free[:, None, :]
    matrix.diagonal(dim1=-2, dim2=-1).add_(1 - free)
    right = -(quadratic.gradient + (quadratic.matrix @ value[..., None])[..., 0]) * free
    factor, _ = torch.linalg.cholesky_ex(matrix)
    return _solve(factor, right[..., None])[..., 0] * free + value


def _solve(factor: Float[Tensor, "b p p"], right: Float[Tensor, "b p 1"]) -> Float[Tensor, "b p 1"]:
    """The solution for a lower Cholesky factor."""
    if factor.device.type == "cpu":
        return torch.cholesky_solve(right, factor)
    # CUDA's `cholesky_solve` allocates memory, which a graph does not allow.
    half = torch.linalg.solve_triangular(factor, right, upper=False)
    return torch.linalg.solve_triangular(factor.mT, half, upper=True)


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
    sharpness: float = 0.8  # once steps are small: share of Newton's curvature in place of IRLS's; see `StepConfig`
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
    """Wrist pose and joints, from initial ones, that bring points on links closest to targets; OptionError: there is none.

    Minimises the sum of un-squared distances within the joint limits [rad or m]; couplings hold exactly. Each grasp stops on
    its own criterion, and its result does not depend on the other grasps in the batch. Joints that are not `movable` keep their
    initial value, inside the limits or not; all move by default.
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
    """Iterate until every grasp is done, in double precision."""
    return (_iterate_fewer if state.q.device.type == "cpu" else _iterate_all)(problem, state, config)


def _iterate_fewer(problem: _Problem, state: _State, config: JointSolverConfig) -> JointSolution:
    """Finished grasps leave the batch, which saves work where one may look at them."""
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


@dataclass(frozen=True)
class _Running(Rows):
    """Iterates, and which of them are final."""

    state: _State
    done: Bool[Tensor, " b"]
    iterations: Int[Tensor, " b"]


def _iterate_all(problem: _Problem, state: _State, config: JointSolverConfig) -> JointSolution:
    """All grasps iterate to the end, those that are done without moving, so that nobody has to wait for a look at them."""
    def step(now: _Running, number: Int[Tensor, "1"]) -> _Running:
        new, change = _advance(problem, now.state, config)
        done = (change < config.tolerance) | (new.stalled >= 2)
        return _Running(now.state.where(now.done, new), now.done | done, now.iterations + ~now.done)

    none = torch.zeros_like(state.stalled)
    end = repeat(step, _Running(state, none.bool(), none), config.max_iterations)
    return JointSolution(end.state.T, end.state.q, point_norms(end.state.residual).mean(-1), end.done, end.iterations)


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
    local = compose(roma.rotvec_to_rotmat(step[:, 3:6]), step[:, :3])
    return state.T @ local, state.q + step[:, 6:]


def _problem(
    tree: KinematicTree, targets: Targets, lower: Float[Tensor, "b n_dof"], upper: Float[Tensor, "b n_dof"]
) -> _Problem:
    """The problem in double precision, with the batch axes of the targets flattened."""
    positions = targets.positions.reshape(-1, *targets.positions.shape[-2:]).double()
    pairs = tree.pairs
    drive = (tree.descends[targets.links][:, pairs.link].to(pairs.rate.dtype) * pairs.rate).T.repeat(1, 3)
    return _Problem(
        tree, targets.links, targets.local.double(), drive, pairs.link, pairs.gather, positions, lower, upper
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
    """Transposed derivative of the points with respect to wrist shift, wrist rotation and joints."""
    # A twist (v, w) moves a point p by v + w x p. `twist` holds this map, six rows over all coordinates; it is the wrist's part
    # of the Jacobian, and a joint's row is its own twist times these six rows.
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
