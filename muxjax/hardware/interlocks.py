"""What the virtual board refuses, and why. Limits are enforced here, whatever the host believes.

Each check looks at the board and at a command's idx and arg (counting from 1, as on the bus) and
gives a reason with the board's own value, or None. ``CHECKS`` lists them for each opcode in the
order in which they are made.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from muxjax.hardware.commands import turns_of
from muxjax.hardware.protocol import (
    MAX_DIVIDER,
    SERVO_BITS_PER_RAD,
    SERVO_LIMIT_BITS,
    VERSION,
    BoardState,
    Op,
    Reason,
)

if TYPE_CHECKING:
    from muxjax.hardware.virtual_board import VirtualBoard

# A tendon at its range's end may have slipped beyond it before the turns were lost; a wrong turn is
# much further off.
TURNS_SLACK_M = 2e-3

Refused = tuple[Reason, int]
Check = Callable[["VirtualBoard", int, int], Refused | None]


def refusal(board: VirtualBoard, op: int, idx: int, arg: int) -> Refused | None:
    """First reason not to execute a command, with the board's own value; None to go ahead."""
    if op not in CHECKS:
        return Reason.UNKNOWN_OP, 0
    found = (check(board, idx, arg) for check in CHECKS[Op(op)])
    return next((refused for refused in found if refused is not None), None)


