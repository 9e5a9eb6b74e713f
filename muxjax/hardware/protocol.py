"""Frames of the TDMA board: the DBC's messages, their CRC and alive counter (docs/protocol.md).

``protocol.dbc`` is the single source of the layout; ``codec`` reads it through cantools.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from enum import IntEnum, IntFlag
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from muxjax.hardware.codec import DLC, layouts
from muxjax.robot import Robot
from muxjax.tendons import displacement_range

VERSION = 1
ESTOP_ID = 0x008

MAX_LAYERS = 15  # idx and layer fields have four bits, 0 is "none"
MAX_SERVOS = 15
MAX_AXIAL = 255  # slot field
MAX_TENDONS = 96  # WHEEL_TURNS: 16 groups of 6
MAX_TURNS = 127  # WHEEL_TURNS: eight bits, signed
SERVO_LIMIT_BITS = 8_000_000  # of 2**23 in 0.1 degree: leaves room for a probe at either end
WHEEL_BITS = 14
COUNTS_PER_TURN = 1 << WHEEL_BITS
MOVING, COUPLED, STALLED, OFFLINE = 1, 2, 4, 8  # status bits of SERVO_FB
PARITY, MAGNET = 1, 2  # status bits of WHEEL_FB
SERVO_BITS_PER_RAD = 1800 / math.pi  # 0.1 degree

MAX_DIVIDER = 20  # of SET_STREAM
BOARD_BEAT_S = 0.05
HOST_BEAT_S = 0.03  # four in a row must be lost before the watchdog bites; at 20 Hz two would do
WATCHDOG_S = 0.150


class Op(IntEnum):
    """What a CMD asks for."""

    HELLO = 1
    ROBOT = 2
    ARM = 3
    DISARM = 4
    AXIAL = 5
    ENGAGE = 6
    RELEASE = 7
    STAGE = 8
    START = 9
    SET_STREAM = 10
    TURNS = 11


class Status(IntEnum):
    """What an ACK says."""

    ACCEPTED = 0
    DONE = 1
    DUPLICATE = 2
    REJECTED = 3
    BUSY = 4
    ABORTED = 5


class Reason(IntEnum):
    """Why a command was rejected or aborted."""

    NONE = 0
    UNKNOWN_OP = 1
    SEQUENCE = 2
    NOT_ARMED = 3
    ARMED_ALREADY = 4
    WRONG_VERSION = 5
    WRONG_ROBOT = 6
    ROBOT_UNCHECKED = 7
    WRONG_SESSION = 8
    NO_HEARTBEAT = 9
    ESTOPPED = 10
    BUSY = 11
    UNKNOWN_AXIAL = 12
    UNKNOWN_SERVO = 13
    UNKNOWN_CLUTCH = 14
    WRONG_LAYER = 15
    CLUTCH_IN = 16
    AXIAL_MOVING = 17
    NOT_IN_SLOT = 18
    NOT_COUPLED = 19
    NOT_STAGED = 20
    SERVO_RANGE = 21
    TENDON_RANGE = 22
    NOT_SEATED = 23
    NOT_RELEASED = 24
    WATCHDOG = 25
    DISARMED = 26
    STREAM_RANGE = 27
    TURNS_UNKNOWN = 28
    SERVO_STALLED = 29
    SERVO_OFFLINE = 30
    ENCODER_FAULT = 31
    COIL_HOT = 32
    UNDERVOLTAGE = 33
    WHEEL_STILL = 34


class BoardState(IntEnum):
    """State of the board, in every BOARD_HB."""

    SILENT = 0
    READY = 1
    ARMED = 2
    SAFE = 3
    ESTOPPED = 4


class Fault(IntFlag):
    """Faults field of BOARD_HB; they stay until power-up."""

    WATCHDOG = 1
    ESTOP = 2
    FRAMES_REFUSED = 4
    TURNS_LOST = 8
    SERVO = 16
    ENCODER = 32
    COIL_HOT = 64
    VOLTAGE = 128


class Refusal(IntEnum):
    """Why a received frame was not taken."""

    LENGTH = 1
    UNKNOWN_ID = 2
    CRC = 3
    COUNTER = 4
    VALUE = 5


# Fields with which a receiver can do nothing unless it knows the value. An unknown Op is answered.
_CLOSED: dict[str, dict[str, type[IntEnum]]] = {
    "ACK": {"Status": Status, "Reason": Reason},
    "EMCY": {"Code": Reason},
    "BOARD_HB": {"State": BoardState},
}


class Frame(NamedTuple):
    """A classic CAN data frame."""

    id: int  # 11 bits
    data: bytes


class Received(NamedTuple):
    """A frame that passed every check."""

    name: str
    values: Mapping[str, Any]  # signal: value in the DBC's unit; without CRC and counter


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte << 1) ^ (0x2F if byte & 0x80 else 0)
        table.append(byte & 0xFF)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc8(data: bytes | bytearray) -> int:
    """CRC-8 of AUTOSAR's E2E profile 2: polynomial 0x2F, start 0xFF, final xor 0xFF."""
    crc = 0xFF
    for byte in data:
        crc = _CRC_TABLE[crc ^ byte]
    return crc ^ 0xFF


