"""One run of a campaign: a host, an operator who puts things right, and the judge's verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from muxjax.hardware import LockstepLink, MemoryJournal, Run, execute, resume
from muxjax.hardware.faults import FaultKind
from muxjax.hardware.protocol import BoardState, Frame
from muxjax.pipeline import replan
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule, waypoints
from tests.campaigns.judge import Judge
from tests.campaigns.scenario import LASTING, Scenario

END_M = 2e-5  # of measured wheel length
RETURNS = 8  # how often the operator lets a run go on
AGAIN_M = 1e-3  # way of a tendon beyond its program, each time that its clutch engages
RANGE_M = 1.2e-3  # slip at a clutch, and the encoder's error
BOOT_S = 2.0
COOLING_S = 300.0


class HostKilled(Exception):  # noqa: N818 - no error, an event
    """The host's process is gone."""


class MortalLink(LockstepLink):
    """A link whose host is killed at certain times.

    Attributes:
        kills: Times left [s].
    """

    kills: tuple[float, ...] = ()

    def wait(self, until: float) -> list[Frame]:
        """As ever, unless the host does not live to see it."""
        if self.kills and self.kills[0] <= until:
            at, self.kills = self.kills[0], self.kills[1:]
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
    judge = Judge(link.board, RANGE_M)
    verdict = Verdict(scenario.seed)
    last = _host(robot, scenario, link, verdict)
    link.kills = ()
    link.wait(link.now + 1.0)
    verdict.simulated_s = link.now
    verdict.offences += judge.offences.values()
    _judge_end(scenario, link, judge, last, verdict)
    return verdict


def _host(robot: Robot, scenario: Scenario, link: MortalLink, verdict: Verdict) -> Run | None:
    """Begin, and go on until it is done or nobody can: the last run, None if it was refused."""
    journal, program = MemoryJournal(), scenario.program
    target = np.array(program.target)
    last: Run | None = None
    for _ in range(RETURNS):
        try:
            unfinished = journal.standing.program is not None
            last = resume(journal, link) if unfinished else execute(program, link, journal=journal)
        except HostKilled:
            verdict.steps.append(f"{link.now:.2f} s: host killed")
            _operator(link)
            continue
        except ValueError as refused:
            verdict.steps.append(f"{link.now:.2f} s: refused: {refused}")
            verdict.reason = str(refused)
            if "coils" not in verdict.reason:
                return None
            _operator(link)
            continue
        verdict.steps.append(f"{link.now:.2f} s: {last.reason}")
        verdict.reason = last.reason
        if last.completed:
            return last
        _operator(link)
        if last.failed_servos and not np.isnan(last.measured).any():
            left = tuple(s for s in program.servos if s not in last.failed_servos)
            if not left:
                return last
            rest = replan(robot, last, target, servos=left)
            program, journal = schedule(robot, rest), MemoryJournal()
            verdict.steps.append(f"planned anew for servos {left}")
        elif not last.resumable:
            return last
    return last


def _operator(link: MortalLink) -> None:
    """Waits; switches a board off and on that is cut off for good or latched."""
    link_kills, link.kills = link.kills, ()
    link.wait(link.now + 0.5)
    board = link.board
    latched = board.state is BoardState.ESTOPPED
    if FaultKind.BUS_OFF in board.cut_off or latched:
        board.power_cycle()
        link.wait(link.now + BOOT_S)
    elif board.cut_off or not board.running or board.volts < board.physics.controller.lowest_v:
        link.wait(link.now + BOOT_S)
    if board.coils.temperature > board.physics.coil.limit_c:
        link.wait(link.now + COOLING_S)
    link.kills = tuple(t for t in link_kills if t > link.now)


def _judge_end(
    scenario: Scenario, link: MortalLink, judge: Judge, last: Run | None, verdict: Verdict
) -> None:
    goals, board = np.array(scenario.program.target), link.board
    samples = []
    for _ in range(16):  # a fresh look with the sensors' noise averaged out
        link.wait(link.now + 0.01)
        samples.append(board.senses.displacements())
    measured = np.mean(samples, axis=0)
    verdict.measured_mm = 1e3 * float(np.abs(measured - goals).max())
    verdict.true_mm = 1e3 * float(np.abs(board.mechanics.displacements - goals).max())
    if not judge.at_rest and not board.mechanics.stuck_plugs:
        verdict.offences.append(f"not at rest at the end, in state {board.state.name}")
    allowed = _ways(board.robot, scenario.program) + AGAIN_M * judge.engaged
    twice = judge.travel - allowed
    if twice.max() > 0 and FaultKind.ENCODER_STUCK not in scenario.lasting:
        tendon = int(twice.argmax()) + 1
        verdict.offences.append(f"tendon {tendon} moved {1e3 * twice.max():.2f} mm too much")
    if last is not None and last.completed:
        verdict.ending = "completed"
        if verdict.measured_mm > 1e3 * END_M:
            verdict.offences.append(f"completed {verdict.measured_mm:.4f} mm off")
        return
    words = [w for kind in scenario.lasting for w in LASTING[kind]]
    if any(w in verdict.reason for w in words):
        verdict.ending = "safe"
    elif words:
        verdict.offences.append(f"stopped for another reason than {scenario.lasting}")
    else:
        verdict.offences.append("did not complete although nothing lasting was broken")


def _ways(robot: Robot, program: Program) -> np.ndarray:
    """How far each tendon goes in a program [m]."""
    return sum(np.abs(np.diff(points, axis=0)).sum(axis=0) for points in waypoints(robot, program))