def not_estopped(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """An emergency stop holds until power-up."""
    return (Reason.ESTOPPED, 0) if board.state is BoardState.ESTOPPED else None


def armed(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Only an armed session moves anything."""
    return None if board.state is BoardState.ARMED else (Reason.NOT_ARMED, board.state)


def not_armed(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Nobody takes an armed board from its session."""
    return (Reason.ARMED_ALREADY, board.session) if board.state is BoardState.ARMED else None


def greeted(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """A session begins with HELLO, again so after a safe stop."""
    return None if board.state is BoardState.READY else (Reason.WRONG_SESSION, board.state)


def idle(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """One job at a time."""
    return (Reason.BUSY, 0) if board.busy else None


def same_version(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """HELLO's arg carries the protocol version above the session."""
    return None if arg >> 16 == VERSION else (Reason.WRONG_VERSION, VERSION)


def same_robot(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Word idx of the robot's hash."""
    known = 1 <= idx <= len(board.words)
    own = board.words[idx - 1] if known else 0
    return None if known and arg == own else (Reason.WRONG_ROBOT, own)


def same_session(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """ARM names the session that said HELLO."""
    return None if arg == board.session else (Reason.WRONG_SESSION, board.session)


def robot_checked(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Every word of the robot's hash was compared in this session."""
    matched = len(board.words_matched)
    return None if matched == len(board.words) else (Reason.ROBOT_UNCHECKED, matched)


def host_alive(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """No arming without a heartbeat."""
    return None if board.now < board.watchdog_due else (Reason.NO_HEARTBEAT, 0)


def turns_known(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """No arming while a reset's lost turns were not told: every range check would be blind."""
    unknown = board.senses.unknown
    return (Reason.TURNS_UNKNOWN, min(unknown) + 1) if unknown else None


def supply_good(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """No arming on a sagging supply; the board's value is in 0.01 V."""
    low = board.volts < board.physics.controller.lowest_v
    return (Reason.UNDERVOLTAGE, round(100 * board.volts)) if low else None


def coils_cool(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """No arming with hot coils; the board's value is in degrees Celsius."""
    hot = board.coils.temperature > board.physics.coil.limit_c
    return (Reason.COIL_HOT, round(board.coils.temperature)) if hot else None


def turns_fit(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """A wheel that exists, whose turns were lost, and a length within its range or nearly so.

    For a wheel whose turns the board itself has counted, only its own number is taken.
    """
    wheel, whole = turns_of(arg)
    if not 0 <= wheel < board.robot.n_tendons:
        return Reason.TURNS_UNKNOWN, board.robot.n_tendons
    if not board.senses.agrees(wheel, whole):
        return Reason.TURNS_UNKNOWN, wheel + 1
    low, high = board.limits[wheel]
    length = board.senses.length_with(wheel, whole)
    inside = low - TURNS_SLACK_M <= length <= high + TURNS_SLACK_M
    return None if inside else (Reason.TENDON_RANGE, wheel + 1)


def known_axial(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Axial positions are those of the robot's map."""
    count = len(board.robot.axial_map)
    return None if 1 <= arg <= count else (Reason.UNKNOWN_AXIAL, count)


def clutches_out(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """The axial motor would shear a plug that is in."""
    held = board.energised | board.verified
    return (Reason.CLUTCH_IN, len(held)) if held else None


def axial_still(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """A plug pushed out while the axial motor turns would meet no slot."""
    return (Reason.AXIAL_MOVING, 0) if board.axial_turning else None


def in_slot(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Clutches meet their servos only at an axial position."""
    return (Reason.NOT_IN_SLOT, 0) if board.slot < 0 else None


def present_layer(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """All servos face one layer at a time (the layer constraint P_i)."""
    return None if idx == board.layer + 1 else (Reason.WRONG_LAYER, board.layer + 1)


def known_clutches(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """At least one clutch, none beyond the layer's tendons."""
    count = board.robot.tendons_per_segment
    return None if 0 < arg < 1 << count else (Reason.UNKNOWN_CLUTCH, count)


def known_servo(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Servos count from 1 to J."""
    count = board.robot.tendons_per_segment
    return None if 1 <= idx <= count else (Reason.UNKNOWN_SERVO, count)


def known_servos(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """At least one servo in START's mask, none beyond J."""
    count = board.robot.tendons_per_segment
    return None if 0 < arg < 1 << count else (Reason.UNKNOWN_SERVO, count)


def servo_coupled(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """A servo moves only with its clutch verified."""
    return None if board.tendon_of(idx - 1) is not None else (Reason.NOT_COUPLED, idx)


def servo_in_range(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Multi-turn range of the servo's own counter."""
    return (Reason.SERVO_RANGE, 0) if abs(arg) > SERVO_LIMIT_BITS else None


def tendon_in_range(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Where the wheel would end, by the encoders, lies within the tendon's range."""
    return _beyond_range(board, idx - 1, arg / SERVO_BITS_PER_RAD)


def stream_in_range(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Streams may be thinned, not stopped."""
    return None if 1 <= arg <= MAX_DIVIDER else (Reason.STREAM_RANGE, MAX_DIVIDER)


def all_staged(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """Every servo of START has a target."""
    missing = [s for s in board.servos_in(arg) if s not in board.staged]
    return (Reason.NOT_STAGED, missing[0] + 1) if missing else None


def all_coupled(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """As ``servo_coupled``, at the start of the motion."""
    loose = [s for s in board.servos_in(arg) if board.tendon_of(s) is None]
    return (Reason.NOT_COUPLED, loose[0] + 1) if loose else None


def all_in_range(board: VirtualBoard, idx: int, arg: int) -> Refused | None:
    """As ``tendon_in_range``, at the start of the motion."""
    found = (_beyond_range(board, s, board.staged[s]) for s in board.servos_in(arg))
    return next((refused for refused in found if refused is not None), None)


def _beyond_range(board: VirtualBoard, servo: int, target: float) -> Refused | None:
    tendon = board.tendon_of(servo)
    if tendon is None:
        return Reason.NOT_COUPLED, servo + 1
    sensed = board.senses.servo_bits()[servo] / SERVO_BITS_PER_RAD
    end = board.senses.displacements()[tendon] + (target - sensed) / float(
        board.robot.servo_per_metre
    )
    low, high = board.limits[tendon]
    return None if low <= end <= high else (Reason.TENDON_RANGE, tendon + 1)


MOVING: tuple[Check, ...] = (not_estopped, armed)

CHECKS: dict[Op, tuple[Check, ...]] = {
    Op.HELLO: (not_estopped, not_armed, same_version, idle),
    Op.ROBOT: (not_estopped, greeted, same_robot),
    Op.ARM: (
        not_estopped,
        not_armed,
        greeted,
        same_session,
        robot_checked,
        turns_known,
        supply_good,
        coils_cool,
        host_alive,
        idle,
    ),
    Op.TURNS: (not_estopped, not_armed, greeted, turns_fit),
    Op.DISARM: (not_estopped, armed),
    Op.AXIAL: (*MOVING, known_axial, clutches_out, idle),
    Op.ENGAGE: (*MOVING, axial_still, in_slot, present_layer, known_clutches, idle),
    Op.RELEASE: (*MOVING, axial_still, in_slot, present_layer, known_clutches, idle),
    Op.STAGE: (*MOVING, known_servo, servo_coupled, servo_in_range, tendon_in_range, idle),
    Op.START: (*MOVING, known_servos, all_staged, all_coupled, all_in_range, idle),
    Op.SET_STREAM: (greeted, stream_in_range),
}
