"""``muxjax run`` and ``muxjax resume``: a program to the board."""

from __future__ import annotations

import dataclasses
import signal
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table

from muxjax.cli.output import console, notice, print_json, verdict
from muxjax.cli.plans import Method, plan_to_configuration, problem_fields, start_fields
from muxjax.cli.poses import Quaternion, Xyz, pose_argument
from muxjax.cli.progress import Reporter
from muxjax.hardware import BusLink, Journal, Link, LockstepLink, MemoryJournal, Progress, Run
from muxjax.hardware.journal import is_journal
from muxjax.hardware.links import open_bus
from muxjax.hardware.log import LoggedLink
from muxjax.hardware.mapping import MappedLink, Translation
from muxjax.pipeline import plan_to_pose, run_to_target
from muxjax.program_file import load_program
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import Program, check_same_robot, schedule

_POWER_UP = (
    "ESTOP holds until the board's power-up: switch it off and on (end and restart muxjax board); "
    "then "
)


def run(
    program: Annotated[Path | None, tyro.conf.Positional] = None,
    xyz_mm: Xyz | None = None,
    rpy_deg: Xyz | None = None,
    quat: Quaternion | None = None,
    q_deg: tuple[float, ...] | None = None,
    start_q_deg: tuple[float, ...] | None = None,
    after: Path | None = None,
    servos: tuple[int, ...] | None = None,
    planner: Method = "exact",
    preset: str = "paper",
    max_step_mm: float | None = None,
    world: str | None = None,
    robot: str = "muxarm",
    bus: str | None = None,
    dry_run: bool = False,
    rehearse: bool = True,
    physics: str = "ideal",
    journal: Path | None = None,
    log: Path | None = None,
    stream_divider: int = 1,
    mapping: Path | None = None,
    json: bool = False,
) -> int:
    """Execute a program, or plan to a pose and execute that, on the virtual board or on a bus.

    Before a bus is opened, the virtual board runs the program. A servo that fails on the way is
    done without, from a new plan. Ctrl-C and SIGTERM stop the arm by ESTOP.

    Example: muxjax run program.json

    Example: muxjax run --planner learned --q-deg 60 0 75 180 40 0

    Example: muxjax run program.json --bus lab --journal arm.journal

    Example: muxjax run --q-deg 0 0 0 0 0 0 --after program.json --bus lab

    Args:
        program: File written by muxjax plan --out.
        xyz_mm: Instead of a program: tool position in the world [mm].
        rpy_deg: Roll, pitch, yaw [degrees]; upright by default.
        quat: Orientation as a quaternion w x y z instead.
        q_deg: Bending angle (not negative) and azimuth of each segment [degrees], not a pose.
        start_q_deg: Where the arm stands, for the plan [degrees]; straight by default.
        after: The program after which the plan starts, instead; not the one to run.
        servos: Available servos, for the plan; all by default.
        planner: Method of the plan, and of new ones; muxjax plan calls it --method.
        preset: Weights of their cost: paper, fastest, no-overshoot, gentle, or a YAML file.
        max_step_mm: Greatest tendon displacement in one of their steps [mm]; no limit by default.
        world: Shipped world or path of a YAML file, of which every step they make must be clear.
        robot: Shipped robot or path of a YAML file; a program runs only on its own robot.
        bus: Arguments of can.Bus as a JSON object, or a section of python-can's configuration;
            the virtual board, in lockstep, by default.
        dry_run: The virtual board only, whatever --bus says.
        rehearse: The virtual board first, before --bus is opened.
        physics: Of the virtual board: ideal, realistic, harsh, or a YAML file.
        journal: File for muxjax resume; on a bus run.journal by default.
        log: File for every frame of the run, as candump -L writes it. On a bus it grows if it
            exists; the virtual board, whose clock begins at 0, needs a new one.
        stream_divider: Feedback at 1 / this of its rates, for slow serial links.
        mapping: YAML file of a lab's own DBC that the board on --bus speaks.
        json: Print JSON in SI units.
    """
    if [program, xyz_mm, q_deg].count(None) != 2:
        raise ValueError("run: give either a program file, --xyz-mm (a pose) or --q-deg")
    if xyz_mm is None and (rpy_deg is not None or quat is not None):
        raise ValueError("run: only --xyz-mm takes --rpy-deg or --quat")
    if mapping is not None and bus is None:
        raise ValueError("run: --mapping is of the board on --bus")
    if program is not None and not (start_q_deg is None and after is None):
        raise ValueError(
            f"run: {program} has its own start; --start-q-deg and --after are for a plan to "
            "--xyz-mm or --q-deg"
        )
    arm = load_robot(robot)
    fields = problem_fields(arm, servos, preset, max_step_mm, world)
    begin = start_fields(arm, start_q_deg, after)
    if program is not None:
        if is_journal(program):
            raise ValueError(f"{program}: is a journal; muxjax resume goes on with it")
        loaded = load_program(program)
    else:
        if xyz_mm is None:
            found = plan_to_configuration(arm, q_deg, planner, begin | fields)
        else:
            pose = pose_argument(xyz_mm, rpy_deg, quat)
            found = plan_to_pose(arm, pose, method=planner, **begin, **fields).plan
        loaded = schedule(arm, found)
    check_same_robot(arm, loaded)
    translation = None if mapping is None else Translation(mapping)
    real = bus is not None and not dry_run
    del fields["servos"]  # new plans have those that are left

    def go(link: Link, into: MemoryJournal, tell: Callable[[Progress], None] | None) -> Run:
        return run_to_target(link, into, loaded, method=planner, on_progress=tell, **fields)

    if not real or rehearse:
        virtual = LockstepLink(arm, physics, loaded.start, loaded.axial, stream_divider)
        if not real:
            with _journal(journal) as into, Reporter() as tell:
                done = go_logged(virtual, log, 0.0, lambda link: go(link, into, tell))
            return report(done, loaded, json)
        done = go(virtual, MemoryJournal(), None)
        if done.interrupted:
            raise KeyboardInterrupt
        if not done.completed:
            raise ValueError(f"run: the rehearsal on the virtual board failed: {done.reason}")
        notice(f"rehearsed on the virtual board: {done.duration_s:.2f} s")
    assert bus is not None  # else not real
    path = journal or Path("run.journal")
    with Journal.open(path) as into:
        done = on_bus(
            bus, arm, stream_divider, translation, log, lambda link, tell: go(link, into, tell)
        )
    return report(done, loaded, json, path)


