"""What the viewer knows and can be asked to do, without any window: pose, solutions, plans, time.

Every refusal is a ``ValueError`` whose message a person can act on, and leaves the arm as it was.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from muxjax.collision import World
from muxjax.ik import all_ik, solve_ik
from muxjax.kinematics import check_configuration, forward_kinematics
from muxjax.metrics import evaluate
from muxjax.planning import METHODS, PlanningError, Problem, Tension
from muxjax.planning import plan as plan_steps
from muxjax.planning.world import clearance_of
from muxjax.robot import Robot
from muxjax.scheduler import schedule
from muxjax.tendons import (
    check_displacements,
    configuration_from_tendons,
    displacement_range,
    tendon_displacements,
)
from muxjax.viz.playback import Moment, Track, numbers_of, still, track_of_program

MOST_GHOSTS = 8
# What of the target counts, as weights of ``ik.all_ik``.
GOALS = {
    "pose": (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    "position and z axis": (1.0, 1.0, 1.0, 1.0, 1.0, 0.0),
    "position": (1.0, 1.0, 1.0, 0.0, 0.0, 0.0),
}


class Desk:
    """The arm as it stands, the target, and the tracks on the timeline.

    Args:
        robot: The arm.
        world: Obstacles, of which every planned step must be clear.
        preset: Weights of the planner's cost.

    Attributes:
        displacements: Of the tendons now [m]; may lie off the image of any configuration, as in
            the middle of a plan.
        q: Configuration that they define (M Eq. 4-5) [rad].
        axial: Axial position now, from 1.
        failed: Servos that cannot be used.
        target: Pose wanted [m].
        goal: What of it counts: a key of ``GOALS``.
        solutions: Configurations that reach it [rad], at most ``MOST_GHOSTS``.
        chosen: Which of them the plan goes to, from 0.
        tracks: By name, in the order in which they came.
        last: The last plan, in words.
    """

    def __init__(self, robot: Robot, world: World | None = None, preset: str = "paper") -> None:
        self.robot, self.world, self.preset = robot, world, preset
        self.displacements: Float[np.ndarray, " SJ"] = np.zeros(robot.n_tendons)
        self.q: Float[np.ndarray, " dof"] = np.zeros(2 * robot.n_segments)
        self.axial = 1
        self.failed: Bool[np.ndarray, " J"] = np.zeros(robot.tendons_per_segment, bool)
        self.target: Float[np.ndarray, "4 4"] = np.asarray(forward_kinematics(robot, self.q))
        self.goal = "pose"
        self.solutions: Float[np.ndarray, "K dof"] = np.zeros((0, len(self.q)))
        self.chosen = 0
        self.tracks: dict[str, Track] = {}
        self.last = ""
        self._tension = jax.jit(Tension().tensions)

    # The arm

    @property
    def limits_mm(self) -> Float[np.ndarray, "SJ 2"]:
        """Least and greatest displacement of each tendon [mm]."""
        return 1e3 * displacement_range(self.robot)

    @property
    def tool(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the tool now [m]."""
        return np.asarray(forward_kinematics(self.robot, self.q))

    @property
    def now(self) -> Moment:
        """The arm at rest as it stands, with the failed servos."""
        now = still(self.robot, self.displacements, self.axial)
        return replace(now, marks=replace(now.marks, lost=self.failed))

    def set_q_deg(self, q_deg: Float[np.ndarray, " dof"]) -> None:
        """Bend the arm; tendons follow (M Eq. 6).

        Args:
            q_deg: Any angles; kept with theta at least 0 and phi from 0 to 360, as sliders have it.

        Raises:
            ValueError: A segment beyond its bending limit.
        """
        q = check_configuration(self.robot, np.radians(q_deg))
        theta, phi = q[0::2], q[1::2] + np.where(q[0::2] < 0, np.pi, 0.0)
        turned = np.where((phi < 0) | (phi > 2 * np.pi), phi % (2 * np.pi), phi)
        self.q = np.stack([np.abs(theta), turned], axis=-1).ravel()
        self.displacements = np.asarray(tendon_displacements(self.robot, self.q))

    def set_tendons_mm(self, lengths: Float[np.ndarray, " SJ"]) -> None:
        """Set tendons; the bending is what they define (M Eq. 4-5), as in the middle of a plan.

        Raises:
            ValueError: A tendon beyond its range, or lengths that bend a segment beyond its limit
                or define no shape.
        """
        l = check_displacements(self.robot, "tendons", np.asarray(lengths) / 1e3)  # noqa: E741
        q = configuration_from_tendons(self.robot, l)
        if not np.isfinite(q).all():
            raise ValueError(
                "tendons: these lengths define no shape: a segment's tendons are wound in by more "
                "than its length; pay one out"
            )
        try:
            self.q = check_configuration(self.robot, q)
        except ValueError as error:
            raise ValueError(f"tendons: {error}") from None
        self.displacements = l

    def show(self, moment: Moment) -> None:
        """Stand as a moment of a track does; shapes that are not defined are left out."""
        self.displacements = moment.displacements
        self.q = self.shape(moment.displacements)
        if moment.slot:
            self.axial = moment.slot

    def shape(self, displacements: Float[np.ndarray, " SJ"]) -> Float[np.ndarray, " dof"]:
        """Configuration [rad] of displacements; the present one where they define none."""
        q = np.asarray(configuration_from_tendons(self.robot, displacements))
        return q if np.isfinite(q).all() else self.q

    def tension(self, displacements: Float[np.ndarray, " SJ"]) -> Float[np.ndarray, " SJ"]:
        """Tension of each tendon [N] by the planner's reduced statics (assumed stiffness)."""
        with jax.enable_x64(True):
            return np.asarray(self._tension(self.robot, displacements[None]))[0]

    # The target

    @property
    def servos(self) -> tuple[int, ...]:
        """Servos that are left, from 1."""
        return numbers_of(~self.failed)

    def solve(self, pose: Float[np.ndarray, "4 4"]) -> str:
        """Configurations that reach a pose, or what of it counts; what was found, in words.

        Of a whole pose these are all (three segments); of a part, representatives, the
        least bent first.

        Raises:
            ValueError: None reaches it, and the message says how far off the closest is; or all
                that do are in collision. There are then no solutions.
        """
        self.target, self.chosen = np.asarray(pose, float), 0
        self.solutions = np.zeros((0, 2 * self.robot.n_segments))
        weights = GOALS[self.goal]
        every = all_ik(self.robot, self.target, weights=weights, project_rotations=True)
        found = np.asarray(every.q)[np.asarray(every.mask)]
        if not len(found):
            nearest = solve_ik(
                self.robot, self.target, q0=self.q, weights=weights, project_rotations=True
            )
            found = np.asarray(nearest.check().q)[None]
        text = f"{len(found)} configuration{'s reach' if len(found) > 1 else ' reaches'} the target"
        if not bool(every.complete):
            text += " (there may be more)"
        if self.world is not None:
            lengths = np.asarray(tendon_displacements(self.robot, found))
            clear = np.array([clearance_of(self.robot, row, self.world) > 0 for row in lengths])
            if not clear.any():
                raise ValueError(f"target: {text}, but all collide; move the target")
            text += f", {int(clear.sum())} clear of obstacles" if not clear.all() else ""
            found = found[clear]
        self.solutions = found[:MOST_GHOSTS]
        return text

    def aim_at_end_of(self, track: Track) -> bool:
        """Put the target where a track's tool goes; whether that is another one than before.

        It is not if the tool ends at the target in what of it counts. Solutions of another one are
        not looked for: the track has its own.
        """
        end = track.at(track.duration_s).displacements if track.target is None else track.target
        q = np.asarray(configuration_from_tendons(self.robot, end))
        if not np.isfinite(q).all():
            return False
        pose = np.asarray(forward_kinematics(self.robot, q))
        # A plan ends at its target but for the planner's tolerance.
        counts = np.ones((3, 4), bool)
        counts[:, :2], counts[:, 2] = GOALS[self.goal][5] > 0, GOALS[self.goal][3] > 0
        if np.allclose(pose[:3][counts], self.target[:3][counts], atol=1e-4):
            return False
        self.target, self.chosen = pose, 0
        self.solutions = np.zeros((0, len(q)))
        return True

    def label(self, k: int) -> str:
        """A solution in words, from 0."""
        pairs = np.degrees(self.solutions[k]).reshape(-1, 2)
        return f"{k + 1}: " + ", ".join(f"{t:.0f}° at {p:.0f}°" for t, p in pairs)

    # Plans

    def plan(self, method: str) -> Track:
        """Plan from where the arm stands to the chosen solution; the track is kept by its name.

        Raises:
            ValueError: No target, no servo left, or no plan; the message says why.
        """
        if not len(self.solutions):
            raise ValueError("plan: there is no reachable target; move the target first")
        if not self.servos:
            raise ValueError("plan: every servo is marked as failed; untick one")
        if method not in METHODS:
            raise ValueError(f"plan: no method {method!r}; there are {', '.join(METHODS)}")
        goal = tendon_displacements(self.robot, self.solutions[self.chosen])
        problem = Problem(
            self.displacements,
            goal,
            servos=self.servos,
            axial=self.axial,
            preset=self.preset,
            world=self.world,
        )
        try:
            found = plan_steps(self.robot, problem, method)
        except PlanningError as error:
            raise ValueError(str(error)) from error
        if found.status == "failed":
            raise ValueError(f"{method}: {found.reason}")
        program = schedule(self.robot, found)
        metrics = evaluate(self.robot, program)
        servos = " ".join(map(str, self.servos))
        name = f"{method}, solution {self.chosen + 1}, servos {servos}"
        track = track_of_program(self.robot, program, name)
        self.tracks[name] = track
        peak = 100 * max((p for p in metrics.overshoot_peak if np.isfinite(p)), default=0.0)
        self.last = (
            f"{method}: {found.status}, {metrics.stages} stages, {metrics.time_s:.1f} s, "
            f"overshoot peak {peak:.1f} %"
        )
        return track
