"""Files as tracks for a viewer's timeline: programs, plans, trajectories and recorded runs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from muxjax.config import ConfigError
from muxjax.hardware.journal import (
    DoneEntry,
    EndEntry,
    Entry,
    LegEntry,
    ProgramEntry,
    ServoEntry,
    SessionEntry,
    read_entries,
)
from muxjax.hardware.protocol import (
    OFFLINE,
    STALLED,
    Frame,
    Op,
    Port,
    Received,
    fingerprint_words,
)
from muxjax.hardware.sensors import Sensors
from muxjax.plan_file import load_plan
from muxjax.program_file import load_program
from muxjax.robot import Robot
from muxjax.scheduler import Program, Trajectory, check_same_robot, schedule
from muxjax.trajectory_file import load_trajectory
from muxjax.viz.playback import Marks, Track, lost_servos, move_words, track_of_program

_LOG_EVERY_S = 0.04  # a bus log is sampled this often


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
        return track_of_log(robot, path)
    if not first.startswith((b"{", b"[")):
        return track_of_journal(robot, read_entries(path), path.name)
    try:
        document: Any = json.loads(path.read_bytes())
    except ValueError as error:
        raise ConfigError(f"{path}: not readable as JSON ({error})") from error
    schema = str(document.get("schema")) if isinstance(document, dict) else ""
    try:
        if schema.startswith("muxjax/plan/"):
            return track_of_program(robot, schedule(robot, load_plan(path)), path.name)
        return track_of_program(robot, load_program(path), path.name)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error


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
    motion.

    Raises:
        ValueError: Its program was made for another robot, or it holds none.
    """
    if not entries:
        raise ConfigError(f"{name}: the journal holds no program")
    n = robot.n_tendons
    none, lost = np.zeros(n, bool), np.zeros(robot.tendons_per_segment, bool)
    now, engaged = np.zeros(n), none
    time_s, axial = 0.0, 0.0
    times, points, marks = list[float](), list[np.ndarray](), list[Marks]()
    axial_s, positions = list[float](), list[float]()
    program: Program | None = None
    for entry in entries:
        phase = marks[-1].phase if marks else "at rest"
        if isinstance(entry, ProgramEntry):
            check_same_robot(robot, entry.program)
            program = entry.program
            lost = lost | lost_servos(robot, program.servos)
            if not points:
                now = np.array(program.start)
                axial = float(program.axial - 1) if program.axial else 0.0
            phase = f"a program of {len(program.instructions)} stages begins"
        elif isinstance(entry, ServoEntry):
            lost = lost.copy()
            lost[entry.servo - 1] = True
            phase = f"servo {entry.servo} failed: {entry.reason}"
        else:
            reached = np.array(
                [old if new is None else new for new, old in zip(entry.lengths, now, strict=True)]
            )
            time_s += float(np.max(np.abs(reached - now))) / float(robot.tendon_speed)
            now = reached
        if isinstance(entry, LegEntry) and program is not None:
            stage = f"stage {entry.visit} of {len(program.instructions)}"
            if entry.leg == 1 or not engaged.any():
                slot = program.instructions[entry.visit - 1].axial - 1
                axial_s.append(time_s)
                positions.append(axial)
                times.append(time_s)
                points.append(now)
                marks.append(Marks(time_s, none, lost, f"{stage}: drum turns to {slot + 1}"))
                time_s += float(robot.switch_time)
                axial = float(slot)
                axial_s.append(time_s - float(robot.engage_time))
                positions.append(axial)
            engaged = np.isin(np.arange(1, n + 1), list(entry.goals))
            phase = f"{stage}: {move_words(sorted(entry.goals))}"
        elif isinstance(entry, DoneEntry):
            engaged, phase = none, f"stage {entry.visit}: over"
        elif isinstance(entry, SessionEntry):
            engaged, phase = none, "the board is armed"
        elif isinstance(entry, EndEntry):
            engaged, phase = none, entry.reason
        times.append(time_s)
        points.append(now)
        marks.append(Marks(time_s, engaged, lost, phase))
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


def track_of_log(robot: Robot, path: str | Path) -> Track:
    """What the board reported in a log of the bus, in candump's format and with its times.

    Frames that the protocol refuses are left out, as the host does; a last line that is not whole
    likewise. Whose log it is, the host's handshake says.

    Raises:
        ValueError: The host was there for another robot, or not all wheels were heard.
    """
    host, board, sensors = Port("HOST"), Port("BOARD"), Sensors(robot)
    words = fingerprint_words(robot.fingerprint)
    times, points, marks = list[float](), list[np.ndarray](), list[Marks]()
    axial_s, axial, n_axial = list[float](), list[float](), len(robot.axial_map)
    begin, due = 0.0, 0.0
    for now, frame in _frames(Path(path)):
        asked = board.unpack(frame)
        if isinstance(asked, Received) and asked.name == "CMD" and asked.values["Op"] == Op.ROBOT:
            place, word = asked.values["Idx"], asked.values["Arg"]
            if not 1 <= place <= len(words) or words[place - 1] != word:
                raise ConfigError(
                    f"{path}: the host ran a program of another robot; this is "
                    f"{robot.config.name!r} ({robot.fingerprint})"
                )
        received = host.unpack(frame)
        if not isinstance(received, Received):
            continue
        sensors.update(now, *received)
        if not sensors.complete:
            continue
        if not times:
            begin = due = now
        if received.name == "AXIAL_FB":
            axial_s.append(now - begin)
            axial.append(received.values["Position"] * n_axial / 360.0)
        _mark(robot, sensors, now - begin, marks)
        if now >= due:
            times.append(now - begin)
            points.append(sensors.displacements())
            due = now + _LOG_EVERY_S
    if not times:
        raise ConfigError(
            f"{path}: no log of this arm's board: its {robot.n_tendons} wheels and "
            f"{robot.tendons_per_segment} servos were not all heard"
        )
    return Track(
        Path(path).name,
        "recorded on the bus, wheels as measured",
        Trajectory(np.array(times), np.array(points)),
        tuple(marks),
        np.array(axial_s),
        np.array(axial),
        float(robot.tendon_speed),
    )


def _frames(path: Path) -> Iterator[tuple[float, Frame]]:
    """Time [s] and frame of each line of a candump log."""
    with open(path, encoding="ascii", errors="replace") as file:
        for line in file:
            words = line.split()
            try:
                name, _, data = words[2].partition("#")
                yield float(words[0].strip("()")), Frame(int(name, 16), bytes.fromhex(data))
            except (IndexError, ValueError):
                continue


def _mark(robot: Robot, sensors: Sensors, now: float, marks: list[Marks]) -> None:
    """One mark more, if the drive is not as the last one says."""
    layer, _, verified = sensors.clutches
    engaged = np.zeros(robot.n_tendons, bool)
    j = robot.tendons_per_segment
    for within in range(j):
        if verified >> within & 1 and layer:
            engaged[(layer - 1) * j + within] = True
    lost = np.array([bool(bits & (STALLED | OFFLINE)) for bits in sensors.servo_status])
    state = sensors.state
    phase = "" if state is None else f"board {state.name.lower()}"
    if engaged.any():
        phase += ", clutches " + ", ".join(str(c + 1) for c in np.flatnonzero(engaged))
    elif not sensors.slot:
        phase += ", drum turns"
    last = marks[-1] if marks else None
    if last is None or last.phase != phase or np.any(last.lost != lost):
        marks.append(Marks(now if marks else 0.0, engaged, lost, phase))
