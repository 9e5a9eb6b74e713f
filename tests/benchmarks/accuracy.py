"""The accuracy experiment of M VI-B on the virtual board: `python -m tests.benchmarks.accuracy`.

Straight, to a target, and back, with 3, 2 and 1 servos and a tendon change of about 0.5 mm at
each switch of a clutch; five trials, each with its own target. Errors are of the true arm, in the
papers' kinematics, against the planned motion.

Open loop turns the servos by what the program says and never looks at the wheels. Closed loop is
the executor as it is. Where the wheel turns along with the slip its encoder sees it; where the
slip happens beyond the wheel nothing on the board can.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import muxjax
from muxjax.hardware import LockstepLink, MemoryJournal, PhysicsConfig, Run, load_physics
from muxjax.hardware.executor import Executor
from muxjax.hardware.journal import LegEntry, ProgramEntry
from muxjax.hardware.session import Script
from muxjax.hardware.visits import Visit, load_visits
from muxjax.kinematics import segment_ends
from muxjax.planning import Problem, plan
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule, waypoints
from muxjax.tendons import bending_from_displacements
from tests.benchmarks.common import ROOT, table

TRIALS = 5
SERVO_SETS = ((1, 2, 3), (1, 2), (1,))
SEED = 7
SAMPLES = 40  # along each instruction
STREAM_DIVIDER = 4
CASES = {
    # name: physics, seen, unseen, closed loop
    "open loop, slip alone": ("ideal", 0.0005, 0.0, False),
    "open loop, realistic board": ("realistic", 0.0005, 0.0, False),
    "closed loop, slip seen": ("realistic", 0.0005, 0.0, True),
    "closed loop, slip not seen": ("realistic", 0.0, 0.0005, True),
    "closed loop, no slip": ("realistic", 0.0, 0.0, True),
}
DRAWN = ("open loop, realistic board", "closed loop, slip seen")
COLOURS = ("tab:blue", "tab:orange", "tab:green")


class OpenLoop(Executor):
    """An executor that believes its servos: no wheel is looked at, nothing is trimmed."""

    def __init__(self, robot: Robot, journal: MemoryJournal, session: int, divider: int) -> None:
        super().__init__(robot, journal, session, divider)
        self._believed = np.array(self.program.start)

    def _move_all(self, number: int, visit: Visit, first_leg: int) -> Script[int]:
        ratio = float(self.robot.servo_per_metre)
        since = self._now
        servos, wheels = [s - 1 for s in visit.tendons], [c - 1 for c in visit.tendons.values()]
        yield from self._expect(lambda: self.sensors.fresh(servos, wheels, since), "the servos")
        zero = {
            s: self.sensors.servo_rad[s - 1] - self._believed[c - 1] * ratio
            for s, c in visit.tendons.items()
        }
        for leg, goals in enumerate(visit.legs, start=1):
            by_tendon = {visit.tendons[s]: m for s, m in goals.items()}
            self._write(
                LegEntry(visit=number, leg=leg, goals=by_tendon, lengths=self._heard_lengths())
            )
            yield from self._move(visit, _bits({s: zero[s] + m * ratio for s, m in goals.items()}))
            for tendon, metres in by_tendon.items():
                self._believed[tendon - 1] = metres
        return 0

    def _mend(self) -> Script[None]:
        return
        yield


def _bits(angles: Mapping[int, float]) -> dict[int, int]:
    return {servo: round(np.rad2deg(angle) * 10) for servo, angle in angles.items()}


@dataclass(frozen=True, eq=False)
class Trial:
    """One run there and back.

    Attributes:
        poses: True poses of the sections' ends, shape (T, S, 4, 4).
        planned: The planned ones nearest to them.
        at_target: Which of the T samples is at the target.
    """

    poses: np.ndarray
    planned: np.ndarray
    at_target: int


def there_and_back(
    robot: Robot, target: np.ndarray, servos: tuple[int, ...]
) -> tuple[Program, int]:
    """One program to the target and back, and how many instructions it takes to the target."""
    straight = np.zeros_like(target)
    out = schedule(robot, plan(robot, Problem(straight, target, servos=servos)))
    home = schedule(robot, plan(robot, Problem(target, straight, servos=servos)))
    whole = Program(
        robot=out.robot,
        fingerprint=out.fingerprint,
        start=out.start,
        target=home.target,
        axial=None,
        servos=servos,
        instructions=(*out.instructions, *home.instructions),
    )
    return whole, len(out.instructions)


def execute(program: Program, link: LockstepLink, closed: bool) -> Run:
    """Run a program in either way."""
    if closed:
        return muxjax.execute(program, link)
    journal = MemoryJournal()
    goals = tuple(tuple(dict(leg) for leg in v.legs) for v in load_visits(link.robot, program))
    journal.write(ProgramEntry(program=program, goals=goals))
    host = OpenLoop(link.robot, journal, link.new_session(), link.stream_divider)
    frames = []
    while not host.finished:
        link.send(host.step(link.now, frames))
        frames = link.wait(host.next_time)
    return host.result(link.trajectory)


def nearest(path: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points on a polyline nearest to some points, all in tendon space."""
    a, b = path[:-1], path[1:]
    way = b - a
    length = np.maximum((way**2).sum(axis=1), 1e-30)
    part = np.clip(np.einsum("psd,sd->ps", points[:, None] - a, way) / length, 0.0, 1.0)
    on = a + part[..., None] * way
    best = ((points[:, None] - on) ** 2).sum(axis=-1).argmin(axis=1)
    return on[np.arange(len(points)), best]


def poses_of(robot: Robot, displacements: np.ndarray) -> np.ndarray:
    """Poses of the sections' ends, shape (T, S, 4, 4)."""
    return np.asarray(segment_ends(robot, bending_from_displacements(robot, displacements)))


