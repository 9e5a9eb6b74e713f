"""What ``muxjax figure`` draws: the data of each figure, and the figure.

matplotlib is loaded only here, inside the functions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from muxjax.cli.output import configuration_argument
from muxjax.config import data_folder, load_yaml, resolve
from muxjax.hardware.accuracy import (
    CASES,
    SEED,
    Trial,
    program_to,
    random_targets,
    rmse,
    run_trial,
    there_and_back,
)
from muxjax.kinematics import check_configuration
from muxjax.metrics.case_study import PANELS, case_study
from muxjax.metrics.protocol import Protocol
from muxjax.metrics.table2 import run_table, summarise
from muxjax.metrics.tables import TextTable, table1, table2, table3
from muxjax.robot import Robot
from muxjax.statics import forward_statics, load_chain
from muxjax.statics.experiment import GRAVITY
from muxjax.tendons import tendon_displacements
from muxjax.workspace import sweep

Tell = Callable[[str, int, int], None]  # what is done, how many, of how many

# Shapes of the arm whose tool lies in the xz plane: bending and azimuth by segment [deg].
SAMPLE_SHAPES: dict[str, tuple[float, ...]] = {
    "nearly straight": (5, 0, 5, 0, 5, 0),
    "slight bend": (30, 0, 25, 0, 20, 0),
    "C": (60, 0, 60, 0, 45, 0),
    "deep C": (100, 0, 100, 0, 80, 0),
    "S": (70, 180, 110, 0, 50, 180),
    "opposing bends": (60, 180, 75, 0, 40, 180),
    "hook": (20, 180, 30, 180, 130, 180),
    "folded": (150, 180, 150, 180, 110, 180),
}


@dataclass(frozen=True, eq=False)
class Drawn:
    """A figure, or a table to be typeset, and its numbers.

    Attributes:
        picture: What is saved.
        header: Of the table that a person reads on the terminal.
        rows: Its rows.
        document: The numbers in SI units, for --json.
    """

    picture: Any
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    document: dict[str, Any]

    def save(self, out: Path) -> Path:
        """Write it in the format of the path's ending."""
        from muxjax.viz.style import save_figure
        from muxjax.viz.tables import save_table

        write = save_table if isinstance(self.picture, TextTable) else save_figure
        return write(self.picture, out)


def draw_fig6(
    arm: Robot, protocol: str, seed: int, target: int, q_deg: Sequence[float] | None, tell: Tell
) -> Drawn:
    """M Fig. 6: to one target by every planner."""
    from muxjax.viz.programs import programs_figure

    rules = load_yaml(Protocol, resolve(protocol, "bench"))
    if q_deg is None:
        try:
            goal = rules.target(arm, seed, target)
        except ValueError as error:
            raise ValueError(f"{error}, or the bending itself with --q-deg") from None
        name = f"target {target} of seed {seed}"
    else:
        q = configuration_argument(arm, "--q-deg", q_deg)
        goal, name = np.asarray(tendon_displacements(arm, q)), "bending and azimuth as given"
    panels = []
    for panel in case_study(arm, rules, goal):
        panels.append(panel)
        tell("plans", len(panels), len(PANELS))
    figure = programs_figure(
        arm,
        {panel.name: panel.program for panel in panels},
        f"{arm.config.name}, {name}",
        letters="abcdefghi"[: len(panels) + 1],
    )
    rows = [
        (
            panel.name,
            f"{panel.metrics.time_s:.1f}",
            str(panel.metrics.stages),
            _percent(panel.metrics.overshoot_duration),
            _percent(panel.metrics.overshoot_peak),
        )
        for panel in panels
    ]
    document = {
        "target_m": goal,
        "panels": [
            {"name": p.name, "setting": p.setting, "servos": p.servos}
            | dataclasses.asdict(p.metrics)
            for p in panels
        ],
    }
    header = ("panel", "T [s]", "stages", "over by segment [% of T]", "peak [%]")
    return Drawn(figure, header, rows, document)


