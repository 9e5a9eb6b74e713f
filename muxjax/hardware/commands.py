"""What the board's commands do. Each handler returns a job if it takes time.

A job is a generator that yields when it is to go on [s] and returns how it ended.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from muxjax.hardware.encoders import COUNTS_PER_RAD
from muxjax.hardware.guards import FOLLOW, Trip
from muxjax.hardware.physics import axial_time, move_time, probe_time
from muxjax.hardware.protocol import SERVO_BITS_PER_RAD, BoardState, Fault, Op, Reason

if TYPE_CHECKING:
    from muxjax.hardware.virtual_board import VirtualBoard

Job = Generator[float, None, Reason]


def hello(board: VirtualBoard, idx: int, arg: int) -> None:
    """A session begins."""
    board.greet(arg & 0xFFFF)


def robot(board: VirtualBoard, idx: int, arg: int) -> None:
    """A word of the robot's hash was right."""
    board.words_matched.add(idx)


def turns(board: VirtualBoard, idx: int, arg: int) -> None:
    """A wheel's whole turns, which a reset had lost."""
    wheel, whole = turns_of(arg)
    board.senses.tell(wheel, whole)
    if not board.senses.unknown:
        board.faults &= ~Fault.TURNS_LOST


def turns_of(arg: int) -> tuple[int, int]:
    """Wheel (from 0) and turns of the arg of TURNS."""
    return (arg >> 16) - 1, ((arg & 0xFFFF) ^ 0x8000) - 0x8000


def set_stream(board: VirtualBoard, idx: int, arg: int) -> None:
    """Streams at 1 / arg of their rates."""
    board.start_streams(arg)


def arm(board: VirtualBoard, idx: int, arg: int) -> None:
    """The session may move."""
    board.senses.turns_are_settled()
    board.state = BoardState.ARMED


def disarm(board: VirtualBoard, idx: int, arg: int) -> Job | None:
    """The session moves no more."""
    board.state = BoardState.READY
    board.words_matched.clear()
    if not board.busy and not board.energised and not board.verified:
        return None
    board.abort_job(Reason.DISARMED)
    return come_to_rest(board)


def come_to_rest(board: VirtualBoard) -> Job:
    """Brake, then take the clutches off."""
    board.staged.clear()
    board.guards.end_move()
    if board.mechanics.moving:
        board.mechanics.brake(board.physics.brake_s)
        yield board.mechanics.end
    board.axial_turning = False
    held = board.energised | board.verified
    board.energised.clear()
    if held:
        yield board.now + board.physics.clutch_out_s
        board.mechanics.unseat(held)
        board.suspects |= held
    board.verified.clear()
    return Reason.NONE


def axial(board: VirtualBoard, idx: int, arg: int) -> Job | None:
    """The drum turns to a position."""
    return None if arg - 1 == board.slot and not board.suspects else _turn_axial(board, arg - 1)


def _turn_axial(board: VirtualBoard, slot: int) -> Job:
    if board.suspects and board.slot >= 0:  # clutches taken off in a hurry were never checked
        servos = {c: s for s, c in enumerate(board.facing[board.slot]) if c in board.suspects}
        followed = yield from _probe(board, servos, must_turn=False)
        if followed:
            board.verified |= followed
            return Reason.NOT_RELEASED
    board.suspects.clear()
    if slot != board.slot:
        way = abs(slot * 2 * math.pi / len(board.facing) - math.radians(board.senses.axial_deg()))
        board.axial_turning, board.slot = True, -1
        board.mechanics.rotate_axial(slot, axial_time(board.robot, board.physics, way))
        yield board.mechanics.end
        board.axial_turning, board.slot = False, slot
    return Reason.NONE


def engage(board: VirtualBoard, idx: int, arg: int) -> Job:
    """Clutches in, seen to be so by both encoders."""
    return _engage(board, board.clutches_in(arg))


