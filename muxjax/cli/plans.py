"""``muxjax plan`` and ``muxjax run``: a pose to a program, a program to the board."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.table import Table

from muxjax.cli.output import console, print_json, row_of
from muxjax.cli.poses import Quaternion, Xyz, pose_argument
from muxjax.hardware import LockstepLink, execute
from muxjax.kinematics import check_configuration
from muxjax.metrics import evaluate
from muxjax.pipeline import problem_for_pose
from muxjax.planning import Problem
from muxjax.planning import plan as plan_steps
from muxjax.program_file import load_program, save_program
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import Program, check_same_robot, schedule
from muxjax.tendons import tendon_displacements

Method = Literal["exact", "beamstep", "beamstep_printed", "sequential", "reverse", "greedy"]


def plan(
    xyz_mm: Xyz | None = None,
    rpy_deg: Xyz | None = None,
    quat: Quaternion | None = None,
    q_deg: tuple[float, ...] | None = None,
    servos: tuple[int, ...] | None = None,
    method: Method = "exact",
    preset: str = "paper",
    max_step_mm: float | None = None,
    robot: str = "muxarm",
    out: Path | None = None,
    json: bool = False,
) -> int:
    """Plan from the straight arm to a pose or a configuration.

    Example: muxjax plan --q-deg 60 0 75 180 40 0 --servos 1 2 --out program.json

    Args:
        xyz_mm: Tool position in the world [mm].
        rpy_deg: Roll, pitch, yaw [degrees]; upright by default.
        quat: Orientation as a quaternion w x y z instead.
        q_deg: Bending angle and azimuth of each segment [degrees], instead of a pose.
        servos: Available servos; all by default.
        method: Planner.
        preset: Weights of the cost: paper, fastest, no-overshoot, or a YAML file.
        max_step_mm: Greatest tendon displacement in one step [mm]; no limit by default.
        robot: Shipped robot or path of a YAML file.
        out: Write the program here, for muxjax run.
        json: Print JSON in SI units.
    """
    arm = load_robot(robot)
    fields: dict[str, Any] = {
        "servos": servos or tuple(range(1, arm.tendons_per_segment + 1)),
        "preset": preset,
        "max_step": None if max_step_mm is None else max_step_mm / 1e3,
    }
    problem = _problem(arm, xyz_mm, rpy_deg, quat, q_deg, fields)
    found = plan_steps(arm, problem, method)
    program = schedule(arm, found)
    metrics = evaluate(arm, program)
    if out is not None:
        save_program(program, out)
    if json:
        print_json(
            {
                "robot": arm.config.name,
                "method": found.method,
                "status": found.status,
                "cost": found.cost,
                "lower_bound": found.lower_bound,
                "gap": found.gap,
                "metrics": dataclasses.asdict(metrics),
                "program": dataclasses.asdict(program),
            }
        )
        return 0
    _print_program(program)
    console.print(
        f"{found.method}: {found.status}, cost {found.cost:.6g}, within {100 * found.gap:.2g} % "
        f"of the optimum; {metrics.time_s:.1f} s in {metrics.stages} stages; overshoot peak "
        f"{row_of(metrics.overshoot_peak, 100, 1)} %"
    )
    if out is not None:
        console.print(f"program written to {out}")
    return 0


def _problem(
    arm: Robot,
    xyz_mm: Xyz | None,
    rpy_deg: Xyz | None,
    quat: Quaternion | None,
    q_deg: tuple[float, ...] | None,
    fields: dict[str, Any],
) -> Problem:
    if q_deg is not None and (rpy_deg is not None or quat is not None):
        raise ValueError("plan: --q-deg fixes the orientation; leave out --rpy-deg and --quat")
    if xyz_mm is not None and q_deg is None:
        return problem_for_pose(arm, pose_argument(xyz_mm, rpy_deg, quat), **fields)[1]
    if q_deg is not None and xyz_mm is None:
        q = check_configuration(arm, np.radians(q_deg))
        return Problem(np.zeros(arm.n_tendons), tendon_displacements(arm, q), **fields)
    raise ValueError("plan: give either --xyz-mm (a pose) or --q-deg (a configuration)")


def _print_program(program: Program) -> None:
    table = Table("stage", "axial", "clutches", "servo: tendon move [mm]", "servo: turn [deg]")
    for number, item in enumerate(program.instructions, start=1):
        moves = "  ".join(f"{s}: {1e3 * m:+.2f}" for s, m in item.length_moves.items())
        turns = "  ".join(f"{s}: {math.degrees(a):+.0f}" for s, a in item.servo_angles.items())
        clutches = " ".join(map(str, item.clutches))
        table.add_row(str(number), str(item.axial), clutches, moves, turns)
    console.print(table)


def run(
    program: Annotated[Path, tyro.conf.Positional],
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """Execute a program on the virtual board, in lockstep on a virtual clock.

    Example: muxjax run program.json

    Args:
        program: File written by muxjax plan --out.
        robot: Shipped robot or path of a YAML file; a program runs only on its own robot.
        json: Print JSON in SI units.
    """
    arm = load_robot(robot)
    loaded = load_program(program)
    check_same_robot(arm, loaded)
    link = LockstepLink(arm, displacements=loaded.start, axial=loaded.axial)
    done = execute(loaded, link)
    error = np.abs(done.measured - np.array(loaded.target))
    if json:
        print_json(
            {
                "robot": arm.config.name,
                "completed": done.completed,
                "reason": done.reason,
                "duration_s": done.duration_s,
                "measured_m": done.measured,
                "largest_error_m": float(np.max(error)),
                "instructions": [dataclasses.asdict(r) for r in done.records],
            }
        )
        return 0 if done.completed else 1
    table = Table("stage", "axial", "begin [s]", "end [s]", "trims")
    for number, r in enumerate(done.records, start=1):
        table.add_row(str(number), str(r.axial), f"{r.start_s:.2f}", f"{r.end_s:.2f}", str(r.trims))
    console.print(table)
    console.print(
        f"{done.reason}: {done.duration_s:.2f} s on the board's clock, wheels within "
        f"{1e3 * np.max(error):.3f} mm of the target"
    )
    return 0 if done.completed else 1
