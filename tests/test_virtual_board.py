"""The virtual board seen from its bus, judged by its truth."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import muxjax
from muxjax.config import ConfigError
from muxjax.hardware.physics import axial_time, load_physics, probe_time
from muxjax.hardware.protocol import (
    COUNTS_PER_TURN,
    SERVO_BITS_PER_RAD,
    VERSION,
    WATCHDOG_S,
    BoardState,
    Frame,
    Op,
    Port,
    Reason,
    Received,
    Status,
    fingerprint_words,
)
from muxjax.hardware.sensors import Sensors
from muxjax.hardware.virtual_board import RANGE_MARGIN_M, VirtualBoard
from muxjax.robot import Robot
from muxjax.tendons import displacement_range

SESSION = 77


class Bench:
    """A host at the bench: sends what it is told, keeps what it hears."""

    def __init__(self, robot: Robot, **board: object) -> None:
        self.robot = robot
        self.board = VirtualBoard(robot, **board)
        self.port, self.ears = Port("HOST"), Port("HOST")
        self.now, self.seq = 0.0, 100
        self.heard: list[Received] = []

    def step(self, frames: Iterable[Frame] = ()) -> list[Received]:
        heard = [self.ears.unpack(f) for f in self.board.step(self.now, frames)]
        assert all(isinstance(h, Received) for h in heard)
        self.heard += heard
        return heard

    def beat(self) -> None:
        self.step([self.port.pack("HOST_HB", Armed=1, Session=SESSION, Watchdog=150)])

    def wait(self, seconds: float, beating: bool = True) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now = min(end, self.now + 0.05)
            self.beat() if beating else self.step()

    def command(self, op: int, idx: int = 0, arg: int = 0, seq: int | None = None) -> tuple:
        """(status, reason) of the first answer."""
        self.seq = (self.seq + 1) & 0xFFFF if seq is None else self.seq
        used = self.seq if seq is None else seq
        heard = self.step([self.port.pack("CMD", Seq=used, Op=op, Idx=idx, Arg=arg)])
        acks = [h.values for h in heard if h.name == "ACK" and h.values["Seq"] == used]
        return Status(acks[0]["Status"]), Reason(acks[0]["Reason"])

    def do(self, op: int, idx: int = 0, arg: int = 0, takes: float = 0.0) -> None:
        status, reason = self.command(op, idx, arg)
        assert status in (Status.DONE, Status.ACCEPTED), reason
        self.wait(takes)
        assert self.last_ack()[:2] == (Status.DONE, Reason.NONE)

    def last_ack(self) -> tuple[Status, Reason, int]:
        ack = next(h.values for h in reversed(self.heard) if h.name == "ACK")
        return Status(ack["Status"]), Reason(ack["Reason"]), ack["Op"]

    def arm(self) -> Bench:
        self.do(Op.HELLO, arg=VERSION << 16 | SESSION)
        for k, word in enumerate(fingerprint_words(self.robot.fingerprint), start=1):
            self.do(Op.ROBOT, k, word)
        self.beat()
        self.do(Op.ARM, arg=SESSION)
        return self

    def engage(self, axial: int = 1) -> Bench:
        """Armed, at an axial position, servo 1 coupled to the tendon it meets there."""
        self.arm().do(Op.AXIAL, arg=axial, takes=3.0)
        self.do(Op.ENGAGE, *self.clutch(axial), takes=1.0)
        return self

    def clutch(self, axial: int) -> tuple[int, int]:
        tendon = int(self.robot.axial_map[axial - 1, 0])
        per_layer = self.robot.tendons_per_segment
        return tendon // per_layer + 1, 1 << tendon % per_layer

    def bits(self, metres: float) -> int:
        return round(metres * float(self.robot.servo_per_metre) * SERVO_BITS_PER_RAD)

    @property
    def truth(self) -> np.ndarray:
        return self.board.mechanics.displacements


@pytest.fixture
def bench(muxarm) -> Bench:
    return Bench(muxarm)


def test_powers_up_silent(bench):
    bench.wait(10.0, beating=False)
    assert bench.heard == []
    assert bench.board.next_time == math.inf
    assert bench.board.state is BoardState.SILENT


@pytest.mark.parametrize("greeted", [False, True])
@pytest.mark.parametrize("op", [Op.AXIAL, Op.ENGAGE, Op.RELEASE, Op.STAGE, Op.START, Op.DISARM])
def test_unarmed_board_refuses_to_move(muxarm, op, greeted):
    bench = Bench(muxarm, axial=1)
    if greeted:
        bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)
    else:
        bench.seq = 0  # within the sequence window of a fresh board
    assert bench.command(op, 1, 1) == (Status.REJECTED, Reason.NOT_ARMED)
    bench.wait(5.0)
    assert not bench.truth.any()
    assert bench.board.mechanics.slot == 0


def test_arming_needs_session_robot_and_heartbeat(bench):
    words = fingerprint_words(bench.robot.fingerprint)
    assert bench.command(Op.HELLO, arg=99 << 16 | SESSION) == (
        Status.REJECTED,
        Reason.WRONG_VERSION,
    )
    bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)
    assert bench.command(Op.ROBOT, 1, words[0] ^ 1) == (Status.REJECTED, Reason.WRONG_ROBOT)
    assert bench.command(Op.ROBOT, 5, words[0]) == (Status.REJECTED, Reason.WRONG_ROBOT)
    assert bench.command(Op.ARM, arg=SESSION) == (Status.REJECTED, Reason.ROBOT_UNCHECKED)
    for k, word in enumerate(words, start=1):
        bench.do(Op.ROBOT, k, word)
    assert bench.command(Op.ARM, arg=SESSION + 1) == (Status.REJECTED, Reason.WRONG_SESSION)
    assert bench.command(Op.ARM, arg=SESSION) == (Status.BUSY, Reason.NO_HEARTBEAT)
    bench.beat()
    bench.seq -= 1  # BUSY has not used the number up
    bench.do(Op.ARM, arg=SESSION)
    assert bench.board.state is BoardState.ARMED


def test_handshake_out_of_order_is_refused(bench):
    bench.seq = 0
    word = fingerprint_words(bench.robot.fingerprint)[0]
    assert bench.command(Op.ROBOT, 1, word) == (Status.REJECTED, Reason.WRONG_SESSION)
    assert bench.command(Op.ARM, arg=0) == (Status.REJECTED, Reason.WRONG_SESSION)
    bench.engage()
    assert bench.command(Op.ARM, arg=SESSION) == (Status.REJECTED, Reason.ARMED_ALREADY)
    bench.wait(WATCHDOG_S + 0.001, beating=False)
    assert bench.board.state is BoardState.SAFE
    assert bench.command(Op.HELLO, arg=VERSION << 16 | 5) == (Status.BUSY, Reason.BUSY)
    assert bench.command(Op.ARM, arg=SESSION) == (Status.REJECTED, Reason.WRONG_SESSION)
    bench.wait(0.2)
    bench.step([Frame(0x008, b"")])
    assert bench.command(Op.ROBOT, 1, word) == (Status.REJECTED, Reason.ESTOPPED)


def test_armed_board_is_not_taken_over(bench):
    bench.arm()
    assert bench.command(Op.HELLO, arg=VERSION << 16 | 5) == (
        Status.REJECTED,
        Reason.ARMED_ALREADY,
    )
    stranger = Port("HOST").pack("HOST_HB", Session=5, Watchdog=150)
    for _ in range(4):
        bench.now += 0.05
        bench.step([stranger])
    assert bench.board.state is BoardState.SAFE


def test_host_loss_stops_a_move_in_time(bench):
    bench.engage()
    bench.beat()
    bench.do(Op.STAGE, 1, bench.bits(-0.05))
    bench.command(Op.START, arg=1)
    bench.wait(0.5)
    last_beat = bench.now
    bench.wait(WATCHDOG_S + 0.05, beating=False)
    at_limit = bench.truth.copy()
    assert at_limit[0] < -1e-3
    bench.wait(5.0, beating=False)
    assert (bench.truth == at_limit).all()
    assert bench.board.state is BoardState.SAFE
    assert bench.last_ack() == (Status.ABORTED, Reason.WATCHDOG, Op.START)
    assert [h.values["Code"] for h in bench.heard if h.name == "EMCY"] == [Reason.WATCHDOG]
    assert not bench.board.mechanics.coupled
    times, points = bench.board.mechanics.trajectory(0.0)
    moved = np.abs(np.diff(points, axis=0)).max(axis=1) > 0
    assert last_beat < times[1:][moved].max() <= last_beat + WATCHDOG_S + 0.05


def test_host_loss_stops_the_axial_motor_between_slots(bench):
    bench.arm().command(Op.AXIAL, arg=5)
    bench.wait(1.0)
    bench.wait(1.0, beating=False)
    stopped = bench.board.mechanics.axial
    assert bench.board.mechanics.slot == -1
    bench.wait(5.0, beating=False)
    assert bench.board.mechanics.axial == stopped > 0


def test_estop_with_a_broken_frame_stops_and_is_latched(bench):
    bench.engage().do(Op.STAGE, 1, bench.bits(0.05))
    bench.command(Op.START, arg=1)
    bench.wait(0.5)
    bench.step([Frame(0x008, b"\xff")])
    bench.wait(bench.board.physics.brake_s)
    stopped = bench.truth.copy()
    bench.wait(2.0)
    assert (bench.truth == stopped).all()
    assert bench.board.state is BoardState.ESTOPPED
    assert not bench.board.energised
    for op in (Op.HELLO, Op.ARM, Op.AXIAL, Op.DISARM):
        assert bench.command(op, arg=VERSION << 16 | 3)[0] is Status.REJECTED
        assert bench.last_ack()[1] is Reason.ESTOPPED


def test_axial_does_not_move_while_a_clutch_is_in(bench):
    bench.engage()
    assert bench.command(Op.AXIAL, arg=2) == (Status.REJECTED, Reason.CLUTCH_IN)
    before = bench.board.mechanics.axial
    bench.wait(4.0)
    assert bench.board.mechanics.axial == before


def test_clutch_does_not_switch_while_the_axial_motor_turns(bench):
    bench.arm().command(Op.AXIAL, arg=2)
    bench.wait(0.5)
    assert bench.command(Op.ENGAGE, *bench.clutch(2)) == (Status.REJECTED, Reason.AXIAL_MOVING)
    assert bench.command(Op.RELEASE, *bench.clutch(2)) == (Status.REJECTED, Reason.AXIAL_MOVING)
    assert bench.command(Op.AXIAL, arg=3) == (Status.BUSY, Reason.BUSY)
    bench.wait(4.0)
    assert not bench.board.mechanics.coupled
    assert bench.board.mechanics.slot == 1


@pytest.mark.parametrize("op", [Op.ENGAGE, Op.RELEASE])
def test_clutch_does_not_switch_between_slots_or_during_a_move(muxarm, op):
    between = Bench(muxarm).arm()
    assert between.command(op, 0, 1) == (Status.REJECTED, Reason.NOT_IN_SLOT)
    moving = Bench(muxarm).engage()
    moving.do(Op.STAGE, 1, moving.bits(0.01))
    moving.command(Op.START, arg=1)
    moving.wait(0.5)
    assert moving.command(op, *moving.clutch(1)) == (Status.BUSY, Reason.BUSY)
    assert moving.board.mechanics.coupled == {0: 0}


def test_servo_moves_only_with_its_clutch(bench):
    bench.engage()
    assert bench.command(Op.STAGE, 2, 500) == (Status.REJECTED, Reason.NOT_COUPLED)
    bench.do(Op.STAGE, 1, bench.bits(0.001))
    assert bench.command(Op.START, arg=0b11) == (Status.REJECTED, Reason.NOT_STAGED)
    bench.do(Op.RELEASE, *bench.clutch(1), takes=0.3)
    assert bench.command(Op.START, arg=1) == (Status.REJECTED, Reason.NOT_COUPLED)
    bench.wait(1.0)
    assert np.abs(bench.truth).max() < 1e-12


@pytest.mark.parametrize(
    ("op", "idx", "arg", "reason"),
    [
        (Op.AXIAL, 0, 0, Reason.UNKNOWN_AXIAL),
        (Op.AXIAL, 0, 10, Reason.UNKNOWN_AXIAL),
        (Op.AXIAL, 0, -1, Reason.UNKNOWN_AXIAL),
        (Op.STAGE, 0, 10, Reason.UNKNOWN_SERVO),
        (Op.STAGE, 4, 10, Reason.UNKNOWN_SERVO),
        (Op.START, 0, 0, Reason.UNKNOWN_SERVO),
        (Op.START, 0, 0b1001, Reason.UNKNOWN_SERVO),
        (Op.ENGAGE, 2, 1, Reason.WRONG_LAYER),
        (Op.ENGAGE, 1, 0, Reason.UNKNOWN_CLUTCH),
        (Op.ENGAGE, 1, 0b1000, Reason.UNKNOWN_CLUTCH),
        (Op.STAGE, 1, 8_000_001, Reason.SERVO_RANGE),
        (Op.SET_STREAM, 0, 5, Reason.WRONG_SESSION),
        (99, 0, 0, Reason.UNKNOWN_OP),
    ],
)
def test_nonsense_is_rejected_with_its_reason(bench, op, idx, arg, reason):
    bench.engage()
    assert bench.command(op, idx, arg) == (Status.REJECTED, reason)


@pytest.mark.parametrize("side", [0, 1])
def test_tendon_beyond_its_range_is_refused_on_the_board(bench, side):
    bench.engage()
    limit = displacement_range(bench.robot)[0, side]
    outwards = -1 if side == 0 else 1
    beyond = bench.bits(limit + outwards * (RANGE_MARGIN_M + 2e-5))
    assert bench.command(Op.STAGE, 1, beyond) == (Status.REJECTED, Reason.TENDON_RANGE)
    bench.do(Op.STAGE, 1, bench.bits(limit))


def test_duplicate_moves_nothing(bench):
    bench.engage().do(Op.STAGE, 1, bench.bits(0.002))
    assert bench.command(Op.START, arg=1)[0] is Status.ACCEPTED
    start = bench.seq
    assert bench.command(Op.START, arg=1, seq=start)[0] is Status.DUPLICATE
    bench.wait(1.5)
    arrived = bench.truth.copy()
    assert arrived[0] == pytest.approx(0.002, abs=1e-6)
    bench.do(Op.STAGE, 1, bench.bits(0.004))
    assert bench.command(Op.START, arg=1, seq=start)[0] is Status.DUPLICATE
    bench.wait(1.5)
    assert (bench.truth == arrived).all()


def test_command_numbers_far_off_are_refused(bench):
    bench.arm()
    for seq in (bench.seq + 17, bench.seq - 40):
        assert bench.command(Op.AXIAL, arg=2, seq=seq) == (Status.REJECTED, Reason.SEQUENCE)
    bench.wait(4.0)
    assert bench.board.mechanics.slot == -1


def test_disarming_comes_to_rest_and_needs_a_new_greeting_check(bench):
    bench.engage().do(Op.STAGE, 1, bench.bits(0.05))
    bench.command(Op.START, arg=1)
    bench.wait(0.3)
    bench.do(Op.DISARM, takes=0.3)
    stopped = bench.truth.copy()
    bench.wait(2.0)
    assert (bench.truth == stopped).all()
    assert not bench.board.mechanics.coupled
    assert bench.command(Op.ARM, arg=SESSION) == (Status.REJECTED, Reason.ROBOT_UNCHECKED)


def test_wheel_streams_carry_the_quantised_displacement(robot, rng):
    held = 0.5 * rng.uniform(*displacement_range(robot).T)
    bench = Bench(robot, displacements=held)
    bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)
    bench.wait(0.05)
    sensors = Sensors(robot)
    for name, values in bench.heard:
        sensors.update(bench.now, name, values)
    step = 2 * math.pi * float(robot.wheel_radius) / COUNTS_PER_TURN
    off = np.abs(sensors.displacements() - held)
    assert sensors.complete
    assert 0 < off.max() <= step / 2 + 1e-15
    assert (bench.truth == held).all()


def test_set_stream_thins_all_but_the_heartbeat(muxarm):
    heard = {}
    for divider in (1, 10):
        bench = Bench(muxarm)
        bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)
        bench.do(Op.SET_STREAM, arg=divider)
        bench.heard.clear()
        bench.wait(2.0)
        heard[divider] = [h.name for h in bench.heard]
    for name, ratio in {"WHEEL_FB_2": 10, "SERVO_FB_1": 10, "BOARD_HB": 1}.items():
        assert heard[1].count(name) == pytest.approx(ratio * heard[10].count(name), abs=ratio)


@given(
    st.lists(
        st.tuples(st.sampled_from([0x020, 0x030, 0x031, 0x7FF]), st.binary(max_size=8)),
        max_size=30,
    )
)
@settings(max_examples=50, deadline=None)
def test_hostile_frames_never_move_or_crash_an_unarmed_board(frames):
    board = VirtualBoard(muxjax.load_robot("muxarm"), axial=1)
    for k, (frame_id, data) in enumerate(frames):
        board.step(0.1 * k, [Frame(frame_id, data)])
    board.step(20.0, [])
    assert not board.mechanics.displacements.any()
    assert board.mechanics.slot == 0
    assert board.state is not BoardState.ARMED


@pytest.mark.parametrize("seed", range(3))
def test_no_valid_command_breaks_an_interlock(robot, seed):
    """A host gone mad, but well-spoken: truth stays within every limit at every instant."""
    rng = np.random.default_rng(seed)
    bench = Bench(robot).arm()
    limits = displacement_range(robot) + np.array([-RANGE_MARGIN_M, RANGE_MARGIN_M])
    taken = 0
    for _ in range(200):
        op = rng.choice([Op.AXIAL, Op.ENGAGE, Op.RELEASE, Op.STAGE, Op.STAGE, Op.START])
        idx = int(rng.integers(0, 6)) if op is Op.STAGE else max(bench.board.layer + 1, 0)
        arg = int(rng.integers(-4, 1 << 4)) if op != Op.STAGE else bench.bits(rng.normal(0, 0.1))
        mechanics = bench.board.mechanics
        coupled, axial = dict(mechanics.coupled), mechanics.axial
        status, reason = bench.command(int(op), idx, arg)
        assert (status is Status.REJECTED) == (reason not in (Reason.NONE, Reason.BUSY))
        taken += status is Status.ACCEPTED
        if status is Status.BUSY:
            bench.seq -= 1
        bench.wait(float(rng.choice([0.01, 0.1, 0.4, 3.0])))
        assert (mechanics.displacements >= limits[:, 0]).all()
        assert (mechanics.displacements <= limits[:, 1]).all()
        assert mechanics.axial == axial or not coupled
        assert not (bench.board.axial_turning and mechanics.coupled)
    assert taken > 10


def test_visit_times_add_up_to_the_switch_time(robot):
    physics = load_physics("ideal")
    rest = physics.clutch_in_s + physics.clutch_out_s + 2 * probe_time(robot, physics)
    assert axial_time(robot, physics, 1.0) + rest == pytest.approx(float(robot.switch_time))
    slow = physics.model_copy(update={"clutch_in_s": 3.0})
    with pytest.raises(ValueError, match=r"must be below the robot's axial.switch_time_s of 3 s"):
        VirtualBoard(robot, slow)


def test_wrong_physics_and_start_are_refused(muxarm, tmp_path):
    bad = tmp_path / "bad.yaml"
    bad.write_text("schema: muxjax/hardware/1\nclutch_in_s: -1\n")
    with pytest.raises(ConfigError, match=r"clutch_in_s: .*greater than or equal to 0.*found -1"):
        load_physics(bad)
    with pytest.raises(ValueError, match="displacements: tendon 1 is at -500 mm"):
        VirtualBoard(muxarm, displacements=np.r_[-0.5, np.zeros(8)])
    with pytest.raises(ValueError, match="axial: is 1 to 9, found 10"):
        VirtualBoard(muxarm, axial=10)
