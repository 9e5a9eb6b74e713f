"""Derivatives of an equilibrium by the implicit function theorem.

Where F(u; p) = 0 with unknowns u, a change of the parameters moves u by -(dF/du)^-1 dF/dp dp. The
unknowns are the joint angles, and for the paper's kernel with given lengths the tensions too.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.statics import kernel as kn
from muxjax.statics.chain import ElasticChain
from muxjax.statics.kernel import Kernel, Tangent
from muxjax.statics.loads import Loads
from muxjax.statics.newton import Given, length_gap, tension_of

Array = Any


def residual_of(
    chain: ElasticChain,
    q: Float[Array, "n B"],
    tension: Float[Array, "m B"],
    loads: Loads,
    kernel: Kernel,
) -> Float[Array, "n B"]:
    """Moment missing at each joint [N m]: gradient of the energy where there is one."""
    return kn.from_joints(chain, _tangent(chain, q, tension, loads, kernel)[0].residual)


def energy_of(
    chain: ElasticChain, q: Float[Array, "n B"], tension: Float[Array, "m B"], loads: Loads
) -> Float[Array, " B"]:
    """Energy of joints, weight and dead forces, and of constant tensions [J]; no moments."""
    own = kn.per_joint(chain, q)
    frames = kn.frames_of(chain, own)
    lengths = kn.path_lengths(chain, kn.chords_of(chain, frames))
    stored = kn.spring_energy(chain, own) + kn.dead_energy(chain, frames, loads)
    return stored + (tension * lengths).sum(0)


def tangent_of(
    chain: ElasticChain,
    q: Float[Array, "n B"],
    tension: Float[Array, "m B"],
    loads: Loads,
    kernel: Kernel,
) -> Float[Array, "n n B"]:
    """dr/dq at constant tension as a dense matrix [N m/rad]."""
    return dense(chain, _tangent(chain, q, tension, loads, kernel)[0])


def dense(chain: ElasticChain, tangent: Tangent) -> Float[Array, "n n B"]:
    """The structured tangent written out."""
    n_elements, p, _, lanes = tangent.left.shape
    size = n_elements * p

    def flat(x: Array) -> Array:
        return x.reshape(size, -1, lanes)

    upper = jnp.einsum("ilb,jlb->ijb", flat(tangent.left), flat(tangent.right))
    lower = jnp.einsum("ilb,jlb->ijb", flat(tangent.lower), flat(tangent.axis))
    element = np.arange(size) // p
    before = (element[:, None] < element[None, :])[..., None]
    same = (element[:, None] == element[None, :])[..., None]
    own = jnp.einsum("epqb,ef->epfqb", tangent.block, jnp.eye(n_elements))
    full = jnp.where(same, own.reshape(size, size, lanes), jnp.where(before, upper, lower))
    place = chain.layout.place
    return full[np.ix_(place, place)]


def _tangent(
    chain: ElasticChain, q: Array, tension: Array, loads: Loads, kernel: Kernel
) -> tuple[Tangent, Float[Array, "n m B"]]:
    """Tangent, and the derivative of the residual by the tensions."""
    own = kn.per_joint(chain, q)
    frames = kn.frames_of(chain, own)
    chords = kn.chords_of(chain, frames)
    gradient = kn.length_gradient(chain, frames, chords)
    tangent = kn.residual_and_tangent(chain, own, frames, chords, gradient, tension, loads, kernel)
    pull = gradient if kernel == "virtual_work" else -kn.end_couples(chain, frames)
    flat = pull.reshape(-1, *pull.shape[2:])[chain.layout.place]
    return tangent, flat


@partial(jax.custom_jvp, nondiff_argnums=(5, 6))
def attach_derivatives(
    chain: ElasticChain,
    given: Float[Array, "m B"],
    loads: Loads,
    q: Float[Array, "n B"],
    tension: Float[Array, "m B"],
    kind: Given,
    kernel: Kernel,
) -> tuple[Float[Array, "n B"], Float[Array, "m B"]]:
    """(q, tension) themselves, with the derivatives that an equilibrium has.

    Differentiable, forwards or backwards, with respect to chain, given values and loads; q and
    tension are taken as found, not as variables. Huge values or NaN tell of a singular tangent.
    """
    del chain, given, loads, kind, kernel
    return q, tension


@attach_derivatives.defjvp
def _jvp(kind, kernel, primals, tangents):  # type: ignore[no-untyped-def]
    chain, given, loads, q, tension = primals
    d_chain, d_given, d_loads, _, _ = tangents

    def unbalanced(chain, given, loads):  # type: ignore[no-untyped-def]
        at_q = tension_of(chain, q, given, tension, kind, kernel)
        return (
            residual_of(chain, q, at_q, loads, kernel),
            length_gap(chain, q, at_q, given) if _lengths_unknown(kind, kernel) else at_q,
        )

    parameters, changes = (chain, given, loads), (d_chain, d_given, d_loads)
    _, (d_residual, d_second) = jax.jvp(unbalanced, parameters, changes)
    tangent, pull = _tangent(chain, q, tension, loads, kernel)
    matrix = dense(chain, tangent)
    if _lengths_unknown(kind, kernel):
        dq, d_tension = _lengths_jvp(chain, q, tension, matrix, pull, d_residual, d_second)
        return (q, tension), (dq, d_tension)
    if kind == "tension":
        return (q, tension), (_solve(matrix, -d_residual), d_second)
    _, slope = jax.jvp(
        lambda x: tension_of(chain, q, x, tension, kind, kernel), (given,), (-jnp.ones_like(given),)
    )
    dq = _solve(matrix + jnp.einsum("imb,mb,jmb->ijb", pull, slope, pull), -d_residual)
    return (q, tension), (dq, d_second + slope * jnp.einsum("imb,ib->mb", pull, dq))


def _lengths_unknown(kind: Given, kernel: Kernel) -> bool:
    return kind == "displacements" and kernel == "couple"


def _lengths_jvp(  # type: ignore[no-untyped-def]
    chain, q, tension, matrix, pull, d_residual, d_gap
):
    """Of [q; t] together: [H, dr/dt; C, 1/K_t] (S Eq. 28)."""
    n, m = q.shape[0], tension.shape[0]

    def gap(x):  # type: ignore[no-untyped-def]
        return length_gap(chain, x, jnp.zeros_like(tension), jnp.zeros_like(tension))

    coupling = jax.jacfwd(lambda x: gap(x[:, None])[:, 0])(q[:, 0])
    lanes = q.shape[1]
    corner = jnp.diag(1 / jnp.asarray(chain.tendon_stiffness))
    below = jnp.concatenate([coupling, corner], axis=1)
    below = jnp.broadcast_to(below[..., None], (m, n + m, lanes))
    whole = jnp.concatenate([jnp.concatenate([matrix, pull], axis=1), below])
    change = _solve(whole, -jnp.concatenate([d_residual, d_gap]))
    return change[:n], change[n:]


def _solve(matrix: Float[Array, "n n B"], rhs: Float[Array, "n B"]) -> Float[Array, "n B"]:
    moved = jnp.moveaxis(matrix, -1, 0), jnp.moveaxis(rhs, -1, 0)[..., None]
    return jnp.moveaxis(jnp.linalg.solve(*moved)[..., 0], 0, -1)