def resume(
    journal: Annotated[Path, tyro.conf.Positional],
    bus: str,
    repaired_encoders: tuple[int, ...] | None = None,
    robot: str = "muxarm",
    planner: Method = "exact",
    preset: str = "paper",
    max_step_mm: float | None = None,
    world: str | None = None,
    log: Path | None = None,
    stream_divider: int = 1,
    mapping: Path | None = None,
    json: bool = False,
) -> int:
    """Go on with a journal's program from where the arm is, to the same lengths.

    Nothing that was done moves again. Where a servo has failed, a new plan does without it.

    Example: muxjax resume run.journal --bus lab

    Example: muxjax resume run.journal --bus lab --repaired-encoders 9

    Args:
        journal: File that muxjax run has written.
        bus: As for muxjax run.
        repaired_encoders: Tendons whose wheel encoders were repaired since: what those say now is
            believed up to 10 mm from the journal, and beyond 2 mm a new plan goes on from there.
        robot: Shipped robot or path of a YAML file.
        planner: Method of new plans; muxjax plan calls it --method.
        preset: Weights of their cost: paper, fastest, no-overshoot, gentle, or a YAML file.
        max_step_mm: Greatest tendon displacement in one of their steps [mm]; no limit by default.
        world: Shipped world or path of a YAML file, of which every step of theirs must be clear.
        log: File for every frame, as candump -L writes it; it grows if it exists.
        stream_divider: Feedback at 1 / this of its rates, for slow serial links.
        mapping: YAML file of a lab's own DBC that the board on --bus speaks.
        json: Print JSON in SI units.
    """
    arm = load_robot(robot)
    if repaired_encoders == ():
        raise ValueError("--repaired-encoders: names no tendon")
    if not journal.is_file():
        raise ValueError(f"{journal}: no such journal; muxjax run --journal writes one")
    translation = None if mapping is None else Translation(mapping)
    fields = problem_fields(arm, None, preset, max_step_mm, world)
    del fields["servos"]  # new plans have those that are left
    with Journal.open(journal) as into:
        if into.note:
            notice(into.note)
        done = on_bus(
            bus,
            arm,
            stream_divider,
            translation,
            log,
            lambda link, tell: run_to_target(
                link,
                into,
                repaired_encoders=repaired_encoders or (),
                method=planner,
                on_progress=tell,
                **fields,
            ),
        )
        program = into.standing.program
    assert program is not None  # else run_to_target has raised
    return report(done, program, json, journal)


