"""How long an ESTOP takes from the call to the board, over each wire of this machine.

The board is a process of its own with an armed session in motion; both processes read the
machine's one monotonic clock. What a real bus adds is a frame of 0.14 ms and its adapter's delay.

    python -m tests.benchmarks.estop
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from multiprocessing.connection import Connection

import numpy as np

import muxjax
from muxjax.hardware import BusLink, MemoryJournal, VirtualBoard
from muxjax.hardware.executor import Executor, begin
from muxjax.hardware.links import open_bus
from muxjax.hardware.pauses import no_long_pauses
from muxjax.hardware.protocol import BoardState
from muxjax.hardware.serving import LOOPBACK, SlcanWire, SocketcandWire
from muxjax.scheduler import Instruction, Program
from tests.benchmarks.common import machine, table

LIMIT_MS = 10.0


def be_the_board(kind: str, pipe: Connection) -> None:
    """Tell when an ESTOP arrived, then be a new board."""
    robot = muxjax.load_robot("muxarm")
    wire = SocketcandWire() if kind == "socketcand" else SlcanWire()
    if isinstance(wire, SocketcandWire):
        bus = {"interface": kind, "host": LOOPBACK, "port": wire.port, "channel": "can0"}
        bus |= {"tcp_tune": True}
    else:
        bus = {"interface": kind, "channel": wire.path, "sleep_after_open": 0}
    pipe.send(json.dumps(bus))
    while True:
        board, begin = VirtualBoard(robot, axial=1), time.monotonic()
        with no_long_pauses():  # as ``serve`` does
            while board.state is not BoardState.ESTOPPED:
                left = board.next_time - (time.monotonic() - begin)
                frames = wire.receive(max(0.0, min(left, 0.01)))
                wire.send(board.step(time.monotonic() - begin, frames))
        pipe.send(time.monotonic())
        pipe.recv()
        while wire.receive(0.02):  # repetitions of the last ESTOP are not for the next board
            pass


def one_motion() -> Program:
    """A program that moves tendon 1 for ten seconds."""
    robot = muxjax.load_robot("muxarm")
    move = {1: 0.02}
    angle = {1: 0.02 * float(robot.servo_per_metre)}
    end = (0.02, *(0.0,) * (robot.n_tendons - 1))
    instruction = Instruction(1, (1,), angle, move, (move,))
    start = (0.0,) * robot.n_tendons
    return Program("muxarm", robot.fingerprint, start, end, 1, (1, 2, 3), (instruction,))


def measure(kind: str, trials: int) -> np.ndarray:
    """From the call to the board [ms], shape (trials,)."""
    near, far = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(target=be_the_board, args=(kind, far))
    process.start()
    took = []
    try:
        with open_bus(near.recv()) as bus, no_long_pauses():  # as ``execute`` does
            link = BusLink(bus, muxjax.load_robot("muxarm"))
            for _ in range(trials):
                journal = MemoryJournal()
                begin(link.robot, one_motion(), journal)
                executor = Executor(link.robot, journal, link.new_session())
                moving_at = np.inf
                while link.now < moving_at + 0.1:
                    link.send(executor.step(link.now, link.wait(executor.next_time)))
                    if executor.phase.startswith("leg") and moving_at == np.inf:
                        moving_at = link.now
                called = time.monotonic()
                executor.estop("benchmark")
                while not executor.finished:
                    link.send(executor.step(link.now))
                    if near.poll(0.002):
                        break
                took.append(1e3 * (near.recv() - called))
                near.send("another")
    finally:
        process.kill()
        process.join()
    return np.array(took)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=50)
    trials = parser.parse_args().trials
    rows = []
    for kind in ("socketcand", "slcan"):
        took = measure(kind, trials)
        late = int(np.sum(took > LIMIT_MS))
        rows.append([kind, f"{np.median(took):.2f}", f"{took.max():.2f}", f"{late} of {trials}"])
    print(machine())
    print(table(["wire", "median [ms]", "most [ms]", f"over {LIMIT_MS:g} ms"], rows))


if __name__ == "__main__":
    main()
