"""Clearance of an arm: the least signed distance to obstacles and to itself.

The arm is everything within ``body_radius`` of its backbone, after its mount; the tool is what the
world says, or a capsule of the same radius to the tool point. The backbone is asked at POINTS
places a segment, and what it may come nearer between them is taken off: if the least distance D
is that of a place between two points, the way to the obstacle leaves the backbone there at a right
angle, and a point at most e away along an arc of curvature k is at a distance d with

    d^2 <= D^2 + e^2 + k e^2 D

(k e^2 / 2 is how far the arc bends away), hence D >= sqrt(d^2 - E^2) with E^2 = e^2 + k e^2 d. An
axis inside an obstacle has D >= d - E. So no clearance is more than the true one as long as the
axis itself is outside obstacles, and near a contact it is E^2 / 2 d less: 0.4 mm for a straight
MuxArm, 0.7 mm for its tightest bends.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from muxjax.collision.distances import (
    FAR,
    Point,
    exact_distance,
    grid_distance,
    half_diagonal_square,
    root,
)
from muxjax.collision.world import World
from muxjax.kinematics import bending_from_configuration
from muxjax.precision import by_device, check_last_axis, matmul
from muxjax.robot import Robot

Array = jax.Array | np.ndarray
Frame = list[list[Any]]  # rows of [R p], each entry an array

POINTS = 16  # a segment
MOUNT = 2  # of these, in the first segment, stand in the arm's mount and do not count
TOOL_SPACING = 0.01  # between points of the tool's line [m]
# Places nearer to each other along the arm than this many body radii do not count as touching:
# a bend so tight would be the discs' own limit.
NEIGHBOURS = np.pi
CHUNK = 2048  # configurations at a time, for the cache
CHUNK_ELSEWHERE = 1 << 17  # on a GPU
_TERMS = 16  # of the series below: the first one left out is below 1e-17 up to 360 degrees
_LEAST = 1e-12  # added to E^2 [m^2]


class Rows(NamedTuple):
    """Points of the arm, one a row, for N configurations."""

    x: Float[jax.Array, "rows N"]  # [m], in the world
    y: Float[jax.Array, "rows N"]
    z: Float[jax.Array, "rows N"]
    square: Float[jax.Array, "rows 1"]  # e^2 [m^2]
    sag: Float[jax.Array, "rows N"]  # k e^2 [m]
    radius: Float[jax.Array, "rows 1"]  # [m]
    arc: Float[jax.Array, " rows"]  # place along the backbone [m]


class Tightest(NamedTuple):
    """Where an arm is nearest to an obstacle or to itself."""

    clearance: Float[Array, "*batch"]  # [m]
    part: Int[Array, "*batch"]  # segment from 1; one more than the last is the tool
    point: Float[Array, "*batch 3"]  # on the arm's axis, in the world [m]


def clearance(robot: Robot, q: Float[Array, "*batch dof"], world: World) -> Float[Array, "*batch"]:
    """Least signed distance [m] of the arm to the world's obstacles and to itself.

    Never more than the true one while the arm's axis is outside obstacles, and less by a
    millimetre at most near contact (the top of ``collision/arm.py`` derives it; grids add
    their own cells'). Deeper, it is minus a depth that is right to half a point's spacing.
    Differentiable almost everywhere; traceable; the precision is that of q.

    Args:
        robot: The arm; ``body_radius`` is its radius. The first eighth of its first segment
            stands in the mount and does not count.
        q: Configuration [rad].
        world: Obstacles, and what the tool carries.
    """
    return _clearance(robot, _bending(robot, q), world)


def bending_clearance(
    robot: Robot, b: Float[Array, "*batch S 2"], world: World
) -> Float[Array, "*batch"]:
    """``clearance`` of Cartesian bending b [rad], differentiable at the straight arm as well."""
    b = jnp.asarray(b)
    return _clearance(robot, b.reshape(*b.shape[:-2], -1), world)


def part_clearances(
    robot: Robot, q: Float[Array, "*batch dof"], world: World
) -> Float[Array, "*batch parts"]:
    """Signed distance [m] of each segment and of the tool with what it carries.

    Two parts that touch each other count at the outer one.
    """
    return _in_chunks(robot, _least_by_part(robot, world), _bending(robot, q))


def tightest(robot: Robot, q: Float[Array, "*batch dof"], world: World) -> Tightest:
    """Clearance, and where it is that: the segment or tool, and the point of its axis."""

    def look(columns: jax.Array) -> jax.Array:
        parts, clear = _by_part(robot, columns, world)
        number = np.repeat(np.arange(len(clear)), [len(c) for c in clear]) + 1.0
        every = jnp.concatenate(clear)
        row = jnp.argmin(every, axis=0)
        chosen = [
            jnp.take_along_axis(jnp.concatenate(x), row[None], axis=0)[0]
            for x in ([p.x for p in parts], [p.y for p in parts], [p.z for p in parts])
        ]
        return jnp.stack([jnp.min(every, axis=0), jnp.asarray(number, every.dtype)[row], *chosen])

    found = _in_chunks(robot, look, _bending(robot, q))
    return Tightest(found[..., 0], found[..., 1].astype(int), found[..., 2:])


def _clearance(robot: Robot, b: jax.Array, world: World) -> jax.Array:
    def least(columns: jax.Array) -> jax.Array:
        return _least(robot, columns, world)[None]

    return _in_chunks(robot, least, b)[..., 0]


@jax.custom_jvp
def _least(
    robot: Robot, columns: Float[jax.Array, "dof N"], world: World
) -> Float[jax.Array, " N"]:
    """Clearance of each column.

    Its derivative is that of the tightest row alone: differentiating the minimum over all rows
    would take XLA minutes to compile.
    """
    clear = _by_part(robot, columns, world)[1]
    return functools.reduce(jnp.minimum, [jnp.min(x, axis=0) for x in clear])


@_least.defjvp
def _least_jvp(primals, tangents):  # type: ignore[no-untyped-def]
    clear = jnp.concatenate(_by_part(*primals)[1])
    row = lax.stop_gradient(jnp.argmin(clear, axis=0))
    return jax.jvp(functools.partial(_row_clearance, row=row), primals, tangents)


def _row_clearance(
    robot: Robot, columns: Float[jax.Array, "dof N"], world: World, row: Int[jax.Array, " N"]
) -> Float[jax.Array, " N"]:
    """Clearance of one row for each column, from the world and from the parts further in."""
    parts = [p._replace(arc=p.arc[:, None]) for p in arm_rows(robot, columns, world)]
    number = np.repeat(np.arange(len(parts)), [len(part.x) for part in parts])
    every = Rows(
        *(
            jnp.concatenate([jnp.broadcast_to(part[k], part.x.shape) for part in parts])
            for k in range(len(Rows._fields))
        )
    )
    own = Rows(*(jnp.take_along_axis(x, row[None], axis=0) for x in every))
    outside = _from_world(world, own)[0]
    mine = jnp.asarray(number)[row]
    inner = jnp.asarray(number)[:, None] < mine + (_is_wide(robot) & (mine < robot.n_segments))
    apart = NEIGHBOURS * jnp.asarray(robot.body_radius, columns.dtype)
    slack = jnp.sqrt(every.square) + jnp.sqrt(own.square)
    counts = inner & (own.arc - every.arc >= apart - slack)
    x, y, z = own.x - every.x, own.y - every.y, own.z - every.z
    away = root(jnp.where(counts, x * x + y * y + z * z, FAR**2))
    between = _sure(away, slack**2, every.sag + own.sag) - every.radius - own.radius
    nearest = lax.stop_gradient(jnp.argmin(between, axis=0))
    inside = jnp.take_along_axis(between, nearest[None], axis=0)[0]
    return jnp.minimum(outside, inside)


def _is_wide(robot: Robot) -> bool:
    """Whether a segment may bend by more than half a turn, and so touch itself."""
    return max(s.theta_max_deg.value for s in robot.config.segments) > 180


def _least_by_part(robot: Robot, world: World) -> Callable[[jax.Array], jax.Array]:
    def least(columns: jax.Array) -> jax.Array:
        return jnp.stack([jnp.min(x, axis=0) for x in _by_part(robot, columns, world)[1]])

    return least


def _bending(robot: Robot, q: Array) -> jax.Array:
    """Cartesian bending (..., 2S) of configurations."""
    q = jnp.asarray(q)
    check_last_axis("q", q.shape, 2 * robot.n_segments)
    return jnp.asarray(bending_from_configuration(q)).reshape(q.shape)


def _in_chunks(robot: Robot, measure: Callable[[jax.Array], jax.Array], b: jax.Array) -> jax.Array:
    """``measure`` of (2S, N) columns, for any batch; large ones piece by piece."""
    rows = b.reshape(-1, 2 * robot.n_segments)
    count, size = len(rows), by_device(CHUNK, CHUNK_ELSEWHERE)
    if count <= size:
        result = measure(rows.T).T
    else:
        padded = jnp.pad(rows, ((0, -count % size), (0, 0)))
        pieces = padded.reshape(-1, size, rows.shape[1])
        result = lax.map(lambda piece: measure(piece.T), pieces)
        result = jnp.swapaxes(result, 1, 2).reshape(len(padded), -1)[:count]
    return result.reshape(*b.shape[:-1], -1)


def _by_part(robot: Robot, columns: jax.Array, world: World) -> tuple[list[Rows], list[jax.Array]]:
    """Points of each segment and of the tool, and their clearances."""
    parts = arm_rows(robot, columns, world)
    clear = [_from_world(world, part) for part in parts]
    wide = _is_wide(robot)
    for j, outer in enumerate(parts):
        # Points of one arc of at most 180 degrees that are far enough apart along it to count are
        # at least two radii apart: its chord is 2 R sin(g / 2 R) >= 2 r for g >= pi r, R >= r.
        for inner in parts[: j + (wide and j < robot.n_segments)]:
            clear[j] = jnp.minimum(clear[j], _from_other(robot, inner, outer))
    return parts, clear


def arm_rows(robot: Robot, columns: Float[jax.Array, "dof N"], world: World) -> list[Rows]:
    """Points along each segment, and of the tool."""
    dtype = columns.dtype
    length = jnp.asarray(robot.length, dtype)
    radius = jnp.asarray(robot.body_radius, dtype)
    bx, by = columns[0::2], columns[1::2]
    fraction = jnp.arange(1, POINTS + 1, dtype=dtype) / POINTS
    points, frame = _points(robot, length, bx, by, fraction)
    spacing = length / POINTS
    theta = root(bx * bx + by * by)
    sag = 0.25 * spacing[:, None] * theta / POINTS  # (theta / L) (spacing / 2)^2
    parts: list[Rows] = []
    start = jnp.zeros((), dtype)
    for i in range(robot.n_segments):
        first = MOUNT - 1 if i == 0 else 0
        x, y, z = (p[i, first:] for p in points)
        ones = jnp.ones((POINTS - first, 1), dtype)
        arc = start + length[i] * fraction[first:]
        parts.append(
            Rows(x, y, z, 0.25 * spacing[i] ** 2 * ones, ones * sag[i], radius * ones, arc)
        )
        start = start + length[i]
    tool = _tool_rows(robot, world, frame, start, radius)
    return [*parts, tool] if tool is not None else parts


def _points(
    robot: Robot,
    length: Float[jax.Array, " S"],
    bx: Float[jax.Array, "S N"],
    by: Float[jax.Array, "S N"],
    fraction: Float[jax.Array, " k"],
) -> tuple[Point, Frame]:
    """Points at fractions of every segment, each (S, k, N) [m], and the last disc's frame.

    A point is at p = L f sinc h (sinc h f b / 2, cos h) in its segment's proximal frame, with
    h = f |b| / 2 half the angle there. A loop over segments, because XLA would otherwise compute
    the frame again for each point.
    """
    base = jnp.asarray(robot.base, bx.dtype)
    # Made of bx, so that inside shard_map the loop's state varies over devices from the start.
    begin = [[base[i, k] + 0 * bx[0] for k in range(4)] for i in range(3)]
    quarter = 0.25 * (bx * bx + by * by)
    sinc, up = _half_angle(quarter)
    end_x, end_y = 0.5 * sinc * bx, 0.5 * sinc * by

    def step(frame: Frame, item: Any) -> tuple[Frame, Point]:
        length, bx, by, quarter, ex, ey, up = item
        sinc, cos = _half_angle(quarter * fraction[:, None] ** 2)
        reach = length * fraction[:, None] * sinc
        across = 0.5 * reach * sinc * fraction[:, None]
        x, y, z = _seen_from(frame, (across * bx, across * by, reach * cos))
        turn = [
            [1 - 2 * ex * ex, -2 * ex * ey, 2 * up * ex],
            [-2 * ex * ey, 1 - 2 * ey * ey, 2 * up * ey],
            [-2 * up * ex, -2 * up * ey, 2 * up * up - 1],
        ]
        end = (x[-1], y[-1], z[-1])
        after = [
            [sum(frame[r][m] * turn[m][k] for m in range(3)) for k in range(3)] + [end[r]]
            for r in range(3)
        ]
        return after, (x, y, z)

    frame, points = lax.scan(step, begin, (length, bx, by, quarter, end_x, end_y, up))
    return points, frame


def _half_angle(square: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sinc and cos of h for h^2, by their series: no transcendental function a point."""
    sinc = cos = jnp.ones_like(square)
    for n in reversed(range(1, _TERMS)):
        sinc = 1 - square * sinc * (1 / (2 * n * (2 * n + 1)))
        cos = 1 - square * cos * (1 / (2 * n * (2 * n - 1)))
    return sinc, cos


def _seen_from(frame: Frame, local: Point) -> Point:
    """Points of a frame in the world."""
    x, y, z = (row[0] * local[0] + row[1] * local[1] + row[2] * local[2] + row[3] for row in frame)
    return x, y, z


def _tool_rows(
    robot: Robot, world: World, frame: Frame, start: jax.Array, radius: jax.Array
) -> Rows | None:
    """Points of the tool's line and what it carries; None where there is neither."""
    dtype = radius.dtype
    tool = jnp.asarray(robot.tool, dtype)
    balls, sizes, squares = (
        jnp.asarray(x, dtype) for x in (world.carried, world.carried_radius, world.carried_slack)
    )
    balls = matmul(balls, tool[:3, :3].T) + tool[:3, 3]
    squares = squares**2
    offset = np.array(robot.config.tool_frame.xyz_m)
    if world.tool_line and offset.any():
        parts = int(np.ceil(np.linalg.norm(offset) / TOOL_SPACING))
        fraction = jnp.arange(1, parts + 1, dtype=dtype)[:, None] / parts
        balls = jnp.concatenate([fraction * tool[:3, 3], balls])
        sizes = jnp.concatenate([jnp.full(parts, radius), sizes])
        own = jnp.sum(tool[:3, 3] ** 2) * (0.5 / parts) ** 2
        squares = jnp.concatenate([jnp.full(parts, own), squares])
    if not len(balls):
        return None
    x, y, z = _seen_from(frame, (balls[:, 0, None], balls[:, 1, None], balls[:, 2, None]))
    away = start + root(jnp.sum(balls**2, axis=-1))
    return Rows(x, y, z, squares[:, None], jnp.zeros_like(x), sizes[:, None], away)


def _sure(distance: jax.Array, square: jax.Array, sag: jax.Array) -> jax.Array:
    """What is left of a sampled distance: sqrt(d^2 - E^2), bounded below without a kink at d = E.

    With t = E / d, sqrt(1 - t^2) >= 1 - t^2 (1 + t^2) / 2; both end at 0 for d = E.
    """
    slack = jnp.sqrt(square + sag * jnp.maximum(distance, 0.0) + _LEAST)
    t = slack / jnp.maximum(distance, slack)
    return distance - 0.5 * slack * t * (1 + t * t)


def _from_world(world: World, rows: Rows) -> jax.Array:
    at = (rows.x, rows.y, rows.z)
    clear = _sure(exact_distance(world, at), rows.square, rows.sag)
    for grid in world.grids:
        square = rows.square + half_diagonal_square(grid)
        clear = jnp.minimum(clear, _sure(grid_distance(grid, at), square, rows.sag))
    return clear - rows.radius


def _from_other(robot: Robot, inner: Rows, outer: Rows) -> jax.Array:
    """Of the outer part's points from the inner part's, where these are not its neighbours."""
    slack = jnp.sqrt(inner.square[:, 0]), jnp.sqrt(outer.square[:, 0])
    apart = NEIGHBOURS * jnp.asarray(robot.body_radius)
    best = jnp.full_like(outer.x, FAR**2)
    for k in range(len(inner.x)):
        x, y, z = outer.x - inner.x[k], outer.y - inner.y[k], outer.z - inner.z[k]
        counts = outer.arc - inner.arc[k] >= apart - slack[0][k] - slack[1]
        best = jnp.minimum(best, jnp.where(counts[:, None], x * x + y * y + z * z, FAR**2))
    square = (jnp.max(slack[0]) + slack[1][:, None]) ** 2
    clear = _sure(root(best), square, outer.sag + inner.sag[:1])
    return clear - inner.radius[0] - outer.radius
