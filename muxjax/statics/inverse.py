"""Inverse statics: tensions that hold a posture or a pose under load, small and within bounds.

A given posture asks for tensions with G' t = K q - loads: a bounded linear least-squares problem.
A given pose leaves the posture open, so the tensions themselves are sought: bounded nonlinear
least squares on the pose of the equilibrium, with its implicit derivatives. Among tensions that
do equally well, a small weight on them picks the least.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float

from muxjax.precision import host_array
from muxjax.statics import kernel as kn
from muxjax.statics.chain import ElasticChain
from muxjax.statics.checks import as_float64, check_chain
from muxjax.statics.forward import forward_statics, outputs
from muxjax.statics.implicit import attach_derivatives
from muxjax.statics.loads import Loads, check_loads
from muxjax.statics.result import Equilibrium, StaticsError

Array = Any

MOMENT_TOLERANCE = 1e-6  # moment left at a joint of a given posture, over mean stiffness * 1 rad
POSITION_TOLERANCE = 1e-6  # [m]
ANGLE_TOLERANCE = 1e-5  # [rad]
SPARING = 1e-7  # final weight of tension over bound against the error over its unit, squared
SPARING_STAGES = (1e3, 30.0, 1.0)  # times the final weight, by its root
MOST_EVALUATIONS = 100  # of a stage


class InverseResult(eqx.Module):
    """Tensions found, and what they leave undone. One case; NumPy arrays."""

    tension: Float[Array, " m"]  # [N], within the bounds
    displacements: Float[Array, " m"]  # of the tendons' ends there [m], negative = wound in
    angles: Float[Array, " n"]  # [rad]
    pose: Float[Array, "4 4"]  # of the tip in the world
    moment_error: Float[Array, ""]  # largest moment left at a joint [N m]
    position_error: Float[Array, ""]  # of the tip; 0 where a posture was asked for [m]
    orientation_error: Float[Array, ""]  # [rad]
    converged: Bool[Array, ""]
    at_bound: Bool[Array, " m"]  # tendons held at a bound
    reason: str = eqx.field(static=True)

    def check(self) -> InverseResult:
        """This result, if it holds what was asked for.

        Raises:
            StaticsError: With the reason and what is left.
        """
        if not bool(self.converged):
            raise StaticsError(f"inverse statics: {self.reason}")
        return self


def inverse_statics(
    chain: ElasticChain,
    *,
    pose: Float[Array, "4 4"] | Sequence[Any] | None = None,
    position: Float[Array, " 3"] | Sequence[Any] | None = None,
    angles: Float[Array, " n"] | Sequence[Any] | None = None,
    bounds: tuple[float, float] | Sequence[Any] = (0.0, 100.0),
    gravity: Float[Array, " 3"] | Sequence[Any] | None = None,
    tip_wrench: Float[Array, " 6"] | Sequence[Any] | None = None,
    wrench_frame: str = "dead",
    point_loads: Float[Array, "Q 3"] | Sequence[Any] | None = None,
    point_bodies: Sequence[int] | None = None,
    point_offsets: Float[Array, "Q 3"] | Sequence[Any] | None = None,
    tension0: Float[Array, " m"] | Sequence[Any] | None = None,
) -> InverseResult:
    """Least tensions [N] within bounds that hold a tip pose, a tip position or a posture.

    A chain has far more joints than tendons, so few postures, and not every pose, can be held:
    then ``converged`` is false, ``reason`` says what is left, and the result is the best found.

    Args:
        chain: The arm.
        pose: Wanted tip frame in the world. One of pose, position and angles is given.
        position: Wanted tip position in the world [m], with any orientation.
        angles: Wanted joint angles [rad].
        bounds: Least and greatest tension [N]: two numbers, or two arrays of one per tendon.
        gravity: Loads as for ``forward_statics``, of one case.
        tip_wrench: See ``forward_statics``.
        wrench_frame: See ``forward_statics``.
        point_loads: See ``forward_statics``.
        point_bodies: See ``forward_statics``.
        point_offsets: See ``forward_statics``.
        tension0: Tensions to start from, for poses and positions.

    Returns:
        Tensions, the posture and displacements that go with them, and the errors left. To hold the
        posture by length, command ``displacements``.

    Raises:
        ValueError: Not exactly one goal, bounds that cross or are negative, wrong shapes.
    """
    if sum(x is not None for x in (pose, position, angles)) != 1:
        raise ValueError("inverse_statics: give one of pose, position and angles")
    check_chain(chain, "tension", "virtual_work")
    host = as_float64(chain)
    low, high = _bounds(chain, bounds)
    loads = check_loads(
        chain, gravity, tip_wrench, wrench_frame, point_loads, point_bodies, point_offsets
    )
    if angles is not None:
        return _hold_posture(host, _one("angles", angles, chain.n_joints), loads, low, high)
    goal, turning = np.eye(4), pose is not None
    if pose is not None:
        goal = host_array("pose", pose, last=4)
        if goal.shape != (4, 4):
            raise ValueError(f"pose: must have shape (4, 4), found {goal.shape}")
    else:
        goal[:3, 3] = _one("position", position, 3)
    start = (low + high) * 0.05 if tension0 is None else _one("tension0", tension0, len(low))
    loading = {
        "gravity": gravity,
        "tip_wrench": tip_wrench,
        "wrench_frame": wrench_frame,
        "point_loads": point_loads,
        "point_bodies": point_bodies,
        "point_offsets": point_offsets,
    }
    return _hold_pose(host, goal, turning, loads, loading, low, high, start)


def _one(name: str, value: object, size: int) -> Float[np.ndarray, " size"]:
    array = host_array(name, value, last=size)
    if array.ndim != 1:
        raise ValueError(
            f"{name}: one case at a time, must have shape ({size},), found {array.shape}"
        )
    return array


def _bounds(
    chain: ElasticChain, bounds: Sequence[Any]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    if len(bounds) != 2:
        raise ValueError(f"bounds: must be (least, greatest) tension, found {len(bounds)} entries")
    try:
        low, high = (
            np.broadcast_to(np.asarray(b, np.float64), (chain.n_tendons,)).copy() for b in bounds
        )
    except (TypeError, ValueError):
        raise ValueError(
            f"bounds: each must be a number or {chain.n_tendons} numbers, one a tendon"
        ) from None
    wrong = ~((low >= 0) & (low < high))
    if wrong.any():
        k = int(np.argmax(wrong))
        raise ValueError(
            f"bounds: must be 0 <= least < greatest [N], found {low[k]:g} and {high[k]:g} at "
            f"tendon {k + 1}"
        )
    return low, high


@eqx.filter_jit
def _linear_parts(chain: ElasticChain, q: Array, loads: Loads) -> tuple[Array, Array]:
    """G' of every joint, and the residual without tendons."""
    own = kn.per_joint(chain, q)
    frames = kn.frames_of(chain, own)
    chords = kn.chords_of(chain, frames)
    gradient = kn.length_gradient(chain, frames, chords)
    slack = jnp.zeros((chain.n_tendons, 1))
    tangent = kn.residual_and_tangent(
        chain, own, frames, chords, gradient, slack, loads, "virtual_work"
    )
    flat = gradient.reshape(-1, chain.n_tendons)[chain.layout.place]
    return flat, kn.from_joints(chain, tangent.residual)[:, 0]


