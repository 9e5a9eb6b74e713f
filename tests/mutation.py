"""Would a test notice? Every interlock, limit and rule of the board is broken in turn.

``python -m tests.mutation`` prints what caught each mutant, and the score.

A mutant is a check taken out of ``interlocks.CHECKS``, a limit loosened, or one place in the
source of a function changed. What must catch it are the conformance suite and the rules below,
which also break the virtual board's parts.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import CodeType, FunctionType
from typing import Any
from unittest import mock

import muxjax
from muxjax.hardware import LockstepLink, conformance, guards, interlocks, protocol, virtual_board
from muxjax.hardware.conformance import Bench, Broken
from muxjax.hardware.protocol import VERSION, BoardState, Fault, Op, Reason, Status

# What the board promises beyond the conformance suite, because parts must fail for it


def start_move(bench: Bench) -> int:
    tendon = bench.engage()
    way = 2 * bench.way(tendon)
    at = float(bench.sensors.displacements()[tendon])
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at + way))
    bench.ask(Op.START, arg=1)
    bench.wait(0.2)
    return tendon


def trips(bench: Bench, reason: Reason, index: int, within: float = 1.0) -> None:
    """EMCY with the reason and index, START aborted, SAFE, nothing moves, clutches out."""
    mark = len(bench.heard)

    def emergency() -> list[Any]:
        return [h.values for _, h in bench.heard[mark:] if h.name == "EMCY"]

    bench.expect(bench.wait(within, lambda: bool(emergency())), f"no EMCY {reason.name}")
    found = Reason(emergency()[0]["Code"]).name, emergency()[0]["Index"]
    bench.expect(found == (reason.name, index), f"EMCY {found}, expected {reason.name} {index}")
    bench.wait(0.3)
    bench.expect(bench.state is BoardState.SAFE, "not SAFE")
    bench.expect(bench.sensors.clutches_out, "a clutch is in")
    aborted = [h.values["Reason"] for _, h in bench.heard if h.name == "ACK"
               and h.values["Status"] == Status.ABORTED]  # fmt: skip
    bench.expect(aborted[-1:] == [reason], "the job was not aborted for it")


def stalled_servo(bench: Bench) -> None:
    start_move(bench)
    bench.link.board.mechanics.jam(0)
    trips(bench, Reason.SERVO_STALLED, 1, 0.08)
    bench.expect(bool(bench.faults & Fault.SERVO), "no fault bit")


def offline_servo(bench: Bench) -> None:
    start_move(bench)
    bench.link.board.senses.offline.add(0)
    trips(bench, Reason.SERVO_OFFLINE, 1, 0.08)


def accidents_are_not_faults(bench: Bench) -> None:
    """Two bad looks in a row are let pass."""
    board = bench.link.board
    start_move(bench)
    for begin, end in (
        (lambda: board.senses.offline.add(0), lambda: board.senses.offline.discard(0)),
        (
            lambda: board.senses.encoders.broken.update({0: 1}),
            lambda: board.senses.encoders.broken.clear(),
        ),
    ):
        begin()
        bench.wait(0.0199)  # two looks
        end()
        bench.wait(0.2)
        bench.expect(bench.state is BoardState.ARMED, "an accident stopped the board")


def dead_servo_in_a_probe(bench: Bench) -> None:
    bench.arm()
    bench.go_to(1)
    bench.link.board.mechanics.jam(0)
    bench.ask(Op.ENGAGE, *bench.clutch(1, 1))
    trips(bench, Reason.SERVO_STALLED, 1)


def servo_that_stood_in_a_probe(bench: Bench) -> None:
    """For too short a time to be a stall, but its probe proves nothing."""
    bench.arm()
    bench.go_to(1)
    board = bench.link.board
    bench.ask(Op.ENGAGE, *bench.clutch(1, 1))
    bench.wait(board.physics.clutch_in_s + 0.012)
    board.mechanics.jam(0)
    board.plan(0.024, board.mechanics.jammed.clear)
    trips(bench, Reason.SERVO_STALLED, 1)


def failed_encoder(bench: Bench) -> None:
    tendon = start_move(bench)
    bench.link.board.senses.encoders.broken[tendon] = 1
    trips(bench, Reason.ENCODER_FAULT, tendon + 1, 0.08)
    bench.expect(bool(bench.faults & Fault.ENCODER), "no fault bit")


def unused_parts_may_fail(bench: Bench) -> None:
    start_move(bench)
    board = bench.link.board
    board.senses.offline.add(1)
    board.mechanics.jammed.add(1)
    board.senses.encoders.broken[4] = 1
    bench.wait(0.5)
    bench.expect(bench.state is BoardState.ARMED, "a part that is not in use stopped the board")


def plug_jumps_out(bench: Bench) -> None:
    tendon = start_move(bench)
    bench.link.board.mechanics.throw_out(0)
    trips(bench, Reason.WHEEL_STILL, tendon + 1, 0.5)


def hot_coils(bench: Bench) -> None:
    start_move(bench)
    limit = bench.link.board.physics.coil.limit_c
    bench.link.board.coils.temperature = limit + 3
    trips(bench, Reason.COIL_HOT, 0, 0.05)
    bench.expect(bool(bench.faults & Fault.COIL_HOT), "no fault bit")
    bench.link.board.coils.temperature = limit + 3
    arm_is_refused(bench, Reason.COIL_HOT)


def low_voltage(bench: Bench) -> None:
    start_move(bench)
    bench.link.board.volts = bench.link.board.physics.controller.lowest_v - 0.5
    trips(bench, Reason.UNDERVOLTAGE, 0, 0.05)
    bench.expect(bool(bench.faults & Fault.VOLTAGE), "no fault bit")
    arm_is_refused(bench, Reason.UNDERVOLTAGE)


def arm_is_refused(bench: Bench, reason: Reason) -> None:
    bench.greet()
    bench.check_robot()
    bench.beat()
    bench.refuses(Op.ARM, 0, bench.session, reason)


def plug_that_does_not_seat(bench: Bench) -> None:
    bench.arm()
    bench.go_to(1)
    tendon = int(bench.robot.axial_map[0, 0])
    bench.link.board.mechanics.dead_plugs.add(tendon)
    bench.ask(Op.ENGAGE, *bench.clutch(1, 1))
    bench.wait(1.0)
    bench.expect(last_ack(bench) == (Status.ABORTED, Reason.NOT_SEATED), "a loose clutch passed")
    bench.refuses(Op.STAGE, 1, 0, Reason.NOT_COUPLED)
    bench.refuses(Op.AXIAL, 0, 2, Reason.CLUTCH_IN)


def last_ack(bench: Bench) -> tuple[Status, Reason]:
    ack = next(h.values for _, h in reversed(bench.heard) if h.name == "ACK")
    return Status(ack["Status"]), Reason(ack["Reason"])


def plug_that_stays_in(bench: Bench) -> None:
    tendon = bench.engage()
    bench.link.board.mechanics.stuck_plugs.add(tendon)
    bench.ask(Op.RELEASE, *bench.clutch(1, 1))
    bench.wait(1.0)
    bench.expect(last_ack(bench) == (Status.ABORTED, Reason.NOT_RELEASED), "a stuck clutch passed")
    bench.refuses(Op.AXIAL, 0, 2, Reason.CLUTCH_IN)


def plug_that_stays_in_unseen(bench: Bench) -> None:
    """After a stop nobody has probed the clutch: the drum does so before it turns."""
    tendon = bench.engage()
    bench.link.board.mechanics.stuck_plugs.add(tendon)
    bench.do(Op.DISARM, within=1.0)
    bench.arm()
    before = bench.link.board.mechanics.axial
    bench.ask(Op.AXIAL, arg=2)
    bench.wait(1.0)
    bench.expect(last_ack(bench) == (Status.ABORTED, Reason.NOT_RELEASED), "a stuck clutch passed")
    bench.expect(bench.link.board.mechanics.axial == before, "the drum turned with a clutch in")
    bench.refuses(Op.AXIAL, 0, 2, Reason.CLUTCH_IN)


def lost_turns(bench: Bench) -> None:
    bench.arm()
    bench.refuses(Op.TURNS, 0, 1 << 16, Reason.ARMED_ALREADY)
    bench.leave()
    bench.link.board.power_cycle()
    bench.wait(1.0)
    bench.heard.clear()
    bench.wait(0.5)
    bench.expect(not bench.heard, "it speaks after a power cycle")
    # A board fresh from reset knows the last number as 0.
    answer = bench.ask(Op.TURNS, 0, 1 << 16, seq=1)
    bench.expect(answer[1] is Reason.WRONG_SESSION, "TURNS was taken before HELLO")
    bench.do(Op.HELLO, arg=VERSION << 16 | bench.session)
    bench.wait(0.1)
    bench.expect(bool(bench.faults & Fault.TURNS_LOST), "no fault bit for lost turns")
    bench.check_robot()
    bench.beating = True
    bench.beat()
    n = bench.robot.n_tendons
    bench.refuses(Op.TURNS, 0, 0, Reason.TURNS_UNKNOWN)
    bench.refuses(Op.TURNS, 0, (n + 1) << 16, Reason.TURNS_UNKNOWN)
    bench.refuses(Op.TURNS, 0, 1 << 16 | 100, Reason.TENDON_RANGE)
    for wheel in range(1, n + 1):
        bench.refuses(Op.ARM, 0, bench.session, Reason.TURNS_UNKNOWN)
        bench.do(Op.TURNS, 0, wheel << 16)
    bench.wait(0.1)
    bench.expect(not bench.faults & Fault.TURNS_LOST, "the fault bit stays")
    bench.do(Op.ARM, arg=bench.session)
    bench.do(Op.DISARM, within=1.0)
    bench.refuses(Op.TURNS, 0, 1 << 16 | 0xFFFF, Reason.TURNS_UNKNOWN)


def lost_turns_beyond_the_range(bench: Bench) -> None:
    """A clutch slipped at the range's end: so far the turn is believed, and no further."""
    board = bench.link.board
    for beyond, taken in ((0.0015, True), (0.0025, False)):
        board.mechanics.wheels[0] = board.limits[0, 1] + beyond
        board.mechanics.windings += 1
        board.power_cycle()
        bench.wait(1.0)
        bench.do(Op.HELLO, arg=VERSION << 16 | bench.session)
        if taken:
            bench.do(Op.TURNS, 0, 1 << 16)
        else:
            bench.refuses(Op.TURNS, 0, 1 << 16, Reason.TENDON_RANGE)


