"""The virtual board's physics and faults: what the truth does, and what the sensors say of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_virtual_board import SESSION, Bench

from muxjax.config import ConfigError
from muxjax.hardware.bus import FRAME_BITS, Bus, BusConfig
from muxjax.hardware.encoders import COUNTS_PER_RAD, EncoderCalibration, Encoders, load_calibration
from muxjax.hardware.faults import FaultConfig, FaultKind
from muxjax.hardware.motion import Motion, fastest, ramp
from muxjax.hardware.physics import load_physics
from muxjax.hardware.protocol import (
    COUNTS_PER_TURN,
    VERSION,
    BoardState,
    Fault,
    Frame,
    Op,
    Port,
    Reason,
    Status,
    fingerprint_words,
)
from muxjax.robot import Robot

COUNT_M = 2 * math.pi * 0.025 / COUNTS_PER_TURN


def ideal_but(**sections: dict) -> object:
    """Ideal physics with some sections of others."""
    physics = load_physics("ideal")
    return physics.model_validate({**physics.model_dump(by_alias=True), **sections})


def fault(kind: str, **fields: object) -> FaultConfig:
    return FaultConfig(kind=kind, **fields)


def moving(robot: Robot, *faults: FaultConfig, physics: object = "ideal", by: float = -0.05):
    """A bench with a long move of tendon 1 under way since 0.5 s."""
    bench = Bench(robot, physics=physics, faults=faults, seed=3)
    bench.engage()
    bench.beat()
    bench.do(Op.STAGE, 1, bench.bits(by))
    assert bench.command(Op.START, arg=1)[0] is Status.ACCEPTED
    bench.wait(0.5)
    return bench


def emergencies(bench: Bench) -> list[tuple[Reason, int]]:
    told = [h.values for h in bench.heard if h.name == "EMCY"]
    return [(Reason(v["Code"]), v["Index"]) for v in told]


@pytest.mark.parametrize(
    ("kind", "index", "reason", "told"),
    [
        ("servo_stall", 1, Reason.SERVO_STALLED, 1),
        ("servo_offline", 1, Reason.SERVO_OFFLINE, 1),
        ("clutch_slip", 1, Reason.WHEEL_STILL, 1),
        ("encoder_stuck", 1, Reason.WHEEL_STILL, 1),
        ("encoder_parity", 1, Reason.ENCODER_FAULT, 1),
        ("encoder_magnet", 1, Reason.ENCODER_FAULT, 1),
        ("coil_heat", None, Reason.COIL_HOT, 0),
        ("undervoltage", None, Reason.UNDERVOLTAGE, 0),
    ],
)
def test_a_part_that_fails_stops_the_board_with_its_name(muxarm, kind, index, reason, told):
    bench = moving(muxarm, fault(kind, index=index, at_op="START", delay_s=0.3))
    bench.wait(1.0)
    stopped = bench.truth.copy()
    bench.wait(2.0)
    assert bench.board.state is BoardState.SAFE
    assert emergencies(bench) == [(reason, told)]
    assert bench.last_ack() == (Status.ABORTED, reason, Op.START)
    assert (bench.truth == stopped).all()
    assert abs(stopped[0]) < 0.005
    assert not bench.board.mechanics.coupled


@pytest.mark.parametrize("kind", ["servo_stall", "servo_offline"])
def test_a_dead_servo_that_is_not_used_stops_nothing(muxarm, kind):
    bench = moving(muxarm, fault(kind, index=2, at_s=0.1), by=0.002)
    bench.wait(2.0)
    assert bench.last_ack()[0] is Status.DONE
    bit = 4 if kind == "servo_stall" else 8
    states = [h.values["Status"] for h in bench.heard if h.name == "SERVO_FB_2"]
    assert (states[-1] & 8 == 8) == (bit == 8)


def test_a_dead_servo_is_named_when_it_is_to_engage(muxarm):
    bench = Bench(muxarm, faults=[fault("servo_stall", index=1, at_s=0.0)])
    bench.arm().do(Op.AXIAL, arg=1, takes=3.0)
    bench.command(Op.ENGAGE, *bench.clutch(1))
    bench.wait(0.5)
    assert emergencies(bench) == [(Reason.SERVO_STALLED, 1)]
    assert bench.board.faults & Fault.SERVO


def test_single_parity_errors_are_flagged_and_bridged(muxarm):
    bench = moving(muxarm, physics=ideal_but(encoder={"parity_rate": 0.05}), by=0.004)
    bench.wait(3.0)
    assert bench.last_ack()[0] is Status.DONE
    flags = [h.values[f"Status{k}"] for h in bench.heard if "WHEEL_FB" in h.name for k in (1, 2, 3)]
    assert 0.02 < np.mean(flags) < 0.1


@pytest.mark.parametrize("kind", ["brown_out", "hang"])
def test_a_reset_stops_within_the_horizon_and_loses_the_turns(muxarm, kind):
    bench = moving(muxarm, fault(kind, at_op="START", delay_s=0.5))
    physics = bench.board.physics
    at_fault = bench.truth.copy()
    bench.wait(physics.controller.horizon_s)
    stopped = bench.truth.copy()
    assert at_fault[0] > stopped[0] > at_fault[0] - 0.1e-3
    bench.heard.clear()
    bench.ears = Port("HOST")  # the board's counters begin anew
    bench.wait(2.0)
    assert (bench.truth == stopped).all()
    assert bench.heard == []
    assert bench.board.state is BoardState.SILENT
    assert not bench.board.mechanics.coupled
    bench.seq = 0
    bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)
    bench.wait(0.1)
    beat = next(h.values for h in bench.heard if h.name == "BOARD_HB")
    assert (beat["BootCount"], beat["Faults"]) == (2, Fault.TURNS_LOST)
    for k, word in enumerate(fingerprint_words(muxarm.fingerprint), start=1):
        bench.do(Op.ROBOT, k, word)
    assert bench.command(Op.ARM, arg=SESSION) == (Status.REJECTED, Reason.TURNS_UNKNOWN)
    true_turns = np.floor(stopped / (2 * math.pi * 0.025)).astype(int)
    bench.wait(0.5)
    turns = [h.values for h in bench.heard if h.name == "WHEEL_TURNS"][-1]
    assert not any(turns[f"Turns{k}"] for k in range(1, 7))
    for wheel, whole in enumerate(true_turns.tolist(), start=1):
        bench.do(Op.TURNS, arg=wheel << 16 | whole & 0xFFFF)
    bench.do(Op.ARM, arg=SESSION)
    assert not bench.board.faults & Fault.TURNS_LOST
    assert bench.board.senses.displacements() == pytest.approx(stopped, abs=COUNT_M)
    assert bench.board.slot == -1


@pytest.mark.parametrize(
    ("kind", "reason"),
    [("undervoltage", Reason.UNDERVOLTAGE), ("coil_heat", Reason.COIL_HOT)],
)
def test_a_board_that_would_stop_at_once_is_not_armed(muxarm, kind, reason):
    bench = Bench(muxarm, faults=[fault(kind, at_s=0.0, for_s=3.0)])
    bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)
    for k, word in enumerate(fingerprint_words(muxarm.fingerprint), start=1):
        bench.do(Op.ROBOT, k, word)
    bench.wait(2.5)
    assert bench.command(Op.ARM, arg=SESSION) == (Status.REJECTED, reason)
    bench.wait(400.0 if kind == "coil_heat" else 1.0)
    bench.do(Op.ARM, arg=SESSION)


def test_turns_are_not_told_to_an_armed_or_stopped_board(muxarm):
    bench = Bench(muxarm).arm()
    assert bench.command(Op.TURNS, arg=1 << 16) == (Status.REJECTED, Reason.ARMED_ALREADY)
    bench.step([Frame(0x008, b"")])
    assert bench.command(Op.TURNS, arg=1 << 16) == (Status.REJECTED, Reason.ESTOPPED)


def test_turns_are_told_only_where_they_were_lost_and_within_the_range(muxarm):
    bench = Bench(muxarm)
    bench.seq = 0
    assert bench.command(Op.TURNS, arg=1 << 16) == (Status.REJECTED, Reason.WRONG_SESSION)
    bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)
    assert bench.command(Op.TURNS, arg=1 << 16 | 1) == (Status.REJECTED, Reason.TURNS_UNKNOWN)
    bench.do(Op.TURNS, arg=1 << 16)
    bench.board.power_cycle()
    bench.wait(1.0)
    bench.ears = Port("HOST")  # the board's counters begin anew
    bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)
    assert bench.command(Op.TURNS, arg=10 << 16) == (Status.REJECTED, Reason.TURNS_UNKNOWN)
    assert bench.command(Op.TURNS, arg=1 << 16 | 5) == (Status.REJECTED, Reason.TENDON_RANGE)
    for wheel in range(1, 10):
        bench.do(Op.TURNS, arg=wheel << 16)
    assert not bench.board.senses.unknown


def test_power_up_ends_an_emergency_stop(bench_of_one):
    bench = bench_of_one
    bench.step([Frame(0x008, b"")])
    assert bench.board.state is BoardState.ESTOPPED
    bench.board.power_cycle()
    bench.wait(1.0)
    assert bench.board.state is BoardState.SILENT


@pytest.fixture
def bench_of_one(muxarm) -> Bench:
    return Bench(muxarm).arm()


def test_bus_off_lasts_until_power_up_and_a_cable_is_put_back(muxarm):
    for kind, back in (("cable", True), ("bus_off", False)):
        bench = Bench(muxarm, faults=[fault(kind, at_s=1.0, for_s=1.0)]).arm()
        bench.wait(1.5)
        assert bench.board.state is BoardState.SAFE
        bench.heard.clear()
        bench.wait(2.0)
        assert bool(bench.heard) is back
        bench.board.power_cycle()
        bench.wait(1.0)
        bench.ears = Port("HOST")
        bench.do(Op.HELLO, arg=VERSION << 16 | SESSION)


def test_a_stuck_plug_is_noticed_before_the_drum_turns(muxarm):
    bench = Bench(muxarm, faults=[fault("clutch_stuck", index=1, at_s=0.0)]).engage()
    bench.command(Op.RELEASE, *bench.clutch(1))
    bench.wait(0.5)
    assert bench.last_ack()[:2] == (Status.ABORTED, Reason.NOT_RELEASED)
    bench.do(Op.DISARM, takes=0.3)
    bench.arm().command(Op.AXIAL, arg=5)
    before = bench.board.mechanics.axial
    bench.wait(4.0)
    assert bench.last_ack() == (Status.ABORTED, Reason.NOT_RELEASED, Op.AXIAL)
    assert bench.board.mechanics.axial == before
    assert bench.command(Op.AXIAL, arg=5) == (Status.REJECTED, Reason.CLUTCH_IN)


def test_dead_clutch_does_not_seat(muxarm):
    bench = Bench(muxarm, faults=[fault("clutch_dead", index=1, at_s=0.0)])
    bench.arm().do(Op.AXIAL, arg=1, takes=3.0)
    bench.command(Op.ENGAGE, *bench.clutch(1))
    bench.wait(0.5)
    assert bench.last_ack()[:2] == (Status.ABORTED, Reason.NOT_SEATED)


def test_plugs_find_their_slot_by_the_oscillation(muxarm):
    slots = {"slot_pitch_deg": 120, "slot_window_deg": 4, "miss_rate": 0.0}
    seated = []
    for seed in range(12):
        bench = Bench(muxarm, physics=ideal_but(clutch=slots, probe_angle_deg=30.0), seed=seed)
        bench.arm().do(Op.AXIAL, arg=1, takes=3.0)
        bench.command(Op.ENGAGE, *bench.clutch(1))
        bench.wait(0.6)
        seated.append((bool(bench.board.mechanics.coupled), bench.last_ack()[1]))
    assert (True, Reason.NONE) in seated  # near its slot
    assert (False, Reason.NOT_SEATED) in seated  # beyond the sweep
    assert (False, Reason.NONE) not in seated


@pytest.mark.parametrize("seen", [True, False])
def test_a_switch_changes_a_tendon_with_or_without_its_wheel(muxarm, seen):
    slip = {"slip_seen_m" if seen else "slip_unseen_m": 0.0005}
    bench = Bench(muxarm, physics=ideal_but(clutch=slip)).engage()
    mechanics = bench.board.mechanics
    assert 0.4e-3 - 1e-9 <= abs(bench.truth[0]) <= 0.6e-3 + 1e-9
    assert bool(abs(mechanics.wheels[0]) > 0.3e-3) is seen
    assert not bench.truth[1:].any()
    times, points = mechanics.trajectory(0.0)
    assert not points[times < times[np.argmax(points[:, 0] != 0)], 0].any()  # a jump, no slope
    sensed = bench.board.senses.displacements()
    assert sensed == pytest.approx(mechanics.wheels, abs=COUNT_M)


def test_the_wheel_lags_by_the_play_alone(muxarm):
    bench = Bench(muxarm, physics=ideal_but(servo={"backlash_m": 0.2e-3}, probe_angle_deg=90.0))
    bench.engage()
    lags = []
    for goal in (0.003, 0.001, 0.002):
        bench.do(Op.STAGE, 1, bench.bits(goal))
        bench.do(Op.START, arg=1, takes=2.0)
        lags.append(bench.truth[0] - goal)
    assert lags[0] == pytest.approx(lags[2], abs=1e-6)
    assert lags[1] - lags[0] == pytest.approx(0.2e-3, abs=1e-6)


def test_inertia_takes_time_and_ends_in_the_same_place(muxarm):
    slow = ideal_but(servo={"acceleration_rad_s2": 20.0}, probe_angle_deg=30.0)
    bench = moving(muxarm, physics=slow, by=0.004)
    bench.wait(4.0)
    assert bench.truth[0] == pytest.approx(0.004, abs=1e-6)
    times, points = bench.board.mechanics.trajectory(0.0)
    speed = np.diff(points[:, 0]) / np.maximum(np.diff(times), 1e-12)
    kept = np.diff(times) > 1e-6
    rise = np.diff(speed[kept]) / np.diff(times[1:][kept])
    limit = 20.0 / float(muxarm.servo_per_metre)
    assert np.abs(speed[kept]).max() <= float(muxarm.tendon_speed) * (1 + 1e-6)
    assert np.median(np.abs(rise[np.abs(rise) > 1e-6])) == pytest.approx(limit, rel=0.3)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_motion_has_the_area_of_its_speed(share):
    motion = Motion(1.0, 2.0, 2 * share, 2 * share)
    times = np.linspace(0.5, 3.5, 3001)
    done = np.array([motion.done(t) for t in times])
    speed = np.array([motion.speed(t) for t in times])
    assert done[0] == 0.0
    assert done[-1] == 1.0
    assert np.gradient(done, times)[5:-5] == pytest.approx(
        speed[5:-5], abs=0.26 if not share else 5e-3
    )


def test_fastest_motion_obeys_both_limits():
    for way in (0.1, 1.0, 20.0):
        lasts = fastest(way, 5.0, 10.0)
        motion = Motion(0.0, lasts, ramp(lasts, 5.0, 10.0), ramp(lasts, 5.0, 10.0))
        top = way * max(motion.speed(t) for t in np.linspace(0, lasts, 999))
        assert top <= 5.0 * (1 + 1e-9)
        assert top / motion.ramp_in == pytest.approx(10.0, rel=0.01)


def test_calibration_takes_the_smooth_error_away():
    encoders = Encoders(9, 14, 0.8, 0.2, 0.0, np.random.default_rng(4))
    angles = np.random.default_rng(5).uniform(-20, 20, (200, 9))
    raw = [encoders.read(encoders.seen(a)) - a * COUNTS_PER_RAD for a in angles]
    encoders.calibration = encoders.measure(64)
    corrected = [encoders.read(encoders.seen(a)) - a * COUNTS_PER_RAD for a in angles]
    worst = np.abs(raw).max() * 360 / COUNTS_PER_TURN
    assert 0.4 < worst < 0.9
    assert np.abs(corrected).max() < 3.0
    assert np.sqrt(np.mean(np.square(corrected))) < 0.8


def test_calibration_file_round_trip_and_refusals(tmp_path):
    path = tmp_path / "wheels.yaml"
    path.write_text("schema: muxjax/encoders/1\nerror_deg: [[0, 0.1, 0, -0.1], [0, 0, 0, 0]]\n")
    table = load_calibration(path)
    quarter = COUNTS_PER_TURN / 4
    assert table.correct(np.array([quarter, quarter])) == pytest.approx(
        [quarter - 0.1 * COUNTS_PER_TURN / 360, quarter]
    )
    with pytest.raises(ValueError, match="same number of angles, at least 4, found"):
        EncoderCalibration(schema="muxjax/encoders/1", error_deg=((0, 0, 0, 0), (0, 0, 0)))


def test_the_servos_are_told_in_their_slots(muxarm):
    bench = moving(muxarm, physics=ideal_but(servo={"uart_period_s": 0.02}))
    times, points = bench.board.mechanics.trajectory(0.0)
    begins = times[1:][np.diff(np.abs(np.diff(points[:, 0])) > 0, prepend=False)]
    assert len(begins)
    bench.wait(0.3, beating=False)
    bench.wait(1.0, beating=False)
    times, points = bench.board.mechanics.trajectory(0.0)
    last = times[1:][np.abs(np.diff(points[:, 0])) > 0].max()
    watchdog = next(h.values for h in bench.heard if h.name == "EMCY")["Detail"] * 1e-3
    assert watchdog < last <= watchdog + 0.05


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"kind": "hang"}, "exactly one of at_s, at_op, rate_hz says when, found"),
        ({"kind": "hang", "at_s": 1, "rate_hz": 1}, "exactly one of"),
        ({"kind": "hang", "at_op": "JUMP"}, "at_op: is one of HELLO, .*found 'JUMP'"),
        ({"kind": "hang", "at_s": 1, "index": 2}, "index: hang has no servo or tendon"),
        ({"kind": "flood", "at_s": 1}, "kind"),
    ],
)
def test_wrong_faults_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        FaultConfig(**fields)


def test_a_fault_beyond_the_robot_is_refused(muxarm):
    with pytest.raises(ValueError, match="servo_stall: index is 1 to 3, found 4"):
        Bench(muxarm, faults=[fault("servo_stall", index=4, at_s=0.0)])


@pytest.mark.parametrize("name", ["realistic", "harsh"])
def test_shipped_physics_load_and_unknown_keys_are_refused(name, tmp_path):
    physics = load_physics(name)
    assert physics.bus.bit_rate == 1e6
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("schema: muxjax/hardware/1\nservo: {backlash: 1}\n")
    with pytest.raises(ConfigError, match=r"servo.backlash"):
        load_physics(wrong)


def test_every_kind_of_fault_can_happen_at_random(muxarm):
    """And the same seed makes the same faults."""
    faults = [fault(kind.value, rate_hz=0.2, for_s=0.3) for kind in FaultKind]
    ends = []
    for _ in range(2):
        bench = Bench(muxarm, physics="harsh", faults=faults, seed=9)
        bench.step([bench.port.pack("CMD", Seq=1, Op=Op.HELLO, Arg=VERSION << 16 | SESSION)])
        bench.wait(20.0)
        ends.append((bench.board.boots, bench.board.coils.temperature, len(bench.heard)))
    assert ends[0] == ends[1]
    assert ends[0][0] > 2


# The bus


def frame(frame_id: int) -> Frame:
    return Frame(frame_id, bytes(8))


def test_the_lowest_id_goes_first_and_frames_take_their_time():
    bus = Bus(BusConfig(bit_rate=1e6), 0.0, np.random.default_rng(0))
    one = FRAME_BITS * 1e-6
    bus.send(0.0, False, [frame(0x058), frame(0x059), frame(0x031)])
    assert bus.next_time == pytest.approx(one)
    bus.take(0.1 * one)  # the answer is on the wire
    bus.send(0.5 * one, True, [frame(0x030)])
    arrived = []
    while bus.next_time < math.inf:
        now = bus.next_time
        board, host = bus.take(now)
        arrived.append((round(now / one, 6), [f.id for f in board], [f.id for f in host]))
    assert arrived == [
        (1.0, [], [0x031]),
        (2.0, [0x030], []),
        (4.0, [], [0x058, 0x059]),
    ]
    assert bus.busy_s == pytest.approx(4 * one)


@pytest.mark.parametrize("trouble", ["loss", "doubling", "corruption", "delay"])
def test_troubles_of_the_bus_have_their_rates(trouble):
    config = BusConfig(**{trouble: 0.1}, delay_s=1.0)
    bus = Bus(config, 1e-4, np.random.default_rng(1))
    got: list[list[Frame]] = []
    late = 0
    for k in range(4000):
        bus.send(float(k), False, [frame(0x058)])
        at_once, later = bus.take(k + 2e-4)[1], bus.take(k + 0.9999999)[1]
        got.append(at_once + later)
        late += bool(later)
    rates = {
        "loss": np.mean([not copies for copies in got]),
        "doubling": np.mean([len(copies) == 2 for copies in got]),
        "corruption": np.mean([any(f.data != bytes(8) for f in copies) for copies in got]),
        "delay": late / 4000,
    }
    assert rates.pop(trouble) == pytest.approx(0.1, abs=0.02)
    assert not any(rates.values())
