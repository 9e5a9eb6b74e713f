"""What a sweep is: the header of its file, and the hash by which a checkpoint knows its own."""

from __future__ import annotations

import hashlib
import json
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax
import numpy as np

from muxjax.collision import World
from muxjax.robot import Robot
from muxjax.workspace.cells import Cells
from muxjax.workspace.marking import Layout
from muxjax.workspace.orientation import bin_error


def about_sweep(
    robot: Robot, layout: Layout, seed: int, tolerance_deg: float, world: World | None = None
) -> dict[str, Any]:
    """Robot, world, grids, seed and versions, as JSON can hold them."""
    error = bin_error(layout.per_axis, layout.in_plane)
    return {
        "robot": {
            "config": robot.config.model_dump(mode="json", by_alias=True),
            # The values used: a design study changes them without writing a new file.
            "length_m": np.asarray(robot.length, float).tolist(),
            "theta_max_rad": np.asarray(robot.theta_max, float).tolist(),
            "base": np.asarray(robot.base, float).tolist(),
            "tool": np.asarray(robot.tool, float).tolist(),
        }
        | (
            {}
            if world is None
            else {"body_radius_m": float(robot.body_radius)}  # decides what is clear
        ),
        **(
            {}
            if world is None
            else {"world": {"name": world.name, "fingerprint": world.fingerprint}}
        ),
        "axially_symmetric": layout.in_plane,
        "seed": int(seed),
        "sampler": layout.sampler,
        "tolerance_deg": float(tolerance_deg),
        "bins_per_axis": layout.per_axis,
        "bin_error_deg": {
            "typical": float(np.degrees(error.typical)),
            "largest": float(np.degrees(error.largest)),
        },
        "versions": {
            "muxjax": _version(),
            "jax": jax.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def _version() -> str:
    try:
        return version("muxjax")
    except PackageNotFoundError:
        return "unknown"


def identity_of(about: dict[str, Any], grid: Cells) -> str:
    """Hash of all that decides the tables; versions and the reasons in the YAML do not."""
    decisive = {key: value for key, value in about.items() if key not in ("versions", "robot")}
    decisive["robot"] = {k: v for k, v in about["robot"].items() if k != "config"}
    decisive["cells"] = [*grid.shape, grid.reach]
    return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()
