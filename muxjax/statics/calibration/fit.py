"""Least squares through the equilibrium, with uncertainties.

Postures are solved by ``forward_statics``; the Jacobian of what is measured by the parameters
follows from the implicit function theorem at each equilibrium. The noise of positions,
orientations and tensions is estimated from the residuals, each corrected for the parameters that
it helped to fit (the leverages), and weighs the next round.

What the data cannot tell is not taken as known either: every parameter has a Gaussian prior about
the file's value with its plausible spread (``parameters.SPREAD``). Where the data speak it does
not count; where they do not, the value stays near the file's, and how uncertain that is widens the
intervals of all that is tied to it. A parameter is identifiable if its standard error comes out
below half of its spread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float

from muxjax.config import load_yaml, resolve
from muxjax.statics.calibration.measured import Measurements
from muxjax.statics.calibration.parameters import (
    REACH,
    Parameter,
    offsets_of,
    parameters_of,
    with_parameters,
)
from muxjax.statics.chain import ElasticChain
from muxjax.statics.files import ChainConfig, load_chain
from muxjax.statics.forward import forward_statics, outputs
from muxjax.statics.implicit import attach_derivatives
from muxjax.statics.kernel import Kernel
from muxjax.statics.loads import Loads
from muxjax.statics.newton import Given
from muxjax.statics.result import Equilibrium, StaticsStatus

Array = Any

ROUNDS = 8  # of fitting and estimating the noise
SETTLED = 0.02  # relative change of the noise that ends the rounds
FIRST_NOISE = {"position": 1e-3, "orientation": 1e-2, "tension": 0.1}  # [m], [rad], [N]
LEAST_NOISE = 1e-7  # below this, rounding would pass for knowledge
LOST = 1e3  # weighted residual of a posture that was not found


@dataclass(frozen=True)
class Estimate:
    """A fitted parameter in its unit."""

    name: str
    unit: str
    start: float
    value: float
    low: float  # of the 95 % interval
    high: float
    identifiable: bool
    remark: str  # why not, or what it is tied to


@dataclass(frozen=True)
class Calibration:
    """A fit and how good it is."""

    chain: ElasticChain  # with the fitted values
    config: ChainConfig  # the file that the fit started from
    estimates: tuple[Estimate, ...]
    covariance: Float[np.ndarray, "P P"]  # of the estimates, of logarithms where scaled
    offsets: Float[np.ndarray, " m"]  # reading = true value + offset, [N] or [m]
    rms: dict[str, tuple[float, float]]  # before and after, by measured quantity
    noise: dict[str, float]  # estimated standard deviation of each measured number
    converged: bool
    reason: str
    rows: int
    source: str
    kind: str  # what drives the model

    def values(self) -> dict[str, float]:
        """Fitted physical values by parameter name, without those that the data left alone."""
        return {
            e.name: e.value
            for e in self.estimates
            if e.identifiable or abs(e.value - e.start) > 1e-6 * max(abs(e.start), 1e-3)
        }


class _Look(NamedTuple):
    """The model at one theta."""

    found: Equilibrium
    residual: Float[np.ndarray, "R D"]  # model minus measured, unweighted
    chain: ElasticChain


def calibrate(
    chain: str | Path,
    data: Measurements,
    *,
    fit: Sequence[str] = ("stiffness",),
    resolution: int | None = None,
) -> Calibration:
    """Fit a chain to measured postures.

    Args:
        chain: Shipped chain or path of a YAML file, where the fit starts.
        data: Measured rows (``read_measurements``).
        fit: Groups of parameters: ``stiffness`` (of each segment's bending joints), ``twist``,
            ``elasticity`` (of the tendons), ``offsets`` (zero of each tendon's reading),
            ``geometry`` (segment lengths, radii of the tendon circles), ``base`` (where the root
            stands and how it is turned, gravity staying with the world).
        resolution: Beads a segment to compute with, as in ``load_chain``.

    Raises:
        ValueError: Unknown group, fewer numbers than parameters, or a row for which the chain as
            the file states it has no equilibrium; names the row.
    """
    config = load_yaml(ChainConfig, resolve(chain, "chains"))
    start = load_chain(chain, resolution=resolution)
    parameters = parameters_of(config, tuple(fit), data.kind)
    numbers = _residual_width(data) * data.n_rows
    if numbers <= len(parameters):
        raise ValueError(
            f"{data.source}: {data.n_rows} rows give {numbers} measured numbers, too few for the "
            f"{len(parameters)} parameters of {', '.join(fit)}; needs more than that"
        )
    model = _Model(start, config, parameters, data)
    begin = _first_guess(model)
    failed = np.flatnonzero(~model.look(begin).found.converged)
    if len(failed):
        row = int(failed[0])
        status = StaticsStatus(int(model.look(begin).found.status[row])).name
        raise ValueError(
            f"{data.row_name(row)}: no equilibrium found for these readings ({status}); a wrong "
            "reading, or a chain too far from the arm"
        )
    return _rounds(model, begin)


def _residual_width(data: Measurements) -> int:
    width = 3 + (3 if data.rotation is not None else 0)
    return width + (data.given.shape[1] if data.tension is not None else 0)


class _Model:
    """Residuals and their Jacobian at a theta, each computed once."""

    def __init__(
        self,
        chain: ElasticChain,
        config: ChainConfig,
        parameters: tuple[Parameter, ...],
        data: Measurements,
    ) -> None:
        self.chain, self.config, self.parameters, self.data = chain, config, parameters, data
        self.kinds = ["position"] * 3
        if data.rotation is not None:
            self.kinds += ["orientation"] * 3
        if data.tension is not None:
            self.kinds += ["tension"] * chain.n_tendons
        self._last: tuple[bytes, _Look] | None = None
        # Arrays are arguments, not constants, so that other data of this shape compile nothing.
        self._differentiate = eqx.filter_jit(jax.jacfwd(self._measured))

    def look(self, theta: Float[np.ndarray, " P"]) -> _Look:
        """Solve every row."""
        key = theta.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, self._solve(theta))
        return self._last[1]

    def _solve(self, theta: Float[np.ndarray, " P"]) -> _Look:
        data = self.data
        with jax.enable_x64(True):
            made = with_parameters(self.chain, self.config, self.parameters, jnp.asarray(theta))
            chain = jax.tree.map(lambda x: np.asarray(x, np.float64), made)
            true = np.asarray(self._true(data.given, jnp.asarray(theta)))
        given: dict[str, Any] = {data.kind: true}
        found = forward_statics(chain, **given, tip_wrench=data.wrench)
        parts = [found.pose[:, :3, 3] - data.position]
        if data.rotation is not None:
            turn = np.swapaxes(data.rotation, -1, -2) @ found.pose[:, :3, :3]
            parts.append(scipy.spatial.transform.Rotation.from_matrix(turn).as_rotvec())
        if data.tension is not None:
            parts.append(found.tension - data.tension)
        return _Look(found, np.concatenate(parts, axis=-1), chain)

    def _true(self, given: Array, theta: Array) -> Array:
        """Readings without their offsets; a tendon cannot push."""
        true = given - offsets_of(self.parameters, theta, self.chain.n_tendons)
        return jnp.maximum(true, 0.0) if self.data.kind == "tension" else true

    def jacobian(self, theta: Float[np.ndarray, " P"]) -> Float[np.ndarray, "R D P"]:
        """Derivative of the residuals by theta."""
        look, data = self.look(theta), self.data
        found, readings = look.found, (data.given, data.rotation, data.wrench)
        with jax.enable_x64(True):
            at = (found.angles.T, found.tension.T, found.pose[:, :3, :3])
            return np.array(self._differentiate(jnp.asarray(theta), self.chain, readings, at))

    def _measured(self, theta: Array, chain: ElasticChain, readings: Any, at: Any) -> Array:
        """What is measured, near the equilibria ``at`` (q, tension, rotation)."""
        kind: Given = self.data.kind
        kernel: Kernel = "virtual_work"
        given, rotation, wrench = readings
        q, tension, turn = at
        chain = with_parameters(chain, self.config, self.parameters, theta)
        chain = jax.tree.map(jnp.asarray, chain)
        loads = Loads(
            gravity=jnp.broadcast_to(chain.gravity[:, None], (3, len(given))),
            wrench=None if wrench is None else wrench.T,
        )
        true = self._true(given, theta).T
        q, tension = attach_derivatives(chain, true, loads, q, tension, kind, kernel)
        _, pose, _, _ = outputs(chain, q, tension, kernel)
        parts = [pose[:, :3, 3]]
        if rotation is not None:
            parts.append(_seen_from(pose[:, :3, :3], turn, rotation))
        if self.data.tension is not None:
            parts.append(tension.T)
        return jnp.concatenate(parts, axis=-1)


def _seen_from(rotation: Array, at: Array, measured: Array) -> Array:
    """A vector whose derivative at ``rotation`` = ``at`` is that of log(measured' rotation).

    The log map's own derivative is the inverse right Jacobian, 1 + [v]/2 + k [v]^2 at v, times
    the body turn away from ``at``.
    """
    turn = jnp.einsum("rji,rjk->rik", at, rotation)  # 1 at the point itself
    body = 0.5 * jnp.stack(
        [
            turn[:, 2, 1] - turn[:, 1, 2],
            turn[:, 0, 2] - turn[:, 2, 0],
            turn[:, 1, 0] - turn[:, 0, 1],
        ],
        axis=-1,
    )
    relative = jax.lax.stop_gradient(jnp.einsum("rji,rjk->rik", measured, at))
    vee = 0.5 * jnp.stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ],
        axis=-1,
    )
    sine = jnp.linalg.norm(vee, axis=-1, keepdims=True)
    cosine = 0.5 * (jnp.trace(relative, axis1=1, axis2=2) - 1)[:, None]
    angle = jnp.arctan2(sine, cosine)
    small = angle < 1e-4
    safe = jnp.where(small, 1.0, angle)
    v = jnp.where(small, vee, vee * safe / jnp.where(small, 1.0, sine))
    k = jnp.where(small, 1 / 12, 1 / safe**2 - (1 + jnp.cos(safe)) / (2 * safe * jnp.sin(safe)))
    once = jnp.cross(v, body)
    return body + 0.5 * once + k * jnp.cross(v, once)


class _Fit(NamedTuple):
    """One round's result."""

    theta: Float[np.ndarray, " P"]
    success: bool
    message: str


def _first_guess(model: _Model) -> Float[np.ndarray, " P"]:
    """The file's values; offsets of lengths from the lengths that measured tensions would give.

    A millimetre too much winds a stiff tendon up by tens of newtons, or lets it go slack: too far
    from the data for a local fit.
    """
    data, parameters = model.data, model.parameters
    theta = np.zeros(len(parameters))
    places = [i for i, p in enumerate(parameters) if p.kind == "offset"]
    if data.tension is None or not places:
        return theta
    pulls = np.maximum(data.tension, 0.0)
    found = forward_statics(model.chain, tension=pulls, tip_wrench=data.wrench)
    gaps = (data.given - found.displacements)[np.asarray(found.converged)]
    if len(gaps):
        limit = 0.9 * REACH * _spread(model)[places]
        theta[places] = np.clip(np.median(gaps, axis=0), -limit, limit)
    return theta


def _rounds(model: _Model, begin: Float[np.ndarray, " P"]) -> Calibration:
    """Fit and estimate the noise in turn until the noise has settled."""
    noise = {kind: FIRST_NOISE[kind] for kind in dict.fromkeys(model.kinds)}
    theta = begin
    settled = False
    for _ in range(ROUNDS):
        fitted = _fit(model, theta, noise)
        theta = fitted.theta
        new = _noise_of(model, theta, noise)
        change = max(abs(np.log(new[kind] / noise[kind])) for kind in noise)
        settled = bool(change < SETTLED)
        noise = new
        if settled:
            break
    return _calibration(model, fitted, noise, settled)


def _spread(model: _Model) -> Float[np.ndarray, " P"]:
    return np.array([p.spread for p in model.parameters])


def _weights(model: _Model, noise: dict[str, float]) -> Float[np.ndarray, " D"]:
    return 1 / np.array([noise[kind] for kind in model.kinds])


def _weighted_jacobian(
    model: _Model, theta: Float[np.ndarray, " P"], noise: dict[str, float]
) -> Float[np.ndarray, "N P"]:
    """Of the measured numbers over their noise, then of the prior's."""
    jacobian = model.jacobian(theta) * _weights(model, noise)[:, None]
    prior = np.diag(1 / _spread(model))
    return np.concatenate([jacobian.reshape(-1, jacobian.shape[-1]), prior])


def _fit(model: _Model, start: Float[np.ndarray, " P"], noise: dict[str, float]) -> _Fit:
    """Levenberg-Marquardt in a trust region."""
    weights, spread = _weights(model, noise), _spread(model)

    def residual(theta: Float[np.ndarray, " P"]) -> Float[np.ndarray, " N"]:
        look = model.look(theta)
        rows = np.where(look.found.converged[:, None], look.residual * weights, LOST)
        return np.concatenate([np.nan_to_num(rows, nan=LOST).ravel(), theta / spread])

    done = scipy.optimize.least_squares(
        residual,
        np.clip(start, -0.99 * REACH * spread, 0.99 * REACH * spread),
        jac=lambda theta: _weighted_jacobian(model, theta, noise),
        bounds=(-REACH * spread, REACH * spread),
        x_scale=spread,
        method="trf",
        max_nfev=100,
        # Half a unit of the cost is one standard error: this is far below.
        ftol=1e-6,
        xtol=1e-8,
        gtol=1e-8,
    )
    return _Fit(done.x, bool(done.success), str(done.message))


def _noise_of(
    model: _Model, theta: Float[np.ndarray, " P"], noise: dict[str, float]
) -> dict[str, float]:
    """Standard deviation of each quantity: residuals over the degrees of freedom left to it."""
    residual = model.look(theta).residual.ravel()
    kinds = np.array(model.kinds * model.data.n_rows)
    orthonormal, _ = np.linalg.qr(_weighted_jacobian(model, theta, noise))
    leverage = (orthonormal[: len(kinds)] ** 2).sum(axis=-1)
    found = {}
    for kind in noise:
        own = kinds == kind
        left = max(own.sum() - leverage[own].sum(), 1.0)
        found[kind] = max(float(np.sqrt((residual[own] ** 2).sum() / left)), LEAST_NOISE)
    return found


def _calibration(
    model: _Model, fitted: _Fit, noise: dict[str, float], settled: bool
) -> Calibration:
    """The result with its intervals."""
    first = model.look(np.zeros(len(model.parameters)))
    last = model.look(fitted.theta)
    jacobian = _weighted_jacobian(model, fitted.theta, noise)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    error = np.sqrt(np.diag(covariance))
    known = error < 0.5 * _spread(model)
    numbers = len(model.kinds) * model.data.n_rows
    from scipy.stats import t as student_t  # takes a third of a second to import

    width = float(student_t.ppf(0.975, numbers - len(error)))
    remarks = _remarks(model, fitted.theta, jacobian[:numbers], covariance, known)
    estimates = tuple(
        _estimate(p, fitted.theta[i], width * error[i], bool(known[i]), remarks[i])
        for i, p in enumerate(model.parameters)
    )
    lost = np.flatnonzero(~last.found.converged)
    reason = fitted.message
    if len(lost):
        reason = f"{model.data.row_name(int(lost[0]))}: no equilibrium at the fitted values"
    elif fitted.success and not settled:
        reason = f"the estimated noise still changes after {ROUNDS} rounds"
    m = model.chain.n_tendons
    with jax.enable_x64(True):
        offsets = np.array(offsets_of(model.parameters, jnp.asarray(fitted.theta), m))
    return Calibration(
        chain=last.chain,
        config=model.config,
        estimates=estimates,
        covariance=covariance,
        offsets=offsets,
        rms={kind: (_rms(model, first, kind), _rms(model, last, kind)) for kind in noise},
        noise=noise,
        converged=fitted.success and settled and not len(lost),
        reason=reason,
        rows=model.data.n_rows,
        source=model.data.source,
        kind=model.data.kind,
    )


def _rms(model: _Model, look: _Look, kind: str) -> float:
    """Root mean square over the rows of a vector's length, or of one tension."""
    own = look.residual[:, [k == kind for k in model.kinds]]
    squares = own**2 if kind == "tension" else (own**2).sum(axis=-1)
    return float(np.sqrt(squares.mean()))


def _estimate(
    parameter: Parameter, theta: float, width: float, known: bool, remark: str
) -> Estimate:
    value, low, high = (parameter.physical(x) for x in (theta, theta - width, theta + width))
    if not known:
        low, high = float("-inf"), float("inf")
    return Estimate(
        parameter.name, parameter.unit, parameter.start, value, low, high, known, remark
    )


def _remarks(
    model: _Model,
    theta: Float[np.ndarray, " P"],
    jacobian: Float[np.ndarray, "N P"],
    covariance: Float[np.ndarray, "P P"],
    known: Bool[np.ndarray, " P"],
) -> list[str]:
    """Why a parameter is not identifiable, what one is tied to, or that it ran into its bound."""
    names, spread = [p.name for p in model.parameters], _spread(model)
    error = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(error, error)
    remarks = []
    for i, name in enumerate(names):
        others = [
            j for j in np.argsort(-abs(correlation[i])) if j != i and abs(correlation[i, j]) > 0.5
        ]
        if not known[i]:
            lone = np.linalg.norm(jacobian[:, i]) * spread[i] < 2.0 or not others
            like = ", ".join(names[j] for j in others[:3])
            remarks.append(
                "not identifiable: these data hardly depend on it"
                if lone
                else f"not identifiable apart from {like}"
            )
            continue
        tied = [f"{names[j]} ({correlation[i, j]:+.2f})" for j in others]
        tied = [t for t, j in zip(tied, others, strict=True) if abs(correlation[i, j]) > 0.95]
        at_bound = abs(theta[i]) > 0.999 * REACH * spread[i]
        bound = f"at the limit of the fit: is {name} right in the file? " if at_bound else ""
        remarks.append(bound + ("tied to " + ", ".join(tied) if tied else ""))
    return remarks
