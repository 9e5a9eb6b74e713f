"""Execution time against overshoot, ours and theirs, with matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from muxjax.metrics.protocol import Protocol
from muxjax.metrics.table2 import Row, Table

# Okabe-Ito, distinguishable without colour vision; the marker tells settings apart in grey print.
_OURS, _THEIRS, _PUBLISHED = "#0072B2", "#D55E00", "#777777"
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
_FIELDS = {
    "overshoot_duration": "overshoot duration [% of T]",
    "overshoot_peak": "overshoot peak [%]",
}


def pareto(protocol: Protocol, table: Table, path: Path) -> list[Path]:
    """Median T against median overshoot of the worst segment, a column a servo count.

    Args:
        protocol: Whose settings are whose, and the published points.
        table: The rerun.
        path: Written as .pdf, .svg and .png beside each other; the ending given is replaced.
    """
    counts = sorted({row.servos for row in table.rows})
    figure = Figure(figsize=(3.3 * len(counts) + 0.4, 6.4), layout="constrained")
    grid = figure.subplots(len(_FIELDS), len(counts), squeeze=False, sharex="col")
    for line, (field, label) in zip(grid, _FIELDS.items(), strict=True):
        for axes, servos in zip(line, counts, strict=True):
            _draw(axes, protocol, table, servos, field)
        line[0].set_ylabel(f"{label}\nof the worst segment", fontsize=9)
    for axes, servos in zip(grid[0], counts, strict=True):
        axes.set_title(f"{servos} servo{'s' if servos > 1 else ''}", fontsize=10)
    for axes in grid[-1]:
        axes.set_xlabel("execution time T [s]", fontsize=9)
    figure.suptitle(f"Medians over {table.targets} targets; less is better on both axes")
    figure.legend(handles=_legend(protocol), loc="outside lower center", ncols=3, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    written = [path.with_suffix(ending) for ending in (".pdf", ".svg", ".png")]
    for one in written:
        figure.savefig(one, dpi=150)
    return written


def _draw(axes: Any, protocol: Protocol, table: Table, servos: int, field: str) -> None:
    rows = {row.setting: row for row in table.rows if row.servos == servos}
    sides = ((protocol.names("theirs"), _THEIRS), (protocol.names("ours"), _OURS))
    for names, colour in sides:
        for marker, name in zip(_MARKERS, names, strict=False):
            row = rows[name]
            worst = max(s.median for s in getattr(row, field))
            axes.plot(
                row.time_s.median, worst, marker, ms=7, color=colour, clip_on=False, alpha=0.85
            )
    columns = [c for c in protocol.published if c.servos == servos]
    for marker, column in zip(_MARKERS, columns, strict=False):
        worst = max(median for median, _ in getattr(column, field))
        axes.plot(column.time_s[0], worst, marker, ms=7, mfc="none", color=_PUBLISHED)
    front = _front([rows[name] for name in protocol.names("theirs", "ours")], field)
    axes.step(*zip(*front, strict=True), where="post", color="0.6", lw=1.0, zorder=0)
    axes.margins(0.12)
    axes.set_ylim(bottom=-0.04 * axes.get_ylim()[1])  # many points are at zero
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=8)


def _front(rows: list[Row], field: str) -> list[tuple[float, float]]:
    """Points that no other dominates, by time, to the table's one decimal."""
    points = {(row.time_s.median, max(s.median for s in getattr(row, field))) for row in rows}
    front: list[tuple[float, float]] = []
    for time, over in sorted((round(t, 1), round(o, 1)) for t, o in points):
        if not front or over < front[-1][1]:
            front.append((time, over))
    return front


def _legend(protocol: Protocol) -> list[Any]:
    def entry(marker: str, label: str, **how: Any) -> Any:
        return mpl.lines.Line2D([], [], ls="", marker=marker, label=label, **how)

    published = list(dict.fromkeys(c.name for c in protocol.published))
    return [
        *(
            entry(m, n, color=_THEIRS)
            for m, n in zip(_MARKERS, protocol.names("theirs"), strict=False)
        ),
        *(
            entry(m, n, color=_PUBLISHED, mfc="none")
            for m, n in zip(_MARKERS, published, strict=False)
        ),
        *(entry(m, n, color=_OURS) for m, n in zip(_MARKERS, protocol.names("ours"), strict=False)),
        mpl.lines.Line2D([], [], color="0.6", lw=1.0, label="Pareto front of the rerun"),
    ]
