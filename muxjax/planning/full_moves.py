"""The optimum of full moves, compiled: each tendon goes all the way in one step.

A state is the set of unfinished tendons, 2^(S J) of them. What a step costs depends on the state
and on the tendons that move, not on where the axial motor stands, except through the waiting: so
legs are priced once, compiled, layer by layer on a product grid, and a dynamic programme over the
number of unfinished tendons combines them with the axial positions: on the host for one problem,
compiled for a batch, which is the last axis. Servos, weights, start and target are traced: one
compilation serves every fault and every target.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.grid import layered_angles
from muxjax.planning.motion import LEG_POINTS, leg_time, relative_excess
from muxjax.planning.terms import CostTerm, Transition, transition_cost, waiting_time
from muxjax.robot import Robot

Array = jax.Array | np.ndarray

MOST_TENDONS = 12


def fits(robot: Robot) -> bool:
    """Whether the states are few, and all servos of an axial position sit on one layer."""
    layers = robot.axial_map // robot.tendons_per_segment
    return robot.n_tendons <= MOST_TENDONS and bool((layers == layers[:, :1]).all())


class Level(NamedTuple):
    """Steps from all states with the same number of unfinished tendons, through one layer."""

    edge: Int[Array, "states L"]  # which leg of the layer
    after: Int[Array, "states L"]  # place of the state after it
    moved: Int[Array, "states L"]  # its tendons within the layer, as bits
    here: Int[Array, "states 1"]  # unfinished tendons of the layer, as bits
    exists: Bool[Array, "states L"]  # the others are padding


@dataclass(frozen=True, eq=False)
class Tables:
    """What depends on the counts alone. States stand in the order of their unfinished tendons.

    A state's number is read in base 2^J, first layer first; the bits of a digit are the
    unfinished tendons of that layer.
    """

    n_segments: int
    j: int
    leg_before: Int[np.ndarray, " legs"]  # digits before and after the legs of a layer
    leg_after: Int[np.ndarray, " legs"]
    place: Int[np.ndarray, " states"]  # of each state
    first: Int[np.ndarray, " levels"]  # place of the first state of each level
    levels: tuple[tuple[Level, ...], ...]  # [level - 1][layer]
    legs_of: tuple[Level, ...]  # [layer], for every state, by place


@lru_cache
def tables(n_segments: int, j: int) -> Tables:
    """Tables for S layers of J tendons."""
    base = 2**j
    pairs = [(x, y) for x in range(base) for y in range(x) if y & ~x == 0]
    before, after = (np.array(side) for side in zip(*pairs, strict=True))
    digits = np.stack(np.unravel_index(np.arange(base**n_segments), (base,) * n_segments), axis=-1)
    count = np.array([int(d).bit_count() for d in range(base)])[digits].sum(axis=-1)
    order = np.argsort(count, kind="stable")
    place = np.argsort(order, kind="stable")
    first = np.searchsorted(count[order], np.arange(n_segments * j + 2))
    legs_of = tuple(
        _legs(digits[order], layer, before, after, place) for layer in range(n_segments)
    )
    levels = []
    for level in range(1, n_segments * j + 1):
        rows = slice(first[level], first[level + 1])
        widest = max(int(table.exists[rows].sum(axis=1).max()) for table in legs_of)
        levels.append(
            tuple(
                Level(*(a[rows, : a.shape[1] if a.shape[1] == 1 else widest] for a in table))
                for table in legs_of
            )
        )
    return Tables(n_segments, j, before, after, place, first, tuple(levels), legs_of)


def _legs(
    digits: Int[np.ndarray, "states S"],
    layer: int,
    before: Int[np.ndarray, " legs"],
    after: Int[np.ndarray, " legs"],
    place: Int[np.ndarray, " states"],
) -> Level:
    """Every state's legs through one layer."""
    n_states, n_segments = digits.shape
    base, widest = int(before.max()) + 1, int(before.max())
    edge, then, moved = (np.zeros((n_states, widest), dtype=np.int64) for _ in range(3))
    exists = np.zeros((n_states, widest), dtype=bool)
    shape = [base] * n_segments
    shape[layer] = len(before)
    for number, digit in enumerate(digits):
        for slot, leg in enumerate(np.flatnonzero(before == digit[layer])):
            through, to = digit.copy(), digit.copy()
            through[layer], to[layer] = leg, after[leg]
            edge[number, slot] = np.ravel_multi_index(tuple(through), shape)
            then[number, slot] = place[np.ravel_multi_index(tuple(to), (base,) * n_segments)]
            moved[number, slot] = digit[layer] & ~after[leg]
            exists[number, slot] = True
    return Level(edge, then, moved, digits[:, layer, None], exists)


def number(unfinished: Bool[np.ndarray, "*n SJ"], j: int) -> Int[np.ndarray, "*n"]:
    """Number of the state in which these tendons are unfinished."""
    digits = unfinished.reshape(*unfinished.shape[:-1], -1, j) @ (1 << np.arange(j))
    base = (2**j) ** np.arange(digits.shape[-1])[::-1]
    return np.asarray(digits @ base)


