#!/usr/bin/env bash
# Dense reconstruction of many projects on a Slurm cluster: one array task per project.
#
#     printf '%s\n' /data/survey/*/sparse/0 > models.txt
#     sbatch --array=1-$(wc -l < models.txt) workflows/slurm_array.sh models.txt [options of `colmap_sph run`]
#
# models.txt names one sparse model per line; the results go to dense/ beside each sparse/. `sacct -j JOB` tells
# which tasks failed or ran out of time; submit those again with --array=3,7, and they go on where they stopped. A
# project that finished without some of its images counts as done, with a warning in the task's log. A task keeps to
# the cores and the memory that it is given below. `colmap_sph` must be on the PATH: submit with its environment
# active.
#SBATCH --job-name=colmap_sph
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=16
#SBATCH --mem=64G
#SBATCH --time=12:00:00
#SBATCH --output=colmap_sph_%A_%a.log
set -eu
list=${1:?usage: sbatch --array=1-N slurm_array.sh models.txt [options of colmap_sph run]}
shift

model=$(sed -n "${SLURM_ARRAY_TASK_ID:?submit with sbatch --array}p" "$list")
[ -n "$model" ] || { echo "$list has no line $SLURM_ARRAY_TASK_ID" >&2; exit 2; }

code=0
colmap_sph run --model "$model" "$@" || code=$?
case $code in
    5) echo "$model: WARNING: finished without some images, see dense/colmap_sph/report.json" ;;
    0) echo "$model: complete" ;;
    *) exit "$code" ;;
esac
