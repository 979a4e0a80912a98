#!/usr/bin/env bash
# Dense reconstruction of one large project on several nodes of a Slurm cluster.
#
#     sbatch --nodes=8 workflows/cluster/slurm.sh --model sparse/0 [options of `colmap_sph run`]
#
# Starts a scheduler of Dask on the first node, workers on all of them, and the run. Project and program must lie on a
# disk that all nodes share, the program installed with Dask: pip install '.[dask]'. Out of time, or a node lost:
# submit it again, and it goes on where it stopped. Each node takes WORKERS processes (default: one for each 8 cores).
#
# Tried with a stand-in for srun on one machine (tests/test_cluster_workflows.py), not on a real Slurm.
#SBATCH --job-name=colmap_sph
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=32
#SBATCH --mem=0
#SBATCH --exclusive
#SBATCH --time=12:00:00
#SBATCH --output=colmap_sph_%j.log
set -eu
here=${SLURM_SUBMIT_DIR:-$PWD}
[ -x "$here/.venv/bin/dask" ] && PATH=$here/.venv/bin:$PATH
command -v dask >/dev/null || { echo "dask is neither on the PATH nor in .venv of this folder" >&2; exit 2; }

cores=${SLURM_CPUS_PER_TASK:?submit with sbatch}
workers=${WORKERS:-$(((cores + 7) / 8))}
export DASK_SCHEDULER_FILE=$here/.scheduler-$SLURM_JOB_ID.json
trap 'kill $(jobs -p) 2>/dev/null; rm -f "$DASK_SCHEDULER_FILE"' EXIT

dask scheduler --scheduler-file "$DASK_SCHEDULER_FILE" &
# A node that fails takes its own workers, and no others.
srun --ntasks-per-node=1 --cpus-per-task="$cores" --kill-on-bad-exit=0 --no-kill --wait=0 \
    dask worker --scheduler-file "$DASK_SCHEDULER_FILE" --nworkers "$workers" \
    --nthreads $(((cores + workers - 1) / workers)) --local-directory "${TMPDIR:-/tmp}" --death-timeout 120 &

colmap_sph run "$@" --scheduler "$DASK_SCHEDULER_FILE"