class EdgeCosts(NamedTuple):
    """Cost of the legs of one layer; the last axis is the batch."""

    stay: Float[Array, "edges batch"]
    switch: Float[Array, "edges batch"]
    engage: Float[Array, "edges batch"]  # a first step where the drum already stands


@jax.jit
def edge_costs(
    robot: Robot,
    terms: tuple[CostTerm, ...],
    weights: Float[Array, " T"],
    start: Float[Array, "SJ batch"],
    end: Float[Array, "SJ batch"],
    target: Float[Array, "SJ batch"],
) -> tuple[EdgeCosts, ...]:
    """Costs of every leg of each layer."""
    table = tables(robot.n_segments, robot.tendons_per_segment)
    bits = (np.arange(2**table.j)[:, None, None] >> np.arange(table.j)[:, None]) & 1
    starts, ends, targets = (
        x.reshape(table.n_segments, 1, table.j, -1) for x in (start, end, target)
    )
    corners = list(jnp.where(bits == 1, starts, ends))
    at_corners = layered_angles(robot, corners)
    goal = jnp.stack([a.reshape(-1) for a in layered_angles(robot, [*targets])], axis=-1)
    costs = []
    for layer in range(table.n_segments):
        leg = _legs_of_layer(robot, table, layer, corners, at_corners, goal)
        defined = jnp.all(jnp.isfinite(leg.theta_after), axis=-1)

        def cost(
            repositions: float, engages: float, leg: Transition = leg, defined: Array = defined
        ) -> Array:
            flags = jnp.full_like(leg.repositions, repositions)
            wait = waiting_time(robot, flags, jnp.full_like(flags, engages))
            moved = leg._replace(repositions=flags, wait=wait)
            value = transition_cost(robot, terms, weights, moved)
            value = jnp.where(defined & jnp.isfinite(value), value, jnp.inf)
            return value.reshape(-1, value.shape[-1])

        costs.append(EdgeCosts(cost(0.0, 0.0), cost(1.0, 0.0), cost(0.0, 1.0)))
    return tuple(costs)


def _legs_of_layer(
    robot: Robot,
    table: Tables,
    layer: int,
    corners: list[Array],
    at_corners: list[Array],
    goal: Float[Array, "batch S"],
) -> Transition:
    """Every leg of a layer, with the others at every corner, yet without any waiting.

    The compiler drops what no term looks at.
    """
    begin, finish = (corners[layer][d] for d in (table.leg_before, table.leg_after))
    before, after = (
        _displacements([*corners[:layer], side, *corners[layer + 1 :]]) for side in (begin, finish)
    )
    theta_before, theta_after = (
        [a if i < layer else jnp.take(a, side, axis=layer) for i, a in enumerate(at_corners)]
        for side in (table.leg_before, table.leg_after)
    )
    zero = jnp.zeros(before.shape[:-1])

    # A loop, so that what a point adds stays in a core's cache.
    def point(found: tuple[Any, Any], fraction: Any) -> tuple[tuple[Any, Any], Any]:
        along = begin + fraction * (finish - begin)
        theta = layered_angles(robot, [*corners[:layer], along, *corners[layer + 1 :]])
        excess = _excess(theta, goal)
        return (found[0] + excess, jnp.maximum(found[1], excess)), _stacked(theta)

    fractions = (np.arange(LEG_POINTS) + 0.5) / LEG_POINTS
    (total, peak), theta_along = jax.lax.scan(point, (zero, zero), fractions)
    duration = leg_time(robot, jnp.moveaxis(finish - begin, 1, -1))
    return Transition(
        before=before,
        after=after,
        repositions=zero,
        wait=zero,
        duration=_spread(duration, layer, zero.shape),
        goal=goal,
        theta_before=_stacked(theta_before),
        theta_after=_stacked(theta_after),
        theta_along=jnp.moveaxis(theta_along, 0, -2),
        excess_before=_excess(theta_before, goal),
        excess_mean=total / LEG_POINTS,
        excess_peak=peak,
    )


def _excess(angles: list[Array], goal: Float[Array, "batch S"]) -> Array:
    """Relative excess, each segment's on the grid up to its layer before they are added up."""
    each = (relative_excess(a[..., None], goal[:, i : i + 1]) for i, a in enumerate(angles))
    return sum(_whole([*each]), start=jnp.zeros(()))


def _stacked(angles: list[Array]) -> Array:
    return jnp.stack(_whole(angles), axis=-1)


def _whole(values: list[Array]) -> list[Array]:
    """Values of each segment, on the grid up to its layer, spread over the whole grid."""
    *grid, batch = values[-1].shape
    return [
        jnp.broadcast_to(
            a.reshape(*a.shape[:-1], *(1,) * (len(grid) + 1 - a.ndim), batch), (*grid, batch)
        )
        for a in values
    ]