def _journal(path: Path | None) -> closing[MemoryJournal]:
    return closing(MemoryJournal() if path is None else Journal.open(path))


def on_bus(
    bus: str,
    arm: Robot,
    stream_divider: int,
    translation: Translation | None,
    log: Path | None,
    go: Callable[[Link, Reporter], Run],
) -> Run:
    """Run something on a bus, shown on the terminal; SIGTERM stops it as Ctrl-C does."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with open_bus(bus) as opened, Reporter() as tell:
        link = BusLink(opened, arm, stream_divider)
        begin_s = time.time() - link.now
        ours = link if translation is None else MappedLink(link, translation)
        done = go_logged(ours, log, begin_s, lambda logged: go(logged, tell))
    for kind, count in link.errors.items():
        notice(f"bus: raised {kind} {count} times")
    return done


def go_logged(link: Link, log: Path | None, begin_s: float, go: Callable[[Link], Run]) -> Run:
    """Run something over a link, with its frames in a file if one is given."""
    if log is None:
        return go(link)
    with closing(LoggedLink(link, log, begin_s)) as logged:
        return go(logged)


def report(done: Run, program: Program, json: bool, journal: Path | None = None) -> int:
    """Print how a run went; its exit code."""
    error = np.abs(done.measured - np.array(program.target))
    code = 0 if done.completed else 130 if done.interrupted else 1
    if json:
        print_json(
            {
                "robot": program.robot,
                "completed": done.completed,
                "reason": done.reason,
                "resumable": done.resumable,
                "estopped": done.estopped,
                "failed_servos": done.failed_servos,
                "duration_s": done.duration_s,
                "measured_m": done.measured,
                "largest_error_m": float(np.max(error)),
                "instructions": [dataclasses.asdict(r) for r in done.records],
                "preflight": [dataclasses.asdict(check) for check in done.checks],
            }
        )
        return code
    if done.records:
        table = Table("instruction", "axial", "begin [s]", "end [s]", "trims")
        for r in done.records:
            times = f"{r.start_s:.2f}", f"{r.end_s:.2f}"
            table.add_row(str(r.number), str(r.axial), *times, str(r.trims))
        console.print(table)
    if np.isnan(done.duration_s):
        how = "the board did not arm"
    elif done.completed and not done.records:
        how = "nothing was left to do"
    else:
        how = f"{done.duration_s:.2f} s on the board's clock"
    if np.isfinite(error).all():
        how += f", wheels within {1e3 * np.max(error):.3f} mm of the target"
    console.print(verdict(done.reason, done.completed) + f": {how}")
    if done.failed_servos:
        console.print(f"failed servos: {' '.join(map(str, done.failed_servos))}")
    if journal is not None and not done.completed:
        what = "goes on" if done.resumable else "goes on once the part is repaired"
        first = _POWER_UP if done.estopped else ""
        console.print(f"{first}muxjax resume {journal} --bus ... {what}", soft_wrap=True)
    return code
