"""A short campaign; the judge sees what it is there for.

The long one: ``python -m tests.campaigns --runs 10000 --seed 0 --workers 2``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_virtual_board import SESSION, Bench

from muxjax.hardware import VirtualBoard
from muxjax.hardware.faults import FaultConfig, FaultKind
from muxjax.hardware.protocol import Op, Port
from tests.campaigns.campaign import run
from tests.campaigns.judge import Judge
from tests.campaigns.scenario import LASTING, PASSING, draw

RUNS = 5


@pytest.mark.parametrize("seed", range(RUNS))
def test_random_program_under_random_faults(muxarm, seed):
    verdict = run(muxarm, draw(muxarm, seed))
    assert not verdict.offences, (verdict.offences, verdict.steps)
    assert verdict.ending in ("completed", "safe")


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1000, 1200, 25))
def test_more_of_the_same(muxarm, first):
    for seed in range(first, first + 25):
        verdict = run(muxarm, draw(muxarm, seed))
        assert not verdict.offences, (seed, verdict.offences, verdict.steps)


def test_a_wheel_that_one_noisy_reading_takes_for_right_is_looked_at_again(muxarm):
    """Found by a long campaign: left 0.0205 mm off when a single reading decided."""
    verdict = run(muxarm, draw(muxarm, 9554))
    assert not verdict.offences, (verdict.offences, verdict.steps)


def test_a_tendon_that_slipped_unseen_while_its_encoder_stuck_comes_to_its_length(muxarm):
    """Found by a long campaign: five slips of a clutch are more than the journal lets pass."""
    verdict = run(muxarm, draw(muxarm, 3953))
    assert verdict.ending == "safe"
    assert not verdict.offences, (verdict.offences, verdict.steps)


def test_a_seed_plays_the_same_again(muxarm):
    one, two = (run(muxarm, draw(muxarm, 11)) for _ in range(2))
    assert one == two
    assert one.steps


def test_every_kind_of_fault_is_drawn(muxarm):
    drawn = {f.kind for seed in range(120) for f in draw(muxarm, seed).faults}
    assert drawn == set(FaultKind) == set(PASSING) | set(LASTING)


def test_a_board_without_its_watchdog_is_found(muxarm, monkeypatch):
    monkeypatch.setattr(VirtualBoard, "_watchdog_end", math.inf)
    killed = [seed for seed in range(40) if draw(muxarm, seed).kills][:8]
    offences = (o for seed in killed for o in run(muxarm, draw(muxarm, seed)).offences)
    assert any("after the host" in o for o in offences)


@pytest.mark.parametrize(
    ("kind", "index", "true", "false"),
    [
        ("servo_offline", 2, "SERVO_OFFLINE (2)", "SERVO_OFFLINE (3)"),
        (
            "servo_stall",
            2,
            "servos: [1, 2] stalled or offline",
            "servos: [1, 3] stalled or offline",
        ),
        (
            "clutch_dead",
            4,
            "clutch 4 not seated after 3 tries",
            "clutch 5 not seated after 3 tries",
        ),
        ("clutch_stuck", 4, "NOT_RELEASED, clutches [4] are", "NOT_RELEASED, clutches [5] are"),
        ("encoder_stuck", 4, "WHEEL_STILL (4)", "SERVO_STALLED (4)"),
        (
            "encoder_magnet",
            4,
            "the encoder of wheel 4 flags",
            "tendon 4: its wheel is 3 counts off",
        ),
    ],
)
def test_a_reason_is_true_if_it_names_what_lasts_and_where(muxarm, kind, index, true, false):
    broken = FaultConfig(kind=kind, index=index, at_s=1.0)
    scenario = replace(draw(muxarm, 0), faults=(broken,))
    assert scenario.explains(true)
    assert not scenario.explains(false)
    passing = replace(draw(muxarm, 0), faults=(broken.model_copy(update={"for_s": 1.0}),))
    assert not passing.explains(true)


# The judge


def judged(robot, **board) -> tuple[Bench, Judge]:
    bench = Bench(robot, axial=1, **board)
    return bench, Judge(bench.board, 0.0)


def beat(bench: Bench) -> None:
    bench.step([bench.port.pack("HOST_HB", Armed=1, Session=SESSION, Watchdog=150)])


def test_an_honest_move_offends_nobody(muxarm):
    bench, judge = judged(muxarm)
    bench.engage()
    beat(bench)
    bench.do(Op.STAGE, 1, bench.bits(0.003))
    bench.do(Op.START, arg=1, takes=2.0)
    bench.do(Op.RELEASE, *bench.clutch(1), takes=0.5)
    bench.do(Op.AXIAL, arg=2, takes=3.0)
    assert judge.offences == {}
    assert judge.travel[0] == pytest.approx(0.003, abs=1e-6)
    assert judge.engaged.tolist() == [1] + 8 * [0]


def test_way_done_twice_counts_twice(muxarm):
    bench, judge = judged(muxarm)
    bench.engage()
    for goal in (0.003, 0.0, 0.003):
        bench.do(Op.STAGE, 1, bench.bits(goal))
        bench.do(Op.START, arg=1, takes=2.0)
    assert judge.travel[0] == pytest.approx(0.009, abs=1e-5)


def test_motion_of_a_board_that_nobody_armed_is_seen(muxarm):
    bench, judge = judged(muxarm)
    bench.board.mechanics.turn({0: 1.0}, 0.5)
    bench.step()
    bench.now = 0.2
    bench.step()
    assert set(judge.offences) == {"motion although not armed", "motion inf ms after the host"}


def test_a_drum_that_turns_with_a_clutch_in_is_seen(muxarm):
    bench, judge = judged(muxarm)
    bench.engage()
    bench.board.mechanics.rotate_axial(1, 0.5)
    bench.wait(0.1)
    assert {k for k in judge.offences if "axial motor turned" in k} == {
        "the axial motor turned with clutches in",
        "the axial motor turned with coils energised",
    }


def test_a_clutch_that_switches_while_the_drum_turns_is_seen(muxarm):
    bench, judge = judged(muxarm)
    bench.arm().command(Op.AXIAL, arg=3)
    bench.wait(0.5)
    bench.board.energised.add(0)
    bench.wait(0.1)
    assert "a clutch switched while the axial motor turned" in judge.offences


def test_a_tendon_beyond_its_range_is_seen(muxarm):
    bench, judge = judged(muxarm)
    bench.engage()
    bench.board.limits = bench.board.limits * 2
    high = float(judge._high[0])
    bench.do(Op.STAGE, 1, bench.bits(high + 0.002))
    bench.do(Op.START, arg=1, takes=high / float(muxarm.tendon_speed) + 2.0)
    assert any(k.startswith("tendon 1 beyond its range") for k in judge.offences)


def test_motion_too_long_after_the_last_heartbeat_is_seen(muxarm, monkeypatch):
    monkeypatch.setattr("muxjax.hardware.virtual_board.WATCHDOG_S", 0.4)
    bench, judge = judged(muxarm)
    bench.engage()
    bench.do(Op.STAGE, 1, bench.bits(0.03))
    bench.port = Port("HOST")
    bench.step([bench.port.pack("HOST_HB", Armed=1, Session=SESSION, Watchdog=255)])
    bench.command(Op.START, arg=1)
    bench.wait(1.0, beating=False)
    assert any("after the host" in k for k in judge.offences)
    assert np.isfinite(judge._heard_at)
