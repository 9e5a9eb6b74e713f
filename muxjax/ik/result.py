"""What an inverse kinematics call returns."""

from __future__ import annotations

from enum import IntEnum

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

Array = jax.Array | np.ndarray


class IkStatus(IntEnum):
    """How a solve ended."""

    CONVERGED = 0  # both errors are below their tolerances
    NOT_CONVERGED = 1  # no start reached the pose; the closest found is inside the limits
    LIMITED = 2  # the same, and the closest found lies on the limits in ``binding_limit``
    OUT_OF_REACH = 3  # the position is farther from the root than the arm and its tool are long
    BLOCKED = 4  # every solution collides; the one returned does so by the least depth


class IkError(ValueError):
    """A pose that was not reached, raised on request by ``IkResult.check``."""


class IkResult(eqx.Module):
    """Configurations found for poses of any leading batch axes.

    Where ``converged`` is false, q is the closest found in the merit
    (position error / total length)^2 + orientation_error^2: a residual, not a solution.
    """

    q: Float[Array, "*batch dof"]  # (theta_1, phi_1, ...) [rad], within the limits
    position_error: Float[Array, "*batch"]  # [m]
    orientation_error: Float[Array, "*batch"]  # angle of the remaining rotation [rad]
    converged: Bool[Array, "*batch"]
    status: Int[Array, "*batch"]  # IkStatus
    binding_limit: Bool[Array, "*batch S"]  # segments bent to their limit
    clearance: Float[Array, "*batch"] | None = None  # with a world: least signed distance to
    # obstacles and to the arm itself [m], negative = depth
    nearest_segment: Int[Array, "*batch"] | None = None  # where that is, 1 to S; S + 1 is the tool
    nearest_point: Float[Array, "*batch 3"] | None = None  # on the arm's axis there [m]

    def check(self) -> IkResult:
        """This result, if every pose was reached.

        Raises:
            IkError: Names the first batch row that was not, its residual and the binding limits.
        """
        failed = np.argwhere(~np.asarray(self.converged))
        if not len(failed):
            return self
        row = tuple(int(i) for i in failed[0])
        bound = [int(i) + 1 for i in np.flatnonzero(np.asarray(self.binding_limit[row]))]
        raise IkError(
            f"pose{list(row) if row else ''}: not reached "
            f"({IkStatus(int(self.status[row])).name}); the closest found is "
            f"{1e3 * float(self.position_error[row]):.4g} mm and "
            f"{np.degrees(float(self.orientation_error[row])):.4g} degrees off"
            + (f", segments {bound} at their bending limit" if bound else "")
            + ("" if self.clearance is None else f", clearance {1e3 * self.clearance[row]:.4g} mm")
        )


class AllIkResult(eqx.Module):
    """Every configuration found for poses of any leading batch axes; K is the most of any pose."""

    q: Float[Array, "*batch K dof"]  # (theta_1, phi_1, ...) [rad]; NaN where ``mask`` is false
    mask: Bool[Array, "*batch K"]  # solutions come first
    singular_value: Float[Array, "*batch K"]  # smallest one of the Jacobian by the Cartesian
    # bending, arm length 1 and rad: small means two solutions that nearly coincide
    position_error: Float[Array, "*batch K"]  # [m]
    orientation_error: Float[Array, "*batch K"]  # [rad]
    complete: Bool[Array, "*batch"]  # no other solution exists; if false, there may be more
