"""Programs from files of programs and of plans."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from muxjax.config import ConfigError
from muxjax.plan_file import load_plan
from muxjax.program_file import load_program
from muxjax.robot import Robot
from muxjax.scheduler import Program, check_same_robot, schedule


def read_program(robot: Robot, path: str | Path) -> Program:
    """The program of a program's or a plan's file, told apart by their schema lines.

    Args:
        robot: The arm.
        path: File of ``save_program`` or of ``save_plan``.

    Raises:
        ConfigError: No such file, none of these, damaged, or made for another robot.
    """
    try:
        document: Any = json.loads(Path(path).read_bytes())
    except (OSError, ValueError):
        document = None  # load_program says what is wrong
    schema = str(document.get("schema")) if isinstance(document, dict) else ""
    try:
        if schema.startswith("muxjax/plan/"):
            return schedule(robot, load_plan(path))
        program = load_program(path)
        check_same_robot(robot, program)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    return program
