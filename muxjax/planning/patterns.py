"""Bending and switches together: a pattern database of layers told apart by what they need.

A layer's class is "untouched", "done", or how much it needs at least, counted in actions, of which
an action takes off one at most, or in steps of its tendons, of which it takes off as many as there
are servos. Whatever a plan does, its classes walk down a small grid, and each step there costs the
least bending that any state of these classes can have. The grid also knows the layer at which the
drum stands: to enter another one is a switch. A layer needs so many visits anyway, which
``bounds.py`` counts; the grid charges those beyond. So bending less by going to and fro between the
layers has its price.

Least bendings are those of ``extents.py`` where tendons run straight, and those of
``pair_patterns.py`` where layers 1 and 2 have few states.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.arrays import PatternArrays, pattern_arrays
from muxjax.planning.extents import extents, least_angles, runs_straight
from muxjax.planning.lattice import Lattice
from muxjax.planning.layer_classes import fewest_actions, layer_states, steps_needed
from muxjax.planning.motion import STRAIGHT
from muxjax.planning.pair_patterns import Points, least_bending, pairs_fit

MOST_STATES = 1_000_000  # of one layer; beyond, there is no pattern
MOST_VALUES = 3_000_000  # of the grid with its counters; beyond, switches are not charged


class Prices(NamedTuple):
    """What one unit costs."""

    bending: float  # of rad^2 and step
    switch: float  # of a switch
    waiting: float  # of relative overshoot while the drum moves


def visit_pattern(
    lattice: Lattice, prices: Prices, goal: Float[np.ndarray, " S"], *, in_actions: bool
) -> PatternArrays | None:
    """Lower bound on the bending still to come, and on switches beyond those that are counted.

    Args:
        lattice: The problem on the robot.
        prices: What is charged.
        goal: Bending of the target [rad], above which a segment overshoots.
        in_actions: What a layer needs is counted in actions, else in steps.

    Returns:
        The pattern of at most three layers, from the base; None where there is none.
    """
    robot = lattice.robot
    servos = int(lattice.reach.sum(axis=1).max())
    steps = lattice.steps.reshape(robot.n_segments, -1)
    few = np.prod(steps + 1.0, axis=1).max() <= MOST_STATES
    if not (lattice.one_layer_a_step and few):
        return None
    layers = min(robot.n_segments, 3)
    points = [_points(lattice, layer, in_actions) for layer in range(layers)]
    if not (runs_straight(robot) or pairs_fit(points)):
        return None
    node, waiting = _least_costs(lattice, points, prices, goal)
    visits = -(-(steps > 0).sum(axis=1)[:layers] // servos)
    if (layers + 1) * np.prod(visits + 1) * node.size > MOST_VALUES:
        visits, prices = 0 * visits, prices._replace(switch=0.0)
    value = _cheapest(node, waiting, prices.switch, visits, 1 if in_actions else servos)
    strides = np.cumprod(np.append(1, value.shape[:0:-1]))[::-1]
    layer_of_stop = lattice.reach.reshape(len(lattice.reach), robot.n_segments, -1)
    # From a layer that the grid leaves out, or an unknown one, every layer has to be entered.
    place = np.minimum(np.argmax(layer_of_stop.any(axis=-1), axis=-1), layers)
    return pattern_arrays(
        lattice,
        value.reshape(-1),
        np.append(place, layers) * strides[0],
        np.zeros(len(place) + 1, dtype=np.int64),
        [[c * stride for (_, c), stride in zip(points, strides[1 + layers :], strict=True)]],
        visits=visits,
        visit=strides[1 : 1 + layers],
    )


def _points(lattice: Lattice, layer: int, in_actions: bool) -> Points:
    """Displacements [m] and class of every state of a layer, in the order of its steps to go."""
    columns, left, lengths = layer_states(lattice, layer)
    if in_actions:
        classes = fewest_actions(lattice, left)
    else:
        classes = steps_needed(lattice, left).sum(axis=-1)
    untouched = (left == lattice.steps[columns]).all(axis=-1) & (classes[-1] > 0)
    return lengths, np.where(untouched, classes[-1] + 1, classes)


def _least_costs(
    lattice: Lattice, points: list[Points], prices: Prices, goal: Float[np.ndarray, " S"]
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Of a step into given classes, and of a switch in them."""
    robot = lattice.robot
    sizes = [int(of_class.max()) + 1 for _, of_class in points]
    node, waiting = np.zeros(sizes), np.zeros(sizes)
    if runs_straight(robot):
        least = least_angles(robot, [extents(robot, i, *p) for i, p in enumerate(points)])
        node = np.where(least.empty, np.inf, prices.bending * least.bending)
        for angle, end in zip(least.angles, goal, strict=False):
            excess = np.maximum(angle - end, 0.0) / max(float(end), STRAIGHT)
            waiting = waiting + np.where(least.empty, 0.0, prices.waiting * excess)
    if pairs_fit(points) and prices.bending > 0:
        node = np.maximum(node, prices.bending * least_bending(robot, points))
    return node, waiting


def _cheapest(
    node: Float[np.ndarray, "..."],
    waiting: Float[np.ndarray, "..."],
    price: float,
    visits: Int[np.ndarray, " layers"],
    most: int,
) -> Float[np.ndarray, "..."]:
    """Cost from every place, number of counted visits and combination of classes to the origin.

    A step takes at most so much off a class, or one more out of "untouched", which is one more.
    """
    n, shape = node.ndim, node.shape
    node, waiting = node.reshape(-1), waiting.reshape(-1)
    strides = np.append(np.cumprod(shape[::-1])[::-1][1:], 1).astype(np.int64)
    index = np.indices(shape).reshape(n, -1)
    level_of = index.sum(axis=0)
    order = np.argsort(level_of, kind="stable")
    levels = np.split(order, np.cumsum(np.bincount(level_of))[:-1])
    value = np.full((n + 1, *(visits + 1), node.size), np.inf)
    value[..., 0] = 0.0
    for here in levels[1:]:
        stays = np.full((n, *(visits + 1), len(here)), np.inf)
        elsewhere = np.full((*(visits + 1), len(here)), np.inf)
        for layer in range(n):
            for drop in range(1, most + 2):
                untouched = index[layer, here] == shape[layer] - 1
                may = (index[layer, here] >= drop) & ((drop <= most) | untouched)
                after = np.where(may, here - drop * strides[layer], 0)
                through = np.where(may, node[after], np.inf) + value[layer][..., after]
                stays[layer] = np.minimum(stays[layer], through)
                fewer = np.maximum(np.arange(visits[layer] + 1) - 1, 0)
                entered = np.take(through, fewer, axis=layer)
                beyond = np.moveaxis(entered, layer, 0)
                beyond[0] += price
                elsewhere = np.minimum(elsewhere, entered)
        elsewhere = elsewhere + waiting[here]
        value[:n, ..., here] = np.minimum(stays, elsewhere)
        value[n][..., here] = elsewhere
    return value.reshape(n + 1, *(visits + 1), *shape)
