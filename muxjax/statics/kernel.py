"""Posture to frames, tendon lengths, energy, residual and tangent; batch last.

Inside this room arrays have joints first and the batch last, and 3-vectors are tuples of three
such arrays: XLA's CPU code is fast on long last axes and slow on stacked short ones. The layout
(E elements of p joints) is that of ``chain.Layout``.

With generalised forces tau(q), the residual is r = K q + c q^3 - tau and the tangent H = dr/dq.
Tendons, as far as they run between holes, couple joints inside an element only. Everything else
that acts on the bodies beyond joint i couples by

    H_ij = alpha_i . X_j  for j >= i,      H_ij = Y_i . a_j  for j < i,

with a the joint axes in the base frame: moving joint j turns all that lies beyond it rigidly.
For dead forces f at distance d from joint j, X_j = -sum (a_j x d) x f, and Y = X.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from muxjax.statics.chain import ElasticChain
from muxjax.statics.loads import Loads

Array = Any  # jax.Array | np.ndarray; mypy knows no operators of their union
Vector = tuple[Array, Array, Array]
Kernel = Literal["virtual_work", "couple"]

HOLES_MEET = 1e-3  # gap of two holes at which they have met, as a share of the straight one


class Frames(NamedTuple):
    """Frames of all bodies in the base frame, in the layout (E, p, ..., B)."""

    rotation: Float[Array, "E p 3 3 B"]
    origin: Float[Array, "E p 3 B"]
    axis: Vector  # of the joints, each (E, p, B)


class Tangent(NamedTuple):
    """Residual and tangent without the stiffness of tendons held by their length.

    L = 3, or 6 with a following wrench: then alpha = (a, a x r).
    """

    residual: Float[Array, "E p B"]  # [N m]
    block: Float[Array, "E p p B"]  # H inside each element
    left: Float[Array, "E p L B"]  # alpha
    right: Float[Array, "E p L B"]  # X
    lower: Float[Array, "E p 3 B"]  # Y
    axis: Float[Array, "E p 3 B"]  # a


def dot(u: Vector, v: Vector) -> Array:
    """Scalar product."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def cross(u: Vector, v: Vector) -> Vector:
    """Vector product."""
    return (
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    )


def minus(u: Vector, v: Vector) -> Vector:
    """Difference."""
    return (u[0] - v[0], u[1] - v[1], u[2] - v[2])


def plus(u: Vector, v: Vector) -> Vector:
    """Sum."""
    return (u[0] + v[0], u[1] + v[1], u[2] + v[2])


def scaled(s: Array, v: Vector) -> Vector:
    """Multiple."""
    return (s * v[0], s * v[1], s * v[2])


def turned(rotation: Array, v: Vector) -> Vector:
    """R v, with R of shape (..., 3, 3, B)."""
    x, y, z = (
        rotation[..., i, 0, :] * v[0]
        + rotation[..., i, 1, :] * v[1]
        + rotation[..., i, 2, :] * v[2]
        for i in range(3)
    )
    return x, y, z


def split(v: Array, axis: int = -2) -> Vector:
    """The three components along an axis."""
    x, y, z = (jax.lax.index_in_dim(v, i, axis % v.ndim, keepdims=False) for i in range(3))
    return x, y, z


def per_joint(chain: ElasticChain, values: Array, rigid: float = 0.0) -> Array:
    """Joint values in the layout (E, p, ...); dummy joints take ``rigid``."""
    values = jnp.asarray(values)
    filler = jnp.full((1, *values.shape[1:]), rigid, values.dtype)
    return jnp.concatenate([values, filler])[chain.layout.joint]


def from_joints(chain: ElasticChain, values: Float[Array, "E p B"]) -> Float[Array, "n B"]:
    """Back from the layout to the chain's joints."""
    return values.reshape(-1, values.shape[-1])[chain.layout.place]


