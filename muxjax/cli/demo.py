"""``muxjax demo``: the whole way, for every target, servo set and method."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich import box
from rich.table import Column, Table

from muxjax.cli.output import console, print_json, row_of
from muxjax.cli.plans import Method
from muxjax.config import TaskConfig, load_yaml, resolve
from muxjax.ik import IkStatus
from muxjax.pipeline import Outcome, run_task
from muxjax.planning.problem import preset_weights
from muxjax.robot import Robot, load_robot


def demo(
    task: str = "fig9a",
    robot: str = "muxarm",
    methods: tuple[Method, ...] = get_args(Method),
    max_step_mm: float | None = 20.0,
    preset: str = "paper",
    out: Path = Path("out/demo"),
    json: bool = False,
) -> int:
    """Every target of a task with all servos, then with one fewer, down to one, executed.

    For each target, servo set and method: IK error, stages, time, overshoot, and where the tool is
    after execution on the virtual board. Draws each target's tendon lengths and bending angles
    over time, and an animation of the arm.

    Example: muxjax demo --methods exact greedy --out out/demo

    Example: muxjax demo --task my_poses.yaml --robot my_arm.yaml

    Args:
        task: Shipped task or path of a YAML file of target poses.
        robot: Shipped robot or path of a YAML file.
        methods: Planners to compare.
        max_step_mm: Greatest tendon displacement in one planning step [mm].
        preset: Weights of the cost: paper, fastest, no-overshoot, gentle, or a YAML file.
        out: Folder for the pictures.
        json: Print JSON in SI units instead of tables.
    """
    if not methods:
        raise ValueError("--methods: needs at least one planner")
    preset_weights(preset)  # a wrong name is refused before any work
    began = time.perf_counter()
    arm = load_robot(robot)
    targets = load_yaml(TaskConfig, resolve(task, "tasks"))
    _check_fits(arm, targets)
    out.mkdir(parents=True, exist_ok=True)
    servo_sets = [tuple(range(1, n + 1)) for n in range(arm.tendons_per_segment, 0, -1)]
    outcomes: list[Outcome] = []
    for outcome in run_task(
        arm,
        targets,
        servo_sets=servo_sets,
        methods=methods,
        max_step=None if max_step_mm is None else max_step_mm / 1e3,
        preset=preset,
    ):
        outcomes.append(outcome)
        if not json:
            _print_outcome(outcome, first=outcome.servos == servo_sets[0])
    pictures = _draw_outcomes(arm, outcomes, out, quiet=json)
    if json:
        print_json([_outcome_document(o) for o in outcomes])
    else:
        console.print(
            "* certified optimum. By segment: share of T above the final angle, peak above it. "
            "Tool: error after execution."
        )
        console.print(f"pictures in {out}: {', '.join(p.name for p in pictures)}")
        console.print(f"done in {time.perf_counter() - began:.0f} s")
    return 0


def _check_fits(arm: Robot, task: TaskConfig) -> None:
    """Whether a task's configurations are of this robot's number of segments.

    Raises:
        ValueError: They are of another one.
    """
    for target in task.targets:
        angles = target.near_q_deg
        if angles is not None and len(angles) != 2 * arm.n_segments:
            raise ValueError(
                f"--task: {task.name!r} is for a robot of {len(angles) // 2} segments "
                f"({target.name!r}, near_q_deg: {len(angles)} angles), {arm.config.name!r} has "
                f"{arm.n_segments}; give a task of your own with --task (docs/command_line.md)"
            )


def _print_outcome(outcome: Outcome, *, first: bool) -> None:
    found = outcome.ik
    if not found.converged:
        if first:
            console.print(
                f"{outcome.target.name}: not reached "
                f"({IkStatus(int(found.status)).name.lower()}), the closest found is "
                f"{1e3 * found.position_error:.1f} mm and "
                f"{np.degrees(found.orientation_error):.1f} deg off; nothing was planned\n"
            )
        return
    table = Table(
        Column("method", no_wrap=True),
        "cost",
        "stages",
        "T [s]",
        "board [s]",
        Column("over [% of T]", no_wrap=True),
        Column("peak [%]", no_wrap=True),
        "tool [mm]",
        "[deg]",
        box=box.SIMPLE_HEAD,
        title=f"{outcome.target.name}, servos {' '.join(map(str, outcome.servos))}: IK error "
        f"{1e3 * found.position_error:.1e} mm, {found.orientation_error:.1e} rad",
        title_justify="left",
    )
    for method, move in outcome.moves.items():
        m = move.metrics
        table.add_row(
            method,
            f"{move.plan.cost:.4f}" + (" *" if move.plan.status == "optimal" else ""),
            str(m.stages),
            f"{m.time_s:.1f}",
            f"{move.run.duration_s:.1f}" if move.run.completed else move.run.reason,
            row_of(m.overshoot_duration, 100, 1),
            row_of(m.overshoot_peak, 100, 1),
            f"{1e3 * move.position_error:.3f}",
            f"{np.degrees(move.orientation_error):.3f}",
        )
    for method, reason in outcome.refusals.items():
        table.add_row(method, reason.removeprefix(f"{method}: "))
    console.print(table)


def _outcome_document(outcome: Outcome) -> dict[str, Any]:
    return {
        "target": outcome.target.name,
        "servos": outcome.servos,
        "reached": bool(outcome.ik.converged),
        "ik_status": IkStatus(int(outcome.ik.status)).name.lower(),
        "ik_position_error_m": float(outcome.ik.position_error),
        "ik_orientation_error_rad": float(outcome.ik.orientation_error),
        "refusals": outcome.refusals,
        "moves": {
            method: {
                "cost": move.plan.cost,
                "lower_bound": move.plan.lower_bound,
                "status": move.plan.status,
                "metrics": dataclasses.asdict(move.metrics),
                "completed": move.run.completed,
                "reason": move.run.reason,
                "duration_s": move.run.duration_s,
                "position_error_m": move.position_error,
                "orientation_error_rad": move.orientation_error,
            }
            for method, move in outcome.moves.items()
        },
    }


def _draw_outcomes(
    robot: Robot, outcomes: Sequence[Outcome], out: Path, *, quiet: bool
) -> list[Path]:
    try:
        from muxjax import viz
    except ImportError:
        if not quiet:
            console.print("no pictures: they need matplotlib, pip install 'muxjax[viz]'")
        return []
    reached = [o for o in outcomes if o.moves]
    pictures = []
    for name in dict.fromkeys(o.target.name for o in reached):
        mine = [o for o in reached if o.target.name == name]
        best = next(iter(mine[0].moves))
        # After M Fig. 6: every method with one servo, the first one with more servos beside it.
        programs = {
            f"{method}, 1 servo": move.program for method, move in reversed(mine[-1].moves.items())
        } | {f"{best}, {len(o.servos)} servos": o.moves[best].program for o in reversed(mine[:-1])}
        stem = name.replace(" ", "_")
        pictures.append(viz.compare_programs(robot, programs, name, out / f"{stem}.png"))
    if reached:
        best = next(iter(reached[0].moves))
        title = f"{reached[0].target.name}, {best}, {len(reached[0].servos)} servos"
        program = reached[0].moves[best].program
        pictures.append(viz.animate(robot, program, title, out / "arm.gif"))
    return pictures