def _percent(shares: Sequence[float]) -> str:
    return "  ".join(f"{100 * share + 0.0:.1f}" for share in shares)


def draw_fig7(arm: Robot, case: str, trials: int, tell: Tell) -> Drawn:
    """M Fig. 7d-e: there and back with 3, 2 and 1 servos; the first trial is drawn."""
    from muxjax.viz.accuracy import trials_figure

    if trials < 1:
        raise ValueError(f"--trials: must be at least 1, found {trials}")
    counts = range(arm.tendons_per_segment, 0, -1)
    found: dict[int, list[Trial]] = {n: [] for n in counts}
    for number, target in enumerate(random_targets(arm, trials)):
        for n in counts:
            made = there_and_back(arm, target, tuple(range(1, n + 1)))
            found[n].append(run_trial(arm, *made, CASES[case], seed=100 * n + number))
            tell("runs", sum(map(len, found.values())), trials * len(counts))
    every = [trial for runs in found.values() for trial in runs]
    sets = [_errors_of(n, runs) for n, runs in [*found.items(), (None, every)]]
    rows = [
        (
            str(one["servos"] or "all"),
            str(one["trials"]),
            *(
                f"{1e3 * one[f'position_m_{where}']:.2f} mm, "
                f"{np.degrees(one[f'orientation_rad_{where}']):.2f} deg"
                for where in ("at_target", "whole_motion")
            ),
        )
        for one in sets
    ]
    figure = trials_figure({n: runs[0] for n, runs in found.items()}, case)
    header = ("servos", "trials", "RMSE at the target", "RMSE, whole motion")
    return Drawn(figure, header, rows, {"case": case, "targets_seed": SEED, "sets": sets})


def _errors_of(servos: int | None, runs: Sequence[Trial]) -> dict[str, Any]:
    """RMSE of the tool at the target and over the whole motion."""
    found: dict[str, Any] = {"servos": servos, "trials": len(runs)}
    for k, name in enumerate(("position_m", "orientation_rad")):
        tool = [trial.errors()[k][:, -1] for trial in runs]
        at = [values[trial.at_target] for values, trial in zip(tool, runs, strict=True)]
        found[f"{name}_at_target"] = rmse(np.array(at))
        found[f"{name}_whole_motion"] = rmse(np.concatenate(tool))
    return found


def draw_fig8c(arm: Robot, samples: int, seed: int, case: str, trials: int, tell: Tell) -> Drawn:
    """M Fig. 8c: dexterity, and time to reach and accuracy at sample points."""
    from muxjax.viz.accuracy import sample_point, workspace_figure

    if trials < 1:
        raise ValueError(f"--trials: must be at least 1, found {trials}")
    if arm.n_segments != 3:
        raise ValueError(
            f"fig8c: its sample shapes are of arms of 3 segments, {arm.config.name} has "
            f"{arm.n_segments}; muxjax sweep draws the dexterity of any arm"
        )
    servos = tuple(range(1, arm.tendons_per_segment + 1))
    points, total = [], 1 + len(SAMPLE_SHAPES)
    found = sweep(arm, samples=samples, seed=seed)
    tell("sample points", 1, total)
    for number, (name, shape) in enumerate(SAMPLE_SHAPES.items()):
        q = check_configuration(arm, np.radians(np.array(shape, dtype=float)))
        program = program_to(arm, np.asarray(tendon_displacements(arm, q)), servos)
        seeds = (1000 * number + k for k in range(trials))
        outward = len(program.instructions)
        runs = [run_trial(arm, program, outward, CASES[case], seed=s) for s in seeds]
        points.append(sample_point(name, runs))
        tell("sample points", len(points) + 1, total)
    about = f"{len(servos)} servos, {case}: RMS of {trials} runs"
    rows = [
        (
            f"{number} {p.name}",
            "  ".join(f"{1e3 * x + 0.0:.0f}" for x in p.tool[[0, 2]]),
            f"{p.time_s:.1f}",
            f"{1e3 * p.position:.2f}",
            f"{np.degrees(p.orientation):.2f}",
        )
        for number, p in enumerate(points, start=1)
    ]
    document = {
        "samples": found.samples,
        "mean_dexterity": found.mean_dexterity,
        "case": case,
        "points": [
            {
                "name": p.name,
                "tool_m": p.tool,
                "time_s": p.time_s,
                "position_error_m": p.position,
                "orientation_error_rad": p.orientation,
            }
            for p in points
        ],
    }
    header = ("sample point", "x, z [mm]", "time [s]", "position [mm]", "orientation [deg]")
    return Drawn(workspace_figure(found, points, about), header, rows, document)


