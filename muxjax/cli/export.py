"""``muxjax export``: programs and plans for other software."""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import Annotated

import tyro

from muxjax.cli.output import console, print_json
from muxjax.metrics.program import timeline
from muxjax.plan_file import load_plan
from muxjax.program_file import load_program, save_program
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import Program, schedule
from muxjax.trajectory_file import columns, sample, save_trajectory


def export(
    source: Annotated[Path, tyro.conf.Positional],
    out: Path,
    rate_hz: float = 50.0,
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """Write how a program or a plan moves the arm, as CSV or NPZ; or the program of a plan.

    A trajectory has tendons, bending and the tool over time, in SI units named in each column:
    time_s, tendon_1_m ..., theta_1_rad, phi_1_rad ..., x_m, y_m, z_m, qw, qx, qy, qz. Times are
    those of M Eq. 14.

    Example: muxjax export program.json --out trajectory.csv

    Example: muxjax export program.json --out trajectory.npz --rate-hz 200

    Example: muxjax export plan.json --out program.json

    Args:
        source: Program (muxjax plan --out) or plan (muxjax plan --save-plan).
        out: File to write: a trajectory as .csv or .npz, a program as .json.
        rate_hz: Samples of a trajectory a second [Hz]; the end itself is one more.
        robot: Shipped robot or path of a YAML file; it must be that of the source.
        json: Print what was written as JSON.
    """
    arm = load_robot(robot)
    program = _program(arm, source)
    document: dict[str, object]
    if out.suffix == ".json":
        save_program(program, out)
        count = len(program.instructions)
        document = {"instructions": count}
        text = f"program of {count} instructions written to {out}"
    else:
        samples = sample(arm, timeline(arm, program), rate_hz)
        save_trajectory(samples, out)
        count, end = len(samples.time_s), float(samples.time_s[-1])
        document = {"samples": count, "duration_s": end, "columns": list(columns(samples))}
        text = f"{count} samples of {end:.2f} s written to {out}"
    if json:
        print_json({"robot": program.robot, "file": str(out), **document})
    else:
        console.print(text)
    return 0


def _program(arm: Robot, source: Path) -> Program:
    """Program of a program's or a plan's file, told apart by their schema lines."""
    try:
        found = json_text.loads(source.read_bytes())
        line = found.get("schema", "") if isinstance(found, dict) else ""
    except (OSError, ValueError):
        line = ""  # load_program says what is wrong
    if str(line).startswith("muxjax/plan/"):
        return schedule(arm, load_plan(source))
    return load_program(source)
