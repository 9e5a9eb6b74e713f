"""One run of a campaign: a host, an operator who puts things right, and the judge's verdict."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

import muxjax
from muxjax.hardware import LockstepLink, MemoryJournal, Run
from muxjax.hardware.encoders import COUNTS_PER_RAD
from muxjax.hardware.faults import FaultKind
from muxjax.hardware.protocol import BoardState, Frame
from muxjax.pipeline import run_to_target
from muxjax.robot import Robot
from muxjax.scheduler import Program, waypoints
from tests.campaigns.judge import Judge
from tests.campaigns.scenario import Scenario, draw

END_M = 2e-5  # of measured wheel length
WAY_M = 2e-4  # trims
RETURNS = 8  # how often the operator lets a run go on
SLIPS = 1.2  # of the physics' slip at a clutch, at most
ENCODER_M = 5e-5  # noise, rounding and what is left of the encoders' errors
BOOT_S = 2.0
COOLING_S = 300.0
ENCODERS = (FaultKind.ENCODER_STUCK, FaultKind.ENCODER_PARITY, FaultKind.ENCODER_MAGNET)


class HostKilled(Exception):  # noqa: N818 - no error, an event
    """The host's process is gone."""


class MortalLink(LockstepLink):
    """A link whose host is killed at certain times.

    Attributes:
        kills: Those left: when [s], and whether before the host sends (or else while it waits).
    """

    kills: tuple[tuple[float, bool], ...] = ()

    def send(self, frames: Iterable[Frame]) -> None:
        """As ever, unless the host dies with the frames in its hands."""
        if self.kills and self.kills[0][1] and self.now >= self.kills[0][0] and list(frames):
            self.kills = self.kills[1:]
            raise HostKilled
        super().send(frames)

    def wait(self, until: float) -> list[Frame]:
        """As ever, unless the host does not live to see it."""
        if self.kills and not self.kills[0][1] and self.kills[0][0] <= until:
            (at, _), self.kills = self.kills[0], self.kills[1:]
            super().wait(max(at, self.now))
            raise HostKilled
        return super().wait(until)


@dataclass
class Verdict:
    """What became of a scenario.

    Attributes:
        seed: Of the scenario.
        ending: "completed", "safe", or "wrong".
        offences: What must not be, in words.
        reason: Of the last run.
        steps: How the host came to its end.
        measured_mm: Largest distance of a wheel from its goal, by a fresh look at the sensors.
        true_mm: The same of the true tendon.
        simulated_s: Time on the virtual clock.
    """

    seed: int
    ending: str = "wrong"
    offences: list[str] = field(default_factory=list)
    reason: str = ""
    steps: list[str] = field(default_factory=list)
    measured_mm: float = math.nan
    true_mm: float = math.nan
    simulated_s: float = 0.0


def run(robot: Robot, scenario: Scenario) -> Verdict:
    """Play a scenario to its end and judge it."""
    program = scenario.program
    link = MortalLink(
        robot,
        scenario.physics,
        program.start,
        scenario.axial,
        scenario.stream_divider,
        scenario.faults,
        scenario.seed,
    )
    link.kills = scenario.kills
    slip = SLIPS * scenario.physics.clutch.slip_seen_m
    judge = Judge(link.board, 2 * slip + ENCODER_M)  # one slip may come on another
    verdict = Verdict(scenario.seed)
    journal = MemoryJournal()
    last = _host(scenario, link, journal, verdict)
    verdict.ending = _judge_rest(scenario, link, judge, last, verdict)
    if verdict.ending == "safe":
        _repair(link)
        encoders = {f.index for f in scenario.lasting if f.kind in ENCODERS and f.index}
        last = _host(scenario, link, journal, verdict, tuple(sorted(encoders)))
        if last is None or not last.completed:
            verdict.offences.append("did not complete once everything was repaired")
    link.kills = ()
    if last is not None and last.completed:
        _judge_lengths(scenario, link, verdict)
    _judge_ways(scenario, judge, slip + 2 * scenario.physics.servo.backlash_m, verdict)
    verdict.simulated_s = link.now
    verdict.offences += judge.offences.values()
    return verdict


def _host(
    scenario: Scenario,
    link: MortalLink,
    journal: MemoryJournal,
    verdict: Verdict,
    repaired: tuple[int, ...] = (),
) -> Run | None:
    """Begin, and go on until it is done or nobody can: the last run, None if it was refused.

    The operator names the encoders that were repaired, as docs/running.md asks for.
    """
    last: Run | None = None
    for _ in range(RETURNS):
        begun = journal.standing.program is not None
        try:
            program = None if begun else scenario.program
            last = run_to_target(link, journal, program, repaired_encoders=repaired)
        except HostKilled:
            verdict.steps.append(f"{link.now:.2f} s: host killed")
            _operator(link)
            continue
        except ValueError as refused:
            verdict.steps.append(f"{link.now:.2f} s: refused: {refused}")
            verdict.reason = str(refused)
            return None
        verdict.steps.append(f"{link.now:.2f} s: {last.reason}; failed {last.failed_servos}")
        verdict.reason = last.reason
        if last.completed or (not last.resumable and scenario.explains(last.reason)):
            return last
        _operator(link)  # who has repaired by then what does not last
    return last


