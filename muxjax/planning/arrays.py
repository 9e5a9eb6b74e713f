"""A lattice and its bound as arrays, for compiled searches.

Everything that differs between two problems of one robot (targets, steps, servos, weights, pattern
databases) is data, padded to sizes that many problems share: so one compilation serves them all.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.lattice import Lattice

Array = Any  # jax.Array | np.ndarray; mypy knows no operators of their union

# Least rooms: larger than most problems need, so that these share a compilation.
_STEPS, _MOVES, _ACTIONS, _LEVELS = 32, 96, 32, 256
_STATES, _VALUES = 2**12, 2**14


class LatticeArrays(NamedTuple):
    """States and actions. M: most steps of a tendon; V: different moves; G: actions."""

    end: Float[Array, " SJ"]  # displacements [m] when nothing remains
    way: Float[Array, "SJ M"]  # from a tendon's end [m], signed, by its remaining steps
    target: Float[Array, " SJ"]  # [m]
    steps: Int[Array, " SJ"]  # at the start
    start_stop: Int[Array, ""]  # -1: not known
    moves: Int[Array, "V SJ"]  # steps of each tendon; rows of zeros are padding
    whole: Bool[Array, ""]  # a move takes what remains of its tendons, else only all of itself
    action_move: Int[Array, " G"]
    action_stop: Int[Array, " G"]
    action_exists: Bool[Array, " G"]
    axial: Int[Array, " stops"]  # axial position, from 1, of a stop; the last one is 0, unknown

    def displacements(self, remaining: Int[Array, "*n SJ"]) -> Float[Array, "*n SJ"]:
        """Displacements [m] of states."""
        return self.end + self.way[jnp.arange(self.way.shape[0]), remaining]

    def moved(self, remaining: Int[Array, "N SJ"]) -> Int[Array, "N V SJ"]:
        """Steps that each tendon makes in each move; none where the move is not possible."""
        made = jnp.minimum(self.moves, remaining[:, None, :])
        possible = self.whole | jnp.all(made == self.moves, axis=-1)
        return jnp.where(possible[..., None], made, 0)


class Needs(NamedTuple):
    """What is still needed, by layer (or by what else may share a step); a row a state."""

    way: list[Float[Array, " N"]]  # of all its tendons [m]
    shortest: list[Float[Array, " N"]]  # of the servos, if they could always work together [m]
    visits: list[Int[Array, " N"]]  # beyond the present one
    state: list[Int[Array, " N"]]  # number of the layer's state


class PatternArrays(NamedTuple):
    """A pattern database. P: states of a layer; a layout is the order of some stops' values."""

    value: Float[Array, " values"]
    begin: Int[Array, " stops"]  # of the stop's values; the last one is for no stop
    layout: Int[Array, " stops"]
    place: Int[Array, "layouts S P"]  # offset by a layer's state
    toll: Float[Array, "layouts S P"]  # to be added, by a layer's state
    visits: Int[Array, " S"]  # that values tell apart
    visit: Int[Array, " S"]  # offset by a visit
    counted: Float[Array, " S"]  # price of a visit that values hold and the bound counts too

    def __call__(self, needs: Needs, stop: Int[Array, " N"], xp: Any) -> Float[Array, " N"]:
        """Bound on what the count leaves out, at states."""
        at, layout = self.begin[stop], self.layout[stop]
        more = 0.0
        for layer, (visits, state) in enumerate(zip(needs.visits, needs.state, strict=True)):
            at = at + self.place[layout, layer, state]
            at = at + xp.minimum(visits, self.visits[layer]) * self.visit[layer]
            more = more + self.toll[layout, layer, state] - self.counted[layer] * visits
        return self.value[at] + more