def trial(
    robot: Robot, program: Program, outward: int, physics: PhysicsConfig, closed: bool, seed: int
) -> Trial:
    """Run and compare every instruction with its planned path."""
    link = LockstepLink(robot, physics, stream_divider=STREAM_DIVIDER, seed=seed)
    run = execute(program, link, closed)
    if not run.completed or run.trajectory is None:
        raise RuntimeError(f"seed {seed}: {run.reason}")
    true, planned, at_target = [], [], 0
    for number, (path, record) in enumerate(
        zip(waypoints(robot, program), run.records, strict=True), start=1
    ):
        points = run.trajectory.at(np.linspace(record.start_s, record.end_s, SAMPLES))
        true.append(points)
        on_path = nearest(path, points)
        on_path[-1] = path[-1]  # at its end an instruction has a place to be
        planned.append(on_path)
        if number == outward:
            at_target = sum(map(len, true)) - 1
    return Trial(poses_of(robot, np.vstack(true)), poses_of(robot, np.vstack(planned)), at_target)


def errors(poses: np.ndarray, planned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [mm] and angles [degree] between poses."""
    position = 1e3 * np.linalg.norm(poses[..., :3, 3] - planned[..., :3, 3], axis=-1)
    turn = np.swapaxes(planned[..., :3, :3], -1, -2) @ poses[..., :3, :3]
    vee = np.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0],
         turn[..., 1, 0] - turn[..., 0, 1]], axis=-1,
    )  # fmt: skip
    trace = np.trace(turn, axis1=-2, axis2=-1)
    return position, np.rad2deg(np.arctan2(np.linalg.norm(vee, axis=-1), trace - 1))


def rmse(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def measure(robot: Robot) -> dict[str, dict[tuple[int, ...], list[Trial]]]:
    """All trials: case, servos, trial."""
    rng = np.random.default_rng(SEED)
    q = np.stack(
        [rng.uniform(0.2, 1.6, (TRIALS, robot.n_segments)),
         rng.uniform(0.0, 2 * np.pi, (TRIALS, robot.n_segments))], axis=-1,
    ).reshape(TRIALS, -1)  # fmt: skip
    targets = muxjax.tendon_displacements(robot, q)
    programs = {s: [there_and_back(robot, t, s) for t in targets] for s in SERVO_SETS}
    found: dict[str, dict[tuple[int, ...], list[Trial]]] = {}
    for case, (name, seen, unseen, closed) in CASES.items():
        base = load_physics(name)
        slips = {"slip_seen_m": seen, "slip_unseen_m": unseen}
        physics = base.model_copy(update={"clutch": base.clutch.model_copy(update=slips)})
        found[case] = {
            servos: [
                trial(robot, *made, physics, closed, seed=100 * len(servos) + k)
                for k, made in enumerate(programs[servos])
            ]
            for servos in SERVO_SETS
        }
    return found


def summary(trials: list[Trial], tip: int) -> list[str]:
    """At the target and over the whole motion, tip; at the target, each section's end."""
    at = [errors(t.poses[t.at_target], t.planned[t.at_target]) for t in trials]
    whole = [errors(t.poses[:, tip], t.planned[:, tip]) for t in trials]
    position, angle = (np.array([a[k] for a in at]) for k in (0, 1))
    cells = [f"{rmse(position[:, tip]):.2f} mm, {rmse(angle[:, tip]):.2f}°"]
    along = [np.concatenate([w[k] for w in whole]) for k in (0, 1)]
    cells.append(f"{rmse(along[0]):.2f} mm, {rmse(along[1]):.2f}°")
    for section in range(tip):
        cells.append(f"{rmse(position[:, section]):.2f} mm, {rmse(angle[:, section]):.2f}°")
    return cells


def draw(found: Mapping[str, Mapping[tuple[int, ...], list[Trial]]], path: Path) -> None:
    """As M Fig. 7d-e: solid there, dashed back, a colour for each number of servos."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(10, 4.5 * len(found)))
    for row, (case, trials) in enumerate(found.items()):
        space, turn = (
            figure.add_subplot(len(found), 2, 2 * row + k, projection="3d") for k in (1, 2)
        )
        for colour, (servos, made) in zip(COLOURS, trials.items(), strict=True):
            one = made[0]
            there, back = slice(0, one.at_target + 1), slice(one.at_target, None)
            for part, style in ((there, "-"), (back, "--")):
                tip = one.poses[part, -1]
                label = f"{len(servos)} servos" if style == "-" else None
                space.plot(*(1e3 * tip[:, :3, 3]).T, style, color=colour, label=label, linewidth=1)
                turn.plot(*tip[:, :3, 2].T, style, color=colour, linewidth=1)
            space.scatter(*(1e3 * one.poses[one.at_target, :, :3, 3]).T, color=colour, s=14)
            turn.scatter(*one.poses[one.at_target, -1, :3, 2], color=colour, s=14)
        wanted = one.planned[one.at_target]
        space.scatter(*(1e3 * wanted[:, :3, 3]).T, color="black", marker="x")
        turn.scatter(*wanted[-1, :3, 2], color="black", marker="x")
        space.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", title=f"tip: {case}")
        turn.set(xlabel="x", ylabel="y", zlabel="z", title=f"direction of its axis: {case}")
        space.legend(loc="upper left", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    """Measure, print the table, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    picture = ROOT / "docs" / "images" / "accuracy.png"
    parser.add_argument("--picture", type=Path, default=picture)
    options = parser.parse_args()
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
    draw({case: found[case] for case in DRAWN}, options.picture)


if __name__ == "__main__":
    main()
