"""What the virtual board reports: the periodic messages of the DBC, from its sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from muxjax.hardware.protocol import (
    BOARD_BEAT_S,
    COUNTS_PER_TURN,
    COUPLED,
    MOVING,
    OFFLINE,
    STALLED,
)

if TYPE_CHECKING:
    from muxjax.hardware.virtual_board import VirtualBoard

TICK_S = 0.01  # the fastest stream, WHEEL_FB; the others are whole multiples
CURRENT_LIMIT_A = 12.75  # of the eight-bit field
HOTTEST_C = 215  # likewise


def stream(board: VirtualBoard, tick: int) -> None:
    """Send what is due at a tick; all but the heartbeat come at 1 / divider of their rate."""
    if tick % round(BOARD_BEAT_S / TICK_S) == 0:
        heartbeat(board)
    if tick % board.stream_divider:
        return
    nth = tick // board.stream_divider
    wheels(board)
    if nth % 2 == 0:
        axial_and_clutches(board)
    if nth % 4 == 0:
        servos(board)
    if nth % 10 == 0:
        power(board)
    if nth % 20 == 0:
        turns(board)  # with the wheels: sampled at one instant


def heartbeat(board: VirtualBoard) -> None:
    """BOARD_HB."""
    board.send(
        "BOARD_HB",
        State=board.state,
        BootCount=board.boots & 0xFF,
        LastSeq=board.last_seq,
        Faults=board.faults,
        Time=board.milliseconds,
    )


def power(board: VirtualBoard) -> None:
    """POWER_FB."""
    refused = min(sum(board.refused.values()), 0xFFFF)
    board.send("POWER_FB", Voltage=board.volts, Refused=refused)


def axial_and_clutches(board: VirtualBoard) -> None:
    """AXIAL_FB and CLUTCH_FB."""
    board.send(
        "AXIAL_FB",
        InPosition=board.slot >= 0,
        Moving=board.axial_turning,
        Position=round(board.senses.axial_deg() % 360, 2) % 360,
        Slot=board.slot + 1,
    )
    coils = len(board.energised) * board.robot.config.clutch.coil_current_a.value
    board.send(
        "CLUTCH_FB",
        Layer=board.layer + 1,
        Energised=board.clutch_mask(board.energised),
        Verified=board.clutch_mask(board.verified),
        Current=min(coils, CURRENT_LIMIT_A),
        Temperature=min(round(board.coils.temperature), HOTTEST_C),
    )


def servos(board: VirtualBoard) -> None:
    """SERVO_FB of every servo."""
    turning = board.mechanics.moving and not board.axial_turning
    stalled, offline = board.senses.stalled(), board.senses.offline
    for s, bits in enumerate(board.senses.servo_bits().tolist()):
        status = MOVING * turning | COUPLED * (board.tendon_of(s) is not None)
        status |= STALLED * (s in stalled) | OFFLINE * (s in offline)
        board.send(f"SERVO_FB_{s % 3 + 1}", Group=s // 3, Position=bits / 10, Status=status)


def wheels(board: VirtualBoard) -> None:
    """WHEEL_FB of every wheel."""
    angles = (board.senses.wheel_counts() % COUNTS_PER_TURN).tolist()
    states = board.senses.status.tolist()
    for k in range(0, len(angles), 3):
        three = {f"Angle{j}": angle for j, angle in enumerate(angles[k : k + 3], start=1)}
        three |= {f"Status{j}": bits for j, bits in enumerate(states[k : k + 3], start=1)}
        board.send(f"WHEEL_FB_{k // 3 % 3 + 1}", Group=k // 9, **three)


def turns(board: VirtualBoard) -> None:
    """WHEEL_TURNS of every wheel."""
    whole = (board.senses.last_counts // COUNTS_PER_TURN).tolist()
    for k in range(0, len(whole), 6):
        six = {f"Turns{j}": turn for j, turn in enumerate(whole[k : k + 6], start=1)}
        board.send("WHEEL_TURNS", Group=k // 6, **six)
