"""A mission becomes stages: the base moves, or the tendons do, never both.

Tendons stand still while the base moves because worm gears hold them then without power and their
lengths are known exactly; the base stands still while tendons move because one instruction moves a
few of them for seconds, and obstacles are judged at the shapes in between, which are exact only for
a base that is where the plan has it. So a clearance of either kind needs no timing between the two
controllers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from muxjax.collision import World
from muxjax.ik import all_ik, solve_ik
from muxjax.ik.every import is_exhaustive
from muxjax.kinematics import bending_from_configuration, check_configuration
from muxjax.metrics import evaluate
from muxjax.pipeline.detour import joined, plan_around
from muxjax.pipeline.missions.files import (
    BaseStep,
    ExtractStep,
    GraspStep,
    InsertStep,
    MissionConfig,
    MoveStep,
    ReleaseStep,
    Step,
)
from muxjax.pipeline.missions.follow import Posture, TubeLine, posture_at
from muxjax.pipeline.missions.scene import Scene, Worlds, first_scene, grasped, released
from muxjax.pipeline.poses import target_pose
from muxjax.pipeline.swept import (
    RESOLUTION,
    at_base,
    clearances,
    grown,
    swept_base,
    swept_tendons,
)
from muxjax.planning import Plan, PlanningError, Problem, plan
from muxjax.planning.world import SWEEP_TOLERANCE
from muxjax.robot import Robot, frame_pose
from muxjax.scheduler import Program
from muxjax.tendons import tendon_displacements

SMALLEST = 4  # an advance into a tube is halved until it is this part of the one asked for


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage of a mission.

    Attributes:
        step: Name of the step it belongs to.
        kind: "base", "tendons", "grasp" or "release".
        before: The scene at its beginning.
        after: At its end.
        world: Obstacles and what the tool carries, meanwhile.
        bases: Poses of the root, straight lines between them; one unless the base moves.
        points: Displacements of the tendons [m], likewise.
        clearance: The arm comes no nearer to an obstacle or itself [m], as planned.
        program: What the board executes; None unless tendons move.
        time_s: Of that program [s]; the base's time is its owner's.
        stops: Instructions of that program.
    """

    step: str
    kind: str
    before: Scene
    after: Scene
    world: World
    bases: Float[np.ndarray, "P 4 4"]
    points: Float[np.ndarray, "Q SJ"]
    clearance: float
    program: Program | None = None
    time_s: float = 0.0
    stops: int = 0


