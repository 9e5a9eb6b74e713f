"""Medians over targets, paired differences, and which points others dominate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

RESAMPLES = 4000
CONFIDENCE = 0.95


class Spread(NamedTuple):
    """Median and interquartile range, as Table II states them."""

    median: float
    iqr: float


class Interval(NamedTuple):
    """Median of paired differences and its bootstrap interval at 95 % confidence."""

    median: float
    low: float
    high: float


def spread(values: Sequence[float] | Float[np.ndarray, " n"]) -> Spread:
    """Median and interquartile range, with linear interpolation between ranks.

    Raises:
        ValueError: No values, or one that is not finite.
    """
    low, middle, high = np.percentile(_finite("values", values), [25, 50, 75])
    return Spread(float(middle), float(high - low))


def paired_difference(
    ours: Sequence[float] | Float[np.ndarray, " n"],
    theirs: Sequence[float] | Float[np.ndarray, " n"],
    *,
    seed: int = 0,
) -> Interval:
    """Median of ours minus theirs over the same targets, with a percentile bootstrap interval.

    Targets are resampled, not methods: a hard target stays hard for both.

    Args:
        ours: A value a target.
        theirs: Values of the same targets, in the same order.
        seed: Of the 4000 resamples.

    Raises:
        ValueError: No values, numbers of targets that differ, or a value that is not finite.
    """
    left, right = _finite("ours", ours), _finite("theirs", theirs)
    if left.shape != right.shape:
        raise ValueError(f"ours, theirs: {len(left)} targets against {len(right)}, must be paired")
    return median_interval(left - right, seed=seed)


def median_interval(
    values: Sequence[float] | Float[np.ndarray, " n"], *, seed: int = 0
) -> Interval:
    """Median with its percentile bootstrap interval.

    Raises:
        ValueError: No values, or one that is not finite.
    """
    given = _finite("values", values)
    drawn = np.random.default_rng(seed).integers(len(given), size=(RESAMPLES, len(given)))
    medians = np.median(given[drawn], axis=1)
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(medians, [tail, 100 - tail])
    return Interval(float(np.median(given)), float(low), float(high))


def dominated_by(name: str, points: Mapping[str, Sequence[float]]) -> list[str]:
    """Names of points that are nowhere worse than the named one and somewhere better.

    All coordinates are costs: less is better.
    """
    own = np.asarray(points[name])
    return [
        other
        for other, point in points.items()
        if other != name and np.all(np.asarray(point) <= own) and np.any(np.asarray(point) < own)
    ]


def _finite(name: str, values: Sequence[float] | Float[np.ndarray, " n"]) -> np.ndarray:
    given = np.asarray(values, dtype=np.float64)
    if given.ndim != 1 or not len(given):
        raise ValueError(f"{name}: must be a row of numbers, found shape {given.shape}")
    if not np.isfinite(given).all():
        raise ValueError(f"{name}: entry {int(np.argmin(np.isfinite(given)))} is not finite")
    return given
