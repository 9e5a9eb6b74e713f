"""Workspace and dexterity of an arm by streamed, resumable, sharded sampling (M VI-C)."""

from muxjax.workspace.cells import Cells, axially_symmetric
from muxjax.workspace.convergence import Limit
from muxjax.workspace.design import Design, DesignStudy, design_study, with_values
from muxjax.workspace.files import SweepFileError
from muxjax.workspace.loop import SweepInterruptedError, sweep
from muxjax.workspace.result import Sweep, load_sweep

__all__ = [
    "Cells",
    "Design",
    "DesignStudy",
    "Limit",
    "Sweep",
    "SweepFileError",
    "SweepInterruptedError",
    "axially_symmetric",
    "design_study",
    "load_sweep",
    "sweep",
    "with_values",
]
