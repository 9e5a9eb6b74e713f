"""Host checks of chains and of what tendons are asked to do."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from muxjax.precision import host_array
from muxjax.statics.chain import ElasticChain


def check_chain(chain: ElasticChain, kind: str, kernel: str) -> None:
    """Raise unless a chain can be solved.

    Raises:
        ValueError: Names the field, the joint or tendon, and the limit.
    """
    if not isinstance(chain, ElasticChain):
        raise ValueError(f"chain: expected an ElasticChain, found {type(chain).__name__}")
    for name in ("axis", "offset", "stiffness", "cubic", "mass", "com", "hole", "gravity"):
        host_array(f"chain.{name}", getattr(chain, name))
    _above("chain.stiffness", chain.stiffness, "joint", "N m/rad")
    _above("chain.tendon_stiffness", chain.tendon_stiffness, "tendon", "N/m")
    for name in ("cubic", "mass"):
        values = np.asarray(getattr(chain, name))
        if (values < 0).any():
            joint = int(np.argmax(values < 0))
            raise ValueError(
                f"chain.{name}: must be at least 0, found {values[joint]:g} at joint {joint + 1}"
            )
    norms = np.linalg.norm(np.asarray(chain.axis), axis=-1)
    if (abs(norms - 1) > 1e-9).any():
        joint = int(np.argmax(abs(norms - 1)))
        raise ValueError(
            f"chain.axis: axes must have length 1, found {norms[joint]:.6g} at joint {joint + 1}"
        )
    if not np.asarray(chain.slack_width) > 0:
        raise ValueError(f"chain.slack_width: must be above 0 N, found {chain.slack_width:g}")
    stiff = np.isinf(np.asarray(chain.tendon_stiffness))
    if kind == "displacements" and kernel == "virtual_work" and stiff.any():
        raise ValueError(
            "chain.tendon_stiffness: lengths need tendons of finite stiffness (N/m), found inf at "
            f"tendon {int(np.argmax(stiff)) + 1}; the paper's form takes inf with kernel='couple'"
        )


def _above(name: str, values: Any, item: str, unit: str) -> None:
    array = np.asarray(values)
    wrong = ~(array > 0)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise ValueError(
            f"{name}: must be above 0 {unit}, found {array[first]:g} at {item} {first + 1}"
        )


def tendon_lengths(chain: ElasticChain) -> Float[np.ndarray, " m"]:
    """Path length of each tendon of the straight arm [m]."""
    origin = np.concatenate([np.zeros((1, 3)), np.cumsum(np.asarray(chain.offset), axis=0)])
    points = np.asarray(chain.hole) + origin[np.concatenate(chain.routing)]
    lengths, first = [], 0
    for bodies in chain.routing:
        own = points[first : first + len(bodies)]
        lengths.append(np.linalg.norm(np.diff(own, axis=0), axis=-1).sum())
        first += len(bodies)
    return np.array(lengths)


def check_given(chain: ElasticChain, given: object, kind: str) -> Float[np.ndarray, "*batch m"]:
    """Host check of tensions or displacements.

    Raises:
        ValueError: Wrong shape, not finite, a negative tension, or a tendon wound in by more
            than its length; names the row and the tendon.
    """
    values = host_array(kind, given, last=chain.n_tendons)
    if kind == "tension":
        wrong, limit = values < 0, "must be at least 0 N, tendons cannot push"
    else:
        lengths = tendon_lengths(chain)
        wrong, limit = (
            values <= -lengths,
            "impossible: wound in by more than its length of {:.4g} m",
        )
    rows = np.argwhere(wrong)
    if len(rows):
        *row, tendon = (int(i) for i in rows[0])
        if kind != "tension":
            limit = limit.format(lengths[tendon])
        raise ValueError(
            f"{kind}{row if row else ''}: tendon {tendon + 1} is at "
            f"{values[tuple(rows[0])]:.4g}; {limit}"
        )
    return values


def as_float64(chain: ElasticChain) -> ElasticChain:
    """The chain with NumPy float64 leaves."""
    return jax.tree.map(lambda x: np.asarray(x, np.float64), chain)