class BoundArrays(NamedTuple):
    """An admissible bound (``bounds.AdmissibleBound``): weights, and what they multiply."""

    travel: Float[Array, ""]
    stop: Float[Array, ""]  # of a stop: switch and repositioning time
    second: Float[Array, ""]
    last: Float[Array, ""]  # bending of the last step
    speed: Float[Array, ""]  # of a tendon [m/s]
    reach: Bool[Array, "stops SJ"]  # the last row, of no stop, is empty
    servos: Int[Array, ""]  # most tendons in a step
    layer_index: Int[Array, "S J"]  # of a remaining step in a layer's states
    patterns: tuple[PatternArrays, ...]

    def needs(
        self, lattice: LatticeArrays, remaining: Int[Array, "N SJ"], stop: Int[Array, " N"], xp: Any
    ) -> Needs:
        """What states need."""
        # A column a tendon: whole rows of memory for the compiler, which short axes are not.
        left, here = remaining.T, self.reach[stop].T
        way = [xp.abs(lattice.way[c][k]) for c, k in enumerate(left)]
        per_layer = self.layer_index.shape[1]
        needs = Needs([], [], [], [])
        for index, first in zip(self.layer_index, range(0, len(way), per_layer), strict=True):
            tendons = range(first, first + per_layer)
            needs.way.append(sum(way[c] for c in tendons))
            longest = reduce(xp.maximum, [way[c] for c in tendons])
            needs.shortest.append(xp.maximum(longest, needs.way[-1] / self.servos))
            elsewhere = sum(((left[c] > 0) & ~here[c]).astype(stop.dtype) for c in tendons)
            needs.visits.append(-(-elsewhere // self.servos))
            needs.state.append(sum(left[c] * index[c - first] for c in tendons))
        return needs

    def __call__(
        self,
        lattice: LatticeArrays,
        remaining: Int[Array, "N SJ"],
        stop: Int[Array, " N"],
        xp: Any = jnp,
    ) -> Float[Array, " N"]:
        """Bound at states; with ``xp=numpy`` on the host."""
        needs = self.needs(lattice, remaining, stop, xp)
        more = self.last * xp.any(remaining > 0, axis=-1)
        for pattern in self.patterns:
            more = xp.maximum(more, pattern(needs, stop, xp))
        return (
            self.travel * sum(needs.way)
            + self.stop * sum(needs.visits)
            + self.second * sum(needs.shortest) / self.speed
            + more
        )


def lattice_arrays(lattice: Lattice) -> LatticeArrays:
    """States and actions of a lattice."""
    robot, steps = lattice.robot, lattice.steps
    stops, counts = lattice.actions
    moves, move = np.unique(counts, axis=0, return_inverse=True)
    most = int(steps.max(initial=0))
    left = np.minimum(np.arange(_room(most + 1, _STEPS)), steps[:, None])
    at = np.stack([lattice.displacements(column) for column in left.T], axis=-1)
    every = robot.n_segments * (2**robot.tendons_per_segment - 1)
    actions = _room(len(stops), _ACTIONS)
    found = LatticeArrays(
        end=at[:, 0],
        way=at - at[:, :1],
        target=lattice.problem.target,
        steps=steps,
        start_stop=np.asarray(lattice.start_stop),
        moves=_padded(moves, _room(len(moves), min(every, _MOVES))),
        whole=np.asarray(lattice.problem.action_set == "all"),
        action_move=_padded(move.reshape(-1), actions),
        action_stop=_padded(stops, actions),
        action_exists=_padded(np.ones(len(stops), bool), actions),
        axial=_padded(lattice.axial_of(np.arange(len(lattice.reach))), len(robot.axial_map) + 1),
    )
    return jax.tree.map(_short, found)


def _room(n: int, least: int, factor: int = 2) -> int:
    """Least, or the next larger one by a power of the factor."""
    while least < n:
        least *= factor
    return least


def _padded(array: np.ndarray, size: int) -> np.ndarray:
    return np.pad(array, ((0, size - len(array)), *((0, 0),) * (array.ndim - 1)))


def level_room(lattice: Lattice) -> int:
    """Room for the levels of a search: a plan has at most as many steps as its tendons."""
    return _room(int(lattice.steps.sum()), _LEVELS)


def pattern_arrays(
    lattice: Lattice,
    value: Float[np.ndarray, " values"],
    begin: Int[np.ndarray, " known"],
    layout: Int[np.ndarray, " known"],
    place: list[list[Int[np.ndarray, " _"]]],
    *,
    toll: list[list[Float[np.ndarray, " _"]]] | None = None,
    visits: Int[np.ndarray, " layers"] | None = None,
    visit: Int[np.ndarray, " layers"] | None = None,
    counted: float = 0.0,
) -> PatternArrays:
    """A pattern database of the first layers of a lattice.

    Args:
        lattice: The problem on the robot.
        value: All values.
        begin: Of each stop's values; the last one is for no stop.
        layout: Of each stop's values, likewise.
        place: By layout and layer, the offset by the layer's state.
        toll: What is to be added to a value, likewise.
        visits: That values tell apart, by layer.
        visit: Offset by a visit, by layer.
        counted: Price of a visit, of the layers known, that values hold and the bound counts too.
    """
    s, layers = lattice.robot.n_segments, len(place[0])
    states = _room(max(len(p) for row in place for p in row), _STATES, 16)
    stops = len(lattice.robot.axial_map) + 1
    places, tolls = np.zeros((2, len(place), s, states))
    for (i, row), (j, _) in product(enumerate(place), enumerate(place[0])):
        places[i, j, : len(row[j])] = row[j]
        if toll is not None:
            tolls[i, j, : len(row[j])] = toll[i][j]

    def of_stops(known: np.ndarray) -> np.ndarray:
        return np.append(known, np.full(stops - len(known), known[-1]))

    def of_layers(known: np.ndarray | None) -> np.ndarray:
        return np.zeros(s, int) if known is None else np.append(known, np.zeros(s - layers, int))

    return PatternArrays(
        value=_padded(value, _room(len(value), _VALUES, 16)),
        begin=_short(of_stops(begin)),
        layout=_short(of_stops(layout)),
        place=_short(places.astype(np.int64)),
        toll=tolls,
        visits=_short(of_layers(visits)),
        visit=_short(of_layers(visit)),
        counted=np.where(np.arange(s) < layers, counted, 0.0),
    )


def bound_arrays(
    lattice: Lattice, weights: Mapping[str, float], last: float, patterns: list[PatternArrays]
) -> BoundArrays:
    """A bound.

    Args:
        lattice: The problem on the robot.
        weights: Of the terms that it knows.
        last: Bending of the target [rad^2].
        patterns: Databases that know more of bending, switches and overshoot.
    """
    robot = lattice.robot
    steps = lattice.steps.reshape(robot.n_segments if lattice.one_layer_a_step else 1, -1)
    index = np.ones_like(steps)
    index[:, :-1] = np.cumprod(steps[:, :0:-1] + 1, axis=1)[:, ::-1]
    seconds = weights.get("time", 0.0)
    return BoundArrays(
        travel=_short(weights.get("travel", 0.0)),
        stop=_short(weights.get("switches", 0.0) + float(robot.switch_time) * seconds),
        second=_short(seconds),
        last=_short(weights.get("bending", 0.0) * last),
        speed=_short(robot.tendon_speed),
        reach=_padded(lattice.reach, len(robot.axial_map) + 1),
        servos=_short(lattice.reach.sum(axis=-1).max()),
        layer_index=_short(index),
        patterns=tuple(patterns),
    )


def _short(leaf: Any) -> np.ndarray:
    """As an array, integers in 32 bits: they are gathered twice as fast."""
    array = np.asarray(leaf)
    return array.astype(np.int32) if array.dtype == np.int64 else array
