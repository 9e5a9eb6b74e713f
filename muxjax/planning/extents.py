"""Least bending of layers told apart by classes, from the extent of each class.

Where tendons run straight, the first harmonic that is left for segment i's own bending is m_i - x,
with m_i that of layer i's tendons alone, and x what passes through the segments before (M Eq. 4-6):
kappa_1 m_1 for i = 2, and (1 - kappa_2) kappa_1 m_1 + kappa_2 m_2 for i = 3, where kappa is a
segment's length by its chords over its mean, 1 on the image of M Eq. 6. Classes are summarised by
the extent of these vectors along some directions, and by the longest arc.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.robot import Robot

_DIRECTIONS = 48
_LOWEST_SINC = -0.2173


class Extents(NamedTuple):
    """The classes of one layer: index 0 is done, the last one untouched."""

    empty: Bool[np.ndarray, " C"]
    furthest: Float[np.ndarray, "C K"]  # of the first harmonic along the directions [m]
    least: Float[np.ndarray, " C"]  # of its length [m]
    arc: Float[np.ndarray, " C"]  # longest mean plus segment's length [m]
    order: Int[np.ndarray, " P"]  # of the states below, by class
    begins: Int[np.ndarray, " present"]
    present: Int[np.ndarray, " present"]  # classes that are not empty
    harmonic: Float[np.ndarray, "P 2"]  # of every state [m]
    mean: Float[np.ndarray, " P"]  # plus the segment's length [m]

    def most(self, values: Float[np.ndarray, "*n P K"]) -> Float[np.ndarray, "*n C K"]:
        """Greatest value in each class."""
        found = np.zeros((*values.shape[:-2], len(self.empty), values.shape[-1]))
        by_class = np.maximum.reduceat(values[..., self.order, :], self.begins, axis=-2)
        found[..., self.present, :] = by_class
        return found


def extents(
    robot: Robot, layer: int, lengths: Float[np.ndarray, "P J"], of_class: Int[np.ndarray, " P"]
) -> Extents:
    """Of one layer, whose tendons have these displacements [m] in its states."""
    psi = np.asarray(robot.tendon_azimuth)[layer, layer]
    share = 2.0 / robot.tendons_per_segment
    harmonic = share * lengths @ np.stack([np.cos(psi), np.sin(psi)], axis=-1)
    arc = lengths.mean(axis=-1) + float(robot.length[layer])
    classes = int(of_class.max()) + 1
    norm = np.linalg.norm(harmonic, axis=-1)
    furthest = np.zeros((classes, _DIRECTIONS))
    least, longest = np.zeros(classes), np.zeros(classes)
    order = np.argsort(of_class, kind="stable")
    present, begins = np.unique(of_class[order], return_index=True)
    furthest[present] = np.maximum.reduceat((harmonic @ directions(_DIRECTIONS))[order], begins)
    least[present] = np.minimum.reduceat(norm[order], begins)
    longest[present] = np.maximum.reduceat(arc[order], begins)
    empty = ~np.isin(np.arange(classes), present)
    return Extents(empty, furthest, least, longest, order, begins, present, harmonic, arc)


def directions(count: int) -> Float[np.ndarray, "2 K"]:
    """Unit vectors all around."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)])


def runs_straight(robot: Robot) -> bool:
    """Whether each tendon keeps its azimuth, and those of a layer are spread evenly."""
    psi = np.asarray(robot.tendon_azimuth)
    own = np.stack([psi[i, i] for i in range(robot.n_segments)])
    kept = all(
        np.allclose(np.exp(1j * psi[n, i]), np.exp(1j * own[i]), atol=1e-12)
        for i in range(robot.n_segments)
        for n in range(i)
    )
    even = [np.abs(np.exp(1j * k * own).sum(axis=1)).max() < 1e-9 for k in (1, 2)]
    return kept and all(even)


class Least(NamedTuple):
    """Least values in the states of each combination of classes."""

    angles: list[Float[np.ndarray, "..."]]  # of each segment [rad]
    bending: Float[np.ndarray, "..."]  # sum of their squares [rad^2]
    empty: Bool[np.ndarray, "..."]  # no state has these classes


