"""Runs that were interrupted at any instant, and gone on with."""

from __future__ import annotations

import numpy as np
import pytest
from test_executor import MortalLink, program, random_program, visit

from muxjax.hardware import LockstepLink, MemoryJournal, execute, resume, take_stock
from muxjax.hardware.executor import Executor, begin
from muxjax.hardware.journal import Journal, LegEntry, RepairEntry, ServoEntry
from muxjax.hardware.protocol import BoardState
from muxjax.pipeline import run_to_target
from muxjax.robot import Robot
from muxjax.scheduler import Program

END_M = 2e-5
PROBE_M = 2e-4  # there and back of one probe


def begun(robot: Robot, made: Program) -> MemoryJournal:
    journal = MemoryJournal()
    begin(robot, made, journal)
    return journal


def run_until(link: LockstepLink, journal: MemoryJournal, end: float) -> None:
    """A host that is killed at a time: its executor is gone, journal and board remain."""
    executor = Executor(link.robot, journal, link.new_session(), link.stream_divider)
    frames = []
    while link.now < end and not executor.finished:
        link.send(executor.step(link.now, frames))
        frames = link.wait(min(end, executor.next_time))


def pass_time(link: LockstepLink, seconds: float) -> None:
    end = link.now + seconds
    while link.now < end:
        link.wait(end)


def travel(link: LockstepLink) -> np.ndarray:
    """Way of each tendon since power-up [m]."""
    _, points = link.board.mechanics.trajectory(0.0)
    return np.abs(np.diff(points, axis=0)).sum(axis=0)


@pytest.mark.parametrize("seed", range(6))
def test_host_killed_at_random_instants_goes_on_to_the_same_lengths(muxarm, seed):
    rng = np.random.default_rng(seed)
    made, seconds = random_program(muxarm, rng, 1 + seed % 3, length=3)
    whole = LockstepLink(muxarm, stream_divider=5)
    assert execute(made, whole).completed
    link, journal = LockstepLink(muxarm, stream_divider=5), begun(muxarm, made)
    kills = 0
    for at in np.sort(rng.uniform(0.0, seconds, 3)):
        run_until(link, journal, float(at))
        kills += 1
        pass_time(link, float(rng.choice([0.0, 0.1, 1.0])))
    run = resume(journal, link)
    assert run.completed, run.reason
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)
    assert run.measured == pytest.approx(np.array(made.target), abs=END_M)
    assert (travel(link) <= travel(whole) + kills * 2 * PROBE_M).all()
    assert journal.standing.completed


def test_resume_of_a_finished_program_moves_nothing(muxarm):
    made, _ = random_program(muxarm, np.random.default_rng(2), 3)
    link, journal = LockstepLink(muxarm), MemoryJournal()
    assert execute(made, link, journal=journal).completed
    before = travel(link)
    run = resume(journal, link)
    assert run.completed
    assert run.records == ()
    assert (travel(link) == before).all()


def test_resume_after_a_cut_cable(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02, 2: -0.01}]), visit(muxarm, 2, [{3: 0.01}])])
    link, journal = MortalLink(muxarm), MemoryJournal()
    link.deaf_from = link.mute_from = 6.0
    run = execute(made, link, journal=journal)
    assert (run.completed, run.resumable) == (False, True)
    assert "heartbeat is lost" in run.reason
    link.deaf_from = link.mute_from = np.inf
    assert resume(journal, link).completed
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_a_short_outage_needs_nobody(muxarm):
    class Outage(LockstepLink):
        def send(self, frames):
            if not 6.0 < self.now < 6.4:
                super().send(frames)

        def wait(self, until):
            frames = super().wait(until)
            return [] if 6.0 < self.now < 6.4 else frames

    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02, 2: -0.01}])])
    link = Outage(muxarm)
    run = execute(made, link)
    assert run.completed, run.reason
    assert link.board.session == 1
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_the_journal_is_ahead_of_the_motion(muxarm):
    made, _ = random_program(muxarm, np.random.default_rng(4), 3, legs=3)
    journal = MemoryJournal()

    class Watch(LockstepLink):
        def wait(self, until):
            frames = super().wait(until)
            moved = np.flatnonzero(np.abs(self.board.mechanics.displacements) > 2 * PROBE_M)
            written = [e for e in journal.entries if isinstance(e, LegEntry)]
            assert set(moved + 1) <= {c for e in written for c in e.goals}
            return frames

    assert execute(made, Watch(muxarm), journal=journal).completed


