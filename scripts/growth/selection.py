"""Processor seconds and memory of the choice of pairs, in models of any layout and number of observations.

    python -m growth.selection --images 1000 4000 10000

What all images see is found for all; the choice itself is timed for some of the images, evenly spread, as each is
chosen for by itself. Memory is what both add to that of the model.
"""

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarking import machine, table

from colmap_sph.project.scene_reader import read_scene
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.partners.covisibility import find_covisibility
from colmap_sph.stereo.partners.pairs import PairOptions, best_partners
from growth.blocks import LAYOUTS, make_block, write_model

# Many observations of each image, few, none: what images share is told by tracks, points in view, frusta.
_OBSERVATIONS = (1000, 10, 0)
_CHOSEN_FOR = 50


def measure(images: int, observations: int, layout: str) -> list[str]:
    """Seconds to find what images see, milliseconds of each to choose its partners, and MiB of both."""
    folder = Path(tempfile.mkdtemp())
    try:
        write_model(make_block(images, observations, layout), folder)
        scene = anchored(read_scene(folder))
    finally:
        shutil.rmtree(folder)
    options = PairOptions()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    graph = find_covisibility(scene, options.min_shared_points, None)
    found = time.process_time()
    some = range(0, images, -(-images // _CHOSEN_FOR))
    for i in some:
        best_partners(graph, options, i)
    each = (time.process_time() - found) / len(some)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return [f"{found - start:.1f}", f"{1e3 * each:.0f}", f"{memory / 1024:.0f}"]


def main() -> None:
    """Measure each model in a process of its own, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, nargs="+", default=[1000, 4000, 10000], metavar="N")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        images, observations, layout = arguments.one
        print(*measure(int(images), int(observations), layout))
        return
    print(machine())
    rows = []
    for layout in LAYOUTS:
        for observations in _OBSERVATIONS:
            for images in arguments.images:
                model = [str(images), str(observations), layout]
                command = [sys.executable, "-m", "growth.selection", "--one", *model]
                told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
                rows.append([layout, str(observations), str(images), *told.split()])
                print(*rows[-1], flush=True)
    print(table(["layout", "observations", "images", "found, s", "chosen, ms per image", "MiB"], rows))


if __name__ == "__main__":
    main()
