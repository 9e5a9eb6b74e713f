"""A pattern database for bending: states told apart by how much each layer still needs.

What a layer needs is counted in steps of its tendons, of which an action takes off at most as many
as there are servos, or in actions, of which it takes off at most one. Either way a plan passes
through a path on the small grid of these numbers. A point of the grid costs the least bending that
any state there can have; the cheapest path is then a lower bound on what bending is still to be
paid for. Segments 1 and 2 are minimised together over all their states (pairs of layer states).
The tendons of layer 3 have for their own segment what is left by the first two, a vector from one
cloud minus a vector from another: their distance along the best of a few directions bounds segment
3. (By M Eq. 4-6 segment 3 depends on layer 1 too, off the image of Eq. 6.)
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.grid import layered_angles, layered_rests
from muxjax.planning.lattice import Lattice

MOST_PAIRS = 3_000_000  # states of layers 1 and 2 together; beyond, there is no pattern
_DIRECTIONS = 24
_PAIRS_AT_ONCE = 100_000


class BendingPattern:
    """Least sum of |theta|^2 [rad^2] over the steps to go, by what the first layers still need.

    Attributes:
        layers: How many layers, from the base, are told apart: 2 or 3, 0 where there is no pattern.
    """

    def __init__(self, lattice: Lattice, *, in_actions: bool) -> None:
        self._lattice, self._in_actions = lattice, in_actions
        robot = lattice.robot
        per_layer = np.prod(lattice.steps.reshape(robot.n_segments, -1) + 1.0, axis=1)
        self.layers = min(robot.n_segments, 3) if lattice.one_layer_a_step else 0
        if self.layers < 2 or per_layer[0] * per_layer[1] > MOST_PAIRS or per_layer.max() > 1e6:
            self.layers = 0
            return
        self._value = self._cheapest(self._node_costs())

    def __call__(self, remaining: Int[np.ndarray, "N SJ"]) -> Float[np.ndarray, " N"]:
        """Lower bound for states."""
        if not self.layers:
            return np.zeros(len(remaining))
        by_layer = remaining.reshape(len(remaining), self._lattice.robot.n_segments, -1)
        return np.asarray(self._value[tuple(self._needed(by_layer).T[: self.layers])])

    def _needed(self, left: Int[np.ndarray, "*n J"]) -> Int[np.ndarray, "*n"]:
        """Steps that finish a layer, or fewest actions: a tendon's own, and all by the servos."""
        servos = int(self._lattice.reach.sum(axis=1).max())
        if self._lattice.problem.action_set == "multistep":
            left = np.minimum(left, 1)  # one action may finish a tendon
        if not self._in_actions:
            return np.asarray(left.sum(axis=-1))
        return np.maximum(left.max(axis=-1), -(-left.sum(axis=-1) // servos))

    def _points(self, layer: int) -> tuple[Float[np.ndarray, "P J"], Int[np.ndarray, " P"]]:
        """Displacements [m] of a layer's tendons in all its states, sorted by what these need."""
        lattice, j = self._lattice, self._lattice.robot.tendons_per_segment
        columns = slice(layer * j, (layer + 1) * j)
        left = np.indices([int(n) + 1 for n in lattice.steps[columns]]).reshape(j, -1).T
        left = left[np.argsort(self._needed(left), kind="stable")]
        remaining = np.zeros((len(left), lattice.robot.n_tendons), dtype=np.int64)
        remaining[:, columns] = left
        return lattice.displacements(remaining)[:, columns], self._needed(left)

    def _node_costs(self) -> Float[np.ndarray, "..."]:
        """Least bending of any state with given needs."""
        robot = self._lattice.robot
        points = [self._points(layer) for layer in range(self.layers)]
        first, second = (np.searchsorted(t, np.arange(t[-1] + 1)) for _, t in points[:2])
        angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        directions = np.stack([np.cos(angle), np.sin(angle)])
        least = np.full((len(first), len(second)), np.inf)
        longest = np.full(least.shape, -np.inf)  # of segment 3's arc, without its own tendons
        furthest = np.full((*least.shape, _DIRECTIONS), -np.inf)
        rows = max(1, _PAIRS_AT_ONCE // len(points[1][0]))
        probe = [np.zeros((1, robot.tendons_per_segment))] * (self.layers - 2)
        for t1, begin in enumerate(first):
            end = first[t1 + 1] if t1 + 1 < len(first) else len(points[0][0])
            for i in range(int(begin), int(end), rows):
                part = points[0][0][i : min(i + rows, int(end))]
                grid = [part, points[1][0]]
                one, two = layered_angles(robot, grid, np)
                square = np.nan_to_num(one[:, None] ** 2 + two**2, nan=np.inf).min(axis=0)
                least[t1] = np.minimum(least[t1], np.minimum.reduceat(square, second))
                if not probe:
                    continue
                _, rest = layered_rests(robot, [*grid, *probe], np)[-1]
                bad = ~np.isfinite(rest.arc[..., 0])
                arc = np.where(bad, -np.inf, rest.arc[..., 0]).max(axis=0)
                longest[t1] = np.maximum(longest[t1], np.maximum.reduceat(arc, second))
                for k, (dx, dy) in enumerate(directions.T):
                    along = -(dx * rest.mx + dy * rest.my)[..., 0]
                    top = np.where(bad, -np.inf, along).max(axis=0)
                    furthest[t1, :, k] = np.maximum(
                        furthest[t1, :, k], np.maximum.reduceat(top, second)
                    )
        if not probe:
            return least
        return least[..., None] + self._third(points[2], directions, longest, furthest)

    def _third(
        self,
        points: tuple[Float[np.ndarray, "P J"], Int[np.ndarray, " P"]],
        directions: Float[np.ndarray, "2 K"],
        longest: Float[np.ndarray, "T1 T2"],
        furthest: Float[np.ndarray, "T1 T2 K"],
    ) -> Float[np.ndarray, "T1 T2 T3"]:
        """Least theta_3^2: own harmonic minus what the first two layers take, over the arc."""
        robot = self._lattice.robot
        own, left = points
        zero = np.zeros((1, robot.tendons_per_segment))
        _, straight = layered_rests(robot, [zero, zero, own], np)[-1]
        begins = np.searchsorted(left, np.arange(left[-1] + 1))
        mean = straight.arc[0, 0] - robot.length[2]
        longer = np.maximum.reduceat(mean, begins)
        harmonic = np.stack([straight.mx[0, 0], straight.my[0, 0]], axis=-1) @ directions
        nearest = np.minimum.reduceat(harmonic, begins, axis=0)  # (T3, K)
        apart = np.full((*longest.shape, len(begins)), 0.0)
        for k in range(directions.shape[1]):
            apart = np.maximum(apart, nearest[:, k] - furthest[..., k, None])
        arc = np.maximum(longest[..., None] + longer, 1e-9)
        theta = apart * robot.length[2] / (robot.tendon_radius * arc)
        return np.nan_to_num(theta**2, posinf=0.0)

    def _cheapest(self, node: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Cheapest path from every point of the grid to the origin, level by level."""
        most = 1 if self._in_actions else int(self._lattice.reach.sum(axis=1).max())
        value = np.full(node.shape, np.inf)
        value[(0,) * node.ndim] = 0.0
        points = np.indices(node.shape).reshape(node.ndim, -1)
        total = points.sum(axis=0)
        for level in range(1, int(total.max()) + 1):
            here = points[:, total == level]
            best = np.full(here.shape[1], np.inf)
            for layer in range(node.ndim):
                for taken in range(1, most + 1):
                    after = here.copy()
                    after[layer] = np.maximum(after[layer] - taken, 0)
                    step = node[tuple(after)] + value[tuple(after)]
                    best = np.minimum(best, np.where(here[layer] >= taken, step, np.inf))
            value[tuple(here)] = best
        return value
