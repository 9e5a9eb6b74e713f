"""Every configuration of three segments that reaches a pose.

The host looks through the swept equation of ``reduction`` for zeros and polishes each in six
variables: sign changes, near-double zeros at the vertex of a parabola, and the folds where both
roots for q1 meet. Planar targets make the reduction singular and have their own search.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from muxjax.batched import WIDE_VECTORS
from muxjax.batched.formulas import product
from muxjax.ik.arcs import Array, Numbers, conjugate
from muxjax.ik.newton import Solved, in_pieces, newton, padded, smallest_singular, solved
from muxjax.ik.planar import planar_seeds
from muxjax.ik.reduction import INTERVALS, Target, chord, equation, point, sweep
from muxjax.precision import padded_size

REFINEMENTS = 4  # regula falsi steps inside a bracket
POLISH_STEPS = 3
LATE_STEPS = 12  # more for those that are not there by then
POLISH_DAMPING = 1e-3
SAME = 1e-6  # [rad] between two bendings that are one solution
NEARLY_SAME = 3e-3  # [rad]; one solution if the bending between the two is a solution as well
PLANAR = 1e-6  # d and s_w / L below which a target is taken for planar
DENSE_INTERVALS = 512  # where INTERVALS found nothing
# Where that found nothing either:
STARTS = 64
SEARCH_STEPS = 30
SEARCH_DAMPING = 0.1
NEAR = 1e-3  # error, over the arm's length or [rad], from which the polish goes on
SWEEP_ROWS = (1, 16, 256)
SWEEP_ROWS_ELSEWHERE = (16, 4096)  # on a GPU
BEYOND_LIMIT = 0.2  # [rad] by which a candidate may pass its bending limit before it is polished
# A solution may pass its bending limit by this much [rad] and is then taken to lie on it.
AT_LIMIT = 1e-9
SIDES = np.array([1.0, 1.0, -1.0, -1.0])  # of q1 in the four parts that ``sweep`` returns
SIGNS = np.array([1.0, -1.0, 1.0, -1.0])  # of w_2


class Seeds(NamedTuple):
    """Brackets [low, high] of zeros of E along the curve; low = high is a guess without one."""

    row: Int[np.ndarray, " n"]  # of the targets
    side: Float[np.ndarray, " n"]
    sign: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]  # t [rad]
    high: Float[np.ndarray, " n"]
    at_low: Float[np.ndarray, " n"]  # E [m]
    at_high: Float[np.ndarray, " n"]


class Found(NamedTuple):
    """Solutions of all targets in one list, ordered by target."""

    row: Int[np.ndarray, " n"]
    b: Float[np.ndarray, "n dof"]  # Cartesian bending [rad]
    singular: Float[np.ndarray, " n"]
    position: Float[np.ndarray, " n"]  # error [m]
    angle: Float[np.ndarray, " n"]  # error [rad]


def solutions_of_three(
    length: Float[np.ndarray, " 3"],
    theta_max: Float[np.ndarray, " 3"],
    goal: Float[np.ndarray, "7 rows"],
    tolerance: tuple[float, float],
) -> tuple[Found, Bool[np.ndarray, " rows"]]:
    """All solutions within the limits, and for which targets the search was exhaustive.

    Args:
        length: L_i [m].
        theta_max: Limits up to pi [rad].
        goal: Positions [m] and unit quaternions (w, x, y, z) of the last disc from the root.
        tolerance: Of a solution's position [m] and angle [rad].
    """
    target = reduction_target(goal)
    planar = _planar(length, target)
    row, b = _seeds_of(length, theta_max, target, np.flatnonzero(~planar), INTERVALS)
    found = _polished(length, theta_max, goal, row, b, tolerance)
    missing = np.setdiff1d(np.flatnonzero(~planar), found.row)
    parts = [found]
    if len(missing):
        row, b = _seeds_of(length, theta_max, target, missing, DENSE_INTERVALS)
        parts.append(_polished(length, theta_max, goal, row, b, tolerance))
        missing = np.setdiff1d(missing, parts[-1].row)
    if len(missing):
        row, b = _searched(length, theta_max, goal, missing)
        parts.append(_polished(length, theta_max, goal, row, b, tolerance))
    if planar.any():
        rows = np.flatnonzero(planar)
        row, b = planar_seeds(length, theta_max, goal, rows)
        parts.append(_polished(length, theta_max, goal, row, b, tolerance))
    order = np.argsort(np.concatenate([p.row for p in parts]), kind="stable")
    merged = Found(*(np.concatenate(x)[order] for x in zip(*parts, strict=True)))
    family = np.abs(target[1]) + np.abs(target[2]) < PLANAR * length.sum()
    return merged, ~(planar & family)


def reduction_target(goal: Float[np.ndarray, "7 rows"]) -> Float[np.ndarray, "8 rows"]:
    """S = (0, p) q and q."""
    p, q = goal[:3], goal[3:]
    s = product((np.zeros_like(p[0]), *p), tuple(q))
    return np.stack([*s, *q])


def _searched(
    length: Float[np.ndarray, " 3"],
    theta_max: Float[np.ndarray, " 3"],
    goal: Float[np.ndarray, "7 rows"],
    rows: Int[np.ndarray, " n"],
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "6 m"]]:
    """The last resort: where damped steps from starts all over the limits come near a target."""
    from scipy.stats import qmc  # takes a third of a second to import, and is seldom needed

    unit = qmc.Halton(6, scramble=False).random(STARTS + 1)[1:]
    theta, phi = theta_max * np.sqrt(unit[:, :3]), 2 * np.pi * unit[:, 3:]
    starts = np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1).reshape(STARTS, 6)
    row, b = np.repeat(rows, STARTS), np.tile(starts.T, len(rows))
    at = newton(
        length, b, goal[:, row], steps=SEARCH_STEPS, damping=SEARCH_DAMPING, theta_max=theta_max
    )
    near = solved(at, NEAR * length.sum(), NEAR)
    return row[near], at.b[:, near]


def _planar(
    length: Float[np.ndarray, " 3"], target: Float[np.ndarray, "8 rows"]
) -> Bool[np.ndarray, " rows"]:
    return np.abs(target[7]) + np.abs(target[0]) / length.sum() < PLANAR


def _seeds_of(
    length: Float[np.ndarray, " 3"],
    theta_max: Float[np.ndarray, " 3"],
    target: Float[np.ndarray, "8 rows"],
    rows: Int[np.ndarray, " n"],
    intervals: int,
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "6 m"]]:
    """Target and bending of every candidate."""
    w_min = np.cos(theta_max / 2)
    found = []
    start = 0
    while start < len(rows):
        size = padded_size(len(rows) - start, SWEEP_ROWS, SWEEP_ROWS_ELSEWHERE)
        piece = rows[start : start + size]
        start += size
        part = padded(target[:, piece], size)
        limit, values = sweep(length, w_min, Target(tuple(part[:4]), tuple(part[4:])), intervals)
        t = np.asarray(limit)[:, None] * np.linspace(-1.0, 1.0, intervals + 1)
        kept = [np.asarray(v)[: len(piece)] for v in values]
        parts = np.stack([part for v in kept for part in (v.real, v.imag)])
        found.append(_look(piece, t[: len(piece)], parts))
    if not found:
        return np.zeros(0, int), np.zeros((6, 0))
    seeds = Seeds(*(np.concatenate(x) for x in zip(*found, strict=True)))
    b = _refined(length, target[:, seeds.row], seeds)
    theta = np.hypot(b[0::2], b[1::2])
    near = (theta < theta_max[:, None] + BEYOND_LIMIT).all(axis=0)  # false for NaN as well
    return seeds.row[near], b[:, near]


def _look(
    rows: Int[np.ndarray, " rows"],
    t: Float[np.ndarray, "rows samples"],
    values: Float[np.ndarray, "parts rows samples"],
) -> Seeds:
    """Brackets and guesses in the swept equation, all four parts in one list."""
    n = len(rows)
    line, *ends = _brackets(np.tile(t, (4, 1)), values.reshape(4 * n, -1))
    part, row = np.divmod(line, n)
    brackets = Seeds(rows[row], SIDES[part], SIGNS[part], *ends)
    plus, minus = (values[k : k + 2].reshape(2 * n, -1) for k in (0, 2))
    line, side, guess = _folds(np.tile(t, (2, 1)), plus, minus)
    part, row = np.divmod(line, n)
    none = np.zeros(len(row))
    folds = Seeds(rows[row], side, SIGNS[part], guess, guess, none, none)
    return Seeds(*(np.concatenate(x) for x in zip(brackets, folds, strict=True)))


def _brackets(
    t: Float[np.ndarray, "rows samples"], e: Float[np.ndarray, "rows samples"]
) -> tuple[np.ndarray, ...]:
    """Row, both ends and E at them: of sign changes, and of near-double zeros."""
    row, k = np.nonzero(e[:, 1:] * e[:, :-1] <= 0)
    found = [(row, t[row, k], t[row, k + 1], e[row, k], e[row, k + 1])]
    rise = np.diff(e, axis=1)
    # Where E turns on its way to zero, two zeros may lie between samples of one sign.
    row, k = np.nonzero((rise[:, :-1] * rise[:, 1:] < 0) & (rise[:, :-1] * e[:, 1:-1] < 0))
    k = k + 1
    here = e[row, k]
    same = (here * e[row, k - 1] > 0) & (here * e[row, k + 1] > 0)
    row, k, here = row[same], k[same], here[same]
    slope = 0.5 * (e[row, k + 1] - e[row, k - 1])
    curve = e[row, k + 1] - 2 * here + e[row, k - 1]
    square = slope * slope - 2 * here * curve  # of the parabola's zeros, in intervals
    near = square > -0.3 * curve * curve
    row, k, slope, curve, square = (x[near] for x in (row, k, slope, curve, square))
    step = t[row, 1] - t[row, 0]
    half = np.sqrt(np.maximum(square, 1e-4 * curve * curve))
    for branch in (-1.0, 1.0):
        guess = t[row, k] + step * np.clip((-slope + branch * half) / curve, -1.0, 1.0)
        zero = np.zeros(len(row))
        found.append((row, guess, guess, zero, zero))
    return tuple(np.concatenate(x) for x in zip(*found, strict=True))


def _folds(
    t: Float[np.ndarray, "rows samples"],
    plus: Float[np.ndarray, "rows samples"],
    minus: Float[np.ndarray, "rows samples"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, side and t of zeros between the last sample with roots for q1 and the fold.

    Towards the fold the mean A of E over both roots is nearly linear in t and the square D^2 of
    half their difference as well, zero at the fold: A^2 = D^2 has the zeros of E, and E = A + D
    or A - D tells on which side they are.
    """
    mean, half = 0.5 * (plus + minus), 0.5 * (plus - minus)
    there = np.isfinite(half)
    found = []
    for inward in (-1, 1):
        beyond = np.zeros_like(there)
        before = np.zeros_like(there)
        if inward < 0:
            beyond[:, :-1], before[:, 1:] = ~there[:, 1:], there[:, :-1]
        else:
            beyond[:, 1:], before[:, :-1] = ~there[:, :-1], there[:, 1:]
        row, k = np.nonzero(there & beyond & before)
        j = k + inward
        a, slope = mean[row, k], mean[row, k] - mean[row, j]
        square = half[row, k] ** 2
        fall = half[row, j] ** 2 - square  # a step
        # (a + slope x)^2 = square - fall x for x steps towards the fold
        p, q, r = slope * slope, 2 * a * slope + fall, a * a - square
        root = np.sqrt(np.maximum(q * q - 4 * p * r, 0.0))
        safe = np.where(p > 0, 2 * p, 1e-300)
        for branch in (-1.0, 1.0):
            x = (-q + branch * root) / safe
            fold = square / np.where(fall > 0, fall, 1e-300)
            good = (x > -0.5) & (x < np.minimum(fold, 1.0) + 0.5) & (fall > 0)
            good &= q * q - 4 * p * r > -0.3 * q * q
            x = np.clip(x, 0.0, np.minimum(fold, 1.0))
            side = np.where((a + slope * x) * half[row, k] > 0, -1.0, 1.0)
            step = (t[row, k] - t[row, j]) * x
            found.append((row[good], side[good], (t[row, k] + step)[good]))
    return tuple(np.concatenate(x) for x in zip(*found, strict=True))  # type: ignore[return-value]