class Planner:
    """Plans step by step; ``scene`` is where the last stage ended.

    Args:
        robot: The arm.
        mission: Scene and steps.
        servos: Available servos, from 1.
        preset: Weights of the planner's cost.
        seed: Of the in-between shapes, where direct plans are blocked.
        method: Planner.

    Raises:
        ValueError: The arm starts in collision, or nearer to one than the margin.
    """

    def __init__(
        self,
        robot: Robot,
        mission: MissionConfig,
        *,
        servos: tuple[int, ...],
        preset: str = "fastest",
        seed: int = 0,
        method: str = "exact",
    ) -> None:
        self.robot, self.mission = robot, mission
        self.seed, self.method = seed, method
        self.fields: dict[str, Any] = {"servos": servos, "preset": preset}
        self.worlds = Worlds(mission)
        self.scene = first_scene(robot, mission)
        self._postures: list[Posture] = []  # of the insertion, the deepest last
        self._line: TubeLine | None = None
        room = float(clearances(self.arm, self.world, self.scene.displacements[None])[0])
        if room < mission.margin_m:
            raise ValueError(
                f"base: the straight arm starts {1e3 * room:.1f} mm from obstacles or itself, the "
                f"margin is {1e3 * mission.margin_m:.1f} mm"
            )

    def stages(self) -> Iterator[Stage]:
        """The stages of the mission, as they are found.

        Raises:
            ValueError: A step does not fit the robot.
            IkError: A pose cannot be reached.
            PlanningError: A step has no way that keeps the margin, or a grasp is too far off.
                All messages name the step.
        """
        for number, step in enumerate(self.mission.steps, start=1):
            try:
                yield from self.take(step)
            except (PlanningError, ValueError) as error:
                raise type(error)(f"steps[{number}], {step.name}: {error}") from None

    @property
    def arm(self) -> Robot:
        """The arm where it stands."""
        return at_base(self.robot, self.scene.base)

    @property
    def world(self) -> World:
        """Obstacles as they are, and what the tool carries."""
        return self.worlds.at(self.scene)

    def take(self, step: Step) -> Iterator[Stage]:
        """The stages of one step."""
        match step:
            case MoveStep():
                yield self._done(self._move(step))
            case BaseStep():
                poses = np.array([self.scene.base, *(frame_pose(f) for f in step.through)])
                yield self._done(self._base(step.name, poses))
            case InsertStep():
                yield from self._insert(step)
            case ExtractStep():
                yield from self._extract(step)
            case GraspStep():
                yield self._done(self._grasp(step))
            case ReleaseStep():
                scene = released(self.robot, self.scene)
                yield self._done(self._still(step.name, "release", scene))

    def _done(self, stage: Stage) -> Stage:
        self.scene = stage.after
        return stage

    def _still(self, name: str, kind: str, after: Scene) -> Stage:
        world, bases, points = self.worlds.at(after), after.base[None], after.displacements[None]
        room = float(clearances(self.arm, world, points)[0])
        return Stage(name, kind, self.scene, after, world, bases, points, room)

    def _grasp(self, step: GraspStep) -> Stage:
        scene, miss = grasped(self.robot, self.mission, self.scene, step.what)
        if miss > self.mission.grasp_tolerance_m:
            raise PlanningError(
                f"{step.what} is {1e3 * miss:.1f} mm from the grasp point, at most "
                f"{1e3 * self.mission.grasp_tolerance_m:.1f} mm are allowed"
            )
        stage = self._still(step.name, "grasp", scene)
        if stage.clearance < self.mission.margin_m:
            raise PlanningError(
                f"{step.what} in the gripper is {1e3 * stage.clearance:.1f} mm from obstacles, the "
                f"margin is {1e3 * self.mission.margin_m:.1f} mm"
            )
        return stage

    # The base

    def _base(self, name: str, poses: Float[np.ndarray, "P 4 4"]) -> Stage:
        swept = swept_base(self.robot, self.world, self.scene.displacements, poses)
        if swept.clearance < self.mission.margin_m:
            raise PlanningError(
                f"on the base's way, {100 * swept.share:.0f} % along, the arm is "
                f"{1e3 * swept.clearance:.1f} mm from obstacles, the margin is "
                f"{1e3 * self.mission.margin_m:.1f} mm"
            )
        after = replace(self.scene, base=poses[-1])
        points = self.scene.displacements[None]
        return Stage(name, "base", self.scene, after, self.world, poses, points, swept.clearance)

    # The tendons

    def _problem(self, target: Float[np.ndarray, " SJ"]) -> tuple[Robot, Problem]:
        """The margin is kept by planning for an arm that is thicker by as much, and a little more.

        The planner may miss a collision that is less deep than its tolerance.
        """
        spare = SWEEP_TOLERANCE + RESOLUTION
        thick, world = grown(self.arm, self.world, self.mission.margin_m + spare)
        start, axial = self.scene.displacements, self.scene.axial
        return thick, Problem(start, target, world=world, axial=axial, **self.fields)

    def around(self, name: str, target: Float[np.ndarray, " SJ"]) -> Stage:
        """A tendon stage, by in-between shapes if need be."""
        thick, problem = self._problem(target)
        return self._tendons(
            name, plan_around(thick, problem, method=self.method, seed=self.seed).plans, thick
        )

    def _tendons(self, name: str, plans: tuple[Plan, ...], thick: Robot) -> Stage:
        # Where the base stands is no matter of the board's: all programs are for the one robot.
        program = replace(joined(thick, plans), fingerprint=self.robot.fingerprint)
        points = np.concatenate([plans[0].displacements[:1], *(p.displacements[1:] for p in plans)])
        axial = program.instructions[-1].axial if program.instructions else self.scene.axial
        metrics = evaluate(self.robot, program)
        return Stage(
            name,
            "tendons",
            self.scene,
            replace(self.scene, displacements=points[-1], axial=axial),
            self.world,
            self.scene.base[None],
            points,
            swept_tendons(self.arm, self.world, points).clearance,
            program,
            metrics.time_s,
            metrics.stages,
        )

    def _move(self, step: MoveStep) -> Stage:
        refusal = ""
        for target in self._targets(step):
            try:
                return self.around(step.name, target)
            except PlanningError as error:
                refusal = str(error)
        raise PlanningError(refusal)

    def _targets(self, step: MoveStep) -> Float[np.ndarray, "K SJ"]:
        """Displacements that do what a step asks, those to be tried first in front."""
        if step.q_deg is not None:
            q = check_configuration(self.robot, np.radians(step.q_deg))
            return np.asarray(tendon_displacements(self.robot, q))[None]
        assert step.to is not None
        pose, near = target_pose(step.to), step.to.near_q_deg
        wanted = None if near is None else np.radians(near)
        if is_exhaustive(self.robot):
            every = all_ik(self.arm, pose)
            found = np.asarray(every.q)[np.asarray(every.mask)]
        else:
            found = np.zeros((0, 2 * self.robot.n_segments))
        if not len(found):
            found = np.asarray(solve_ik(self.arm, pose, q0=wanted).check().q)[None]
        targets = np.asarray(tendon_displacements(self.robot, found))
        room = clearances(self.arm, self.world, targets)
        if room.max() < self.mission.margin_m:
            raise PlanningError(
                f"of {len(found)} configurations that reach the pose the best is "
                f"{1e3 * room.max():.1f} mm from obstacles, the margin is "
                f"{1e3 * self.mission.margin_m:.1f} mm"
            )
        if wanted is None:
            far = np.abs(targets - self.scene.displacements).sum(axis=1)
        else:
            bent = np.asarray(bending_from_configuration(found)) - np.asarray(
                bending_from_configuration(wanted)
            )
            far = np.linalg.norm(bent, axis=(1, 2))
        order = np.argsort(far, kind="stable")
        clear = order[room[order] >= self.mission.margin_m]
        return targets[clear if wanted is None else clear[:1]]

    # Base and tendons in turn

    def _insert(self, step: InsertStep) -> Iterator[Stage]:
        self._line = TubeLine(np.array(self.mission.tubes[step.tube - 1].through_m))
        count = max(1, int(np.ceil((step.depth_m - step.from_m) / step.step_m)))
        depths = np.linspace(step.from_m, step.depth_m, count + 1)
        self._postures = []
        for depth in depths:
            before = self._postures[-1] if self._postures else None
            posture = posture_at(self.robot, self._line, float(depth), before)
            for passed, stages in self._between(step.name, before, posture, SMALLEST):
                self._postures.append(passed)
                yield from stages

    def _extract(self, step: ExtractStep) -> Iterator[Stage]:
        way = self._postures[::-1]
        for before, posture in pairwise(way):
            for _, stages in self._between(step.name, before, posture, SMALLEST):
                yield from stages
        self._postures = []

    def _between(
        self, name: str, before: Posture | None, posture: Posture, parts: int
    ) -> Iterator[tuple[Posture, list[Stage]]]:
        """Stages to a posture, in one advance or by halves."""
        begin = self.scene
        finer = parts <= 1 or before is None
        try:
            yield posture, self._to(name, posture, multistep=finer)
            return
        except PlanningError:
            self.scene = begin
            if finer:
                raise
        assert before is not None
        assert self._line is not None
        halfway = posture_at(self.robot, self._line, 0.5 * (before.depth + posture.depth), before)
        yield from self._between(name, before, halfway, parts // 2)
        yield from self._between(name, halfway, posture, parts // 2)

    def _to(self, name: str, posture: Posture, *, multistep: bool) -> list[Stage]:
        """A base and a tendon stage to a posture, in the order that leaves more room."""
        begin, world = self.scene, self.world
        ends = np.stack([begin.displacements, posture.displacements])
        rooms = clearances(self.robot, world, ends, np.stack([posture.base, begin.base]))
        refusals = []
        for order in ("base", "tendons") if rooms[0] >= rooms[1] else ("tendons", "base"):
            self.scene = begin
            try:
                stages = []
                for kind in (order, "tendons" if order == "base" else "base"):
                    if kind == "base":
                        way = np.stack([self.scene.base, posture.base])
                        stages.append(self._done(self._base(name, way)))
                    elif np.abs(posture.displacements - self.scene.displacements).max() > 1e-5:
                        found = self._directly(name, posture.displacements, multistep=multistep)
                        stages.append(self._done(found))
                return stages
            except (PlanningError, ValueError) as error:
                refusals.append(f"{order} first: {error}")
        depth = f"at depth {1e3 * posture.depth:.0f} mm"
        raise PlanningError(f"{depth}, {'; '.join(refusals)}")

    def _directly(self, name: str, target: Float[np.ndarray, " SJ"], *, multistep: bool) -> Stage:
        """A tendon stage without in-between shapes; with half moves where full ones are blocked."""
        thick, problem = self._problem(target)
        found = plan(thick, problem, self.method)
        if found.status == "failed" and multistep:
            half = 0.5 * float(np.abs(target - problem.start).max())
            finer = replace(problem, max_step=half + 1e-6, action_set="multistep")
            found = plan(thick, finer, self.method)
        if found.status == "failed":
            raise PlanningError(found.reason)
        return self._tendons(name, (found,), thick)
