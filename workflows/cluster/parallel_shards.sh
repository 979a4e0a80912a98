#!/usr/bin/env bash
# Dense reconstruction of one large project by GNU parallel, on machines that are reached by SSH.
#
#     workflows/cluster/parallel_shards.sh 16 --model /data/block/sparse/0 [options of `colmap_sph run`]
#
# Makes 16 shards of each stage, as many at a time as `parallel` is told to, by the options in the variable PARALLEL:
# PARALLEL='--jobs 1 --sshlogin alpha,beta --workdir .' has one on each of two machines. Project and program must lie
# on a disk that all machines share, under the same path. Begin again with the same command: what is finished is kept.
#
# Tried with GNU parallel on one machine, not across a network.
set -eu
shards=${1:?usage: parallel_shards.sh SHARDS [options of colmap_sph run]}
shift
program=$(command -v colmap_sph) || program=$PWD/.venv/bin/colmap_sph
[ -x "$program" ] || { echo "colmap_sph is neither on the PATH nor in .venv of this folder" >&2; exit 2; }
command -v parallel >/dev/null || { echo "GNU parallel is not installed" >&2; exit 2; }

code=0
"$program" run "$@" --stage prepare || code=$?
[ "$code" = 0 ] || [ "$code" = 5 ] || exit "$code" # 5: some images cannot be used, the others go on
for stage in match vote confirm; do
    seq "$shards" | parallel --quote --halt soon,fail=1 "$program" run "$@" --stage "$stage" --shard "{}/$shards"
done
"$program" run "$@"