def numbers(bench: Bench) -> None:
    bench.arm()
    last = bench.seq
    foreign = VERSION << 16 | bench.session ^ conformance.FOREIGN
    answer = bench.ask(Op.HELLO, arg=foreign, seq=(last + 9) & 0xFFFF)
    bench.expect(answer[:2] == (Status.REJECTED, Reason.ARMED_ALREADY), "HELLO of a stranger")
    answer = bench.ask(Op.DISARM, seq=(last - 400) & 0xFFFF)
    bench.expect(answer[2] == last, "a stranger's HELLO shifted the session's numbers")
    bench.refuses(Op.AXIAL, 0, 0, Reason.UNKNOWN_AXIAL)
    answer = bench.ask(Op.DISARM, seq=(last - 400) & 0xFFFF)
    bench.expect(answer[2] == bench.seq, "a rejected command has not used its number up")
    bench.ask(Op.AXIAL, arg=1)
    busy = (bench.seq + 1) & 0xFFFF
    for _ in range(2):
        answer = bench.ask(Op.AXIAL, arg=2, seq=busy)
        bench.expect(answer[:2] == (Status.BUSY, Reason.BUSY), "BUSY has used its number up")


def many_answers_are_remembered(bench: Bench) -> None:
    bench.arm()
    first = (bench.seq + 1) & 0xFFFF
    for _ in range(30):
        bench.refuses(Op.AXIAL, 0, 0, Reason.UNKNOWN_AXIAL)
    answer = bench.ask(Op.AXIAL, arg=1, seq=first)
    bench.expect(answer[0] is Status.DUPLICATE, "an answer was forgotten")