def frames_of(chain: ElasticChain, q: Float[Array, "E p B"]) -> Frames:
    """Frames of all bodies, by one pass from the base to the tip."""
    n_elements, p, lanes = q.shape
    ax, ay, az = split(per_joint(chain, chain.axis)[..., None])
    sin, half = jnp.sin(q), jnp.sin(0.5 * q)
    versine = 2 * half * half
    # Rodrigues: 1 + sin q [a] + (1 - cos q) (a a' - 1)
    turn = [
        [1 - versine * (1 - ax * ax), versine * ax * ay - sin * az, versine * ax * az + sin * ay],
        [versine * ax * ay + sin * az, 1 - versine * (1 - ay * ay), versine * ay * az - sin * ax],
        [versine * ax * az - sin * ay, versine * ay * az + sin * ax, 1 - versine * (1 - az * az)],
    ]
    turns = jnp.stack([jnp.stack(row, axis=2) for row in turn], axis=2)
    offsets = per_joint(chain, chain.offset)[..., None].astype(q.dtype)

    def step(carry: tuple[Array, Array], x: tuple[Array, Array]) -> Any:
        rotation, origin = carry
        turn, offset = x
        origin = origin + sum(rotation[:, k] * offset[k] for k in range(3))
        rotation = sum(rotation[:, k, None] * turn[k] for k in range(3))
        return (rotation, origin), (rotation, origin)

    start = (
        jnp.broadcast_to(jnp.eye(3, dtype=q.dtype)[..., None], (3, 3, lanes)),
        jnp.zeros((3, lanes), q.dtype),
    )
    xs = (turns.reshape(-1, 3, 3, lanes), offsets.reshape(-1, 3, 1))
    _, (rotation, origin) = jax.lax.scan(step, start, xs, unroll=1)
    rotation = rotation.reshape(n_elements, p, 3, 3, lanes)
    axis = turned(rotation, (ax, ay, az))
    return Frames(rotation, origin.reshape(n_elements, p, 3, lanes), axis)


class Chords(NamedTuple):
    """Straight stretches of tendon between holes, in the layout (E, c, B)."""

    end: Vector  # distal hole
    unit: Vector  # from the proximal to the distal hole
    length: Array  # 0 where the row is not used
    inverse: Array  # 1 / length, 0 where the row is not used


def _chord_frames(
    chain: ElasticChain, frames: Frames
) -> list[tuple[Float[Array, "E c 3 3 B"], Float[Array, "E c 3 B"]]]:
    """Rotation and origin of the bodies at the proximal and the distal hole of each chord."""
    layout, (rotation, origin, _) = chain.layout, frames
    base = jnp.broadcast_to(jnp.eye(3, dtype=origin.dtype)[..., None], (1, 1, *rotation.shape[2:]))
    before = jnp.concatenate([base, rotation[:-1, -1:]], axis=0)
    origin_before = jnp.concatenate([jnp.zeros_like(origin[:1, -1:]), origin[:-1, -1:]], axis=0)
    if layout.regular:
        return [(before, origin_before), (rotation[:, -1:], origin[:, -1:])]
    rotations = jnp.concatenate([before, rotation], axis=1)
    origins = jnp.concatenate([origin_before, origin], axis=1)
    rows = np.arange(len(layout.joint))[:, None]
    return [(rotations[rows, at], origins[rows, at]) for at in (layout.start, layout.stop)]


def chords_of(chain: ElasticChain, frames: Frames) -> Chords:
    """All chords of a posture."""
    layout, hole = chain.layout, jnp.asarray(chain.hole)
    a, b = (
        plus(turned(turn, split(hole[at][..., None])), split(origin))
        for (turn, origin), at in zip(
            _chord_frames(chain, frames), (layout.hole_a, layout.hole_b), strict=True
        )
    )
    used = layout.used[..., None]
    gap = minus(b, a)
    safe = jnp.sqrt(dot(gap, gap) + ~used)
    inverse = used / safe
    return Chords(b, scaled(inverse, gap), jnp.where(used, safe, 0.0), inverse)


