"""Every frame of a run in a file, as ``candump -L`` writes it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from muxjax.hardware.links import Link
from muxjax.hardware.protocol import Frame
from muxjax.scheduler import Trajectory

_STAMP = re.compile(rb"^\((\d+\.\d+)\) ", re.MULTILINE)
_TAIL = 1 << 12  # bytes at the end of a file in which its last stamp stands
_CALENDAR_S = 1e9  # times since 1970 are beyond this, those of a virtual clock are not


class LoggedLink:
    """A link whose frames are also written to a file.

    They are with the system as soon as they were sent or received, so the file survives a killed
    process. python-can, SavvyCAN and cantools (``cantools decode``, with protocol.dbc) read it.

    Args:
        link: The link.
        path: Of the file, which grows if it exists and its times go on without falling; a last
            line that is not whole goes.
        begin_s: Time in the file at the zero of the link's clock [s]; for a link in real time,
            ``time.time() - link.now``.

    Raises:
        ValueError: The file's last time is later than the link's now, or one of the two is of a
            virtual clock, which begins at 0, and the other since 1970.
        OSError: The file cannot be read or written.
    """

    def __init__(self, link: Link, path: str | Path, begin_s: float = 0.0) -> None:
        self.robot = link.robot
        self.stream_divider = link.stream_divider
        self._link, self._begin = link, begin_s
        _make_ready(Path(path), begin_s + link.now)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)

    @property
    def now(self) -> float:
        """As of the link."""
        return self._link.now

    def new_session(self) -> int:
        """As of the link."""
        return self._link.new_session()

    def send(self, frames: Iterable[Frame]) -> None:
        """Write the frames down, then send them."""
        frames = list(frames)
        self._write(frames, "T")
        self._link.send(frames)

    def wait(self, until: float) -> list[Frame]:
        """As of the link."""
        frames = self._link.wait(until)
        self._write(frames, "R")
        return frames

    def trajectory(self, since: float) -> Trajectory | None:
        """As of the link."""
        return self._link.trajectory(since)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _write(self, frames: list[Frame], way: str) -> None:
        at = self._begin + self.now
        lines = (f"({at:.6f}) can0 {f.id:03X}#{f.data.hex().upper()} {way}\n" for f in frames)
        if text := "".join(lines):
            os.write(self._file, text.encode())


def _make_ready(path: Path, now: float) -> None:
    """Make a file end with a whole line; a failed supply may have cut its last one.

    Raises:
        ValueError: Frames of this time [s] cannot follow those in the file.
    """
    if not path.is_file():
        return
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - _TAIL))
        tail = file.read()
    stamps = _STAMP.findall(tail)
    if not stamps:
        return
    last = float(stamps[-1])
    if last > now or (last < _CALENDAR_S < now):
        raise ValueError(
            f"log: {path} exists and ends at {last:.6f} s, this run begins at {now:.6f} s (a "
            "virtual board's clock begins at 0); give another name, or remove the file"
        )
    os.truncate(path, size - len(tail) + tail.rfind(b"\n") + 1)
