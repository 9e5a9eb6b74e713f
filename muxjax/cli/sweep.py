"""``muxjax sweep``: reach and dexterity of an arm, or of many designs of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from muxjax.cli.output import complain, console, print_json
from muxjax.collision import World, load_world
from muxjax.robot import load_robot
from muxjax.workspace import DesignStudy, Sweep, SweepInterruptedError, design_study
from muxjax.workspace import sweep as run_sweep


def sweep(
    samples: float = 1e7,
    seed: int = 0,
    sampler: Literal["random", "lattice"] = "random",
    vary: tuple[str, ...] = (),
    tolerance_deg: float = 10.0,
    robot: str = "muxarm",
    world: str | None = None,
    out: Path = Path("out/sweep"),
    resume: bool = False,
    json: bool = False,
) -> int:
    """Reach and dexterity over all configurations of an arm.

    Writes sweep.npz (everything), dexterity.png, convergence.png and cut.png, and with --world
    clear.png, where clear samples reach; with --vary a table designs.csv and designs.png instead.
    Interrupt it at any time; the same command with --resume goes on from the last checkpoint and
    comes to the same tables.

    Example: muxjax sweep --samples 1e9 --out out/muxarm

    Example: muxjax sweep --world cabinet --samples 3e6

    Example: muxjax sweep --vary "segments[1].length_m=0.12,0.15,0.18" --samples 3e6

    Args:
        samples: Configurations to draw (of each design).
        seed: Of the samples.
        sampler: Monte Carlo ("random") or a low-discrepancy sequence ("lattice").
        vary: Robot parameters and their values, as path=value,value,...; every combination.
        tolerance_deg: Angle within which an orientation counts as met [degrees].
        robot: Shipped robot or path of a YAML file.
        world: Shipped world or path of a YAML file; only samples clear of it make a cell dexterous.
        out: Folder to write to.
        resume: Go on from this folder's checkpoint.
        json: Print JSON in SI units.
    """
    if samples != int(samples):
        raise ValueError(f"--samples: must be a whole number, found {samples:g}")
    arm = load_robot(robot)
    out.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {
        "samples": int(samples),
        "seed": seed,
        "sampler": sampler,
        "tolerance_deg": tolerance_deg,
    }
    obstacles = None if world is None else load_world(world)
    if vary:
        if world is not None:
            raise ValueError("--world: a design study (--vary) has none")
        if resume:
            raise ValueError("--resume: a design study (--vary) keeps no checkpoint")
        study = design_study(arm, _parameters(vary), **options)
        return _report_study(study, out, json)
    checkpoint = out / "checkpoint.npz"
    try:
        found = run_sweep(
            arm,
            **options,
            world=obstacles,
            out=out / "sweep.npz",
            checkpoint=checkpoint,
            resume=resume,
        )
    except SweepInterruptedError as interruption:
        complain(f"{interruption}; --resume goes on")
        return 130
    checkpoint.unlink(missing_ok=True)
    return _report_sweep(found, obstacles, out, json)


def _parameters(vary: tuple[str, ...]) -> dict[str, list[float]]:
    parameters = {}
    for item in vary:
        name, equals, values = item.partition("=")
        try:
            parameters[name] = [float(value) for value in values.split(",")]
        except ValueError:
            equals = ""
        if not equals:
            raise ValueError(f"--vary: must be path=value,value,..., found {item!r}")
    return parameters


def _report_sweep(found: Sweep, world: World | None, out: Path, json: bool) -> int:
    limit = found.limit()
    if json:
        print_json(
            {
                "samples": found.samples,
                "reach_radius_m": found.reach_radius,
                "reach_volume_m3": found.reach_volume,
                "mean_dexterity": found.mean_dexterity,
                "mean_dexterity_limit": limit.value,
                "limit_uncertainty": limit.uncertainty,
                "peak_dexterity": found.peak_dexterity,
            }
            | ({} if world is None else {"clear_volume_m3": found.clear_volume})
        )
    else:
        table = Table("", f"{found.samples:.3g} samples")
        table.add_row("reach, radius [mm]", f"{1e3 * found.reach_radius:.1f}")
        table.add_row("reach, volume [dm3]", f"{1e3 * found.reach_volume:.2f}")
        if world is not None:
            table.add_row("  by clear samples [dm3]", f"{1e3 * found.clear_volume:.2f}")
        table.add_row("mean dexterity", f"{found.mean_dexterity:.4f}")
        table.add_row("  extrapolated limit", f"{limit.value:.4f} +- {limit.uncertainty:.4f}")
        table.add_row("peak dexterity", f"{found.peak_dexterity:.4f}")
        console.print(table)
    plots = _plots()
    if plots is not None:
        plots.dexterity_map(found, out / "dexterity.png")
        if world is not None:
            plots.clear_map(found, world, out / "clear.png")
        plots.convergence_curve(found, out / "convergence.png")
        plots.workspace_cut(found, out / "cut.png")
    if not json:
        console.print(f"written to {out}")
    return 0


def _report_study(study: DesignStudy, out: Path, json: bool) -> int:
    study.save_csv(out / "designs.csv")
    rows = study.table()
    if json:
        print_json(rows)
    else:
        headings = ("reach [mm]", "volume [dm3]", "dexterity", "limit", "peak", "stroke [mm]")
        table = Table(*study.parameters, *headings)
        for row in rows:
            table.add_row(
                *(f"{row[name]:g}" for name in study.parameters),
                f"{1e3 * row['reach_radius_m']:.1f}",
                f"{1e3 * row['reach_volume_m3']:.1f}",
                f"{row['mean_dexterity']:.4f}",
                f"{row['mean_dexterity_limit']:.3f} +- {row['limit_uncertainty']:.3f}",
                f"{row['peak_dexterity']:.4f}",
                f"{1e3 * row['tendon_stroke_m']:.1f}",
            )
        console.print(table)
    plots = _plots()
    if plots is not None:
        plots.design_plot(study, out / "designs.png")
    if not json:
        console.print(f"written to {out}")
    return 0


def _plots() -> Any:
    """The plotting module, or None where matplotlib is not installed."""
    try:
        from muxjax.workspace import plots
    except ImportError:
        complain("no plots: they need matplotlib, pip install 'muxjax[viz]'")
        return None
    return plots
