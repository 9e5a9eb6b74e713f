"""The MuxArm paper's Tables I to III as text, beside what follows from this model."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

from muxjax.bom import cost_sheet
from muxjax.metrics.protocol import Protocol, Published
from muxjax.metrics.report import cell, markdown_table
from muxjax.metrics.table2 import Row
from muxjax.metrics.table2 import Table as Comparison
from muxjax.robot import Robot


@dataclass(frozen=True)
class TextTable:
    """A table that is ready to be typeset.

    Attributes:
        title: Above it.
        header: Names of the columns, units in brackets.
        rows: Text of the cells.
        rules: Rows, from 0, that begin a new group.
        notes: Below it.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    rules: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        wrong = [row for row in self.rows if len(row) != len(self.header)]
        if wrong:
            raise ValueError(f"rows: {len(self.header)} cells each, found {wrong[0]}")


# M Table I, driving solutions by reference of the paper. Our text of the paper keeps its crosses
# and has lost its ticks: an empty cell of a column of crosses is read as a tick.
_TABLE_1 = (
    ("Ref. [22]", "no", "N/A", "Medium", "Good", "Low", "no"),
    ("Ref. [2]", "yes", "1-3 s", "Low", "Good", "High", "no"),
    ("Ref. [6]", "yes", "1-3 s", "Low", "Good", "High", "no"),
    ("Ref. [1]", "yes", "1-3 s", "Low", "Good", "High", "no"),
    ("Ref. [9]", "yes", "50-80 ms", "Medium", "Poor", "Low", "no"),
    ("Ref. [27]", "yes", "0.1-0.5 s", "Medium", "Good", "Low", "no"),
    ("Ref. [12]", "yes", "0.1-0.5 s", "High", "Poor", "Low", "no"),
    ("Ref. [11]", "yes", "50-100 ms", "Low", "Good", "Medium", "no"),
    ("MuxArm", "yes", "<0.1 s", "High", "Good", "Low", "yes"),
)


def table1(robot: Robot) -> TextTable:
    """Driving solutions (M Table I), and what this model says of the robot's.

    Args:
        robot: The arm of the last row.
    """
    drive = robot.config.drive_strength
    worm = None if drive is None else drive.worm_efficiency.value
    clutch = robot.config.clutch.engage_time_s.value
    stall = robot.config.servo.stall_torque_nm.value * float(robot.gear_ratio)
    alone = sum(
        bool(robot.reach((s,)).any(axis=0).all()) for s in range(1, robot.tendons_per_segment + 1)
    )
    model = (
        f"{robot.config.name}, this model",
        "-" if worm is None else "yes" if worm < 0.5 else "no",
        f"{clutch:g} s, {float(robot.switch_time):g} s with a turn",
        "-" if worm is None else f"{stall * worm:.0f} N m",
        f"{robot.tendons_per_segment + 1} motors, {robot.n_tendons} tendons",
        "-",
        f"{alone} of {robot.tendons_per_segment} servos reach all",
    )
    return TextTable(
        "TABLE I: driving solutions for continuum robots",
        ("work", "self-lock", "switching", "torque", "compact", "temp. sens.", "fault tol."),
        (*_TABLE_1, model),
        rules=(len(_TABLE_1) - 1, len(_TABLE_1)),
        notes=(
            "Rows of references and of MuxArm: as published; ticks are lost in our text of the "
            "paper, an empty cell is read as yes.",
            "Last row: a worm below 50 % efficiency locks itself; the clutch alone, and with the "
            "drum's turn (t_sw, derived from Table II); a servo's stall torque at the wheel; "
            "servos that alone reach every tendon. Heat is not modelled.",
        ),
    )


# Settings of ours that stand beside the paper's four columns, if the protocol has them.
_OURS = {"exact, least overshoot": "ours,\nleast overshoot", "exact, split moves": "ours,\nfastest"}


