"""Choice among several configurations of one pose: by a cost, and clear of obstacles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from muxjax.collision import Tightest, World, bending_clearance, tightest
from muxjax.ik.descent import ORIENTATION_TOLERANCE, POSITION_TOLERANCE, solve_by_descent
from muxjax.ik.every import polar
from muxjax.ik.goals import tool_goals
from muxjax.ik.levenberg import levenberg
from muxjax.ik.result import AllIkResult
from muxjax.ik.seeded import bending_of
from muxjax.precision import pad_rows
from muxjax.robot import Robot

Array = jax.Array | np.ndarray
Prefer = str | Mapping[str, float]

TERMS = ("distance", "bending", "clearance")
DESCENTS = 6  # of the paper's method, each from another reference
CLIMBED = 6  # candidates a pose that are moved away from obstacles
CLIMBS = 24  # steps of that
FIRST_CLIMB = 0.15  # [rad]
BACK_STEPS = 10  # of Levenberg-Marquardt, back to the goal after each
_COLLIDES = 1e6  # cost before which any clear solution ranks


class Candidates(NamedTuple):
    """Configurations that reach their pose, K a row at most."""

    q: Float[np.ndarray, "rows K dof"]
    mask: Bool[np.ndarray, "rows K"]
    position: Float[np.ndarray, "rows K"]  # error [m]
    angle: Float[np.ndarray, "rows K"]  # error [rad]


class Chosen(NamedTuple):
    """The best candidate of each row; clearances are NaN without a world, or where none is."""

    solved: Bool[np.ndarray, " rows"]
    q: Float[np.ndarray, "rows dof"]
    position: Float[np.ndarray, " rows"]
    angle: Float[np.ndarray, " rows"]
    cost: Float[np.ndarray, " rows"]
    clearance: Float[np.ndarray, " rows"]  # [m]
    part: Float[np.ndarray, " rows"]
    point: Float[np.ndarray, "rows 3"]  # [m]


def check_prefer(prefer: object, world: World | None) -> dict[str, float]:
    """Weights of the terms of a preference.

    Raises:
        ValueError: An unknown term, a weight that is not finite or negative, all of them 0, or
            clearance without a world.
    """
    given = {prefer: 1.0} if isinstance(prefer, str) else prefer
    if not isinstance(given, Mapping):
        raise ValueError(f"prefer: must be a term or weights by term, found {prefer!r}")
    for name, weight in given.items():
        if name not in TERMS:
            raise ValueError(f"prefer: must be of {', '.join(TERMS)}, found {name!r}")
        if not isinstance(weight, int | float) or not 0 <= weight < np.inf:
            raise ValueError(f"prefer[{name!r}]: must be a number >= 0, found {weight!r}")
    weights = {name: float(weight) for name, weight in given.items() if weight}
    if not weights:
        raise ValueError("prefer: needs a weight above 0")
    if "clearance" in weights and world is None:
        raise ValueError("prefer: 'clearance' needs a world")
    return weights


def of_all(every: AllIkResult) -> Candidates:
    """Candidates that ``all_ik`` found."""
    found = (every.q, every.mask, every.position_error, every.orientation_error)
    return Candidates(*(np.asarray(x) for x in found))


def of_descents(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    reference: Float[np.ndarray, "rows dof"],
    key: PRNGKeyArray | None,
    starts: int,
) -> Candidates:
    """The paper's method near several references, the first of them the given one."""
    rng = np.random.default_rng(0)
    found = []
    for number in range(DESCENTS):
        near = reference
        if number:
            theta = rng.uniform(0, robot.theta_max, (len(poses), robot.n_segments))
            phi = rng.uniform(0, 2 * np.pi, theta.shape)
            near = np.stack([theta, phi], axis=-1).reshape(reference.shape)
        one = jax.tree.map(np.asarray, solve_by_descent(robot, poses, near, key, starts))
        found.append((one.q, one.converged, one.position_error, one.orientation_error))
    return Candidates(*(np.stack(x, axis=1) for x in zip(*found, strict=True)))


