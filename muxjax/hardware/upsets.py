"""What a fault does to a virtual board, and how it passes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from muxjax.hardware.faults import BROWN_OUT_S, FaultConfig, FaultKind
from muxjax.hardware.protocol import MAGNET, PARITY

if TYPE_CHECKING:
    from muxjax.hardware.virtual_board import VirtualBoard

T = TypeVar("T")
Undo = Callable[[], object] | None  # what ends the fault, if anything does


def upset(board: VirtualBoard, fault: FaultConfig, at: int) -> None:
    """Let a fault begin at a servo or tendon (from 0); it passes after its ``for_s``."""
    undo = _BEGIN[fault.kind](board, at, fault)
    if fault.for_s is not None and undo is not None:
        board.plan(fault.for_s, undo)


def _stall(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    board.mechanics.jam(at)
    return lambda: board.mechanics.jammed.discard(at)


def _offline(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    board.senses.offline.add(at)
    board.mechanics.jam(at)

    def undo() -> None:
        board.senses.offline.discard(at)
        board.mechanics.jammed.discard(at)

    return undo


def _slip(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    board.mechanics.throw_out(at)
    return None


def _member(board: VirtualBoard, members: set[T], item: T) -> Undo:
    members.add(item)
    return lambda: members.discard(item)


def _clutch_dead(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    return _member(board, board.mechanics.dead_plugs, at)


def _clutch_stuck(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    return _member(board, board.mechanics.stuck_plugs, at)


def _encoder_stuck(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    stuck = board.senses.encoders.stuck
    stuck[at] = board.senses.raw(at)
    return lambda: stuck.pop(at, None)


def _status(bit: int) -> Callable[[VirtualBoard, int, FaultConfig], Undo]:
    def begin(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
        broken = board.senses.encoders.broken
        broken[at] = broken.get(at, 0) | bit
        return lambda: broken.pop(at, None)

    return begin


def _coil_heat(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    board.coils.faulty = True
    return lambda: setattr(board.coils, "faulty", False)


def _undervoltage(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    limits = board.physics.controller
    board.volts = (limits.lowest_v + limits.brown_out_v) / 2
    return lambda: setattr(board, "volts", board.physics.supply_v)


def _brown_out(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    board.power_cycle(BROWN_OUT_S if fault.for_s is None else fault.for_s)
    return None


def _hang(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    board.halt()
    boots = board.boots

    def reset() -> None:
        if board.boots == boots:
            board.power_cycle(0.0)

    board.plan(board.physics.controller.hardware_watchdog_s, reset)
    return None


def _cable(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    return _member(board, board.cut_off, FaultKind.CABLE)


def _bus_off(board: VirtualBoard, at: int, fault: FaultConfig) -> Undo:
    board.cut_off.add(FaultKind.BUS_OFF)
    return None


_BEGIN: dict[FaultKind, Callable[[VirtualBoard, int, FaultConfig], Undo]] = {
    FaultKind.SERVO_STALL: _stall,
    FaultKind.SERVO_OFFLINE: _offline,
    FaultKind.CLUTCH_SLIP: _slip,
    FaultKind.CLUTCH_DEAD: _clutch_dead,
    FaultKind.CLUTCH_STUCK: _clutch_stuck,
    FaultKind.ENCODER_STUCK: _encoder_stuck,
    FaultKind.ENCODER_PARITY: _status(PARITY),
    FaultKind.ENCODER_MAGNET: _status(MAGNET),
    FaultKind.COIL_HEAT: _coil_heat,
    FaultKind.UNDERVOLTAGE: _undervoltage,
    FaultKind.BROWN_OUT: _brown_out,
    FaultKind.HANG: _hang,
    FaultKind.BUS_OFF: _bus_off,
    FaultKind.CABLE: _cable,
}
