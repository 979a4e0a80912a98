"""Seconds and peak memory of `evaluate` for two large clouds.

    python scripts/bench_evaluation.py [--points 5000000] [--definition points]

Two clouds of the same rolling ground, 700 m square: a noisy reconstruction with some far outliers, slightly
out of place, against a reference. Reading files is not timed.
"""

import argparse
import resource
import time

import numpy as np
import numpy.typing as npt

from colmap_sph.evaluation import EvaluationOptions, PointCloud, evaluate_cloud, format_clouds, make_reference

EXTENT = 700.0
OUTLIER_SHARE = 0.01


def ground(count: int, noise: float, seed: int) -> npt.NDArray[np.float64]:
    """Points (count, 3) on rolling ground with steps like buildings, in no spatial order."""
    random = np.random.default_rng(seed)
    x, y = random.random((2, count)) * EXTENT
    z = 10 * np.sin(x / 20) * np.cos(y / 15) + 8 * ((x // 25 + y // 25) % 3 == 0)
    return np.stack([x, y, z + random.normal(0, noise, count)], axis=1)


def main() -> None:
    """Print one line per step and the scores."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=5_000_000, help="points in each cloud")
    parser.add_argument("--definition", default="points", help="points, tanks-and-temples or eth3d")
    parser.add_argument("--threads", type=int, default=0, help="0: one per core")
    arguments = parser.parse_args()
    options = EvaluationOptions(tau=(0.1, 0.2, 0.5), definition=arguments.definition, threads=arguments.threads)
    cloud = ground(arguments.points, 0.1, 1) + np.array([0.2, -0.1, 0.15])
    outliers = int(OUTLIER_SHARE * arguments.points)
    cloud[:outliers, 2] += np.random.default_rng(3).normal(0, 20, outliers)
    truth = PointCloud("reference", ground(arguments.points, 0.02, 2))
    started = time.perf_counter()
    reference = make_reference(truth, options)
    prepared = time.perf_counter()
    scores = evaluate_cloud(PointCloud("cloud", cloud), reference, options)
    finished = time.perf_counter()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(format_clouds([scores]))
    print(
        f"\n{arguments.points:,} against {arguments.points:,} points: reference {prepared - started:.1f} s, "
        f"evaluation {finished - prepared:.1f} s, peak memory {peak:.2f} GiB"
    )


if __name__ == "__main__":
    main()