def test_a_journal_that_cannot_be_written_stops_before_the_motion(muxarm):
    class Full(MemoryJournal):
        def write(self, entry, *, ahead=True):
            if isinstance(entry, LegEntry):
                raise OSError("No space left on device")
            super().write(entry, ahead=ahead)

    link = LockstepLink(muxarm)
    run = execute(program(muxarm, [visit(muxarm, 1, [{1: 0.02}])]), link, journal=Full())
    assert (run.completed, run.resumable) == (False, True)
    assert run.reason == "instruction 1: journal: No space left on device"
    assert np.abs(link.board.mechanics.displacements).max() < PROBE_M
    assert link.board.state is BoardState.READY


def test_an_arm_that_was_moved_by_hand_is_refused(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02}]), visit(muxarm, 2, [{1: 0.02}])])
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    run_until(link, journal, 14.0)
    pass_time(link, 1.0)
    link.board.mechanics._wind(8, 0.003)
    for _ in range(2):  # trying again must not make it true
        with pytest.raises(
            ValueError, match=r"lengths: tendon 9 stands 3.* from where the journal"
        ):
            resume(journal, link)


@pytest.fixture
def moved(muxarm):
    """A run of which nothing is left for tendon 9, which then slipped further than passes."""
    legs = [visit(muxarm, 3, [{3: 0.02}]), visit(muxarm, 2, [{1: 0.02}])]
    made = program(muxarm, [*legs, visit(muxarm, 3, [{3: -0.01}])])
    assert 9 in made.instructions[0].clutches
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    run_until(link, journal, 20.0)
    pass_time(link, 1.0)
    assert journal.standing.done == 1
    link.board.mechanics._wind(8, 0.003)
    return made, link, journal


def test_a_repaired_encoder_is_believed_and_the_run_comes_to_the_same_lengths(moved):
    made, link, journal = moved
    with pytest.raises(ValueError, match="--repaired-encoders"):
        resume(journal, link)
    before = travel(link)
    assert take_stock(journal, link, repaired_encoders=(9,)).completed
    assert (travel(link) == before).all()
    assert isinstance(journal.entries[-1], RepairEntry)
    assert resume(journal, link).completed
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_what_nobody_vouched_for_stays_refused(moved):
    _, link, journal = moved
    link.board.mechanics._wind(4, -0.003)
    entries = len(journal.entries)
    with pytest.raises(ValueError, match=r"lengths: tendon 5 stands 3.* mm .*, at most 2 mm"):
        run_to_target(link, journal, repaired_encoders=(9,))
    assert len([e for e in journal.entries[entries:] if isinstance(e, RepairEntry)]) == 0


def test_a_repaired_encoder_too_far_away_is_refused(moved):
    _, link, journal = moved
    link.board.mechanics._wind(8, 0.008)
    with pytest.raises(ValueError, match=r"lengths: tendon 9 stands 11 mm .*, at most 10 mm"):
        take_stock(journal, link, repaired_encoders=(9,))


def test_a_tendon_far_off_is_not_believed_in_another_turn(moved):
    """The board has lost its turns: the reading nearest to the journal may be a turn off."""
    _, link, journal = moved
    link.board.mechanics._wind(8, 0.122)
    link.board.power_cycle()
    pass_time(link, 2.0)
    with pytest.raises(ValueError, match=r"lengths: tendon 9 stands 3\d.* mm .*, at most 10 mm"):
        run_to_target(link, journal, repaired_encoders=(9,))


def test_a_repaired_tendon_that_no_instruction_moves_comes_to_its_length_by_a_new_plan(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02}]), visit(muxarm, 2, [{1: 0.02}])])
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    assert all(9 not in item.clutches for item in made.instructions)
    run_until(link, journal, 14.0)
    pass_time(link, 1.0)
    link.board.mechanics._wind(8, 0.003)
    run = run_to_target(link, journal, repaired_encoders=(9,))
    assert run.completed, run.reason
    assert [c for c in run.checks if not c.passed] == []
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_only_a_repaired_tendon_gets_a_new_length(moved):
    """Else five times a bit by hand would be far, and nobody had said that it is right."""
    _, link, journal = moved
    before = journal.standing.lengths
    link.board.mechanics._wind(4, 0.0019)
    assert take_stock(journal, link, repaired_encoders=(9,)).completed
    assert journal.standing.lengths[:8] == before[:8]
    link.board.mechanics._wind(4, 0.0019)
    with pytest.raises(ValueError, match=r"lengths: tendon 5 stands 3\.8"):
        take_stock(journal, link, repaired_encoders=(9,))


