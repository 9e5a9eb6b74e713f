#!/bin/bash
#SBATCH --job-name=muxjax-sweep
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=32
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=2G
#SBATCH --time=01:00:00
#SBATCH --requeue
# One process a core. A job that is stopped and queued again goes on from its checkpoint.
export JAX_PLATFORMS=cpu
export XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
export FOLDER="$SLURM_SUBMIT_DIR/out/cluster" SAMPLES=1e11
srun python docs/tutorials/cluster.py
