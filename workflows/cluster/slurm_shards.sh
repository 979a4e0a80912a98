#!/usr/bin/env bash
# Dense reconstruction of one large project by job arrays of a Slurm cluster, without an engine.
#
#     workflows/cluster/slurm_shards.sh 16 --model sparse/0 [options of `colmap_sph run`]
#
# Run it where jobs are submitted. It submits a job that prepares the project, one array of 16 jobs for each of the
# stages match, vote and confirm, and a job that fuses and reports; each begins when all of the one before has ended
# well. Project and program must lie on a disk that all nodes share. Where a job failed or ran out of time, those that
# wait for it are cancelled: submit all again, and only what is missing is made; or that job alone, of shard 5 say:
#
#     sbatch --array=5 workflows/cluster/slurm_shards.sh match 16 --model sparse/0 [the same options]
#
# Tried with a stand-in for sbatch on one machine (tests/test_cluster_workflows.py), not on a real Slurm.
#SBATCH --job-name=colmap_sph
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=16
#SBATCH --mem=64G
#SBATCH --time=12:00:00
#SBATCH --output=colmap_sph_%x_%j.log
set -eu
usage="usage: slurm_shards.sh SHARDS [options of colmap_sph run]"
what=${1:?$usage}
shift

if [[ $what =~ ^[1-9][0-9]*$ ]]; then
    submit() { # STAGE DEPENDENCY [options of sbatch]
        sbatch --parsable --job-name="colmap_sph_$1" ${2:+--dependency=afterok:$2 --kill-on-invalid-dep=yes} \
            "${@:3}" "$script" "$1" "$what" "${options[@]}" | cut -d ';' -f 1
    }
    script=$0
    options=("$@")
    job=$(submit prepare "")
    for stage in match vote confirm; do
        job=$(submit "$stage" "$job" --array=1-"$what")
    done
    submit fuse "$job"
    exit
fi

shards=${1:?$usage}
shift
program=$(command -v colmap_sph) || program=${SLURM_SUBMIT_DIR:-.}/.venv/bin/colmap_sph
[ -x "$program" ] || { echo "colmap_sph is neither on the PATH nor in .venv of this folder" >&2; exit 2; }
case $what in
    prepare) which=(--stage prepare) ;;
    match | vote | confirm) which=(--stage "$what" --shard "${SLURM_ARRAY_TASK_ID:?submit with sbatch --array}/$shards") ;;
    fuse) which=() ;;
    *) echo "$usage" >&2; exit 2 ;;
esac

code=0
"$program" run "$@" "${which[@]}" || code=$?
# Some images cannot be used: the others go on. A shard that lacks something must be run again.
if [ "$code" = 5 ] && [ "${#which[@]}" -lt 4 ]; then
    echo "WARNING: finished without some images, see above" >&2
    code=0
fi
exit "$code"
