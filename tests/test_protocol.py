"""The frame layer: DBC, codec, CRC, counters."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from muxjax.config import RobotConfig
from muxjax.hardware.codec import database, layouts
from muxjax.hardware.protocol import (
    BoardState,
    Frame,
    Op,
    Port,
    Reason,
    Received,
    Refusal,
    Status,
    check_robot_fits,
    crc8,
    fingerprint_words,
)
from muxjax.robot import Robot, robot_from_config

NAMES = [message.name for message in database().messages]


def crc_bit_by_bit(data: bytes) -> int:
    """Independent transcription: polynomial division, one bit at a time."""
    register = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            feedback = (register >> 7) ^ ((byte >> bit) & 1)
            register = (register << 1) & 0xFF
            if feedback:
                register ^= 0x2F
    return register ^ 0xFF


def test_crc_has_the_published_check_value():
    assert crc8(b"123456789") == 0xDF


@given(st.binary(max_size=20))
def test_crc_is_the_polynomial_division(data):
    assert crc8(data) == crc_bit_by_bit(data)


@pytest.mark.parametrize("name", NAMES)
def test_codec_is_cantools(name, rng):
    message, layout = database().get_message_by_name(name), layouts()[0][name]
    for _ in range(200):
        raw = {
            s.name: int(rng.integers(s.conversion.scaled_to_raw(s.minimum),
                                     s.conversion.scaled_to_raw(s.maximum), endpoint=True))
            for s in message.signals
        }  # fmt: skip
        data = message.encode(raw, scaling=False)
        values = message.decode(data, decode_choices=False)
        assert layout.decode(data) == values
        assert layout.encode(values) == data == message.encode(values)


@pytest.mark.parametrize("name", NAMES)
def test_messages_start_with_crc_and_counter_and_overlap_nowhere(name):
    message = database().get_message_by_name(name)
    places = {s.name: (s.start, s.length) for s in message.signals}
    assert (places["Crc"], places["Counter"]) == ((0, 8), (8, 4))
    bits = [b for start, length in places.values() for b in range(start, start + length)]
    assert len(bits) == len(set(bits))
    assert max(bits) < 64
    assert message.length == 8


@pytest.mark.parametrize(
    ("message", "signal", "enum"),
    [
        ("CMD", "Op", Op),
        ("ACK", "Op", Op),
        ("ACK", "Reason", Reason),
        ("EMCY", "Code", Reason),
        ("BOARD_HB", "State", BoardState),
    ],
)
def test_enums_are_those_of_the_dbc(message, signal, enum):
    choices = database().get_message_by_name(message).get_signal_by_name(signal).choices
    assert {value: str(name) for value, name in choices.items()} == {e.value: e.name for e in enum}


def command(port: Port, **values: int) -> Frame:
    return port.pack("CMD", Seq=values.pop("Seq", 7), Op=Op.AXIAL, **values)


def test_round_trip():
    frame = Port("HOST").pack("CMD", Seq=65535, Op=Op.STAGE, Idx=15, Arg=-8388608)
    received = Port("BOARD").unpack(frame)
    assert isinstance(received, Received)
    wanted = {"Seq": 65535, "Op": Op.STAGE, "Idx": 15, "Arg": -8388608}
    assert received.name == "CMD"
    assert {k: received.values[k] for k in wanted} == wanted


@given(st.integers(1, 0x7FF), st.integers(-(2**23), 2**23 - 1))
def test_every_flipped_bit_is_refused(id_flips, arg):
    frame = command(Port("HOST"), Arg=arg)
    word = int.from_bytes(frame.data, "big")
    for bit in range(64):
        broken = Frame(frame.id, (word ^ (1 << bit)).to_bytes(8, "big"))
        assert Port("BOARD").unpack(broken) is Refusal.CRC
    other_id = frame.id ^ id_flips
    if other_id != 0x008:
        moved = Port("BOARD").unpack(Frame(other_id, frame.data))
        assert isinstance(moved, Refusal)


def test_payload_of_a_command_is_no_heartbeat():
    frame = command(Port("HOST"), Arg=3)
    assert Port("BOARD").unpack(Frame(0x020, frame.data)) is Refusal.CRC


def test_repeated_frame_is_refused_by_its_counter_and_the_next_is_taken():
    host, board = Port("HOST"), Port("BOARD")
    first = command(host, Arg=1)
    assert isinstance(board.unpack(first), Received)
    assert board.unpack(first) is Refusal.COUNTER
    assert isinstance(board.unpack(command(host, Arg=1)), Received)


@pytest.mark.parametrize("length", [0, 1, 7])
def test_short_frame_is_refused(length):
    frame = command(Port("HOST"))
    assert Port("BOARD").unpack(Frame(frame.id, frame.data[:length])) is Refusal.LENGTH


def test_unknown_ids_and_echoes_are_refused():
    frame = command(Port("HOST"))
    assert Port("BOARD").unpack(Frame(0x123, frame.data)) is Refusal.UNKNOWN_ID
    assert Port("HOST").unpack(frame) is Refusal.UNKNOWN_ID


def test_value_outside_an_enumeration_is_refused():
    frame = Port("BOARD").pack("ACK", Status=15)
    assert Port("HOST").unpack(frame) is Refusal.VALUE


@given(st.integers(0, 2**29), st.binary(max_size=64), st.sampled_from(["HOST", "BOARD"]))
def test_garbage_never_raises(frame_id, data, node):
    assert isinstance(Port(node).unpack(Frame(frame_id, data)), Received | Refusal)


@given(st.binary(max_size=8))
def test_estop_is_taken_however_broken(data):
    received = Port("BOARD").unpack(Frame(0x008, data))
    assert isinstance(received, Received)
    assert received.name == "ESTOP"


def test_pack_names_the_wrong_signal_and_the_limit():
    with pytest.raises(ValueError, match=r"CMD: has no signal.*Speed"):
        Port("HOST").pack("CMD", Speed=3)
    with pytest.raises(ValueError, match=r"CMD.Arg: is -8.38861e\+06 to 8.38861e\+06"):
        Port("HOST").pack("CMD", Arg=1 << 23)
    with pytest.raises(ValueError, match="no 'MOVE'"):
        Port("HOST").pack("MOVE")


def test_status_choices_fit_the_enum():
    for status in Status:
        received = Port("HOST").unpack(Port("BOARD").pack("ACK", Status=status))
        assert isinstance(received, Received)
        assert received.values["Status"] == status


def test_fingerprint_words_are_the_fingerprint(robot):
    words = fingerprint_words(robot.fingerprint)
    assert "".join(f"{word:04x}" for word in words) == robot.fingerprint


def bigger(robot: Robot, **changes: object) -> Robot:
    values = robot.config.model_dump(mode="json", by_alias=True)
    for path, value in changes.items():
        section, field = path.split("__")
        values[section][field]["value"] = value
    values["cost"] = None  # the sheet counts the motors of the robot as it is
    return robot_from_config(RobotConfig.model_validate(values))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tendons__per_segment": 16}, "16 servos, the protocol carries at most 15"),
        ({"transmission__wheel_radius_m": 1e-4}, "wheel turns, the protocol carries at most 127"),
    ],
)
def test_robot_beyond_the_fields_is_refused(muxarm, change, message):
    with pytest.raises(ValueError, match=message):
        check_robot_fits(bigger(muxarm, **change))


def test_shipped_robots_fit(robot):
    check_robot_fits(robot)


def test_imports_stay_light():
    code = "import muxjax, muxjax.hardware, sys; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "muxjax.hardware.executor" in loaded
    assert not [m for m in loaded if re.fullmatch(r"(can|cantools)(\..*)?", m)]


def test_streams_stay_within_the_bus(robot):
    """Worst-case stuffing: 135 bits a frame at 1 Mbit/s, issue's limit 15 % of the bus."""
    cycles = {m.name: m.cycle_time for m in database().messages if m.cycle_time}
    frames = dict.fromkeys(cycles, 1)
    frames |= {f"SERVO_FB_{k + 1}": 0 for k in range(3)} | {
        f"WHEEL_FB_{k + 1}": 0 for k in range(3)
    }
    for servo in range(robot.tendons_per_segment):
        frames[f"SERVO_FB_{servo % 3 + 1}"] += 1
    for trio in range(int(np.ceil(robot.n_tendons / 3))):
        frames[f"WHEEL_FB_{trio % 3 + 1}"] += 1
    frames["WHEEL_TURNS"] = int(np.ceil(robot.n_tendons / 6))
    rate = sum(1000 / cycles[name] * count for name, count in frames.items())
    assert rate * 135 / 1e6 < 0.15
