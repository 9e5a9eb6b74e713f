"""Constant curvature (PCC) for a chain's tendons: the kinematic model beside statics.

Each segment is one arc; a tendon in it changes by -r . b, with r its hole and b the segment's
bending (theta cos phi, theta sin phi): M Eq. 4-6 to first order, and the model of S [10, 11].
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.kinematics import segment_transform
from muxjax.precision import host_array
from muxjax.statics.chain import ElasticChain


def segment_lengths(chain: ElasticChain) -> Float[np.ndarray, " S"]:
    """Lengths of the straight segments along z [m]."""
    heights = np.cumsum(np.asarray(chain.offset)[:, 2])
    tops = heights[np.array(chain.segment_bodies) - 1] + np.asarray(chain.end_frame)[:, 2, 3]
    return np.diff(tops, prepend=0.0)


def length_table(chain: ElasticChain) -> Float[np.ndarray, "m S 2"]:
    """Displacement of each tendon by the bending of each segment [m/rad]."""
    table = np.zeros((chain.n_tendons, len(chain.segment_bodies), 2))
    first = 0
    for k, bodies in enumerate(chain.routing):
        holes = np.asarray(chain.hole)[first : first + len(bodies)]
        begin = 0
        for s, end in enumerate(chain.segment_bodies):
            inside = [i for i, body in enumerate(bodies) if begin < body <= end]
            if inside:
                table[k, s] = -holes[inside[-1], :2]
            begin = end
        first += len(bodies)
    return table


def pcc_bending(
    chain: ElasticChain, displacements: Float[np.ndarray, "*batch m"]
) -> Float[np.ndarray, "*batch S 2"]:
    """Bending of each segment [rad] that fits the displacements [m] best (least squares).

    Raises:
        ValueError: Last axis is not the number of tendons, or an entry is not finite.
    """
    values = host_array("displacements", displacements, last=chain.n_tendons)
    table = length_table(chain).reshape(chain.n_tendons, -1)
    found = values @ np.linalg.pinv(table).T
    return found.reshape(*values.shape[:-1], -1, 2)


def pcc_displacements(
    chain: ElasticChain, bending: Float[np.ndarray, "*batch S 2"]
) -> Float[np.ndarray, "*batch m"]:
    """Tendon displacements [m] that constant curvature gives to a bending [rad]."""
    found: np.ndarray = np.einsum("...sx,msx->...m", bending, length_table(chain))
    return found


def bending_between(
    chain: ElasticChain, segment_ends: Float[np.ndarray, "*batch S 4 4"]
) -> Float[np.ndarray, "*batch S 2"]:
    """Bending of each segment [rad] from the orientations of its two ends, as S IV-A has it."""
    root = np.broadcast_to(np.asarray(chain.base), (*segment_ends.shape[:-3], 1, 4, 4))
    before = np.concatenate([root, segment_ends[..., :-1, :, :]], axis=-3)
    across = np.swapaxes(before[..., :3, :3], -1, -2) @ segment_ends[..., :3, 2:3]
    x, y, z = across[..., 0, 0], across[..., 1, 0], across[..., 2, 0]
    sine = np.hypot(x, y)
    ratio = np.where(sine > 0, np.arctan2(sine, z) / np.where(sine > 0, sine, 1.0), 1.0)
    return np.stack([ratio * x, ratio * y], axis=-1)


def pcc_frames(
    chain: ElasticChain, bending: Float[np.ndarray, "*batch S 2"], n: int = 1
) -> Float[np.ndarray, "*batch frames 4 4"]:
    """Frames along the arcs in the world, n a segment, base first; the last is the chain's tip.

    Args:
        chain: The arm, for its segment lengths, base and tip.
        bending: Of each segment [rad].
        n: Frames a segment.
    """
    lengths = segment_lengths(chain)
    tail = np.linalg.inv(np.asarray(chain.end_frame)[-1]) @ np.asarray(chain.tip)
    pose = np.broadcast_to(np.asarray(chain.base), (*bending.shape[:-2], 4, 4))
    frames = [pose]
    with jax.enable_x64(True):
        for s, length in enumerate(lengths):
            for share in np.arange(1, n + 1) / n:
                arc = jnp.asarray(share * bending[..., s, :])
                part = segment_transform(arc, jnp.asarray(share * length))
                frames.append(pose @ np.asarray(part))
            pose = frames[-1]
    frames[-1] = frames[-1] @ tail
    return np.stack(frames, axis=-3)
