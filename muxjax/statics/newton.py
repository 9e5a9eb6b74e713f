"""Damped Newton iteration on a batch, joints first and batch last.

The default kernel is conservative: an equilibrium is a stationary point of elastic, gravity and
tendon energy, and a step must lower that energy. Where the tangent has negative eigenvalues, a
multiple mu of the joint stiffness is added first. Loads without potential (moments, following
wrenches) count by their work along the step, and the paper's couple load, which has none either,
by the norm of its residual.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.statics import kernel as kn
from muxjax.statics.chain import ElasticChain
from muxjax.statics.kernel import Kernel
from muxjax.statics.loads import Loads
from muxjax.statics.recursion import eliminate, solve_pivotless, substitute
from muxjax.statics.tension import inverse_ramp, inverse_softplus, ramp, softplus

Array = Any
Given = Literal["tension", "displacements"]

TOLERANCE = 1e-10  # largest moment left at a joint, over the mean stiffness of a joint [rad]
MAX_STEP = 0.5  # largest change of a joint angle in one iteration [rad]
STEPS = ("step", "stretch_step", "slope")  # what a posture without a usable step lacks
ENOUGH = 1e-4  # share of the predicted decrease that a step must bring


class Solution(NamedTuple):
    """What the iteration found; q in the chain's order."""

    q: Float[Array, "n B"]
    tension: Float[Array, "m B"]
    residual: Float[Array, " B"]  # largest moment left at a joint [N m]
    length_residual: Float[Array, " B"]  # largest length error left [m]
    converged: Bool[Array, " B"]
    stable: Bool[Array, " B"]
    iterations: Int[Array, " B"]


class Point(NamedTuple):
    """Everything of one posture that the iteration compares."""

    energy: Array  # (B,) merit without the work of moments
    moment: Array  # (E, p, B) forces without a potential
    residual: Array  # (B,)
    length_residual: Array  # (B,)
    slope: Array  # (B,) change of the merit along the Newton step
    step: Array  # (E, p, B)
    stretch_step: Array  # (m, B) of the couple kernel's s
    tension: Array  # (m, B)
    negative: Array  # (B,) eigenvalues below zero


class State(NamedTuple):
    """Of the loop: the best posture so far and the step that is tried from it."""

    q: Array
    stretch: Array  # (m, B) s of the couple kernel
    best: Point
    scale: Array  # share of the step that is tried
    damping: Array  # mu
    iterations: Array
    settled: Array  # the best posture is below the tolerances
    done: Array


