"""Going on after a failure: fewer servos, or no axial motor.

Any non-empty set of servos still reaches every tendon. The axial motor is the single point of
failure: without it only the tendons at its present position move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import scipy
from jaxtyping import Float

from muxjax.hardware import Link, MemoryJournal, Run, execute, resume
from muxjax.hardware.executor import MEND_COUNTS, OnProgress, begin, take_stock
from muxjax.hardware.handshake import RESUME_TOLERANCE_MM, beyond
from muxjax.hardware.journal import Standing
from muxjax.hardware.protocol import COUNTS_PER_TURN
from muxjax.kinematics import check_configuration
from muxjax.planning import Plan, PlanningError, Problem, plan
from muxjax.precision import host_array
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule
from muxjax.tendons import (
    bending_from_displacements,
    check_displacements,
    configuration_from_tendons,
    displacement_range,
)

# Displacements count this little against bending [rad/m]: it only picks one of equally bent shapes.
_LEAST_MOTION = 1e-3


def replan(
    robot: Robot,
    run: Run | Float[np.ndarray, " SJ"],
    target: Float[np.ndarray, " SJ"],
    *,
    servos: tuple[int, ...],
    axial: int | None = None,
    method: str = "exact",
    **fields: Any,
) -> Plan:
    """A plan from where a run stopped, with the servos that are left.

    ``execute(schedule(robot, plan), link)`` goes on with it on the same link.

    Args:
        robot: The arm.
        run: The run that stopped, or measured displacements [m].
        target: Displacements wanted [m].
        servos: The servos that are left, from 1; any non-empty set reaches every tendon.
        axial: Axial position, if known; an interrupted run may have left the drum between two.
        method: Planner.
        **fields: Other fields of ``Problem``. The tolerance is at least two encoder counts, for a
            finer residual is not worth a stage.

    Raises:
        ValueError: A wheel was never heard, or a field does not fit the robot.
        PlanningError: The planner refuses.
    """
    measured = _measured(robot, run.measured if isinstance(run, Run) else run)
    count = 2 * math.pi * float(robot.wheel_radius) / COUNTS_PER_TURN
    tolerance = max(fields.pop("tolerance", 0.0), MEND_COUNTS * count)
    problem = Problem(measured, target, servos=servos, axial=axial, tolerance=tolerance, **fields)
    return plan(robot, problem, method)


def run_to_target(
    link: Link,
    journal: MemoryJournal,
    program: Program | None = None,
    *,
    repaired_encoders: tuple[int, ...] = (),
    method: str = "exact",
    on_progress: OnProgress | None = None,
    **fields: Any,
) -> Run:
    """Run a program to its target, planning anew without each servo that fails on the way.

    Args:
        link: The way to the board.
        journal: Of this run, or of the one to go on with.
        program: What to run; None to go on with the journal's.
        repaired_encoders: Tendons (from 1) whose wheel encoders were repaired since the journal's
            run: they are believed before it goes on, see ``take_stock``. Where one is further from
            where the journal left it than ``resume`` lets pass, it goes on by a new plan.
        method: Planner.
        on_progress: As for ``execute``.
        **fields: Other fields of ``Problem`` for the new plans, such as ``world``.

    Returns:
        The last run. If it is not completed, something else than a servo has stopped it, or no
        servo is left.

    Raises:
        ValueError: See ``execute``, ``resume`` and ``take_stock``; repaired encoders for a
            program that only begins.
        PlanningError: There is no way on with the servos that are left.
    """
    if program is not None and repaired_encoders:
        raise ValueError("repaired_encoders: only for going on with a journal's program")
    if program is not None:
        run = execute(program, link, journal=journal, on_progress=on_progress)
    else:
        before, elsewhere = journal.standing, False
        if repaired_encoders or _left(before):
            stock = take_stock(
                journal, link, repaired_encoders=repaired_encoders, on_progress=on_progress
            )
            if not stock.completed:
                return stock
            elsewhere = bool((beyond(stock.measured, before) > 1e-3 * RESUME_TOLERANCE_MM).any())
        if (program := _anew(link.robot, journal, method, fields, elsewhere)) is not None:
            begin(link.robot, program, journal)
        run = resume(journal, link, on_progress=on_progress)
    while not (run.completed or run.interrupted):
        program = _anew(link.robot, journal, method, fields)
        if program is None:
            break
        begin(link.robot, program, journal)
        run = resume(journal, link, on_progress=on_progress)
    return run


def _anew(
    robot: Robot,
    journal: MemoryJournal,
    method: str,
    fields: dict[str, Any],
    elsewhere: bool = False,
) -> Program | None:
    """On from where the journal's wheels are, with the servos that are left.

    None if none of the program's has failed, or all have; unless the arm stands elsewhere than the
    program can have brought it.
    """
    now = journal.standing
    left = _left(now)
    if elsewhere and now.program is not None and not left:
        left = now.program.servos
    if now.program is None or not left:
        return None
    measured = np.array(now.lengths, dtype=np.float64)
    target = np.array(now.program.target)
    found = replan(robot, measured, target, servos=left, method=method, **fields)
    if found.status == "failed":
        raise PlanningError(f"{method}: without servos {now.failed_servos}: {found.reason}")
    return schedule(robot, found)


def _left(now: Standing) -> tuple[int, ...]:
    """Servos with which to plan anew; () if none of the program's has failed, or all have."""
    servos = () if now.program is None else now.program.servos
    left = tuple(s for s in servos if s not in now.failed_servos)
    return () if left == servos else left


