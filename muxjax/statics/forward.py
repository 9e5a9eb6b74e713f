"""Forward statics: from tendon tension or tendon length to posture (S Eq. 14-31).

The face ``forward_statics``: checks on the host, batches in chunks of lanes, load continuation
for what the plain iteration did not solve, and the traced path with implicit derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.precision import check_last_axis, host_array, in_threads, padded_size
from muxjax.statics import kernel as kn
from muxjax.statics.chain import ElasticChain
from muxjax.statics.checks import check_chain, check_given
from muxjax.statics.implicit import attach_derivatives
from muxjax.statics.kernel import Kernel
from muxjax.statics.loads import Loads, check_loads
from muxjax.statics.newton import Given, Solution, displacements_of, solve
from muxjax.statics.result import Equilibrium, StaticsStatus

Array = Any

MAX_ITERATIONS = 60
LANES = (1, 64)  # solves that are compiled as one; 64 fit a core's cache
LANES_ELSEWHERE = (8, 1 << 12)  # on a GPU
CONTINUATION = ((0.25, 0.5, 0.75, 1.0), tuple(np.arange(1, 33) / 32))  # shares of the load


def forward_statics(
    chain: ElasticChain,
    *,
    tension: Float[Array, "*batch m"] | Sequence[Any] | None = None,
    displacements: Float[Array, "*batch m"] | Sequence[Any] | None = None,
    gravity: Float[Array, "*g 3"] | Sequence[Any] | None = None,
    tip_wrench: Float[Array, "*w 6"] | Sequence[Any] | None = None,
    wrench_frame: str = "dead",
    point_loads: Float[Array, "*p Q 3"] | Sequence[Any] | None = None,
    point_bodies: Sequence[int] | None = None,
    point_offsets: Float[Array, "Q 3"] | Sequence[Any] | None = None,
    kernel: str = "virtual_work",
    q0: Float[Array, "*s n"] | Sequence[Any] | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> Equilibrium:
    """Posture of an elastic chain for given tendon tensions (FST) or lengths (FSL), in float64.

    Args:
        chain: The arm (``load_chain``, ``elastic_chain``).
        tension: Of each tendon [N], >= 0, any leading batch axes. Either this or displacements.
        displacements: Of each tendon's proximal end [m], negative = wound in, as the robot's.
        gravity: [m/s^2] in the base frame, broadcast against the batch; the chain's by default.
        tip_wrench: (moment [N m], force [N]) on the arm at the tip frame's origin.
        wrench_frame: ``"dead"``: the wrench keeps its direction in the base frame;
            ``"following"``: it is fixed in the tip frame.
        point_loads: Dead forces in the base frame [N], one for each entry of ``point_bodies``.
        point_bodies: Bodies they act on, counting from 1 (the body that joint 1 carries);
            ``chain.segment_bodies`` lists the segment ends.
        point_offsets: Points of attack in those bodies' frames [m]; their origins by default.
        kernel: ``"virtual_work"``: tendon forces from true chord lengths, tendons are unilateral
            springs; ``"couple"``: the paper's, a couple at each tendon's last bead and constant C.
        q0: Joint angles to start from [rad]; by default straight for tensions, and for lengths
            the linear answer of springs and tendons.
        max_iterations: Newton steps before load continuation is tried.

    Returns:
        NumPy float64 arrays; see ``Equilibrium``. Where ``converged`` is false, ``status`` says
        why and ``residual`` how far off it is; ``.check()`` raises. Under load there may be
        several equilibria: the one found is that of the start, and ``stable`` tells of what kind.

    Inside a trace there is no continuation, and derivatives are those of the implicit function
    theorem.

    Raises:
        ValueError: Neither or both of tension and displacements, a negative tension, a tendon
            wound in by more than its length, wrong shape, not finite, a chain that cannot be
            solved (zero stiffness, ...); names the field and the limit. Also when traced in
            float32: set jax.config.update("jax_enable_x64", True).
    """
    if kernel not in get_args(Kernel):
        raise ValueError(f"kernel: must be one of {', '.join(get_args(Kernel))}, found {kernel!r}")
    form = cast(Kernel, kernel)
    if (tension is None) == (displacements is None):
        raise ValueError("forward_statics: give either tension or displacements")
    if max_iterations < 1:
        raise ValueError(f"max_iterations: must be at least 1, found {max_iterations}")
    kind: Given = "displacements" if tension is None else "tension"
    given = displacements if tension is None else tension
    raw = (chain, given, gravity, tip_wrench, point_loads, point_offsets, q0)
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(raw)):
        bodies = tuple(point_bodies or ())
        fixed: Any = np.zeros((len(bodies), 3)) if point_offsets is None else point_offsets
        following = wrench_frame == "following" and tip_wrench is not None
        acting: Any = (chain.gravity if gravity is None else gravity, tip_wrench, point_loads)
        loads = Loads(acting[0], acting[1], acting[2], fixed, bodies, following)
        return _traced(chain, given, loads, q0, kind, form, max_iterations)
    check_chain(chain, kind, kernel)
    loads = check_loads(
        chain, gravity, tip_wrench, wrench_frame, point_loads, point_bodies, point_offsets
    )
    values = check_given(chain, given, kind)
    start = None if q0 is None else host_array("q0", q0, last=chain.n_joints)
    batch = _batch(values, loads, start)
    values, loads, start = _rows(batch, values, loads, start)
    host = jax.tree.map(lambda x: np.asarray(x, np.float64), chain)
    with jax.enable_x64(True):
        found = _solve_rows(host, values, loads, start, kind, form, max_iterations)
        result = _finished(host, values, found, kind, form)
    return result.reshaped(batch)


def _batch(given: Array, loads: Loads, q0: Array | None) -> tuple[int, ...]:
    """Common batch axes of all that may have them."""
    parts = {"tension or displacements": (given, 1), "gravity": (loads.gravity, 1)}
    for name, value, own in (
        ("tip_wrench", loads.wrench, 1),
        ("point_loads", loads.point_force, 2),
        ("q0", q0, 1),
    ):
        if value is not None:
            parts[name] = (value, own)
    batch: tuple[int, ...] = ()
    for name, (value, own) in parts.items():
        axes = value.shape[: value.ndim - own]
        try:
            batch = np.broadcast_shapes(batch, axes)
        except ValueError:
            raise ValueError(f"{name}: batch axes {axes} do not broadcast with {batch}") from None
    return batch


def _rows(batch: tuple[int, ...], given: Array, loads: Loads, q0: Array | None) -> Any:
    """Everything with one batch axis, the last one."""
    is_jax = any(isinstance(x, jax.Array) for x in jax.tree.leaves((given, loads, q0)))
    xp: Any = jnp if is_jax else np

    def last(value: Array, own: int) -> Array:
        tail = value.shape[value.ndim - own :]
        rows = xp.broadcast_to(value, (*batch, *tail)).reshape(-1, *tail)
        return xp.moveaxis(rows, 0, -1)

    return (
        last(given, 1),
        Loads(
            last(loads.gravity, 1),
            None if loads.wrench is None else last(loads.wrench, 1),
            None if loads.point_force is None else last(loads.point_force, 2),
            loads.point_offset,
            loads.point_bodies,
            loads.following,
        ),
        None if q0 is None else last(q0, 1),
    )


@eqx.filter_jit
def _compiled(chain: ElasticChain, q0: Any, given: Any, loads: Loads, **options: Any) -> Solution:
    return solve(chain, q0, given, loads, **options)


def _lanes(loads: Loads, of: Any) -> Loads:
    """``of`` applied to every array that has a batch axis; offsets belong to the bodies."""
    return Loads(
        of(loads.gravity),
        None if loads.wrench is None else of(loads.wrench),
        None if loads.point_force is None else of(loads.point_force),
        loads.point_offset,
        loads.point_bodies,
        loads.following,
    )


def _solve_chunks(
    chain: ElasticChain, q0: Array | None, given: Array, loads: Loads, **options: Any
) -> Solution:
    """One round of the iteration, in chunks of lanes; short ones are filled with their last row.

    XLA runs a chunk on one core, so the chunks are shared out to threads. The first one compiles.
    """
    rows = given.shape[-1]
    lanes = padded_size(rows, LANES, LANES_ELSEWHERE)

    def chunk(first: int) -> list[Array]:
        pick = np.minimum(np.arange(first, first + lanes), rows - 1)
        start = None if q0 is None else q0[:, pick]
        own = _lanes(loads, lambda x: x[..., pick])
        with jax.enable_x64(True):  # a setting of each thread
            found = _compiled(chain, start, given[:, pick], own, **options)
            return [np.asarray(x) for x in found]

    firsts = range(0, rows, lanes)
    parts = [chunk(first) for first in firsts[:1]] + in_threads(chunk, firsts[1:])
    columns = zip(*parts, strict=True)
    return Solution(*(np.concatenate(column, axis=-1)[..., :rows] for column in columns))


def _solve_rows(
    chain: ElasticChain,
    given: Array,
    loads: Loads,
    q0: Array | None,
    kind: Given,
    kernel: Kernel,
    max_iterations: int,
) -> Solution:
    """The plain iteration, then growing loads for the rows that it did not solve."""
    options = {"kind": kind, "kernel": kernel, "max_iterations": max_iterations}
    found = _solve_chunks(chain, q0, given, loads, **options)
    for shares in CONTINUATION:
        open_rows = np.flatnonzero(~found.converged)
        if not len(open_rows):
            break
        part, own = given[:, open_rows], _lanes(loads, lambda x, at=open_rows: x[..., at])
        start = np.zeros((chain.n_joints, len(open_rows)))
        count = found.iterations[open_rows]
        for share in shares:
            scaled = _lanes(own, lambda x, by=share: by * x)
            stage = _solve_chunks(chain, start, share * part, scaled, **options)
            start = np.where(np.isfinite(stage.q), stage.q, 0.0)
            count = count + stage.iterations
        better = stage.converged | (stage.residual < found.residual[open_rows])
        stage = stage._replace(iterations=count)
        for name, kept in found._asdict().items():
            new = getattr(stage, name)
            kept[..., open_rows[better]] = new[..., better]
    return found


@eqx.filter_jit
def _outputs(chain: ElasticChain, q: Any, tension: Any, kernel: Kernel) -> Any:
    return outputs(chain, q, tension, kernel)


def outputs(
    chain: ElasticChain, q: Float[Array, "n B"], tension: Float[Array, "m B"], kernel: Kernel
) -> tuple[Array, Array, Array, Array]:
    """Displacements (B, m), tip (B, 4, 4) and segment ends (B, S, 4, 4) in the world, and (B,).

    The last one tells whether the holes of a tendon have crossed.
    """
    own = kn.per_joint(chain, q)
    frames = kn.frames_of(chain, own)
    shape = (-1, *frames.rotation.shape[2:])
    rotation = jnp.moveaxis(frames.rotation.reshape(shape), -1, 0)  # (B, joints, 3, 3)
    origin = jnp.moveaxis(frames.origin.reshape(-1, *frames.origin.shape[2:]), -1, 0)
    base = jnp.asarray(chain.base)

    def pose(body: int, frame: Array) -> Array:
        place = int(chain.layout.place[body - 1])
        top = jnp.concatenate([rotation[:, place], origin[:, place, :, None]], axis=-1)
        below = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (len(top), 1, 4))
        return base @ jnp.concatenate([top, below], axis=-2) @ frame

    ends = [pose(b, f) for b, f in zip(chain.segment_bodies, chain.end_frame, strict=True)]
    displacements = displacements_of(chain, q, tension, kernel)
    folded = kn.holes_crossed(chain, frames)
    return displacements.T, pose(chain.n_joints, chain.tip), jnp.stack(ends, axis=1), folded


def _finished(
    chain: ElasticChain, given: Array, found: Solution, kind: Given, kernel: Kernel
) -> Equilibrium:
    """The result of the host path, rows first."""
    computed = _outputs(chain, found.q, found.tension, kernel)
    displacements, pose, ends, folded = (np.array(x) for x in computed)
    return _equilibrium(
        np,
        found,
        displacements if kind == "tension" else given.T.copy(),
        pose,
        ends,
        folded,
        float(chain.slack_width),
    )


def _equilibrium(
    xp: Any,
    found: Solution,
    displacements: Array,
    pose: Array,
    ends: Array,
    folded: Array,
    width: Any,
) -> Equilibrium:
    """A result, and the reason where there is none. Crossed holes are outside the model."""
    finite = xp.isfinite(found.residual) & xp.isfinite(found.q).all(0)
    failure = xp.where(finite, int(StaticsStatus.NOT_CONVERGED), int(StaticsStatus.DIVERGED))
    failure = xp.where(folded & finite, int(StaticsStatus.FOLDED), failure)
    status = xp.where(found.converged & ~folded, int(StaticsStatus.CONVERGED), failure)
    return Equilibrium(
        angles=found.q.T,
        tension=found.tension.T,
        displacements=displacements,
        pose=pose,
        segment_ends=ends,
        residual=found.residual,
        converged=found.converged & ~folded,
        status=status,
        stable=found.stable,
        slack=(found.tension < width).T,
        iterations=found.iterations,
    )


def _traced(
    chain: ElasticChain,
    given: Array,
    loads: Loads,
    q0: Array | None,
    kind: Given,
    kernel: Kernel,
    max_iterations: int,
) -> Equilibrium:
    """The same inside a trace: one round, then implicit derivatives."""
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError(
            "forward_statics: traced in float32; set jax.config.update('jax_enable_x64', True)"
        )
    given = jnp.asarray(given, jnp.float64)
    check_last_axis(kind, given.shape, chain.n_tendons)
    loads = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), loads)
    start = None if q0 is None else jax.lax.stop_gradient(jnp.asarray(q0, jnp.float64))
    batch = _batch(given, loads, start)
    given, loads, start = _rows(batch, given, loads, start)
    # Only tracers carry derivatives; the chain's NumPy leaves stay what they are.
    held = jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.core.Tracer) else x,
        (chain, given, loads),
    )
    found = solve(
        held[0], start, held[1], held[2], kind=kind, kernel=kernel, max_iterations=max_iterations
    )
    q, tension = attach_derivatives(
        jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), chain),
        given,
        loads,
        found.q,
        found.tension,
        kind,
        kernel,
    )
    displacements, pose, ends, folded = outputs(chain, q, tension, kernel)
    displacements = displacements if kind == "tension" else given.T
    found = found._replace(q=q, tension=tension)
    width = chain.slack_width
    result = _equilibrium(jnp, found, displacements, pose, ends, folded, width)
    return result.reshaped(batch)