def solve(
    chain: ElasticChain,
    q0: Float[Array, "n B"] | None,
    given: Float[Array, "m B"],
    loads: Loads,
    *,
    kind: Given,
    kernel: Kernel,
    max_iterations: int,
) -> Solution:
    """Equilibria for tensions [N] or displacements [m], from q0 or the default start."""
    lanes, dtype = given.shape[-1], given.dtype
    start = default_start(chain, given, kind) if q0 is None else kn.per_joint(chain, q0)
    stretch = jnp.broadcast_to(jnp.asarray(chain.slack_width), given.shape).astype(dtype)
    if kind == "tension":
        stretch = inverse_softplus(given, chain.slack_width)
    stiffness = jnp.mean(jnp.asarray(chain.stiffness))
    zero = jnp.zeros(lanes, dtype)
    blank = Point(
        jnp.full(lanes, jnp.inf, dtype),
        jnp.zeros_like(start),
        jnp.full(lanes, jnp.inf, dtype),
        zero,
        zero,
        jnp.zeros_like(start),
        jnp.zeros_like(given),
        jnp.zeros_like(given),
        jnp.zeros(lanes, jnp.int32),
    )

    def look(q: Array, stretch: Array, damping: Array) -> Point:
        return _look(chain, q, stretch, damping, given, loads, kind, kernel)

    def body(state: State) -> State:
        best, scale = state.best, state.scale
        q = state.q + scale * best.step
        stretch = state.stretch + scale * best.stretch_step
        point = look(q, stretch, state.damping)
        settled = (point.residual < TOLERANCE * stiffness) & (point.length_residual < TOLERANCE)
        accepted = _accepted(state, point) | (state.settled & settled)
        stuck = ~accepted & (scale < 1e-3)
        # At an accepted posture with an indefinite tangent there is no step yet, nor where the
        # step cannot be shortened any more: stay, and look again with more damping.
        wait = (accepted & (point.negative > 0) & ~settled) | stuck
        easier = jnp.where(accepted, _less(state.damping), state.damping)
        damping = jnp.where(wait, jnp.clip(10 * state.damping, 1e-2, 1e6), easier)
        q, stretch, point = _where(accepted, (q, stretch, point), (state.q, state.stretch, best))
        still = {name: jnp.where(wait, 0.0, getattr(point, name)) for name in STEPS}
        # Once below the tolerance, one more step without damping: it squares what is left.
        new = State(
            q,
            stretch,
            point._replace(**still),
            jnp.where(accepted | stuck, 1.0, 0.25 * scale),
            jnp.where(accepted & settled, 0.0, damping),
            state.iterations + 1,
            jnp.where(accepted, settled, state.settled),
            accepted & settled & state.settled,
        )
        return _where(state.done, state, new)

    def going(state: State) -> Array:
        return ~jnp.all(state.done | (state.iterations >= max_iterations))

    no = jnp.zeros(lanes, bool)
    first = State(start, stretch, blank, zero + 1, zero, jnp.zeros(lanes, jnp.int32), no, no)
    found = jax.lax.while_loop(going, body, first)
    return Solution(
        kn.from_joints(chain, found.q),
        found.best.tension,
        found.best.residual,
        found.best.length_residual,
        found.done,
        found.best.negative <= 0,
        found.iterations,
    )


