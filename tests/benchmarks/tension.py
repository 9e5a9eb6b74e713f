"""Tendon tension of plans, ours and the paper's, over assumed springs and tendons.

    python -m tests.benchmarks.tension [targets]
    python -m tests.benchmarks.tension posture
    python -m tests.benchmarks.tension friction

``posture``: how far constant curvature is from the statics; ``friction``: a winding loop. The
claim is "reduces tendon load by up to 50 %" (M abstract, VI-A). Targets as in Table II's protocol
(``configs/bench/table2.yaml``, seed 0), from the straight arm, with one to three servos; unlike
there, a step moves a tendon all the way.
Neither springs, tendons nor the arm's own mass are published: every figure stands with its range.
"""

from __future__ import annotations

import sys
import time
from itertools import product

import jax
import numpy as np

import muxjax
from muxjax.config import load_yaml, resolve
from muxjax.metrics import evaluate
from muxjax.metrics.protocol import Protocol
from muxjax.metrics.statistics import paired_difference, spread
from muxjax.metrics.tension import TensionProfile, tension_along
from muxjax.planning.tension import Tension
from muxjax.statics import ElasticChain, elastic_chain, forward_statics
from muxjax.statics.friction import winding_loop
from muxjax.statics.transmission import load_test, tendon_forces
from tests.benchmarks.common import machine, table

SERVO_SETS = ((1,), (1, 2), (1, 2, 3))
# 12 springs of 1.3 to 13 N/mm, 25 mm from the axis, between two discs: 6 k r^2.
BENDING = (5.0, 15.0, 50.0)  # [N m/rad]
TENDON = (5e3, 2e4, 5e4)  # [N/m]: polymer cord to steel rope, about a metre of it
MOUNTINGS = {  # gravity in the world [m/s^2]; the arm's base points up
    "hanging": (0.0, 0.0, 9.81),
    "horizontal": (9.81, 0.0, 0.0),
    "upright": (0.0, 0.0, -9.81),
}
MASS = 0.5  # of the arm beyond its base [kg]; 2.17 kg is published with the driver
BASELINES = ("sequential", "reverse", "greedy")
OURS = {
    "BeamStep, as printed": ("beamstep_printed", "paper"),
    "BeamStep, layered": ("beamstep", "paper"),
    "exact, fastest": ("exact", "fastest"),
    "exact, no-overshoot": ("exact", "no-overshoot"),
    "exact, gentle": ("exact", "gentle"),
}
SETTINGS = {name: (name, "paper") for name in BASELINES} | OURS


def programs(
    robot: muxjax.Robot, protocol: Protocol, n: int
) -> dict[tuple[str, int], list[muxjax.Program]]:
    """Of every setting and servo set, one a target."""
    found: dict[tuple[str, int], list[muxjax.Program]] = {}
    for servos, (name, (method, preset)) in product(SERVO_SETS, SETTINGS.items()):
        found[name, len(servos)] = [
            muxjax.schedule(
                robot,
                muxjax.plan(
                    robot,
                    muxjax.Problem(
                        np.zeros(robot.n_tendons),
                        protocol.target(robot, 0, number),
                        servos=servos,
                        preset=preset,
                    ),
                    method,
                ),
            )
            for number in range(1, n + 1)
        ]
    return found


def cell(values: np.ndarray) -> str:
    """Median and interquartile range."""
    middle = spread(values)
    return f"{middle.median:.1f} ({middle.iqr:.1f})"


def change(ours: np.ndarray, theirs: np.ndarray) -> str:
    """Paired difference in percent of theirs: median and 95 % interval."""
    found = paired_difference(100 * ours / theirs, np.full(len(ours), 100.0))
    return f"{found.median:+.0f} % [{found.low:+.0f}, {found.high:+.0f}]"


def report(
    profiles: dict[tuple[str, int], list[TensionProfile]],
    runs: dict[tuple[str, int], list[muxjax.Program]],
    robot: muxjax.Robot,
) -> str:
    """One table for one arm: tensions, changes against the baselines, overshoot both ways."""
    rows = []
    for (name, servos), own in profiles.items():
        peak, mean = (np.array([getattr(p, x) for p in own]) for x in ("peak", "mean"))
        changes = []
        for base in BASELINES:
            other = profiles[base, servos]
            # Only targets whose every sample was solved by both.
            both = [i for i, p in enumerate(own) if p.unsolved + other[i].unsolved == 0]
            for mine, field in ((peak, "peak"), (mean, "mean")):
                theirs = np.array([getattr(p, field) for p in other])
                enough = name not in BASELINES and len(both) > 1
                changes.append(change(mine[both], theirs[both]) if enough else "")
        formulas = np.array([evaluate(robot, p).overshoot_peak for p in runs[name, servos]])
        statics = np.array([p.overshoot()[1] for p in own])
        rows.append(
            [
                str(servos),
                name,
                cell(np.array([evaluate(robot, p).time_s for p in runs[name, servos]])),
                cell(peak[np.isfinite(peak)]),
                cell(mean[np.isfinite(mean)]),
                *changes,
                " / ".join(f"{100 * x:.0f}" for x in np.nanmedian(formulas, axis=0)),
                " / ".join(f"{100 * x:.0f}" for x in np.nanmedian(statics, axis=0)),
                f"{sum(p.unsolved for p in own)} of {sum(len(p.times) for p in own)}",
            ]
        )
    header = ["servos", "setting", "T [s]", "peak [N]", "mean [N]"]
    header += [f"{field} vs {base}" for base in BASELINES for field in ("peak", "mean")]
    header += ["overshoot peak by Eq. 5 [%]", "by statics [%]", "unsolved"]
    return table(header, rows)


