"""The generated and hand-written C against Python."""

from __future__ import annotations

import ctypes as c
import re
from collections.abc import Iterator

import numpy as np
import pytest
from c_board import SHIM, CBoard, build

import muxjax
from muxjax.cli import main
from muxjax.hardware import LockstepLink, VirtualBoard, execute, load_physics
from muxjax.hardware.codec import database, layouts
from muxjax.hardware.firmware import HAND_WRITTEN, values_header, write_firmware
from muxjax.hardware.protocol import (
    SERVO_BITS_PER_RAD,
    VERSION,
    BoardState,
    Frame,
    Op,
    Port,
    Reason,
    Received,
    Status,
    crc8,
    fingerprint_words,
)
from muxjax.robot import Robot

NAMES = [message.name for message in database().messages]
SESSION = 77


def c_name(name: str) -> str:
    from cantools.database.can.c_source import camel_to_snake_case

    return camel_to_snake_case(name)


def codec_shim() -> str:
    """pack_NAME and unpack_NAME over an array of raw values, for every message."""
    lines = ['#include "tdma.h"', '#include "e2e.h"', "#include <stdint.h>"]
    for message in database().messages:
        struct, fields = f"tdma_{c_name(message.name)}", [c_name(s.name) for s in message.signals]
        lines += [f"void pack_{message.name}(const int64_t *raw, uint8_t *data) {{"]
        lines += [f"    struct {struct}_t m;"]
        for k, (field, signal) in enumerate(zip(fields, message.signals, strict=True)):
            lines += [f"    m.{field} = ({c_type(signal)})raw[{k}];"]
        lines += [f"    {struct}_pack(data, &m, 8);"]
        lines += [f"    e2e_protect({message.frame_id}, data, m.counter);", "}"]
        lines += [f"void unpack_{message.name}(int64_t *raw, const uint8_t *data) {{"]
        lines += [f"    struct {struct}_t m;", f"    {struct}_unpack(&m, data, 8);"]
        lines += [f"    raw[{k}] = m.{field};" for k, field in enumerate(fields)] + ["}"]
    return "\n".join([*lines, ""])


def c_type(signal: object) -> str:
    bits = next(b for b in (8, 16, 32) if signal.length <= b)
    return f"{'' if signal.is_signed else 'u'}int{bits}_t"


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    folder = tmp_path_factory.mktemp("muxarm")
    files = {"shim.c": SHIM, "codec_shim.c": codec_shim()}
    return build(folder, muxjax.load_robot("muxarm"), files)


@pytest.mark.parametrize("name", NAMES)
def test_c_packs_and_unpacks_bit_for_bit_like_python(library, name, rng):
    layout = layouts()[0][name]
    pack, unpack = getattr(library, f"pack_{name}"), getattr(library, f"unpack_{name}")
    data, back = (c.c_uint8 * 8)(), (c.c_int64 * len(layout.fields))()
    counter = -1
    port = Port(layout.sender)
    for _ in range(300):
        raw = [int(rng.integers(f.low, f.high, endpoint=True)) for f in layout.fields]
        counter = (counter + 1) & 0xF
        values = {}
        for k, field in enumerate(layout.fields):
            if field.name == "Counter":
                raw[k] = counter
            elif field.name != "Crc":
                values[field.name] = raw[k] * field.scale + field.offset
        frame = port.pack(name, **values)
        pack((c.c_int64 * len(raw))(*raw), data)
        assert bytes(data) == frame.data
        unpack(back, data)
        crc = next(k for k, field in enumerate(layout.fields) if field.name == "Crc")
        raw[crc] = frame.data[0]
        assert list(back) == raw


def test_c_crc_is_python_s(library, rng):
    library.e2e_crc8.restype = c.c_uint8
    for _ in range(300):
        data = rng.bytes(int(rng.integers(0, 20)))
        assert library.e2e_crc8(data, len(data)) == crc8(data)


def test_c_enumerations_are_python_s():
    text = values_header()
    for name, enum in (("OP", Op), ("STATUS", Status), ("REASON", Reason), ("STATE", BoardState)):
        found = dict(re.findall(rf"TDMA_{name}_(\w+) = (\d+),", text))
        assert found == {e.name: str(e.value) for e in enum}


