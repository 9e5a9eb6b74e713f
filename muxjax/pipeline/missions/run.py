"""A mission on a board, and what truly happened.

The board runs the programs of the tendon stages, one after the other on the same link; between them
whoever owns the base moves it, which the board knows nothing of. Displacements are carried on as
the wheels measure them: a stage whose start they miss is planned again from where they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from muxjax.collision import World
from muxjax.hardware import BusLink, LockstepLink, Run, Trajectory, execute
from muxjax.pipeline.missions.plan import Planner, Stage
from muxjax.pipeline.missions.scene import Scene, grasped, released, tool_pose
from muxjax.pipeline.swept import at_base, clearances, swept_base, swept_tendons
from muxjax.robot import Robot
from muxjax.scheduler import waypoints

PLANNED_AGAIN = 2e-4  # a start that is further off than this [m]


@dataclass(frozen=True, eq=False)
class StageRun:
    """What became of a stage.

    Attributes:
        stage: As planned, or as planned again.
        run: Of its program; None if there is none.
        points: True displacements on the way where the link knows them, else as measured and
            commanded [m].
        scene: At the end, by the wheels' measurement.
        world: Obstacles as they were, and what the tool carried.
        clearance: The arm truly came no nearer to obstacles or itself [m].
        tool_error: Distance between the true and the planned tool at the end [m].
        replanned: The start was not where it was planned to be.
        failure: Why the mission ends here, else empty.
    """

    stage: Stage
    run: Run | None
    points: Float[np.ndarray, "Q SJ"]
    scene: Scene
    world: World
    clearance: float
    tool_error: float
    replanned: bool = False
    failure: str = ""


def run_mission(planner: Planner, link: LockstepLink | BusLink) -> Iterator[StageRun]:
    """Plan and execute stage by stage, to the end or to the first failure.

    Args:
        planner: Of the mission.
        link: To the board, whose tendons stand straight.

    Raises:
        ValueError, IkError, PlanningError: See ``Planner.stages``; what was done before is done.
    """
    scene = planner.scene
    truth = scene.displacements
    for stage in planner.stages():
        done, truth = _one(planner, stage, scene, truth, link)
        yield done
        if done.failure:
            return
        scene = done.scene


def _one(
    planner: Planner,
    stage: Stage,
    scene: Scene,
    truth: Float[np.ndarray, " SJ"],
    link: LockstepLink | BusLink,
) -> tuple[StageRun, Float[np.ndarray, " SJ"]]:
    """A stage, and the true displacements after it."""
    robot, mission, worlds = planner.robot, planner.mission, planner.worlds
    run, replanned, failure = None, False, ""
    points = truth[None]
    real = at_base(robot, scene.base)
    if stage.kind == "base":
        scene = replace(scene, base=stage.after.base)
        room = swept_base(real, worlds.at(scene), truth, stage.bases).clearance
    elif stage.program is None:
        # Whether the gripper has the object depends on where the arm truly is.
        actual = replace(scene, displacements=truth)
        if stage.kind == "grasp":
            assert stage.after.held is not None
            what = mission.objects[stage.after.held].name
            actual, miss = grasped(robot, mission, actual, what)
            if miss > mission.grasp_tolerance_m:
                failure = f"{what} is {1e3 * miss:.1f} mm from the grasp point"
        else:
            actual = released(robot, actual)
        scene = replace(actual, displacements=scene.displacements)
        room = float(clearances(real, worlds.at(scene), points)[0])
    else:
        off = float(np.abs(scene.displacements - np.array(stage.program.start)).max())
        if off > PLANNED_AGAIN:
            onwards, planner.scene, replanned = planner.scene, scene, True
            stage = planner.around(stage.step, stage.after.displacements)
            planner.scene = onwards
        assert stage.program is not None
        run = execute(stage.program, link)
        failure = "" if run.completed else run.reason
        points = _way(robot, stage, run)
        room = swept_tendons(real, worlds.at(scene), points).clearance
        truth = points[-1]
        axial = stage.after.axial if run.completed else None
        scene = replace(scene, displacements=run.measured, axial=axial)
    error = _tool_error(robot, replace(scene, displacements=truth), stage.after)
    world = worlds.at(scene)
    return StageRun(stage, run, points, scene, world, room, error, replanned, failure), truth


def _way(robot: Robot, stage: Stage, run: Run) -> Float[np.ndarray, "Q SJ"]:
    """True displacements during a run; what was commanded, where nobody knows the truth."""
    assert stage.program is not None
    if run.trajectory is None:
        return np.concatenate([*waypoints(robot, stage.program), run.measured[None]])
    return corners(run.trajectory)


def corners(trajectory: Trajectory) -> Float[np.ndarray, "Q SJ"]:
    """A trajectory's points, but those at which nothing moves or that lie on a straight line."""
    kept = [trajectory.displacements[0]]
    for before, after in pairwise(trajectory.displacements):
        if np.abs(after - before).max() == 0.0:
            continue
        if len(kept) > 1 and _straight(kept[-2], kept[-1], after):
            kept[-1] = after
        else:
            kept.append(after)
    return np.array(kept if len(kept) > 1 else [kept[0], kept[0]])


def _straight(a: np.ndarray, b: np.ndarray, c: np.ndarray, within: float = 1e-9) -> bool:
    """Whether b lies between a and c."""
    way = c - a
    share = float((b - a) @ way) / max(float(way @ way), 1e-30)
    return 0.0 <= share <= 1.0 and float(np.abs(a + share * way - b).max()) <= within


def _tool_error(robot: Robot, actual: Scene, wanted: Scene) -> float:
    ends = tool_pose(robot, actual)[:3, 3] - tool_pose(robot, wanted)[:3, 3]
    return float(np.linalg.norm(ends))
