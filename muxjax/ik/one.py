"""One configuration for each pose: the face ``solve_ik`` and the choice of its method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from muxjax.collision import CAPSULES, World, part_clearances
from muxjax.ik.checks import check_pose, check_reference
from muxjax.ik.descent import STARTS, solve_by_descent, solve_traced
from muxjax.ik.every import all_ik, is_exhaustive
from muxjax.ik.goals import check_weights
from muxjax.ik.implicit import attach_derivatives
from muxjax.ik.levenberg import MOST_SEGMENTS
from muxjax.ik.result import AllIkResult, IkResult, IkStatus
from muxjax.ik.seeded import bending_of, closest, from_table
from muxjax.precision import pad_rows
from muxjax.robot import Robot

Array = jax.Array | np.ndarray
Method = Literal["auto", "all", "levenberg_marquardt", "pseudo_inverse"]


def solve_ik(
    robot: Robot,
    pose: Float[Array, "*batch 4 4"],
    *,
    q0: Float[Array, "*#batch dof"] | None = None,
    world: World | None = None,
    weights: Float[Array, " 6"] | Sequence[float] | None = None,
    method: Method = "auto",
    key: PRNGKeyArray | None = None,
    starts: int = STARTS,
) -> IkResult:
    """One configuration for each tool pose, in float64: the nearest to a reference.

    Args:
        robot: The arm; its base and tool frames are included.
        pose: Homogeneous transforms [m], any leading batch axes. Rotations that are off by
            rounding (``checks.ROTATION_TOLERANCE``) are orthonormalised first.
        q0: Configuration [rad] to stay near, broadcast against the batch of poses; the straight
            arm by default. Near means in the Cartesian bending of all segments.
        world: Obstacles. Only clear solutions are chosen from; where all collide the one of least
            depth is returned, with ``converged`` false and status BLOCKED. Three segments only.
        weights: What of the pose counts, as ``goals`` describes: (1, 1, 1, 0, 0, 0) is a position,
            (1, 1, 1, 1, 1, 0) a position and the direction of the tool's z axis. Freedom that is
            left goes to the reference.
        method: ``"all"``: choose among all solutions (three segments only);
            ``"levenberg_marquardt"``: from the nearest poses of a table, any goal;
            ``"pseudo_inverse"``: the paper's iteration, whole poses only; ``"auto"``: the first
            of these that fits.
        key: JAX random key of the starts of ``"pseudo_inverse"``; ``jax.random.key(0)`` by
            default, so that the same call gives the same answer.
        starts: Descents a pose at most, for ``"pseudo_inverse"``.

    Returns:
        NumPy float64 arrays. A pose that was not reached has ``converged`` false and the closest
        configuration found, in the sum over (weight * error)^2 with positions over the arm's
        length.

    Inside a trace the paper's method runs from all starts in one round; derivatives are those
    of the implicit function theorem.

    Raises:
        ValueError: Wrong shape, not finite, not a rotation, a position so far away that its unit
            must be wrong, q0 beyond the limits, starts below 1, or a method that does not fit
            the goal; names the row of the batch. Also when traced in float32: set
            jax.config.update("jax_enable_x64", True).
    """
    if starts < 1:
        raise ValueError(f"starts: must be at least 1, found {starts}")
    if method not in get_args(Method):
        raise ValueError(f"method: must be one of {', '.join(get_args(Method))}, found {method!r}")
    wanted = check_weights(weights)
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((robot, pose, q0, key))):
        if world is not None:
            raise ValueError("world: the choice among all solutions cannot be traced")
        if method not in ("auto", "pseudo_inverse") or (wanted != 1).any():
            raise ValueError("solve_ik: a trace has only whole poses and method 'pseudo_inverse'")
        # Only tracers carry derivatives; the robot's NumPy leaves stay what they are.
        held, at, near = jax.tree.map(
            lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.core.Tracer) else x,
            (robot, pose, q0),
        )
        found = solve_traced(held, jnp.asarray(at), near, key, starts)
        return eqx.tree_at(
            lambda r: r.q, found, attach_derivatives(robot, jnp.asarray(pose), found.q)
        )
    poses = check_pose(robot, pose)
    batch = poses.shape[:-2]
    reference = check_reference(robot, q0, batch).reshape(-1, 2 * robot.n_segments)
    poses = poses.reshape(-1, 4, 4)
    host = jax.tree.map(lambda x: np.asarray(x, np.float64), robot)
    fitting = _fitting(host, method, wanted)
    if world is not None and fitting != "all":
        raise ValueError(
            f"world: needs method 'all', which looks at every solution, not {fitting!r}"
        )
    match fitting:
        case "all":
            flat = _from_all(host, poses, reference, world, key, starts)
        case "pseudo_inverse":
            flat = solve_by_descent(host, poses, reference, key, starts)
        case _:
            flat = from_table(host, poses, reference, wanted)
    return jax.tree.map(lambda x: x.reshape((*batch, *x.shape[1:])), flat)


def _fitting(robot: Robot, method: Method, weights: Float[np.ndarray, " 6"]) -> str:
    """The method that ``"auto"`` stands for, or the given one if it fits."""
    whole = bool((weights == 1).all())
    if method == "auto":
        if whole and is_exhaustive(robot):
            return "all"
        small = robot.n_segments <= MOST_SEGMENTS
        method = "pseudo_inverse" if whole and not small else "levenberg_marquardt"
    if method == "all" and not is_exhaustive(robot):
        raise ValueError("method: 'all' needs three segments that bend by at most 180 degrees")
    if method == "levenberg_marquardt" and robot.n_segments > MOST_SEGMENTS:
        raise ValueError(
            f"method: 'levenberg_marquardt' is for at most {MOST_SEGMENTS} segments, "
            f"the robot has {robot.n_segments}"
        )
    if method != "levenberg_marquardt" and not whole:
        raise ValueError(f"weights: method {method!r} is for whole poses, all weights 1")
    return method


def _from_all(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    reference: Float[np.ndarray, "rows dof"],
    world: World | None,
    key: PRNGKeyArray | None,
    starts: int,
) -> IkResult:
    """The nearest of all solutions; descents where there is none, or a continuum of them."""
    every = jax.tree.map(np.asarray, all_ik(robot, poses))
    solved = every.mask.any(axis=-1)
    away = np.sum((bending_of(every.q) - bending_of(reference)[:, None]) ** 2, axis=-1)
    parts = None if world is None else _parts(robot, every, world)
    if parts is not None:
        depth = np.minimum(parts.min(axis=-1), 0.0)
        # Any clear solution ranks before any that collides, and those by their depth.
        away = np.where(depth < 0, 1e6 - 1e6 * depth, away)
    # One more column, so that there is something to take where no pose has a solution.
    away = np.pad(np.where(every.mask, away, np.inf), ((0, 0), (0, 1)), constant_values=np.inf)
    choice, rows = np.argmin(away, axis=1), np.arange(len(poses))
    nearest = away[rows, choice]

    def taken(values: np.ndarray) -> np.ndarray:
        wide = np.pad(values, ((0, 0), (0, 1)) + ((0, 0),) * (values.ndim - 2))
        return wide[rows, choice]

    q, position, angle = map(taken, (every.q, every.position_error, every.orientation_error))
    q = np.where(solved[:, None], q, 0.0)
    result = closest(robot, poses, q, position, angle, solved)
    if parts is not None:
        found = np.where(solved[:, None], taken(parts), np.nan)
        return _with_clearance(result, found, solved)
    open_rows = np.flatnonzero(~solved | ~every.complete)
    if not len(open_rows):
        return result
    other = jax.tree.map(
        np.asarray, solve_by_descent(robot, poses[open_rows], reference[open_rows], key, starts)
    )
    distance = np.sum((bending_of(other.q) - bending_of(reference[open_rows])) ** 2, axis=-1)
    better = ~solved[open_rows] | (other.converged & (distance < nearest[open_rows]))
    for kept, new in zip(jax.tree.leaves(result), jax.tree.leaves(other), strict=True):
        kept[open_rows[better]] = new[better]
    return result


@jax.jit
def _part_clearances(robot: Robot, q: Float[Array, "n dof"], world: World) -> Float[Array, "n p"]:
    return part_clearances(robot, q, world)


def _parts(robot: Robot, every: AllIkResult, world: World) -> Float[np.ndarray, "rows K parts"]:
    """Signed distance of every capsule in every solution [m]; NaN where there is none."""
    mask = np.asarray(every.mask)
    q = np.asarray(every.q)[mask]
    found = np.full((*mask.shape, CAPSULES * robot.n_segments), np.nan)
    if len(q):
        with jax.enable_x64(True):
            found[mask] = np.asarray(_part_clearances(robot, pad_rows(q), world))[: len(q)]
    return found


def _with_clearance(
    result: IkResult, parts: Float[np.ndarray, "rows parts"], solved: np.ndarray
) -> IkResult:
    """What is known of the chosen solutions' distances; those that collide are BLOCKED."""
    least = parts.min(axis=-1)
    blocked = solved & (least < 0)
    # The first capsule stands in the mount and is left out; the last one is the tool's.
    place = np.where(solved, np.argmin(parts, axis=-1) + 1, 0)
    return eqx.tree_at(
        lambda r: (r.converged, r.status, r.clearance, r.nearest_segment),
        result,
        (
            solved & ~blocked,
            np.where(blocked, int(IkStatus.BLOCKED), result.status),
            least,
            np.where(solved, place // CAPSULES + 1, 0),
        ),
        is_leaf=lambda x: x is None,
    )
