"""How coverage grows with the number of samples, and where it is going.

The marks that are still missing after N samples are the rarely hit ones. If the density of hit
rates near zero is a power law, the missing share falls as a power of N:

    coverage(N) = limit - a N^-b

The three numbers are fitted to the last points of a geometric ladder. The points are nested, not
independent, and the law is only an approximation; the uncertainty therefore is how much the limit
moves when the fit starts later or leaves the last point out, and never less than a tenth of the
step from the last point to the limit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

_EXPONENTS = np.geomspace(0.02, 2.0, 400)
_POINTS = 6


class Limit(NamedTuple):
    """Extrapolated coverage; NaN where the ladder is too short (fewer than five points)."""

    value: float
    uncertainty: float
    exponent: float  # b


def extrapolate(samples: Int[np.ndarray, " K"], coverage: Float[np.ndarray, " K"]) -> Limit:
    """Coverage at endlessly many samples.

    Args:
        samples: Sample counts, increasing.
        coverage: Share covered at each, between 0 and 1.
    """
    if len(samples) < 5:
        return Limit(float("nan"), float("nan"), float("nan"))
    n, c = np.asarray(samples, float)[-_POINTS:], np.asarray(coverage, float)[-_POINTS:]
    value, exponent = _fit(n, c)
    others = [_fit(n[1:], c[1:])[0], _fit(n[:-1], c[:-1])[0]]
    if len(n) > 5:
        others.append(_fit(n[2:], c[2:])[0])
    moved = max(abs(other - value) for other in others)
    return Limit(value, max(moved, 0.1 * abs(value - c[-1])), exponent)


def _fit(n: Float[np.ndarray, " K"], c: Float[np.ndarray, " K"]) -> tuple[float, float]:
    """Limit and exponent of least squares: linear in (limit, a) for each exponent on a grid."""
    best = (np.inf, float(c[-1]), 0.0)
    for b in _EXPONENTS:
        falling = (n / n[-1]) ** -b
        design = np.stack([np.ones_like(n), -falling], axis=1)
        (limit, a), *_ = np.linalg.lstsq(design, c, rcond=None)
        error = float(np.sum((design @ [limit, a] - c) ** 2))
        # A share cannot exceed one, nor fall below what was already seen.
        if error < best[0] and c[-1] <= limit + 1e-12 and limit <= 1 + 1e-12:
            best = (error, float(limit), float(b))
    return best[1], best[2]