def new_session_new_numbers(bench: Bench) -> None:
    bench.greet()
    used = bench.seq
    bench.session ^= 1
    bench.seq = (used - 1) & 0xFFFF
    answer = bench.ask(Op.HELLO, arg=VERSION << 16 | bench.session)
    bench.expect(answer[0] is Status.DONE, "a new session's HELLO under an old number")
    bench.greet()
    old = (bench.seq + 1) & 0xFFFF
    bench.do(Op.SET_STREAM, arg=1)
    bench.session ^= 1
    bench.greet()
    bench.seq = (old - 1) & 0xFFFF
    answer = bench.ask(Op.HELLO, arg=VERSION << 16 | bench.session)
    bench.expect(answer[0] is Status.DONE, "a number of an old session counted as answered")


def stop_forgets_targets(bench: Bench) -> None:
    tendon = bench.engage()
    bench.do(Op.STAGE, 1, bench.target(1, tendon, float(bench.sensors.displacements()[tendon])))
    bench.do(Op.DISARM, within=1.0)
    bench.engage()
    bench.refuses(Op.START, 0, 1, Reason.NOT_STAGED)


def braking_takes_its_time(bench: Bench) -> None:
    """DISARM stops the servo by a ramp, not by pulling its clutch while it turns."""
    start_move(bench)
    board = bench.link.board
    bench.ask(Op.DISARM)
    bench.wait(board.physics.brake_s + 0.01)
    bench.expect(not board.mechanics.moving, "the servo turns on after DISARM")
    bench.expect(bool(board.mechanics.coupled), "the clutch let go before the servo stood")


