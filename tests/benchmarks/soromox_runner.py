"""Runs inside SoRoMoX's own environment: three constant-strain segments, poses of the tip.

Prints JSON: median and quartiles of CPU-seconds a pose, seconds to construct and to compile, and
the largest difference from poses handed in.
"""

from __future__ import annotations

import json
import statistics
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from soromox.systems.components import LinkSpec
from soromox.systems.pcs.pcs import PCS

given = np.load(sys.argv[1])
bending, length, position = given["bending"], given["length"], given["position"]
start = time.perf_counter()
links = [
    LinkSpec.circular(
        length=float(one),
        density=1000.0,
        radius=0.01,
        reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
        young_modulus=1e6,
        poisson_ratio=0.45,
    )
    for one in length
]
arm = PCS.from_links(links, base_pose=None)
constructed = time.perf_counter() - start

# Their rod runs along x. Our x is their y, our y their z: a bend towards our x is a curvature
# about their z, one towards our y a negative curvature about their y.
strain = np.zeros((len(bending), 3, 6), np.float32)
strain[..., 1] = -bending[..., 1] / length
strain[..., 2] = bending[..., 0] / length
strain = jnp.asarray(strain.reshape(len(bending), 18))
tip = jnp.asarray(float(np.sum(length)), jnp.float32)
base = arm.forward_kinematics(jnp.zeros(18), jnp.asarray(0.0))
run = jax.jit(jax.vmap(lambda q: arm.forward_kinematics(q, tip)))
start = time.perf_counter()
poses = jax.block_until_ready(run(strain))
compiled = time.perf_counter() - start
times = []
for _ in range(int(sys.argv[2])):
    start = time.process_time()
    jax.block_until_ready(run(strain))
    times.append((time.process_time() - start) / len(bending))
in_base = np.einsum("ij,njk->nik", np.linalg.inv(np.asarray(base)), np.asarray(poses))
found = in_base[:, [1, 2, 0], 3]
low, middle, high = statistics.quantiles(times, n=4, method="inclusive")
print(
    json.dumps(
        {
            "times": [middle, low, high],
            "constructed": constructed,
            "compiled": compiled,
            "difference": float(np.max(np.abs(found - position))),
        }
    )
)
