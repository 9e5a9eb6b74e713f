"""Least bending of layers told apart by classes, over every pair of states of the first two.

Segments 1 and 2 are minimised together over all pairs of layer states. The tendons of layer 3 have
for their own segment what is left by the first two, a vector from one cloud minus a vector from
another: their distance along the best of a few directions bounds segment 3. (By M Eq. 4-6 segment
3 depends on layer 1 too, off the image of Eq. 6.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.extents import directions
from muxjax.planning.grid import Rest, layered_angles, layered_rests
from muxjax.robot import Robot

MOST_PAIRS = 3_000_000  # states of layers 1 and 2 together; beyond, pairs take too long
_DIRECTIONS = 24
_PAIRS_AT_ONCE = 100_000

Points = tuple[Float[np.ndarray, "_ J"], Int[np.ndarray, " _"]]
"""Displacements [m] of a layer's tendons in all its states, and the class of each."""


class _Clouds(NamedTuple):
    """Of the pairs of each combination of classes of layers 1 and 2."""

    least: Float[np.ndarray, "C1 C2"]  # bending of segments 1 and 2 [rad^2]
    longest: Float[np.ndarray, "C1 C2"]  # segment 3's arc, without its own tendons [m]
    furthest: Float[np.ndarray, "C1 C2 K"]  # of what it is left, along the directions [m]


def pairs_fit(layers: list[Points]) -> bool:
    """Whether there are two layers, and few enough pairs of their states."""
    return len(layers) > 1 and len(layers[0][1]) * len(layers[1][1]) <= MOST_PAIRS


def least_bending(robot: Robot, layers: list[Points]) -> Float[np.ndarray, "..."]:
    """Least sum of theta^2 [rad^2] of any state with given classes, one axis a layer.

    A class without states has an infinite value, or that of another class; undefined states count
    as infinitely bent.

    Args:
        robot: The arm.
        layers: Its first two layers or three.
    """
    ordered = [_by_class(points) for points in layers]
    clouds = _clouds(robot, ordered)
    if len(layers) == 2:
        return clouds.least
    return clouds.least[..., None] + _third(robot, ordered[2], clouds)


def _by_class(points: Points) -> Points:
    order = np.argsort(points[1], kind="stable")
    return points[0][order], points[1][order]


def _begins(of_class: Int[np.ndarray, " P"]) -> Int[np.ndarray, " C"]:
    return np.searchsorted(of_class, np.arange(of_class[-1] + 1))


def _clouds(robot: Robot, layers: list[Points]) -> _Clouds:
    (one, classes), (two, others) = layers[:2]
    begins = _begins(others)
    shape = (int(classes[-1]) + 1, len(begins))
    found = _Clouds(
        np.full(shape, np.inf), np.full(shape, -np.inf), np.full((*shape, _DIRECTIONS), -np.inf)
    )
    rows = max(1, _PAIRS_AT_ONCE // len(two))
    probe = [np.zeros((1, robot.tendons_per_segment))] * (len(layers) - 2)
    for number in np.unique(classes):
        states = one[classes == number]
        for i in range(0, len(states), rows):
            grid = [states[i : i + rows], two]
            first, second = layered_angles(robot, grid, np)
            square = np.nan_to_num(first[:, None] ** 2 + second**2, nan=np.inf).min(axis=0)
            found.least[number] = np.minimum(
                found.least[number], np.minimum.reduceat(square, begins)
            )
            if probe:
                _, rest = layered_rests(robot, [*grid, *probe], np)[-1]
                _widen(found, int(number), rest, begins)
    return found


def _widen(found: _Clouds, number: int, rest: Rest, begins: Int[np.ndarray, " C"]) -> None:
    """Take more pairs, with this class of layer 1, into the clouds."""
    bad = ~np.isfinite(rest.arc[..., 0])
    arc = np.where(bad, -np.inf, rest.arc[..., 0]).max(axis=0)
    found.longest[number] = np.maximum(found.longest[number], np.maximum.reduceat(arc, begins))
    for k, (dx, dy) in enumerate(directions(_DIRECTIONS).T):
        along = -(dx * rest.mx + dy * rest.my)[..., 0]
        top = np.maximum.reduceat(np.where(bad, -np.inf, along).max(axis=0), begins)
        found.furthest[number, :, k] = np.maximum(found.furthest[number, :, k], top)


def _third(robot: Robot, points: Points, clouds: _Clouds) -> Float[np.ndarray, "C1 C2 C3"]:
    """Least theta_3^2: own harmonic minus what the first two layers take, over the arc."""
    own, of_class = points
    zero = np.zeros((1, robot.tendons_per_segment))
    _, straight = layered_rests(robot, [zero, zero, own], np)[-1]
    begins = _begins(of_class)
    longer = np.maximum.reduceat(straight.arc[0, 0] - robot.length[2], begins)
    harmonic = np.stack([straight.mx[0, 0], straight.my[0, 0]], axis=-1) @ directions(_DIRECTIONS)
    nearest = np.minimum.reduceat(harmonic, begins, axis=0)  # (C3, K)
    apart = np.full((*clouds.longest.shape, len(begins)), 0.0)
    for k in range(_DIRECTIONS):
        apart = np.maximum(apart, nearest[:, k] - clouds.furthest[..., k, None])
    arc = np.maximum(clouds.longest[..., None] + longer, 1e-9)
    theta = apart * robot.length[2] / (robot.tendon_radius * arc)
    return np.nan_to_num(theta**2, posinf=0.0)
