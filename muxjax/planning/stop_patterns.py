"""Bending and switches together, where the drum stands included: a finer pattern database.

The layer at which the drum stands is told apart by its class, the others, which rest, by the cells
of their classes (``layer_classes.py``). Actions and switches are those of the lattice: so which
tendons are untouched or done while another layer moves, and how many switches that takes, counts
exactly. What is given away: a step bends as little as any state of its classes can; and a layer
that was left in a cell is entered again at that class of the cell from which the rest is cheapest.
Of that, the bending that every plan has on the layer's way (its toll) is counted apart, and kept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.arrays import PatternArrays, pattern_arrays
from muxjax.planning.extents import extents, least_angles, runs_straight
from muxjax.planning.lattice import Lattice
from muxjax.planning.layer_classes import Cells, LayerClasses, cells, layer_classes, moves_fit
from muxjax.planning.motion import STRAIGHT
from muxjax.planning.patterns import Prices

MOST_COMBINATIONS = 3_000_000  # of classes and cells; beyond, cells are widened
COMBINATIONS_PER_STEP = 24_000  # of the lattice; coarse ones need no more and are to stay fast
_SIZES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 48)  # actions to a cell


class _Layer(NamedTuple):
    """One of the layers that the pattern knows."""

    classes: LayerClasses
    cells: Cells
    toll: Float[np.ndarray, " X"]  # least bending that is still to come while it moves, priced

    @property
    def size(self) -> int:
        """Of its axis where it moves: its classes, and one from which nothing leads on."""
        return len(self.classes.needed) + 1


class _Moving(NamedTuple):
    """Values with one layer moving, flat: one axis a layer, its classes or the others' cells."""

    begin: Int[np.ndarray, "levels ranks+1"]  # of the values in ``order``
    order: Int[np.ndarray, " V"]  # by level, then rank
    combination: Int[np.ndarray, " V"]  # of cells; in that order, like the next two
    klass: Int[np.ndarray, " V"]
    step: Float[np.ndarray, " V"]  # price of the bending of a step into it
    ahead: Int[np.ndarray, "width stops X"]  # from a value to those after each action
    value: Float[np.ndarray, " stops*size"]  # from the state on, by stop
    onwards: Float[np.ndarray, " stops*size"]  # and with the step into it


class StopPattern:
    """Lower bound on the bending still to come, and on switches into the layers it knows.

    Args:
        lattice: The problem on the robot.
        classes: Of its first layers, three at most.
        joined: Their cells.
        prices: What is charged.
        goal: Bending of the target [rad], above which a segment overshoots.

    Attributes:
        layers: How many layers, from the base, it knows.
        wide: Whether some cell has several classes.
    """

    def __init__(
        self,
        lattice: Lattice,
        classes: list[LayerClasses],
        joined: list[Cells],
        prices: Prices,
        goal: Float[np.ndarray, " S"],
    ) -> None:
        self.layers = n = len(classes)
        self.wide = any(cell.rank.max() > 0 for cell in joined)
        steps = [_bending(lattice, classes, joined, i) * prices.bending for i in range(n)]
        self._layers = [
            _Layer(c, j, _toll(c, step.min(axis=tuple(a for a in range(n) if a != i))))
            for i, (c, j, step) in enumerate(zip(classes, joined, steps, strict=True))
        ]
        waiting = _waiting(lattice, classes, joined, goal) * prices.waiting
        moving = [_moving(self._layers, i, step) for i, step in enumerate(steps)]
        switched = _solve(self._layers, moving, prices.switch + waiting.reshape(-1))
        self._lattice, self._moving, self._switched = lattice, moving, switched
        self._price = prices.switch

    def arrays(self) -> PatternArrays:
        """One table: values where the drum moves on, then those with each layer moving."""
        n, stops = len(self._layers), len(self._lattice.reach)
        cells_of = [layer.cells.count for layer in self._layers]
        begin, layout = np.zeros(stops + 1, dtype=np.int64), np.zeros(stops + 1, dtype=np.int64)
        place, toll, end = list[list[np.ndarray]](), list[list[np.ndarray]](), len(self._switched)
        for moving in range(-1, n):
            shape = [*cells_of]
            if moving >= 0:
                own = self._layers[moving]
                shape[moving] = own.size
                layout[own.classes.stops] = moving + 1
                own_begins = np.arange(len(own.classes.stops)) * int(np.prod(shape))
                begin[own.classes.stops] = end + own_begins
                end += len(self._moving[moving].value)
            place.append([])
            toll.append([])
            for i, (layer, stride) in enumerate(zip(self._layers, _strides(shape), strict=True)):
                of_state = layer.classes.of_state
                rests = i != moving
                number = layer.cells.of_class[of_state] if rests else of_state
                place[-1].append(number * stride)
                toll[-1].append(layer.toll[of_state] if rests else np.zeros(len(of_state)))
        value = np.concatenate([self._switched, *(m.value for m in self._moving)])
        return pattern_arrays(
            self._lattice, value, begin, layout, place, toll=toll, counted=self._price
        )