def _column(loads: Loads) -> Loads:
    """Loads of one case with a batch axis of one lane."""

    def own(x: Array | None) -> Array | None:
        return None if x is None else np.asarray(x)[..., None]

    return Loads(
        own(loads.gravity),  # type: ignore[arg-type]
        own(loads.wrench),
        own(loads.point_force),
        loads.point_offset,
        loads.point_bodies,
        loads.following,
    )


def _hold_posture(
    chain: ElasticChain, q: Array, loads: Loads, low: Array, high: Array
) -> InverseResult:
    """Bounded least squares of the moments, each relative to the mean joint stiffness."""
    with jax.enable_x64(True):
        pull, rest = (np.asarray(x) for x in _linear_parts(chain, q[:, None], _column(loads)))
    unit = float(np.mean(chain.stiffness))
    sparing = np.sqrt(SPARING) * MOMENT_TOLERANCE**0.5 / high
    matrix = np.concatenate([pull / unit, np.diag(sparing)])
    found = scipy.optimize.lsq_linear(
        matrix, np.concatenate([-rest / unit, 0 * sparing]), (low, high), tol=1e-14
    )
    tension = np.clip(found.x, low, high)
    error = float(np.abs(pull @ tension + rest).max())
    good = error <= MOMENT_TOLERANCE * unit
    with jax.enable_x64(True):
        displacements, pose, *_ = (
            np.array(x[0]) for x in _outputs(chain, q[:, None], tension[:, None])
        )
    reason = (
        "held"
        if good
        else (
            f"these tendons cannot hold the posture: {error:.3g} N m is left at a joint, tolerance "
            f"{MOMENT_TOLERANCE * unit:.3g}"
        )
    )
    return InverseResult(
        tension,
        displacements,
        q,
        pose,
        np.array(error),
        np.array(0.0),
        np.array(0.0),
        np.array(good),
        _at_bound(tension, low, high),
        reason,
    )


@eqx.filter_jit
def _outputs(chain: ElasticChain, q: Array, tension: Array) -> Any:
    return outputs(chain, q, tension, "virtual_work")


def _at_bound(tension: Array, low: Array, high: Array) -> Bool[np.ndarray, " m"]:
    near = 1e-6 * (high - low)
    return (tension <= low + near) | (tension >= high - near)


