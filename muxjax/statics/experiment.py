"""The second paper's experiment on a synthetic arm (S IV): its measured data are not published.

The truth is a model too, finer than the one under test and perturbed: every hinge's stiffness,
every tendon's stiffness and circle, holsters' weight at the segment ends, a tilted mount, friction
in the Bowden cables between load cell and arm, offsets of the length readings, noise of cameras and
load cells. A slow motion between random postures is computed equilibrium by equilibrium, and
stretches that are static by the paper's criteria become the configurations (S IV-A).

What it does not have: inertia, friction at the beads' holes, play, creep of the hinges.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Bool, Float

from muxjax.statics.chain import ElasticChain
from muxjax.statics.curvature import (
    bending_between,
    pcc_bending,
    pcc_displacements,
    pcc_frames,
)
from muxjax.statics.files import load_chain
from muxjax.statics.forward import forward_statics

Mounting = Literal["upright", "hanging", "horizontal"]
GRAVITY = {
    "upright": (0.0, 0.0, -9.81),
    "hanging": (0.0, 0.0, 9.81),
    "horizontal": (-9.81, 0.0, 0.0),
}  # [m/s^2] in the base frame, whose z points along the straight arm

# S IV-A: what counts as static.
MOST_SPEED, MOST_ACCELERATION, MOST_TENSION_RATE = 0.5e-3, 25e-3, 0.1  # [m/s], [m/s^2], [N/s]


@dataclass(frozen=True)
class Perturbation:
    """How the synthetic truth differs from the model; standard deviations and constants."""

    hinge_spread: float = 0.10  # of the logarithm of each joint's stiffness
    segment_spread: float = 0.05  # of the logarithm of a whole segment's stiffness
    tendon_spread: float = 0.20  # of the logarithm of each tendon's stiffness
    radius_spread: float = 0.01  # of the logarithm of each tendon's radius
    tilt_deg: float = 1.0  # of the mount
    holster_kg: float = 0.015  # at each segment end
    friction: float = 0.05  # mu times the angle that each Bowden cable turns through
    length_offset_m: float = 0.2e-3
    camera_noise_m: float = 0.1e-3
    camera_noise_rad: float = 1e-3
    load_cell_noise_n: float = 0.02


@dataclass(frozen=True)
class Recording:
    """What the synthetic cameras, load cells and encoders saw. P samples, m tendons, S segments."""

    time: Float[np.ndarray, " P"]  # [s]
    tension: Float[np.ndarray, "P m"]  # [N]
    displacements: Float[np.ndarray, "P m"]  # [m]
    segment_ends: Float[np.ndarray, "P S 4 4"]  # in the world


@dataclass(frozen=True)
class Errors:
    """Of predicted tip poses, one a configuration (S appendix V-D).

    Relative ones are over what the tip has moved and turned from the straight arm. (The text of
    V-D at hand has lost its formulas; these fit how S IV-B speaks of them.)
    """

    position: Float[np.ndarray, " N"]  # [m]
    relative_position: Float[np.ndarray, " N"]
    orientation: Float[np.ndarray, " N"]  # [rad]
    relative_orientation: Float[np.ndarray, " N"]


@dataclass(frozen=True)
class Experiment:
    """Static configurations and how well each model predicts them."""

    chain: ElasticChain  # the model under test
    measured: Recording  # means over the static stretches, N of them
    motion: Recording
    static: Bool[np.ndarray, " P"]
    travel: Float[np.ndarray, " N"]  # of the tip from the straight arm [m]
    turn: Float[np.ndarray, " N"]  # [rad]
    errors: dict[str, Errors]  # by method
    length_errors: dict[str, Float[np.ndarray, "N m"]]  # estimated less measured [m]
    tension_error: Float[np.ndarray, "N m"]  # FSL's less measured [N]
    predicted: dict[str, Float[np.ndarray, "N 4 4"]] = field(default_factory=dict)
    unsolved: tuple[str, ...] = ()  # configurations without an equilibrium, by method


def run_experiment(
    chain: str | Path = "hyper_redundant",
    *,
    postures: int = 15,
    mounting: Mounting = "hanging",
    seed: int = 0,
    perturbation: Perturbation | None = None,
    largest_tension: float = 12.0,
    finer: int = 2,
) -> Experiment:
    """Simulate the motion, find its static stretches, and evaluate FST, FSL and PCC on them.

    - **FST**: measured tensions to posture, and to tendon lengths (S Fig. 5, 6).
    - **FSL**: measured lengths to posture, and to tensions (S Fig. 7, 8).
    - **PCC from lengths**: the kinematic model on the same input as FSL.
    - **PCC from ends**: the paper's reference: arcs through the measured orientations.

    Args:
        chain: Model under test, a shipped chain or path of a YAML file with hinges.
        postures: Random postures that the motion halts at.
        mounting: How gravity acts on the arm, whose paper does not say.
        seed: Of truth, motion and noise.
        perturbation: How the truth differs from the model.
        largest_tension: In a random posture [N].
        finer: Beads of the truth for each one of the model.

    Raises:
        ValueError: Wrong counts or names, or no stretch of the motion was static.
    """
    if mounting not in GRAVITY:
        raise ValueError(f"mounting: must be one of {', '.join(GRAVITY)}, found {mounting!r}")
    for name, value in (("postures", postures), ("finer", finer)):
        if value < 1:
            raise ValueError(f"{name}: must be at least 1, found {value}")
    if not 0 < largest_tension < np.inf:
        raise ValueError(f"largest_tension: must be above 0 N, found {largest_tension:g}")
    perturbation = Perturbation() if perturbation is None else perturbation
    rng = np.random.default_rng(seed)
    model = load_chain(chain)
    model = eqx.tree_at(lambda c: c.gravity, model, np.array(GRAVITY[mounting]))
    truth = _perturbed(_refined(chain, model, finer), perturbation, rng)
    motion = _record(truth, perturbation, postures, largest_tension, rng)
    static = static_samples(motion)
    runs = _stretches(static)
    if not runs:
        raise ValueError(
            "experiment: no stretch of the motion was static by the criteria of S IV-A"
        )
    return _evaluated(model, motion, static, _means(motion, runs))


def one_at_a_time(chain: str | Path = "hyper_redundant", **options: Any) -> dict[str, Experiment]:
    """The experiment with each perturbation alone, by its name, and first with none.

    What is left with none is the finer truth. Options as in ``run_experiment``.
    """
    names = [f.name for f in fields(Perturbation)]
    nothing = Perturbation(**dict.fromkeys(names, 0.0))
    default = Perturbation()
    found = {"none": run_experiment(chain, perturbation=nothing, **options)}
    for name in names:
        alone = replace(nothing, **{name: getattr(default, name)})
        found[name] = run_experiment(chain, perturbation=alone, **options)
    return found


def _refined(chain: str | Path, model: ElasticChain, finer: int) -> ElasticChain:
    """The same arm with more beads; holes stay where they are."""
    beads = len(model.routing[0]) - 1
    fine = load_chain(chain, resolution=finer * beads, hole_every=finer)
    return eqx.tree_at(lambda c: c.gravity, fine, model.gravity)


def _perturbed(chain: ElasticChain, size: Perturbation, rng: np.random.Generator) -> ElasticChain:
    """The truth: another arm of the same make."""
    ends = np.array(chain.segment_bodies)
    own = np.searchsorted(ends, np.arange(1, chain.n_joints + 1))
    softer = rng.normal(0, size.segment_spread, len(ends))[own]
    stiffness = chain.stiffness * np.exp(softer + rng.normal(0, size.hinge_spread, len(own)))
    tendons = np.exp(rng.normal(0, size.tendon_spread, chain.n_tendons))
    wider = np.exp(rng.normal(0, size.radius_spread, chain.n_tendons))
    per_hole = np.repeat(wider, [len(bodies) for bodies in chain.routing])
    hole = chain.hole * np.stack([per_hole, per_hole, np.ones_like(per_hole)], axis=-1)
    mass = np.array(chain.mass)
    mass[ends - 1] += size.holster_kg
    axis = rng.normal(size=2)
    tilt = np.radians(size.tilt_deg) * np.array([*axis, 0.0]) / np.linalg.norm(axis)
    gravity = scipy.spatial.transform.Rotation.from_rotvec(tilt).apply(chain.gravity)
    return eqx.tree_at(
        lambda c: (c.stiffness, c.tendon_stiffness, c.hole, c.mass, c.gravity),
        chain,
        (stiffness, chain.tendon_stiffness * tendons, hole, mass, gravity),
    )


RATE, MOVE, REST = 10.0, 8.0, 4.0  # samples a second; seconds of a move and of a halt


def _record(
    truth: ElasticChain,
    size: Perturbation,
    postures: int,
    largest: float,
    rng: np.random.Generator,
) -> Recording:
    """The motion through random postures, as the instruments see it."""
    m = truth.n_tendons
    pulls = rng.uniform(0, largest, (postures, m)) * (rng.random((postures, m)) < 0.4)
    halts = forward_statics(truth, tension=pulls + 0.5).check().displacements
    stops = np.concatenate(
        [forward_statics(truth, tension=np.full((1, m), 0.5)).displacements, halts]
    )
    s = np.arange(int(MOVE * RATE)) / (MOVE * RATE)
    ease = np.concatenate([s**3 * (10 - 15 * s + 6 * s * s), np.ones(int(REST * RATE))])
    moves = [a + ease[:, None] * (b - a) for a, b in pairwise(stops)]
    lengths = np.concatenate(moves)
    found = forward_statics(truth, displacements=lengths).check()
    return _seen(lengths, found, size, rng)


def _seen(
    lengths: Float[np.ndarray, "P m"], found: Any, size: Perturbation, rng: np.random.Generator
) -> Recording:
    """Readings with friction, offsets and noise.

    A Bowden cable that is being wound in, or was last, takes exp(mu phi) of the arm's tension at
    the load cell, one that is paid out exp(-mu phi) (capstan).
    """
    step = np.diff(lengths, axis=0, prepend=lengths[:1])
    way = np.sign(step) * (abs(step) > 1e-9)
    for k in range(1, len(way)):
        way[k] = np.where(way[k] == 0, way[k - 1], way[k])
    tension = found.tension * np.exp(-size.friction * way)
    noisy = tension + rng.normal(0, size.load_cell_noise_n, tension.shape)
    ends = np.array(found.segment_ends)
    ends[..., :3, 3] += rng.normal(0, size.camera_noise_m, ends[..., :3, 3].shape)
    shape = ends.shape[:-2]
    turn = scipy.spatial.transform.Rotation.from_rotvec(
        rng.normal(0, size.camera_noise_rad, (int(np.prod(shape)), 3))
    )
    ends[..., :3, :3] = ends[..., :3, :3] @ turn.as_matrix().reshape(*shape, 3, 3)
    return Recording(
        time=np.arange(len(lengths)) / RATE,
        tension=np.maximum(noisy, 0.0),
        displacements=lengths + rng.normal(0, size.length_offset_m, lengths.shape[-1]),
        segment_ends=ends,
    )


def static_samples(motion: Recording) -> Bool[np.ndarray, " P"]:
    """Samples at which the tip and the tensions hardly change, by the criteria of S IV-A.

    Derivatives are those of parabolas through a second of samples around each.
    """
    from scipy.signal import savgol_filter  # takes a quarter of a second to import

    dt = float(motion.time[1] - motion.time[0])
    window = 2 * round(0.5 / dt) + 1
    tip = motion.segment_ends[:, -1, :3, 3]

    def slope(values: Any, order: int) -> Any:
        return savgol_filter(values, window, 2, deriv=order, delta=dt, axis=0)

    speed = np.linalg.norm(slope(tip, 1), axis=-1)
    acceleration = np.linalg.norm(slope(tip, 2), axis=-1)
    rate = abs(slope(motion.tension, 1)).max(axis=-1)
    found: np.ndarray = (
        (speed <= MOST_SPEED) & (acceleration <= MOST_ACCELERATION) & (rate <= MOST_TENSION_RATE)
    )
    return found


def _stretches(static: Bool[np.ndarray, " P"]) -> list[np.ndarray]:
    """Runs of static samples of at least a second."""
    edges = np.flatnonzero(np.diff(static.astype(int), prepend=0, append=0))
    runs = [np.arange(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if len(run) >= RATE]


def _means(motion: Recording, runs: list[np.ndarray]) -> Recording:
    """One configuration a stretch."""
    ends = np.stack([motion.segment_ends[run].mean(axis=0) for run in runs])
    for k, run in enumerate(runs):
        for s in range(ends.shape[1]):
            turns = scipy.spatial.transform.Rotation.from_matrix(
                motion.segment_ends[run, s, :3, :3]
            )
            ends[k, s, :3, :3] = turns.mean().as_matrix()
    return Recording(
        time=np.array([motion.time[run].mean() for run in runs]),
        tension=np.stack([motion.tension[run].mean(axis=0) for run in runs]),
        displacements=np.stack([motion.displacements[run].mean(axis=0) for run in runs]),
        segment_ends=ends,
    )


def _evaluated(
    model: ElasticChain, motion: Recording, static: np.ndarray, measured: Recording
) -> Experiment:
    """Every method on every configuration."""
    fst = forward_statics(model, tension=measured.tension)
    fsl = forward_statics(model, displacements=measured.displacements)
    bent = bending_between(model, measured.segment_ends)
    by_length = pcc_bending(model, measured.displacements)
    # Segment ends carry the markers; the tip frame, where it differs, is not measured.
    predicted = {
        "FST": _solved(fst),
        "FSL": _solved(fsl),
        "PCC from lengths": _arc_end(model, by_length),
        "PCC from ends": _arc_end(model, bent),
    }
    home = _arc_end(model, np.zeros((1, *by_length.shape[1:])))[0]
    target = measured.segment_ends[:, -1]
    return Experiment(
        chain=model,
        measured=measured,
        motion=motion,
        static=static,
        travel=np.linalg.norm(target[:, :3, 3] - home[:3, 3], axis=-1),
        turn=_angle(home[:3, :3], target[:, :3, :3]),
        errors={name: pose_errors(pose, target, home) for name, pose in predicted.items()},
        length_errors={
            "FST": np.asarray(fst.displacements) - measured.displacements,
            "PCC from ends": pcc_displacements(model, bent) - measured.displacements,
        },
        tension_error=np.asarray(fsl.tension) - measured.tension,
        predicted=predicted,
        unsolved=tuple(
            f"{name} {k + 1}"
            for name, found in (("FST", fst), ("FSL", fsl))
            for k in np.flatnonzero(~found.converged)
        ),
    )


def _solved(found: Any) -> Float[np.ndarray, "N 4 4"]:
    """The last segment's end; NaN where there is no solution, so that no error is invented."""
    ends = np.array(found.segment_ends[:, -1])
    ends[~found.converged] = np.nan
    return ends