def stop_pattern(
    lattice: Lattice, prices: Prices, goal: Float[np.ndarray, " S"]
) -> StopPattern | None:
    """The pattern of a lattice, with the smallest cells that fit; None where none do.

    Tendons have to run straight, and all that one action moves has to be of one layer.
    """
    robot = lattice.robot
    if not (lattice.one_layer_a_step and runs_straight(robot) and moves_fit(lattice)):
        return None
    classes = [layer_classes(lattice, i) for i in range(min(robot.n_segments, 3))]
    servos = int(lattice.reach.sum(axis=1).max())
    most = min(MOST_COMBINATIONS, COMBINATIONS_PER_STEP * int(lattice.steps.sum()))
    for size in _SIZES:
        # Three servos seldom leave a single tendon on its way.
        joined = [cells(c, (size if servos < 3 else 2 * size, size)) for c in classes]
        counts = np.array([j.count for j in joined])
        moving = [len(c.needed) for c in classes] / counts
        if np.prod(counts) * moving.sum() <= most:
            return StopPattern(lattice, classes, joined, prices, goal)
    return None


def _strides(shape: Int[np.ndarray, " n"] | list[int]) -> Int[np.ndarray, " n"]:
    return np.append(np.cumprod(np.asarray(shape)[::-1])[::-1][1:], 1).astype(np.int64)


def _labels(
    classes: list[LayerClasses], joined: list[Cells], moving: int
) -> list[Int[np.ndarray, " P"]]:
    """Of every state of each layer: its class in the moving one, its cell in the others."""
    return [
        c.of_state if i == moving else j.of_class[c.of_state]
        for i, (c, j) in enumerate(zip(classes, joined, strict=True))
    ]


def _bending(
    lattice: Lattice, classes: list[LayerClasses], joined: list[Cells], moving: int
) -> Float[np.ndarray, "..."]:
    """Least sum of theta^2 [rad^2] with one layer moving; one axis a layer."""
    labels = _labels(classes, joined, moving)
    layers = [
        extents(lattice.robot, i, c.lengths, label)
        for i, (c, label) in enumerate(zip(classes, labels, strict=True))
    ]
    return least_angles(lattice.robot, layers).bending


def _waiting(
    lattice: Lattice,
    classes: list[LayerClasses],
    joined: list[Cells],
    goal: Float[np.ndarray, " S"],
) -> Float[np.ndarray, "..."]:
    """Least relative overshoot while the drum moves and all layers rest."""
    labels = _labels(classes, joined, -1)
    layers = [
        extents(lattice.robot, i, c.lengths, label)
        for i, (c, label) in enumerate(zip(classes, labels, strict=True))
    ]
    excess = np.zeros([j.count for j in joined])
    for angle, end in zip(least_angles(lattice.robot, layers).angles, goal, strict=False):
        excess = excess + np.maximum(angle - end, 0.0) / max(float(end), STRAIGHT)
    return excess


def _toll(classes: LayerClasses, step: Float[np.ndarray, " X"]) -> Float[np.ndarray, " X"]:
    """Cheapest way of a layer to its end, where a step into a class has this price at least."""
    toll = np.full(len(step), np.inf)
    toll[0] = 0.0
    leads = classes.leads.any(axis=0)
    begin, end = np.nonzero(leads)
    while True:
        found = toll.copy()
        np.minimum.at(found, begin, step[end] + toll[end])
        if (found == toll).all():
            return toll
        toll = found


