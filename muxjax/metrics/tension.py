"""How hard the tendons are pulled while a program runs: statics through every stage of it.

The motion is slow, so each instant is an equilibrium (MODEL.md section 9): tendons that stand still
are held by their worms and pull, or hang slack, as the posture demands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from muxjax.metrics.program import timeline
from muxjax.planning.motion import ANGLE_TOLERANCE, STRAIGHT
from muxjax.precision import host_array
from muxjax.robot import Robot
from muxjax.scheduler import Program
from muxjax.statics.chain import ElasticChain
from muxjax.statics.follow import follow
from muxjax.statics.posture import check_chain_of, segment_bending

SAMPLES_A_LEG = 4


@dataclass(frozen=True)
class TensionProfile:
    """A program's equilibria over time. Rows that were not solved are NaN, and count as such.

    Attributes:
        times: Of the samples [s]; ends of waits and of legs, and points on the legs.
        displacements: Length commands there [m].
        tension: Of every tendon [N].
        bending: Of every segment, end against end, in the true posture [rad].
        solved: Whether the equilibrium was found, with no tendon's holes crossed.
        stable: Whether it is a minimum of energy.
    """

    times: Float[np.ndarray, " P"]
    displacements: Float[np.ndarray, "P SJ"]
    tension: Float[np.ndarray, "P SJ"]
    bending: Float[np.ndarray, "P S"]
    solved: Bool[np.ndarray, " P"]
    stable: Bool[np.ndarray, " P"]

    @property
    def unsolved(self) -> int:
        """Samples without an equilibrium; figures below are over the others."""
        return int((~self.solved).sum())

    @property
    def peak(self) -> float:
        """Greatest tension of any tendon [N]."""
        return float(np.nanmax(self.tension)) if self.solved.any() else float("nan")

    @property
    def peak_at(self) -> tuple[int, float]:
        """Tendon (from 1) and time [s] of the peak.

        Raises:
            ValueError: No sample was solved.
        """
        if not self.solved.any():
            raise ValueError("peak_at: no sample of the program was solved")
        sample, tendon = np.unravel_index(np.nanargmax(self.tension), self.tension.shape)
        return int(tendon) + 1, float(self.times[sample])

    @property
    def mean(self) -> float:
        """Mean over time and tendons [N]."""
        return self._over_time(self.tension.mean(axis=-1))

    @property
    def mean_of_largest(self) -> float:
        """Mean over time of the tension of the tendon that is pulled hardest [N]."""
        return self._over_time(self.tension.max(axis=-1))

    @property
    def slack(self) -> float:
        """Share of time and tendons with less than 0.1 N."""
        return self._over_time(
            np.where(np.isnan(self.tension), np.nan, self.tension < 0.1).mean(-1)
        )

    def overshoot(self) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
        """Share of time above the final bending and greatest relative excess (as M Eq. 15).

        Like ``Metrics``, with the segments' true bending instead of that of the formulas; NaN
        where the last sample was not solved or, for the excess, where a segment ends straight.
        """
        goal = self.bending[-1]
        excess = self.bending - goal
        share = np.array([self._above(column - ANGLE_TOLERANCE) for column in excess.T])
        peak = np.maximum(np.nanmax(excess, axis=0), 0.0) if self.solved.any() else goal
        relative = np.where(goal >= STRAIGHT, peak / np.maximum(goal, STRAIGHT), np.nan)
        return np.where(np.isnan(goal), np.nan, share), relative

    def _over_time(self, values: Float[np.ndarray, " P"]) -> float:
        """Time average of a piecewise linear curve over its solved stretches."""
        width, middle = np.diff(self.times), 0.5 * (values[1:] + values[:-1])
        known = np.isfinite(middle)
        if not known.any():
            return float("nan")
        total = float(width[known].sum())
        if total == 0.0:
            return float(np.mean(middle[known]))
        return float((width[known] * middle[known]).sum() / total)

    def _above(self, excess: Float[np.ndarray, " P"]) -> float:
        """Share of the solved time in which a piecewise linear curve is above zero."""
        width, left, right = np.diff(self.times), excess[:-1], excess[1:]
        known = np.isfinite(left) & np.isfinite(right)
        top, gap = np.maximum(left, right), np.abs(left - right)
        crossing = (left > 0) != (right > 0)
        share = np.where(crossing, top / np.where(crossing, gap, 1.0), (left > 0) & (right > 0))
        total = float(width[known].sum())
        return float((width[known] * share[known]).sum() / total) if total > 0 else 0.0


def tension_along(
    robot: Robot,
    chain: ElasticChain,
    programs: Sequence[Program],
    *,
    samples_a_leg: int = SAMPLES_A_LEG,
    pretension: float = 0.0,
    payload: float = 0.0,
) -> list[TensionProfile]:
    """Tension in every tendon while programs run.

    Programs are solved side by side, samples one after the other (``statics.follow``).

    Args:
        robot: The arm.
        chain: Its elastic model, from ``elastic_chain(robot, ...)``.
        programs: Each from its own start, at rest.
        samples_a_leg: Equilibria on each leg.
        pretension: Of every tendon of the straight, weightless arm [N]: all of them are wound in
            by its stretch before they follow the program.
        payload: Mass at the tool frame's origin [kg].

    Raises:
        ValueError: No programs, one made for another robot, a chain of another arm, a pretension
            or payload below 0, fewer than one sample; names the field and the limit.
    """
    check_chain_of(robot, chain)
    if not programs:
        raise ValueError("programs: needs at least one")
    if samples_a_leg < 1:
        raise ValueError(f"samples_a_leg: must be at least 1, found {samples_a_leg}")
    tight = float(host_array("pretension", pretension))
    if tight < 0:
        raise ValueError(f"pretension: must be at least 0 N, found {tight:g}")
    sampled = [_samples(robot, program, samples_a_leg) for program in programs]
    longest = max(len(times) for times, _ in sampled)
    # A shorter program waits at its end.
    paths = np.stack([np.pad(d, ((0, longest - len(d)), (0, 0)), "edge") for _, d in sampled])
    found = follow(chain, paths - tight / np.asarray(chain.tendon_stiffness), payload=payload)
    bending = segment_bending(np.asarray(chain.base), found.segment_ends)
    profiles = []
    for i, (times, displacements) in enumerate(sampled):
        own = slice(0, len(times))
        solved = found.converged[i, own]
        profiles.append(
            TensionProfile(
                times,
                displacements,
                np.where(solved[:, None], found.tension[i, own], np.nan),
                np.where(solved[:, None], bending[i, own], np.nan),
                solved,
                found.stable[i, own],
            )
        )
    return profiles


def _samples(
    robot: Robot, program: Program, a_leg: int
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, "P SJ"]]:
    """When the tendons are where: the corners of the timeline, and points on its legs."""
    line = timeline(robot, program)
    times = [line.time_s[:1]]
    for k in range(1, len(line.time_s)):
        moves = bool((line.displacements[k] != line.displacements[k - 1]).any())
        share = np.arange(1, a_leg + 1) / a_leg if moves else np.ones(1)
        times.append(line.time_s[k - 1] + share * (line.time_s[k] - line.time_s[k - 1]))
    flat = np.concatenate(times)
    return flat, line.at(flat)
