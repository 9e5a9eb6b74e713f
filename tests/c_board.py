"""The C reference of the board, compiled for this machine and driven through ctypes.

``Plant`` is the hardware behind it: constant speeds, every clutch seats, nothing slips. It is
written apart from the virtual board's mechanics, so that the two boards share no code but the
protocol.
"""

from __future__ import annotations

import ctypes as c
import math
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from muxjax.hardware import load_physics
from muxjax.hardware.firmware import write_firmware
from muxjax.hardware.physics import PhysicsConfig, axial_time
from muxjax.hardware.protocol import COUNTS_PER_TURN, SERVO_BITS_PER_RAD, BoardState, Frame
from muxjax.robot import Robot

FLAGS = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror")

# What ctypes needs to know of struct board without repeating its layout.
SHIM = """
#include "board.h"
size_t shim_size(void) { return sizeof(struct board); }
const struct board_frame *shim_out(const struct board *b) { return b->out; }
unsigned shim_out_count(const struct board *b) { return b->out_count; }
unsigned shim_dropped(const struct board *b) { return b->out_dropped; }
unsigned shim_state(const struct board *b) { return b->state; }
"""


def compiler() -> str:
    """The host's C compiler; the test is skipped where there is none."""
    found = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if found is None:
        pytest.skip("no C compiler (cc, gcc or clang) on this machine")
    return found


