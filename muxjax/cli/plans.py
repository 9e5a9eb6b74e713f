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
from muxjax.config import TaskConfig, load_yaml, resolve
from muxjax.hardware import LockstepLink, execute
from muxjax.kinematics import check_configuration
from muxjax.metrics import evaluate
from muxjax.pipeline import PathPlan, PosePlan, plan_task, plan_to_pose
from muxjax.planning import Plan, Problem
from muxjax.planning import plan as plan_steps
from muxjax.program_file import load_program, save_program
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import Program, check_same_robot, schedule
from muxjax.tendons import tendon_displacements

Method = Literal[
    "exact", "beamstep", "beamstep_printed", "learned", "sequential", "reverse", "greedy"
]


def plan(
    xyz_mm: Xyz | None = None,
    rpy_deg: Xyz | None = None,
    quat: Quaternion | None = None,
    q_deg: tuple[float, ...] | None = None,
    poses: str | None = None,
    servos: tuple[int, ...] | None = None,
    method: Method = "exact",
    preset: str = "paper",
    max_step_mm: float | None = None,
    robot: str = "muxarm",
    out: Path | None = None,
    json: bool = False,
) -> int:
    """Plan from the straight arm to a pose, to a configuration, or through several poses.

    A pose is reached by the configuration whose plan costs least.

    Example: muxjax plan --q-deg 60 0 75 180 40 0 --servos 1 2 --out program.json

    Args:
        xyz_mm: Tool position in the world [mm].
        rpy_deg: Roll, pitch, yaw [degrees]; upright by default.
        quat: Orientation as a quaternion w x y z instead.
        q_deg: Bending angle and azimuth of each segment [degrees], instead of a pose.
        poses: Shipped task or path of a YAML file, whose targets are passed in order, instead.
        servos: Available servos; all by default.
        method: Planner.
        preset: Weights of the cost: paper, fastest, no-overshoot, or a YAML file.
        max_step_mm: Greatest tendon displacement in one step [mm]; no limit by default.
        robot: Shipped robot or path of a YAML file.
        out: Write the program here, for muxjax run.
        json: Print JSON in SI units.
    """
    arm = load_robot(robot)
    fields = _fields(arm, servos, preset, max_step_mm)
    if [xyz_mm, q_deg, poses].count(None) != 2:
        raise ValueError("plan: give either --xyz-mm (a pose), --q-deg or --poses")
    if xyz_mm is None and (rpy_deg is not None or quat is not None):
        raise ValueError("plan: only --xyz-mm takes --rpy-deg or --quat")
    if poses is not None:
        task = load_yaml(TaskConfig, resolve(poses, "tasks"))
        return _report_path(arm, task, plan_task(arm, task, method=method, **fields), out, json)
    if xyz_mm is None:
        return _report_plan(arm, _plan_to(arm, q_deg, method, fields), None, out, json)
    choice = plan_to_pose(arm, pose_argument(xyz_mm, rpy_deg, quat), method=method, **fields)
    return _report_plan(arm, choice.plan, choice, out, json)


def _plan_to(
    arm: Robot, q_deg: tuple[float, ...] | None, method: Method, fields: dict[str, Any]
) -> Plan:
    """Plan from the straight arm to a configuration [degrees]."""
    q = check_configuration(arm, np.radians(np.asarray(q_deg)))
    problem = Problem(np.zeros(arm.n_tendons), tendon_displacements(arm, q), **fields)
    return plan_steps(arm, problem, method)


def _fields(
    arm: Robot, servos: tuple[int, ...] | None, preset: str, max_step_mm: float | None
) -> dict[str, Any]:
    """Fields of ``Problem`` that the command line chooses."""
    return {
        "servos": servos or tuple(range(1, arm.tendons_per_segment + 1)),
        "preset": preset,
        "max_step": None if max_step_mm is None else max_step_mm / 1e3,
    }


def _report_plan(
    arm: Robot, found: Plan, choice: PosePlan | None, out: Path | None, json: bool
) -> int:
    program = schedule(arm, found)
    metrics = evaluate(arm, program)
    if out is not None:
        save_program(program, out)
    if json:
        document = {
            "robot": arm.config.name,
            "method": found.method,
            "status": found.status,
            "cost": found.cost,
            "lower_bound": found.lower_bound,
            "gap": found.gap,
            "metrics": dataclasses.asdict(metrics),
            "program": dataclasses.asdict(program),
        }
        if choice is not None:
            document["configurations"] = [
                {"q": o.q, "cost": o.cost, "lower_bound": o.lower_bound, "refusal": o.refusal}
                for o in (choice.chosen, *choice.alternatives)
            ]
            document["all_configurations"] = choice.complete
        print_json(document)
        return 0
    _print_program(program)
    if choice is not None:
        _print_choice(choice)
    console.print(
        f"{found.method}: {found.status}, cost {found.cost:.6g}, within {100 * found.gap:.2g} % "
        f"of the optimum; {metrics.time_s:.1f} s in {metrics.stages} stages; overshoot peak "
        f"{row_of(metrics.overshoot_peak, 100, 1)} %"
    )
    if out is not None:
        console.print(f"program written to {out}")
    return 0