def _where(condition: Array, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _less(damping: Array) -> Array:
    return jnp.where(damping < 1e-3, 0.0, 0.2 * damping)


def _accepted(state: State, point: Point) -> Array:
    """Whether the tried posture is better than the best one so far."""
    best, scale = state.best, state.scale
    change = point.energy - best.energy
    work = 0.5 * ((point.moment + best.moment) * scale * best.step).sum((0, 1))
    change = change - work
    # Below the rounding of the energy only the residual can tell.
    rounding = 1e-12 * (jnp.abs(point.energy) + 1e-9)
    lower = change <= ENOUGH * scale * best.slope
    level = (change <= rounding) & (point.residual <= best.residual)
    return (lower | level | jnp.isinf(best.energy)) & jnp.isfinite(point.energy)


def default_start(
    chain: ElasticChain, given: Float[Array, "m B"], kind: Given
) -> Float[Array, "E p B"]:
    """Straight for tensions; for lengths the linear answer of springs and two-sided tendons.

    q0 = K^-1 C' (C K^-1 C' + 1/K_t)^-1 dL, a weighted pinv(C) dL (MODEL.md section 9).
    """
    shape = (*chain.layout.joint.shape, given.shape[-1])
    if kind == "tension":
        return jnp.zeros(shape, given.dtype)
    gradient = straight_gradient(chain).astype(given.dtype)  # dl/dq = -C
    flexible = gradient / kn.per_joint(chain, chain.stiffness, 1.0)[:, :, None]
    small = jnp.einsum("epk,epl->kl", gradient, flexible)
    ridge = 1e-9 * jnp.trace(small) + 1 / jnp.asarray(chain.tendon_stiffness)
    tension = jnp.linalg.solve(small + jnp.diag(ridge), given)
    return jnp.einsum("epk,kb->epb", flexible, tension)


def straight_gradient(chain: ElasticChain) -> Float[Array, "E p m"]:
    """dl/dq at q = 0."""
    q = jnp.zeros((*chain.layout.joint.shape, 1))
    frames = kn.frames_of(chain, q)
    return kn.length_gradient(chain, frames, kn.chords_of(chain, frames))[..., 0]


def _look(
    chain: ElasticChain,
    q: Float[Array, "E p B"],
    stretch: Float[Array, "m B"],
    damping: Float[Array, " B"],
    given: Float[Array, "m B"],
    loads: Loads,
    kind: Given,
    kernel: Kernel,
) -> Point:
    """Merit, residual and Newton step of a posture."""
    frames = kn.frames_of(chain, q)
    chords = kn.chords_of(chain, frames)
    gradient = kn.length_gradient(chain, frames, chords)
    kt, width = jnp.asarray(chain.tendon_stiffness)[:, None], jnp.asarray(chain.slack_width)
    lengths = kn.path_lengths(chain, chords)
    tendon_energy = jnp.zeros(q.shape[-1], q.dtype)
    slope = jnp.ones_like(given)
    if kind == "tension":
        tension, tendon_energy = given, (given * lengths).sum(0)
    elif kernel == "virtual_work":
        straight = kn.straight_lengths(chain)[:, None]
        tension, slope, integral = ramp(kt * (lengths - straight - given), width)
        tendon_energy = (integral / kt).sum(0)
    else:
        tension, slope = softplus(stretch, width)
    tangent = kn.residual_and_tangent(chain, q, frames, chords, gradient, tension, loads, kernel)
    firm = damping * kn.per_joint(chain, chain.stiffness, 1.0)[..., None]
    block = tangent.block + firm[:, :, None] * np.eye(q.shape[1])[:, :, None]
    system = tangent._replace(block=block)
    largest = jnp.abs(tangent.residual).max((0, 1))
    moment = kn.moment_forces(chain, frames, loads)
    symmetric = kernel == "virtual_work" and loads.wrench is None
    none = jnp.zeros_like(given)
    rhs = -tangent.residual[:, :, None]
    gap = jnp.zeros_like(given)
    if kind == "tension":
        factors = eliminate(system, rhs, None if symmetric else rhs)
        step, stretch_step, negative = factors.solved[:, :, 0], none, factors.negative
    elif kernel == "virtual_work":
        rhs = jnp.concatenate([rhs, gradient], axis=2)
        factors = eliminate(system, rhs, None if symmetric else rhs)
        step, negative = _with_springs(factors, jnp.sqrt(kt * slope))
        stretch_step = none
    else:
        couples = kn.end_couples(chain, frames)
        gap = length_gap(chain, kn.from_joints(chain, q), tension, given)
        straight = jnp.broadcast_to(-straight_gradient(chain)[..., None], couples.shape)
        factors = eliminate(system, jnp.concatenate([rhs, couples], axis=2), straight)
        step, stretch_step, negative = _with_lengths(factors, slope, kt, gap)
    step = substitute(factors, step)
    cap = jnp.minimum(1.0, MAX_STEP / (jnp.abs(step).max((0, 1)) + 1e-30))
    step, stretch_step = step * cap, stretch_step * cap
    if kernel == "virtual_work":
        energy = kn.spring_energy(chain, q) + tendon_energy + kn.dead_energy(chain, frames, loads)
        predicted = (tangent.residual * step).sum((0, 1))
    else:
        unit = jnp.mean(jnp.asarray(chain.stiffness))
        energy = ((tangent.residual / unit) ** 2).sum((0, 1))
        energy = energy + ((gap / 0.01) ** 2).sum(0)  # 1 cm of tendon counts as 1 rad
        predicted, moment = -2 * energy * cap, jnp.zeros_like(moment)
        negative = jnp.zeros_like(negative)
    return Point(
        energy,
        moment,
        largest,
        jnp.abs(gap).max(0),
        jnp.minimum(predicted, 0.0),
        step,
        stretch_step,
        tension,
        negative.astype(jnp.int32),
    )


def _with_springs(factors: Any, root: Float[Array, "m B"]) -> tuple[Array, Array]:
    """Solved side and negative eigenvalues of H + G' D G, with root = sqrt(D) (Woodbury).

    The signs of both factorisations give the inertia of the sum (Haynsworth).
    """
    m = root.shape[0]
    sides = root[:, None] * factors.product[1:]  # D^1/2 G H^-1 of every right-hand side
    small = sides[:, 1:] * root + jnp.eye(m, dtype=root.dtype)[..., None]
    scaled, pivots = solve_pivotless(small, sides[:, :1])
    tension = scaled[:, 0]
    solved = factors.solved[:, :, 0] - (factors.solved[:, :, 1:] * (root * tension)).sum(2)
    return solved, factors.negative - (pivots < 0).sum(0)


def _with_lengths(factors: Any, slope: Array, kt: Array, gap: Array) -> tuple[Array, Array, Array]:
    """Newton step of [q; s] of S Eq. 27-31, with t = phi(s).

    H x - B phi' ds = -r and C x + phi'/K_t ds = -gap.
    """
    m = gap.shape[0]
    # A tendon deep in its dead zone has a column of zeros; the floor keeps the step finite.
    slope = jnp.maximum(slope, 1e-6)
    small = factors.product[:, 1:] * slope + jnp.eye(m)[..., None] * slope / kt
    right = -gap - factors.product[:, 0]
    ds = jnp.linalg.solve(jnp.moveaxis(small, -1, 0), jnp.moveaxis(right, -1, 0)[..., None])
    ds = jnp.moveaxis(ds[..., 0], 0, -1)
    solved = factors.solved[:, :, 0] + (factors.solved[:, :, 1:] * (slope * ds)).sum(2)
    return solved, ds, factors.negative


def tension_of(
    chain: ElasticChain,
    q: Float[Array, "n B"],
    given: Float[Array, "m B"],
    found: Float[Array, "m B"],
    kind: Given,
    kernel: Kernel,
) -> Float[Array, "m B"]:
    """Tensions of a posture: given, by the tendons' stretch, or unknowns that were ``found``."""
    if kind == "tension":
        return given
    if kernel == "couple":
        return found
    excess = _path_changes(chain, q) - given
    return ramp(jnp.asarray(chain.tendon_stiffness)[:, None] * excess, chain.slack_width)[0]


def length_gap(
    chain: ElasticChain,
    q: Float[Array, "n B"],
    tension: Float[Array, "m B"],
    given: Float[Array, "m B"],
) -> Float[Array, "m B"]:
    """C q + t / K_t - L of S Eq. 24-26 with the paper's constant C, L = -given [m]."""
    turned = (straight_gradient(chain)[..., None] * kn.per_joint(chain, q)[:, :, None]).sum((0, 1))
    return tension / jnp.asarray(chain.tendon_stiffness)[:, None] + given - turned


def _path_changes(chain: ElasticChain, q: Float[Array, "n B"]) -> Float[Array, "m B"]:
    frames = kn.frames_of(chain, kn.per_joint(chain, q))
    lengths = kn.path_lengths(chain, kn.chords_of(chain, frames))
    return lengths - kn.straight_lengths(chain)[:, None]


def displacements_of(
    chain: ElasticChain,
    q: Float[Array, "n B"],
    tension: Float[Array, "m B"],
    kernel: Kernel,
) -> Float[Array, "m B"]:
    """Displacements at which tendons of this tension hold this posture [m]; negative = wound in.

    A tendon without tension is taken as just slack.
    """
    if kernel == "couple":
        return -length_gap(chain, q, tension, jnp.zeros_like(tension))
    stretch = inverse_ramp(tension, jnp.asarray(chain.slack_width))
    return _path_changes(chain, q) - stretch / jnp.asarray(chain.tendon_stiffness)[:, None]
