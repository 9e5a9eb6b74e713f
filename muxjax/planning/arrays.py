"""A lattice and its bound as arrays, for compiled searches.

Everything that differs between two problems of one robot (targets, steps, servos, weights, pattern
databases) is data, padded to sizes that many problems share: so one compilation serves them all.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.bounds import bound_of
from muxjax.planning.lattice import Lattice
from muxjax.planning.patterns import VisitPattern

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


class PatternArrays(NamedTuple):
    """One pattern database; indices are offsets into its flat values. P: states of a layer."""

    value: Float[Array, " values"]
    place: Int[Array, " stops"]  # of the stop; the last one where it is not known
    visits: Int[Array, " S"]  # counted at most
    visit: Int[Array, " S"]  # of one visit
    state: Int[Array, "S P"]  # of a layer's state


class Needs(NamedTuple):
    """What is still needed, by layer; arrays with a row a state."""

    way: list[Float[Array, " N"]]  # of all its tendons [m]
    shortest: list[Float[Array, " N"]]  # of the servos, if they could always work together [m]
    visits: list[Int[Array, " N"]]  # beyond the present one
    state: list[Int[Array, " N"]]  # number of the layer's state


class BoundArrays(NamedTuple):
    """``bounds.AdmissibleBound`` of a lattice: weights, and what they multiply."""

    travel: Float[Array, ""]
    stop: Float[Array, ""]  # of a stop: switch and repositioning time
    second: Float[Array, ""]
    bending: Float[Array, ""]  # of the last step
    speed: Float[Array, ""]  # of a tendon [m/s]
    reach: Bool[Array, "stops SJ"]  # the last row, of no stop, is empty
    servos: Int[Array, ""]  # most tendons in a step
    layer_index: Int[Array, "S J"]  # of a remaining step in a layer's states
    patterns: tuple[PatternArrays, ...]

    def needs(
        self, lattice: LatticeArrays, remaining: Int[Array, "N SJ"], stop: Int[Array, " N"]
    ) -> Needs:
        """What states need by layer, or by what else may share a step."""
        # A column a tendon: whole rows of memory for the compiler, which short axes are not.
        left, here = remaining.T, self.reach[stop].T
        way = [jnp.abs(lattice.way[c][k]) for c, k in enumerate(left)]
        per_layer = self.layer_index.shape[1]
        needs = Needs([], [], [], [])
        for index, first in zip(self.layer_index, range(0, len(way), per_layer), strict=True):
            tendons = range(first, first + per_layer)
            needs.way.append(sum(way[c] for c in tendons))
            longest = reduce(jnp.maximum, [way[c] for c in tendons])
            needs.shortest.append(jnp.maximum(longest, needs.way[-1] / self.servos))
            elsewhere = sum(((left[c] > 0) & ~here[c]).astype(stop.dtype) for c in tendons)
            needs.visits.append(-(-elsewhere // self.servos))
            needs.state.append(sum(left[c] * index[c - first] for c in tendons))
        return needs

    def __call__(
        self, lattice: LatticeArrays, remaining: Int[Array, "N SJ"], stop: Int[Array, " N"]
    ) -> Float[Array, " N"]:
        """Bound at states."""
        needs = self.needs(lattice, remaining, stop)
        more = self.bending * jnp.any(remaining > 0, axis=-1)
        for pattern in self.patterns:
            at = pattern.place[stop]
            for layer, (count, state) in enumerate(zip(needs.visits, needs.state, strict=True)):
                counted = jnp.minimum(count, pattern.visits[layer])
                at = at + counted * pattern.visit[layer] + pattern.state[layer][state]
            more = jnp.maximum(more, pattern.value[at])
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


def bound_arrays(lattice: Lattice, heuristic: str) -> BoundArrays:
    """Bound of a lattice, or a part of it: see ``beamstep.beamstep``."""
    robot, bound = lattice.robot, bound_of(lattice)
    weights = {} if heuristic == "none" else bound.weights
    groups = robot.n_segments if lattice.one_layer_a_step else 1
    steps = lattice.steps.reshape(groups, -1)
    index = np.ones_like(steps)
    index[:, :-1] = np.cumprod(steps[:, :0:-1] + 1, axis=1)[:, ::-1]
    stops = len(robot.axial_map) + 1  # and one for no stop
    known = bound.patterns if heuristic == "patterns" else []
    patterns = [_pattern_arrays(p, lattice, stops) for p in known if p.layers]
    seconds = weights.get("time", 0.0)
    found = BoundArrays(
        travel=weights.get("travel", 0.0),
        stop=weights.get("switches", 0.0) + float(robot.switch_time) * seconds,
        second=seconds,
        bending=weights.get("bending", 0.0) * np.sum(bound.end_angles**2),
        speed=robot.tendon_speed,
        reach=_padded(lattice.reach, stops),
        servos=np.asarray(lattice.reach.sum(axis=-1).max()),
        layer_index=index,
        patterns=(*patterns, *[_no_pattern(groups, stops)] * (2 - len(patterns))),
    )
    return jax.tree.map(_short, found)


def _short(leaf: Any) -> np.ndarray:
    """As an array, integers in 32 bits: they are gathered twice as fast."""
    array = np.asarray(leaf)
    return array.astype(np.int32) if array.dtype == np.int64 else array


def _no_pattern(groups: int, stops: int) -> PatternArrays:
    nothing, states = np.zeros(groups, int), np.zeros((groups, _STATES), int)
    return PatternArrays(np.zeros(_VALUES), np.zeros(stops, int), nothing, nothing, states)


def _pattern_arrays(p: VisitPattern, lattice: Lattice, stops: int) -> PatternArrays:
    s, layers = lattice.robot.n_segments, p.layers
    shape = p._value.shape
    stride = np.cumprod(np.append(1, shape[:0:-1]))[::-1]
    layer_of_stop = lattice.reach.reshape(len(lattice.reach), s, -1)
    place = np.minimum(np.argmax(layer_of_stop.any(axis=-1), axis=-1), layers)
    place = np.append(place, np.full(stops - len(place), layers))
    visits, visit = np.zeros(s, int), np.zeros(s, int)
    visits[:layers], visit[:layers] = np.array(shape[1 : 1 + layers]) - 1, stride[1 : 1 + layers]
    classes = [p._points(i)[1] for i in range(layers)]
    state = np.zeros((s, _room(max(map(len, classes)), _STATES, 16)), int)
    for i, of_state in enumerate(classes):
        state[i, : len(of_state)] = of_state * stride[1 + layers + i]
    values = p._value.reshape(-1)
    return PatternArrays(
        _padded(values, _room(len(values), _VALUES, 16)), place * stride[0], visits, visit, state
    )
