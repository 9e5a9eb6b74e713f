"""One configuration for each pose: the face ``solve_ik`` and the choice of its method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from muxjax.collision import World
from muxjax.ik.checks import check_pose, check_reference
from muxjax.ik.clear import (
    Candidates,
    Chosen,
    Prefer,
    check_prefer,
    choose,
    climb,
    of_all,
    of_descents,
)
from muxjax.ik.descent import STARTS, solve_by_descent, solve_traced
from muxjax.ik.every import all_ik, is_exhaustive
from muxjax.ik.goals import check_weights
from muxjax.ik.implicit import attach_derivatives
from muxjax.ik.levenberg import MOST_SEGMENTS
from muxjax.ik.result import IkResult, IkStatus
from muxjax.ik.seeded import bending_of, closest, from_table
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
    prefer: Prefer = "distance",
    method: Method = "auto",
    key: PRNGKeyArray | None = None,
    starts: int = STARTS,
    project_rotations: bool = False,
) -> IkResult:
    """One configuration for each tool pose, in float64: the nearest to a reference, or the best.

    Args:
        robot: The arm; its base and tool frames are included.
        pose: Homogeneous transforms [m], any leading batch axes. Rotations that are off by
            rounding (``checks.ROTATION_TOLERANCE``) are orthonormalised first.
        q0: Configuration [rad] to stay near, broadcast against the batch of poses; the straight
            arm by default. Near means in the Cartesian bending of all segments.
        world: Obstacles. Only clear solutions are chosen from. Where a goal leaves freedom and
            no solution found is clear, they are moved away from the obstacles within it. If all
            still collide, the one of least depth is returned, with ``converged`` false, status
            BLOCKED and where it touches.
        weights: What of the pose counts, as ``goals`` describes: (1, 1, 1, 0, 0, 0) is a position,
            (1, 1, 1, 1, 1, 0) a position and the direction of the tool's z axis. Freedom that is
            left goes to the reference.
        prefer: What is best among several solutions: ``"distance"`` from q0, least ``"bending"``,
            most ``"clearance"`` (with a world), or weights of these by name; ``clear.choose``
            has their units. Anything but the distance alone looks at several solutions.
        method: ``"all"``: choose among all solutions (three segments only);
            ``"levenberg_marquardt"``: from the nearest poses of a table, any goal;
            ``"pseudo_inverse"``: the paper's iteration, whole poses only; ``"auto"``: the first
            of these that fits.
        key: JAX random key of the starts of ``"pseudo_inverse"``; ``jax.random.key(0)`` by
            default, so that the same call gives the same answer.
        starts: Descents a pose at most, for ``"pseudo_inverse"``.
        project_rotations: Take the nearest rotation where a matrix is not quite one.

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
    wanted, liked = check_weights(weights), check_prefer(prefer, world)
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((robot, pose, q0, key))):
        if world is not None:
            raise ValueError("world: the choice among several solutions cannot be traced")
        if liked.keys() != {"distance"}:
            raise ValueError("prefer: a trace has only the distance")
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
    poses = check_pose(robot, pose, project_rotations)
    batch = poses.shape[:-2]
    reference = check_reference(robot, q0, batch).reshape(-1, 2 * robot.n_segments)
    poses = poses.reshape(-1, 4, 4)
    host = jax.tree.map(lambda x: np.asarray(x, np.float64), robot)
    fitting = _fitting(host, method, wanted)
    search = _Search(host, poses, reference, wanted, fitting, key, starts)
    flat = _nearest(search) if world is None and liked.keys() == {"distance"} else None
    flat = _best(search, liked, world) if flat is None else flat
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


class _Search(NamedTuple):
    """What one call looks for, and how."""

    robot: Robot
    poses: Float[np.ndarray, "rows 4 4"]
    reference: Float[np.ndarray, "rows dof"]
    weights: Float[np.ndarray, " 6"]
    method: str
    key: PRNGKeyArray | None
    starts: int

    def only(self, rows: np.ndarray) -> _Search:
        """The search for some of the poses."""
        return self._replace(poses=self.poses[rows], reference=self.reference[rows])


def _nearest(search: _Search) -> IkResult:
    """One solution a pose, near the reference."""
    robot, poses, reference = search[:3]
    match search.method:
        case "all":
            return _from_all(search)
        case "pseudo_inverse":
            return solve_by_descent(robot, poses, reference, search.key, search.starts)
        case _:
            return from_table(robot, poses, reference, search.weights)


