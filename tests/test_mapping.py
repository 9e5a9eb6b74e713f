"""A lab's own DBC through a mapping file: other ids, names, scales, byte order, no CRC."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

import muxjax
from muxjax.config import ConfigError
from muxjax.hardware import LockstepLink, execute
from muxjax.hardware.codec import database
from muxjax.hardware.conformance import run_checks
from muxjax.hardware.mapping import MappedLink, Translation
from muxjax.hardware.protocol import Frame, Op, Port, Received, frame_crc

# What the lab does otherwise than we: ids + 0x100, names with LAB_; CMD, ACK and the streams of
# servos without CRC; everything of these in big-endian; the servo in 1/20 degree; opcodes + 100.
NO_CRC = ("CMD", "ACK", "SERVO_FB_1", "SERVO_FB_2", "SERVO_FB_3")


def lab_dbc() -> str:
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: PC CONTROLLER"]
    for message in database().messages:
        lines.append(f"BO_ {message.frame_id + 0x100} LAB_{message.name}: 8 PC")
        for s in message.signals:
            if s.name in ("Crc", "Counter"):
                continue
            scale, offset, start, order, signed = 1.0, 0.0, s.start, 1, "-" if s.is_signed else "+"
            scale, offset = float(s.conversion.scale), float(s.conversion.offset)
            if message.name in NO_CRC:
                order = 0
                start = big_endian_start(s.start, s.length)
            if s.name == "Position" and message.name.startswith("SERVO"):
                scale = 0.05
            lines.append(
                f" SG_ lab{s.name} : {start}|{s.length}@{order}{signed} ({scale},{offset}) "
                f'[0|0] "" CONTROLLER'
            )
    return "\n".join([*lines, ""])


def big_endian_start(start: int, length: int) -> int:
    """The same bytes, most significant bit first, as a DBC counts it."""
    if length <= 8:
        return start + length - 1
    assert start % 8 == 0
    assert length % 8 == 0
    return start + 7


def lab_mapping() -> dict:
    messages = {}
    for message in database().messages:
        signals: dict = {
            s.name: f"lab{s.name}" for s in message.signals if s.name not in ("Crc", "Counter")
        }
        if "Op" in signals:
            signals["Op"] = {"signal": "labOp", "values": {int(op): op + 100 for op in Op}}
        if message.name.startswith("SERVO"):
            # Their angles are half of ours: a gear of 2 before their encoder.
            signals["Position"] = {"signal": "labPosition", "scale": 0.5}
        messages[message.name] = {
            "message": f"LAB_{message.name}",
            "crc": message.name not in NO_CRC,
            "signals": signals,
        }
    return {"schema": "muxjax/mapping/1", "dbc": "lab.dbc", "messages": messages}


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "lab.dbc").write_text(lab_dbc())
    path = tmp_path / "mapping.yaml"
    path.write_text(yaml.safe_dump(lab_mapping()))
    return path


class LabBoard:
    """A virtual board behind the lab's firmware: what arrives and leaves is the lab's."""

    def __init__(self, board, translation: Translation) -> None:
        self._board, self._translation = board, translation
        self.seen: list[Frame] = []

    def __getattr__(self, name):
        return getattr(self._board, name)

    def step(self, now, frames=()):
        frames = list(frames)
        self.seen += frames
        sent = self._translation.out(self._board.step(now, self._translation.back(frames)))
        self.seen += sent
        return sent


def lab_link(robot, lab: Path) -> tuple[MappedLink, LabBoard]:
    inner = LockstepLink(robot, stream_divider=5)
    inner.board = board = LabBoard(inner.board, Translation(lab))
    return MappedLink(inner, Translation(lab)), board


def test_the_executor_runs_a_program_in_the_lab_s_dbc(muxarm, lab):
    target = np.array([0.006, -0.004, 0, 0, 0.003, 0, 0, 0, 0])
    program = muxjax.schedule(muxarm, muxjax.plan(muxarm, muxjax.Problem(np.zeros(9), target)))
    link, board = lab_link(muxarm, lab)
    run = execute(program, link)
    assert run.reason == "completed"
    assert run.measured == pytest.approx(target, abs=2e-5)
    assert board.mechanics.displacements == pytest.approx(target, abs=2e-5)
    assert {frame.id for frame in board.seen} <= {m.frame_id + 0x100 for m in database().messages}
    ours = LockstepLink(muxarm, stream_divider=5)
    assert run.duration_s == pytest.approx(execute(program, ours).duration_s, abs=0.01)


def test_the_lab_s_board_conforms(muxarm, lab):
    """All but the counting of repeated frames, which needs a counter."""
    link, _ = lab_link(muxarm, lab)
    names = ["handshake_in_order", "watchdog_expires", "sequence_window", "clutch_interlocks",
             "servo_moves_its_tendon", "tendon_range_is_kept",
             "estop_stops_and_is_latched"]  # fmt: skip
    found = run_checks(link, allow_motion=True, only=names)
    assert [(f.name, f.verdict, f.reason) for f in found] == [(f.name, "pass", "") for f in found]


@pytest.mark.parametrize("name", [message.name for message in database().messages])
def test_every_message_survives_the_way_there_and_back(name, lab, rng):
    message = database().get_message_by_name(name)
    there, here = Translation(lab), Translation(lab)
    port, ears = Port(message.senders[0]), Port("BOARD" if message.senders[0] == "HOST" else "HOST")
    for _ in range(50):
        values = {}
        for s in message.signals:
            if s.name in ("Crc", "Counter"):
                continue
            low, high = s.conversion.scaled_to_raw(s.minimum), s.conversion.scaled_to_raw(s.maximum)
            raw = int(rng.integers(low, high, endpoint=True))
            choices = s.choices and sorted(s.choices)
            raw = int(rng.choice(choices)) if choices else raw
            values[s.name] = raw * s.conversion.scale + s.conversion.offset
        frame = port.pack(name, **values)
        (theirs,) = there.out([frame])
        assert theirs.id == frame.id + 0x100
        (back,) = here.back([theirs])
        received = ears.unpack(back)
        assert isinstance(received, Received)
        if name != "ESTOP":
            found = {k: v for k, v in received.values.items() if k in values}
            assert found == pytest.approx(values)


def test_values_lie_where_the_lab_s_dbc_says(lab):
    (frame,) = Translation(lab).out([Port("HOST").pack("CMD", Seq=0x1234, Op=Op.AXIAL, Arg=-2)])
    assert frame == Frame(0x130, bytes.fromhex("0000123469fffffe"))
    (frame,) = Translation(lab).out([Port("BOARD").pack("BOARD_HB", LastSeq=0x1234)])
    assert frame.data[3:5] == bytes.fromhex("3412")
    assert frame.data[0] == frame_crc(0x121, frame.data)
    (frame,) = Translation(lab).out([Port("BOARD").pack("SERVO_FB_1", Position=90.0)])
    assert int.from_bytes(frame.data[2:5], "big") == round(90.0 * 0.5 / 0.05)


def test_broken_and_foreign_frames_are_dropped(lab):
    translation = Translation(lab)
    (beat,) = translation.out([Port("BOARD").pack("BOARD_HB", State=1)])
    flipped = Frame(beat.id, bytes([beat.data[0] ^ 1]) + beat.data[1:])
    short = Frame(beat.id, beat.data[:7])
    assert translation.back([flipped, short, Frame(0x7FF, beat.data), Frame(0x21, beat.data)]) == []
    assert len(translation.back([beat])) == 1
    (estop,) = translation.back([Frame(0x108, b"\x01")])
    assert isinstance(Port("BOARD").unpack(estop), Received)


def without(path: str) -> dict:
    document = lab_mapping()
    *way, last = path.split(".")
    at = document
    for key in way:
        at = at[key]
    del at[last]
    return document


def changed(path: str, value: object) -> dict:
    document = lab_mapping()
    *way, last = path.split(".")
    at = document
    for key in way:
        at = at[key]
    at[last] = value
    return document


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (without("messages.CMD"), "messages: our CMD is missing"),
        (without("messages.CMD.signals.Arg"), r"messages.CMD.signals: our 'Arg' is missing"),
        (without("messages.CMD.crc"), "messages.CMD.crc"),
        (changed("messages.CMD.message", "NOWHERE"), "lab's DBC has no message 'NOWHERE'"),
        (
            changed("messages.ACK.message", "LAB_CMD"),
            "two of our messages are their LAB_CMD|no sig",
        ),
        (changed("messages.CMD.signals.Arg", "labSpeed"), "LAB_CMD has no signal 'labSpeed'"),
        (changed("messages.CMD.signals.Arg", "labSeq"), "two of ours go to one of theirs"),
        (changed("messages.CMD.signals.Speed", "labSeq"), "our CMD has no signal 'Speed'"),
        (changed("messages.CMD.constant", {"Arg": 0}), "'Arg' is both mapped and constant"),
        (
            changed("messages.CMD.signals.Arg", {"signal": "labArg", "scale": 0}),
            "messages.CMD.signals.Arg.scale: must not be 0",
        ),
        (
            changed("messages.CMD.signals.Op", {"signal": "labOp", "values": {1: 5, 2: 5}}),
            "two of ours are one of theirs",
        ),
        (
            changed("messages.MOVE", {"message": "X", "crc": True, "signals": {}}),
            "no message 'MOVE'",
        ),
        (changed("absent", ["MOVE"]), "absent: the protocol has no message 'MOVE'"),
        (changed("dbc", "gone.dbc"), "dbc: .*gone.dbc is not readable"),
        (changed("speed", 3), "speed"),
    ],
)
def test_a_wrong_mapping_is_refused_by_name(document, message, tmp_path):
    (tmp_path / "lab.dbc").write_text(lab_dbc())
    path = tmp_path / "mapping.yaml"
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(ConfigError, match=message):
        Translation(path)


def test_a_crc_needs_its_place(tmp_path):
    (tmp_path / "lab.dbc").write_text(lab_dbc().replace("labOp : 39|8", "labOp : 7|8"))
    path = tmp_path / "mapping.yaml"
    path.write_text(yaml.safe_dump(changed("messages.CMD.crc", True)))
    with pytest.raises(ConfigError, match="their 'labOp' lies in byte 0"):
        Translation(path)


def test_constants_stand_for_what_the_lab_does_not_send(tmp_path):
    document = without("messages.CLUTCH_FB.signals.Temperature")
    document["messages"]["CLUTCH_FB"]["constant"] = {"Temperature": 25}
    (tmp_path / "lab.dbc").write_text(lab_dbc())
    path = tmp_path / "mapping.yaml"
    path.write_text(yaml.safe_dump(document))
    translation = Translation(path)
    frame = Port("BOARD").pack("CLUTCH_FB", Layer=2, Temperature=99)
    (back,) = translation.back(translation.out([frame]))
    received = Port("HOST").unpack(back)
    assert (received.values["Layer"], received.values["Temperature"]) == (2, 25)
    assert math.isfinite(received.values["Current"])
