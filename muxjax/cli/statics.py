"""``muxjax statics``: the true posture of an arm, calibration, and the paper's experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.table import Table

from muxjax.cli.output import choice_of, console, pose_document, print_json, row_of, verdict
from muxjax.cli.poses import Xyz
from muxjax.robot import load_robot
from muxjax.statics import (
    ElasticChain,
    Equilibrium,
    StaticsStatus,
    elastic_chain,
    forward_statics,
    load_chain,
)
from muxjax.statics.calibration import Calibration, calibrate, read_measurements, save_chain
from muxjax.statics.calibration.parameters import Group
from muxjax.statics.curvature import pcc_bending, pcc_frames
from muxjax.statics.experiment import (
    GRAVITY,
    Experiment,
    Mounting,
    Perturbation,
    one_at_a_time,
    run_experiment,
)

UNITS = {
    "position": (1e3, "mm"),
    "orientation": (float(np.degrees(1.0)), "deg"),
    "tension": (1.0, "N"),
}


def posture(
    tension_n: tuple[float, ...] | None = None,
    displacements_mm: tuple[float, ...] | None = None,
    chain: str | None = None,
    robot: str | None = None,
    mounting: Mounting | None = None,
    gravity: Xyz | None = None,
    payload_kg: float = 0.0,
    tip_force_n: Xyz = (0.0, 0.0, 0.0),
    tip_moment_nm: Xyz = (0.0, 0.0, 0.0),
    kernel: Literal["virtual_work", "couple"] = "virtual_work",
    plot: Path | None = None,
    json: bool = False,
) -> int:
    """Posture from tendon tensions or tendon lengths, under weight and load.

    Example: muxjax statics posture --displacements-mm -4 0 4 0 -6 0 6 0 --mounting hanging

    Example: muxjax statics posture --robot muxarm --tension-n 20 0 0 0 0 0 0 0 0 --payload-kg 0.5

    Args:
        tension_n: Tension of every tendon [N]; either this or the displacements.
        displacements_mm: Displacement of every tendon [mm], negative = wound in.
        chain: Shipped chain or path of a YAML file; hyper_redundant by default.
        robot: Robot instead of a chain; springs are then assumed (see elastic_chain).
        mounting: How the arm stands; as its file says by default.
        gravity: Direction and size in the base frame instead [m/s^2]; 0 0 0 is none.
        payload_kg: Mass at the tip.
        tip_force_n: Force on the tip in the base frame [N].
        tip_moment_nm: Moment on the tip in the base frame [N m].
        kernel: Virtual work, or the paper's couple load.
        plot: Draw the posture beside constant curvature, and the tensions, into this file.
        json: Print JSON in SI units.
    """
    if (tension_n is None) == (displacements_mm is None):
        raise ValueError("posture: give either --tension-n or --displacements-mm")
    if not 0 <= payload_kg < np.inf:
        raise ValueError(f"--payload-kg: must be at least 0, found {payload_kg:g}")
    arm = _arm(chain, robot)
    down = _gravity(arm, mounting, gravity)
    force = np.array(tip_force_n) + payload_kg * down
    given: dict[str, Any] = {"tension": tension_n}
    if displacements_mm is not None:
        given = {"displacements": np.array(displacements_mm) / 1e3}
    found = forward_statics(
        arm, **given, gravity=down, tip_wrench=np.array([*tip_moment_nm, *force]), kernel=kernel
    )
    if plot is not None:
        _figures().draw_posture(arm, found, plot)
    if json:
        print_json(_posture_document(arm, found))
    else:
        _print_posture(arm, found)
        if plot is not None:
            console.print(f"drawn into {plot}")
    return 0 if found.converged else 1


def _arm(chain: str | None, robot: str | None) -> ElasticChain:
    if robot is None:
        return load_chain(chain or "hyper_redundant")
    if chain is not None:
        raise ValueError("posture: give either --chain or --robot")
    return elastic_chain(load_robot(robot))


def _gravity(
    arm: ElasticChain, mounting: Mounting | None, gravity: Xyz | None
) -> np.ndarray[Any, np.dtype[np.float64]]:
    if mounting is not None and gravity is not None:
        raise ValueError("posture: give either --mounting or --gravity")
    if gravity is not None:
        return np.array(gravity)
    return np.asarray(arm.gravity) if mounting is None else np.array(GRAVITY[mounting])


def _posture_document(arm: ElasticChain, found: Equilibrium) -> dict[str, Any]:
    return {
        "chain": arm.name,
        "converged": bool(found.converged),
        "status": StaticsStatus(int(found.status)).name.lower(),
        "stable": bool(found.stable),
        "residual_nm": float(found.residual),
        "iterations": int(found.iterations),
        "angles_rad": found.angles,
        "tension_n": found.tension,
        "slack": found.slack,
        "displacements_m": found.displacements,
        "tip": pose_document(found.pose),
        "segment_ends": found.segment_ends,
        "tip_pcc": pose_document(_pcc_tip(arm, found)),
    }


def _pcc_tip(arm: ElasticChain, found: Equilibrium) -> Any:
    return pcc_frames(arm, pcc_bending(arm, np.asarray(found.displacements)))[-1]


def _print_posture(arm: ElasticChain, found: Equilibrium) -> None:
    status = StaticsStatus(int(found.status)).name.lower()
    heading = arm.name if found.converged else f"{arm.name}: NO EQUILIBRIUM FOUND ({status})"
    if found.converged and not found.stable:
        heading += ": UNSTABLE, an arm would not stay there"
    ours, pcc = pose_document(found.pose), pose_document(_pcc_tip(arm, found))
    table = Table(
        "tip",
        "statics",
        "constant curvature, same lengths",
        title=verdict(heading, bool(found.converged)),
    )
    table.add_row("position [mm]", *(row_of(x["position_m"], 1e3, 1) for x in (ours, pcc)))
    table.add_row("roll, pitch, yaw [deg]", *(row_of(x["rpy_deg"], 1, 1) for x in (ours, pcc)))
    console.print(table)
    tendons = Table("tendon", "tension [N]", "displacement [mm]", "")
    rows = zip(found.tension, found.displacements, found.slack, strict=True)
    for number, (tension, length, slack) in enumerate(rows, start=1):
        tendons.add_row(
            str(number), f"{tension:.3f}", f"{1e3 * length + 0.0:.3f}", "slack" if slack else ""
        )
    console.print(tendons)
    gap = np.linalg.norm(np.array(ours["position_m"]) - pcc["position_m"])
    console.print(
        f"constant curvature is {1e3 * gap:.1f} mm off; largest moment left at a joint "
        f"{float(found.residual):.1e} N m after {int(found.iterations)} iterations"
    )


def fit_chain(
    data: Annotated[Path, tyro.conf.Positional],
    chain: str = "hyper_redundant",
    fit: tuple[Group, ...] = ("stiffness",),
    out: Path | None = None,
    json: bool = False,
) -> int:
    """Fit a chain to measured tip poses; a CSV goes in, a chain YAML comes out.

    Columns, SI units, one row a static posture: tension_1_n ... or displacement_1_m ... (both:
    lengths drive the model and tensions are fitted too); x_m y_m z_m; optionally qw qx qy qz and
    a known load force_x_n ... moment_x_nm ...

    Example: muxjax statics calibrate data.csv --fit stiffness offsets --out my_chain.yaml

    Args:
        data: The CSV file.
        chain: Shipped chain or path of a YAML file to start from.
        fit: What to fit: stiffness, twist, elasticity, offsets, geometry, base.
        out: Write the fitted chain here; it loads again with load_chain and --chain.
        json: Print JSON in SI units.
    """
    if out is not None and out.suffix not in {".yaml", ".yml"}:
        raise ValueError(f"--out: must end in .yaml or .yml, found {out.name!r}")
    groups = tuple(part for item in fit for part in item.split(","))
    found = calibrate(chain, read_measurements(data, load_chain(chain)), fit=groups)
    if out is not None:
        save_chain(found, out)
    if json:
        print_json(_calibration_document(found))
    else:
        _print_calibration(found)
        if out is not None:
            console.print(f"chain written to {out}")
    return 0 if found.converged else 1


def _calibration_document(found: Calibration) -> dict[str, Any]:
    return {
        "converged": found.converged,
        "reason": found.reason,
        "rows": found.rows,
        "parameters": {
            e.name: {
                "unit": e.unit,
                "start": e.start,
                "value": e.value,
                "low": e.low,
                "high": e.high,
                "identifiable": e.identifiable,
                "remark": e.remark,
            }
            for e in found.estimates
        },
        "rms_before": {kind: before for kind, (before, _) in found.rms.items()},
        "rms_after": {kind: after for kind, (_, after) in found.rms.items()},
        "noise": found.noise,
        "covariance": found.covariance,
    }


def _print_calibration(found: Calibration) -> None:
    heading = f"{found.source}, {found.rows} rows" + (
        "" if found.converged else f": NOT CONVERGED ({found.reason})"
    )
    table = Table("parameter", "file", "fitted", "95 % interval", "unit", "", title=heading)
    for e in found.estimates:
        interval = f"{e.low:.5g} to {e.high:.5g}" if e.identifiable else "-"
        table.add_row(e.name, f"{e.start:.5g}", f"{e.value:.5g}", interval, e.unit, e.remark)
    console.print(table)
    for kind, (before, after) in found.rms.items():
        scale, unit = UNITS[kind]
        console.print(f"{kind}: rms {scale * before:.3g} {unit} before, {scale * after:.3g} after")


def experiment(
    chain: str = "hyper_redundant",
    postures: int = 15,
    mounting: Mounting = "hanging",
    seed: int = 0,
    study: bool = False,
    out: Path | None = None,
    json: bool = False,
) -> int:
    """The second paper's experiment on a SYNTHETIC arm: its measured data are not published.

    The truth is a finer, perturbed model with friction in its Bowden cables; a slow motion is
    filtered by the paper's static criteria, and tension input (FST), length input (FSL) and
    constant curvature (PCC) are compared on what remains.

    Example: muxjax statics experiment --mounting horizontal --seed 3 --out out/experiment

    Args:
        chain: Model under test, with hinges.
        postures: Random postures that the motion halts at.
        mounting: How gravity acts on the arm.
        seed: Of truth, motion and noise.
        study: Also switch the truth's perturbations on one at a time.
        out: Folder for errors.svg and postures.svg.
        json: Print JSON in SI units.
    """
    found = run_experiment(chain, postures=postures, mounting=mounting, seed=seed)
    options: dict[str, Any] = {"postures": postures, "mounting": mounting, "seed": seed}
    alone = one_at_a_time(chain, **options) if study else {}
    if out is not None:
        figures = _figures()
        figures.draw_errors(found, out / "errors.svg")
        figures.draw_configurations(found, out / "postures.svg")
    if json:
        print_json(_experiment_document(found, alone))
    else:
        _print_experiment(found, mounting, seed)
        if alone:
            _print_study(alone)
        if out is not None:
            console.print(f"drawn into {out}: errors.svg, postures.svg")
    return 1 if found.unsolved else 0


def _experiment_document(found: Experiment, alone: dict[str, Experiment]) -> dict[str, Any]:
    def errors(one: Experiment) -> dict[str, Any]:
        return {
            name: {
                "position_m": e.position,
                "relative_position": e.relative_position,
                "orientation_rad": e.orientation,
                "relative_orientation": e.relative_orientation,
            }
            for name, e in one.errors.items()
        }

    return {
        "synthetic": True,
        "perturbation": vars(Perturbation()),
        "configurations": len(found.travel),
        "travel_m": found.travel,
        "turn_rad": found.turn,
        "errors": errors(found),
        "length_errors_m": found.length_errors,
        "tension_error_n": found.tension_error,
        "unsolved": found.unsolved,
        "one_at_a_time": {name: errors(one) for name, one in alone.items()},
    }


def _print_experiment(found: Experiment, mounting: str, seed: int) -> None:
    columns = (*found.errors,)
    title = (
        f"SYNTHETIC: {len(found.travel)} static configurations of a perturbed {found.chain.name}, "
        f"{mounting}, seed {seed}"
    )
    table = Table("", "tip moved", *(f"{name}\n[mm] ([%])" for name in columns), title=title)
    for k in range(len(found.travel)):
        cells = [_cell(1e3 * e.position[k], e.relative_position[k]) for e in found.errors.values()]
        table.add_row(str(k + 1), f"{1e3 * found.travel[k]:.0f} mm", *cells)
    table.add_section()
    median = [
        _cell(1e3 * np.nanmedian(e.position), np.nanmedian(e.relative_position))
        for e in found.errors.values()
    ]
    table.add_row("median", f"{1e3 * np.median(found.travel):.0f} mm", *median)
    turned = [
        _cell(np.degrees(np.nanmedian(e.orientation)), np.nanmedian(e.relative_orientation))
        for e in found.errors.values()
    ]
    turn = f"{np.degrees(np.median(found.turn)):.0f} deg"
    table.add_row("orientation, median [deg]", turn, *turned)
    console.print(table)
    rms = {name: 1e3 * np.sqrt(np.nanmean(e**2)) for name, e in found.length_errors.items()}
    texts = ", ".join(f"{name} {value:.2f} mm" for name, value in rms.items())
    tension = np.sqrt(np.nanmean(found.tension_error**2))
    console.print(f"estimated tendon lengths, rms error: {texts}")
    console.print(f"tensions estimated by FSL, rms against the load cells: {tension:.2f} N")
    if found.unsolved:
        console.print(f"NO EQUILIBRIUM: {', '.join(found.unsolved)}")


def _cell(value: float, share: float) -> str:
    return f"{value:.1f} ({100 * share:.1f})"


def _print_study(alone: dict[str, Experiment]) -> None:
    names = (*next(iter(alone.values())).errors,)
    table = Table(
        "median tip error [mm] with only",
        *names,
        title="SYNTHETIC: the truth's perturbations, one at a time",
    )
    for what, one in alone.items():
        cells = [f"{1e3 * np.nanmedian(e.position):.1f}" for e in one.errors.values()]
        table.add_row(what, *cells)
    console.print(table)


def _figures() -> Any:
    """The module that draws.

    Raises:
        ValueError: matplotlib is not installed.
    """
    try:
        from muxjax.viz import statics as figures
    except ImportError:
        raise ValueError("figures need matplotlib: pip install 'muxjax[viz]'") from None
    return figures


COMMANDS: dict[str, Any] = {
    "posture": posture,
    "calibrate": fit_chain,
    "experiment": experiment,
}
_Choice: Any = choice_of(COMMANDS)


def statics(command: tyro.conf.OmitArgPrefixes[_Choice]) -> int:
    """True postures under weight and load, calibration, and the second paper's experiment.

    Example: muxjax statics posture --displacements-mm -4 0 4 0 -6 0 6 0 --mounting hanging
    """
    code: int = command
    return code
