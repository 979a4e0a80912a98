#!/usr/bin/env bash
# Dense reconstruction of one large project on several nodes of a PBS cluster.
#
#     qsub -l select=8:ncpus=32:mem=120gb -v OPTIONS="--model sparse/0" workflows/cluster/pbs.sh
#
# As slurm.sh: a scheduler of Dask on the first node, workers on all of them, and the run, with the options of
# `colmap_sph run` in OPTIONS. Each node takes WORKERS processes (default: one for each 8 cores).
#
# Tried with a stand-in for pbsdsh on one machine (tests/test_cluster_workflows.py), not on a real PBS.
#PBS -N colmap_sph
#PBS -l select=4:ncpus=32:mem=120gb
#PBS -l walltime=12:00:00
#PBS -j oe
set -eu
cd "${PBS_O_WORKDIR:?submit with qsub}"
[ -x .venv/bin/dask ] && PATH=$PWD/.venv/bin:$PATH
dask=$(command -v dask) || { echo "dask is neither on the PATH nor in .venv of this folder" >&2; exit 2; }

cores=${NCPUS:-$(nproc)}
workers=${WORKERS:-$(((cores + 7) / 8))}
file=$PWD/.scheduler-$PBS_JOBID.json
trap 'kill $(jobs -p) 2>/dev/null; rm -f "$file"' EXIT

dask scheduler --scheduler-file "$file" &
# One for each chunk of `select`; it hands no environment on, so that all paths are whole.
pbsdsh -- "$dask" worker --scheduler-file "$file" --nworkers "$workers" \
    --nthreads $(((cores + workers - 1) / workers)) --local-directory "${TMPDIR:-/tmp}" --death-timeout 120 &

read -r -a options <<<"${OPTIONS:?give the options of colmap_sph run: qsub -v OPTIONS=\"--model sparse/0\"}"
colmap_sph run "${options[@]}" --scheduler "$file"
