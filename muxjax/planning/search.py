"""The layered beam, compiled: one level of partial plans after the other.

A level's plans all have the same number of steps. Their children are priced, those that lead to
the same state are reduced to the cheapest, and the most promising go on. Shapes depend on the
robot, the width and padded sizes only (``arrays.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.arrays import BoundArrays, LatticeArrays
from muxjax.planning.motion import bending_angles
from muxjax.planning.terms import CostTerm, Traced, step, transition_cost
from muxjax.robot import Robot

Array = Any  # jax.Array | np.ndarray; mypy knows no operators of their union


class States(NamedTuple):
    """What a value function sees of partial plans."""

    displacements: Float[Array, "N SJ"]  # [m]
    remaining: Int[Array, "N SJ"]  # steps that each tendon has to go
    stop: Int[Array, " N"]  # -1 = unknown
    axial: Int[Array, " N"]  # axial position from 1, 0 = unknown
    bound: Float[Array, " N"]  # admissible bound on the cost to go


ValueFunction = Callable[[States], Float[Array, " N"]]
"""Estimated cost to go: a JAX function. An ``equinox.Module``'s arrays are traced."""

_SHORTLIST = 4  # times the width: plans, by promise, that a value function puts in order
_SHORTEST = 16  # but no fewer than this: a narrow beam is cheap, and needs the order most
_HASHED = 4  # places in the table of states for every child
_ROUNDS = 2  # of reducing equal states; in each, few are missed because their places collide


class Level(NamedTuple):
    """Partial plans of equal length; a row each, those that do not exist cost infinitely much."""

    remaining: Int[Array, "N SJ"]
    stop: Int[Array, " N"]
    cost: Float[Array, " N"]
    parent: Int[Array, " N"]  # row in the level above
    action: Int[Array, " N"]


class Found(NamedTuple):
    """Result of a search."""

    cost: Float[Array, ""]  # of the best plan: the one given, or a better one
    length: Int[Array, ""]  # its steps; 0 if it is the one given
    parent: Int[Array, ""]  # row, in the level above, of its last step's begin
    action: Int[Array, ""]  # its last step
    cut_off: Float[Array, ""]  # least promise of what was cut off
    expansions: Int[Array, ""]
    negative: Bool[Array, ""]  # a cost term was negative
    parents: Int[Array, "levels width"]  # of every plan that was kept
    actions: Int[Array, "levels width"]