def test_a_program_that_is_refused_does_not_replace_the_one_before(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: -0.02}]), visit(muxarm, 2, [{2: 0.02}])])
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    run_until(link, journal, 14.0)
    pass_time(link, 1.0)
    journal.write(ServoEntry(servo=2, reason="stalled"))
    before = journal.standing
    with pytest.raises(ValueError, match="lengths: tendon"):  # it does not stand at the start
        execute(made, link, journal=journal)
    assert journal.standing == before
    run = run_to_target(link, journal)
    assert (run.completed, run.failed_servos) == (True, (2,))
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_stock_that_is_interrupted_leaves_the_run_as_it_was(moved):
    _, link, journal = moved
    before = journal.standing

    class Interrupted(LockstepLink):
        pressed = False

        def wait(self, until):
            if not self.pressed:
                self.pressed = True
                raise KeyboardInterrupt
            return super().wait(until)

    other = Interrupted(link.robot, displacements=link.board.mechanics.displacements)
    assert take_stock(journal, other, repaired_encoders=(9,)).interrupted
    assert journal.standing == before


def test_believing_says_what_it_cannot_do(moved):
    made, link, journal = moved
    with pytest.raises(ValueError, match="repaired_encoders: tendons are 1 to 9, found 0"):
        take_stock(journal, link, repaired_encoders=(0, 9))
    with pytest.raises(ValueError, match="only for going on"):
        run_to_target(link, journal, made, repaired_encoders=(9,))
    with pytest.raises(ValueError, match="journal: holds no program"):
        take_stock(MemoryJournal(), link, repaired_encoders=(9,))
    link.board.senses.encoders.broken[8] = 2
    run = run_to_target(link, journal, repaired_encoders=(9,))
    assert (run.completed, run.resumable) == (False, False)
    assert run.reason == "the encoder of wheel 9 flags every sample"


def test_a_new_plan_begins_where_the_wheels_are_not_where_the_journal_left_them(muxarm):
    made = program(muxarm, [visit(muxarm, 3, [{3: 0.02}]), visit(muxarm, 2, [{1: 0.02}])])
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    run_until(link, journal, 20.0)
    pass_time(link, 1.0)
    assert journal.standing.done == 1
    journal.write(ServoEntry(servo=1, reason="stalled"))  # and the host died before it looked
    link.board.mechanics._wind(8, 0.001)  # the clutch of a tendon that was where it should be
    run = run_to_target(link, journal)
    assert run.completed, run.reason
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_a_board_that_lost_its_turns_does_not_spoil_the_journal(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: -0.02}]), visit(muxarm, 2, [{1: 0.02}])])
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    run_until(link, journal, 14.0)
    before = journal.standing.lengths
    assert before[0] == pytest.approx(-0.02, abs=END_M)  # in the turn below the one of 0
    link.board.power_cycle()
    link.board.senses.encoders.broken[4] = 2
    pass_time(link, 2.0)
    run = resume(journal, link)
    assert run.reason == "the encoder of wheel 5 flags every sample"
    assert journal.standing.lengths == before
    assert np.isnan(run.measured).all()
    link.board.senses.encoders.broken.clear()
    assert resume(journal, link).completed
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_an_unfinished_journal_takes_no_other_program(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02}])])
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    run_until(link, journal, 6.0)
    with pytest.raises(ValueError, match="journal: holds a program that is not finished"):
        execute(made, link, journal=journal)
    never_armed = begun(muxarm, program(muxarm, [visit(muxarm, 2, [{1: 0.02}])]))
    assert execute(made, LockstepLink(muxarm), journal=never_armed).completed
    with pytest.raises(ValueError, match="journal: holds no program"):
        resume(MemoryJournal(), LockstepLink(muxarm))


def test_a_host_that_died_a_moment_ago_is_waited_for(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02}])])
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    run_until(link, journal, 6.0)
    assert link.board.state is BoardState.ARMED
    assert resume(journal, link).completed


def test_a_host_that_lives_keeps_its_board(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02}])])
    link, journal = LockstepLink(muxarm), begun(muxarm, made)
    run_until(link, journal, 6.0)

    class Shared(LockstepLink):
        def __init__(self):
            self.__dict__.update(link.__dict__)

        def wait(self, until):
            self.board._host_heard = self.board.mechanics.time
            return super().wait(until)

    run = execute(made, Shared())
    assert run.reason == "HELLO: the board is armed by another host that lives"
    assert link.board.state is BoardState.ARMED


def test_a_file_serves_as_journal(muxarm, tmp_path):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02}]), visit(muxarm, 2, [{2: 0.01}])])
    link = LockstepLink(muxarm)
    with Journal.open(tmp_path / "j") as journal:
        for entry in begun(muxarm, made).entries:
            journal.write(entry)
        run_until(link, journal, 8.0)
    with Journal.open(tmp_path / "j") as journal:
        assert resume(journal, link).completed
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)
