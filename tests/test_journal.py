"""The journal's file: what survives, what is dropped, what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from muxjax.hardware.journal import (
    AtEntry,
    DoneEntry,
    EndEntry,
    Journal,
    LegEntry,
    MemoryJournal,
    ProgramEntry,
    RepairEntry,
    ServoEntry,
    SessionEntry,
    is_journal,
)
from muxjax.scheduler import Instruction, Program

PROGRAM = Program(
    robot="two",
    fingerprint="0123456789abcdef",
    start=(0.0, 0.001),
    target=(0.01, 1 / 3),
    axial=None,
    servos=(1, 2),
    instructions=(Instruction(1, (1,), {1: 24.0}, {1: 0.01}, ({1: 0.01},)),),
)
ENTRIES = [
    ProgramEntry(program=PROGRAM, goals=(({1: 0.01},),)),
    SessionEntry(session=7, boot_count=1, lengths=(0.0, None)),
    LegEntry(visit=1, leg=1, goals={1: 0.01}, lengths=(0.0, 0.001)),
    AtEntry(lengths=(0.004, None)),
    ServoEntry(servo=2, reason="stalled"),
    RepairEntry(encoders=(2,), lengths=(0.004, 0.002)),
    DoneEntry(visit=1, lengths=(0.01, 0.001)),
    EndEntry(completed=True, reason="completed", lengths=(0.01, 0.001)),
]


@pytest.fixture
def path(tmp_path):
    with Journal.open(tmp_path / "run.journal") as journal:
        for entry in ENTRIES:
            journal.write(entry, ahead=entry.kind != "at")
        assert journal.note == ""
    return tmp_path / "run.journal"


def test_what_was_written_is_read(path):
    with Journal.open(path) as journal:
        assert journal.entries == ENTRIES
        assert journal.note == ""


def test_standing_after_each_entry():
    journal, found = MemoryJournal(), []
    for entry in ENTRIES:
        journal.write(entry)
        now = journal.standing
        assert now.program == PROGRAM
        found.append((now.done, now.leg, now.toward, now.lengths, now.completed))
    start = (0.0, 0.001)
    assert found == [
        (0, 0, None, start, False),
        (0, 0, None, start, False),  # a wheel not heard stays where it was
        (0, 1, {1: 0.01}, start, False),
        (0, 1, {1: 0.01}, (0.004, 0.001), False),
        (0, 1, {1: 0.01}, (0.004, 0.001), False),
        (0, 1, {1: 0.01}, (0.004, 0.002), False),
        (1, 0, None, (0.01, 0.001), False),
        (1, 0, None, (0.01, 0.001), True),
    ]
    assert journal.standing.failed_servos == (2,)


@pytest.mark.parametrize(("servos", "failed"), [((1,), (2,)), ((1, 2), ())])
def test_a_new_program_replaces_the_old_one_and_who_gives_it_a_failed_servo_repaired_it(
    servos, failed
):
    journal = MemoryJournal()
    new = ProgramEntry(program=replace(PROGRAM, servos=servos), goals=ENTRIES[0].goals)
    for entry in [*ENTRIES, new]:
        journal.write(entry)
    now = journal.standing
    assert (now.done, now.completed, now.failed_servos) == (0, False, failed)
    assert not now.begun  # it begins where the old one ended, not where an accident left the arm


@pytest.mark.parametrize(
    ("entries", "begun"),
    [
        (ENTRIES[:1], False),
        (ENTRIES[:2], True),
        (ENTRIES, True),
        ([*ENTRIES[:4], ENTRIES[0]], True),
    ],
)
def test_begun_from_the_first_session_to_the_next_program_after_the_end(entries, begun):
    journal = MemoryJournal()
    for entry in entries:
        journal.write(entry)
    assert journal.standing.begun is begun


def test_a_torn_last_line_is_dropped_and_reported_wherever_it_tore(path):
    data = path.read_bytes()
    last = data.rstrip(b"\n").rfind(b"\n") + 1
    for end in range(last + 1, len(data)):
        path.write_bytes(data[:end])
        with Journal.open(path) as journal:
            assert journal.entries == ENTRIES[:-1]
            assert f"line {len(ENTRIES)}: torn after {end - last} bytes; dropped" in journal.note
            journal.write(ENTRIES[-1])
        assert path.read_bytes() == data


def test_any_flipped_byte_before_the_last_line_is_refused_with_its_line(path):
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    for at in rng.choice(len(data) - 1, 300, replace=False).tolist():
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(rng.integers(7))
        path.write_bytes(bytes(flipped))
        line = data[:at].count(b"\n") + 1
        with pytest.raises(ValueError, match=rf"run.journal, line {line}: "):
            Journal.open(path)


def test_a_missing_line_is_not_a_journal(path):
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[1:]))
    with pytest.raises(ValueError, match=r"line 1: a journal begins with a program"):
        Journal.open(path)


def test_a_journal_has_one_owner(path):
    with Journal.open(path), pytest.raises(ValueError, match="another process has this journal"):
        Journal.open(path)
    Journal.open(path).close()


def test_what_is_written_ahead_is_on_the_disk(path, monkeypatch):
    synced = []
    monkeypatch.setattr("os.fsync", lambda file: synced.append(path.stat().st_size))
    with Journal.open(path) as journal:
        synced.clear()
        journal.write(ENTRIES[3], ahead=False)
        assert synced == []
        journal.write(ENTRIES[2])
        assert synced == [path.stat().st_size]


def test_a_full_disk_leaves_whole_lines(path, monkeypatch):
    import os

    data, write = path.read_bytes(), os.write
    with Journal.open(path) as journal:
        monkeypatch.setattr("os.write", lambda file, line: write(file, line[:10]))
        with pytest.raises(OSError, match=r"only 10 of \d+ bytes written"):
            journal.write(ENTRIES[3])
        assert path.read_bytes() == data
        assert journal.entries == ENTRIES


def test_another_file_is_refused_and_left_as_it_is(tmp_path):
    for text in ('{"schema": "muxjax/program/1"}', "a note without an end of line", "\n"):
        (tmp_path / "other").write_text(text)
        with pytest.raises(ValueError, match=r"other, line 1: not that of a journal"):
            Journal.open(tmp_path / "other")
        assert (tmp_path / "other").read_text() == text
        assert not is_journal(tmp_path / "other")


def test_a_journal_is_known_by_its_head(path):
    assert is_journal(path)
    assert not is_journal(path.with_name("none"))
