"""A run from the frames that ``muxjax run --log`` has written (candump -L)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.config import ConfigError
from muxjax.hardware.protocol import (
    OFFLINE,
    STALLED,
    BoardState,
    Fault,
    Frame,
    Op,
    Port,
    Received,
    fingerprint_words,
)
from muxjax.hardware.sensors import Sensors
from muxjax.recording.recording import Recording, take
from muxjax.robot import Robot
from muxjax.scheduler import Trajectory
from muxjax.trajectory_file import sample

_LINE = re.compile(rb"^\((\d+\.\d+)\) \S+ ([0-9A-Fa-f]{3})#([0-9A-Fa-f]{0,16})(?: [TR])?\s*$")


@dataclass(frozen=True, eq=False)
class LoggedRun:
    """What a board has reported, whenever its last wheel did.

    Attributes:
        time_s: Of the file [s], never falling.
        displacements: By the wheels' encoders [m].
        servo_rad: Shaft angles of the servos [rad].
        servo_lost: Servos that have stalled or do not answer.
        axial: Axial position, from 1; 0 between two.
        drum: Where the drum stands, from 0, with fractions, at least -0.5; NaN before it has
            reported.
        engaged: Tendons whose clutches are energised.
        state: Of the board.
        refused: Frames of the board that were damaged, and were left out.
    """

    time_s: Float[np.ndarray, " P"]
    displacements: Float[np.ndarray, "P SJ"]
    servo_rad: Float[np.ndarray, "P J"]
    servo_lost: Bool[np.ndarray, "P J"]
    axial: Int[np.ndarray, " P"]
    drum: Float[np.ndarray, " P"]
    engaged: Bool[np.ndarray, "P SJ"]
    state: tuple[BoardState, ...]
    refused: int

    @property
    def trajectory(self) -> Trajectory:
        """Tendon displacements by the wheels, from time 0 on."""
        return Trajectory(self.time_s - self.time_s[0], self.displacements)


def read_log(robot: Robot, path: str | Path) -> LoggedRun:
    """Read a run's frames.

    From when on every wheel's turn and every servo is known; while a board says that it has lost
    its turn counts, nothing is. A last line that is not whole, as a killed host leaves it, is left
    out.

    Args:
        robot: The arm on the board.
        path: File of ``muxjax run --log``, or of ``candump -L``.

    Raises:
        ConfigError: No such file, a line that is none of candump's, times that fall, a host that
            ran a program of another robot, or no moment at which the board has reported everything.
    """
    sensors, port, refused, drum = Sensors(robot), Port("HOST"), 0, np.nan
    board, numbers = Port("BOARD"), np.arange(1, robot.n_tendons + 1)
    last_group = f"WHEEL_FB_{(robot.n_tendons - 1) // 3 % 3 + 1}", (robot.n_tendons - 1) // 9
    times: list[float] = []
    rows: list[tuple[Any, ...]] = []
    boots, lost = -1, True  # until the board's first heartbeat nothing is believed
    for at_s, frame in _frames(Path(path)):
        # candump marks no direction: the host's frames are those that a board would take.
        asked = board.unpack(frame)
        if isinstance(asked, Received):
            _check_robot(robot, path, asked)
            continue
        read = port.unpack(frame)
        if not isinstance(read, Received):
            refused += 1
            continue
        if read.name == "WHEEL_TURNS" and lost:
            continue  # the board counts from wherever it woke up
        sensors.update(at_s, read.name, read.values)
        if read.name == "BOARD_HB":
            lost = Fault.TURNS_LOST in sensors.faults
            if lost or sensors.boot_count != boots:
                sensors.forget_turns()
            boots = sensors.boot_count
        if read.name == "AXIAL_FB":
            slots = len(robot.axial_map)
            # An encoder's last digit below the first position's zero reads as almost 360 degrees.
            drum = (read.values["Position"] * slots / 360.0 + 0.5) % slots - 0.5
        whole = (read.name, read.values.get("Group")) == last_group
        if whole and sensors.complete:
            times.append(at_s)
            stuck = np.array([bool(bits & (STALLED | OFFLINE)) for bits in sensors.servo_status])
            servo = sensors.servo_rad.copy(), stuck
            engaged = np.isin(numbers, sensors.tendons_of(sensors.clutches[1]))
            drive = sensors.slot, drum, engaged, sensors.state
            rows.append((sensors.displacements(), *servo, *drive))
    if not rows:
        raise ConfigError(
            f"{path}: at no moment has every wheel and every servo of {robot.config.name!r} "
            "reported; is it the log of a run of this robot?"
        )
    lengths, servos, stopped, axial, drums, coupled, state = zip(*rows, strict=True)
    return LoggedRun(
        np.array(times),
        np.stack(lengths),
        np.stack(servos),
        np.stack(stopped),
        np.array(axial),
        np.array(drums),
        np.stack(coupled),
        state,
        refused,
    )


def logged_recording(robot: Robot, run: LoggedRun, rate_hz: float = 50.0) -> Recording:
    """A run at equal times; lengths in between on straight lines, the rest as last reported.

    Raises:
        ValueError: A rate that cannot serve.
    """
    samples = sample(robot, run.trajectory, rate_hz)
    times = run.time_s - run.time_s[0]
    return Recording(
        samples=samples,
        begin_s=float(run.time_s[0]),
        servo_rad=take(run.servo_rad, times, samples.time_s),
        axial=take(run.axial, times, samples.time_s),
        engaged=take(run.engaged.astype(int), times, samples.time_s).astype(bool),
        source="run",
    )


def _frames(path: Path) -> Iterator[tuple[float, Frame]]:
    """Times [s] and frames of a log."""
    try:
        lines = path.read_bytes().splitlines(keepends=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    before = -np.inf
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        found = _LINE.match(line)
        if found is None or len(found[3]) % 2:
            if number > 1 and not line.endswith(b"\n"):
                return
            raise ConfigError(
                f"{path}, line {number}: is no line of candump -L, found {line.rstrip()[:60]!r}; "
                "muxjax run --log writes such files"
            )
        at_s = float(found[1])
        if at_s < before:
            raise ConfigError(
                f"{path}, line {number}: time {at_s:.6f} s is before {before:.6f} s: a log that "
                "grew over several runs in lockstep? Take one run at a time"
            )
        before = at_s
        yield at_s, Frame(int(found[2], 16), bytes.fromhex(found[3].decode()))


def _check_robot(robot: Robot, path: str | Path, asked: Received) -> None:
    """Whose log it is, the host's handshake says, word by word."""
    if asked.name != "CMD" or asked.values["Op"] != Op.ROBOT:
        return
    words, place = fingerprint_words(robot.fingerprint), asked.values["Idx"]
    if not 1 <= place <= len(words) or words[place - 1] != asked.values["Arg"]:
        raise ConfigError(
            f"{path}: the host ran a program of another robot; this is {robot.config.name!r} "
            f"({robot.fingerprint})"
        )
