"""A run on the terminal, while it goes on."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.table import Table

from muxjax.cli.output import errors, notice, verdict
from muxjax.hardware import Check, Progress


class Reporter:
    """Shows a run on standard error: one live line on a terminal, else a line for each visit.

    The preflight report comes first, whichever it is.
    """

    def __init__(self) -> None:
        self._console = errors
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=None)
        self._checks: tuple[Check, ...] = ()
        self._instruction = 0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def __call__(self, progress: Progress) -> None:
        """Take the news."""
        if progress.checks and progress.checks != self._checks:
            self._checks = progress.checks
            self._console.print(preflight_table(progress.checks))
        done = progress.instruction - 1
        self._bar.update(
            self._task, description=progress.phase, total=progress.instructions, completed=done
        )
        if not self._console.is_terminal and progress.instruction != self._instruction:
            self._instruction = progress.instruction
            if done < progress.instructions:
                total = progress.instructions
                notice(f"instruction {progress.instruction} of {total}")


def work_bar() -> Bar:
    """A bar for long work, on standard error: standard output holds results alone."""
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Bar(*columns, console=errors, transient=True, disable=not errors.is_terminal)


def preflight_table(checks: tuple[Check, ...]) -> Table:
    """The preflight report."""
    table = Table("preflight", "", "found")
    for check in checks:
        table.add_row(
            check.name, verdict("pass" if check.passed else "FAIL", check.passed), check.detail
        )
    return table
