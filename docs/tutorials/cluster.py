"""A sweep that runs on one machine or on many. Shown by docs/tutorials/cluster.md.

It writes sweep.ckpt and sweep.npz into the folder out/cluster.
"""

# %% [markdown]
# # Sweeps on a cluster
# Every process runs this file; JAX divides the work. Alone, on a laptop, it is a small sweep.

# %% --8<-- [start:join]
import os
from pathlib import Path

import jax

if "SLURM_JOB_ID" in os.environ:
    jax.distributed.initialize()  # finds address, count and rank by itself
elif "COORDINATOR" in os.environ:  # by hand: "host:port" of the first process
    jax.distributed.initialize(
        os.environ["COORDINATOR"], int(os.environ["PROCESSES"]), int(os.environ["RANK"])
    )

import muxjax  # after joining: JAX must not have started before

# --8<-- [end:join]

# %% --8<-- [start:sweep]
folder = Path(os.environ.get("FOLDER", "out/cluster"))  # on a file system that all share
folder.mkdir(parents=True, exist_ok=True)
found = muxjax.sweep(
    muxjax.load_robot("muxarm"),
    samples=int(float(os.environ.get("SAMPLES", "2e6"))),
    seed=1,
    checkpoint=folder / "sweep.ckpt",  # every 30 s, and on Ctrl-C
    resume=True,  # from there, if it is there
    out=folder / "sweep.npz",
)
if jax.process_index() == 0:
    print(f"{found.samples} samples: reach {1e3 * found.reach_radius:.0f} mm,")
    print(f"dexterity {100 * found.mean_dexterity:.3f} % on average")
# --8<-- [end:sweep]
