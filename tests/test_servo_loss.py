"""Parts that fail on the way, on the board's own word, and what the executor makes of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_executor import program, random_program, visit
from test_resume import pass_time, run_until

from muxjax.hardware import LockstepLink, MemoryJournal, execute, load_physics, resume
from muxjax.hardware.executor import begin
from muxjax.hardware.faults import FaultConfig
from muxjax.hardware.protocol import BoardState
from muxjax.pipeline import run_to_target

END_M = 2e-5


def fault(kind: str, **when) -> FaultConfig:
    return FaultConfig.model_validate({"kind": kind, **when})


@pytest.mark.parametrize("kind", ["servo_stall", "servo_offline"])
def test_a_servo_that_dies_is_named_and_done_without(muxarm, kind):
    made, _ = random_program(muxarm, np.random.default_rng(3), 3, length=3)
    dies = fault(kind, index=2, at_op="START", nth=3, delay_s=0.4)
    link = LockstepLink(muxarm, faults=[dies], stream_divider=5)
    journal = MemoryJournal()
    run = execute(made, link, journal=journal)
    assert not run.completed
    assert run.failed_servos == (2,)
    assert not run.resumable
    assert ("SERVO_STALLED (2)" if kind == "servo_stall" else "SERVO_OFFLINE (2)") in run.reason
    assert link.board.state is BoardState.SAFE
    assert not link.board.mechanics.coupled
    done = run_to_target(link, journal)
    assert done.completed, done.reason
    assert journal.standing.program.servos == (1, 3)
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_a_servo_that_was_repaired_is_not_done_without_for_ever(muxarm):
    """One journal for program after program, as ``muxjax run --bus`` has by default."""
    made, _ = random_program(muxarm, np.random.default_rng(3), 3, length=3)
    dies = fault("servo_offline", index=2, at_op="START", nth=3, delay_s=0.4)
    link, journal = LockstepLink(muxarm, faults=[dies], stream_divider=5), MemoryJournal()
    run = run_to_target(link, journal, made)
    assert (run.completed, run.failed_servos) == (True, (2,))
    link.board.senses.offline.clear()
    link.board.mechanics.jammed.clear()
    back = program(
        muxarm,
        [visit(muxarm, 1, [{2: 0.002}]), visit(muxarm, 2, [{2: -0.002}])],
        np.array(made.target),
    )
    begin(muxarm, back, journal)
    run_until(link, journal, link.now + 4.0)
    pass_time(link, 1.0)
    run = run_to_target(link, journal)
    assert (run.completed, run.failed_servos) == (True, ())
    assert journal.standing.program == back  # no new plan
    assert link.board.mechanics.displacements == pytest.approx(np.array(back.target), abs=END_M)


def test_a_servo_that_is_dead_before_is_seen_in_the_preflight(muxarm):
    made = program(
        muxarm, [visit(muxarm, 1, [{1: 0.004, 2: -0.002}]), visit(muxarm, 2, [{2: 0.001}])]
    )
    link = LockstepLink(muxarm, faults=[fault("servo_offline", index=1, at_s=0.0)])
    run = execute(made, link)
    assert (run.completed, run.failed_servos) == (False, (1,))
    assert run.reason == "servos: [1] stalled or offline"
    assert [c.name for c in run.checks if not c.passed] == ["servos"]
    assert link.board.state is BoardState.READY
    assert run_to_target(link, MemoryJournal(), made).completed
    unused = program(muxarm, [visit(muxarm, 3, [{3: 0.001}])], np.array(made.target))
    assert execute(unused, link).completed


def test_a_low_supply_is_seen_in_the_preflight(muxarm):
    low = load_physics("ideal").model_copy(update={"supply_v": 15.0})
    run = execute(program(muxarm, [visit(muxarm, 1, [{1: 0.004}])]), LockstepLink(muxarm, low))
    assert (run.completed, run.resumable) == (False, True)
    assert run.reason == "supply: 15.0 V, at least 18 V"


def test_two_servos_die_one_after_the_other(muxarm):
    made, _ = random_program(muxarm, np.random.default_rng(4), 3, length=3)
    dies = [
        fault("servo_stall", index=1, at_op="START", nth=2, delay_s=0.3),
        fault("servo_offline", index=3, at_op="START", nth=4, delay_s=0.2),
    ]
    link = LockstepLink(muxarm, faults=dies, stream_divider=5)
    run = run_to_target(link, MemoryJournal(), made)
    assert run.completed, run.reason
    assert run.failed_servos == (1, 3)
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_the_last_servo_dies(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.01}])])
    made = dataclasses.replace(made, servos=(1,))
    dies = fault("servo_stall", index=1, at_op="START", delay_s=0.3)
    run = run_to_target(LockstepLink(muxarm, faults=[dies]), MemoryJournal(), made)
    assert (run.completed, run.failed_servos) == (False, (1,))


def test_a_dead_clutch_is_told_from_a_servo(muxarm):
    link = LockstepLink(muxarm, faults=[fault("clutch_dead", index=1, at_s=0.0)])
    run = execute(program(muxarm, [visit(muxarm, 1, [{1: 0.01, 2: 0.01}])]), link)
    assert "clutch 1 not seated after 3 tries with servo 1, nor with servo 2" in run.reason
    assert "clutch or encoder of tendon 1" in run.reason
    assert (run.resumable, run.failed_servos) == (False, ())
    assert np.abs(link.board.mechanics.displacements).max() < END_M


def test_an_encoder_that_gets_stuck_on_the_way_does_not_wind_on(muxarm):
    stuck = fault("encoder_stuck", index=1, at_op="START", delay_s=1.0)
    link = LockstepLink(muxarm, faults=[stuck])
    run = execute(program(muxarm, [visit(muxarm, 1, [{1: 0.02}])]), link)
    assert "WHEEL_STILL (1)" in run.reason
    assert "clutch or encoder of tendon 1" in run.reason
    assert not run.resumable
    assert run.failed_servos == ()
    # The board saw it within its window; of what it moved, nobody knows.
    assert link.board.mechanics.displacements[0] - run.measured[0] < 1e-3


def test_a_plug_that_jumps_out_is_put_in_again(muxarm):
    slips = fault("clutch_slip", index=1, at_op="START", delay_s=1.0)
    link = LockstepLink(muxarm, faults=[slips])
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.01, 2: -0.01}])])
    run = execute(made, link)
    assert run.completed, run.reason
    assert link.board.session == 1
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


@pytest.mark.parametrize("kind", ["brown_out", "hang"])
def test_a_board_that_restarts_is_told_its_turns(muxarm, kind):
    start = np.array([0.0, -1e-5, 0.08, 0, 0, 0, 0, -0.17, 0.2])
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.01, 2: -0.01}]), visit(muxarm, 2, [{3: 0.01}])])
    made = program(muxarm, made.instructions, start)
    link = LockstepLink(
        muxarm, displacements=start, faults=[fault(kind, at_op="START", delay_s=1.0)]
    )
    run = execute(made, link)
    assert run.completed, run.reason
    assert link.board.boots == 2
    assert run.measured == pytest.approx(np.array(made.target), abs=END_M)
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_bus_off_is_resumed_after_a_power_cycle(muxarm):
    made, _ = random_program(muxarm, np.random.default_rng(6), 2, length=3)
    link = LockstepLink(muxarm, faults=[fault("bus_off", at_op="START", nth=3, delay_s=0.2)])
    journal = MemoryJournal()
    run = execute(made, link, journal=journal)
    assert (run.completed, run.resumable) == (False, True)
    assert "heartbeat is lost" in run.reason
    link.board.power_cycle()
    pass_time(link, 2.0)
    assert resume(journal, link).completed
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_a_wheel_whose_encoder_only_flags_is_named(muxarm):
    link = LockstepLink(muxarm, faults=[fault("encoder_magnet", index=5, at_s=0.0)])
    run = execute(program(muxarm, [visit(muxarm, 1, [{1: 0.01}])]), link)
    assert run.reason == "the encoder of wheel 5 flags every sample"
    assert not run.resumable