def _refined(
    length: Float[np.ndarray, " 3"], target: Float[np.ndarray, "8 n"], seeds: Seeds
) -> Float[np.ndarray, "6 n"]:
    """Bending of each seed after regula falsi inside its bracket."""
    ends = np.empty((6, len(seeds.row)))
    for piece, size in in_pieces(len(seeds.row)):
        part = padded(target[:, piece], size)
        args = [padded(x[piece], size) for x in seeds[1:]]
        found = _refine(length, Target(tuple(part[:4]), tuple(part[4:])), *args)
        for k, values in enumerate(found):
            ends[k, piece] = np.asarray(values)[: piece.stop - piece.start]
    return ends


@partial(jax.jit, compiler_options=WIDE_VECTORS)
def _refine(
    length: Array,
    target: Target,
    side: Array,
    sign: Array,
    low: Array,
    high: Array,
    at_low: Array,
    at_high: Array,
) -> Numbers:
    """Regula falsi with the Illinois rule, and the bending at its last point."""

    def inside(low: Array, high: Array, at_low: Array, at_high: Array) -> Array:
        rise = at_high - at_low
        return low - (high - low) * at_low / jnp.where(rise == 0, 1.0, rise)

    def body(_: Array | int, ends: Numbers) -> Numbers:
        low, high, at_low, at_high = ends
        t = inside(*ends)
        value = equation(length, point(length, target, t, side), sign)
        # The new point replaces the end of its sign; a kept end counts half the next time.
        left = value * at_low > 0
        return (
            jnp.where(left, t, low),
            jnp.where(left, high, t),
            jnp.where(left, value, 0.5 * at_low),
            jnp.where(left, 0.5 * at_high, value),
        )

    t = inside(*lax.fori_loop(0, REFINEMENTS, body, (low, high, at_low, at_high)))
    return _bending(length, target, jnp.where(low < high, t, low), side, sign)