def test_same_robot_gives_the_same_files(muxarm, tmp_path):
    physics = load_physics("ideal")
    first = write_firmware(tmp_path / "a", muxarm, physics)
    second = write_firmware(tmp_path / "b", muxarm, physics)
    assert [p.name for p in first] == [p.name for p in second]
    assert set(HAND_WRITTEN) < {p.name for p in first}
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]


class Twins:
    """The two boards, told the same at the same time; commands keep clear of rounding.

    The C board counts whole milliseconds, so a job of the virtual one ends up to a few
    milliseconds earlier: nothing is sent while one of them may just have ended.
    """

    CLEAR_S = 0.006

    def __init__(self, library: c.CDLL, robot: Robot) -> None:
        self.robot = robot
        self.python = VirtualBoard(robot)
        self.c = CBoard(library, robot)
        self.now, self.seq = 0.0, 100
        self.port = Port("HOST")
        self.ears = Port("HOST"), Port("HOST")
        self.told: tuple[list, list] = ([], [])

    def step(self, *frames: Frame) -> None:
        for board, ears, told in zip((self.python, self.c), self.ears, self.told, strict=True):
            for frame in board.step(self.now, frames):
                received = ears.unpack(frame)
                assert isinstance(received, Received)
                if received.name in ("ACK", "EMCY"):
                    told.append(essence(received))

    def wait(self, seconds: float, beating: bool) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = round(self.now + min(0.03, end - self.now), 3)
            self.step(*[self.beat()] * beating)

    def beat(self) -> Frame:
        return self.port.pack("HOST_HB", Armed=1, Session=SESSION, Watchdog=150)

    def settle(self) -> None:
        """On to a moment at which no job has just ended or is about to."""
        while self.python._job_due - self.now < self.CLEAR_S:
            self.now = round(self.now + 2 * self.CLEAR_S, 3)
            self.step(self.beat())

    def command(self, op: int, idx: int = 0, arg: int = 0, seq: int | None = None) -> None:
        if seq is None:
            self.seq = seq = (self.seq + 1) & 0xFFFF
        self.step(self.port.pack("CMD", Seq=seq, Op=op, Idx=idx, Arg=arg))

    def arm(self) -> None:
        self.command(Op.HELLO, arg=VERSION << 16 | SESSION)
        for k, word in enumerate(fingerprint_words(self.robot.fingerprint), start=1):
            self.command(Op.ROBOT, k, word)
        self.step(self.beat())
        self.command(Op.ARM, arg=SESSION)

    def agree(self) -> None:
        assert self.told[0] == self.told[1]
        assert self.python.state == self.c.state


def essence(received: Received) -> tuple:
    """What the boards must agree on: all but the clock, which rounds differently."""
    values = dict(received.values)
    del values["Counter"], values["Crc"]
    clock = received.name == "EMCY" or values["Status"] in (
        Status.ACCEPTED,
        Status.DONE,
        Status.ABORTED,
    )
    if clock:
        del values["Detail"]
    return received.name, tuple(values.items())


def sensible(twins: Twins, rng: np.random.Generator) -> tuple[int, int, int]:
    """What a host would do next, so that random commands come deep into the state machine."""
    board = twins.python
    if board.state is not BoardState.ARMED or board.slot < 0:
        return Op.AXIAL, 0, int(rng.integers(1, len(twins.robot.axial_map) + 1))
    if board.staged:
        return Op.START, 0, sum(1 << servo for servo in board.staged)
    coupled = [s for s in range(twins.robot.tendons_per_segment) if board.tendon_of(s) is not None]
    if not coupled:
        return Op.ENGAGE, board.layer + 1, int(rng.integers(1, 8))
    if rng.random() < 0.3:
        return Op.RELEASE, board.layer + 1, board.clutch_mask(board.energised)
    return Op.STAGE, 1 + int(rng.choice(coupled)), bits(twins.robot, rng.normal(0, 0.03))


def wild(twins: Twins, rng: np.random.Generator) -> tuple[int, int, int]:
    """Known opcodes with numbers around their limits."""
    op = int(rng.choice([Op.AXIAL, Op.ENGAGE, Op.RELEASE, Op.STAGE, Op.START, Op.DISARM]))
    if op == Op.STAGE:
        return op, int(rng.integers(0, 5)), bits(twins.robot, rng.normal(0, 0.1))
    return op, max(twins.python.layer + int(rng.integers(0, 3)), 0), int(rng.integers(0, 11))


