"""Servos that die on the way, and an axial motor that stands still."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import jax
import numpy as np
import pytest
from scipy.optimize import minimize

import muxjax
from muxjax.hardware import LockstepLink
from muxjax.pipeline import replan, without_axial_motor
from muxjax.planning import Problem, plan
from muxjax.tendons import bending_from_displacements

SERVO_SETS = [s for n in (1, 2, 3) for s in combinations((1, 2, 3), n)]
Q = np.array([0.9, 0.4, 0.7, 2.5, 0.6, 4.0])


def bending(robot, displacements):
    """Bending vectors in the planners' precision."""
    with jax.enable_x64(True):
        return np.asarray(bending_from_displacements(robot, displacements)).ravel()


@pytest.fixture
def target(muxarm):
    return muxjax.tendon_displacements(muxarm, Q)


def kill(link: LockstepLink, servo: int, after: int) -> None:
    """The servo's shaft stands still from the ``after``-th visit on, whatever it is told."""
    mechanics, visits = link.board.mechanics, [0]
    turn, rotate = mechanics.turn, mechanics.rotate_axial

    def weak_turn(by, duration):
        dead = visits[0] > after
        turn({s: 0.0 if dead and s == servo - 1 else a for s, a in by.items()}, duration)

    def counted(slot, duration):
        visits[0] += 1
        rotate(slot, duration)

    mechanics.turn, mechanics.rotate_axial = weak_turn, counted


@pytest.mark.parametrize("dead", [1, 2, 3])
def test_a_servo_dies_between_two_instructions_and_the_rest_arrive(muxarm, target, dead):
    first = muxjax.schedule(muxarm, plan(muxarm, Problem(np.zeros(9), target)))
    link = LockstepLink(muxarm, stream_divider=10)
    kill(link, dead, after=1)
    run = muxjax.execute(first, link)
    assert not run.completed
    assert "SERVO_STALLED" in run.reason
    assert len(run.records) == 1
    left = tuple(s for s in (1, 2, 3) if s != dead)
    rest = replan(muxarm, run, target, servos=left)
    assert rest.status == "optimal"
    program = muxjax.schedule(muxarm, rest)
    assert program.start == pytest.approx(run.measured, abs=1e-12)
    assert all(dead not in i.length_moves for i in program.instructions)
    done = muxjax.execute(program, link)
    assert done.completed
    assert link.board.mechanics.displacements == pytest.approx(target, abs=3e-5)


@pytest.mark.parametrize("servos", SERVO_SETS)
def test_every_servo_set_takes_over_after_any_instruction(muxarm, target, servos):
    whole = muxjax.schedule(muxarm, plan(muxarm, Problem(np.zeros(9), target)))
    for done in range(len(whole.instructions)):
        link = LockstepLink(muxarm, stream_divider=20)
        begun = muxjax.execute(replace(whole, instructions=whole.instructions[:done]), link)
        drum = begun.records[-1].axial if begun.records else None
        rest = replan(muxarm, begun, target, servos=servos, axial=drum, method="beamstep")
        run = muxjax.execute(muxjax.schedule(muxarm, rest), link)
        assert run.completed
        assert link.board.mechanics.displacements == pytest.approx(target, abs=3e-5)


def test_what_the_executor_leaves_alone_costs_no_stage(muxarm, target):
    rest = replan(muxarm, target + 1.4e-5, target, servos=(2,))
    assert rest.n_steps == 0
    rest = replan(muxarm, target + 4e-5, target, servos=(2,))
    assert rest.n_steps == 9


def test_a_wheel_beyond_its_range_by_rounding_is_no_obstacle(muxarm):
    from muxjax.tendons import displacement_range

    low = displacement_range(muxarm)[:, 0]
    held = np.zeros(9)
    held[0] = low[0] - 1e-5
    assert replan(muxarm, held, np.zeros(9), servos=(1,)).status == "optimal"
    held[0] = low[0] - 2e-3
    with pytest.raises(ValueError, match="measured: tendon 1 is 2 mm beyond its range"):
        replan(muxarm, held, np.zeros(9), servos=(1,))


def test_unheard_wheels_and_empty_servo_sets_are_refused(muxarm, target):
    silent = np.zeros(9)
    silent[4] = np.nan
    with pytest.raises(ValueError, match="the wheel of tendon 5 was never heard"):
        replan(muxarm, silent, target, servos=(1,))
    with pytest.raises(ValueError, match="non-empty set of servos"):
        replan(muxarm, np.zeros(9), target, servos=())
    with pytest.raises(ValueError, match="positions 1 to 9 and servos 1 to 3, found 12"):
        without_axial_motor(muxarm, np.zeros(9), target, axial=12, servos=(1,))


@pytest.mark.parametrize("servos", [(2,), (1, 3), (1, 2, 3)])
@pytest.mark.parametrize("axial", [1, 5, 9])
def test_without_the_axial_motor_the_closest_is_reached(muxarm, target, axial, servos):
    held = 0.5 * target
    found = without_axial_motor(muxarm, held, target, axial=axial, servos=servos)
    moving = [int(muxarm.axial_map[axial - 1, s - 1]) for s in servos]
    assert found.tendons == tuple(sorted(c + 1 for c in moving))
    still = [c for c in range(9) if c not in moving]
    assert (found.displacements[still] == held[still]).all()
    wanted = bending(muxarm, target)

    def distance(moved):
        displacements = held.copy()
        displacements[moving] = moved
        return np.linalg.norm(bending(muxarm, displacements) - wanted)

    assert found.bending_error < distance(held[moving])
    other = minimize(distance, held[moving], method="Nelder-Mead", options={"xatol": 1e-7})
    assert found.bending_error <= other.fun + 1e-4
    program = muxjax.schedule(muxarm, found.plan)
    assert {i.axial for i in program.instructions} == {axial}
    link = LockstepLink(muxarm, displacements=held, axial=axial, stream_divider=10)
    angle = link.board.mechanics.axial
    run = muxjax.execute(program, link)
    assert run.completed
    assert link.board.mechanics.axial == angle
    assert run.measured == pytest.approx(found.displacements, abs=3e-5)


def test_a_target_within_reach_is_reached_without_the_axial_motor(muxarm):
    q = np.array([0.9, 0.4, 0.7, 2.5, 0.6, 4.0])
    held = muxjax.tendon_displacements(muxarm, q)
    q[4:] = 0.3, 1.0  # the distal segment alone
    goal = muxjax.tendon_displacements(muxarm, q)
    axial = 1 + int(np.flatnonzero((muxarm.axial_map // 3 == 2).all(axis=1))[0])
    found = without_axial_motor(muxarm, held, goal, axial=axial, servos=(1, 2, 3))
    assert found.bending_error < 1e-5
    assert found.q == pytest.approx(q, abs=1e-4)