def _bending(length: Array, target: Target, t: Array, side: Array, sign: Array) -> Numbers:
    """Cartesian bending of all segments at a point of the curve."""
    # A guess beside the fold may lie beyond it: there the two roots are one.
    at = point(length, target, t, side, clip=True)
    zero = jnp.zeros_like(t)
    q3 = (*at.q3, zero)
    q1 = (*at.q1, zero)
    q2 = product(conjugate(q1), product(target.q, conjugate(q3)))
    bending: list[Array] = []
    for q, way in ((q1, 1.0), (q2, sign), (q3, 1.0)):
        # e = (q_y, -q_x), b = 2 e / sinc(theta / 2)
        factor = 2 * way / chord(way * q[0])
        bending += [factor * q[2], -factor * q[1]]
    return tuple(bending)


def _polished(
    length: Float[np.ndarray, " 3"],
    theta_max: Float[np.ndarray, " 3"],
    goal: Float[np.ndarray, "7 rows"],
    row: Int[np.ndarray, " n"],
    b: Float[np.ndarray, "6 n"],
    tolerance: tuple[float, float],
) -> Found:
    """The distinct solutions among polished candidates."""
    order = np.argsort(row, kind="stable")
    row, b = row[order], b[:, order]
    at = newton(length, b, goal[:, row], steps=POLISH_STEPS, damping=POLISH_DAMPING)
    late = np.flatnonzero(~solved(at, *tolerance))
    if len(late):
        again = newton(
            length, at.b[:, late], goal[:, row[late]], steps=LATE_STEPS, damping=POLISH_DAMPING
        )
        for kept, new in zip(at, again, strict=True):
            kept[..., late] = new
    theta = np.hypot(at.b[0::2], at.b[1::2])
    inside = (theta <= theta_max[:, None] + AT_LIMIT).all(axis=0)
    good = np.flatnonzero(solved(at, *tolerance) & inside)
    row, at = row[good], Solved(*(x[..., good] for x in at))

    def is_solution(row: np.ndarray, b: np.ndarray) -> np.ndarray:
        return solved(newton(length, b, goal[:, row], steps=0), *tolerance)

    kept = ~repeated(row, at.b, is_solution)
    b = at.b[:, kept]
    return Found(row[kept], b.T, smallest_singular(length, b), at.position[kept], at.angle[kept])


def repeated(
    row: Int[np.ndarray, " n"],
    b: Float[np.ndarray, "dof n"],
    is_solution: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Bool[np.ndarray, " n"]:
    """Which solutions an earlier one of the same target equals; the list is ordered by target.

    Args:
        row: Target of each.
        b: Cartesian bending [rad].
        is_solution: Whether bendings solve targets, given the targets and the bendings.
    """
    again = np.zeros(len(row), bool)
    for gap in range(1, len(row)):
        same_row = row[gap:] == row[:-gap]
        if not same_row.any():
            break
        later = np.flatnonzero(same_row) + gap
        away = np.abs(b[:, later] - b[:, later - gap]).max(axis=0)
        close = away < SAME
        unsure = np.flatnonzero(~close & (away < NEARLY_SAME))
        if len(unsure):
            pair = later[unsure]
            close[unsure] = is_solution(row[pair], 0.5 * (b[:, pair] + b[:, pair - gap]))
        again[later[close]] = True
    return again
