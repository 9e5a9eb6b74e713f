"""Tables as figures, and as the text that a document takes in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from muxjax.config import replacing
from muxjax.metrics.tables import TextTable, as_csv, as_latex, as_markdown
from muxjax.viz.style import INK, STYLE, check_ending, save_figure

TEXTS = {".tex": as_latex, ".md": as_markdown, ".csv": as_csv}
_LINE, _PAD = 0.155, 0.14  # height of a line and room between columns [inch]
_NOTE_LINE = 0.13


def save_table(table: TextTable, path: str | Path) -> Path:
    """Write a table as .pdf, .svg or .png, or as .tex, .md or .csv.

    Raises:
        ValueError: Another ending.
    """
    path = check_ending(path, tuple(TEXTS))
    if path.suffix not in TEXTS:
        return save_figure(table_figure(table), path)
    with replacing(path) as part:
        part.write_text(TEXTS[path.suffix](table), encoding="utf-8")
    return path


def table_figure(table: TextTable) -> Figure:
    """The table between rules, as wide as its text."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8, 4))
        FigureCanvasAgg(figure)
        widths = [_width(figure, column) for column in _columns(table)]
        width = sum(widths) + _PAD * (len(widths) + 1)
        notes = [line for note in table.notes for line in _wrapped(figure, note, width - 2 * _PAD)]
        head = max(name.count("\n") for name in table.header) + 1
        height = _LINE * (len(table.rows) + head + 1.6) + _NOTE_LINE * len(notes) + 2 * _PAD
        figure.set_size_inches(width, height)
        lefts = _PAD + np.cumsum([0.0, *(w + _PAD for w in widths[:-1])])
        _write(figure, table, lefts, head, notes)
        return figure


def _columns(table: TextTable) -> list[list[str]]:
    lines = [table.header, *table.rows]
    return [[line[k] for line in lines] for k in range(len(table.header))]


def _width(figure: Figure, texts: list[str], **how: Any) -> float:
    """Of the widest text [inch]."""
    found = 0.0
    for text in texts:
        artist = figure.text(0, 0, text, **how)
        found = max(found, artist.get_window_extent().width / figure.dpi)
        artist.remove()
    return found


def _wrapped(figure: Figure, note: str, width: float) -> list[str]:
    lines = [""]
    for word in note.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and _width(figure, [longer], fontsize=6.5) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def _write(
    figure: Figure,
    table: TextTable,
    lefts: np.ndarray[Any, np.dtype[np.float64]],
    head: int,
    notes: list[str],
) -> None:
    width, height = figure.get_size_inches()
    y = height - _PAD

    def rule(at: float, thick: float) -> None:
        ends = [_PAD / width, 1 - _PAD / width]
        line = mpl.lines.Line2D(ends, [at / height] * 2, color=INK, lw=thick)
        line.set_transform(figure.transFigure)
        figure.add_artist(line)

    def put(x: float, at: float, text: str, **how: Any) -> None:
        base = at - 0.7 * _LINE  # on one line with its neighbours, whatever letters it has
        figure.text(x / width, base / height, text, va="baseline", **how)

    put(_PAD, y, table.title, fontweight="bold")
    y -= 1.4 * _LINE
    rule(y + 0.3 * _LINE, 1.2)
    for x, name in zip(lefts, table.header, strict=True):
        for number, line in enumerate(name.split("\n")):
            put(x, y - number * _LINE, line)
    y -= head * _LINE
    rule(y + 0.08 * _LINE, 0.7)
    for number, row in enumerate(table.rows):
        if number in table.rules:
            rule(y + 0.08 * _LINE, 0.5)
        for x, text in zip(lefts, row, strict=True):
            put(x, y, text)
        y -= _LINE
    rule(y + 0.08 * _LINE, 1.2)
    y -= 0.1 * _LINE
    for line in notes:
        put(_PAD, y, line, fontsize=6.5)
        y -= _NOTE_LINE
