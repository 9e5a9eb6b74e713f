"""A comparison as Markdown and CSV. Percent, millimetres and seconds, as in the paper's table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable

from muxjax.metrics.protocol import Protocol, Published
from muxjax.metrics.statistics import Interval, Spread
from muxjax.metrics.table2 import Difference, Row, Table


def cell(values: Spread | tuple[float, float], less: float = 0.0) -> str:
    """Median (IQR), the median less a number, without a minus before zero."""
    return f"{round(values[0] - less, 1) + 0.0:.1f} ({values[1]:.1f})"


def interval(values: Interval, digits: int = 1) -> str:
    """Median [low, high] of a difference, without a minus before zero."""
    middle, low, high = (f"{round(x, digits) + 0.0:.{digits}f}" for x in values)
    return f"{middle} [{low}, {high}]"


def row_cells(row: Row) -> list[str]:
    """Name and figures of a rerun setting, as ``header`` names them."""
    return [
        row.setting,
        cell(row.time_s),
        cell(row.over_least_time),
        cell(row.stages),
        *(cell(x) for x in row.overshoot_duration),
        *(cell(x) for x in row.overshoot_peak),
        cell(row.tip_deviation_mm),
        f"{row.none_at_all:.0f}",
        f"{row.cpu_s.median:.2f}",
    ]


def published_cells(column: Published) -> list[str]:
    """The same of a published column; its stages less one (MODEL.md section 7)."""
    return [
        column.name,
        cell(column.time_s),
        "",
        cell(column.printed_stages, less=1.0),
        *(cell(x) for x in column.overshoot_duration),
        *(cell(x) for x in column.overshoot_peak),
        "",
        "",
        "",
    ]


def header(segments: int) -> list[str]:
    """Of the main table."""
    return [
        "method",
        "T [s]",
        "over bound [%]",
        "stages",
        *(f"over {i} [% of T]" for i in range(1, segments + 1)),
        *(f"peak {i} [%]" for i in range(1, segments + 1)),
        "tip [mm]",
        "none [%]",
        "CPU [s]",
    ]


def markdown(protocol: Protocol, table: Table) -> str:
    """The whole comparison as a Markdown document."""
    segments = len(table.rows[0].overshoot_duration)
    parts = [
        f"{table.targets} random targets, seed {table.seed}; median (interquartile range). "
        "Over bound: T above what no program between the same ends can fall below. Over and peak: "
        "overshoot duration and peak by segment. Tip: greatest distance of the tool from the "
        "straight line between its first and last position. None: share of targets without any "
        "overshoot. CPU: median of planning.",
    ]
    for servos in sorted({row.servos for row in table.rows}):
        lines = [row_cells(row) for row in table.rows if row.servos == servos]
        lines += [published_cells(c) for c in protocol.published if c.servos == servos]
        parts += [f"### {_servos(servos)}", markdown_table(header(segments), lines)]
    parts += ["### Paired differences", _DIFFERENCES, *_difference_tables(table, segments)]
    parts += ["### The paper's side claims", *_side_claims(protocol, table)]
    parts += ["### Notes", "\n".join(f"- {note}" for note in protocol.notes)]
    return "\n\n".join(parts) + "\n"


_DIFFERENCES = (
    "Ours minus theirs on the same targets: median [95 % bootstrap interval]. Below zero is better."
)


def _servos(count: int) -> str:
    return f"{count} servo{'s' if count > 1 else ''}"


def _difference_tables(table: Table, segments: int) -> Iterable[str]:
    names = ["ours", "theirs", "T [s]", "stages"]
    names += [f"over {i} [% of T]" for i in range(2, segments + 1)]
    names += [f"peak {i} [%]" for i in range(2, segments + 1)]
    for servos in sorted({d.servos for d in table.differences}):
        lines = [_difference_cells(d) for d in table.differences if d.servos == servos]
        yield f"{_servos(servos)}:\n\n" + markdown_table([*names, "tip [mm]"], lines)


def _difference_cells(d: Difference) -> list[str]:
    by_segment = [*d.overshoot_duration[1:], *d.overshoot_peak[1:]]
    figures = [d.time_s, d.stages, *by_segment, d.tip_deviation_mm]
    return [d.ours, d.theirs, *(interval(x) for x in figures)]


def _side_claims(protocol: Protocol, table: Table) -> Iterable[str]:
    yield "How many times faster more servos are, T over T on the same target:"
    by_setting: dict[str, list[str]] = {}
    steps = list(dict.fromkeys((s.fewer, s.more) for s in table.speed_ups))
    for s in table.speed_ups:
        by_setting.setdefault(s.setting, [s.setting]).append(interval(s.factor, 2))
    names = ["method", *(f"{fewer} to {more} servos" for fewer, more in steps)]
    yield markdown_table(names, list(by_setting.values()))
    yield (
        f"BeamStep without its switch weight against {protocol.greedy!r} (the paper: its behaviour "
        f"then approaches greedy); difference to greedy with the weight ({protocol.beamstep!r}) "
        "and without:"
    )
    names = ["servos", "without", "T with [s]", "T without [s]", "stages with", "stages without"]
    lines = [
        [
            str(s.servos),
            s.variant,
            *map(interval, (s.time_with, s.time_without, s.stages_with, s.stages_without)),
        ]
        for s in table.switch_weight
    ]
    yield markdown_table(names, lines)


def markdown_table(names: list[str], lines: list[list[str]]) -> str:
    """A table in Markdown."""
    rows = [names, ["---"] * len(names), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def csv_text(table: Table) -> str:
    """Medians and interquartile ranges of the rerun settings, a row each."""
    segments = range(1, len(table.rows[0].overshoot_duration) + 1)
    figures = ["time_s", "over_least_time_percent", "stages", "tip_deviation_mm"]
    figures += [f"overshoot_duration_{i}_percent" for i in segments]
    figures += [f"overshoot_peak_{i}_percent" for i in segments]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["servos", "setting", *(f"{f}_{k}" for f in figures for k in ("median", "iqr"))]
    )
    for row in table.rows:
        spreads = [row.time_s, row.over_least_time, row.stages, row.tip_deviation_mm]
        spreads += [*row.overshoot_duration, *row.overshoot_peak]
        writer.writerow([row.servos, row.setting, *(f"{x:.6g}" for s in spreads for x in s)])
    return text.getvalue()