def to_tendons(chain: ElasticChain, values: Array) -> Array:
    """Sum over the chords of each tendon: from (E, c, B) or (E, p, c, B) to m in place of c."""
    if chain.layout.regular:
        return values
    of = chain.layout.tendon[..., None] == np.arange(chain.n_tendons)  # (E, c, m)
    wide = of & chain.layout.used[..., None]
    if values.ndim == 4:
        wide = wide[:, None]
    return (values[..., None, :] * wide[..., None]).sum(-3)


def path_lengths(chain: ElasticChain, chords: Chords) -> Float[Array, "m B"]:
    """Length of each tendon from the base to its end [m]."""
    return to_tendons(chain, chords.length).sum(0)


def straight_lengths(chain: ElasticChain) -> Float[Array, " m"]:
    """Path length of each tendon at q = 0 [m]."""
    origin = jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(jnp.asarray(chain.offset), axis=0)])
    points = jnp.asarray(chain.hole) + origin[np.concatenate(chain.routing)]
    gaps = jnp.sqrt(((points[1:] - points[:-1]) ** 2).sum(-1))
    lengths, first = [], 0
    for bodies in chain.routing:
        lengths.append(gaps[first : first + len(bodies) - 1].sum())
        first += len(bodies)
    return jnp.stack(lengths)


def _crossed(chain: ElasticChain) -> Array:
    """Which joints of an element move a chord: 1, or a mask (E, p, c, 1)."""
    if chain.layout.regular:
        return 1.0
    i = np.arange(chain.layout.joint.shape[1])[None, :, None]
    start, stop = chain.layout.start[:, None], chain.layout.stop[:, None]
    return ((start <= i) & (i < stop))[..., None]


def _levers(frames: Frames, chords: Chords) -> tuple[Vector, Vector]:
    """Joint axes, (E, p, 1, B), and the velocities w = a x lever of distal holes, (E, p, c, B)."""
    ends = (chords.end[0][:, None], chords.end[1][:, None], chords.end[2][:, None])
    axis = (frames.axis[0][:, :, None], frames.axis[1][:, :, None], frames.axis[2][:, :, None])
    return axis, cross(axis, minus(ends, split(frames.origin[:, :, None])))


def length_gradient(chain: ElasticChain, frames: Frames, chords: Chords) -> Float[Array, "E p m B"]:
    """Derivative of the path lengths by the joint angles [m/rad]; -C(q) of MODEL.md section 9."""
    _, velocity = _levers(frames, chords)
    x, y, z = chords.unit
    return to_tendons(chain, _crossed(chain) * dot((x[:, None], y[:, None], z[:, None]), velocity))


def chord_stiffness(
    chain: ElasticChain, frames: Frames, chords: Chords, tension: Float[Array, "m B"]
) -> Float[Array, "E p p B"]:
    """Sum over tendons of tension times the second derivative of its length [N m/rad].

    For i before j: l_ij = (w_i . w_j - (u . w_i)(u . w_j)) / l + u . (a_i x w_j).
    """
    at = tension if chain.layout.regular else tension[chain.layout.tendon]
    axis, velocity = _levers(frames, chords)
    x, y, z = chords.unit
    unit = (x[:, None], y[:, None], z[:, None])
    crossed = _crossed(chain)
    pull = crossed * (at if chain.layout.regular else at[:, None])
    along = dot(unit, velocity)
    inverse = chords.inverse[:, None]
    p = frames.origin.shape[1]
    rows = []
    for j in range(p):
        own = (velocity[0][:, j, None], velocity[1][:, j, None], velocity[2][:, j, None])
        bend = (dot(velocity, own) - along * along[:, j, None]) * inverse
        # u . (a_i x w_j) for i <= j; the entries below the diagonal are copied from above it
        second = bend + dot(unit, cross(axis, own))
        mask = 1.0 if chain.layout.regular else crossed[:, j, None]
        rows.append((pull * mask * second).sum(2))
    upper = jnp.stack(rows, axis=2)  # (E, i, j, B)
    first = (np.arange(p)[:, None] <= np.arange(p)[None, :])[..., None]
    return jnp.where(first, upper, jnp.swapaxes(upper, 1, 2))


