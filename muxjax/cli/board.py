"""``muxjax board``: a virtual board as a process of its own."""

from __future__ import annotations

import json
import signal
import threading
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np

from muxjax.config import ConfigError, replacing
from muxjax.hardware import VirtualBoard
from muxjax.hardware.serving import LOOPBACK, SlcanWire, SocketcandWire, serve
from muxjax.program_file import load_program
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import check_same_robot
from muxjax.tendons import check_displacements

KEEP_S = 0.05  # between two writings of the arm's true lengths


def board(
    serve: Literal["socketcand", "slcan"] = "socketcand",
    port: int = 29536,
    robot: str = "muxarm",
    physics: str = "ideal",
    program: Path | None = None,
    arm: Path | None = None,
    seed: int = 0,
) -> int:
    """Be a virtual board in real time, until Ctrl-C, for muxjax run --bus and any python-can tool.

    Example: muxjax board --serve socketcand --port 29536

    Args:
        serve: socketcand listens on 127.0.0.1; slcan is a serial port at a pseudo-terminal, whose
            path is printed.
        port: Of socketcand; 0 for any free one.
        robot: Shipped robot or path of a YAML file.
        physics: Shipped physics (ideal, realistic, harsh) or path of a YAML file.
        program: The arm stands at this program's start; straight by default.
        arm: File that keeps the arm's true lengths while the board is off. If it is there, the arm
            stands as it says, and the board has lost its turn counts, as after a power failure.
        seed: Of everything that is drawn.
    """
    mechanism = load_robot(robot)
    start = None if program is None else _start(mechanism, program)
    found = None if arm is None else _kept(mechanism, arm)
    virtual = VirtualBoard(mechanism, physics, start if found is None else found, seed=seed)
    if found is not None:
        virtual.power_cycle(off_s=0.0)
    wire: SocketcandWire | SlcanWire
    if serve == "socketcand":
        try:
            wire = SocketcandWire(port)
        except (OSError, OverflowError) as error:  # in use, not allowed, no port at all
            raise ValueError(f"port: {port} on {LOOPBACK} cannot be served: {error}") from error
        bus: dict[str, Any] = {"interface": "socketcand", "host": LOOPBACK, "port": wire.port}
        bus |= {"channel": "can0", "tcp_tune": True}
    else:
        wire = SlcanWire()
        bus = {"interface": "slcan", "channel": wire.path, "sleep_after_open": 0}
    print(f"board of {robot} on {json.dumps(bus)}", flush=True)
    try:
        _serve(virtual, wire, arm)
    finally:
        wire.close()
    return 0


def _start(mechanism: Robot, path: Path) -> tuple[float, ...]:
    program = load_program(path)
    check_same_robot(mechanism, program)
    return program.start


def _serve(virtual: VirtualBoard, wire: SocketcandWire | SlcanWire, arm: Path | None) -> None:
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    due = 0.0

    def stopped() -> bool:
        nonlocal due
        if arm is not None and (time.monotonic() >= due or stop.is_set()):
            due = time.monotonic() + KEEP_S
            _keep(virtual, arm)
        return stop.is_set()

    serve(virtual, wire, stopped)


def _keep(virtual: VirtualBoard, arm: Path) -> None:
    document = {
        "schema": "muxjax/arm/1",
        "robot": virtual.robot.fingerprint,
        "displacements_m": virtual.mechanics.displacements.tolist(),
        "state": virtual.state.name,
    }
    with replacing(arm) as part:
        part.write_text(json.dumps(document) + "\n", encoding="utf-8")


def _kept(robot: Robot, arm: Path) -> np.ndarray | None:
    """Lengths [m] that a board before has left; None if there was none."""
    if not arm.exists():
        return None
    try:
        document = json.loads(arm.read_text(encoding="utf-8"))
        whose = document["schema"], document["robot"]
        lengths = np.array(document["displacements_m"], dtype=np.float64)
    except KeyError as missing:
        raise ConfigError(f"{arm}: not an arm's lengths: {missing} is missing") from missing
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{arm}: not an arm's lengths: {error}") from error
    if whose != ("muxjax/arm/1", robot.fingerprint):
        raise ConfigError(f"{arm}: not the lengths of this robot ({robot.fingerprint})")
    return np.asarray(check_displacements(robot, f"{arm}: displacements_m", lengths))
