#!/usr/bin/env bash
# Dense reconstruction of one large project on machines that are reached by SSH.
#
#     workflows/cluster/ssh.sh "alpha beta gamma" --model /data/block/sparse/0 [options of `colmap_sph run`]
#
# Starts a scheduler of Dask here, a worker on each machine, and the run; ends them all when it is done. Keys must be
# set up, so that ssh asks nothing. Project and program must lie on a disk that all machines share, under the same
# path, the program installed with Dask: pip install '.[dask]'. The machines must reach this one's ports. Each takes
# one process with as many threads as it has cores.
#
# Tried with a stand-in for ssh on one machine (tests/test_cluster_workflows.py), not across a network.
set -eu
hosts=${1:?usage: ssh.sh "HOST HOST …" [options of colmap_sph run]}
shift
[ -x .venv/bin/dask ] && PATH=$PWD/.venv/bin:$PATH
dask=$(command -v dask) || { echo "dask is neither on the PATH nor in .venv of this folder" >&2; exit 2; }

file=$PWD/.scheduler-$$.json
trap 'kill $(jobs -p) 2>/dev/null; rm -f "$file"' EXIT

dask scheduler --scheduler-file "$file" &
for host in $hosts; do
    # Quoted for the shell at the other end; -tt ends the worker there when ssh ends here.
    ssh -tt -o BatchMode=yes "$host" "$(printf '%q ' "$dask" worker --scheduler-file "$file" --death-timeout 120)" \
        </dev/null &
done

colmap_sph run "$@" --scheduler "$file"