def _beyond(values: Float[Array, "N *k B"]) -> Float[Array, "N *k B"]:
    """Sum over a joint's own body and all bodies beyond it."""
    return jnp.cumsum(values[::-1], axis=0)[::-1]


def _dead_levers(
    chain: ElasticChain, frames: Frames, loads: Loads
) -> tuple[list[list[Array]], list[Array]]:
    """D = sum d f' over the dead forces beyond each joint, and their sum F at the root.

    d is the distance of the point of attack from the joint, f the force in the base frame. D is
    3 x 3 entries of shape (E, p, B), F three of shape (B,): all that dead loads contribute.
    """
    shape = frames.origin.shape
    origin = split(frames.origin)
    weight = per_joint(chain, chain.mass)[..., None]
    com = turned(frames.rotation, split(per_joint(chain, chain.com)[..., None]))
    centres = jnp.stack(scaled(weight, plus(origin, com)), axis=2)
    mass = _beyond(weight.reshape(-1, 1)).reshape(*shape[:2], 1)
    arm = minus(
        split(_beyond(centres.reshape(-1, 3, shape[-1])).reshape(shape)), scaled(mass, origin)
    )
    lever = [[arm[i] * loads.gravity[j] for j in range(3)] for i in range(3)]
    total = [mass[0, 0] * loads.gravity[j] for j in range(3)]
    if loads.wrench is not None and not loads.following:
        reach, force = minus(_tip(chain, frames), origin), loads.wrench[3:]
        lever = [[lever[i][j] + reach[i] * force[j] for j in range(3)] for i in range(3)]
        total = [total[j] + force[j] for j in range(3)]
    if loads.point_force is not None:
        first, force = _point_levers(chain, frames, loads)
        lever = [
            [lever[i][j] + first[:, :, i, j] - origin[i] * force[:, :, j] for j in range(3)]
            for i in range(3)
        ]
        total = [total[j] + force[0, 0, j] for j in range(3)]
    return lever, total


def _point_levers(
    chain: ElasticChain, frames: Frames, loads: Loads
) -> tuple[Float[Array, "E p 3 3 B"], Float[Array, "E p 3 B"]]:
    """Sums of p f' and of f over the point loads beyond each joint, p from the base frame."""
    shape = frames.origin.shape
    places = chain.layout.place[np.array(loads.point_bodies, dtype=int) - 1]
    origin = frames.origin.reshape(-1, 3, shape[-1])[places]
    rotation = frames.rotation.reshape(-1, 3, 3, shape[-1])[places]
    offset = split(jnp.asarray(loads.point_offset)[..., None])
    point = jnp.stack(plus(split(origin), turned(rotation, offset)), axis=1)
    force = jnp.asarray(loads.point_force)
    blank = jnp.zeros((shape[0] * shape[1], 3, shape[-1]), origin.dtype)
    forces = _beyond(blank.at[places].add(force))
    moments = blank[:, :, None] * jnp.zeros((1, 1, 3, 1))
    moments = _beyond(moments.at[places].add(point[:, :, None] * force[:, None]))
    return moments.reshape(*shape[:2], 3, 3, -1), forces.reshape(shape)


def _tip(chain: ElasticChain, frames: Frames) -> Vector:
    offset = split(jnp.asarray(chain.tip)[:3, 3, None], axis=0)
    return plus(split(frames.origin[-1, -1], 0), turned(frames.rotation[-1, -1], offset))


