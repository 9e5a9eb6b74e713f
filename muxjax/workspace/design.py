"""Reach and dexterity against a robot's parameters: one sweep for each design."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from muxjax.config import RobotConfig
from muxjax.robot import Robot, robot_from_config
from muxjax.tendons import displacement_range
from muxjax.workspace.loop import sweep
from muxjax.workspace.result import Sweep

_STEP = re.compile(r"([a-z_0-9]+)(?:\[(\d+)\])?")


@dataclass(frozen=True, eq=False)
class Design:
    """One row of a design study."""

    values: dict[str, float]  # the parameters, by their paths in the robot's file
    sweep: Sweep
    stroke: float  # largest travel that any tendon needs, end to end [m]

    def row(self) -> dict[str, float]:
        """Parameters and figures, as a line of a table."""
        limit = self.sweep.limit()
        return {
            **self.values,
            "reach_radius_m": self.sweep.reach_radius,
            "reach_volume_m3": self.sweep.reach_volume,
            "mean_dexterity": self.sweep.mean_dexterity,
            "mean_dexterity_limit": limit.value,
            "limit_uncertainty": limit.uncertainty,
            "peak_dexterity": self.sweep.peak_dexterity,
            "tendon_stroke_m": self.stroke,
        }


@dataclass(frozen=True, eq=False)
class DesignStudy:
    """All designs of a study, in the order of the grid."""

    parameters: dict[str, tuple[float, ...]]
    designs: tuple[Design, ...]

    def table(self) -> list[dict[str, float]]:
        """One dictionary a design: parameters, reach, dexterity and tendon stroke."""
        return [design.row() for design in self.designs]

    def save_csv(self, path: str | Path) -> Path:
        """Write the table."""
        path, rows = Path(path), self.table()
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        return path


def design_study(
    robot: Robot, parameters: Mapping[str, Sequence[float]], *, samples: int, **options: Any
) -> DesignStudy:
    """Sweep every combination of parameter values.

    All designs share the samples' seed, so that differences between neighbours are not noise.

    Args:
        robot: Its configuration is where the designs start from.
        parameters: Values for each parameter, named by its path in the robot's file, such as
            ``"segments[1].length_m"``, ``"segments[3].theta_max_deg"`` or ``"tendons.radius_m"``.
            (The tendon radius does not change the workspace, only the stroke that it costs.)
        samples: Configurations a design.
        options: As for ``sweep``.

    Raises:
        ValueError: No parameter, no value, an unknown path, or a value out of its limits.
    """
    if not parameters or not all(len(values) for values in parameters.values()):
        raise ValueError("parameters: needs at least one parameter with at least one value")
    grid = [
        dict(zip(parameters, values, strict=True))
        for values in itertools.product(*parameters.values())
    ]
    variants = [with_values(robot, values) for values in grid]  # all are checked before any runs
    designs = []
    for values, variant in zip(grid, variants, strict=True):
        span = displacement_range(variant)
        designs.append(
            Design(
                {name: float(value) for name, value in values.items()},
                sweep(variant, samples=samples, **options),
                float(np.max(span[:, 1] - span[:, 0])),
            )
        )
    lists = {name: tuple(float(v) for v in values) for name, values in parameters.items()}
    return DesignStudy(lists, tuple(designs))


def with_values(robot: Robot, values: Mapping[str, float]) -> Robot:
    """The robot of a changed configuration.

    Args:
        robot: Its configuration is changed.
        values: New values by path; lists count from 1, as in error messages.

    Raises:
        ValueError: Unknown path, or a value that the configuration does not allow.
    """
    raw = robot.config.model_dump(by_alias=True)
    for path, value in values.items():
        _set(raw, path, float(value))
    try:
        return robot_from_config(RobotConfig.model_validate(raw))
    except ValidationError as error:
        reasons = "; ".join(item["msg"] for item in error.errors(include_url=False))
        raise ValueError(
            f"{', '.join(f'{k} = {v:g}' for k, v in values.items())}: {reasons}"
        ) from (error)


def _set(raw: dict[str, Any], path: str, value: float) -> None:
    here: Any = raw
    for step in path.split("."):
        match = _STEP.fullmatch(step)
        if match is None or not isinstance(here, dict) or match[1] not in here:
            known = ", ".join(here) if isinstance(here, dict) else "nothing"
            raise ValueError(f"{path}: no such parameter at {step!r}; here are {known}")
        here = here[match[1]]
        if match[2] is not None:
            number = int(match[2])
            if not isinstance(here, list | tuple) or not 1 <= number <= len(here):
                size = len(here) if isinstance(here, list | tuple) else 0
                raise ValueError(f"{path}: {match[1]} has entries 1 to {size}, found {number}")
            here = here[number - 1]
    if not isinstance(here, dict) or here.keys() != {"value", "source", "why"}:
        raise ValueError(f"{path}: is not one value; name a field such as segments[1].length_m")
    here.update(value=value, source="assumed", why="varied in a design study")
