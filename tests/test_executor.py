"""Programs on the virtual board: time, place, refusals, and trouble on the way."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterable

import numpy as np
import pytest

import muxjax
from muxjax.config import RobotConfig
from muxjax.hardware import BusLink, LockstepLink, VirtualBoard, execute
from muxjax.hardware.protocol import BoardState, Frame
from muxjax.hardware.serving import BusWire, serve
from muxjax.hardware.visits import load_visits, motions
from muxjax.robot import Robot, robot_from_config
from muxjax.scheduler import Instruction, Program
from muxjax.tendons import displacement_range

END_M = 2e-5


def visit(robot: Robot, axial: int, via: list[dict[int, float]]) -> Instruction:
    facing = robot.axial_map[axial - 1]
    ratio = float(robot.servo_per_metre)
    return Instruction(
        axial=axial,
        clutches=tuple(sorted(int(facing[s - 1]) + 1 for s in via[-1])),
        servo_angles={s: m * ratio for s, m in via[-1].items()},
        length_moves=dict(via[-1]),
        via=tuple(via),
    )


def program(
    robot: Robot, instructions: Iterable[Instruction], start: np.ndarray | None = None
) -> Program:
    start = np.zeros(robot.n_tendons) if start is None else start
    end = start.copy()
    instructions = tuple(instructions)
    for item in instructions:
        for servo, move in item.length_moves.items():
            end[robot.axial_map[item.axial - 1, servo - 1]] += move
    return Program(
        robot=robot.config.name,
        fingerprint=robot.fingerprint,
        start=tuple(start.tolist()),
        target=tuple(end.tolist()),
        axial=None,
        servos=tuple(range(1, robot.tendons_per_segment + 1)),
        instructions=instructions,
    )


def random_program(
    robot: Robot, rng: np.random.Generator, servos: int, length: int = 4, legs: int = 2
) -> tuple[Program, float]:
    """A program over neighbouring slots never visited twice in a row, and its time by Eq. 14."""
    limits = 0.2 * displacement_range(robot)
    held, seconds, axial = np.zeros(robot.n_tendons), 0.0, 0
    instructions = []
    for _ in range(length):
        axial = (axial + int(rng.integers(1, len(robot.axial_map)))) % len(robot.axial_map)
        chosen = rng.permutation(robot.tendons_per_segment)[:servos]
        tendons = robot.axial_map[axial, chosen]
        points = rng.uniform(*limits[tendons].T, (legs, servos))
        path = np.vstack([held[tendons], points])
        via = [
            {int(s) + 1: float(m) for s, m in zip(chosen, row, strict=True)}
            for row in points - held[tendons]
        ]
        instructions.append(visit(robot, axial + 1, via))
        legs_s = np.abs(np.diff(path, axis=0)).max(axis=1) * float(robot.servo_per_metre)
        seconds += float(robot.switch_time) + legs_s.sum() / float(robot.servo_speed)
        held[tendons] = points[-1]
    return program(robot, instructions), float(seconds)


@pytest.mark.parametrize("servos", [1, 2, 3])
@pytest.mark.parametrize("seed", [1, 2])
def test_board_time_is_eq_14_and_the_tendons_arrive(robot, servos, seed):
    made, seconds = random_program(robot, np.random.default_rng(seed), servos)
    link = LockstepLink(robot)
    run = execute(made, link)
    assert (run.completed, run.reason) == (True, "completed")
    assert run.duration_s == pytest.approx(seconds, rel=0.01)
    assert run.measured == pytest.approx(np.array(made.target), abs=END_M)
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)
    assert [r.axial for r in run.records] == [i.axial for i in made.instructions]
    assert run.records[-1].end_s <= run.duration_s + 1e-9
    assert sum(r.trims for r in run.records) == 0
    assert link.board.state is BoardState.READY


def test_trajectory_goes_through_every_leg(muxarm):
    made, _ = random_program(muxarm, np.random.default_rng(5), 3)
    run = execute(made, LockstepLink(muxarm))
    times, points = run.trajectory.time_s, run.trajectory.displacements
    assert (np.diff(times) >= 0).all()
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(run.duration_s, abs=0.01)
    for instruction, record in zip(load_visits(muxarm, made), run.records, strict=True):
        during = points[(times >= record.start_s) & (times <= record.end_s)]
        for goals in instruction.legs:
            wanted = [goals[s] for s in instruction.tendons]
            tendons = [c - 1 for c in instruction.tendons.values()]
            assert np.abs(during[:, tendons] - wanted).max(axis=1).min() < END_M
    travel = np.abs(np.diff(points, axis=0)) / np.maximum(np.diff(times), 1e-12)[:, None]
    assert travel[np.diff(times) > 1e-6].max() <= float(muxarm.tendon_speed) * (1 + 1e-6)


def test_same_run_twice_and_with_thinner_streams(muxarm):
    made, _ = random_program(muxarm, np.random.default_rng(3), 2)
    first, again = (execute(made, LockstepLink(muxarm)) for _ in range(2))
    assert (first.trajectory.displacements == again.trajectory.displacements).all()
    assert (first.trajectory.time_s == again.trajectory.time_s).all()
    thin = LockstepLink(muxarm, stream_divider=20)
    run = execute(made, thin)
    assert run.completed
    assert run.duration_s == pytest.approx(first.duration_s, abs=0.01)
    assert run.measured == pytest.approx(first.measured, abs=END_M)


def test_collinear_legs_are_one_motion(muxarm):
    fused = visit(muxarm, 1, [{1: 0.01, 2: -0.005}, {1: 0.02, 2: -0.01}, {1: 0.02, 2: -0.01}])
    assert motions(fused) == ({1: 0.02, 2: -0.01},)
    bent = visit(muxarm, 1, [{1: 0.01, 2: -0.005}, {1: 0.02, 2: -0.02}, {1: 0.01, 2: -0.02}])
    assert len(motions(bent)) == 3
    back = visit(muxarm, 1, [{1: 0.01}, {1: 0.02}, {1: 0.005}])
    assert motions(back) == ({1: 0.02}, {1: 0.005})


def test_there_and_back_on_one_link(muxarm):
    there = program(
        muxarm, [visit(muxarm, 1, [{1: -0.01, 2: 0.004}]), visit(muxarm, 2, [{3: 0.01}])]
    )
    link = LockstepLink(muxarm)
    assert execute(there, link).completed
    start = np.array(there.target)
    back = program(
        muxarm, [visit(muxarm, 2, [{3: -0.01}]), visit(muxarm, 1, [{1: 0.01, 2: -0.004}])], start
    )
    run = execute(back, link)
    assert run.measured == pytest.approx(np.zeros(9), abs=END_M)
    assert run.duration_s < execute_time(muxarm, there) - 2.5  # the drum already stands at 2


def execute_time(robot: Robot, made: Program) -> float:
    return execute(made, LockstepLink(robot)).duration_s


def test_program_of_another_robot_is_refused(muxarm):
    penta = muxjax.load_robot("penta")
    link = LockstepLink(penta)
    with pytest.raises(ValueError, match=r"program: made for robot 'muxarm'.*this is 'penta'"):
        execute(program(muxarm, [visit(muxarm, 1, [{1: 0.01}])]), link)
    assert link.frames == 0


def test_board_of_another_robot_is_refused_before_anything_moves(muxarm):
    values = muxarm.config.model_dump(mode="json", by_alias=True)
    values["transmission"]["gear_ratio"]["value"] = 61
    other = robot_from_config(RobotConfig.model_validate(values))
    link = LockstepLink(other)
    link.robot = muxarm
    with pytest.raises(
        ValueError, match="WRONG_ROBOT; the board drives another robot than the program"
    ):
        execute(program(muxarm, [visit(muxarm, 1, [{1: 0.01}])]), link)
    assert link.board.state is BoardState.READY
    assert not link.board.mechanics.displacements.any()


def test_arm_elsewhere_than_the_start_is_refused(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.01}])])
    link = LockstepLink(muxarm, displacements=[0.0] * 8 + [0.002])
    with pytest.raises(
        ValueError,
        match=r"program.start: tendon 9 stands 2 mm.*at most 0.5 mm; .*--after.*displacements=",
    ):
        execute(made, link)
    assert link.board.mechanics.displacements[8] == 0.002


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axial": 0}, r"instruction 2: axial is 1 to 9, found 0"),
        ({"axial": 10}, r"instruction 2: axial is 1 to 9, found 10"),
        ({"length_moves": {}}, r"instruction 2: moves no servo"),
        ({"length_moves": {4: 0.002}}, r"instruction 2: length_moves: servos are 1 to 3, found 4"),
        ({"length_moves": {1: float("nan")}}, r"instruction 2: length_moves\[1\] is nan"),
        ({"servo_angles": {0: 1.0}}, r"instruction 2: servo_angles: servos are 1 to 3, found 0"),
        ({"servo_angles": {1: 5.0}}, r"instruction 2: servo_angles\[1\] / N at .* length_moves"),
        ({"servo_angles": {}}, r"instruction 2: servo_angles\[1\] / N at 0 m"),
        ({"via": ()}, r"instruction 2: via ends servo 1 at 0 m, length_moves says 0.002 m"),
        ({"via": ({1: float("inf")}, {1: 0.002})}, r"instruction 2: via\[1\]\[1\] is inf"),
        ({"via": ({2: 0.1}, {1: 0.002})}, r"instruction 2: via\[1\]: servo 2 is not in length_mo"),
        ({"via": ({1: 0.5}, {1: 0.002})}, r"instruction 2: tendon 4 is at 500 mm, its range is"),
        ({"clutches": (1,)}, r"instruction 2: servos \[1\] at axial 2 drive tendons \[4\], clutch"),
    ],
)
def test_wrong_instruction_is_named(muxarm, changes, message):
    wrong = dataclasses.replace(visit(muxarm, 2, [{1: 0.001}, {1: 0.002}]), **changes)
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.001}])])
    made = dataclasses.replace(made, instructions=(*made.instructions, wrong))
    link = LockstepLink(muxarm)
    with pytest.raises(ValueError, match=message):
        execute(made, link)
    assert link.frames == 0


def test_servo_that_the_program_may_not_use_is_named(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{2: 0.001}])])
    with pytest.raises(ValueError, match=r"instruction 1: servo 2 is not among \(1, 3\)"):
        execute(dataclasses.replace(made, servos=(1, 3)), LockstepLink(muxarm))


class BadLink(LockstepLink):
    """Loses, doubles and corrupts frames, both ways, by seed."""

    def __init__(self, robot: Robot, seed: int) -> None:
        super().__init__(robot)
        self.rng = np.random.default_rng(seed)

    def spoil(self, frames: Iterable[Frame]) -> list[Frame]:
        spoiled = []
        for frame in frames:
            fate = self.rng.random()
            if fate < 0.02:
                continue
            if fate < 0.03:
                at = int(self.rng.integers(8))
                data = bytearray(frame.data)
                data[at] ^= 1 << int(self.rng.integers(8))
                frame = Frame(frame.id, bytes(data))
            spoiled += [frame] * (2 if fate > 0.98 else 1)
        return spoiled

    def send(self, frames: Iterable[Frame]) -> None:
        super().send(self.spoil(frames))

    def wait(self, until: float) -> list[Frame]:
        return self.spoil(super().wait(until))


@pytest.mark.parametrize("seed", range(4))
def test_bad_link_changes_nothing_but_time(muxarm, seed):
    made, seconds = random_program(muxarm, np.random.default_rng(seed), 3)
    link = BadLink(muxarm, seed)
    run = execute(made, link)
    assert run.completed, run.reason
    assert sum(link.board.refused.values()) > 0
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)
    assert seconds <= run.duration_s + 0.01


class MortalLink(LockstepLink):
    """From a time on, nothing gets through one way or the other."""

    deaf_from = mute_from = interrupt_at = np.inf

    def send(self, frames: Iterable[Frame]) -> None:
        if self.now < self.deaf_from:
            super().send(frames)

    def wait(self, until: float) -> list[Frame]:
        frames = super().wait(until)
        if self.now >= self.interrupt_at:
            self.interrupt_at = np.inf
            raise KeyboardInterrupt
        return frames if self.now < self.mute_from else []


@pytest.mark.parametrize(
    ("way", "reason"),
    [("deaf_from", "WATCHDOG"), ("mute_from", "the board's heartbeat is lost")],
)
def test_broken_link_ends_in_the_safe_state(muxarm, way, reason):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.05}])])
    link = MortalLink(muxarm)
    setattr(link, way, 5.0)
    run = execute(made, link)
    assert not run.completed
    assert "instruction 1" in run.reason
    assert reason in run.reason
    link.deaf_from = 0.0
    link.wait(link.now + 1.0)
    stopped = link.board.mechanics.displacements.copy()
    assert 1e-3 < stopped[0] < 0.049
    link.wait(link.now + 30.0)
    assert (link.board.mechanics.displacements == stopped).all()
    assert link.board.state is not BoardState.ARMED
    assert not link.board.mechanics.coupled


def test_keyboard_interrupt_is_an_emergency_stop(muxarm):
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.05}])])
    link = MortalLink(muxarm)
    link.interrupt_at = 6.0
    run = execute(made, link)
    assert (run.completed, run.reason) == (False, "stopped from the keyboard")
    assert link.board.state is BoardState.ESTOPPED
    assert link.now < 6.0 + 0.02
    after = execute(program(muxarm, [visit(muxarm, 1, [{1: 0.01}])], run.measured), link)
    assert not after.completed
    assert "ESTOPPED" in after.reason


def test_silent_board_is_reported(muxarm):
    link = MortalLink(muxarm)
    link.deaf_from = 0.0
    run = execute(program(muxarm, [visit(muxarm, 1, [{1: 0.01}])]), link)
    assert (run.completed, run.reason) == (False, "HELLO: no answer after 5 tries")
    assert np.isnan(run.duration_s)
    assert np.isnan(run.measured).all()
    assert run.trajectory is None


def test_gear_that_falls_short_is_trimmed_by_the_wheel(muxarm):
    link = LockstepLink(muxarm)
    link.board.mechanics._metres_per_rad *= 0.98
    made = program(muxarm, [visit(muxarm, 1, [{1: 0.02, 2: -0.01}])])
    run = execute(made, link)
    assert run.completed
    assert run.records[0].trims >= 1
    assert link.board.mechanics.displacements == pytest.approx(np.array(made.target), abs=END_M)


def test_the_garbage_collector_leaves_a_run_alone(muxarm):
    import gc

    frozen = []
    run = execute(
        program(muxarm, [visit(muxarm, 1, [{1: 0.001}])]),
        LockstepLink(muxarm),
        on_progress=lambda _: frozen.append(gc.get_freeze_count()),
    )
    assert run.completed
    assert min(frozen) > 1000
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize(
    ("share", "move", "reason"),
    [
        (0.55, 0.001, "counts off after 3 trims: gear, clutch or encoder"),
        (0.6, 0.02, r"wheel moved 12.00 mm while servo 1 turned for 20.00 mm"),
    ],
)
def test_gear_beyond_trimming_is_reported(muxarm, share, move, reason, monkeypatch):
    monkeypatch.setattr("muxjax.hardware.transaction.MAX_TRIMS", 3)
    link = LockstepLink(muxarm)
    link.board.mechanics._metres_per_rad *= share
    run = execute(program(muxarm, [visit(muxarm, 1, [{1: move}])]), link)
    assert (run.completed, run.resumable) == (False, False)
    assert reason in run.reason
    assert link.board.mechanics.displacements[0] <= move


@pytest.mark.parametrize(
    ("misses", "reason", "failed"),
    [
        (1, "completed", ()),
        (2, "completed", ()),
        (3, "tries with servo 1, seated with servo 2: servo 1 is at fault", (1,)),
        (9, "tries with servo 1, nor with servo 2: clutch or encoder of tendon 1", ()),
    ],
)
def test_clutch_that_does_not_seat_is_tried_again(muxarm, misses, reason, failed):
    class Loose(dict):
        left = misses

        def update(self, *args, **kwargs):
            self.left -= 1
            if self.left < 0:
                super().update(*args, **kwargs)

    link = LockstepLink(muxarm)
    link.board.mechanics.coupled = Loose()
    run = execute(program(muxarm, [visit(muxarm, 1, [{1: 0.01}])]), link)
    assert run.completed is (misses < 3)
    assert reason in run.reason
    assert run.failed_servos == failed
    assert not run.resumable
    assert not link.board.energised
    if not run.completed:
        assert np.abs(link.board.mechanics.displacements).max() < 1e-12


def test_over_a_python_can_bus(muxarm):
    can = pytest.importorskip("can")
    values = muxarm.config.model_dump(mode="json", by_alias=True)
    values["axial"]["switch_time_s"]["value"] = 0.5
    quick = robot_from_config(RobotConfig.model_validate(values))
    board, done = VirtualBoard(quick), threading.Event()
    with (
        can.Bus("muxjax-test", interface="virtual") as host,
        can.Bus("muxjax-test", interface="virtual") as far,
    ):
        thread = threading.Thread(target=serve, args=(board, BusWire(far), done.is_set))
        thread.start()
        try:
            run = execute(
                program(quick, [visit(quick, 2, [{1: 0.0004, 3: -0.0002}])]), BusLink(host, quick)
            )
        finally:
            done.set()
            thread.join()
    assert run.completed, run.reason
    assert board.mechanics.displacements[[3, 5]] == pytest.approx([0.0004, -0.0002], abs=END_M)
    assert run.trajectory is None
