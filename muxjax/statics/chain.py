"""The elastic joint chain as a pytree, and how its joints fall into elements.

At q = 0 every body frame is parallel to the base frame; body j sits at joint j, which carries it,
and body 0 is the base. A chain of any rest shape can be written so: axes and offsets are vectors
in those aligned frames.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

Array = jax.Array | np.ndarray
Routing = tuple[tuple[int, ...], ...]

WASTE = 1.5  # dummy joints are worth it up to this many rows a joint: chords stay regular


class ElasticChain(eqx.Module):
    """Revolute elastic joints in series, threaded by tendons.

    The leaves are float64 NumPy arrays: any of them can be replaced (``eqx.tree_at``), and the
    solver is differentiable with respect to all of them. n joints, m tendons, H holes, S ends.
    """

    axis: Float[Array, "n 3"]  # unit axis of each joint, in its body's frame
    offset: Float[Array, "n 3"]  # joint j in the frame of body j - 1 [m]
    stiffness: Float[Array, " n"]  # K [N m/rad]
    cubic: Float[Array, " n"]  # torque K q + cubic q^3 [N m/rad^3]
    mass: Float[Array, " n"]  # of the body that the joint carries [kg]
    com: Float[Array, "n 3"]  # its centre of mass, body frame [m]
    hole: Float[Array, "H 3"]  # holes, tendon after tendon, each in its body's frame [m]
    tendon_stiffness: Float[Array, " m"]  # K_t [N/m]; inf = inextensible
    slack_width: Float[Array, ""]  # below this tension a tendon goes slack smoothly [N]
    gravity: Float[Array, " 3"]  # [m/s^2] in the base frame
    base: Float[Array, "4 4"]  # base frame in the world
    tip: Float[Array, "4 4"]  # tip frame in the last body's frame
    end_frame: Float[Array, "S 4 4"]  # segment ends, in the frames of bodies ``segment_bodies``
    routing: Routing = eqx.field(static=True)  # bodies whose holes tendon k passes, base to end
    segment_bodies: tuple[int, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.axis.shape[0]

    @property
    def n_tendons(self) -> int:
        """Number of tendons."""
        return len(self.routing)

    @property
    def end_bodies(self) -> tuple[int, ...]:
        """Body at which each tendon is fixed."""
        return tuple(bodies[-1] for bodies in self.routing)

    @property
    def layout(self) -> Layout:
        """How joints and chords fall into elements."""
        return layout_of(self.n_joints, self.routing)


class Layout(NamedTuple):
    """Joints grouped into elements of p, so that no tendon's chord leaves its element.

    A chord is the straight stretch between two consecutive holes of a tendon. Its length depends
    on the joints between them only, so tendons couple joints inside an element only, and what
    couples the elements is weight, loads and each tendon's one tension: the cost is linear.
    Rows that fill up an element point at ``n_joints``, a rigid dummy.
    """

    joint: Int[np.ndarray, "E p"]
    place: Int[np.ndarray, " n"]  # where joint j stands in the flattened ``joint``
    tendon: Int[np.ndarray, "E c"]  # of each chord
    start: Int[np.ndarray, "E c"]  # place of the chord's proximal body in the element; 0 = before
    stop: Int[np.ndarray, "E c"]
    hole_a: Int[np.ndarray, "E c"]
    hole_b: Int[np.ndarray, "E c"]
    used: Bool[np.ndarray, "E c"]
    regular: bool  # chord k belongs to tendon k and spans its whole element


@lru_cache(maxsize=64)
def layout_of(n: int, routing: Routing) -> Layout:
    """Group n joints into elements, as few per element as the widest chord demands."""
    chords = []
    first = 0
    for k, bodies in enumerate(routing):
        for i, (a, b) in enumerate(pairwise(bodies)):
            chords.append((k, a, b, first + i, first + i + 1))
        first += len(bodies)
    inside = np.zeros(n + 1, dtype=bool)
    for _, a, b, *_ in chords:
        inside[a + 1 : b] = True
    cuts = np.flatnonzero(~inside)
    widest = int(np.diff(cuts).max())
    bounds = [int(cut) for cut in cuts]
    if widest * (len(cuts) - 1) > WASTE * n:
        bounds = _merged(cuts, widest)
    sizes = np.diff(bounds)
    joint = np.full((len(sizes), widest), n)
    for e, (low, size) in enumerate(zip(bounds, sizes, strict=False)):
        joint[e, :size] = np.arange(low, low + size)
    return _with_chords(n, len(routing), joint, bounds, chords)


def _merged(cuts: Int[np.ndarray, " cuts"], widest: int) -> list[int]:
    """Cuts so far apart as ``widest`` allows: fewer elements, filled up better."""
    bounds = [0]
    for cut, following in pairwise(cuts[1:]):
        if following - bounds[-1] > widest:
            bounds.append(int(cut))
    return [*bounds, int(cuts[-1])]


def _with_chords(
    n: int,
    m: int,
    joint: np.ndarray,
    bounds: list[int],
    chords: list[tuple[int, int, int, int, int]],
) -> Layout:
    """The layout with each chord's row in its element."""
    n_elements, p = joint.shape
    members: list[list[tuple[int, int, int, int, int]]] = [[] for _ in range(n_elements)]
    for chord in chords:
        members[int(np.searchsorted(bounds, chord[1], side="right")) - 1].append(chord)
    # A tendon's chord that crosses a whole element takes the tendon's own row where it can.
    regular = all(
        len({c[0] for c in row}) == len(row)
        and all(c[1] == bounds[e] and c[2] == bounds[e + 1] for c in row)
        for e, row in enumerate(members)
    )
    rows = m if regular else max(len(row) for row in members)
    table = np.zeros((6, n_elements, rows), dtype=int)
    for e, row in enumerate(members):
        for i, (k, a, b, hole_a, hole_b) in enumerate(row):
            entry = [k, a - bounds[e], b - bounds[e], hole_a, hole_b, 1]
            table[:, e, k if regular else i] = entry
    if regular:
        table[0], table[2] = np.arange(m), p
    places = np.flatnonzero(joint.ravel() < n)
    of, start, stop, first, second, used = table
    return Layout(joint, places, of, start, stop, first, second, used.astype(bool), regular)