def _spread(values: Float[Array, "_ batch"], layer: int, shape: tuple[int, ...]) -> Array:
    """Values at the points of one layer, spread over the whole grid."""
    *grid, batch = shape
    at = values.reshape(*(n if k == layer else 1 for k, n in enumerate(grid)), batch)
    return jnp.broadcast_to(at, shape)


def _displacements(points: list[Array]) -> Array:
    """Of all tendons on the whole grid."""
    shape = (*(len(p) for p in points), points[0].shape[-1])
    columns = [
        _spread(column, layer, shape)
        for layer, p in enumerate(points)
        for column in jnp.moveaxis(p, 1, 0)
    ]
    return jnp.stack(columns, axis=-1)


def values(
    robot: Robot,
    edges: tuple[EdgeCosts, ...],
    healthy: Bool[Array, " J"],
    whole: Bool[Array, ""],
    xp: Any,
) -> Float[Array, "states A batch"]:
    """Cost to go from each state (by place) at each axial position.

    Args:
        robot: The arm.
        edges: By layer.
        healthy: Which servos are available.
        whole: A step moves all that it reaches and that still has to move; else any subset.
        xp: ``numpy``, or ``jax.numpy`` in compiled code.
    """
    table = tables(robot.n_segments, robot.tendons_per_segment)
    axials, reach = reach_by_layer(robot, healthy, xp)
    back = np.argsort(np.concatenate(axials))
    everywhere = [
        allowed(*both, whole)[..., None] for both in zip(table.legs_of, reach, strict=True)
    ]
    value = xp.zeros((1, len(robot.axial_map), edges[0].stay.shape[-1]))
    for number, level in enumerate(table.levels, start=1):
        rows = slice(table.first[number], table.first[number + 1])
        stays, switches = [], []
        for layer, steps in enumerate(level):
            may = everywhere[layer][rows, : steps.exists.shape[1]]
            after = xp.where(may, value[:, axials[layer]][steps.after], xp.inf)
            stays.append(xp.min(edges[layer].stay[steps.edge][:, :, None] + after, axis=1))
            onwards = edges[layer].switch[steps.edge] + xp.min(after, axis=2)
            switches.append(xp.min(onwards, axis=1))
        elsewhere = xp.min(xp.stack(switches), axis=0)
        stay = xp.concatenate(stays, axis=1)[:, back]
        value = xp.concatenate([value, xp.minimum(stay, elsewhere[:, None])])
    return value


@jax.jit
def costs_from_start(
    robot: Robot,
    edges: tuple[EdgeCosts, ...],
    unfinished: Int[Array, " batch"],
    axial: Int[Array, ""],
    healthy: Bool[Array, " J"],
    whole: Bool[Array, ""],
) -> Float[Array, " batch"]:
    """Cost of the optimum of each problem of a batch.

    Args:
        robot: The arm, which ``fits``.
        edges: Costs of the legs, by layer.
        unfinished: Number of the start's state.
        axial: Axial position at the start, counting from 0; -1 where it is not known.
        healthy: Which servos are available.
        whole: A step moves all that it reaches and that still has to move; else any subset.
    """
    table = tables(robot.n_segments, robot.tendons_per_segment)
    axials, reach = reach_by_layer(robot, healthy, jnp)
    value = values(robot, edges, healthy, whole, jnp)

    def one(value: Array, edges: tuple[EdgeCosts, ...], state: Array) -> Array:
        best = jnp.where(state == 0, 0.0, jnp.inf)
        for layer, everywhere in enumerate(table.legs_of):
            steps = Level(*(jnp.asarray(a)[state][None] for a in everywhere))
            may = allowed(steps, reach[layer], whole)[0]
            after = value[steps.after[0]][:, axials[layer]]
            _, switch, engage = (c[steps.edge[0]][:, None] for c in edges[layer])
            # The first step may engage without repositioning.
            through = jnp.where(axials[layer] == axial, engage, switch) + after
            best = jnp.minimum(best, jnp.min(jnp.where(may, through, jnp.inf)))
        return best

    return jax.vmap(one, in_axes=(-1, -1, 0))(value, edges, jnp.asarray(table.place)[unfinished])


def reach_by_layer(
    robot: Robot, healthy: Bool[Array, " J"], xp: Any
) -> tuple[list[np.ndarray], list[Int[Array, " a"]]]:
    """Axial positions at each layer, and the tendons met there by healthy servos, as bits."""
    layer_of, within = np.divmod(robot.axial_map, robot.tendons_per_segment)
    bits = xp.sum(xp.where(healthy, 1 << within, 0), axis=1)
    axials = [np.flatnonzero(layer_of[:, 0] == layer) for layer in range(robot.n_segments)]
    return axials, [bits[a] for a in axials]


def allowed(
    steps: Level, reach: Int[Array, " a"], whole: Bool[Array, ""]
) -> Bool[Array, "states L a"]:
    """Which steps may be taken from which of the layer's axial positions."""
    moved, here = steps.moved[..., None], steps.here[..., None]
    all_of_it, some = moved == (reach & here), (moved & ~reach) == 0
    return steps.exists[..., None] & ((whole & all_of_it) | (~whole & some))
