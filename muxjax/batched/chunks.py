"""Poses and tendon lengths of millions of configurations, in float32, by the chunk.

XLA on a CPU runs a whole fused kernel again for each array that it returns. Results therefore
leave it four by four, as the bits of complex128 arrays, which cuts that work to a quarter and
happens to be the array-of-structures layout that a caller wants.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from muxjax.batched.formulas import (
    WIDE_VECTORS,
    Chain,
    Output,
    Vector,
    chain,
    length_values,
    pose_values,
)
from muxjax.precision import by_device, host_array
from muxjax.robot import Robot

Array = jax.Array | np.ndarray

CHUNK = 1 << 17  # configurations a call: in cache, and long against the 0.1 ms that a call costs
CHUNK_ELSEWHERE = 1 << 20  # on a GPU
QUADS: dict[str, int] = {"position": 1, "quaternion": 2, "matrix": 3}


def in_quads(values: Vector) -> Vector:
    """Float32 arrays as complex128 ones, four by four; the last is filled up with zeros.

    Only bits are moved. Seen from NumPy, each result is an array (..., 4) of float32.
    """
    padding = -len(values) % 4
    bits = [lax.bitcast_convert_type(v, jnp.uint32).astype(jnp.uint64) for v in values]
    bits += [jnp.zeros_like(bits[0])] * padding
    halves = [
        lax.bitcast_convert_type(low | (high << np.uint64(32)), jnp.float64)
        for low, high in zip(bits[0::2], bits[1::2], strict=True)
    ]
    return tuple(lax.complex(a, b) for a, b in zip(halves[0::2], halves[1::2], strict=True))


def _checked_rows(arm: Chain, bending: Float[Array, "2S N"]) -> Vector:
    """Rows of the bending, NaN where a segment is bent beyond what the polynomials cover."""
    rows: list[jax.Array] = []
    limit = np.float32((arm.angle_limit * (1 + 1e-6)) ** 2)
    for ux, uy in zip(bending[0::2], bending[1::2], strict=True):
        rows += [jnp.where(ux * ux + uy * uy <= limit, ux, jnp.nan), uy]
    return tuple(rows)


@partial(
    jax.jit,
    static_argnames="output",
    donate_argnames="old",
    keep_unused=True,
    compiler_options=WIDE_VECTORS,
)
def _compiled(old: Vector, arm: Chain, bending: jax.Array, output: Output | None) -> Vector:
    del old  # its memory receives the result
    u = _checked_rows(arm, bending)
    if output is None:
        return in_quads(length_values(arm, u))
    values = pose_values(arm, u, output)
    if output == "matrix":
        x, y, z, *r = values
        return in_quads((*r[0:3], x, *r[3:6], y, *r[6:9], z))
    return in_quads(values[:3]) + (in_quads(values[3:]) if output == "quaternion" else ())


def pose_quads(
    arm: Chain,
    bending: Float[Array, "2S N"],
    output: Output = "quaternion",
    reuse: Vector | None = None,
) -> Vector:
    """Poses of one chunk, compiled, as complex128 arrays of N; see ``numbers``.

    Args:
        arm: From ``chain(robot)``.
        bending: Structure of arrays, float32; best about CHUNK columns.
        output: What is computed; nothing else is paid for. ``"position"``: (x, y, z, 0) [m];
            ``"quaternion"``: these and (w, x, y, z); ``"matrix"``: the three rows of [R p].
        reuse: The result of an earlier call of the same kind, whose memory is written again.
            Without it each call pays for fresh pages.

    Bending beyond ``arm.angle_limit`` gives NaN.
    """
    _check_rows(arm, bending)
    if output not in QUADS:
        raise ValueError(f"output: must be one of {', '.join(QUADS)}, found {output!r}")
    with jax.enable_x64(True):
        return _compiled(reuse or _memory(QUADS[output], bending), arm, bending, output)


def length_quads(arm: Chain, bending: Float[Array, "2S N"], reuse: Vector | None = None) -> Vector:
    """Tendon displacements [m] of one chunk, four by four; arguments as for ``pose_quads``."""
    _check_rows(arm, bending)
    with jax.enable_x64(True):
        return _compiled(reuse or _memory(-(-arm.n_tendons // 4), bending), arm, bending, None)


def numbers(quads: Vector) -> list[Float[np.ndarray, "N 4"]]:
    """The float32 numbers of each quad, without a copy on a CPU.

    The views are valid until the quads are handed back as ``reuse``.
    """
    return [np.asarray(quad).view(np.float32).reshape(-1, 4) for quad in quads]


def _memory(n_quads: int, bending: Array) -> Vector:
    return tuple(jnp.zeros(bending.shape[1], jnp.complex128) for _ in range(n_quads))


def _check_rows(arm: Chain, bending: Array) -> None:
    if bending.ndim != 2 or bending.shape[0] != 2 * arm.n_segments:
        raise ValueError(
            f"bending: must have shape ({2 * arm.n_segments}, N), found {bending.shape}"
        )
    if bending.dtype != np.float32:
        raise ValueError(f"bending: must be float32, found {bending.dtype}")


def poses(
    robot: Robot, bending: Float[np.ndarray, "*batch S 2"], output: Output = "quaternion"
) -> np.ndarray:
    """Tool poses in the world of any number of configurations, in float32 and cache-sized chunks.

    Args:
        robot: The arm; its base and tool frames are included.
        bending: b_i = theta_i (cos phi_i, sin phi_i) [rad].
        output: ``"position"``: (*batch, 3) [m]; ``"quaternion"``: (*batch, 7), position and
            (w, x, y, z); ``"matrix"``: (*batch, 4, 4).

    Raises:
        ValueError: Wrong shape, an entry that is not finite, or a segment bent beyond the range
            of the polynomials (``theta_max`` rounded up to a multiple of 45 degrees).
    """
    arm = chain(robot)
    if output not in QUADS:
        raise ValueError(f"output: must be one of {', '.join(QUADS)}, found {output!r}")
    widths = {"position": (3,), "quaternion": (3, 4), "matrix": (4, 4, 4)}[output]
    flat = _in_chunks(arm, bending, widths, lambda rows, old: pose_quads(arm, rows, output, old))
    if output != "matrix":
        return flat
    lowest = np.broadcast_to(np.array([0, 0, 0, 1], np.float32), (*flat.shape[:-1], 4))
    return np.concatenate([flat, lowest], axis=-1).reshape(*flat.shape[:-1], 4, 4)


def tendon_lengths(robot: Robot, bending: Float[np.ndarray, "*batch S 2"]) -> np.ndarray:
    """Tendon displacements ``(*batch, S*J)`` [m] of any number of configurations, in float32.

    Raises:
        ValueError: As for ``poses``.
    """
    arm = chain(robot)
    full, rest = divmod(arm.n_tendons, 4)
    widths = (4,) * full + ((rest,) if rest else ())
    return _in_chunks(arm, bending, widths, lambda rows, old: length_quads(arm, rows, old))


def _in_chunks(
    arm: Chain,
    bending: object,
    widths: tuple[int, ...],
    kernel: Callable[[np.ndarray, Vector | None], Vector],
) -> np.ndarray:
    """Host loop: transpose in, run, copy out; the last chunk is filled up with zeros."""
    b = _shaped_bending(arm, bending)
    flat = b.reshape(-1, 2 * arm.n_segments)
    result = np.empty((len(flat), sum(widths)), np.float32)
    size = min(by_device(CHUNK, CHUNK_ELSEWHERE), 1 << max(6, (len(flat) - 1).bit_length()))
    rows = np.zeros((2 * arm.n_segments, size), np.float32)
    quads: Vector | None = None
    for start in range(0, len(flat), size):
        part = flat[start : start + size]
        rows[:, : len(part)] = part.T
        quads = kernel(rows, quads)
        column = 0
        # Reading the result waits for it, so that `rows` is free again.
        for width, quad in zip(widths, numbers(quads), strict=True):
            result[start : start + size, column : column + width] = quad[: len(part), :width]
            column += width
        # The kernel has looked already: what it refuses is NaN in the last number of all.
        if np.isnan(result[start : start + size, -1]).any():
            raise ValueError(_what_is_wrong(arm, b))
    return result.reshape(*b.shape[:-2], sum(widths))


def _shaped_bending(arm: Chain, bending: object) -> Float[np.ndarray, "*batch S 2"]:
    b = np.asarray(bending)
    if b.dtype != np.float32:
        b = host_array("bending", bending).astype(np.float32)
    if b.ndim < 2 or b.shape[-2:] != (arm.n_segments, 2):
        raise ValueError(f"bending: last axes must be ({arm.n_segments}, 2), found shape {b.shape}")
    return b


def _what_is_wrong(arm: Chain, b: Float[np.ndarray, "*batch S 2"]) -> str:
    """Name the first bend that the polynomials do not cover."""
    angle = np.hypot(b[..., 0], b[..., 1])
    # Negated, so that NaN is found too.
    *row, segment = (int(i) for i in np.argwhere(~(angle <= arm.angle_limit * (1 + 2e-7)))[0])
    return (
        f"bending{row if row else ''}: segment {segment + 1} is bent by "
        f"{np.degrees(angle[(*row, segment)]):.4g} degrees; the polynomials of this robot go to "
        f"{np.degrees(arm.angle_limit):.4g}"
    )