def _tip_wrench_in_base(chain: ElasticChain, frames: Frames, loads: Loads) -> tuple[Vector, Vector]:
    turn = jnp.einsum("ijb,jk->ikb", frames.rotation[-1, -1], jnp.asarray(chain.tip)[:3, :3])
    wrench = jnp.asarray(loads.wrench)
    moment, force = (turned(turn, split(w, 0)) for w in (wrench[:3], wrench[3:]))
    return moment, force


def end_couples(chain: ElasticChain, frames: Frames) -> Float[Array, "E p m B"]:
    """Moment of unit tensions under the paper's couple load, by joint: a_i . R_e (r_k x -z).

    S Eq. 12-13: a tendon acts on the bead it ends at alone, as a pure couple.
    """
    p = frames.origin.shape[1]
    hole, last = jnp.asarray(chain.hole), np.cumsum([len(b) for b in chain.routing]) - 1
    columns = []
    for k, body in enumerate(chain.end_bodies):
        place = int(chain.layout.place[body - 1])
        rotation = frames.rotation[place // p, place % p]
        x, y = hole[last[k], 0], hole[last[k], 1]
        couple = turned(rotation, (-y, x, jnp.zeros_like(x)))
        mask = (np.arange(frames.origin.shape[0] * p) <= place).reshape(-1, p, 1)
        columns.append(mask * dot(frames.axis, couple))
    return jnp.stack(columns, axis=2)


def _couples(chain: ElasticChain, frames: Frames, tension: Array) -> Vector:
    """Moment in the base frame that the paper's couples beyond each joint sum up to."""
    p = frames.origin.shape[1]
    hole, last = jnp.asarray(chain.hole), np.cumsum([len(b) for b in chain.routing]) - 1
    total: Vector = (0.0, 0.0, 0.0)
    for body in sorted(set(chain.end_bodies)):
        place = int(chain.layout.place[body - 1])
        own = [k for k, end in enumerate(chain.end_bodies) if end == body]
        x = sum(hole[last[k], 0] * tension[k] for k in own)
        y = sum(hole[last[k], 1] * tension[k] for k in own)
        couple = turned(frames.rotation[place // p, place % p], (-y, x, jnp.zeros_like(x)))
        mask = (np.arange(frames.origin.shape[0] * p) <= place).reshape(-1, p, 1)
        total = plus(total, scaled(mask, couple))
    return total


def spring_energy(chain: ElasticChain, q: Float[Array, "E p B"]) -> Float[Array, " B"]:
    """Elastic energy of the joints [J]."""
    k, c = (per_joint(chain, x)[..., None] for x in (chain.stiffness, chain.cubic))
    return (0.5 * k * q * q + 0.25 * c * q**4).sum((0, 1))


def dead_energy(chain: ElasticChain, frames: Frames, loads: Loads) -> Float[Array, " B"]:
    """Potential of gravity, point loads and a dead tip force [J]; moments have none."""
    lever, force = _dead_levers(chain, frames, loads)
    # -sum p . f, with p = the first joint's place + d
    return -sum(lever[i][i][0, 0] + frames.origin[0, 0, i] * force[i] for i in range(3))


def moment_forces(chain: ElasticChain, frames: Frames, loads: Loads) -> Float[Array, "E p B"]:
    """Generalised forces of loads without a potential: a tip moment, or a following wrench."""
    if loads.wrench is None:
        return jnp.zeros_like(frames.axis[0])
    if not loads.following:
        return dot(frames.axis, split(loads.wrench[:3], axis=0))
    moment, force = _tip_wrench_in_base(chain, frames, loads)
    arm = minus(_tip(chain, frames), split(frames.origin))
    return dot(frames.axis, plus(cross(arm, force), moment))


def residual_and_tangent(
    chain: ElasticChain,
    q: Float[Array, "E p B"],
    frames: Frames,
    chords: Chords,
    gradient: Float[Array, "E p m B"],
    tension: Float[Array, "m B"],
    loads: Loads,
    kernel: Kernel,
) -> Tangent:
    """Residual and tangent at constant tension."""
    k, c = (
        per_joint(chain, x, r)[..., None] for x, r in ((chain.stiffness, 1.0), (chain.cubic, 0.0))
    )
    a = frames.axis
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = _dead_levers(chain, frames, loads)[0]
    moment: Vector = (yz - zy, zx - xz, xy - yx)  # sum d x f
    # -sum (a x d) x f = sum a (d . f) - d (a . f) = a tr D - D a
    right = minus(
        scaled(xx + yy + zz, a), (dot((xx, xy, xz), a), dot((yx, yy, yz), a), dot((zx, zy, zz), a))
    )
    lower, left_extra, right_extra = right, None, None
    residual = (k + c * q * q) * q - dot(a, moment)
    if loads.wrench is not None:
        residual = residual - moment_forces(chain, frames, loads)
        if not loads.following:
            lower = minus(lower, cross(a, split(loads.wrench[:3], axis=0)))
        else:
            twist, force = _tip_wrench_in_base(chain, frames, loads)
            tip, swing = _tip(chain, frames), cross(a, force)
            arm = minus(tip, split(frames.origin))
            pulled = plus(cross(cross(a, arm), force), cross(tip, swing))
            right = minus(right, plus(pulled, cross(a, twist)))
            left_extra, right_extra = cross(a, split(frames.origin)), swing
    if kernel == "couple":
        couples = _couples(chain, frames, tension)
        residual = residual - dot(a, couples)
        right = minus(right, cross(a, couples))
        block = jnp.zeros((*q.shape[:2], q.shape[1], q.shape[2]), q.dtype)
    else:
        residual = residual + (gradient * tension).sum(2)
        block = chord_stiffness(chain, frames, chords, tension)
    axes, rights, lowers = (jnp.stack(jnp.broadcast_arrays(*v), axis=2) for v in (a, right, lower))
    lefts = axes
    if left_extra is not None and right_extra is not None:
        lefts = jnp.concatenate([axes, jnp.stack(left_extra, axis=2)], axis=2)
        rights = jnp.concatenate([rights, jnp.stack(right_extra, axis=2)], axis=2)
    block = _inner(block, k + 3 * c * q * q, lefts, rights, lowers, axes)
    return Tangent(residual, block, lefts, rights, lowers, axes)


def _inner(
    block: Array, diagonal: Array, left: Array, right: Array, lower: Array, axis: Array
) -> Float[Array, "E p p B"]:
    """The tangent inside each element: springs, chords, and what couples joints anyway."""
    p = block.shape[1]
    rows = []
    for i in range(p):
        row = [
            (left[:, i] * right[:, j]).sum(1) if j >= i else (lower[:, i] * axis[:, j]).sum(1)
            for j in range(p)
        ]
        row[i] = row[i] + diagonal[:, i]
        rows.append(jnp.stack(row, axis=1))
    return block + jnp.stack(rows, axis=1)


def holes_crossed(chain: ElasticChain, frames: Frames) -> Bool[Array, " B"]:
    """Whether two consecutive holes of a tendon have met or passed each other along the arm.

    For one joint half way between two holes that is tan(q / 2) > half gap / r (MODEL.md section
    9): from there on the tendon would push. The direction of the straight arm's chord, carried
    by both beads, is what "along" means. A solver comes to rest where the holes meet, since the
    force turns round there: less than a thousandth of the straight gap counts as met.
    """
    straight = jnp.zeros((*chain.layout.joint.shape, 1), frames.origin.dtype)
    gap = chords_of(chain, frames_of(chain, straight))
    (a, _), (b, _) = _chord_frames(chain, frames)
    along = plus(turned(a, gap.unit), turned(b, gap.unit))
    chords = chords_of(chain, frames)
    left = 0.5 * dot(along, chords.unit) * chords.length
    return ((left < HOLES_MEET * gap.length) & chain.layout.used[..., None]).any((0, 1))
