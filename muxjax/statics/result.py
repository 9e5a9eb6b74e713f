"""What a statics call returns."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

Array = jax.Array | np.ndarray


class StaticsStatus(IntEnum):
    """How a solve ended."""

    CONVERGED = 0  # equilibrium, below the tolerances
    NOT_CONVERGED = 1  # iterations ran out; the last residual is in the result
    DIVERGED = 2  # energy or posture was no longer a finite number
    FOLDED = 3  # a tendon's holes have crossed: the arm buckled to where the model does not hold


class StaticsError(ValueError):
    """An equilibrium that was not found, raised on request by ``Equilibrium.check``."""


class Equilibrium(eqx.Module):
    """Postures under load, for any leading batch axes.

    Where ``converged`` is false the posture is the last one of the iteration, not a solution.
    """

    angles: Float[Array, "*batch n"]  # of the joints [rad]
    tension: Float[Array, "*batch m"]  # [N]
    displacements: Float[Array, "*batch m"]  # of the tendons' ends [m], negative = wound in
    pose: Float[Array, "*batch 4 4"]  # tip in the world
    segment_ends: Float[Array, "*batch S 4 4"]  # in the world
    residual: Float[Array, "*batch"]  # largest moment left at a joint [N m]
    converged: Bool[Array, "*batch"]
    status: Int[Array, "*batch"]  # StaticsStatus
    stable: Bool[Array, "*batch"]  # no negative eigenvalue of the tangent: not buckled
    slack: Bool[Array, "*batch m"]  # tendons that pull with less than ``chain.slack_width``
    iterations: Int[Array, "*batch"]

    def check(self) -> Equilibrium:
        """This result, if every solve converged.

        Raises:
            StaticsError: Names the first batch row that did not, its reason and its residual.
        """
        failed = np.argwhere(~np.asarray(self.converged))
        if not len(failed):
            return self
        row = tuple(int(i) for i in failed[0])
        raise StaticsError(
            f"equilibrium{list(row) if row else ''}: not found "
            f"({StaticsStatus(int(self.status[row])).name}) after {int(self.iterations[row])} "
            f"iterations; the largest moment left at a joint is {float(self.residual[row]):.3g} N m"
        )

    def reshaped(self, batch: tuple[int, ...]) -> Equilibrium:
        """With the one batch axis replaced by ``batch``."""

        def own(x: Any) -> Any:
            return x.reshape((*batch, *x.shape[1:]))

        return jax.tree.map(own, self)