def host_loss_forgets_the_robot(bench: Bench) -> None:
    bench.arm()
    bench.beating = False
    bench.wait(0.5)
    bench.expect(not bench.link.board.words_matched, "a stop left the robot checked")


RULES: tuple[Callable[[Bench], None], ...] = (
    stalled_servo,
    offline_servo,
    accidents_are_not_faults,
    dead_servo_in_a_probe,
    servo_that_stood_in_a_probe,
    failed_encoder,
    unused_parts_may_fail,
    plug_jumps_out,
    hot_coils,
    low_voltage,
    plug_that_does_not_seat,
    plug_that_stays_in,
    plug_that_stays_in_unseen,
    lost_turns,
    lost_turns_beyond_the_range,
    numbers,
    many_answers_are_remembered,
    new_session_new_numbers,
    stop_forgets_targets,
    braking_takes_its_time,
    host_loss_forgets_the_robot,
)


def caught_by(robot: muxjax.Robot) -> str | None:
    """Name of the first check or rule that the board of this moment breaks; None if none."""
    link = LockstepLink(robot)
    caught: list[str] = []

    def note(finding: conformance.Finding) -> None:
        if finding.verdict == "fail":
            caught.append(f"{finding.name}: {finding.reason}")
            raise StopIteration

    # Whatever a broken board makes of a test, an error in it included, has caught the mutant.
    try:
        conformance.run_checks(link, allow_motion=True, just_powered=True, on_finding=note)
    except StopIteration:
        return caught[0]
    except Exception as error:
        return f"conformance suite: {type(error).__name__} {error}"
    for rule in RULES:
        try:
            rule(Bench(LockstepLink(robot), allow_motion=True, just_powered=True))
        except Broken as broken:
            return f"{rule.__name__}: {broken}"
        except Exception as error:
            return f"{rule.__name__}: {type(error).__name__} {error}"
    return None


