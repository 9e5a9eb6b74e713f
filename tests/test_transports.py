"""The same behaviour on every transport: in lockstep, over socketcand, over slcan on a pty.

Over the buses the board is a process of its own, and everything runs in real time.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from test_executor import program, visit

from muxjax.hardware import BusLink, Link, LockstepLink, MemoryJournal, Run, execute, resume
from muxjax.hardware.executor import Executor, begin
from muxjax.hardware.journal import Journal, LegEntry
from muxjax.hardware.links import open_bus
from muxjax.hardware.log import LoggedLink
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import Program

END_M = 2e-5
STEP_M = 1e-3  # 0.44 s of motion


class Lockstep:
    """A board in this process."""

    def __init__(self, robot_file: Path, folder: Path) -> None:
        self.robot = load_robot(robot_file)
        self._link = LockstepLink(self.robot)

    @contextmanager
    def link(self) -> Iterator[Link]:
        yield self._link

    def pass_time(self, seconds: float) -> None:
        end = self._link.now + seconds
        while self._link.now < end:
            self._link.wait(end)

    def truth(self) -> np.ndarray:
        return self._link.board.mechanics.displacements.copy()

    def state(self) -> str:
        return self._link.board.state.name

    def power_failure(self) -> None:
        self._link.board.power_cycle(0.0)
        self.pass_time(1.0)

    def close(self) -> None:
        pass


def be_the_board(out: str, arguments: dict[str, Any]) -> None:
    from muxjax.cli.board import board

    with open(out, "w") as sys.stdout:
        board(**arguments)


class Process:
    """A board in a process of its own, killed and started at will."""

    wire: Any

    def __init__(self, robot_file: Path, folder: Path) -> None:
        self.robot = load_robot(robot_file)
        self._out, self._arm = folder / "out", folder / "arm.json"
        self._arguments = {
            "serve": self.wire,
            "port": 0,
            "robot": str(robot_file),
            "arm": self._arm,
        }
        self._start()

    def _start(self) -> None:
        # Forked from a process that has imported everything: starting one takes no time.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["muxjax.cli.board"])
        self._out.unlink(missing_ok=True)
        self._process = context.Process(
            target=be_the_board, args=(str(self._out), self._arguments), daemon=True
        )
        self._process.start()
        deadline = time.monotonic() + 60
        while not (self._out.is_file() and self._out.read_text().endswith("\n")):
            assert time.monotonic() < deadline, "the board does not come up"
            time.sleep(0.02)
        self.bus = self._out.read_text().partition(" on ")[2].strip()

    @contextmanager
    def link(self) -> Iterator[Link]:
        with open_bus(self.bus) as bus:
            yield BusLink(bus, self.robot)

    def pass_time(self, seconds: float) -> None:
        time.sleep(seconds)

    def _kept(self) -> dict[str, Any]:
        before = self._arm.stat().st_mtime_ns if self._arm.exists() else 0
        deadline = time.monotonic() + 10
        while not (self._arm.exists() and self._arm.stat().st_mtime_ns > before):
            assert time.monotonic() < deadline, "the board has died"
            time.sleep(0.01)
        return json.loads(self._arm.read_text())

    def truth(self) -> np.ndarray:
        return np.array(self._kept()["displacements_m"])

    def state(self) -> str:
        return str(self._kept()["state"])

    def kill(self) -> None:
        self._process.kill()
        self._process.join()

    def power_failure(self) -> None:
        self.kill()
        self._start()

    def close(self) -> None:
        self.kill()


class Socketcand(Process):
    wire = "socketcand"


class Slcan(Process):
    wire = "slcan"


@pytest.fixture(
    scope="module", params=[Lockstep, Socketcand, Slcan], ids=lambda kind: kind.__name__
)
def bench(request, tmp_path_factory):
    if request.param is not Lockstep:
        pytest.importorskip("can")
    if request.param is Slcan:
        pytest.importorskip("serial")
    folder = tmp_path_factory.mktemp(request.param.__name__)
    values = load_robot("muxarm").config.model_dump(mode="json", by_alias=True)
    values["axial"]["switch_time_s"]["value"] = 0.4
    (folder / "quick.yaml").write_text(yaml.safe_dump(values))
    made = request.param(folder / "quick.yaml", folder)
    yield made
    made.close()


def begun(robot: Robot, made: Program, journal: MemoryJournal) -> MemoryJournal:
    begin(robot, made, journal)
    return journal


def die_in_motion(link: Link, journal: MemoryJournal) -> None:
    """A host that is gone 0.1 s after it started the first leg."""
    executor = Executor(link.robot, journal, link.new_session())
    frames, started = [], np.inf
    while link.now < started + 0.1:
        link.send(executor.step(link.now, frames))
        if started == np.inf and any(isinstance(e, LegEntry) for e in journal.entries):
            started = link.now
        frames = link.wait(min(executor.next_time, started + 0.1))


def go_on(journal: MemoryJournal, link: Link) -> Run:
    """Resume to the end. A busy machine starves host or board for longer than the watchdog."""
    for _ in range(10):
        run = resume(journal, link)
        if run.completed:
            break
        assert run.resumable, run.reason
    return run


def there(bench, visits: int = 1) -> Program:
    """Tendons 1 to 3 from where they are, and tendon 4 in a second visit if there is one."""
    start = bench.truth()
    sign = -np.sign(start[0] - 1e-9)
    moves = {s: float(sign * STEP_M / s) for s in (1, 2, 3)}
    back = {1: float(-np.sign(start[3] - 1e-9) * STEP_M / 4)}
    made = [visit(bench.robot, 1, [moves]), visit(bench.robot, 2, [back])]
    return program(bench.robot, made[:visits], start)


def arrived(bench, made: Program) -> bool:
    return bool(np.abs(bench.truth() - made.target).max() < END_M)


def test_a_program_arrives_and_its_log_can_be_read(bench, tmp_path):
    can = pytest.importorskip("can")
    made = there(bench, visits=2)
    with bench.link() as link:
        logged = LoggedLink(link, tmp_path / "run.log")
        journal = MemoryJournal()
        run = execute(made, logged, journal=journal)
        logged.close()
        if not run.completed:
            run = go_on(journal, link)
    assert run.completed, run.reason
    assert np.abs(run.measured - made.target).max() < END_M
    assert arrived(bench, made)
    assert [check.passed for check in run.checks] == [True] * len(run.checks)
    with can.CanutilsLogReader(tmp_path / "run.log") as reader:
        messages = list(reader)
    assert {m.arbitration_id for m in messages} >= {0x20, 0x21, 0x30, 0x31, 0x58}
    assert {m.is_rx for m in messages} == {True, False}
    times = [m.timestamp for m in messages]
    assert times == sorted(times)


def test_another_robot_and_another_start_are_refused(bench):
    penta = load_robot("penta")
    before = bench.truth()
    elsewhere = program(bench.robot, [visit(bench.robot, 1, [{1: 1e-4}])], before + 0.002)
    with bench.link() as link:
        link.robot = penta
        with pytest.raises(ValueError, match="WRONG_ROBOT"):
            execute(program(penta, [visit(penta, 1, [{1: 1e-4}])]), link)
        link.robot = bench.robot
        with pytest.raises(ValueError, match=r"program.start: tendon \d stands 2 mm"):
            execute(elsewhere, link)
    assert (bench.truth() == before).all()


def test_a_host_that_dies_is_stopped_and_gone_on_with(bench, tmp_path):
    made = there(bench)
    with Journal.open(tmp_path / "j") as journal, bench.link() as link:
        die_in_motion(link, begun(bench.robot, made, journal))
    bench.pass_time(0.4)
    stopped = bench.truth()
    bench.pass_time(0.2)
    assert (bench.truth() == stopped).all()
    assert bench.state() == "SAFE"
    assert 1e-5 < abs(stopped[0] - made.start[0]) < STEP_M - 1e-5
    with Journal.open(tmp_path / "j") as journal, bench.link() as link:
        run = go_on(journal, link)
    assert run.completed, run.reason
    assert arrived(bench, made)


def test_a_board_that_loses_its_supply_goes_on(bench):
    made, journal = there(bench), MemoryJournal()
    with bench.link() as link:
        die_in_motion(link, begun(bench.robot, made, journal))
    bench.power_failure()
    assert bench.state() == "SILENT"
    with bench.link() as link:
        run = go_on(journal, link)
    assert run.completed, run.reason
    assert arrived(bench, made)


def test_a_stranger_on_the_bus_moves_nothing(bench):
    made, journal = there(bench), MemoryJournal()
    with bench.link() as link:
        executor = Executor(bench.robot, begun(bench.robot, made, journal), link.new_session())
        while not executor.phase.startswith("leg"):
            link.send(executor.step(link.now, link.wait(link.now + 0.001)))
        other = Executor(bench.robot, begun(bench.robot, made, MemoryJournal()), 999)
        refused = other.step(link.now)  # HELLO of another session, and its heartbeat
        link.send(refused)
        while not executor.finished:
            link.send(executor.step(link.now, link.wait(executor.next_time)))
        run = executor.result(link.trajectory)
        if not run.completed:
            run = go_on(journal, link)
    assert run.completed, run.reason
    assert arrived(bench, made)


def test_estop_stops_at_once_and_holds_until_power_up(bench):
    made, journal = there(bench), MemoryJournal()

    def press(progress) -> None:
        if progress.phase.startswith("leg"):
            raise KeyboardInterrupt

    with bench.link() as link:
        run = execute(made, link, journal=journal, on_progress=press)
        assert (run.reason, run.resumable) == ("stopped from the keyboard", True)
        stopped = bench.truth()
        assert bench.state() == "ESTOPPED"
        again = resume(journal, link)
        assert not again.completed
        assert "ESTOPPED" in again.reason
    bench.pass_time(0.2)
    assert np.abs(bench.truth() - stopped).max() < 1e-4
    assert abs(stopped[0] - made.start[0]) < STEP_M - 1e-5
    bench.power_failure()
    with bench.link() as link:
        run = go_on(journal, link)
    assert run.completed, run.reason
    assert arrived(bench, made)


@pytest.mark.slow
def test_a_board_that_dies_is_missed_by_its_heartbeat(bench):
    if isinstance(bench, Lockstep):
        pytest.skip("a board in this process does not die")
    made = there(bench)
    journal = begun(bench.robot, made, MemoryJournal())
    with bench.link() as link:
        executor = Executor(bench.robot, journal, link.new_session())
        started = np.inf
        while not executor.finished:
            link.send(executor.step(link.now, link.wait(executor.next_time)))
            if executor.phase.startswith("leg") and started == np.inf:
                started = link.now
            if link.now > started + 0.1:
                bench.kill()
        run = executor.result(link.trajectory)
    assert "the board's heartbeat is lost" in run.reason
    assert run.resumable
    bench.power_failure()
    with bench.link() as link:
        assert go_on(journal, link).completed
    assert arrived(bench, made)