@eqx.filter_jit
def _pose_derivative(chain: ElasticChain, q: Array, tension: Array, loads: Loads) -> Array:
    """Derivative of the pose of an equilibrium by the tensions, (m, 4, 4)."""

    def pose(t: Array) -> Array:
        at, _ = attach_derivatives(
            jax.tree.map(jnp.asarray, chain),
            t[:, None],
            jax.tree.map(jnp.asarray, loads),
            q,
            tension,
            "tension",
            "virtual_work",
        )
        return outputs(chain, at, t[:, None], "virtual_work")[1][0]

    return jnp.moveaxis(jax.jacfwd(pose)(tension[:, 0]), -1, 0)


def _hold_pose(
    chain: ElasticChain,
    goal: Array,
    turning: bool,
    loads: Loads,
    loading: dict[str, Any],
    low: Array,
    high: Array,
    start: Array,
) -> InverseResult:
    """Bounded nonlinear least squares on the tip of the equilibrium."""
    length = float(np.abs(chain.offset).sum() + np.abs(chain.tip[:3, 3]).sum())
    # The weight on tension falls in stages, so that the path ends at the least of the tensions that
    # do equally well and not at those nearest to the start.
    sparing = np.sqrt(SPARING) * 1e-2 / high
    heavier = 1.0
    last: dict[str, Any] = {"q": None}

    def at(tension: Array) -> Equilibrium:
        key = tension.tobytes()
        if last.get("key") != key:
            eq = forward_statics(chain, tension=tension, q0=last["q"], **loading)
            if not eq.converged and last["q"] is not None:
                eq = forward_statics(chain, tension=tension, **loading)
            last.update(key=key, eq=eq, q=eq.angles if eq.converged else last["q"])
        return last["eq"]

    def error(tension: Array) -> Array:
        tip = at(tension).pose
        parts = [(tip[:3, 3] - goal[:3, 3]) / length]
        if turning:
            parts.append(
                scipy.spatial.transform.Rotation.from_matrix(
                    goal[:3, :3].T @ tip[:3, :3]
                ).as_rotvec()
            )
        return np.concatenate([*parts, heavier * sparing * tension])

    def derivative(tension: Array) -> Array:
        eq = at(tension)
        with jax.enable_x64(True):
            change = np.asarray(
                _pose_derivative(chain, eq.angles[:, None], tension[:, None], _column(loads))
            )
        rows = [change[:, :3, 3].T / length]
        if turning:
            relative = scipy.spatial.transform.Rotation.from_matrix(
                goal[:3, :3].T @ eq.pose[:3, :3]
            )
            spin = np.swapaxes(eq.pose[:3, :3][None], -1, -2) @ change[:, :3, :3]
            body = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=0)
            rows.append(_inverse_right_jacobian(relative.as_rotvec()) @ body)
        return np.concatenate([*rows, np.diag(heavier * sparing)])

    tension = start
    for stage in SPARING_STAGES:
        heavier = stage
        inner = np.clip(tension, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
        found = scipy.optimize.least_squares(
            error,
            inner,
            derivative,
            bounds=(low, high),
            x_scale=high,
            xtol=1e-13,
            ftol=1e-15,
            gtol=1e-15,
            max_nfev=MOST_EVALUATIONS,
        )
        tension = np.clip(found.x, low, high)
    eq = at(tension)
    away = float(np.linalg.norm(eq.pose[:3, 3] - goal[:3, 3]))
    angle = 0.0
    if turning:
        angle = float(
            scipy.spatial.transform.Rotation.from_matrix(
                goal[:3, :3].T @ eq.pose[:3, :3]
            ).magnitude()
        )
    near = away <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE
    reason = "held"
    if not bool(eq.converged):
        reason = (
            f"no equilibrium was found at the last tensions, where {1e3 * away:.4g} mm and "
            f"{np.degrees(angle):.4g} degrees are left"
        )
    elif not near:
        reason = (
            f"no tensions within the bounds were found that hold the goal: {1e3 * away:.4g} mm and "
            f"{np.degrees(angle):.4g} degrees are left"
        )
    return InverseResult(
        tension,
        eq.displacements,
        eq.angles,
        eq.pose,
        eq.residual,
        np.array(away),
        np.array(angle),
        np.array(near and bool(eq.converged)),
        _at_bound(tension, low, high),
        reason,
    )


def _inverse_right_jacobian(w: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Derivative of a rotation vector by a rotation in the body frame: 1 + [w]/2 + c [w]^2."""
    theta = float(np.linalg.norm(w))
    skew = np.cross(np.eye(3), -w)
    if theta < 1e-4:
        c = 1 / 12
    else:
        c = 1 / theta**2 - (1 + np.cos(theta)) / (2 * theta * np.sin(theta))
    return np.eye(3) + 0.5 * skew + c * skew @ skew