def frame_crc(frame_id: int, data: bytes | bytearray) -> int:
    """CRC of a frame: over its id (two bytes, high one first) and its bytes from the second on.

    The id is covered so that a payload under another message's id is refused.
    """
    return crc8(frame_id.to_bytes(2, "big") + data[1:])


class Port:
    """One node's end of the bus: counts what it sends, checks what it receives.

    Args:
        node: "HOST" or "BOARD" as in the DBC; only messages of the other node are taken.
    """

    def __init__(self, node: str) -> None:
        self.node = node
        self._sent: dict[str, int] = {}
        self._heard: dict[int, int] = {}

    def pack(self, name: str, **values: float) -> Frame:
        """Encode a message.

        Args:
            name: Message in the DBC.
            **values: Signals in the DBC's units; the bits of signals left out are 0.

        Raises:
            ValueError: A signal that the message has not, or a value beyond its field.
        """
        counter = (self._sent.get(name, -1) + 1) & 0xF
        frame = _encode(name, counter, tuple(values.items()))
        self._sent[name] = counter
        return frame

    def unpack(self, frame: Frame) -> Received | Refusal:
        """Decode a frame, or say why it is refused. Never raises, whatever the bytes are."""
        read = _decode(frame, self.node)
        if isinstance(read, Refusal) or frame.id == ESTOP_ID:
            return read
        counter = frame.data[1] & 0xF
        if self._heard.get(frame.id) == counter:
            return Refusal.COUNTER
        self._heard[frame.id] = counter
        return read


# While nothing moves a stream repeats itself but for its counter: both ways are remembered.
@functools.lru_cache(maxsize=4096)
def _encode(name: str, counter: int, values: tuple[tuple[str, float], ...]) -> Frame:
    layout = layouts()[0].get(name)
    if layout is None:
        raise ValueError(f"message: the protocol has no {name!r}")
    data = bytearray(layout.encode({**dict(values), "Counter": counter}))
    data[0] = frame_crc(layout.id, data)
    return Frame(layout.id, bytes(data))


@functools.lru_cache(maxsize=4096)
def _decode(frame: Frame, node: str) -> Received | Refusal:
    """Everything about a received frame that does not depend on the ones before."""
    layout = layouts()[1].get(frame.id)
    if layout is None or layout.sender == node:
        return Refusal.UNKNOWN_ID
    if frame.id == ESTOP_ID:
        return Received("ESTOP", {})
    if len(frame.data) != DLC:
        return Refusal.LENGTH
    if frame.data[0] != frame_crc(frame.id, frame.data):
        return Refusal.CRC
    values = layout.decode(frame.data)
    if layout.name in _CLOSED and not _known(layout.name, values):
        return Refusal.VALUE
    return Received(layout.name, MappingProxyType(values))


def _known(name: str, values: Mapping[str, Any]) -> bool:
    return all(values[field] in tuple(choices) for field, choices in _CLOSED[name].items())


def check_robot_fits(robot: Robot) -> None:
    """Raise ValueError if the protocol's fields cannot carry this robot."""
    travel = np.abs(displacement_range(robot)).max() / (2 * math.pi * float(robot.wheel_radius))
    sizes = {
        "segments": (robot.n_segments, MAX_LAYERS),
        "servos": (robot.tendons_per_segment, MAX_SERVOS),
        "axial positions": (len(robot.axial_map), MAX_AXIAL),
        "tendons": (robot.n_tendons, MAX_TENDONS),
        "wheel turns": (math.ceil(travel), MAX_TURNS),
    }
    for what, (found, limit) in sizes.items():
        if found > limit:
            raise ValueError(
                f"{robot.config.name}: {found} {what}, the protocol carries at most {limit}"
            )


def fingerprint_words(fingerprint: str) -> tuple[int, ...]:
    """The robot's 16-digit hash as the four 16-bit words that the handshake compares."""
    return tuple(int(fingerprint[k : k + 4], 16) for k in range(0, 16, 4))
