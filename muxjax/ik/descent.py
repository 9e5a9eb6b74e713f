"""Pose to configuration: the paper's iteration, restarted from many points (M Eq. 3).

MODEL.md section 2 makes the method exact. One descent goes, from a start b,

    db = gain * (J^+ e + (I - J^+ J) mu),        J^+ = J' (J J' + damping)^-1

where e holds the position error over the arm's length (base frame) and the vee of the rotation
error (end-effector frame), J has the same rows, and b is the Cartesian bending, so that straight
segments are ordinary points. The gain starts at 1, halves on a step that does not descend and
doubles back on one that does; the bending limits are enforced after every update.

Descents from several starts run together (``descend_from_starts``, traceable);
``solve_by_descent`` repeats such rounds for the poses that are still unsolved.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from muxjax.ik.checks import distance_from_root, orthonormalised, reach
from muxjax.ik.result import IkResult, IkStatus
from muxjax.kinematics import (
    bending_from_configuration,
    bending_jacobian,
    configuration_from_bending,
    pose_from_bending,
)
from muxjax.precision import check_last_axis, padded_size
from muxjax.robot import Robot

Array = jax.Array | np.ndarray

POSITION_TOLERANCE = 1e-10  # [m], M IV-A2
ORIENTATION_TOLERANCE = 1e-10  # [rad], M IV-A2; judged on the true angle, never on the vee
STARTS = 128  # descents a pose at most
STARTS_PER_ROUND = 8
ITERATIONS = 32  # trial steps a descent at most
LEAST_GAIN = 2.0**-10  # a descent that would need less has stalled

# The damping of J J' is this times the merit. It bounds the step where J loses rank (the straight
# arm) and vanishes with the error, so that the last steps are Newton's and 1e-10 is reached.
DAMPING = 0.03
# Pull of the null-space term towards the reference, times the root of the merit: it too vanishes
# at the solution, where its second-order effect would otherwise keep the error up.
NULL_SPACE_PULL = 0.5
TILT = 0.1  # [rad] by which the second start leaves the reference, each segment its own way

# Poses of a round are padded to one of these, so that few sizes are ever compiled.
_BUCKETS = (1, 16, 256)
_BUCKETS_ELSEWHERE = (16, 1 << 12)  # on a GPU


def solve_by_descent(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    reference: Float[np.ndarray, "rows dof"],
    key: PRNGKeyArray | None,
    starts: int,
) -> IkResult:
    """One configuration for each pose by the paper's method.

    The first descents start at the reference and beside it, the others at random within the
    limits. Rounds of ``STARTS_PER_ROUND`` go on until one has a solution; of those it has, the
    one nearest to the reference in Cartesian bending is returned. All rows share their random
    starts: a row's answer does not depend on the others.
    """
    with jax.enable_x64(True):
        return _solve_in_rounds(
            jax.tree.map(lambda x: np.asarray(x, np.float64), robot),
            poses,
            reference,
            jax.random.key(0) if key is None else key,
            starts,
        )


def solve_traced(
    robot: Robot,
    pose: Float[jax.Array, "*batch 4 4"],
    q0: Float[Array, "*#batch dof"] | None,
    key: PRNGKeyArray | None,
    starts: int,
) -> IkResult:
    """``solve_ik`` inside a trace: checks of shape only, one round."""
    if not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "solve_ik: needs float64, but is traced in float32; call it outside jit, or set "
            'jax.config.update("jax_enable_x64", True)'
        )
    if pose.shape[-2:] != (4, 4):
        raise ValueError(f"pose: must have shape (..., 4, 4), found {pose.shape}")
    q = jnp.zeros(2 * robot.n_segments) if q0 is None else jnp.asarray(q0, jnp.float64)
    check_last_axis("q0", q.shape, 2 * robot.n_segments)
    reference = jnp.broadcast_to(q, (*pose.shape[:-2], q.shape[-1]))
    key = jax.random.key(0) if key is None else key
    return descend_from_starts(
        robot, pose.astype(jnp.float64), reference, reference, key, 0, starts
    )


def _solve_in_rounds(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    reference: Float[np.ndarray, "rows dof"],
    key: PRNGKeyArray,
    starts: int,
) -> IkResult:
    """Rounds of starts, each for the poses that are still unsolved."""
    n = len(poses)
    best = IkResult(
        q=np.zeros_like(reference),
        position_error=np.full(n, np.inf),
        orientation_error=np.full(n, np.inf),
        converged=np.zeros(n, bool),
        status=np.full(n, int(IkStatus.NOT_CONVERGED)),
        binding_limit=np.zeros((n, robot.n_segments), bool),
    )
    for first in range(0, starts, STARTS_PER_ROUND):
        open_rows = np.flatnonzero(~best.converged)
        count = min(STARTS_PER_ROUND, starts - first)
        for rows in _buckets(open_rows):
            begin = best.q if first else reference
            found = _round(robot, poses[rows], reference[rows], begin[rows], key, first, count)
            found = jax.tree.map(np.asarray, found)
            better = found.converged | (_merit_of(robot, found) < _merit_of(robot, best)[rows])
            for kept, new in zip(jax.tree.leaves(best), jax.tree.leaves(found), strict=True):
                kept[rows[better]] = new[better]
    return best


def _buckets(rows: Int[np.ndarray, " n"]) -> list[Int[np.ndarray, " bucket"]]:
    """Rows cut into pieces of the compiled sizes; the last piece repeats its last row."""
    pieces = []
    while len(rows):
        size = padded_size(len(rows), _BUCKETS, _BUCKETS_ELSEWHERE)
        piece, rows = rows[:size], rows[size:]
        pieces.append(np.pad(piece, (0, size - len(piece)), mode="edge"))
    return pieces


def descend_from_starts(
    robot: Robot,
    pose: Float[Array, "*batch 4 4"],
    reference: Float[Array, "*batch dof"],
    begin: Float[Array, "*batch dof"],
    key: PRNGKeyArray,
    first: int | Int[Array, ""],
    count: int,
) -> IkResult:
    """One round of ``count`` descents, and the best of them. Traceable; float64.

    Best is the converged one nearest to the reference, or else the one of least merit.

    Args:
        robot: The arm.
        pose: Targets.
        reference: Configuration to stay near [rad].
        begin: First start [rad]; the closest of earlier rounds, to go on with it.
        key: Of all random starts.
        first: Starts in earlier rounds.
        count: Starts in this one.
    """
    target = orthonormalised(pose)[..., None, :, :]
    wanted = bending_from_configuration(reference)[..., None, :, :]
    begin = bending_from_configuration(begin)[..., None, :, :]
    start = _starts(robot, begin, key, first, count)
    b, at = _descend(robot, start, target, wanted)
    away = jnp.sum((b - wanted) ** 2, axis=(-1, -2))
    reached = _converged(at)
    # Both below 1, so that no unsolved start ranks before a solved one.
    rank = jnp.where(reached, away / (1 + away), 1 + at.merit / (1 + at.merit))
    choice = jnp.argmin(jnp.where(jnp.isnan(rank), jnp.inf, rank), axis=-1)[..., None]
    b = jnp.take_along_axis(b, choice[..., None, None], axis=-3)[..., 0, :, :]
    position, angle, solved = (
        jnp.take_along_axis(x, choice, axis=-1)[..., 0] for x in (at.position, at.angle, reached)
    )
    q = configuration_from_bending(b)
    binding = q[..., 0::2] >= robot.theta_max * (1 - 1e-9)
    q = (
        jnp.asarray(q).at[..., 0::2].min(jnp.asarray(robot.theta_max))
    )  # hypot may round the limit up
    failure = jnp.where(
        distance_from_root(robot, pose) > reach(robot),
        IkStatus.OUT_OF_REACH,
        jnp.where(jnp.any(binding, axis=-1), IkStatus.LIMITED, IkStatus.NOT_CONVERGED),
    )
    status = jnp.where(solved, IkStatus.CONVERGED, failure)
    return IkResult(q, position, angle, solved, status, binding)


_round = jax.jit(descend_from_starts, static_argnames=("count",))


def _starts(
    robot: Robot,
    begin: Float[Array, "*batch 1 S 2"],
    key: PRNGKeyArray,
    first: int | Int[Array, ""],
    count: int,
) -> Float[Array, "*batch count S 2"]:
    """``begin``, a point beside it (in case it is singular), then uniform in theta and phi."""
    golden = jnp.pi * (3 - jnp.sqrt(5.0)) * jnp.arange(robot.n_segments)
    tilt = TILT * jnp.stack([jnp.cos(golden), jnp.sin(golden)], axis=-1)

    def draw(index: Int[Array, ""]) -> Float[Array, "S 2"]:
        unit = jax.random.uniform(jax.random.fold_in(key, index), (2, robot.n_segments))
        q = jnp.stack([unit[0] * robot.theta_max, unit[1] * 2 * jnp.pi], axis=-1)
        return bending_from_configuration(q.reshape(-1))

    drawn = jax.vmap(draw)(first + jnp.arange(count))
    drawn = jnp.broadcast_to(drawn, (*begin.shape[:-3], *drawn.shape))
    beside = _within_limits(robot, begin + tilt)
    return jnp.concatenate([begin, beside, drawn[..., 2:, :, :]], axis=-3)[..., :count, :, :]


class _At(NamedTuple):
    """What is known of a bending: its errors, and the full step from it."""

    step: Float[Array, "*batch S 2"]  # [rad]
    position: Float[Array, "*batch"]  # [m]
    angle: Float[Array, "*batch"]  # [rad]
    merit: Float[Array, "*batch"]


def _descend(
    robot: Robot,
    start: Float[Array, "*batch S 2"],
    target: Float[Array, "*#batch 4 4"],
    reference: Float[Array, "*#batch S 2"],
) -> tuple[Float[Array, "*batch S 2"], _At]:
    """The damped iteration of M Eq. 3 from every start, each until converged or stalled."""

    def running(at: _At, gain: Float[Array, "*batch"]) -> Bool[Array, "*batch"]:
        return ~_converged(at) & (gain >= LEAST_GAIN)

    def keep_going(state: Any) -> Bool[Array, ""]:
        iteration, _, at, gain = state
        return (iteration < ITERATIONS) & jnp.any(running(at, gain))

    def trial(state: Any) -> Any:
        iteration, b, at, gain = state
        tried = _within_limits(robot, b + gain[..., None, None] * at.step)
        there = _evaluate(robot, tried, target, reference)
        live = running(at, gain)
        descends = live & (there.merit < at.merit)  # false for NaN as well
        b, at = jax.tree.map(
            lambda new, old: jnp.where(_like(descends, new), new, old), (tried, there), (b, at)
        )
        next_gain = jnp.where(descends, jnp.minimum(1.0, 2 * gain), gain / 2)
        return iteration + 1, b, at, jnp.where(live, next_gain, gain)

    start = jnp.asarray(start)
    at = _evaluate(robot, start, target, reference)
    state = (0, start, at, jnp.ones_like(at.merit))
    _, b, at, _ = jax.lax.while_loop(keep_going, trial, state)
    return b, at


def _like(mask: Bool[Array, "*batch"], array: Array) -> Bool[Array, "..."]:
    return mask.reshape(mask.shape + (1,) * (array.ndim - mask.ndim))


def _evaluate(
    robot: Robot,
    b: Float[Array, "*batch S 2"],
    target: Float[Array, "*#batch 4 4"],
    reference: Float[Array, "*#batch S 2"],
) -> _At:
    """Errors at b and the full step J^+ e + (I - J^+ J) mu."""
    scale = 1 / jnp.sum(robot.length)
    pose = pose_from_bending(robot, b)
    offset = target[..., :3, 3] - pose[..., :3, 3]
    vee, angle = rotation_error(pose[..., :3, :3], target[..., :3, :3])
    position = jnp.linalg.norm(offset, axis=-1)
    merit = (scale * position) ** 2 + angle**2
    error = jnp.concatenate([scale * offset, vee], axis=-1)
    rows = jnp.array([1, 1, 1, 0, 0, 0]) * scale + jnp.array([0, 0, 0, 1, 1, 1])
    jac = rows[:, None] * bending_jacobian(robot, b, "mixed")
    free = _free_directions(robot, b, jnp.einsum("...ij,...i->...j", jac, error).reshape(b.shape))
    jac = jnp.einsum("...isx,...sxy->...isy", jac.reshape(*jac.shape[:-1], -1, 2), free)
    jac = jac.reshape(*jac.shape[:-2], -1)
    damping = DAMPING * merit
    if 2 * robot.n_segments <= 6:
        step = _damped_pseudo_inverse(jac, error, damping)
    else:
        pull = NULL_SPACE_PULL * jnp.minimum(1.0, jnp.sqrt(merit))[..., None, None]
        mu = pull * jnp.einsum("...sxy,...sy->...sx", free, reference - b)
        mu = mu.reshape(*merit.shape, -1)
        # J^+ e + (I - J^+ J) mu = mu + J^+ (e - J mu): one solve for both terms
        step = mu + _damped_pseudo_inverse(
            jac, error - jnp.einsum("...ij,...j->...i", jac, mu), damping
        )
    return _At(step.reshape(b.shape), position, angle, merit)


def _free_directions(
    robot: Robot, b: Float[Array, "*batch S 2"], pull: Float[Array, "*batch S 2"]
) -> Float[Array, "*batch S 2 2"]:
    """Projector onto the bending that is free to change, given the merit's descent direction.

    A segment at its limit that is pulled outwards only turns about its base. Without this, the
    update would rely on a bending that the limits then take away, and stall on the boundary.
    """
    theta = jnp.hypot(b[..., 0], b[..., 1])
    held = (theta >= robot.theta_max * (1 - 1e-12)) & (jnp.sum(b * pull, axis=-1) > 0)
    radial = jnp.where(held, 1 / jnp.where(held, theta, 1.0), 0.0)[..., None] * b
    return jnp.eye(2) - radial[..., :, None] * radial[..., None, :]


def _damped_pseudo_inverse(
    jac: Float[Array, "*batch 6 n"],
    error: Float[Array, "*batch 6"],
    damping: Float[Array, "*batch"],
) -> Float[Array, "*batch n"]:
    """J' (J J' + damping)^-1 e, equal to (J' J + damping)^-1 J' e: the smaller matrix is solved.

    NaN where that matrix is singular in spite of the damping; such a step does not descend.
    """
    transposed = jnp.swapaxes(jac, -1, -2)
    identity = jnp.eye(min(jac.shape[-2:]))
    floor = damping[..., None, None] * identity
    if jac.shape[-1] >= 6:
        solved = jnp.linalg.solve(jac @ transposed + floor, error[..., None])
        return (transposed @ solved)[..., 0]
    return jnp.linalg.solve(transposed @ jac + floor, transposed @ error[..., None])[..., 0]


def rotation_error(
    current: Float[Array, "*batch 3 3"], desired: Float[Array, "*#batch 3 3"]
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch"]]:
    """M Eq. 3: vee of (Ru' Rd - Rd' Ru) / 2 in the end-effector frame, and the true angle [rad].

    The vee is sin(angle) times the axis: it vanishes at 180 degrees as well. The angle is
    atan2(|vee|, (tr - 1) / 2), as an arccos returns 0 below 1e-8.
    """
    between = jnp.swapaxes(current, -1, -2) @ desired
    skew = 0.5 * (between - jnp.swapaxes(between, -1, -2))
    vee = jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    cosine = 0.5 * (jnp.trace(between, axis1=-2, axis2=-1) - 1)
    return vee, jnp.arctan2(jnp.linalg.norm(vee, axis=-1), cosine)


def _converged(at: _At) -> Bool[Array, "*batch"]:
    return (at.position < POSITION_TOLERANCE) & (at.angle < ORIENTATION_TOLERANCE)


def _within_limits(robot: Robot, b: Float[Array, "*batch S 2"]) -> Float[Array, "*batch S 2"]:
    """Each bending shortened to its limit."""
    theta = jnp.hypot(b[..., 0], b[..., 1])
    return b * jnp.where(theta > robot.theta_max, robot.theta_max / theta, 1.0)[..., None]


def _merit_of(robot: Robot, result: IkResult) -> Any:
    scale = robot.length.sum()
    return (result.position_error / scale) ** 2 + result.orientation_error**2