def bits(robot: Robot, metres: float) -> int:
    return round(metres * float(robot.servo_per_metre) * SERVO_BITS_PER_RAD)


def bend(twins: Twins, rng: np.random.Generator) -> None:
    """A part fails, in both boards; or all are whole again."""
    virtual, plant = twins.python, twins.c.plant
    servo, wheel = int(rng.integers(0, 3)), int(rng.integers(0, 9))
    virtual.mechanics.jammed.clear()
    for faults in (virtual.senses.offline, virtual.senses.encoders.broken,
                   virtual.senses.encoders.stuck, virtual.mechanics.dead_plugs,
                   plant.jammed, plant.offline, plant.stuck_wheels, plant.dead_plugs):  # fmt: skip
        faults.clear()
    plant.wheel_bits = [0] * len(plant.wheel_bits)
    virtual.volts, plant.centivolts = 24.0, 2400
    kind = str(rng.choice(["none", "jam", "offline", "encoder", "stuck", "volts", "plug"]))
    if kind in ("jam", "offline"):
        virtual.mechanics.jam(servo)
        plant.jammed.add(servo)
    if kind == "offline":
        virtual.senses.offline.add(servo)
        plant.offline.add(servo)
    elif kind == "encoder":
        virtual.senses.encoders.broken[wheel] = plant.wheel_bits[wheel] = int(rng.integers(1, 4))
    elif kind == "stuck":
        virtual.senses.encoders.stuck[wheel] = virtual.senses.raw(wheel)
        plant.stuck_wheels[wheel] = plant.wheel_counts(wheel)
    elif kind == "volts":
        virtual.volts, plant.centivolts = 12.0, 1200
    elif kind == "plug":
        virtual.mechanics.dead_plugs.add(wheel)
        plant.dead_plugs.add(wheel)


DEEDS = {"sensible": 0.5, "wild": 0.15, "nonsense": 0.04, "repeat": 0.06, "far": 0.02,
         "silence": 0.03, "disarm": 0.02, "arm": 0.14, "bend": 0.04}  # fmt: skip


def script(twins: Twins, rng: np.random.Generator, steps: int) -> Iterator[None]:
    """Random commands, sensible ones and nonsense, silence, at last ESTOP.

    Yields when both boards had time for their answers.
    """
    for step in range(steps):
        twins.settle()
        yield
        deed = str(rng.choice(list(DEEDS), p=list(DEEDS.values())))
        if step == steps - 8:
            twins.step(Frame(0x008, b""))
        elif deed == "sensible":
            twins.command(*sensible(twins, rng))
        elif deed == "wild":
            twins.command(*wild(twins, rng))
        elif deed == "nonsense":
            op = int(rng.choice([*range(14), 255]))
            idx, arg = int(rng.integers(0, 16)), int(rng.integers(-(2**23), 2**23))
            twins.command(op, idx, arg)
        elif deed == "repeat":
            twins.command(Op.START, 0, 1, seq=twins.seq - int(rng.integers(0, 40)) & 0xFFFF)
        elif deed == "far":
            twins.seq = (twins.seq + int(rng.integers(0, 18))) & 0xFFFF
            twins.command(Op.SET_STREAM, 0, 5)
        elif deed == "silence":
            twins.wait(0.4, beating=False)
        elif deed == "disarm":
            twins.command(Op.DISARM)
        elif deed == "bend":
            bend(twins, rng)
        else:
            twins.arm()
        twins.wait(float(rng.choice([0.002, 0.05, 0.25, 0.6, 3.0])), beating=True)


@pytest.mark.parametrize(
    "seed", [*range(3), *(pytest.param(k, marks=pytest.mark.slow) for k in range(3, 60))]
)
def test_both_boards_answer_random_commands_alike(library, muxarm, seed):
    rng = np.random.default_rng(seed)
    twins = Twins(library, muxarm)
    for _ in script(twins, rng, 120):
        twins.agree()
    twins.wait(0.5, beating=False)
    twins.agree()
    truth = twins.python.mechanics.displacements
    # One bit of servo and the last of a line that is cut into whole milliseconds.
    assert np.abs(truth - twins.c.plant.displacements).max() < 2e-4
    assert twins.c.dropped == 0
    assert len(twins.told[0]) > 100