# The mutants


@dataclass(frozen=True)
class Mutant:
    """A way to break the board, and to mend it again."""

    name: str
    broken: Callable[[], contextlib.AbstractContextManager[object]]


def without_check(op: Op, check: interlocks.Check) -> Mutant:
    left = tuple(c for c in interlocks.CHECKS[op] if c is not check)
    return Mutant(
        f"{op.name} without {check.__name__}",
        lambda: mock.patch.dict(interlocks.CHECKS, {op: left}),
    )


def limit(module: Any, name: str, value: float) -> Mutant:
    return Mutant(f"{name} = {value:g}", lambda: mock.patch.object(module, name, value))


def source(target: str, old: str, new: str) -> Mutant:
    """One place in the source of a function, given as module:qualified.name."""
    label = " ".join(f"{old.strip()} -> {new.strip() or 'nothing'}".split())
    return Mutant(f"{target.split(':')[1]}: {label}", lambda: _rewritten(target, old, new))


@contextlib.contextmanager
def _rewritten(target: str, old: str, new: str) -> Iterator[None]:
    module_name, name = target.split(":")
    module = importlib.import_module(f"muxjax.hardware.{module_name}")
    found: Any = module
    for part in name.split("."):
        found = inspect.getattr_static(found, part)
    function: FunctionType = getattr(inspect.unwrap(found), "fget", None) or inspect.unwrap(found)
    text = textwrap.dedent(inspect.getsource(function))
    if text.count(old) != 1:
        raise LookupError(f"{target}: {text.count(old)} places read {old!r}, must be one")
    kept, function.__code__ = function.__code__, _compiled(text.replace(old, new), function)
    _forget()
    try:
        yield
    finally:
        function.__code__ = kept
        _forget()


def _compiled(text: str, function: FunctionType) -> CodeType:
    # Annotations stay words, as in the modules themselves.
    outer = compile(f"from __future__ import annotations\n{text}", function.__code__.co_filename,
                    "exec", dont_inherit=True)  # fmt: skip
    return next(
        c for c in outer.co_consts
        if isinstance(c, CodeType) and c.co_name == function.__code__.co_name
    )  # fmt: skip


def _forget() -> None:
    """Frames decoded by a mutant must not be remembered."""
    protocol._decode.cache_clear()


def mutants() -> list[Mutant]:
    checks = [without_check(op, c) for op, found in interlocks.CHECKS.items() for c in found]
    limits = [
        limit(interlocks, "SERVO_LIMIT_BITS", protocol.SERVO_LIMIT_BITS + 1),
        limit(interlocks, "TURNS_SLACK_M", 0.0),
        limit(interlocks, "TURNS_SLACK_M", 2 * interlocks.TURNS_SLACK_M),
        limit(interlocks, "MAX_DIVIDER", protocol.MAX_DIVIDER + 1),
        limit(virtual_board, "WATCHDOG_S", 1.4 * protocol.WATCHDOG_S),
        limit(virtual_board, "WATCHDOG_S", 0.8 * protocol.WATCHDOG_S),
        limit(virtual_board, "RANGE_MARGIN_M", 2 * virtual_board.RANGE_MARGIN_M),
        limit(virtual_board, "SEQUENCE_WINDOW", virtual_board.SEQUENCE_WINDOW + 1),
        limit(virtual_board, "SEQUENCE_WINDOW", virtual_board.SEQUENCE_WINDOW - 1),
        limit(virtual_board, "REMEMBERED", 16),
        limit(guards, "PATIENCE", 2),
        limit(guards, "PATIENCE", 30),
        limit(guards, "FOLLOW", 0.0),
        limit(guards, "COMPARE_EVERY", 100),
        limit(virtual_board, "WINDOW_COUNTS", 20 * guards.WINDOW_COUNTS),
        limit(importlib.import_module("muxjax.hardware.sensing"), "BAD_SAMPLES", 2),
        limit(importlib.import_module("muxjax.hardware.sensing"), "BAD_SAMPLES", 30),
        limit(importlib.import_module("muxjax.hardware.commands"), "FOLLOW", 2.0),
        limit(importlib.import_module("muxjax.hardware.commands"), "FOLLOW", -1.0),
    ]
    return [*checks, *limits, *(source(*rule) for rule in SOURCES)]