def table2(protocol: Protocol, found: Comparison) -> TextTable:
    """The paper's Table II in its own form: our rerun of its methods, its cells, and ours.

    Args:
        protocol: What was compared; its settings of "theirs" in the order of its published columns.
        found: The rerun.
    """
    theirs = protocol.names("theirs")
    ours = [name for name in _OURS if name in protocol.names("ours")]
    published = list(dict.fromkeys(c.name for c in protocol.published))
    header = ["servos", "median (IQR)"]
    for name, printed in zip(theirs, published, strict=True):
        header += [f"{name},\nrerun", printed.replace(", ", ",\n")]
    rows: list[tuple[str, ...]] = []
    rules = []
    for servos in sorted({row.servos for row in found.rows}):
        by_name = {row.setting: row for row in found.rows if row.servos == servos}
        columns: list[list[str]] = []
        printed_of = [c for c in protocol.published if c.servos == servos]
        for name, column in zip(theirs, printed_of, strict=True):
            columns += [_rerun(by_name[name]), _printed(column)]
        columns += [_rerun(by_name[name]) for name in ours]
        labels = _labels(len(found.rows[0].overshoot_duration))
        rules.append(len(rows))
        rows += [
            (str(servos) if k == 0 else "", label, *(c[k] for c in columns))
            for k, label in enumerate(labels)
        ]
    return TextTable(
        f"TABLE II: planners on {found.targets} random targets, seed {found.seed}",
        (*header, *(_OURS[name] for name in ours)),
        tuple(rows),
        rules=tuple(rules[1:]),
        notes=(
            "Published cells are context: their arm's measures, targets, step and weights are not "
            "published. Their stages are shown less one, which the motion does not need "
            "(MODEL.md section 7).",
            "Over and peak: overshoot duration and peak by segment (M Eq. 15).",
        ),
    )


def _labels(segments: int) -> list[str]:
    numbers = range(1, segments + 1)
    return [
        "T [s]",
        "stages [-]",
        *(f"over {i} [% of T]" for i in numbers),
        *(f"peak {i} [%]" for i in numbers),
    ]


def _rerun(row: Row) -> list[str]:
    return [cell(x) for x in (row.time_s, row.stages, *row.overshoot_duration, *row.overshoot_peak)]


def _printed(column: Published) -> list[str]:
    over = [cell(x) for x in (*column.overshoot_duration, *column.overshoot_peak)]
    return [cell(column.time_s), cell(column.printed_stages, less=1.0), *over]


def table3(robot: Robot) -> TextTable:
    """Cost of the drive (M Table III), its sums, and an actuator for every tendon beside it.

    Raises:
        ConfigError: The robot's file has no section ``cost``.
    """
    sheet = cost_sheet(robot)
    rows = [
        (part.kind, part.name, "" if part.count is None else str(part.count), _usd(part.price_usd))
        for part in sheet.parts
    ]
    singles = f"{sheet.single_count} {sheet.single_name}"
    return TextTable(
        f"TABLE III: cost of the drive of {robot.config.name}",
        ("kind", "item", "count [-]", "price [USD]"),
        (
            *rows,
            ("", "total", "", _usd(sheet.total)),
            ("", f"instead: {singles}", str(sheet.single_count), _usd(sheet.single_total)),
        ),
        rules=(len(rows), len(rows) + 1),
        notes=(
            f"{100 * sheet.saving:.1f} % less than {singles} alone; {sheet.motors} motors, "
            f"{100 * sheet.fewer_motors:.1f} % fewer (derived from the lines above).",
        ),
    )


def _usd(price: float) -> str:
    return f"{price:.2f}"


def as_markdown(table: TextTable) -> str:
    """The table for a document."""
    body = markdown_table(
        [name.replace("\n", " ") for name in table.header], [list(row) for row in table.rows]
    )
    return f"**{table.title}**\n\n{body}\n" + "".join(f"\n{note}\n" for note in table.notes)


def as_csv(table: TextTable) -> str:
    """The table for a spreadsheet, without title and notes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(name.replace("\n", " ") for name in table.header)
    writer.writerows(table.rows)
    return text.getvalue()


_TEX = {"&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "<": r"$<$"}


def as_latex(table: TextTable) -> str:
    """The table for a paper; needs the package booktabs."""
    lines = [
        r"\begin{table}",
        rf"\caption{{{_tex(table.title)}}}",
        rf"\begin{{tabular}}{{{'l' * len(table.header)}}}",
        r"\toprule",
        _tex_row(table.header),
        r"\midrule",
    ]
    for number, row in enumerate(table.rows):
        if number in table.rules:
            lines.append(r"\midrule")
        lines.append(_tex_row(row))
    notes = [rf"\par {_tex(note)}" for note in table.notes]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", *notes, r"\end{table}"]) + "\n"


def _tex_row(cells: tuple[str, ...]) -> str:
    return " & ".join(_tex(cell) for cell in cells) + r" \\"


def _tex(text: str) -> str:
    return "".join(_TEX.get(letter, letter) for letter in text.replace("\n", " "))
