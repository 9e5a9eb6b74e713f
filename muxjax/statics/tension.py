"""Tendon tension from stretch: tendons pull, they never push.

``virtual_work`` uses a ramp that is exactly 0 for s <= -w and exactly s for s >= w, with two
continuous derivatives between (w = ``chain.slack_width``); the paper's ``couple`` form uses
softplus, log(1 + exp(beta s)) / beta (S Eq. 30-31; the choice of kernel is ours, MODEL.md 9).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

Array = Any


def ramp(s: Array, width: Array) -> tuple[Array, Array, Array]:
    """Tension [N], its slope, and its integral [N^2] for a stretch s = K_t * (excess length) [N].

    Between -w and w, with y = s + w: phi = y^3 (4 w - y) / (16 w^3).
    """
    y = jnp.clip(s + width, 0.0, 2 * width)
    cube = 1 / (16 * width**3)
    taut = s > width
    value = jnp.where(taut, s, cube * y**3 * (4 * width - y))
    slope = jnp.where(taut, 1.0, cube * y**2 * (12 * width - 4 * y))
    integral = jnp.where(taut, 0.5 * s * s + 0.1 * width**2, cube * y**4 * (width - y / 5))
    return value, slope, integral


def inverse_ramp(tension: Array, width: Array) -> Array:
    """The stretch s [N] with ramp(s) = tension; -w, just slack, where the tension is 0.

    Newton on the convex part y^3 (4 w - y) = 16 w^3 t of the ramp, from above: monotone.
    """
    small = jnp.clip(tension, 0.0, width)
    safe = jnp.maximum(small, 1e-300)
    target = jax.lax.stop_gradient(16 * width**3 * safe)
    w = jax.lax.stop_gradient(width)
    # y^3 (4 w - y) >= 2 w y^3 for y <= 2 w, so this start is not below the root.
    y = jnp.cbrt(target / (2 * w))
    for _ in range(8):
        y = y - (y**3 * (4 * w - y) - target) / (y**2 * (12 * w - 4 * y))
    # One more step on the differentiable quantities carries the derivative of the root.
    y = y - (y**3 * (4 * width - y) - 16 * width**3 * safe) / (y**2 * (12 * w - 4 * y))
    return jnp.where(tension >= width, tension, jnp.where(tension > 0, y, 0.0) - width)


def softplus(s: Array, width: Array) -> tuple[Array, Array]:
    """Tension [N] and its slope, with beta = 1 / width; width * ln 2 at s = 0."""
    return width * jax.nn.softplus(s / width), jax.nn.sigmoid(s / width)


def inverse_softplus(tension: Array, width: Array) -> Array:
    """The s with softplus(s) = tension > 0; a tension of 0 is taken as 1e-12 N."""
    x = jnp.maximum(tension, 1e-12) / width
    return width * (x + jnp.log(-jnp.expm1(-x)))
