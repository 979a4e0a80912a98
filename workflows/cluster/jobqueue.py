#!/usr/bin/env python3
"""Dense reconstruction of one large project by jobs that come and go in a queue: dask-jobqueue, here for Slurm.

    pip install '.[dask]' dask-jobqueue
    workflows/cluster/jobqueue.py --model sparse/0 [options of `colmap_sph run`]

Runs on a machine that may submit jobs, and asks for as many as there is work for, up to MOST_JOBS; each is a
worker that joins when the queue lets it begin, and one that is lost or out of time is replaced. Edit what a job is
below, or take PBSCluster, SGECluster, LSFCluster … in the place of SLURMCluster. Project and program must lie on a
disk that all nodes share.

Tried with a stand-in for sbatch on one machine, not on a real Slurm.
"""

import os
import subprocess
import sys

from dask_jobqueue import SLURMCluster

MOST_JOBS = int(os.environ.get("MOST_JOBS", "50"))


def main() -> int:
    """Run with workers from the queue; return the run's exit code."""
    with SLURMCluster(
        job_name="colmap_sph",
        cores=8,  # threads of a job,
        processes=1,  # which is one process
        memory="32GiB",
        walltime="04:00:00",
        # Out of time, a job ends by itself before it is killed; the run goes on with others.
        worker_extra_args=["--lifetime", "230m", "--lifetime-stagger", "5m"],
        local_directory=os.environ.get("TMPDIR", "/tmp"),
        log_directory="colmap_sph_jobs",
    ) as cluster:
        cluster.adapt(minimum_jobs=1, maximum_jobs=MOST_JOBS)
        run = [sys.executable, "-m", "colmap_sph", "run", *sys.argv[1:], "--scheduler", cluster.scheduler_address]
        return subprocess.run(run, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