def build(folder: Path, robot: Robot, extra: dict[str, str]) -> c.CDLL:
    """Write the firmware, add files {name: text}, compile all and load it."""
    command = compiler()
    write_firmware(folder, robot, load_physics("ideal"))
    for name, text in extra.items():
        (folder / name).write_text(text)
    sources = sorted(str(path) for path in folder.glob("*.c"))
    library = folder / "board.so"
    built = subprocess.run(
        [command, *FLAGS, "-shared", "-fPIC", "-o", str(library), *sources, "-lm"],
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    return c.CDLL(str(library))


class CFrame(c.Structure):
    _fields_ = [("id", c.c_uint16), ("length", c.c_uint8), ("data", c.c_uint8 * 8)]


_CALLS = {
    "servo_position": c.CFUNCTYPE(c.c_int32, c.c_void_p, c.c_uint8),
    "servo_status": c.CFUNCTYPE(c.c_uint8, c.c_void_p, c.c_uint8),
    "servo_goals": c.CFUNCTYPE(None, c.c_void_p, c.c_uint16, c.POINTER(c.c_int32), c.c_uint16),
    "servo_stop": c.CFUNCTYPE(None, c.c_void_p),
    "axial_turn": c.CFUNCTYPE(None, c.c_void_p, c.c_uint8),
    "axial_stop": c.CFUNCTYPE(None, c.c_void_p),
    "axial_moving": c.CFUNCTYPE(c.c_bool, c.c_void_p),
    "axial_angle": c.CFUNCTYPE(c.c_uint16, c.c_void_p),
    "clutch_coil": c.CFUNCTYPE(None, c.c_void_p, c.c_uint8, c.c_bool),
    "clutch_temperature": c.CFUNCTYPE(c.c_uint8, c.c_void_p),
    "wheel_angle": c.CFUNCTYPE(c.c_uint16, c.c_void_p, c.c_uint8),
    "wheel_status": c.CFUNCTYPE(c.c_uint8, c.c_void_p, c.c_uint8),
    "voltage": c.CFUNCTYPE(c.c_uint16, c.c_void_p),
    "tx_errors": c.CFUNCTYPE(c.c_uint8, c.c_void_p),
    "rx_errors": c.CFUNCTYPE(c.c_uint8, c.c_void_p),
}


class Hal(c.Structure):
    _fields_ = [("context", c.c_void_p), *_CALLS.items()]


class Plant:
    """Servos, clutches, wheels and drum. Times in ms, angles in 0.1 degree, wheels in metres."""

    def __init__(self, robot: Robot, physics: PhysicsConfig, displacements: np.ndarray) -> None:
        self.robot = robot
        self.now = 0
        self.servo = [0.0] * robot.tendons_per_segment
        self.displacements = displacements.tolist()
        self.slot: int | None = None  # where the drum stands
        self.coils: dict[int, float] = {}  # tendon: when its plug began to move in
        self.released: dict[int, int] = {}  # tendon: when it was switched off; still coupled
        self.jammed: set[int] = set()  # servos that do not turn
        self.offline: set[int] = set()  # servos that do not answer either
        self.wheel_bits = [0] * robot.n_tendons
        self.stuck_wheels: dict[int, int] = {}  # tendon: counts that its encoder stays at
        self.centivolts = 2400
        self.dead_plugs: set[int] = set()  # tendons
        self._mask = 0  # servos that were told to turn
        self._clutch_ms = round(physics.clutch_in_s * 1e3), round(physics.clutch_out_s * 1e3)
        self._axial_ms = math.ceil(axial_time(robot, physics, 0.0) * 1e3 - 1e-6)
        self._axial_due: int | None = None
        self._axial_goal = 0
        self._rate = [0.0] * len(self.servo)  # per ms
        self._until = 0
        self._metres_per_bit = 1 / (SERVO_BITS_PER_RAD * float(robot.servo_per_metre))
        self._counts_per_metre = COUNTS_PER_TURN / (2 * math.pi * float(robot.wheel_radius))

    def advance(self, now: int) -> None:
        for _ in range(now - self.now):
            self._drop_released()
            moving = self.now < self._until
            self.now += 1
            if moving:
                self._turn_servos()
        self._drop_released()

    def _drop_released(self) -> None:
        for tendon, at in list(self.released.items()):
            if self.now >= at + self._clutch_ms[1]:
                del self.released[tendon]

    def _turn_servos(self) -> None:
        for servo, rate in enumerate(self._rate):
            if servo in self.jammed:
                continue
            self.servo[servo] += rate
            tendon = self._met(servo)
            if tendon is not None and self._coupled(tendon):
                self.displacements[tendon] += rate * self._metres_per_bit

    def _met(self, servo: int) -> int | None:
        return None if self.slot is None else int(self.robot.axial_map[self.slot, servo])

    def _coupled(self, tendon: int) -> bool:
        on = self.coils.get(tendon)
        seated = on is not None and self.now > on + self._clutch_ms[0]
        return seated or tendon in self.released

    # What the board's code calls

    def servo_position(self, _: None, servo: int) -> int:
        return round(self.servo[servo])

    def servo_status(self, _: None, servo: int) -> int:
        strained = servo in self.jammed and self._mask >> servo & 1 and self.now < self._until
        return 8 if servo in self.offline else 4 * bool(strained)

    def servo_goals(self, _: None, mask: int, goals: list[int], within: int) -> None:
        for s, at in enumerate(self.servo):
            self._rate[s] = (goals[s] - at) / within if mask >> s & 1 and within else 0.0
        self._until, self._mask = self.now + within, mask

    def servo_stop(self, _: None) -> None:
        self._until = self.now

    def axial_turn(self, _: None, position: int) -> None:
        assert not any(self._coupled(t) for t in range(self.robot.n_tendons)), "plugs would shear"
        self.slot, self._axial_goal, self._axial_due = None, position, self.now + self._axial_ms

    def axial_stop(self, _: None) -> None:
        if self._axial_due is not None and self.now < self._axial_due:
            self._axial_due = None

    def axial_moving(self, _: None) -> bool:
        if self._axial_due is not None and self.now >= self._axial_due:
            self.slot, self._axial_due = self._axial_goal, None
        return self._axial_due is not None

    def axial_angle(self, _: None) -> int:
        return round(36000 / len(self.robot.axial_map) * self._axial_goal) % 36000

    def clutch_coil(self, _: None, tendon: int, on: bool) -> None:
        assert self._axial_due is None or not on, "a plug would meet no slot"
        if on:
            never = tendon in self.dead_plugs
            self.coils.setdefault(tendon, math.inf if never else self.now)
        elif tendon in self.coils:
            if self._coupled(tendon):
                self.released[tendon] = self.now
            del self.coils[tendon]

    def clutch_temperature(self, _: None) -> int:
        return 65

    def wheel_counts(self, tendon: int) -> int:
        if tendon in self.stuck_wheels:
            return self.stuck_wheels[tendon]
        return round(self.displacements[tendon] * self._counts_per_metre)

    def wheel_angle(self, _: None, tendon: int) -> int:
        return self.wheel_counts(tendon) % COUNTS_PER_TURN

    def wheel_status(self, _: None, tendon: int) -> int:
        return self.wheel_bits[tendon]

    def voltage(self, _: None) -> int:
        return self.centivolts

    def tx_errors(self, _: None) -> int:
        return 0

    def rx_errors(self, _: None) -> int:
        return 0


class CBoard:
    """Looks like a VirtualBoard to a LockstepLink; its code is the firmware's.

    Args:
        library: As ``build`` gave it, with SHIM among the files.
        robot: The robot it was built for.
        displacements: Tendons at power-up [m]; straight if None.
        turns_lost: Power-up without the wheels' whole turns.
    """

    def __init__(
        self,
        library: c.CDLL,
        robot: Robot,
        displacements: np.ndarray | None = None,
        turns_lost: bool = False,
    ) -> None:
        self.physics = load_physics("ideal")
        start = np.zeros(robot.n_tendons) if displacements is None else displacements
        self.plant = Plant(robot, self.physics, np.asarray(start, dtype=np.float64))
        self._library = library
        library.shim_out.restype = c.POINTER(CFrame)
        self._step = library.board_step
        self._step.argtypes = [c.c_void_p, c.c_uint32, c.POINTER(CFrame)]
        self._step.restype = None
        # Kept, because C holds only their addresses.
        self._hal = Hal(None, *[call(getattr(self.plant, name)) for name, call in _CALLS.items()])
        self._memory = c.create_string_buffer(library.shim_size())
        self._board = c.addressof(self._memory)
        counts = [self.plant.wheel_counts(tendon) for tendon in range(robot.n_tendons)]
        turns = (c.c_int8 * len(counts))(*[count // COUNTS_PER_TURN for count in counts])
        config = c.addressof(c.c_char.in_dll(library, "board_config"))
        library.board_init(
            c.c_void_p(self._board),
            c.c_void_p(config),
            c.byref(self._hal),
            c.c_uint32(0),
            c.c_uint8(1),
            None if turns_lost else turns,
        )

    @property
    def state(self) -> BoardState:
        return BoardState(self._library.shim_state(c.c_void_p(self._board)))

    @property
    def dropped(self) -> int:
        return self._library.shim_dropped(c.c_void_p(self._board))

    @property
    def next_time(self) -> float:
        return (self.plant.now + 1) * 1e-3

    def step(self, now: float, frames: Iterable[Frame] = ()) -> list[Frame]:
        out = []
        milliseconds = int(now * 1e3 + 1e-6)
        while self.plant.now < milliseconds:
            self.plant.advance(self.plant.now + 1)
            out += self._run(None)
        for frame in frames:
            out += self._run(CFrame(frame.id, len(frame.data), (c.c_uint8 * 8)(*frame.data)))
        return out

    def _run(self, frame: CFrame | None) -> list[Frame]:
        self._step(self._board, self.plant.now, None if frame is None else c.byref(frame))
        count = self._library.shim_out_count(c.c_void_p(self._board))
        sent = self._library.shim_out(c.c_void_p(self._board))
        return [Frame(sent[k].id, bytes(sent[k].data)) for k in range(count)]