def surrogate_error(robot: muxjax.Robot, chain: ElasticChain, term: Tension, n: int = 200) -> str:
    """How far the planners' reduced statics is from the full one, on states of random plans."""
    rng = np.random.default_rng(1)
    theta = rng.uniform(0.2, 1.6, (n, robot.n_segments))
    phi = rng.uniform(0, 2 * np.pi, theta.shape)
    goals = muxjax.tendon_displacements(robot, np.stack([theta, phi], -1).reshape(n, -1))
    states = goals * rng.choice([0.0, 0.5, 1.0], size=goals.shape)
    full = forward_statics(chain, displacements=states, max_iterations=25)
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(lambda x: term.largest(robot, x))(states))
    exact = full.tension.max(axis=-1)[full.converged]
    gap = abs(found[full.converged] - exact)
    share = 100 * np.percentile(gap / exact, [50, 90])
    newton = np.percentile(gap, [50, 90, 100])
    return (
        f"Largest tension by the planners' term against the full statics, {len(gap)} of {n} states "
        f"solved: {newton[0]:.2f} N in the median, {newton[1]:.2f} N at 90 %, {newton[2]:.1f} N at "
        f"worst ({share[0]:.1f} % and {share[1]:.1f} %)."
    )


def postures(robot: muxjax.Robot) -> str:
    """Gap between the tools by statics and by constant curvature, over springs and mountings."""
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.2, 1.6, (60, robot.n_segments))
    phi = rng.uniform(0, 2 * np.pi, theta.shape)
    goals = muxjax.tendon_displacements(robot, np.stack([theta, phi], -1).reshape(60, -1))
    length, rows = float(np.sum(robot.length)), []
    for bending, payload in product(BENDING, (0.0, 0.5)):
        row = [f"{bending:g}", f"{payload:g}"]
        for gravity in MOUNTINGS.values():
            chain = elastic_chain(robot, bending_stiffness=bending, mass=MASS, gravity=gravity)
            found = muxjax.true_posture(robot, chain, goals, payload=payload)
            gap = np.percentile(100 * found.position_gap[found.converged] / length, [50, 90])
            row.append(f"{gap[0]:.1f} / {gap[1]:.1f} % of {found.converged.sum()}")
        rows.append(row)
    return table(["springs [N m/rad]", "payload [kg]", *MOUNTINGS], rows)


def friction_loops(robot: muxjax.Robot) -> str:
    """Tendon 1 wound in by 40 mm and paid out, by friction: tension and tool half-way, work."""
    chain, rows, steps = elastic_chain(robot, bending_stiffness=15.0, mass=MASS), [], 40
    for friction in (0.0, 0.1, 0.2):
        loop = winding_loop(chain, 1, depth=0.04, friction=friction, steps=steps)
        inward, outward = 2 * steps + steps // 2, 3 * steps + steps // 2  # of the second round
        pull = loop.tension[2 * steps :]
        moved = np.diff(loop.displacements[2 * steps :], axis=0)
        apart = np.linalg.norm(loop.pose[inward, :3, 3] - loop.pose[outward, :3, 3])
        rows.append(
            [
                f"{friction:g}",
                f"{loop.tension[inward, 0]:.1f}",
                f"{loop.tension[outward, 0]:.1f}",
                f"{1e3 * apart:.1f}",
                f"{-(0.5 * (pull[1:] + pull[:-1]) * moved).sum():.3f}",
                f"{loop.converged.mean():.0%}",
            ]
        )
    header = ["mu", "inwards [N]", "outwards [N]", "tool apart [mm]", "work of a loop [J]"]
    return table([*header, "solved"], rows)


def main() -> None:
    """Measure and print tables."""
    alone = {"posture": postures, "friction": friction_loops}
    if sys.argv[1:] and sys.argv[1] in alone:
        print(alone[sys.argv[1]](muxjax.load_robot("muxarm")))
        return
    robot, n = muxjax.load_robot("muxarm"), int(sys.argv[1]) if len(sys.argv) > 1 else 15
    protocol = load_yaml(Protocol, resolve("table2", "bench"))
    print(f"{machine()}\n\n{n} targets, upright, arm of {MASS} kg (assumed), full moves.\n")
    print(f"Transmission: {tendon_forces(robot)}\n{load_test(robot)}\n", flush=True)
    runs = programs(robot, protocol, n)
    flat = [p for own in runs.values() for p in own]
    for bending, tendon in product(BENDING, TENDON):
        began = time.process_time()
        chain = elastic_chain(robot, bending_stiffness=bending, tendon_stiffness=tendon, mass=MASS)
        found = iter(tension_along(robot, chain, flat))
        profiles = {key: [next(found) for _ in own] for key, own in runs.items()}
        spent = time.process_time() - began
        print(f"\n## Springs {bending:g} N m/rad, tendons {tendon:g} N/m ({spent:.0f} CPU-s)\n")
        print(report(profiles, runs, robot), flush=True)
        if bending >= 15 or tendon <= 5e3:  # softer arms buckle, and cold starts take long
            term = Tension(bending_stiffness=bending, tendon_stiffness=tendon, mass=MASS)
            print("\n" + surrogate_error(robot, chain, term), flush=True)


if __name__ == "__main__":
    main()
