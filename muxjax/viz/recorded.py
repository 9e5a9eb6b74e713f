"""Files as tracks for a viewer's timeline: programs, plans, trajectories and recorded runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from muxjax.config import ConfigError
from muxjax.hardware.journal import (
    DoneEntry,
    EndEntry,
    Entry,
    LegEntry,
    ProgramEntry,
    RepairEntry,
    ServoEntry,
    SessionEntry,
    in_force,
    read_entries,
)
from muxjax.recording import LoggedRun, read_log, read_program
from muxjax.robot import Robot
from muxjax.scheduler import Program, Trajectory, check_same_robot
from muxjax.trajectory_file import load_trajectory
from muxjax.viz.playback import (
    Marks,
    Track,
    axial_before,
    lost_servos,
    move_words,
    numbers_of,
    track_of_program,
)

_ELSEWHERE = 5e-4  # least difference of a beginning from the end before it; less is slip [m]


def read_track(robot: Robot, path: str | Path) -> Track:
    """A file as a track: a program, a plan, a trajectory, a journal or a log of the bus.

    Files are told apart by what they hold: JSON with a schema line, CSV or NPZ (``muxjax export``),
    a journal (``muxjax run --journal``) or candump lines (``muxjax run --log``).

    Raises:
        ValueError: No such file, none of these, damaged, or made for another robot.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    if path.suffix in {".csv", ".npz"}:
        line = load_trajectory(robot, path)
        return _track_of_trajectory(robot, line, path.name)
    with open(path, "rb") as file:
        first = file.readline().lstrip()
    if not first:
        raise ConfigError(f"{path}: is empty")
    if first.startswith(b"("):
        return track_of_run(robot, read_log(robot, path), path.name)
    if not first.startswith((b"{", b"[")):
        return track_of_journal(robot, read_entries(path), path.name)
    return track_of_program(robot, read_program(robot, path), path.name)


def _track_of_trajectory(robot: Robot, line: Trajectory, name: str) -> Track:
    moved = Trajectory(line.time_s - line.time_s[0], line.displacements)
    # A trajectory says nothing of the drive; any tendon may be seen to move.
    every = np.ones(robot.n_tendons, bool)
    none = np.zeros(robot.tendons_per_segment, bool)
    return Track(
        name,
        "trajectory; the file has no drum and clutches",
        moved,
        (Marks(0.0, every, none, ""),),
        np.zeros(0),
        np.zeros(0),
        float(robot.tendon_speed),
    )


def track_of_journal(robot: Robot, entries: list[Entry], name: str) -> Track:
    """Where a journal says that the wheels were.

    A journal has no clock: between two of its lines as much time is put as M Eq. 14 gives the
    motion. A program or a session that begins where no clutch can have brought the wheels, as the
    next run of the same journal does, is there at once.

    Raises:
        ValueError: Its program was made for another robot, or it holds none.
    """
    entries = in_force(entries)
    if not entries:
        raise ConfigError(f"{name}: the journal holds no program")
    n = robot.n_tendons
    none, failed = np.zeros(n, bool), np.zeros(robot.tendons_per_segment, bool)
    lost = failed
    now, engaged = np.zeros(n), none
    time_s, axial = 0.0, 0.0
    times, points, marks = list[float](), list[np.ndarray](), list[Marks]()
    axial_s, positions = list[float](), list[float]()
    program: Program | None = None
    for entry in entries:
        phase, jumps = marks[-1].phase if marks else "at rest", False
        if isinstance(entry, ProgramEntry):
            check_same_robot(robot, entry.program)
            program = entry.program
            lost = lost_servos(robot, program.servos)
            failed = failed & lost  # one that a program has again was repaired
            start = np.array(program.start)
            phase = f"a program of {len(program.instructions)} stages begins"
            jumps = bool(points) and bool(np.max(np.abs(start - now)) > _ELSEWHERE)
            if jumps:
                axial_s.append(time_s)
                positions.append(axial)
            if jumps or not points:
                now, axial = start, axial_before(program)
                axial_s.append(time_s)
                positions.append(axial)
        elif isinstance(entry, ServoEntry):
            one = np.arange(len(failed)) == entry.servo - 1
            failed, lost = failed | one, lost | one
            phase = f"servo {entry.servo} failed: {entry.reason}"
        else:
            reached = np.array(
                [old if new is None else new for new, old in zip(entry.lengths, now, strict=True)]
            )
            moved = np.abs(reached - now)
            jumps = isinstance(entry, SessionEntry) and bool(np.any(moved[~engaged] > _ELSEWHERE))
            if not (jumps or isinstance(entry, RepairEntry)):  # which nothing moved for
                time_s += float(np.max(moved)) / float(robot.tendon_speed)
            now = reached
        if isinstance(entry, LegEntry) and program is not None:
            stage = f"stage {entry.visit} of {len(program.instructions)}"
            if entry.leg == 1 or not engaged.any():
                slot = program.instructions[entry.visit - 1].axial - 1
                turns = slot != axial
                axial_s.append(time_s)
                positions.append(axial)
                times.append(time_s)
                points.append(now)
                what = f"drum turns to {slot + 1}" if turns else "clutches engage"
                out = numbers_of(lost & ~failed)
                marks.append(Marks(time_s, none, lost, f"{stage}: {what}", out))
                time_s += float(robot.switch_time if turns else robot.engage_time)
                axial = float(slot)
                axial_s.append(time_s - float(robot.engage_time))
                positions.append(axial)
            engaged = np.isin(np.arange(1, n + 1), list(entry.goals))
            phase = f"{stage}: {move_words(sorted(entry.goals))}"
        elif isinstance(entry, DoneEntry):
            engaged, phase = none, f"stage {entry.visit}: over"
        elif isinstance(entry, SessionEntry):
            engaged, phase = none, "the board is armed"
        elif isinstance(entry, RepairEntry):
            engaged, phase = none, f"repaired encoders: {sorted(entry.encoders)}"
        elif isinstance(entry, EndEntry):
            engaged, phase = none, entry.reason
        if jumps:
            engaged, phase = none, f"{phase}; its start is elsewhere"
        times.append(time_s)
        points.append(now)
        marks.append(Marks(time_s, engaged, lost, phase, numbers_of(lost & ~failed)))
    assert program is not None  # a journal begins with a program
    return Track(
        name,
        "journal of a run; it has no clock, times of M Eq. 14",
        Trajectory(np.array(times), np.array(points)),
        (replace(marks[0], since_s=0.0), *marks[1:]),
        np.array(axial_s),
        np.array(positions),
        float(robot.tendon_speed),
        np.array(program.target),
    )


def track_of_run(robot: Robot, run: LoggedRun, name: str) -> Track:
    """What the board has reported, with the log's times."""
    marks = list[Marks]()
    line = run.trajectory
    for k, time_s in enumerate(line.time_s):
        engaged, phase = run.engaged[k], f"board {run.state[k].name.lower()}"
        if engaged.any():
            phase += ", clutches " + ", ".join(str(c + 1) for c in np.flatnonzero(engaged))
        elif not run.axial[k]:
            phase += ", drum turns"
        last = marks[-1] if marks else None
        if last is None or last.phase != phase or np.any(last.lost != run.servo_lost[k]):
            marks.append(Marks(float(time_s), engaged, run.servo_lost[k], phase))
    heard = np.isfinite(run.drum)
    return Track(
        name,
        "recorded on the bus, wheels as measured",
        line,
        tuple(marks),
        line.time_s[heard],
        run.drum[heard],
        float(robot.tendon_speed),
    )
