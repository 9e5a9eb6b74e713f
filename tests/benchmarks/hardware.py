"""Speed of the lockstep board and load of its bus: `python -m tests.benchmarks.hardware`."""

from __future__ import annotations

import time

import muxjax
from muxjax.hardware import LockstepLink
from muxjax.planning import Problem, plan
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule
from tests.benchmarks.common import machine, spread, table

ROUNDS = 5
DIVIDERS = (1, 4, 20)


def program(robot: Robot) -> Program:
    """A plan from the straight arm with all servos: moves and switching as they are."""
    q = [0.9, 0.4, 0.7, 2.5, 0.6, 4.0]
    target = muxjax.tendon_displacements(robot, q)
    return schedule(robot, plan(robot, Problem(0 * target, target)))


def main() -> None:
    """Measure and print."""
    robot = muxjax.load_robot("muxarm")
    made = program(robot)
    rows = []
    for physics in ("ideal", "realistic"):
        for divider in DIVIDERS:
            ratios = []
            for number in range(ROUNDS + 1):
                link = LockstepLink(robot, physics, stream_divider=divider, seed=number)
                begin = time.process_time()
                run = muxjax.execute(made, link)
                took = time.process_time() - begin
                if not run.completed:
                    raise RuntimeError(f"seed {number}: {run.reason}")
                if number:  # the first round warms up
                    ratios.append(link.now / took)
            middle, low, high = spread(ratios)
            load = (
                f"{100 * link.bus.busy_s / link.now:.1f} %" if link.bus.busy_s else "not modelled"
            )
            rows.append(
                [
                    physics,
                    str(divider),
                    f"{middle:.0f} ({low:.0f}-{high:.0f})",
                    f"{link.frames / link.now:.0f}",
                    load,
                ]
            )
    header = ["physics", "stream divider", "times real time (quartiles)", "frames/s", "bus load"]
    print(table(header, rows))
    print(machine())


if __name__ == "__main__":
    main()
