"""What acts on a chain besides springs and tendons."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from muxjax.precision import host_array
from muxjax.statics.chain import ElasticChain

Array = jax.Array | np.ndarray


class Loads(eqx.Module):
    """Loads of one solve or of a batch; None where there is none.

    Batch axes lead here at the face and trail inside (see ``kernel``); shapes are those of one.

    A tip wrench is (moment, force), applied at the origin of the tip frame: a dead one keeps its
    direction in the base frame, a following one is fixed in the tip frame. A point load is a dead
    force in the base frame at a point of a body.
    """

    gravity: Float[Array, "..."]  # (3,) [m/s^2] in the base frame
    wrench: Float[Array, "..."] | None = None  # (6,) [N m], [N]
    point_force: Float[Array, "..."] | None = None  # (Q, 3) [N]
    point_offset: Float[Array, "Q 3"] | None = None  # in the frames of ``point_bodies`` [m]
    point_bodies: tuple[int, ...] = eqx.field(static=True, default=())
    following: bool = eqx.field(static=True, default=False)


def check_loads(
    chain: ElasticChain,
    gravity: object,
    tip_wrench: object,
    wrench_frame: str,
    point_loads: object,
    point_bodies: Sequence[int] | None,
    point_offsets: object,
) -> Loads:
    """Host check of the loads of a call; arguments as in ``forward_statics``.

    Raises:
        ValueError: Names the field and the limit.
    """
    if wrench_frame not in ("dead", "following"):
        raise ValueError(f"wrench_frame: must be 'dead' or 'following', found {wrench_frame!r}")
    force, offset = None, None
    bodies: tuple[int, ...] = ()
    if point_loads is not None:
        force = host_array("point_loads", point_loads, last=3)
        bodies = _bodies(chain, point_bodies)
        if force.shape[-2:] != (len(bodies), 3):
            raise ValueError(
                f"point_loads: must have shape (..., {len(bodies)}, 3), one force for each of "
                f"point_bodies, found {force.shape}"
            )
        offset = np.zeros((len(bodies), 3))
        if point_offsets is not None:
            offset = host_array("point_offsets", point_offsets, last=3)
        if offset.shape != (len(bodies), 3):
            raise ValueError(
                f"point_offsets: must have shape ({len(bodies)}, 3), found {offset.shape}"
            )
    elif point_bodies is not None or point_offsets is not None:
        raise ValueError("point_loads: point_bodies and point_offsets need forces")
    return Loads(
        gravity=host_array("gravity", chain.gravity if gravity is None else gravity, last=3),
        wrench=None if tip_wrench is None else host_array("tip_wrench", tip_wrench, last=6),
        point_force=force,
        point_offset=offset,
        point_bodies=bodies,
        following=wrench_frame == "following" and tip_wrench is not None,
    )


def _bodies(chain: ElasticChain, given: Sequence[int] | None) -> tuple[int, ...]:
    if given is None:
        raise ValueError("point_bodies: needed with point_loads; bodies count from 1 at the base")
    bodies = tuple(int(b) for b in given)
    for body in bodies:
        if not 1 <= body <= chain.n_joints:
            raise ValueError(f"point_bodies: bodies are 1 to {chain.n_joints}, found {body}")
    return bodies
