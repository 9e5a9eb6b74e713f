"""States of one layer told apart by what each tendon has done and by the actions still needed.

A tendon is untouched, on its way, or done. In a class all tendons are one of these three, and the
layer needs the same number of actions at least: so states with no tendon on its way have a class
of their own, and one with a single tendon on its way is a state on an edge of the layer's lattice.
Classes are joined to cells where the layer rests while the drum stands at another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.lattice import Lattice

MOST_MOVES = 5_000_000  # states of a layer times actions; beyond, classes take too long


@dataclass(frozen=True)
class LayerClasses:
    """Classes of one layer, and the actions between them. Class and cell 0 are done."""

    lengths: Float[np.ndarray, "P J"]  # displacements [m] in every state
    of_state: Int[np.ndarray, " P"]  # class of every state, in the order of its steps to go
    untouched: int  # class of the start
    stops: Int[np.ndarray, " stops"]  # of the lattice, on this layer
    leads: Bool[np.ndarray, "stops X X"]  # whether an action at a stop leads to another class
    needed: Int[np.ndarray, " X"]  # fewest actions
    status: Int[np.ndarray, " X"]  # number of what the tendons have done
    on_their_way: Int[np.ndarray, " X"]  # tendons


@dataclass(frozen=True)
class Cells:
    """Cells of a layer's classes. No action leads back to a cell that was left."""

    of_class: Int[np.ndarray, " X"]
    level: Int[np.ndarray, " C"]  # falls with every action that leaves a cell
    rank: Int[np.ndarray, " X"]  # falls with every action within a cell

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.level)


def moves_fit(lattice: Lattice) -> bool:
    """Whether the states of each layer and the actions there are few enough."""
    steps = lattice.steps.reshape(lattice.robot.n_segments, -1)
    return bool(np.prod(steps + 1.0, axis=1).max() * len(lattice.actions[0]) <= MOST_MOVES)


def layer_states(
    lattice: Lattice, layer: int
) -> tuple[slice, Int[np.ndarray, "P J"], Float[np.ndarray, "P J"]]:
    """A layer's tendons, their steps to go in all its states, in order, and displacements [m]."""
    j = lattice.robot.tendons_per_segment
    columns = slice(layer * j, (layer + 1) * j)
    left = np.indices([int(n) + 1 for n in lattice.steps[columns]]).reshape(j, -1).T
    remaining = np.zeros((len(left), lattice.robot.n_tendons), dtype=np.int64)
    remaining[:, columns] = left
    return columns, left, lattice.displacements(remaining)[:, columns]


def steps_needed(lattice: Lattice, left: Int[np.ndarray, "P J"]) -> Int[np.ndarray, "P J"]:
    """Fewest moves that finish each tendon with so many steps to go."""
    # In these action sets one move may finish a tendon.
    return np.minimum(left, 1) if lattice.problem.action_set in ("multistep", "splits") else left


def fewest_actions(lattice: Lattice, left: Int[np.ndarray, "P J"]) -> Int[np.ndarray, " P"]:
    """Fewest actions that finish a layer: a tendon's own, and all by the servos."""
    needed, servos = steps_needed(lattice, left), int(lattice.reach.sum(axis=1).max())
    return np.asarray(np.maximum(needed.max(axis=-1), -(-needed.sum(axis=-1) // servos)))


def layer_classes(lattice: Lattice, layer: int) -> LayerClasses:
    """Classes of one layer, from the base."""
    columns, left, lengths = layer_states(lattice, layer)
    steps, needed = lattice.steps[columns], fewest_actions(lattice, left)
    status, partly = _status(left, steps), ((left > 0) & (left < steps)).sum(axis=1)
    key = status * (int(needed.max()) + 1) + needed
    _, first, of_state = np.unique(key, return_index=True, return_inverse=True)
    stops = np.flatnonzero(lattice.reach[:, columns].any(axis=1))
    return LayerClasses(
        lengths=lengths,
        of_state=of_state,
        untouched=int(of_state[-1]),
        stops=stops,
        leads=_leads(lattice, columns, left, of_state, stops),
        needed=needed[first],
        status=status[first],
        on_their_way=partly[first],
    )


def _status(left: Int[np.ndarray, "P J"], steps: Int[np.ndarray, " J"]) -> Int[np.ndarray, " P"]:
    """Base 3, a digit a tendon: 0 done, 1 on its way, 2 untouched."""
    digits = np.where(left == 0, 0, np.where(left == steps, 2, 1))
    return np.asarray(digits @ 3 ** np.arange(left.shape[1]))


def _leads(
    lattice: Lattice,
    columns: slice,
    left: Int[np.ndarray, "P J"],
    of_state: Int[np.ndarray, " P"],
    stops: Int[np.ndarray, " stops"],
) -> Bool[np.ndarray, "stops X X"]:
    at, counts = lattice.actions
    strides = np.append(np.cumprod(left[-1, ::-1] + 1)[::-1][1:], 1)
    classes = int(of_state.max()) + 1
    leads = np.zeros((len(stops), classes, classes), dtype=bool)
    for row, stop in zip(leads, stops, strict=True):
        for count in counts[at == stop][:, columns]:
            moves = np.minimum(count, left)
            whole = lattice.problem.action_set == "all"
            state = np.flatnonzero(moves.any(axis=1) if whole else (moves == count).all(axis=1))
            row[of_state[state], of_state[state - moves[state] @ strides]] = True
        np.fill_diagonal(row, False)
    return leads


def cells(classes: LayerClasses, size: tuple[int, int]) -> Cells:
    """Join classes of one status, so many actions to a cell.

    Args:
        classes: Of a layer.
        size: Actions where one tendon is on its way, and where several are.
    """
    most = int(classes.needed.max()) + 1
    width = np.array([1, *size])[np.minimum(classes.on_their_way, 2)]
    key = classes.status * most + classes.needed // width
    _, of_class = np.unique(key, return_inverse=True)
    order = np.lexsort((classes.needed, of_class))
    rank = np.zeros(len(key), dtype=np.int64)
    rank[order] = np.arange(len(key)) - np.searchsorted(of_class[order], of_class[order])
    begin, end = of_class[np.array(np.nonzero(classes.leads.any(axis=0)))]
    begin, end = begin[begin != end], end[begin != end]
    level = np.zeros(int(of_class.max()) + 1, dtype=np.int64)
    while len(begin) and (level[begin] <= level[end]).any():
        np.maximum.at(level, begin, level[end] + 1)
    return Cells(of_class, level, rank)
