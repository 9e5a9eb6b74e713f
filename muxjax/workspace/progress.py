"""A progress bar with rate and time left, on standard error."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Self

import jax
import rich.progress
from rich.console import Console
from rich.text import Text

_EVERY_S = 0.2


class _Rate(rich.progress.ProgressColumn):
    def render(self, task: rich.progress.Task) -> Text:
        speed = task.speed or 0.0
        return Text(f"{speed / 1e6:.1f} M samples/s")


class Progress:
    """Context manager around the rich bar; silent on all processes but the first."""

    def __init__(self, total: int, done: int, wanted: bool | None) -> None:
        shown = sys.stderr.isatty() if wanted is None else wanted
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("sweep"),
            rich.progress.BarColumn(),
            rich.progress.TaskProgressColumn(),
            _Rate(),
            rich.progress.TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=not shown or jax.process_index() != 0,
        )
        self._task = self._bar.add_task("sweep", total=total, completed=done)
        self._total, self._last = total, 0.0

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

    def update(self, done: int) -> None:
        """Samples done so far."""
        now = time.monotonic()
        if now - self._last > _EVERY_S or done >= self._total:
            self._bar.update(self._task, completed=done)
            self._last = now
