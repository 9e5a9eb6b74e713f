"""Equilibria along a path of tendon lengths: each sample starts from the one before.

A slow motion stays on its branch of equilibria as long as that is stable, and falls to a lower one
where it ends. The iteration of ``newton`` lowers the energy from where it starts, so warm starts
follow the branch and find what the arm falls to.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from muxjax.precision import host_array
from muxjax.statics.chain import ElasticChain
from muxjax.statics.checks import check_chain, check_given
from muxjax.statics.forward import forward_statics, outputs
from muxjax.statics.loads import Loads
from muxjax.statics.newton import Solution, solve

Array = Any

LANES = (8, 32)  # paths that are compiled as one
ITERATIONS = 25
PIECES = (4,)  # into which a step is cut where it did not converge
NUDGE = 1e-2  # [rad]; off an unstable equilibrium, which no real arm keeps


class Branch(eqx.Module):
    """Equilibria at P samples of a path, for any leading batch axes.

    Where ``converged`` is false the row is the iteration's last posture, not a solution.
    """

    angles: Float[np.ndarray, "*batch P n"]  # of the joints [rad]
    tension: Float[np.ndarray, "*batch P m"]  # [N]
    pose: Float[np.ndarray, "*batch P 4 4"]  # tip in the world
    segment_ends: Float[np.ndarray, "*batch P S 4 4"]  # in the world
    residual: Float[np.ndarray, "*batch P"]  # largest moment left at a joint [N m]
    converged: Bool[np.ndarray, "*batch P"]
    stable: Bool[np.ndarray, "*batch P"]


def follow(
    chain: ElasticChain,
    displacements: Float[Array, "*batch P m"],
    *,
    payload: float = 0.0,
) -> Branch:
    """Equilibria at consecutive samples of one path, or of a batch of paths of as many samples.

    The first sample is solved from the default start. A step that does not converge is cut into
    pieces; a sample that still does not is reported as such, and the next one starts from the
    last posture that did. From an unstable equilibrium the arm is nudged.

    Args:
        chain: The arm.
        displacements: Of each tendon's proximal end [m], negative = wound in; P samples.
        payload: Mass at the tip frame's origin [kg].

    Raises:
        ValueError: Wrong shape, not finite, a tendon wound in by more than its length, a payload
            below 0, or a chain that cannot be solved; names the field and the limit.
    """
    check_chain(chain, "displacements", "virtual_work")
    values = check_given(chain, displacements, "displacements")
    if values.ndim < 2 or not values.shape[-2]:
        raise ValueError(f"displacements: needs samples along a path, found shape {values.shape}")
    batch, (samples, m) = values.shape[:-2], values.shape[-2:]
    rows = values.reshape(-1, samples, m)
    wrench = payload_wrench(chain, payload)
    host = jax.tree.map(lambda x: np.asarray(x, np.float64), chain)
    walker = _Walker(host, wrench)
    parts = [walker.walk(rows[i : i + LANES[-1]]) for i in range(0, len(rows), LANES[-1])]
    whole = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Branch(*(x.reshape((*batch, *x.shape[1:])) for x in whole))


def payload_wrench(chain: ElasticChain, payload: float) -> Float[np.ndarray, "6"] | None:
    """Weight of a mass [kg] at the tip, as moment and force in the base frame; None for none.

    Raises:
        ValueError: The mass is below 0 or not finite.
    """
    mass = float(host_array("payload", payload))
    if mass < 0:
        raise ValueError(f"payload: must be at least 0 kg, found {mass:g}")
    if mass == 0:
        return None
    return np.concatenate([np.zeros(3), mass * np.asarray(chain.gravity)])


class _Walker:
    """Steps a few paths at once; rows first outside, batch last inside."""

    def __init__(self, chain: ElasticChain, wrench: Float[np.ndarray, "6"] | None) -> None:
        self.chain, self.wrench = chain, wrench
        self.nudge = NUDGE * np.random.default_rng(0).standard_normal(chain.n_joints)

    def walk(self, rows: Float[np.ndarray, "B P m"]) -> tuple[np.ndarray, ...]:
        """All samples of all rows, in the order of the fields of ``Branch``."""
        first = forward_statics(self.chain, displacements=rows[:, 0], tip_wrench=self.wrench)
        angles, done = first.angles, first.converged & first.stable
        angles = np.where(first.converged[:, None], angles, 0.0)
        found = []
        for k in range(rows.shape[1]):
            before = rows[:, max(k - 1, 0)]
            now = self.step(angles, before, rows[:, k])
            if k == 0:
                now.converged[:] |= done
            angles = np.where(now.converged[:, None], now.q, angles)
            found.append(now)
        q, tension, residual, converged, stable = (
            np.stack([getattr(x, name) for x in found], axis=1)
            for name in ("q", "tension", "residual", "converged", "stable")
        )
        pose, ends, folded = self.frames(q, tension)
        return q, tension, pose, ends, residual, converged & ~folded, stable

    def step(
        self,
        angles: Float[np.ndarray, "B n"],
        before: Float[np.ndarray, "B m"],
        after: Float[np.ndarray, "B m"],
    ) -> Solution:
        """The next sample, in one step or in several."""
        found = self.solve(angles, after)
        for pieces in PIECES:
            rest = np.flatnonzero(~found.converged)
            if not len(rest):
                break
            q = angles[rest]
            for share in np.arange(1, pieces + 1) / pieces:
                stage = self.solve(q, before[rest] + share * (after - before)[rest])
                q = np.where(np.isfinite(stage.q), stage.q, q)
            _put(found, rest, stage)
        unstable = np.flatnonzero(found.converged & ~found.stable)
        if len(unstable):
            stage = self.solve(found.q[unstable] + self.nudge, after[unstable])
            better = stage.converged
            _put(found, unstable[better], Solution(*(x[better] for x in stage)))
        return found

    def solve(self, angles: Float[np.ndarray, "B n"], given: Float[np.ndarray, "B m"]) -> Solution:
        """One round of the iteration, rows first; filled up to a compiled number of lanes."""
        count = len(given)
        lanes = next(n for n in LANES if n >= count)
        pick = np.minimum(np.arange(lanes), count - 1)
        with jax.enable_x64(True):
            found = _solved(self.chain, angles[pick].T, given[pick].T, self.wrench)
            return Solution(*(np.array(np.moveaxis(x, -1, 0)[:count]) for x in found))

    def frames(
        self, q: Float[np.ndarray, "B P n"], tension: Float[np.ndarray, "B P m"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tips, segment ends, and whether holes have crossed."""
        lanes = next(n for n in LANES if n >= len(q))
        pick = np.minimum(np.arange(lanes), len(q) - 1)
        parts = []
        with jax.enable_x64(True):
            for k in range(q.shape[1]):
                out = _frames(self.chain, q[pick, k].T, tension[pick, k].T)
                parts.append([np.asarray(x)[: len(q)] for x in out])
        pose, ends, folded = (np.stack(x, axis=1) for x in zip(*parts, strict=True))
        return pose, ends, folded


def _put(into: Solution, rows: Any, new: Solution) -> None:
    for old, value in zip(into, new, strict=True):
        old[rows] = value


@eqx.filter_jit
def _solved(chain: ElasticChain, q0: Array, given: Array, wrench: Array | None) -> Solution:
    def every(load: Array) -> Array:
        return jnp.broadcast_to(jnp.asarray(load)[:, None], (len(load), given.shape[-1]))

    loads = Loads(every(chain.gravity), None if wrench is None else every(wrench))
    return solve(
        chain,
        q0,
        given,
        loads,
        kind="displacements",
        kernel="virtual_work",
        max_iterations=ITERATIONS,
    )


@eqx.filter_jit
def _frames(chain: ElasticChain, q: Array, tension: Array) -> tuple[Array, Array, Array]:
    _, pose, ends, folded = outputs(chain, q, tension, "virtual_work")
    return pose, ends, folded
