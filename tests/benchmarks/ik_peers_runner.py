"""Runs inside the peers' own environment: scipy and optimistix on the same poses.

Arguments: a file with lengths, poses and starts, and the number of rounds. Prints JSON: for each
peer the CPU-seconds a target of every round, the share solved at 1e-9, and its version.
"""

from __future__ import annotations

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import scipy
from scipy.optimize import least_squares

jax.config.update("jax_enable_x64", True)
given = np.load(sys.argv[1])
lengths, poses, starts = given["lengths"], given["poses"], given["starts"]
TOLERANCE = 1e-9


def residual(b, pose):
    """Position error over the arm's length, and rotation difference, of Cartesian bending."""
    frame = jnp.eye(4)
    for i, length in enumerate(lengths):
        x, y = b[2 * i], b[2 * i + 1]
        u = x * x + y * y + 1e-24
        theta = jnp.sqrt(u)
        s, v, c = jnp.sin(theta) / theta, (1 - jnp.cos(theta)) / u, jnp.cos(theta)
        turn = jnp.array(
            [
                [1 - v * x * x, -v * x * y, s * x],
                [-v * x * y, 1 - v * y * y, s * y],
                [-s * x, -s * y, c],
            ]
        )
        place = length * jnp.array([v * x, v * y, s])
        frame = frame @ jnp.block([[turn, place[:, None]], [jnp.zeros((1, 3)), jnp.ones((1, 1))]])
    apart = (frame - pose)[:3]
    return jnp.concatenate([apart[:, :3].ravel(), apart[:, 3] / lengths.sum()])


fun = jax.jit(residual)
slope = jax.jit(jax.jacfwd(residual))
solver = optimistix.LevenbergMarquardt(rtol=1e-12, atol=1e-14)


def by_optimistix(start, pose):
    """One solve from one start."""
    return optimistix.least_squares(residual, solver, start, pose, max_steps=100, throw=False).value


batched = jax.jit(jax.vmap(by_optimistix))


def scipy_all():
    """Each pose from one start, with exact Jacobians."""
    ends = [
        least_squares(
            lambda b, p=pose: np.asarray(fun(b, p)),
            start,
            jac=lambda b, p=pose: np.asarray(slope(b, p)),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        ).x
        for start, pose in zip(starts, poses, strict=True)
    ]
    return np.array(ends)


def optimistix_all():
    """All poses in one vmap."""
    return np.asarray(batched(jnp.asarray(starts), jnp.asarray(poses)))


out = {}
for name, call, version in (
    ("scipy", scipy_all, scipy.__version__),
    ("optimistix", optimistix_all, optimistix.__version__),
):
    times = []
    for number in range(int(sys.argv[2]) + 1):
        begin = time.process_time()
        ends = call()
        if number:
            times.append((time.process_time() - begin) / len(poses))
    worst = [float(np.abs(fun(b, p)).max()) for b, p in zip(ends, poses, strict=True)]
    out[name] = {
        "times": times,
        "solved": float(np.mean(np.array(worst) < TOLERANCE)),
        "version": version,
    }
print(json.dumps(out))
