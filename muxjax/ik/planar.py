"""Seeds for planar targets, where the reduction of three segments is singular.

A target is planar if d = q_z = 0 and s_w = 0: some plane through the root's axis holds the arm
and keeps it. There a segment is a signed angle a_i, a_1 + a_2 + a_3 is known up to turns, and the
position leaves two equations in (a_1, a_3), searched on a grid.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

GRID = 65  # angles of segments 1 and 3
TURNS = (-2, -1, 0, 1, 2)
SEEDS = 24  # best local minima taken from each target


def planar_seeds(
    length: Float[np.ndarray, " 3"],
    theta_max: Float[np.ndarray, " 3"],
    goal: Float[np.ndarray, "7 targets"],
    rows: Int[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "6 m"]]:
    """Target and bending of candidates in the plane of each target.

    Args:
        length: L_i [m].
        theta_max: Limits [rad].
        goal: Positions and quaternions (w, x, y, z), as columns.
        rows: The planar ones of them.
    """
    found_rows, found = [], []
    for row in rows:
        position, (w, qx, qy, _) = goal[:3, row], goal[3:, row]
        plane = np.array([qy, -qx])
        if np.hypot(*plane) < 1e-9:
            plane = position[:2]
        size = np.hypot(*plane)
        plane = plane / size if size > 1e-12 else np.array([1.0, 0.0])
        angle = 2 * np.arctan2(np.array([qy, -qx]) @ plane, w)
        signed = _in_plane(length, theta_max, angle, position[:2] @ plane, position[2])
        found_rows.append(np.full(len(signed), row))
        found.append((signed[:, :, None] * plane).reshape(-1, 6).T)
    return np.concatenate(found_rows), np.concatenate(found, axis=1)


def _in_plane(
    length: Float[np.ndarray, " 3"],
    theta_max: Float[np.ndarray, " 3"],
    angle: float,
    across: float,
    up: float,
) -> Float[np.ndarray, "seeds 3"]:
    """Signed angles at the local minima of the position error."""
    grid = np.linspace(-1.0, 1.0, GRID)
    first, last = theta_max[0] * grid[:, None], theta_max[2] * grid[None, :]
    # Straight segments are a fold of the position, which no local minimum marks exactly.
    seeds, errors = [np.zeros((1, 3))], [np.zeros(1)]
    for turn in TURNS:
        middle = angle + 2 * np.pi * turn - first - last
        arcs = [(length[0], first), (length[1], middle), (length[2], last)]
        heading, end = np.zeros((GRID, GRID)), np.zeros((GRID, GRID), complex)
        for arc, bend in arcs:
            # a chord of a circle points half its bend away from its start
            end = end + arc * np.sinc(bend / (2 * np.pi)) * np.exp(1j * (heading + bend / 2))
            heading = heading + bend
        error = np.abs(end - (up + 1j * across))
        error[np.abs(middle) > theta_max[1] + 0.2] = np.inf
        i, j = np.nonzero(_local_minimum(error))
        seeds.append(np.stack([first[i, 0], middle[i, j], last[0, j]], axis=1))
        errors.append(error[i, j])
    best = np.argsort(np.concatenate(errors), kind="stable")[:SEEDS]
    return np.concatenate(seeds)[best]


def _local_minimum(error: Float[np.ndarray, "n n"]) -> np.ndarray:
    """Not above any of the eight neighbours."""
    wide = np.pad(error, 1, constant_values=np.inf)
    n = len(error)
    around = [wide[1 + i : 1 + i + n, 1 + j : 1 + j + n] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return np.isfinite(error) & (error <= np.min(around, axis=0))