def _engage(board: VirtualBoard, wanted: Mapping[int, int]) -> Job:
    board.energised |= wanted.keys()
    yield board.now + board.physics.clutch_in_s
    board.mechanics.press({servo: tendon for tendon, servo in wanted.items()})
    followed = yield from _probe(board, wanted)
    board.verified |= followed
    return Reason.NONE if followed == wanted.keys() else Reason.NOT_SEATED


def release(board: VirtualBoard, idx: int, arg: int) -> Job:
    """Clutches out, seen to be so."""
    return _release(board, board.clutches_in(arg))


def _release(board: VirtualBoard, wanted: Mapping[int, int]) -> Job:
    board.energised -= wanted.keys()
    yield board.now + board.physics.clutch_out_s
    board.mechanics.unseat(wanted.keys())
    followed = yield from _probe(board, wanted)
    board.verified -= wanted.keys() - followed
    return Reason.NOT_RELEASED if followed else Reason.NONE


def _probe(
    board: VirtualBoard, tendons: Mapping[int, int], must_turn: bool = True
) -> Generator[float, None, set[int]]:
    """Turn the servos a little and back; which of {tendon: servo} had a wheel that followed.

    Each turns towards the middle of its tendon's range, so that no probe leaves the range.

    Raises:
        Trip: A servo that must turn did not.
    """
    angle = math.radians(board.physics.probe_angle_deg)
    half = probe_time(board.robot, board.physics) / 2
    wheels, servos = board.senses.wheel_counts(), board.senses.servo_bits()
    centre = board.limits.mean(axis=1) - board.senses.displacements()
    by = {s: angle if centre[c] > 0 else -angle for c, s in tendons.items()}
    board.mechanics.turn(by, half)
    yield from _turned(board)
    turned = np.abs(board.senses.servo_bits() - servos)
    for servo in sorted(by):
        if must_turn and turned[servo] < FOLLOW * angle * SERVO_BITS_PER_RAD:
            offline = servo in board.senses.offline
            raise Trip(Reason.SERVO_OFFLINE if offline else Reason.SERVO_STALLED, servo + 1)
    moved = np.abs(board.senses.wheel_counts() - wheels)
    board.mechanics.turn({s: -a for s, a in by.items()}, half)
    yield from _turned(board)
    expected = angle / float(board.robot.gear_ratio) * COUNTS_PER_RAD
    return {c for c in tendons if moved[c] > FOLLOW * expected}


def _turned(board: VirtualBoard) -> Generator[float, None, None]:
    """Wait until servos that turn should be there, and the UART has heard it."""
    yield board.mechanics.end
    if (told := board.mechanics.next_told()) > board.now:
        yield told


def stage(board: VirtualBoard, idx: int, arg: int) -> None:
    """A servo's next target."""
    board.staged[idx - 1] = arg / SERVO_BITS_PER_RAD


def start(board: VirtualBoard, idx: int, arg: int) -> Job:
    """Staged servos move and end together."""
    return _move(board, {s: board.staged.pop(s) for s in board.servos_in(arg)})


def _move(board: VirtualBoard, targets: Mapping[int, float]) -> Job:
    sensed = board.senses.servo_bits() / SERVO_BITS_PER_RAD
    way = max(abs(target - float(sensed[s])) for s, target in targets.items())
    if (duration := move_time(board.robot, board.physics, way)) > 0:
        board.guards.begin_move(board)
        board.mechanics.turn_to(targets, duration)
        yield from _turned(board)
        board.guards.end_move()
    return Reason.NONE


HANDLERS: dict[Op, Callable[[VirtualBoard, int, int], Job | None]] = {
    Op.HELLO: hello,
    Op.ROBOT: robot,
    Op.TURNS: turns,
    Op.ARM: arm,
    Op.DISARM: disarm,
    Op.AXIAL: axial,
    Op.ENGAGE: engage,
    Op.RELEASE: release,
    Op.STAGE: stage,
    Op.START: start,
    Op.SET_STREAM: set_stream,
}