def test_a_program_runs_on_the_c_board(library, muxarm):
    target = np.array([0.004, -0.006, 0, 0, 0, 0, 0.003, 0, 0])
    program = muxjax.schedule(muxarm, muxjax.plan(muxarm, muxjax.Problem(np.zeros(9), target)))
    link = LockstepLink(muxarm, stream_divider=10)
    board = CBoard(library, muxarm)
    link.board = board
    link.trajectory = lambda since: None
    run = execute(program, link)
    assert run.reason == "completed"
    assert run.measured == pytest.approx(target, abs=2e-5)
    assert board.plant.displacements == pytest.approx(target, abs=3e-5)
    assert board.state is BoardState.READY


def test_c_board_feeds_its_servos_a_short_way_ahead(library, muxarm):
    """Should the controller hang in the middle of a move, the servos stand within the horizon."""
    twins = Twins(library, muxarm)
    twins.arm()
    twins.command(Op.AXIAL, 0, 1)
    twins.wait(3.2, beating=True)
    twins.command(Op.ENGAGE, 1, 1)
    twins.wait(0.4, beating=True)
    twins.command(Op.STAGE, 1, 20000)
    twins.command(Op.START, 0, 1)
    twins.wait(1.0, beating=True)
    plant = twins.c.plant
    twins.agree()
    before = plant.servo[0]
    plant.advance(plant.now + 1000)
    ahead = plant.servo[0] - before
    assert 0 < ahead <= 0.040 * float(muxarm.servo_speed) * SERVO_BITS_PER_RAD + 1


def test_c_board_without_its_turns_arms_only_when_told(library, muxarm):
    counts = 20000  # of wheel 8: one turn and a bit
    start = np.zeros(9)
    start[7] = counts * 2 * np.pi * float(muxarm.wheel_radius) / 16384
    board = CBoard(library, muxarm, start, turns_lost=True)
    port, ears, heard = Port("HOST"), Port("HOST"), []

    def tell(name: str, **values: int) -> Received:
        frames = board.step(board.next_time, [port.pack(name, **values)])
        heard.extend(ears.unpack(frame) for frame in frames)
        return next((h for h in reversed(heard) if h.name == "ACK"), None)

    tell("CMD", Seq=1, Op=Op.HELLO, Arg=VERSION << 16 | SESSION)
    for k, word in enumerate(fingerprint_words(muxarm.fingerprint), start=1):
        tell("CMD", Seq=1 + k, Op=Op.ROBOT, Idx=k, Arg=word)
    tell("HOST_HB", Session=SESSION, Watchdog=150)
    for wheel in range(1, 10):
        refused = tell("CMD", Seq=2 * wheel + 4, Op=Op.ARM, Arg=SESSION).values
        assert (refused["Reason"], refused["Detail"]) == (Reason.TURNS_UNKNOWN, wheel)
        turns = 1 if wheel == 8 else 0
        tell("CMD", Seq=2 * wheel + 5, Op=Op.TURNS, Arg=wheel << 16 | turns)
    tell("HOST_HB", Session=SESSION, Watchdog=150)
    assert tell("CMD", Seq=30, Op=Op.ARM, Arg=SESSION).values["Status"] == Status.DONE
    for _ in range(250):
        heard += [ears.unpack(frame) for frame in board.step(board.next_time)]
    beats = [h.values["Faults"] for h in heard if h.name == "BOARD_HB"]
    assert (beats[0] & 8, beats[-1] & 8) == (8, 0)
    turns = [
        h.values["Turns2"] for h in heard if h.name == "WHEEL_TURNS" and h.values["Group"] == 1
    ]
    assert turns[-1] == 1


def test_a_robot_of_another_shape_compiles_and_runs(tmp_path):
    penta = muxjax.load_robot("penta")
    library = build(tmp_path, penta, {"shim.c": SHIM})
    twins = Twins(library, penta)
    rng = np.random.default_rng(3)
    for _ in script(twins, rng, 60):
        twins.agree()
    assert twins.c.dropped == 0


def test_command_writes_the_files(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["firmware", "--out", str(tmp_path / "out"), "--robot", "penta"])
    assert stop.value.code == 0
    assert "8 files in" in capsys.readouterr().out
    written = (tmp_path / "out" / "board_config.c").read_text()
    assert f"hash {muxjax.load_robot('penta').fingerprint}" in written