def _print_choice(choice: PosePlan) -> None:
    table = Table("bending and azimuth of each segment [deg]", "cost", "")
    for option in (choice.chosen, *choice.alternatives):
        pairs = np.degrees(option.q).reshape(-1, 2)
        cost = f"{option.cost:.6g}"
        remark = "chosen" if option is choice.chosen else option.refusal
        if option.plan is None and not option.refusal:
            cost, remark = f"at least {option.lower_bound:.6g}", "not planned"
        table.add_row("   ".join(f"{t:.2f} at {p:.2f}" for t, p in pairs), cost, remark)
    console.print(table)


def _report_path(
    arm: Robot, task: TaskConfig, found: PathPlan, out: Path | None, json: bool
) -> int:
    metrics = [evaluate(arm, program) for program in found.programs]
    whole = evaluate(arm, found.program)
    if out is not None:
        save_program(found.program, out)
    if json:
        print_json(
            {
                "robot": arm.config.name,
                "cost": found.cost,
                "time_s": whole.time_s,
                "stages": whole.stages,
                "poses": [
                    {"name": t.name, "q": q, "status": p.status, "cost": p.cost}
                    | {"tip_deviation_m": d, "metrics": dataclasses.asdict(m)}
                    for t, q, p, d, m in zip(
                        task.targets, found.q, found.plans, found.deviations, metrics, strict=True
                    )
                ],
                "program": dataclasses.asdict(found.program),
            }
        )
        return 0
    _print_program(found.program)
    table = Table("to", "plan", "T [s]", "stages", "overshoot peak [%]", "tip off the line [mm]")
    for t, p, d, m in zip(task.targets, found.plans, found.deviations, metrics, strict=True):
        peak = row_of(m.overshoot_peak, 100, 1)
        row = (t.name, p.status, f"{m.time_s:.1f}", str(m.stages), peak, f"{1e3 * d:.1f}")
        table.add_row(*row)
    console.print(table)
    console.print(
        f"cost {found.cost:.6g}; {whole.time_s:.1f} s in {whole.stages} stages; the tool strays "
        f"{1e3 * max(found.deviations):.1f} mm at most from the line through the poses"
    )
    if out is not None:
        console.print(f"program written to {out}")
    return 0


def _print_program(program: Program) -> None:
    table = Table("stage", "axial", "clutches", "servo: tendon move [mm]", "servo: turn [deg]")
    for number, item in enumerate(program.instructions, start=1):
        moves = "  ".join(f"{s}: {1e3 * m:+.2f}" for s, m in item.length_moves.items())
        turns = "  ".join(f"{s}: {math.degrees(a):+.0f}" for s, a in item.servo_angles.items())
        clutches = " ".join(map(str, item.clutches))
        table.add_row(str(number), str(item.axial), clutches, moves, turns)
    console.print(table)


def run(
    program: Annotated[Path | None, tyro.conf.Positional] = None,
    xyz_mm: Xyz | None = None,
    rpy_deg: Xyz | None = None,
    quat: Quaternion | None = None,
    q_deg: tuple[float, ...] | None = None,
    servos: tuple[int, ...] | None = None,
    planner: Method = "exact",
    preset: str = "paper",
    max_step_mm: float | None = None,
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """Execute a program, or plan to a pose and execute that, on the virtual board, in lockstep.

    Examples: muxjax run program.json; muxjax run --planner learned --q-deg 60 0 75 180 40 0

    Args:
        program: File written by muxjax plan --out.
        xyz_mm: Instead of a program: tool position in the world [mm].
        rpy_deg: Roll, pitch, yaw [degrees]; upright by default.
        quat: Orientation as a quaternion w x y z instead.
        q_deg: Bending angle and azimuth of each segment [degrees], instead of a pose.
        servos: Available servos, for the plan; all by default.
        planner: Method of the plan.
        preset: Weights of its cost: paper, fastest, no-overshoot, or a YAML file.
        max_step_mm: Greatest tendon displacement in one of its steps [mm]; no limit by default.
        robot: Shipped robot or path of a YAML file; a program runs only on its own robot.
        json: Print JSON in SI units.
    """
    if [program, xyz_mm, q_deg].count(None) != 2:
        raise ValueError("run: give either a program file, --xyz-mm (a pose) or --q-deg")
    if xyz_mm is None and (rpy_deg is not None or quat is not None):
        raise ValueError("run: only --xyz-mm takes --rpy-deg or --quat")
    arm = load_robot(robot)
    if program is not None:
        loaded = load_program(program)
    else:
        fields = _fields(arm, servos, preset, max_step_mm)
        if xyz_mm is None:
            found = _plan_to(arm, q_deg, planner, fields)
        else:
            pose = pose_argument(xyz_mm, rpy_deg, quat)
            found = plan_to_pose(arm, pose, method=planner, **fields).plan
        loaded = schedule(arm, found)
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