def draw_table1(arm: Robot) -> Drawn:
    """M Table I."""
    return _table(table1(arm))


def draw_table2(
    arm: Robot, protocol: str, targets: int, seed: int, records: Path, tell: Tell
) -> Drawn:
    """M Table II. Targets done before, in the same folder, are not run again."""
    rules = load_yaml(Protocol, resolve(protocol, "bench"))
    records.mkdir(parents=True, exist_ok=True)
    done = run_table(
        arm,
        rules,
        targets=targets,
        seed=seed,
        kept=records / "targets.jsonl",
        progress=lambda k, of: tell("targets", k, of),
    )
    return _table(table2(rules, summarise(rules, done, seed)))


def draw_table3(arm: Robot) -> Drawn:
    """M Table III."""
    return _table(table3(arm))


def _table(table: TextTable) -> Drawn:
    document = {"title": table.title, "header": table.header, "rows": table.rows}
    return Drawn(table, table.header, list(table.rows), document)


def draw_statics(chain: str, displacements_mm: Sequence[float], payload_kg: float) -> Drawn:
    """The same tendon lengths upright, hanging and horizontal."""
    from muxjax.viz.statics import mountings_figure

    arm = load_chain(chain)
    found = {}
    for mounting, gravity in GRAVITY.items():
        down = np.array(gravity)
        found[mounting] = forward_statics(
            arm,
            displacements=np.array(displacements_mm) / 1e3,
            gravity=down,
            tip_wrench=np.array([0.0, 0.0, 0.0, *(payload_kg * down)]),
        )
    rows = [
        (
            mounting,
            "  ".join(f"{1e3 * x + 0.0:.1f}" for x in np.asarray(one.pose)[:3, 3]),
            f"{float(np.max(one.tension)):.1f}",
            "" if one.converged else "NO EQUILIBRIUM FOUND",
        )
        for mounting, one in found.items()
    ]
    document = {
        mounting: {
            "converged": bool(one.converged),
            "tip_m": np.asarray(one.pose)[:3, 3],
            "tension_n": np.asarray(one.tension),
        }
        for mounting, one in found.items()
    }
    header = ("mounting", "tip x, y, z [mm]", "largest tension [N]", "")
    return Drawn(
        mountings_figure(arm, found, GRAVITY), header, rows, {"chain": arm.name} | document
    )


def draw_training(runs: Sequence[Path]) -> Drawn:
    """Learning curves of trainings, by default of the policies that are shipped."""
    from muxjax.viz.training import curves_figure, load_curve

    folders = list(runs) or sorted((data_folder("checkpoints") / "policies").iterdir())
    curves = {folder.name: load_curve(folder) for folder in folders}
    rows = [
        (
            name,
            f"{1e-6 * curve[-1]['steps']:.2f}",
            f"{100 * curve[-1]['median_gap']:.2f}",
            f"{100 * (1 - curve[-1]['solved']):.2f}",
        )
        for name, curve in curves.items()
    ]
    header = ("training", "steps [million]", "over the optimum [%]", "unsolved [%]")
    document = {name: {"last": dict(curve[-1])} for name, curve in curves.items()}
    return Drawn(curves_figure(curves), header, rows, document)
