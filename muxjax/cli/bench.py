"""``muxjax bench``: comparisons that the documentation quotes."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich import box
from rich.table import Column, Table

from muxjax.cli.output import complain, console, print_json
from muxjax.cli.progress import work_bar
from muxjax.config import load_yaml, resolve
from muxjax.metrics.protocol import Protocol, Published
from muxjax.metrics.report import cell, csv_text, interval, markdown
from muxjax.metrics.table2 import Row, run_table, summarise
from muxjax.metrics.table2 import Table as Comparison
from muxjax.robot import load_robot


def bench(
    which: Annotated[Literal["table2"], tyro.conf.Positional],
    targets: int = 15,
    seed: int = 0,
    protocol: str = "table2",
    out: Path | None = None,
    json: bool = False,
) -> int:
    """The paper's Table II: its planners and ours on the same random targets.

    Example: muxjax bench table2 --targets 200 --out out/table2

    Args:
        which: The comparison.
        targets: Random targets; the paper has 15.
        seed: Of the targets.
        protocol: Shipped protocol or path of a YAML file: servo sets, settings, published cells.
        out: Folder for results as JSON, Markdown, CSV and a plot. Targets done so far are kept
            there: the same command goes on after an interruption, or to more targets.
        json: Print JSON instead of tables.
    """
    rules = load_yaml(Protocol, resolve(protocol, "bench"))
    robot = load_robot(rules.robot)
    began = time.perf_counter()
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    kept = None if out is None else out / "targets.jsonl"
    with work_bar() as bar:
        task = bar.add_task(which, total=targets)
        records = run_table(
            robot,
            rules,
            targets=targets,
            seed=seed,
            kept=kept,
            progress=lambda done, _: bar.update(task, completed=done),
        )
    found = summarise(rules, records, seed)
    if json:
        print_json(dataclasses.asdict(found))
    else:
        _print(rules, found)
        console.print(f"done in {time.perf_counter() - began:.0f} s")
    if out is not None:
        written = _write(rules, found, out)
        if not json:
            console.print(f"written to {out}: {', '.join(p.name for p in written)}")
    return 0


def _print(rules: Protocol, found: Comparison) -> None:
    for servos in sorted({row.servos for row in found.rows}):
        segments = range(1, len(found.rows[0].overshoot_duration) + 1)
        table = Table(
            Column("method", max_width=28),
            "T [s]",
            "over\nbound [%]",
            "stages",
            *(f"segment {i}\nover, peak [%]" for i in segments),
            "tip [mm]",
            box=box.SIMPLE_HEAD,
            title=f"{servos} of the servos, {found.targets} targets: median (IQR)",
            title_justify="left",
        )
        for row in (r for r in found.rows if r.servos == servos):
            table.add_row(*_cells(row))
        table.add_section()
        for column in (c for c in rules.published if c.servos == servos):
            table.add_row(*_published(column), style="dim")
        console.print(table)
    _print_differences(rules, found)
    console.print("Faster with more servos, T over T on the same target:")
    for s in found.speed_ups:
        if s.setting in (rules.beamstep, *rules.names("ours")):
            factor = interval(s.factor, 2)
            console.print(f"  {s.setting}, {s.fewer} to {s.more} servos: {factor}")
    console.print("BeamStep with and without its switch weight, stages more than greedy:")
    for w in found.switch_weight:
        console.print(
            f"  {w.servos} servo(s), {w.variant}: {interval(w.stages_without)}, "
            f"with it {interval(w.stages_with)}"
        )
    for note in rules.notes:
        console.print(f"- {note}")


def _cells(row: Row) -> list[str]:
    segments = zip(row.overshoot_duration, row.overshoot_peak, strict=True)
    return [
        row.setting,
        cell(row.time_s),
        cell(row.over_least_time),
        cell(row.stages),
        *(f"{cell(over)}\n{cell(peak)}" for over, peak in segments),
        cell(row.tip_deviation_mm),
    ]


def _published(column: Published) -> list[str]:
    segments = zip(column.overshoot_duration, column.overshoot_peak, strict=True)
    return [
        column.name,
        cell(column.time_s),
        "",
        cell(column.printed_stages, less=1.0),
        *(f"{cell(over)}\n{cell(peak)}" for over, peak in segments),
        "",
    ]


def _print_differences(rules: Protocol, found: Comparison) -> None:
    table = Table(
        "servos",
        Column("ours", max_width=24),
        Column("theirs", max_width=20),
        "T [s]",
        "stages",
        "worst segment\nover [% of T]",
        "tip [mm]",
        box=box.SIMPLE_HEAD,
        title="Ours minus theirs on the same targets: median [95 % bootstrap interval]",
        title_justify="left",
    )
    for d in found.differences:
        if d.theirs in (rules.greedy, rules.beamstep):
            worst = max(d.overshoot_duration)
            figures = (d.time_s, d.stages, worst, d.tip_deviation_mm)
            table.add_row(str(d.servos), d.ours, d.theirs, *map(interval, figures))
    console.print(table)


def _write(rules: Protocol, found: Comparison, out: Path) -> list[Path]:
    import json

    document = json.dumps(dataclasses.asdict(found), indent=1)
    texts = {"table2.json": document, "table2.md": markdown(rules, found)}
    texts["table2.csv"] = csv_text(found)
    written = []
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
        written.append(out / name)
    plots = _plots()
    return written if plots is None else [*written, *plots.pareto(rules, found, out / "pareto.pdf")]


def _plots() -> Any:
    """The plotting module, or None where matplotlib is not installed."""
    try:
        from muxjax.metrics import plots
    except ImportError:
        complain("no plots: they need matplotlib, pip install 'muxjax[viz]'")
        return None
    return plots
