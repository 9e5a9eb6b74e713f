"""The write-ahead journal of a run, with which it can be gone on with to the same final lengths.

It says what a host that was killed had begun, and where the wheels of a board that lost its turn
counts were.

A file of lines, each ``<crc32, 8 hex digits> <JSON>``, only ever appended to. Lines that are
written ahead of a motion are on the disk before the motion's first frame leaves the host.
"""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, TypeAdapter, ValidationError

from muxjax.config import Strict, explain
from muxjax.scheduler import Program

Lengths = tuple[float | None, ...]  # by the wheels [m]; None for a wheel never heard
_HEAD = re.compile(rb"[0-9a-f]{0,8}|[0-9a-f]{8} ")  # the first 9 bytes, also where they are torn


class ProgramEntry(Strict):
    """A program begins; it replaces the one before. Written ahead."""

    kind: Literal["program"] = "program"
    file_schema: Literal["muxjax/journal/1"] = Field(default="muxjax/journal/1", alias="schema")
    program: Program  # has the robot's fingerprint
    goals: tuple[tuple[dict[int, float], ...], ...]  # absolute, {servo: m} a leg, a visit


class SessionEntry(Strict):
    """A session armed the board. Written ahead."""

    kind: Literal["session"] = "session"
    session: int
    boot_count: int
    lengths: Lengths


class LegEntry(Strict):
    """A leg is about to start. Written ahead."""

    kind: Literal["leg"] = "leg"
    visit: int  # from 1
    leg: int  # from 1
    goals: dict[int, float]  # {tendon: m}
    lengths: Lengths


class AtEntry(Strict):
    """Where the wheels are, every now and then."""

    kind: Literal["at"] = "at"
    lengths: Lengths


class DoneEntry(Strict):
    """A visit is over: its goals are reached and its clutches are out. On the disk at once."""

    kind: Literal["done"] = "done"
    visit: int
    lengths: Lengths


class ServoEntry(Strict):
    """A servo failed and is out of use, until a program has it again. On the disk at once."""

    kind: Literal["servo"] = "servo"
    servo: int
    reason: str


class RepairEntry(Strict):
    """Wheel encoders were repaired, says an operator: they are right and the journal was not.

    On the disk at once.
    """

    kind: Literal["repair"] = "repair"
    encoders: tuple[int, ...]  # of tendons, from 1
    lengths: Lengths  # None for the others: nobody vouches for those


class EndEntry(Strict):
    """A run ended, one way or the other. On the disk at once."""

    kind: Literal["end"] = "end"
    completed: bool
    reason: str
    lengths: Lengths
    refused: bool = False  # before anything moved: a program that only began is withdrawn


Entry: TypeAlias = (
    ProgramEntry
    | SessionEntry
    | LegEntry
    | AtEntry
    | DoneEntry
    | ServoEntry
    | RepairEntry
    | EndEntry
)
_ENTRY: TypeAdapter[Entry] = TypeAdapter(Annotated[Entry, Field(discriminator="kind")])


@dataclass(frozen=True)
class Standing:
    """How far a journal says that its last program has come.

    Attributes:
        program: The last program; None in an empty journal.
        goals: Its pinned absolute goals, {servo: m} a leg, a visit.
        done: Visits that are over, all the first ones.
        leg: Leg of the next visit that was last started, from 1; 0 if none was.
        lengths: Last known lengths [m]; None for a wheel never heard.
        toward: Goals of the motion that may have been under way, {tendon: m}.
        failed_servos: Servos that failed and that no program since has, ascending. New plans do
            without them; who begins a program with one of them has repaired it.
        completed: Whether the program ran to its end.
        begun: Whether a session has armed the board for it, or for one before that was not
            completed: what then slipped when clutches dropped out, no length tells.
    """

    program: Program | None = None
    goals: tuple[tuple[Mapping[int, float], ...], ...] = ()
    done: int = 0
    leg: int = 0
    lengths: Lengths = ()
    toward: Mapping[int, float] | None = None
    failed_servos: tuple[int, ...] = ()
    completed: bool = False
    begun: bool = False


def standing(entries: Sequence[Entry]) -> Standing:
    """Read a journal's entries from the last program on, and the failed servos of all."""
    entries = in_force(entries)
    failed = _failed(entries)
    starts = [k for k, entry in enumerate(entries) if isinstance(entry, ProgramEntry)]
    if not starts:
        return Standing(failed_servos=failed)
    first = entries[starts[-1]]
    assert isinstance(first, ProgramEntry)  # as chosen above
    done = leg = 0
    lengths: Lengths = first.program.start
    toward: Mapping[int, float] | None = None
    completed = False
    for entry in entries[starts[-1] + 1 :]:
        if isinstance(entry, LegEntry):
            leg, toward = (entry.leg if entry.visit == done + 1 else 0), entry.goals
        elif isinstance(entry, DoneEntry):
            done, leg, toward = max(done, entry.visit), 0, None
        elif isinstance(entry, EndEntry):
            completed = entry.completed
        if not isinstance(entry, (ProgramEntry, ServoEntry)):
            known = zip(entry.lengths, lengths, strict=True)
            lengths = tuple(old if new is None else new for new, old in known)
    return Standing(
        first.program,
        first.goals,
        done,
        leg,
        lengths,
        toward,
        failed,
        completed,
        begun=_begun(entries),
    )


def in_force(entries: Sequence[Entry]) -> list[Entry]:
    """Entries without the programs that were refused before anything moved for them."""
    kept = list[Entry]()
    for entry in entries:
        kept.append(entry)
        if isinstance(entry, EndEntry) and entry.refused:
            begin = max(k for k, e in enumerate(kept) if isinstance(e, ProgramEntry))
            if not any(isinstance(e, SessionEntry) for e in kept[begin:]):
                del kept[begin:]
    return kept