def _from_all(search: _Search) -> IkResult:
    """The nearest of all solutions; from the table where none or a continuum is found."""
    robot, poses, reference, weights = search[:4]
    every = all_ik(robot, poses)
    chosen = choose(robot, of_all(every), reference, {"distance": 1.0}, None)
    result = _result(search, chosen)
    open_rows = np.flatnonzero(~chosen.solved | ~np.asarray(every.complete))
    if not len(open_rows):
        return result
    other = from_table(robot, poses[open_rows], reference[open_rows], weights)
    other = jax.tree.map(np.asarray, other)
    distance = np.sum((bending_of(other.q) - bending_of(reference[open_rows])) ** 2, axis=-1)
    better = ~chosen.solved[open_rows] | (other.converged & (distance < chosen.cost[open_rows]))
    for kept, new in zip(jax.tree.leaves(result), jax.tree.leaves(other), strict=True):
        kept[open_rows[better]] = new[better]
    return result


def _best(search: _Search, prefer: Mapping[str, float], world: World | None) -> IkResult:
    """The best of several solutions; where none is found, the closest to the pose."""
    robot, poses, reference, weights = search[:4]
    found, free = _several(search)
    chosen = _copied(choose(robot, found, reference, prefer, world))
    if world is not None:
        enough = np.inf if "clearance" in prefer else 0.0
        rows = np.flatnonzero(chosen.solved & free & ~(chosen.clearance >= enough))
        if len(rows):
            part = Candidates(*(x[rows] for x in found))
            moved = climb(robot, poses[rows], weights, part, world, enough)
            again = choose(robot, moved, reference[rows], prefer, world)
            better = again.cost < chosen.cost[rows]
            for kept, new in zip(chosen, again, strict=True):
                kept[rows[better]] = new[better]
    result = _result(search, chosen)
    open_rows = np.flatnonzero(~chosen.solved)
    if len(open_rows):
        other = jax.tree.map(np.asarray, _nearest(search.only(open_rows)))
        for kept, new in zip(jax.tree.leaves(result), jax.tree.leaves(other), strict=True):
            kept[open_rows] = new
        late = open_rows[other.converged]
        if len(late):  # the search for one solution is more thorough than that for several
            errors = (result.position_error, result.orientation_error)
            alone = Candidates(
                *(np.asarray(x)[late, None] for x in (result.q, result.converged, *errors))
            )
            for kept, new in zip(
                chosen, choose(robot, alone, reference[late], prefer, world), strict=True
            ):
                kept[late] = new
    return result if world is None else _with_clearance(result, chosen)


def _several(search: _Search) -> tuple[Candidates, np.ndarray]:
    """Solutions of each pose, and whether they have freedom to move."""
    robot, poses, reference, weights = search[:4]
    free = 2 * robot.n_segments > int((weights > 0).sum())
    if robot.n_segments > MOST_SEGMENTS:
        found = of_descents(robot, poses, reference, search.key, search.starts)
        return found, np.zeros(len(poses), bool)
    every = all_ik(robot, poses, weights=weights)
    return of_all(every), free | (is_exhaustive(robot) & ~np.asarray(every.complete))


def _copied(chosen: Chosen) -> Chosen:
    return Chosen(*(np.array(x) for x in chosen))


def _result(search: _Search, chosen: Chosen) -> IkResult:
    return closest(
        search.robot, search.poses, chosen.q, chosen.position, chosen.angle, chosen.solved
    )


def _with_clearance(result: IkResult, chosen: Chosen) -> IkResult:
    """What is known of the chosen solutions' distances; those that collide are BLOCKED."""
    blocked = chosen.solved & (chosen.clearance < 0)
    return eqx.tree_at(
        lambda r: (r.converged, r.status, r.clearance, r.nearest_segment, r.nearest_point),
        result,
        (
            chosen.solved & ~blocked,
            np.where(blocked, int(IkStatus.BLOCKED), result.status),
            chosen.clearance,
            np.where(chosen.solved, np.nan_to_num(chosen.part), 0).astype(int),
            chosen.point,
        ),
        is_leaf=lambda x: x is None,
    )
