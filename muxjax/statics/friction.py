"""Tendon friction at the holes (capstan), and its hysteresis between winding in and paying out.

A tendon that slides over a hole by which it turns through the angle w keeps exp(-mu w) of its
tension, seen in the direction of motion. Wound in, it slides towards the base and tension falls
with every hole; paid out, tension rises towards the end. With sigma = 1 for winding in and -1 for
paying out, and W the angle turned from the wheel on, a tendon of tension t at the wheel has
t exp(-sigma mu W) on its way, and stretches by the mean of that over its path.

All holes of a tendon are taken to slide as its end at the wheel last did. On a reversal they do not
all turn over at once: sigma goes from one end of its range to the other while the wheel moves by
``presliding``. A tendon held by its worm keeps its sigma. Which hole sticks is not modelled, nor
that other tendons' motion may drag a held one through its holes.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from muxjax.precision import host_array
from muxjax.statics import kernel as kn
from muxjax.statics.chain import ElasticChain
from muxjax.statics.checks import check_chain, check_given
from muxjax.statics.forward import forward_statics, outputs
from muxjax.statics.implicit import residual_of
from muxjax.statics.loads import Loads
from muxjax.statics.tension import ramp

Array = Any

ITERATIONS = 40
TOLERANCE = 1e-9  # of the largest moment left, over the mean stiffness of a joint [rad]
MAX_STEP = 0.1  # [rad]
CORNER = 1e-3  # [rad]; rounds off |turn| where a tendon runs straight through a hole


class FrictionPath(eqx.Module):
    """Equilibria with friction at P samples of a path; none where ``converged`` is false."""

    displacements: Float[np.ndarray, "P m"]  # length commands [m]
    angles: Float[np.ndarray, "P n"]  # of the joints [rad]
    tension: Float[np.ndarray, "P m"]  # at the wheel [N]
    end_tension: Float[np.ndarray, "P m"]  # at each tendon's end [N]
    sigma: Float[np.ndarray, "P m"]  # 1 winding in, -1 paying out
    pose: Float[np.ndarray, "P 4 4"]  # tip in the world
    residual: Float[np.ndarray, " P"]  # largest moment left at a joint [N m]
    converged: Bool[np.ndarray, " P"]

    @property
    def work(self) -> float:
        """Work that the wheels did along the path [J]; over a closed one, what friction took."""
        pull = 0.5 * (self.tension[1:] + self.tension[:-1])
        return float(-(pull * np.diff(self.displacements, axis=0)).sum())


def friction_path(
    chain: ElasticChain,
    displacements: Float[Array, "P m"],
    friction: float,
    *,
    presliding: float = 5e-4,
    sigma: Float[Array, " m"] | None = None,
) -> FrictionPath:
    """Equilibria along a path of tendon lengths, with friction at every hole.

    Args:
        chain: The arm.
        displacements: Of each tendon's proximal end [m], in steps small enough for warm starts.
        friction: Coefficient mu (steel rope in a metal hole: 0.1 to 0.2; assumed).
        presliding: Wheel motion over which friction turns round [m] (assumed).
        sigma: Direction at the start, in [-1, 1]; by default 0, no friction yet.

    Raises:
        ValueError: Wrong shape, not finite, friction below 0, presliding not above 0, sigma
            outside [-1, 1], or a chain whose holes do not make a regular layout; names the field.
    """
    check_chain(chain, "displacements", "virtual_work")
    values = check_given(chain, displacements, "displacements")
    if values.ndim != 2 or not len(values):
        raise ValueError(f"displacements: must have shape (P, m), found {values.shape}")
    mu, reversal = (
        float(host_array(name, x))
        for name, x in (("friction", friction), ("presliding", presliding))
    )
    if mu < 0:
        raise ValueError(f"friction: must be at least 0, found {mu:g}")
    if reversal <= 0:
        raise ValueError(f"presliding: must be above 0 m, found {reversal:g}")
    if not chain.layout.regular:
        raise ValueError("chain: friction needs a hole of every tendon at both ends of an element")
    start = np.zeros(chain.n_tendons) if sigma is None else host_array("sigma", sigma)
    if start.shape != (chain.n_tendons,) or (abs(start) > 1).any():
        raise ValueError(f"sigma: must be {chain.n_tendons} numbers in [-1, 1], found {start}")
    directions = _directions(values, start, reversal)
    host = jax.tree.map(lambda x: np.asarray(x, np.float64), chain)
    return _walk(host, values, directions, mu)


def winding_loop(
    chain: ElasticChain,
    tendon: int,
    *,
    depth: float,
    friction: float,
    hold: Float[Array, " m"] | None = None,
    steps: int = 40,
    presliding: float = 5e-4,
) -> FrictionPath:
    """One tendon wound in by ``depth`` and paid out again, then both once more.

    The second round (the last ``2 steps + 1`` samples) is the closed loop: the first begins
    without friction. Plot ``-displacements[:, tendon - 1]`` against ``tension[:, tendon - 1]``.

    Args:
        chain: The arm.
        tendon: Which, from 1.
        depth: How far it is wound in [m], above 0.
        friction: Coefficient mu.
        hold: Displacements of all tendons at the start [m]; by default all others are paid out by
            ``depth``, so that the arm can bend.
        steps: Samples on each of the four ways.
        presliding: Wheel motion over which friction turns round [m].

    Raises:
        ValueError: No such tendon, a depth that is not above 0, or as for ``friction_path``.
    """
    if not 1 <= tendon <= chain.n_tendons:
        raise ValueError(f"tendon: the chain has tendons 1 to {chain.n_tendons}, found {tendon}")
    if not (np.isfinite(depth) and depth > 0):
        raise ValueError(f"depth: must be above 0 m, found {depth!r}")
    if steps < 1:
        raise ValueError(f"steps: must be at least 1, found {steps}")
    base = np.full(chain.n_tendons, float(depth)) if hold is None else host_array("hold", hold)
    base = np.array(base)
    if hold is None:
        base[tendon - 1] = 0.0
    wound = np.interp(np.arange(4 * steps + 1), np.arange(5) * steps, [0.0, 1.0, 0.0, 1.0, 0.0])
    path = np.tile(base, (len(wound), 1))
    path[:, tendon - 1] -= depth * wound
    return friction_path(chain, path, friction, presliding=presliding)


def _directions(
    values: Float[np.ndarray, "P m"], start: Float[np.ndarray, " m"], presliding: float
) -> Float[np.ndarray, "P m"]:
    """Direction of every sample: it follows the wheel within [-1, 1] (a play operator)."""
    sigma = [start]
    for change in np.diff(values, axis=0):
        sigma.append(np.clip(sigma[-1] - 2 * change / presliding, -1.0, 1.0))
    return np.stack(sigma)


def _walk(
    chain: ElasticChain,
    values: Float[np.ndarray, "P m"],
    sigma: Float[np.ndarray, "P m"],
    mu: float,
) -> FrictionPath:
    q = forward_statics(chain, displacements=values[0]).angles  # without friction, as a start
    found = []
    with jax.enable_x64(True):
        for given, direction in zip(values, sigma, strict=True):
            row = [np.asarray(x) for x in _solve(chain, q, given, direction, np.float64(mu))]
            q = row[0] if row[-1] else q
            found.append(row)
    angles, tension, end_tension, pose, residual, converged = map(
        np.stack, zip(*found, strict=True)
    )
    return FrictionPath(values, angles, tension, end_tension, sigma, pose, residual, converged)


@eqx.filter_jit
def _solve(
    chain: ElasticChain,
    q0: Float[Array, " n"],
    given: Float[Array, " m"],
    sigma: Float[Array, " m"],
    mu: Float[Array, ""],
) -> tuple[Array, ...]:
    """Newton on the moments, with the step halved until the largest moment falls."""
    scale = jnp.mean(jnp.asarray(chain.stiffness))

    def moments(q: Float[Array, " n"]) -> Float[Array, " n"]:
        return unbalanced(chain, q, given, sigma, mu)

    def improve(state: tuple[Array, ...]) -> tuple[Array, ...]:
        q, left, count = state
        step = -jnp.linalg.solve(jax.jacfwd(moments)(q), left)
        step = step * jnp.minimum(1.0, MAX_STEP / (jnp.max(jnp.abs(step)) + 1e-30))
        tried = q + jnp.array([1.0, 0.5, 0.2, 0.05, 0.01])[:, None] * step
        after = jax.vmap(moments)(tried)
        best = jnp.argmin(jnp.sum(after**2, axis=-1))
        return tried[best], after[best], count + 1

    def going(state: tuple[Array, ...]) -> Array:
        _, left, count = state
        return (jnp.max(jnp.abs(left)) > TOLERANCE * scale) & (count < ITERATIONS)

    q, left, _ = jax.lax.while_loop(going, improve, (q0, moments(q0), 0))
    frames = kn.frames_of(chain, kn.per_joint(chain, q[:, None]))
    at_wheel, share = _tensions(chain, kn.chords_of(chain, frames), given, sigma, mu)
    # A tendon's chords fill the elements from the base on.
    last = share[chain.layout.used.sum(axis=0) - 1, np.arange(chain.n_tendons)]
    _, pose, _, folded = outputs(chain, q[:, None], at_wheel, "virtual_work")
    residual = jnp.max(jnp.abs(left))
    done = (residual <= TOLERANCE * scale) & ~folded[0]
    return q, at_wheel[:, 0], (at_wheel * last)[:, 0], pose[0], residual, done


def unbalanced(
    chain: ElasticChain,
    q: Float[Array, " n"],
    given: Float[Array, " m"],
    sigma: Float[Array, " m"],
    mu: Float[Array, ""],
) -> Float[Array, " n"]:
    """Moment missing at each joint [N m], friction included."""
    lane = q[:, None]
    loads = Loads(jnp.asarray(chain.gravity)[:, None])
    none = jnp.zeros((chain.n_tendons, 1))
    passive = residual_of(chain, lane, none, loads, "virtual_work")
    frames = kn.frames_of(chain, kn.per_joint(chain, lane))
    chords = kn.chords_of(chain, frames)
    gradient = kn.length_gradient(chain, frames, chords)  # of every chord, as layouts are regular
    at_wheel, share = _tensions(chain, chords, given, sigma, mu)
    pull = jnp.sum(gradient * (at_wheel * share)[:, None], axis=2)
    return (passive + kn.from_joints(chain, pull))[:, 0]


def _tensions(
    chain: ElasticChain,
    chords: kn.Chords,
    given: Float[Array, " m"],
    sigma: Float[Array, " m"],
    mu: Float[Array, ""],
) -> tuple[Float[Array, "m 1"], Float[Array, "E m 1"]]:
    """Tension at the wheel [N], and what every chord has of it."""
    turned = jnp.cumsum(_turns(chain, chords), axis=0)
    share = jnp.exp(-mu * sigma[:, None] * turned)
    length = jnp.sum(chords.length, axis=0)
    # Stretch is the integral of tension: a tendon with less of it inside gives way less.
    stiffness = jnp.asarray(chain.tendon_stiffness)[:, None]
    mean = jnp.sum(share * chords.length, axis=0) / length
    excess = length - kn.straight_lengths(chain)[:, None] - given[:, None]
    return ramp(stiffness * excess / mean, jnp.asarray(chain.slack_width))[0], share


def _turns(chain: ElasticChain, chords: kn.Chords) -> Float[Array, "E m 1"]:
    """Angle by which each tendon turns at the proximal hole of every chord [rad].

    Into the base it runs along the arm's axis.
    """
    units = jnp.stack(chords.unit)  # (3, E, m, 1)
    into = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0])[:, None, None, None], units[:, :1].shape)
    before = jnp.concatenate([into, units[:, :-1]], axis=1)
    across = jnp.cross(before, units, axis=0)
    sine = jnp.sqrt(jnp.sum(across**2, axis=0) + CORNER**2) - CORNER
    angle = jnp.arctan2(sine, jnp.sum(before * units, axis=0))
    return jnp.where(chain.layout.used[..., None], angle, 0.0)