def _failed(entries: Sequence[Entry]) -> tuple[int, ...]:
    failed = set[int]()
    for entry in entries:
        if isinstance(entry, ServoEntry):
            failed.add(entry.servo)
        elif isinstance(entry, ProgramEntry):
            failed.difference_update(entry.program.servos)
    return tuple(sorted(failed))


def _begun(entries: Sequence[Entry]) -> bool:
    new = False  # whether a program has begun since
    for entry in reversed(entries):
        if isinstance(entry, SessionEntry):
            return True
        if new and isinstance(entry, EndEntry) and entry.completed:
            return False
        new = new or isinstance(entry, ProgramEntry)
    return False


class MemoryJournal:
    """A journal that lives as long as this process, for trials.

    Attributes:
        entries: What was written, in order.
    """

    def __init__(self) -> None:
        self.entries: list[Entry] = []

    def write(self, entry: Entry, *, ahead: bool = True) -> None:
        """Append an entry.

        Args:
            entry: The entry.
            ahead: Return only when it is on the disk; else it may be lost with the host's power,
                not with the process.
        """
        self.entries.append(entry)

    @property
    def standing(self) -> Standing:
        """How far the last program has come."""
        return standing(self.entries)

    def close(self) -> None:
        """Nothing more will be written."""


class Journal(MemoryJournal):
    """A journal in a file.

    Attributes:
        note: What was wrong with the file and could be mended; empty if nothing.
    """

    def __init__(self, path: Path, file: int, entries: list[Entry], note: str) -> None:
        super().__init__()
        self.path = path
        self.entries = entries
        self.note = note
        self._file = file

    @classmethod
    def open(cls, path: str | Path) -> Journal:
        """Open a journal, or begin one.

        A last line that the host died over is dropped, with a note: what it announced had not
        begun, because frames leave only after the line.

        Raises:
            ValueError: A line that is damaged or says something unknown, with its number; or
                another process that has the journal open.
            OSError: The file cannot be read or written.
        """
        path = Path(path)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            _lock(file, path)
            with os.fdopen(os.dup(file), "rb") as reader:
                data = reader.read()
            entries, whole = _entries(path, data)
            note = ""
            if whole < len(data):
                torn = len(data) - whole
                note = f"{path}, line {len(entries) + 1}: torn after {torn} bytes; dropped"
                os.ftruncate(file, whole)
            os.fsync(file)
            _sync_folder(path.parent)
        except BaseException:
            os.close(file)
            raise
        return cls(path, file, entries, note)

    def write(self, entry: Entry, *, ahead: bool = True) -> None:
        """As ``MemoryJournal.write``.

        Raises:
            OSError: The disk does not take it.
        """
        text = entry.model_dump_json(by_alias=True).encode()
        line = f"{zlib.crc32(text):08x} ".encode() + text + b"\n"
        before = os.fstat(self._file).st_size
        written = os.write(self._file, line)
        if written < len(line):
            os.ftruncate(self._file, before)  # or the next line would continue this one
            raise OSError(f"{self.path}: only {written} of {len(line)} bytes written")
        if ahead:
            os.fsync(self._file)
        super().write(entry, ahead=ahead)

    def close(self) -> None:
        """Close the file; another process may go on with it."""
        os.close(self._file)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def read_entries(path: str | Path) -> list[Entry]:
    """What a journal says, to look at: the file is neither locked nor mended.

    A last line that is not yet whole is left out.

    Raises:
        ValueError: A line that is damaged or says something unknown, with its number.
        OSError: The file cannot be read.
    """
    path = Path(path)
    return _entries(path, path.read_bytes())[0]


def is_journal(path: str | Path) -> bool:
    """Whether a file begins as a journal does; False if there is no such file."""
    path = Path(path)
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(9)
    return len(head) == 9 and _HEAD.fullmatch(head) is not None


def _entries(path: Path, data: bytes) -> tuple[list[Entry], int]:
    """Entries of the whole lines, and how many bytes those are."""
    if not _HEAD.fullmatch(data[:9]):  # before anything is taken for torn, and cut off
        what = "not that of a journal, as muxjax run --journal writes it"
        if b'"muxjax/program/' in data[:200]:
            what += "; this is a program, which muxjax run takes"
        raise ValueError(f"{path}, line 1: {what}")
    whole = data.rfind(b"\n") + 1
    lines = data[:whole].splitlines()
    entries = [_parse(path, n, line) for n, line in enumerate(lines, start=1)]
    if entries and not isinstance(entries[0], ProgramEntry):
        raise ValueError(f"{path}, line 1: a journal begins with a program")
    return entries, whole


def _parse(path: Path, number: int, line: bytes) -> Entry:
    where = f"{path}, line {number}"
    checksum, _, text = line.partition(b" ")
    if checksum != f"{zlib.crc32(text):08x}".encode():
        raise ValueError(f"{where}: checksum is {zlib.crc32(text):08x}, found {checksum[:8]!r}")
    try:
        return _ENTRY.validate_json(text)
    except ValidationError as error:
        raise ValueError(f"{where}: {explain(error)}") from error


def _lock(file: int, path: Path) -> None:
    """Two hosts must not go on with one journal."""
    try:
        import fcntl
    except ImportError:  # not on this system; nothing else is at hand
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ValueError(f"{path}: another process has this journal open") from error


def _sync_folder(folder: Path) -> None:
    """A new file's name is on the disk only when its folder is."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
