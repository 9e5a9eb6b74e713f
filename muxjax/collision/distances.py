"""Signed distances of points to a world, on structures of arrays.

A point is three arrays x, y, z of any one shape. Each distance is the true one or less: that of
nearest obstacle, negative inside. Only a grid's may be more, by its cells (``grid_distance``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from muxjax.collision.sampled import Grid
from muxjax.collision.world import World
from muxjax.precision import matmul

Array = jax.Array
Point = tuple[Array, Array, Array]

FAR = 1e3  # [m], where there is nothing
_WRITTEN_OUT = 12  # obstacles of a kind, or pieces of a tube; more are looped over


def root(square: Array) -> Array:
    """Square root with gradient 0 at 0."""
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def exact_distance(world: World, at: Point) -> Array:
    """To all but the grids [m]; FAR if there are no others."""
    best = FAR + 0 * at[0]  # not a constant: see arm._points
    begin, along = jnp.asarray(world.round_from), jnp.asarray(world.round_to) - world.round_from
    best = _least(_to_round, (begin, along, jnp.asarray(world.round_radius)), at, best)
    frame = jnp.asarray(world.box_frame)
    best = _least(_to_box, (frame, jnp.asarray(world.box_half)), at, best)
    planes = (jnp.asarray(world.plane_point), jnp.asarray(world.plane_normal))
    best = _least(_to_plane, planes, at, best)
    for line, bore, wall in zip(world.tube_line, world.tube_bore, world.tube_wall, strict=True):
        best = jnp.minimum(best, _to_tube(jnp.asarray(line), bore, wall, at))
    return best


def point_distance(world: World, points: Any) -> Array:
    """Signed distance [m] of points (..., 3) to all obstacles; see ``grid_distance`` for grids."""
    points = jnp.asarray(points)
    at = (points[..., 0], points[..., 1], points[..., 2])
    best = exact_distance(world, at)
    for grid in world.grids:
        best = jnp.minimum(best, grid_distance(grid, at))
    return best


def _least(
    distance: Callable[[Any, Point], Array], items: tuple[Array, ...], at: Point, best: Array
) -> Array:
    """Minimum over obstacles of one kind."""
    if len(items[0]) <= _WRITTEN_OUT:
        for k in range(len(items[0])):
            best = jnp.minimum(best, distance(tuple(x[k] for x in items), at))
        return best

    def step(best: Array, item: Any) -> tuple[Array, None]:
        return jnp.minimum(best, distance(item, at)), None

    return lax.scan(step, best, items, unroll=_WRITTEN_OUT // 2)[0]


def _to_round(item: tuple[Array, ...], at: Point) -> Array:
    begin, along, radius = item
    square = matmul(along, along)
    x, y, z = (p - begin[k] for k, p in enumerate(at))
    t = (x * along[0] + y * along[1] + z * along[2]) * (1 / jnp.where(square > 0, square, 1.0))
    t = jnp.clip(t, 0.0, 1.0)
    x, y, z = (p - t * along[k] for k, p in enumerate((x, y, z)))
    return root(x * x + y * y + z * z) - radius


def _to_box(item: tuple[Array, ...], at: Point) -> Array:
    frame, half = item
    x, y, z = at
    local = [frame[k, 0] * x + frame[k, 1] * y + frame[k, 2] * z + frame[k, 3] for k in range(3)]
    over = [jnp.abs(p) - half[k] for k, p in enumerate(local)]
    outside = root(sum((jnp.maximum(o, 0.0) ** 2 for o in over), start=jnp.zeros(())))
    return outside + jnp.minimum(jnp.maximum(jnp.maximum(*over[:2]), over[2]), 0.0)


def _to_plane(item: tuple[Array, ...], at: Point) -> Array:
    point, normal = item
    x, y, z = (p - point[k] for k, p in enumerate(at))
    return x * normal[0] + y * normal[1] + z * normal[2]


def _to_tube(line: Array, bore: Any, wall: Any, at: Point) -> Array:
    """Of the wall of a tube: bore <= distance to the line (<= bore + wall, between open ends).

    In front of an open end the nearest place is on the rim, in cylinder coordinates about the
    first or last piece of the line.
    """
    along = line[1:] - line[:-1]
    length = root(jnp.sum(along * along, axis=1))
    unit = along / jnp.where(length > 0, length, 1.0)[:, None]
    # An end that is not open is far from being passed.
    order = jnp.arange(len(length))
    front = jnp.where(order == 0, 0.0, -FAR)
    back = jnp.where(order == len(length) - 1, 0.0, -FAR)
    best, sideways, over = _nearest_piece((line[:-1], unit, length, front, back), at)
    if wall is None:
        return bore - root(best)
    off = root(jnp.where(over > 0, sideways, best))
    inside = jnp.maximum(bore - off, off - bore - wall)  # of the wall, across it
    outside = root(jnp.maximum(inside, 0.0) ** 2 + jnp.maximum(over, 0.0) ** 2)
    return outside + jnp.minimum(jnp.maximum(inside, over), 0.0)


def _nearest_piece(pieces: tuple[Array, ...], at: Point) -> tuple[Array, Array, Array]:
    """The nearest piece of a line: square distance, square across it, way past an open end.

    Args:
        pieces: Where each begins, its direction, its length, and what is added to the way past
            its beginning and past its end, 0 at an open end.
        at: Points.
    """
    far = 0 * at[0]  # not a constant: see arm._points
    state = (far + FAR**2, far + FAR**2, far - FAR)

    def step(state: tuple[Array, Array, Array], piece: Any) -> tuple[Any, None]:
        start, unit, length, front, back = piece
        x, y, z = (p - start[i] for i, p in enumerate(at))
        t = x * unit[0] + y * unit[1] + z * unit[2]
        across = jnp.maximum(x * x + y * y + z * z - t * t, 0.0)
        beyond = t - jnp.clip(t, 0.0, length)
        square = across + beyond * beyond
        new = (square, across, jnp.maximum(front - t, back + t - length))
        nearer = square < state[0]
        return tuple(jnp.where(nearer, n, o) for n, o in zip(new, state, strict=True)), None

    if len(pieces[0]) > _WRITTEN_OUT:
        return lax.scan(step, state, pieces, unroll=_WRITTEN_OUT // 2)[0]
    for k in range(len(pieces[0])):
        state, _ = step(state, tuple(x[k] for x in pieces))
    return state


def half_diagonal_square(grid: Grid) -> Array:
    """Square [m^2] of half a cell's diagonal.

    Interpolating a distance d to a set gives at most sqrt(d^2 + this): each node's value is at
    most its distance to the place nearest to the point asked, the weights reproduce linear
    functions, and their mean square distance to the nodes is at most half the diagonal's square.
    """
    return 0.25 * jnp.sum(jnp.asarray(grid.spacing) ** 2)


def grid_distance(grid: Grid, at: Point) -> Array:
    """Trilinear interpolation [m]; see ``half_diagonal_square`` for what it may be too much.

    Outside the grid: where obstacles end with it, at least the way to the grid and the distance
    from there, at a right angle; elsewhere obstacles may begin at once, so that the way to the
    grid is taken off.
    """
    values = jnp.asarray(grid.values)
    counts = values.shape
    corner, part, away = [], [], jnp.zeros_like(at[0])
    for k, p in enumerate(at):
        place = (p - grid.origin[k]) / grid.spacing[k]
        inside = jnp.clip(place, 0.0, counts[k] - 1.0)
        cell = jnp.clip(jnp.floor(lax.stop_gradient(inside)), 0, counts[k] - 2)
        away = away + ((place - inside) * grid.spacing[k]) ** 2
        corner.append(cell.astype(jnp.int32))
        part.append(inside - cell)
    flat = values.reshape(-1)
    index = (corner[0] * counts[1] + corner[1]) * counts[2] + corner[2]

    def take(offset: int) -> Array:
        return jnp.take(flat, index + offset, mode="clip")

    rows = []
    for offset in (0, counts[2], counts[1] * counts[2], (counts[1] + 1) * counts[2]):
        low = take(offset)
        rows.append(low + part[2] * (take(offset + 1) - low))
    sheets = [rows[0] + part[1] * (rows[1] - rows[0]), rows[2] + part[1] * (rows[3] - rows[2])]
    value = sheets[0] + part[0] * (sheets[1] - sheets[0])
    if not grid.free:
        return value - root(away)
    aside = root(jnp.maximum(value, 0.0) ** 2 + away)
    return jnp.where(value > 0, aside, value + root(away))
