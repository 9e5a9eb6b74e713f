"""The table of docs/accuracy.md: `python -m tests.benchmarks.accuracy`.

Five trials, each with its own target, for every case and with 3, 2 and 1 servos.
`muxjax figure fig7` draws one case.
"""

from __future__ import annotations

import numpy as np

import muxjax
from muxjax.hardware.accuracy import CASES, Trial, random_targets, rmse, run_trial, there_and_back
from muxjax.robot import Robot
from tests.benchmarks.common import table

TRIALS = 5
SERVO_SETS = ((1, 2, 3), (1, 2), (1,))


def measure(robot: Robot) -> dict[str, dict[tuple[int, ...], list[Trial]]]:
    """All trials: case, servos, trial."""
    targets = random_targets(robot, TRIALS)
    programs = {s: [there_and_back(robot, t, s) for t in targets] for s in SERVO_SETS}
    return {
        name: {
            servos: [
                run_trial(robot, *made, case, seed=100 * len(servos) + k)
                for k, made in enumerate(programs[servos])
            ]
            for servos in SERVO_SETS
        }
        for name, case in CASES.items()
    }


def summary(trials: list[Trial], tip: int) -> list[str]:
    """At the target and over the whole motion, tip; at the target, each section's end."""
    every = [trial.errors() for trial in trials]
    whole = [np.concatenate([errors[k][:, tip] for errors in every]) for k in (0, 1)]
    at = [np.array([e[k][t.at_target] for e, t in zip(every, trials, strict=True)]) for k in (0, 1)]
    cells = [cell(at[0][:, tip], at[1][:, tip]), cell(*whole)]
    return cells + [cell(at[0][:, section], at[1][:, section]) for section in range(tip)]


def cell(position: np.ndarray, angle: np.ndarray) -> str:
    """RMSE of distances [m] and angles [rad], as a person reads them."""
    return f"{1e3 * rmse(position):.2f} mm, {np.rad2deg(rmse(angle)):.2f}°"


def main() -> None:
    """Measure and print the table."""
    robot = muxjax.load_robot("muxarm")
    found, tip = measure(robot), robot.n_segments - 1
    rows = []
    for case, by_servos in found.items():
        for servos, trials in by_servos.items():
            rows.append([case, str(len(servos)), *summary(trials, tip)])
        every = [t for trials in by_servos.values() for t in trials]
        rows.append([case, "all", *summary(every, tip)])
    sections = [f"section {k + 1} at the target" for k in range(tip)]
    print(table(["case", "servos", "tip at the target", "tip, whole motion", *sections], rows))


if __name__ == "__main__":
    main()