def choose(
    robot: Robot,
    found: Candidates,
    reference: Float[np.ndarray, "rows dof"],
    prefer: Mapping[str, float],
    world: World | None,
) -> Chosen:
    """The candidate of least cost; of those that collide the one of least depth.

    The cost is the sum of the weighted terms: squared distance in Cartesian bending from the
    reference [rad^2], squared bending [rad^2], and minus the clearance in lengths of the arm.
    """
    rows, width = found.mask.shape
    # One more column, so that there is something to take where no pose has a candidate.
    q, mask, position, angle = (
        np.pad(x, ((0, 0), (0, 1)) + ((0, 0),) * (x.ndim - 2)) for x in found
    )
    q = np.where(mask[..., None], q, 0.0)
    b = bending_of(q)
    cost = prefer.get("distance", 0.0) * np.sum((b - bending_of(reference)[:, None]) ** 2, axis=-1)
    cost = cost + prefer.get("bending", 0.0) * np.sum(b**2, axis=-1)
    near = Tightest(*(np.full((rows, width + 1, *more), np.nan) for more in ((), (), (3,))))
    if world is not None:
        for whole, part in zip(near, nearest(robot, q[mask], world), strict=True):
            whole[mask] = part
        cost = cost - prefer.get("clearance", 0.0) * near.clearance / np.sum(robot.length)
        cost = np.where(near.clearance < 0, _COLLIDES * (1 - near.clearance), cost)
    cost = np.where(mask, cost, np.inf)
    taken = np.arange(rows), np.argmin(cost, axis=1)
    own = (mask.any(axis=1), q[taken], position[taken], angle[taken], cost[taken])
    return Chosen(*(np.asarray(x) for x in (*own, *(np.asarray(x)[taken] for x in near))))


@jax.jit
def _tightest(robot: Robot, q: Float[Array, "n dof"], world: World) -> Tightest:
    return tightest(robot, q, world)


def nearest(robot: Robot, q: Float[np.ndarray, "n dof"], world: World) -> Tightest:
    """``tightest`` of any number of configurations, in float64."""
    with jax.enable_x64(True):
        found = _tightest(robot, pad_rows(q), world)
    return Tightest(*(np.asarray(x)[: len(q)] for x in found))


@jax.jit
def _uphill(robot: Robot, b: Float[Array, "n dof"], world: World) -> tuple[Array, Array]:
    def total(b: Array) -> tuple[Array, Array]:
        clear = bending_clearance(robot, b.reshape(len(b), -1, 2), world)
        return jnp.sum(clear), clear

    (_, clear), gradient = jax.value_and_grad(total, has_aux=True)(b)
    return clear, gradient


def climb(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    weights: Float[np.ndarray, " 6"],
    found: Candidates,
    world: World,
    enough: float,
) -> Candidates:
    """Candidates moved away from obstacles within the freedom that their goals leave.

    Each step goes up the gradient of the clearance and comes back to the goal by
    Levenberg-Marquardt, to the nearest configuration of that pose; it is kept if it is clearer.

    Args:
        robot: The arm.
        poses: Of every row.
        weights: Of the goals.
        found: Where to start; of each row the CLIMBED clearest.
        world: Obstacles.
        enough: Clearance [m] at which to stop; inf for the most that can be had.
    """
    rows = len(poses)
    at = np.where(found.mask[..., None], found.q, 0.0)
    clear = np.full(found.mask.shape, -np.inf)
    clear[found.mask] = nearest(robot, found.q[found.mask], world).clearance
    best = np.argsort(-clear, axis=1)[:, :CLIMBED]
    q = np.take_along_axis(at, best[..., None], axis=1)
    mask = np.take_along_axis(found.mask, best, axis=1)
    flat, live = bending_of(q).reshape(rows * best.shape[1], -1), mask.reshape(-1)
    errors = [np.take_along_axis(x, best, axis=1).reshape(-1) for x in found[2:]]
    size = np.full(len(flat), FIRST_CLIMB)
    with jax.enable_x64(True):
        goal = np.repeat(tool_goals(robot, poses), best.shape[1], axis=1)
        for _ in range(CLIMBS):
            height, slope = (np.asarray(x) for x in _uphill(robot, pad_rows(flat), world))
            height, slope = height[: len(flat)], slope[: len(flat)]
            norm = np.linalg.norm(slope, axis=1)
            going = np.flatnonzero(live & (height < enough) & (norm > 0) & (size > 1e-4))
            if not len(going):
                break
            tried = flat[going] + (size / np.maximum(norm, 1e-12))[going, None] * slope[going]
            back = levenberg(robot, tried.T, tried.T, goal[:, going], weights, BACK_STEPS)
            there, _ = _uphill(robot, pad_rows(back.b.T), world)
            better = _within(back.position, back.angle) & (
                np.asarray(there)[: len(going)] > height[going]
            )
            kept = going[better]
            flat[kept] = back.b.T[better]
            errors[0][kept], errors[1][kept] = back.position[better], back.angle[better]
            size[going] *= np.where(better, 1.5, 0.5)
    shape = best.shape
    return Candidates(
        polar(robot, flat).reshape(*shape, -1), mask, *(x.reshape(shape) for x in errors)
    )


def _within(position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return (position < POSITION_TOLERANCE) & (angle < ORIENTATION_TOLERANCE)