def _arc_end(
    model: ElasticChain, bending: Float[np.ndarray, "N S 2"]
) -> Float[np.ndarray, "N 4 4"]:
    frames = pcc_frames(model, bending)[:, -1]
    tail = np.linalg.inv(np.asarray(model.tip)) @ np.asarray(model.end_frame)[-1]
    return frames @ tail


def pose_errors(
    predicted: Float[np.ndarray, "N 4 4"],
    measured: Float[np.ndarray, "N 4 4"],
    home: Float[np.ndarray, "4 4"],
) -> Errors:
    """Absolute errors, and relative to the way from ``home`` (see ``Errors``)."""
    position = np.linalg.norm(predicted[:, :3, 3] - measured[:, :3, 3], axis=-1)
    travel = np.linalg.norm(measured[:, :3, 3] - home[:3, 3], axis=-1)
    orientation = _angle(predicted[:, :3, :3], measured[:, :3, :3])
    turn = _angle(home[:3, :3], measured[:, :3, :3])
    return Errors(position, position / travel, orientation, orientation / turn)


def _angle(
    a: Float[np.ndarray, "*#N 3 3"], b: Float[np.ndarray, "*N 3 3"]
) -> Float[np.ndarray, " *N"]:
    """Angle between rotations [rad]; NaN where one is."""
    turn = np.swapaxes(a, -1, -2) @ b
    vee = np.stack([turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
    trace = np.trace(turn, axis1=-2, axis2=-1)
    angle: np.ndarray = np.arctan2(0.5 * np.linalg.norm(vee, axis=-1), 0.5 * (trace - 1))
    return angle
