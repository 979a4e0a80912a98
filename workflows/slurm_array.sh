#!/usr/bin/env bash
# Dense reconstruction of many projects on a Slurm cluster: one array task per project.
#
#     printf '%s\n' /data/survey/*/sparse/[0-9]* > models.txt
#     sbatch --array=1-$(wc -l < models.txt) workflows/slurm_array.sh models.txt [options of `colmap_sph run`]
#     workflows/batch_summary.py models.txt --output models      # afterwards: a table, and a page with links
#
# models.txt names one sparse model per line; the results go to dense/ beside each sparse/, those of sparse/1 to
# dense-1/. `sacct -j JOB` tells which tasks failed or ran out of time; submit those again with --array=3,7, and they go
# on where they stopped. A project that finished without some of its images counts as done, with a warning in the task's
# log. A task keeps to the cores and the memory that it is given below. `colmap_sph` must be on the PATH, or in .venv of
# the folder where the job is submitted.
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

# Lines may end as on Windows.
model=$(sed -n "${SLURM_ARRAY_TASK_ID:?submit with sbatch --array}{s/\r\$//;p}" "$list")
[ -n "$model" ] || { echo "$list has no line $SLURM_ARRAY_TASK_ID" >&2; exit 2; }

program=$(command -v colmap_sph) || program=${SLURM_SUBMIT_DIR:-.}/.venv/bin/colmap_sph
[ -x "$program" ] || { echo "colmap_sph is neither on the PATH nor in .venv of this folder" >&2; exit 2; }

code=0
"$program" run --model "$model" "$@" || code=$?
case $code in
    5) echo "$model: WARNING: finished without some images, see its colmap_sph/report.json" ;;
    0) echo "$model: complete" ;;
    *) exit "$code" ;;
esac
