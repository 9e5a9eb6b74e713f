"""Pose to configuration: all of them, or one.

``all_solutions`` enumerates the configurations of three segments (MODEL.md section 8);
``levenberg`` serves other arms and partial goals; ``descent`` is the paper's own iteration
(M Eq. 3); ``one`` chooses. ``path`` follows a sequence of poses, ``implicit`` differentiates.
"""

from muxjax.ik.descent import rotation_error
from muxjax.ik.every import all_ik
from muxjax.ik.implicit import attach_derivatives
from muxjax.ik.one import solve_ik
from muxjax.ik.path import PathResult, solve_path
from muxjax.ik.result import AllIkResult, IkError, IkResult, IkStatus

__all__ = [
    "AllIkResult",
    "IkError",
    "IkResult",
    "IkStatus",
    "PathResult",
    "all_ik",
    "attach_derivatives",
    "rotation_error",
    "solve_ik",
    "solve_path",
]