def least_angles(robot: Robot, layers: list[Extents]) -> Least:
    """Least angles of at most three layers, from the base, in every combination of classes."""
    n = len(layers)

    def along(values: np.ndarray, axis: int) -> np.ndarray:
        return values.reshape(*(len(values) if k == axis else 1 for k in range(n)))

    lengths, slack = np.asarray(robot.length), _slack(robot, layers)
    through = _through(robot, layers, slack)
    angles, empty = [], np.zeros((1,) * n, dtype=bool)
    for i, layer in enumerate(layers):
        if i == 0:
            apart = along(layer.least, 0)
        else:
            nearest = -np.roll(layer.furthest, _DIRECTIONS // 2, axis=1)  # least along directions
            gap = np.zeros((*through[i - 1].shape[:-1], len(nearest)))
            for k in range(_DIRECTIONS):
                np.maximum(gap, nearest[:, k] - through[i - 1][..., k, None], out=gap)
            apart = gap.reshape(*gap.shape, *(1,) * (n - gap.ndim))
        arc = np.maximum(along(layer.arc, i) + slack[i], 1e-9)
        angles.append(apart * (lengths[i] / (float(robot.tendon_radius) * arc)))
        empty = empty | along(layer.empty, i)
    squares = [angle**2 for angle in angles]
    bending = sum(squares, start=np.zeros(()))
    for together in _together(robot, layers, through, squares, arc):
        np.maximum(bending, together, out=bending)
    return Least(angles, bending, empty)


def _together(
    robot: Robot,
    layers: list[Extents],
    through: list[np.ndarray],
    squares: list[np.ndarray],
    arc: np.ndarray,
) -> list[np.ndarray]:
    """Other lower bounds on the sum of squares, with some segments taken together.

    Of what goes on behind segment i, y_i = y_(i-1) + kappa_i v_i with v_i the harmonic left for
    it: so theta_i = |v_i| L_i / (r_a arc_i) >= |y_i - y_(i-1)| / r_a, as kappa_i is a sinc times
    L_i / arc_i. And the squares of parts of a vector, each with a factor, are at least the square
    of the vector over the sum of the factors' inverses.
    """
    n, radius = len(layers), float(robot.tendon_radius)
    if n == 1:
        return []

    def along(values: np.ndarray, *axes: int) -> np.ndarray:
        shape = [1] * n
        for axis, size in zip(axes, values.shape, strict=True):
            shape[axis] = size
        return values.reshape(shape)

    found, last = [], layers[-1]
    inverse = (radius * arc / float(robot.length[n - 1])) ** 2  # of the last segment's factor
    found.append(along(last.least, n - 1) ** 2 / ((n - 1) * radius**2 + inverse))
    if n == 3:
        nearest = -np.roll(last.furthest, _DIRECTIONS // 2, axis=1)
        apart = np.maximum((nearest - through[0][:, None, :]).max(axis=-1), 0.0)
        found.append(squares[0] + along(apart, 0, 2) ** 2 / (radius**2 + inverse))
        far = np.maximum(-through[1].min(axis=-1), 0.0)
        found.append(along(far, 0, 1) ** 2 / (2 * radius**2) + squares[2])
    return found


def _slack(robot: Robot, layers: list[Extents]) -> list[float]:
    """How much longer an arc can be because the segments before it bend [m]."""
    slack, before = [0.0], 0.0
    for i, layer in enumerate(layers[:-1]):
        length = float(robot.length[i])
        largest = float(np.linalg.norm(layer.harmonic, axis=-1).max())
        shortest = max(float(layer.mean.min()), 1e-9)
        widest = (largest + before) * length / (float(robot.tendon_radius) * shortest)
        half = widest / (2 * robot.n_discs[i])
        sinc = np.sinc(half / np.pi) if half < np.pi else _LOWEST_SINC
        slack.append(slack[-1] + length * float(1 - sinc))
        # The vector that goes on is between the one before and this one, times kappa at most.
        before = max(before, largest) * max(1.0, length / shortest) + before
    return slack


def _through(robot: Robot, layers: list[Extents], slack: list[float]) -> list[np.ndarray]:
    """Greatest extent of what passes on to the next layer: (C1, K), and (C1, C2, K)."""
    around, found = directions(_DIRECTIONS), list[np.ndarray]()
    if len(layers) > 1:
        one, length = layers[0], float(robot.length[0])
        mean = np.maximum(one.mean, 1e-9)
        angle = np.linalg.norm(one.harmonic, axis=-1) * length / (robot.tendon_radius * mean)
        kappa = length * np.sinc(angle / (2 * robot.n_discs[0]) / np.pi) / mean
        found.append(one.most((kappa[:, None] * one.harmonic) @ around))
    if len(layers) > 2:
        two, length = layers[1], float(robot.length[1])
        sinc = 1.0 - (slack[2] - slack[1]) / length
        longest = np.maximum(two.mean, 1e-9) + (slack[1] if sinc > 0 else 0.0)
        low = length * sinc / longest
        high = length / np.maximum(two.mean, 1e-9)
        # Own part and the rest apart: together they would need every class with every state.
        both = np.stack([low, high], axis=-1)
        own = two.harmonic @ around
        most = two.most(np.maximum(low[:, None] * own, high[:, None] * own))
        shares = two.most(1 - both).max(axis=-1), -two.most(both - 1).max(axis=-1)
        far = found[0][:, None]  # (C1, 1, K)
        near = -np.roll(far, _DIRECTIONS // 2, axis=-1)
        found.append(most + np.max([k[:, None] * x for k in shares for x in (near, far)], axis=0))
    return found