def _moving(layers: list[_Layer], moving: int, step: Float[np.ndarray, "..."]) -> _Moving:
    """Lay out the values with one layer moving."""
    own, n = layers[moving], len(layers)
    counts = [layer.cells.count for layer in layers]
    shape = [*counts[:moving], own.size, *counts[moving + 1 :]]
    ranks, stops = int(own.cells.rank.max()) + 1, len(own.classes.stops)

    def along(values: np.ndarray, axis: int) -> np.ndarray:
        return values.reshape(*(len(values) if a == axis else 1 for a in range(n)))

    level, combination = np.zeros((1,) * n, dtype=np.int64), np.zeros((1,) * n, dtype=np.int64)
    for i, layer in enumerate(layers):
        cell = layer.cells.of_class if i == moving else np.arange(layer.cells.count)
        level = level + along(layer.cells.level[cell], i)
        combination = combination + along(cell * _strides(counts)[i], i)
    key = level * ranks + along(own.cells.rank, moving)
    index = np.arange(int(np.prod(shape))).reshape(shape)
    index = np.take(index, np.arange(own.size - 1), axis=moving).reshape(-1)
    klass = np.broadcast_to(along(np.arange(own.size - 1), moving), key.shape).reshape(-1)
    order = np.argsort(key.reshape(-1).astype(np.int32), kind="stable")
    groups = np.arange((int(level.max()) + 1) * ranks + 1)
    begin = np.searchsorted(key.reshape(-1)[order], groups)
    rows = np.arange(0, len(groups) - 1, ranks)[:, None] + np.arange(ranks + 1)
    size = int(np.prod(shape))
    return _Moving(
        begin=begin[rows],
        order=index[order],
        combination=combination.reshape(-1)[order],
        klass=klass[order],
        step=step.reshape(-1)[order],
        ahead=_ahead(own, int(_strides(shape)[moving]), size),
        value=np.full(stops * size, np.inf),
        onwards=np.full(stops * size, np.inf),
    )


def _ahead(own: _Layer, stride: int, size: int) -> Int[np.ndarray, "width stops X"]:
    leads = own.classes.leads
    stop, begin, end = np.nonzero(leads)
    width = max(1, int(leads.sum(axis=-1).max()))
    after = np.full((width, *leads.shape[:2]), own.size - 1)
    row = stop * leads.shape[1] + begin
    after[np.arange(len(row)) - np.searchsorted(row, row), stop, begin] = end
    away = (after - np.arange(leads.shape[1])) * stride
    return np.asarray(away + size * np.arange(leads.shape[0])[:, None])


def _solve(
    layers: list[_Layer], moving: list[_Moving], price: Float[np.ndarray, " combinations"]
) -> Float[np.ndarray, " combinations"]:
    """Fill in all values; returns those of combinations of cells from which the drum moves on.

    A combination's values need those of lower levels, and within its cells of lower ranks. To
    leave a layer is to move on from the combination; that may go unconsidered within the cell,
    since to leave it at once costs no more: tolls never fall faster than steps are priced.
    """
    switched = np.full(len(price), np.inf)
    switched[0] = 0.0
    for level in range(max(len(m.begin) for m in moving)):
        here = [(o, m) for o, m in zip(layers, moving, strict=True) if level < len(m.begin)]
        for own, m in here:
            for a, b in zip(m.begin[level], m.begin[level][1:], strict=False):
                if a == b or level == 0:
                    continue
                klass, combination = m.klass[a:b], m.combination[a:b]
                goes = np.take(m.onwards, m.order[a:b] + m.ahead[:, :, klass]).min(axis=0)
                _store(m, slice(a, b), goes)
                through = goes.min(axis=0) + (price[combination] - own.toll[klass])
                switched[combination] = np.minimum(switched[combination], through)
        for own, m in here:
            group = slice(m.begin[level, 0], m.begin[level, -1])
            places = _places(m, group)
            leaves = switched[m.combination[group]] + own.toll[m.klass[group]]
            _store(m, group, np.minimum(m.value[places], leaves))
    return switched


def _places(m: _Moving, group: slice) -> Int[np.ndarray, "stops n"]:
    stops = m.ahead.shape[1]
    return np.asarray(m.order[group] + (len(m.value) // stops) * np.arange(stops)[:, None])


def _store(m: _Moving, group: slice, value: Float[np.ndarray, "stops n"]) -> None:
    places = _places(m, group)
    m.value[places] = value
    m.onwards[places] = value + m.step[group]