@partial(jax.jit, static_argnames=("rows", "levels"))
def search(
    robot: Robot,
    terms: tuple[CostTerm, ...],
    weights: Float[Array, " T"],
    expensive: tuple[CostTerm, ...],
    expensive_weights: Float[Array, " E"],
    lattice: LatticeArrays,
    bound: BoundArrays,
    value: Traced | None,
    width: Int[Array, ""],
    best: Float[Array, ""],
    *,
    rows: int,
    levels: int,
) -> Found:
    """Search with at most ``width`` plans a level, ``width`` <= ``rows``, for one below ``best``.

    Args:
        robot: The arm.
        terms: Cost terms that are asked about every child.
        weights: Their weights.
        expensive: Those that are asked only about children that would otherwise be kept.
        expensive_weights: Their weights.
        lattice: States and actions.
        bound: Admissible bound.
        value: Orders children in its place, or None: see ``beamstep.ValueFunction``.
        width: Plans kept at each level.
        best: Cost of a known plan.
        rows: Room for plans.
        levels: Room for levels; no plan of the lattice has more steps.
    """
    goal = bending_angles(robot, lattice.target)
    n_tendons = lattice.moves.shape[1]

    def children(level: Level, first: Array) -> Level:
        """Every child of every plan: (rows * G)."""
        made = lattice.moved(level.remaining)
        before = lattice.displacements(level.remaining)[:, None]
        after = lattice.displacements(level.remaining[:, None] - made)

        def cost(repositions: float) -> Array:
            flags = jnp.full(made.shape[:-1], repositions)
            moved = step(robot, before, after - before, flags, (1.0 - flags) * first, goal)
            price = transition_cost(robot, terms, weights, moved)
            defined = jnp.all(jnp.isfinite(moved.theta_after), axis=-1) & jnp.isfinite(price)
            return jnp.where(defined & jnp.any(made > 0, axis=-1), price, jnp.inf)

        stays = level.stop[:, None] == lattice.action_stop
        of_action = lattice.action_move
        price = jnp.where(stays, cost(0.0)[:, of_action], cost(1.0)[:, of_action])
        price = jnp.where(lattice.action_exists, price, jnp.inf)
        shape = price.shape
        return Level(
            (level.remaining[:, None] - made[:, of_action]).reshape(-1, n_tendons),
            jnp.broadcast_to(lattice.action_stop, shape).reshape(-1),
            (level.cost[:, None] + price).reshape(-1),
            jnp.broadcast_to(jnp.arange(shape[0], dtype=jnp.int32)[:, None], shape).reshape(-1),
            jnp.broadcast_to(jnp.arange(shape[1], dtype=jnp.int32), shape).reshape(-1),
        )

    def asked_price(level: Level, chosen: Level, first: Array) -> Array:
        """What the expensive terms add to the last steps of some children."""
        remaining = level.remaining[chosen.parent]
        before = lattice.displacements(remaining)
        after = lattice.displacements(chosen.remaining)
        flags = (chosen.stop != level.stop[chosen.parent]).astype(before.dtype)
        moved = step(robot, before, after - before, flags, (1.0 - flags) * first, goal)
        price = transition_cost(robot, expensive, expensive_weights, moved)
        return jnp.where(jnp.isfinite(price), price, jnp.inf)

    def ranked(kids: Level, to_go: Array, best: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Rows that go on, whether each exists; the best that arrives, whether; all promises."""
        done = ~jnp.any(kids.remaining > 0, axis=-1)
        promise = kids.cost + to_go
        alive = ~done & (promise < best)
        if rows > 1:  # the children of one plan all lead to other states
            alive = _cheapest(kids, alive)
        promise = jnp.where(alive, promise, jnp.inf)
        kept, exists = _first(kids, promise, to_go, lattice, value, width, rows)
        arrival = jnp.where(done, kids.cost, jnp.inf)
        arriving = jnp.argmin(arrival)
        return kept, exists, arriving, arrival[arriving] < best, promise

    def with_expensive(level: Level, kids: Level, to_go: Array, first: Array, best: Array) -> Level:
        """Children with the expensive terms' price, as far as they would be kept or arrive."""

        def ask(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            cost, asked, _ = carry
            now = kids._replace(cost=cost)
            kept, exists, arriving, arrives, _ = ranked(now, to_go, best)
            chosen = jnp.append(kept, arriving)
            wanted = jnp.append(exists, arrives) & ~asked[chosen]
            price = jax.lax.cond(
                jnp.any(wanted),
                lambda: asked_price(level, Level(*(x[chosen] for x in now)), first),
                lambda: jnp.zeros(rows + 1, cost.dtype),
            )
            cost = cost.at[chosen].add(jnp.where(wanted, price, 0.0))
            return cost, asked.at[chosen].max(wanted), jnp.any(wanted)

        start = (kids.cost, jnp.zeros(len(kids.cost), bool), jnp.ones((), bool))
        cost, _, _ = jax.lax.while_loop(lambda carry: carry[-1], ask, start)
        return kids._replace(cost=cost)

    def advance(state: tuple[Level, Found, Array]) -> tuple[Level, Found, Array]:
        level, found, number = state
        first = (number == 0).astype(found.cost.dtype)
        kids = children(level, first)
        to_go = bound(lattice, kids.remaining, kids.stop)
        if expensive:
            kids = with_expensive(level, kids, to_go, first, found.cost)
        kept, exists, arriving, arrives, promise = ranked(kids, to_go, found.cost)
        cut = jnp.min(promise.at[kept].set(jnp.where(exists, jnp.inf, promise[kept])))
        below = Level(*(x[kept] for x in kids))
        found = Found(
            cost=jnp.where(arrives, kids.cost[arriving], found.cost),
            length=jnp.where(arrives, number + 1, found.length),
            parent=jnp.where(arrives, kids.parent[arriving], found.parent),
            action=jnp.where(arrives, kids.action[arriving], found.action),
            cut_off=jnp.minimum(found.cut_off, cut),
            expansions=found.expansions + jnp.sum(jnp.isfinite(level.cost), dtype=jnp.int32),
            negative=found.negative | jnp.any(kids.cost < level.cost[kids.parent]),
            parents=found.parents.at[number].set(below.parent),
            actions=found.actions.at[number].set(below.action),
        )
        return below._replace(cost=jnp.where(exists, below.cost, jnp.inf)), found, number + 1

    def goes_on(state: Any) -> Array:
        level, _, number = state
        return (number < levels) & jnp.any(jnp.isfinite(level.cost))

    nothing = jnp.zeros((), jnp.int32)
    root = Level(
        jnp.broadcast_to(lattice.steps, (rows, n_tendons)),
        jnp.broadcast_to(lattice.start_stop, (rows,)),
        jnp.full(rows, jnp.inf).at[0].set(jnp.where(jnp.any(lattice.steps > 0), 0.0, jnp.inf)),
        jnp.zeros(rows, jnp.int32),
        jnp.zeros(rows, jnp.int32),
    )
    found = Found(
        best,
        *(nothing, nothing, nothing),
        jnp.inf * jnp.ones_like(best),
        nothing,
        jnp.zeros((), bool),
        *(jnp.zeros((levels, rows), jnp.int32),) * 2,
    )
    return jax.lax.while_loop(goes_on, advance, (root, found, nothing))[1]


def _cheapest(kids: Level, alive: Bool[Array, " N"]) -> Bool[Array, " N"]:
    """Which rows are the cheapest of those that are alive in their state; few are missed."""
    n = len(kids.cost)
    row, size = jnp.arange(n, dtype=jnp.int32), 1 << (_HASHED * n - 1).bit_length()
    states = jnp.column_stack([kids.remaining, kids.stop]).astype(jnp.uint32)
    for seed in range(_ROUNDS):
        factors = np.random.default_rng(seed).integers(2**32, size=states.shape[1]) | 1
        mixed = jnp.sum(states * jnp.asarray(factors, jnp.uint32), axis=-1, dtype=jnp.uint32)
        place = (mixed >> (33 - size.bit_length())).astype(jnp.int32)
        cost = jnp.where(alive, kids.cost, jnp.inf)
        least = jnp.full(size, jnp.inf).at[place].min(cost)
        leader = jnp.where(alive & (cost == least[place]), row, n)
        first = jnp.full(size, n, jnp.int32).at[place].min(leader)[place]
        same = jnp.all(states[first] == states, axis=-1)
        alive = alive & ~(same & (first != row))
    return alive


def _first(
    kids: Level,
    promise: Float[Array, " N"],
    to_go: Float[Array, " N"],
    lattice: LatticeArrays,
    value: Traced | None,
    width: Int[Array, ""],
    rows: int,
) -> tuple[Int[Array, " rows"], Bool[Array, " rows"]]:
    """The rows that go on, as many as ``width``, and whether each of them exists."""
    n = len(promise)
    if value is None:
        least, kept = _lowest(promise, min(rows, n))
    else:
        least, few = _lowest(promise, min(max(_SHORTLIST * rows, _SHORTEST), n))
        remaining, stop = kids.remaining[few], kids.stop[few]
        at = lattice.displacements(remaining)
        order = kids.cost[few] + value(States(at, remaining, stop, lattice.axial[stop], to_go[few]))
        longest = jnp.maximum(_SHORTLIST * width, _SHORTEST)
        hopeful = jnp.isfinite(least) & (jnp.arange(len(few)) < longest)
        least, best = _lowest(jnp.where(hopeful, order, jnp.inf), min(rows, n))
        kept = few[best]
    exists = jnp.isfinite(least) & (jnp.arange(len(kept)) < width)
    short = (0, rows - len(kept))
    return jnp.pad(kept, short), jnp.pad(exists, short)


def _lowest(values: Float[Array, " N"], count: int) -> tuple[Float[Array, " k"], Int[Array, " k"]]:
    """The lowest values and their rows, the lower row first among equals."""
    # Single precision is sorted much faster, and what it ties is as good either way.
    _, rows = jax.lax.top_k(-values.astype(jnp.float32), count)
    return values[rows], rows