BOARD, COMMANDS, GUARDS = "virtual_board:VirtualBoard.", "commands:", "guards:Guards."

SOURCES: tuple[tuple[str, str, str], ...] = (
    # frames
    ("protocol:_decode", "frame.data[0] != frame_crc(frame.id, frame.data)", "False"),
    ("protocol:_decode", "len(frame.data) != DLC", "False"),
    ("protocol:_decode", "if frame.id == ESTOP_ID:", "if False:"),
    ("protocol:Port.unpack", "self._heard.get(frame.id) == counter", "False"),
    (BOARD + "_receive", "self.faults |= Fault.FRAMES_REFUSED", "pass"),
    (BOARD + "_receive", "self.refused[received] += 1", "pass"),
    # numbers
    (BOARD + "_command", "if seq in self._answers and not new_session:", "if False:"),
    (BOARD + "_command", " and not new_session", ""),
    (BOARD + "_command", "not 1 <= ahead <= SEQUENCE_WINDOW", "False"),
    (BOARD + "_command", "not 1 <= ahead", "not 0 <= ahead"),
    (BOARD + "_command", "refused[0] in PASSING", "False"),
    (BOARD + "_command", "elif op == Op.HELLO:", "elif False:"),
    (BOARD + "_command", "self.last_seq = seq", "pass"),
    (BOARD + "_obey", "self.last_seq = seq", "pass"),
    (BOARD + "_answer", "self._answers[seq] = (status, reason)", "pass"),
    # the session and its heart
    (BOARD + "greet", "self._answers.clear()", "pass"),
    (BOARD + "greet", "self.words_matched.clear()", "pass"),
    (BOARD + "greet", "self._host_heard = -math.inf", "pass"),
    (BOARD + "_receive", 'elif values["Session"] == self.session:', "else:"),
    (BOARD + "_receive", 'min(values["Watchdog"] * 1e-3, WATCHDOG_S)', 'values["Watchdog"] * 1e-3'),
    (BOARD + "_receive", 'min(values["Watchdog"] * 1e-3, WATCHDOG_S)', "WATCHDOG_S"),
    (BOARD + "_watchdog_end", "self.state is BoardState.ARMED", "False"),
    # stopping
    (BOARD + "_happen", "self._stop(BoardState.SAFE, Reason.WATCHDOG)",
     "self.state = BoardState.SAFE"),
    (BOARD + "_happen", "self.faults |= Fault.WATCHDOG", "pass"),
    (BOARD + "_estop", "self._stop(BoardState.ESTOPPED, Reason.ESTOPPED)",
     "self.state = BoardState.ESTOPPED"),
    (BOARD + "_estop", "self._stop(BoardState.ESTOPPED, Reason.ESTOPPED)",
     "self._stop(BoardState.SAFE, Reason.ESTOPPED)"),
    (BOARD + "_estop", "self.faults |= Fault.ESTOP", "pass"),
    (BOARD + "_stop", "self.words_matched.clear()", "pass"),
    (BOARD + "_stop", "self.abort_job(reason)", "self._job = None"),
    (BOARD + "_stop", "self._start_job(come_to_rest(self), None)", "pass"),
    (BOARD + "_trip", "self.faults |= FAULTS[trip.reason]", "pass"),
    (BOARD + "_trip", "self._stop(BoardState.SAFE, trip.reason, trip.index)", "pass"),
    (COMMANDS + "disarm", "board.state = BoardState.READY", "pass"),
    (COMMANDS + "disarm", "board.words_matched.clear()", "pass"),
    (COMMANDS + "disarm", "board.abort_job(Reason.DISARMED)", "pass"),
    (COMMANDS + "come_to_rest", "board.staged.clear()", "pass"),
    (COMMANDS + "come_to_rest", "if board.mechanics.moving:", "if False:"),
    (COMMANDS + "come_to_rest", "board.energised.clear()", "pass"),
    (COMMANDS + "come_to_rest", "board.suspects |= held", "pass"),
    (COMMANDS + "come_to_rest", "board.verified.clear()", "pass"),
    # clutches and drum
    (COMMANDS + "_turn_axial", "if board.suspects and board.slot >= 0:", "if False:"),
    (COMMANDS + "_turn_axial", "board.verified |= followed", "pass"),
    (COMMANDS + "_turn_axial", "board.axial_turning, board.slot = True, -1",
     "board.axial_turning = True"),
    (COMMANDS + "_engage", "board.verified |= followed", "board.verified |= wanted.keys()"),
    (COMMANDS + "_engage", "Reason.NONE if followed == wanted.keys() else Reason.NOT_SEATED",
     "Reason.NONE"),
    (COMMANDS + "_release", "wanted.keys() - followed", "wanted.keys()"),
    (COMMANDS + "_release", "Reason.NOT_RELEASED if followed else Reason.NONE", "Reason.NONE"),
    (COMMANDS + "_probe", "if must_turn and", "if False and"),
    # lost turns
    (BOARD + "_power_up", "self.senses.lose_turns()", "pass"),
    (BOARD + "_power_up", "self.faults = Fault.TURNS_LOST", "pass"),
    (COMMANDS + "turns", "board.faults &= ~Fault.TURNS_LOST", "pass"),
    (COMMANDS + "arm", "board.senses.turns_are_settled()", "pass"),
    # guards
    (GUARDS + "look", "board.volts < limits.controller.lowest_v", "False"),
    (GUARDS + "look", "board.coils.temperature > limits.coil.limit_c", "False"),
    (GUARDS + "look", "board.senses.offline & used.keys()", "set()"),
    (GUARDS + "look", "board.senses.offline & used.keys()", "board.senses.offline"),
    (GUARDS + "look", "board.senses.stalled() & used.keys()", "set()"),
    (GUARDS + "look", "board.senses.failed_wheels() & set(used.values())", "set()"),
    (GUARDS + "look", " & set(used.values())", ""),
    (GUARDS + "look", "self._compare(board, used)", "pass"),
    (BOARD + "_tick", "self.guards.look(self)", "pass"),
)  # fmt: skip


def score() -> tuple[list[str], list[str]]:
    """Run every mutant; what was caught and by what, and what was not."""
    robot = muxjax.load_robot("muxarm")
    caught, survived = [], []
    for mutant in mutants():
        with mutant.broken():
            by = caught_by(robot)
        (survived if by is None else caught).append(f"{mutant.name}   [{by}]")
    return caught, survived


def main() -> int:
    """Print the score."""
    began = time.perf_counter()
    if (by := caught_by(muxjax.load_robot("muxarm"))) is not None:
        print(f"the board as it is breaks {by}")
        return 2
    caught, survived = score()
    print(*caught, sep="\n")
    print(*(f"SURVIVED {line}" for line in survived), sep="\n")
    total = len(caught) + len(survived)
    print(
        f"{len(caught)} of {total} mutants caught, {100 * len(caught) / total:.1f} %, "
        f"in {time.perf_counter() - began:.0f} s"
    )
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
