"""``muxjax plan``: a pose to a program."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.table import Table

from muxjax.cli.output import configuration_argument, console, print_json, row_of
from muxjax.cli.poses import Quaternion, Xyz, pose_argument
from muxjax.collision import load_world
from muxjax.config import TaskConfig, load_yaml, resolve
from muxjax.metrics import evaluate
from muxjax.pipeline import PathPlan, PosePlan, plan_task, plan_to_pose
from muxjax.plan_file import save_plan as write_plan
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
    start_q_deg: tuple[float, ...] | None = None,
    after: Path | None = None,
    servos: tuple[int, ...] | None = None,
    method: Method = "exact",
    preset: str = "paper",
    max_step_mm: float | None = None,
    world: str | None = None,
    robot: str = "muxarm",
    out: Path | None = None,
    save_plan: Path | None = None,
    json: bool = False,
) -> int:
    """Plan to a pose, to a configuration, or through several poses.

    A pose is reached by the configuration whose plan costs least. The plan starts from the straight
    arm, or from where --after or --start-q-deg says that the arm stands.

    Example: muxjax plan --q-deg 60 0 75 180 40 0 --servos 1 2 --out program.json

    Example: muxjax plan --q-deg 0 0 0 0 0 0 --after program.json --out back.json

    Args:
        xyz_mm: Tool position in the world [mm].
        rpy_deg: Roll, pitch, yaw [degrees]; upright by default.
        quat: Orientation as a quaternion w x y z instead.
        q_deg: Bending angle (not negative) and azimuth of each segment [degrees], not a pose.
        poses: Shipped task or path of a YAML file, whose targets are passed in order, instead.
        start_q_deg: Start from this configuration [degrees] instead of the straight arm.
        after: Start where this program ends instead; its last axial position is then known, too.
        servos: Available servos; all by default.
        method: Planner; muxjax run and resume call it --planner.
        preset: Weights of the cost: paper, fastest, no-overshoot, gentle, or a YAML file.
        max_step_mm: Greatest tendon displacement in one step [mm]; no limit by default.
        world: Shipped world or path of a YAML file, of which every step must be clear.
        robot: Shipped robot or path of a YAML file.
        out: Write the program here, for muxjax run.
        save_plan: Write the plan itself here, step by step, as JSON.
        json: Print JSON in SI units.
    """
    arm = load_robot(robot)
    fields = problem_fields(arm, servos, preset, max_step_mm, world)
    if [xyz_mm, q_deg, poses].count(None) != 2:
        raise ValueError("plan: give either --xyz-mm (a pose), --q-deg or --poses")
    if xyz_mm is None and (rpy_deg is not None or quat is not None):
        raise ValueError("plan: only --xyz-mm takes --rpy-deg or --quat")
    if poses is not None and save_plan is not None:
        raise ValueError("plan: --save-plan takes one plan, --poses makes several; use --out")
    begin = start_fields(arm, start_q_deg, after)
    if poses is not None:
        task = load_yaml(TaskConfig, resolve(poses, "tasks"))
        path = plan_task(arm, task, method=method, **begin, **fields)
        return _report_path(arm, task, path, out, json)
    choice = None
    if xyz_mm is None:
        found = plan_to_configuration(arm, q_deg, method, begin | fields)
    else:
        pose = pose_argument(xyz_mm, rpy_deg, quat)
        choice = plan_to_pose(arm, pose, method=method, **begin, **fields)
        found = choice.plan
    if save_plan is not None:
        write_plan(found, save_plan)
    return _report_plan(arm, found, choice, out, json)


def plan_to_configuration(
    arm: Robot, q_deg: tuple[float, ...] | None, method: Method, fields: dict[str, Any]
) -> Plan:
    """Plan to a configuration [degrees]; the fields of ``Problem`` have the start."""
    assert q_deg is not None  # the callers have seen to it
    q = configuration_argument(arm, "--q-deg", q_deg)
    problem = Problem(target=tendon_displacements(arm, q), **fields)
    return plan_steps(arm, problem, method)


def start_fields(
    arm: Robot, start_q_deg: tuple[float, ...] | None, after: Path | None
) -> dict[str, Any]:
    """Fields of ``Problem`` that say where the arm stands: straight unless something is given.

    Raises:
        ValueError: Both are given, a configuration that the arm does not have, or the program of
            another robot.
        ConfigError: The program cannot be read.
    """
    if start_q_deg is not None and after is not None:
        raise ValueError("--start-q-deg, --after: the arm starts from one of them; give only one")
    if start_q_deg is not None:
        q = configuration_argument(arm, "--start-q-deg", start_q_deg)
        return {"start": np.asarray(tendon_displacements(arm, q)), "axial": None}
    if after is None:
        return {"start": np.zeros(arm.n_tendons), "axial": None}
    before = load_program(after)
    check_same_robot(arm, before)
    visits = before.instructions
    axial = visits[-1].axial if visits else before.axial
    return {"start": np.array(before.target), "axial": axial}


def problem_fields(
    arm: Robot,
    servos: tuple[int, ...] | None,
    preset: str,
    max_step_mm: float | None,
    world: str | None = None,
) -> dict[str, Any]:
    """Fields of ``Problem`` that the command line chooses."""
    return {
        "servos": servos or tuple(range(1, arm.tendons_per_segment + 1)),
        "preset": preset,
        "max_step": None if max_step_mm is None else max_step_mm / 1e3,
        "world": None if world is None else load_world(world),
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