@dataclass(frozen=True, eq=False)
class Stranded:
    """What an arm can still do without its axial motor.

    Attributes:
        tendons: Those that still move, from 1.
        displacements: Of the closest configuration that moving only those reaches [m].
        q: That configuration [rad].
        bending_error: Its distance from the wanted one, |b - b*| over all segments [rad].
        plan: There, without turning the drum.
    """

    tendons: tuple[int, ...]
    displacements: Float[np.ndarray, " SJ"]
    q: Float[np.ndarray, " dof"]
    bending_error: float
    plan: Plan


def without_axial_motor(
    robot: Robot,
    measured: Float[np.ndarray, " SJ"],
    target: Float[np.ndarray, " SJ"],
    *,
    axial: int,
    servos: tuple[int, ...],
) -> Stranded:
    """The closest to a target that is reached with the axial motor standing still.

    Least squares in the Cartesian bending of all segments over the displacements of the tendons
    that the servos meet, within their range. Distal segments bend along with a proximal one
    whose tendons move.

    Args:
        robot: The arm.
        measured: Displacements now [m].
        target: Displacements wanted [m].
        axial: Where the axial motor stands, from 1.
        servos: Available servos, from 1.

    Raises:
        ValueError: A wheel was never heard, no such axial position or servo, or a closest shape
            that bends a segment beyond its limit.
    """
    held, goal = _measured(robot, measured), check_displacements(robot, "target", target)
    problem = Problem(held, goal, servos=servos, axial=axial)
    n_axial, n_servos = robot.axial_map.shape
    if not 1 <= axial <= n_axial or not set(servos) <= set(range(1, n_servos + 1)):
        raise ValueError(
            f"axial, servos: the robot has positions 1 to {n_axial} and servos 1 to {n_servos}, "
            f"found {axial} and {servos}"
        )
    moving = np.flatnonzero(robot.reach(problem.servos)[axial - 1])
    wanted = _bending(robot, goal)

    def at(moved: Float[np.ndarray, " m"]) -> Float[np.ndarray, " SJ"]:
        displacements = held.copy()
        displacements[moving] = moved
        return displacements

    def residual(moved: Float[np.ndarray, " m"]) -> Float[np.ndarray, " r"]:
        effort = _LEAST_MOTION * (moved - held[moving])
        return np.concatenate([_bending(robot, at(moved)) - wanted, effort])

    low, high = displacement_range(robot)[moving].T
    inside = np.clip(held[moving], low + 1e-9, high - 1e-9)
    found = scipy.optimize.least_squares(
        residual, inside, bounds=(low, high), x_scale=1e-2, xtol=1e-14
    )
    if not found.success:
        raise ValueError(f"target: the closest shape was not found ({found.message})")
    closest = at(found.x)
    q = check_configuration(robot, configuration_from_tendons(robot, closest))
    return Stranded(
        tendons=tuple(int(c) + 1 for c in moving),
        displacements=closest,
        q=q,
        bending_error=float(np.linalg.norm(_bending(robot, closest) - wanted)),
        plan=plan(robot, Problem(held, closest, servos=servos, axial=axial), "exact"),
    )


def _measured(robot: Robot, measured: Float[np.ndarray, " SJ"]) -> Float[np.ndarray, " SJ"]:
    """Measured displacements within the tendons' range, from which rounding may take them."""
    silent = np.flatnonzero(~np.isfinite(measured))
    if len(silent):
        raise ValueError(f"measured: the wheel of tendon {int(silent[0]) + 1} was never heard")
    checked = host_array("measured", measured, last=robot.n_tendons)
    low, high = displacement_range(robot).T
    within = np.clip(checked, low, high)
    off = np.abs(within - checked)
    if off.max() > 1e-3:
        raise ValueError(
            f"measured: tendon {int(off.argmax()) + 1} is {1e3 * off.max():.3g} mm beyond its range"
        )
    return within


def _bending(robot: Robot, displacements: Float[np.ndarray, " SJ"]) -> Float[np.ndarray, " b"]:
    with jax.enable_x64(True):
        return np.asarray(_compiled_bending(robot, displacements)).reshape(-1)


_compiled_bending = jax.jit(bending_from_displacements)