def _operator(link: MortalLink) -> None:
    """Waits; switches a board off and on that is cut off for good or latched."""
    kills, link.kills = link.kills, ()
    _pass(link, 0.5)
    board = link.board
    if FaultKind.BUS_OFF in board.cut_off or board.state is BoardState.ESTOPPED:
        board.power_cycle()
    _pass(link, BOOT_S)
    if board.coils.temperature > board.physics.coil.limit_c:
        _pass(link, COOLING_S)
    link.kills = tuple(kill for kill in kills if kill[0] > link.now)


def _pass(link: MortalLink, seconds: float) -> None:
    """Let time pass without a host."""
    end = link.now + seconds
    while link.now < end:
        link.wait(end)


def _repair(link: MortalLink) -> None:
    """Whatever is broken on the board is mended, and the board switched off and on."""
    board = link.board
    encoders, mechanics = board.senses.encoders, board.mechanics
    for broken in (mechanics.jammed, mechanics.dead_plugs, mechanics.stuck_plugs):
        broken.clear()
    board.senses.offline.clear()
    encoders.stuck.clear()
    encoders.broken.clear()
    kills, link.kills = link.kills, ()
    board.power_cycle()
    _pass(link, BOOT_S)
    link.kills = tuple(kill for kill in kills if kill[0] > link.now)


def _judge_rest(
    scenario: Scenario, link: MortalLink, judge: Judge, last: Run | None, verdict: Verdict
) -> str:
    """Whether the first host left the board at rest, and with a reason that is true."""
    kills, link.kills = link.kills, ()
    _pass(link, 1.0)
    link.kills = tuple(kill for kill in kills if kill[0] > link.now)
    if not judge.at_rest:
        verdict.offences.append(f"not at rest at the end, in state {link.board.state.name}")
    if last is not None and last.completed:
        return "completed"
    if scenario.explains(verdict.reason):
        return "safe"
    kinds = ", ".join(f"{f.kind} {f.index}" for f in scenario.lasting) or "nothing lasting"
    verdict.offences.append(f"did not complete, although {kinds} was broken")
    return "wrong"


def _judge_lengths(scenario: Scenario, link: MortalLink, verdict: Verdict) -> None:
    """Whether a completed run left the wheels where they should be."""
    goals, board = np.array(scenario.program.target), link.board
    samples = []
    for _ in range(16):  # a fresh look with the sensors' noise averaged out
        _pass(link, 0.01)
        samples.append([board.senses.raw(c) for c in range(len(goals))])  # turns never lost
    measured = np.mean(samples, axis=0) / COUNTS_PER_RAD * float(board.robot.wheel_radius)
    verdict.measured_mm = 1e3 * float(np.abs(measured - goals).max())
    verdict.true_mm = 1e3 * float(np.abs(board.mechanics.displacements - goals).max())
    if verdict.measured_mm > 1e3 * END_M:
        verdict.offences.append(f"completed {verdict.measured_mm:.4f} mm off")


def _judge_ways(scenario: Scenario, judge: Judge, again_m: float, verdict: Verdict) -> None:
    """Whether a tendon went further than its program and what slips must be made good [m]."""
    allowed = _ways(judge.board.robot, scenario.program) + again_m * judge.engaged + WAY_M
    for fault in scenario.lasting:
        if fault.kind is FaultKind.ENCODER_STUCK:  # what it does not see is to be made good
            allowed[fault.index - 1] = np.inf
    twice = judge.travel - allowed
    if twice.max() > 0:
        tendon = int(twice.argmax()) + 1
        verdict.offences.append(f"tendon {tendon} moved {1e3 * twice.max():.2f} mm too much")


def _ways(robot: Robot, program: Program) -> np.ndarray:
    """How far each tendon goes in a program [m]."""
    return sum(np.abs(np.diff(points, axis=0)).sum(axis=0) for points in waypoints(robot, program))


def play(seeds: Iterable[int]) -> tuple[list[Verdict], float]:
    """Verdicts of some seeds, and the CPU time that they took [s]."""
    robot = muxjax.load_robot("muxarm")
    begin = time.process_time()
    verdicts = [run(robot, draw(robot, seed)) for seed in seeds]
    return verdicts, time.process_time() - begin
