"""Processor seconds of single steps in a workspace; or simulated reads.

python -m growth.steps WORKSPACE RESULT
python -m growth.steps --reads IMAGES RESULT
"""

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.fusion_partners import PartnersInFusion
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.partners.pairs import PairOptions, select_pairs
from colmap_sph.stereo.partners.places import Places
from growth.blocks import make_block, write_model
from growth.reads import reads_in_check, reads_in_fusion

T = TypeVar("T")

_PIXELS = 12e6
_MEMORY = 10e9


def steps(folder: Path) -> dict[str, float]:
    """Reading the model, choosing pairs, finding who is looked up in fusion, and the order of the work."""
    seconds: dict[str, float] = {}

    def timed(step: str, work: Callable[[], T]) -> T:
        start = time.process_time()
        result = work()
        seconds[step] = time.process_time() - start
        return result

    workspace = Workspace(folder)
    scene = timed("read", lambda: anchored(read_scene(workspace.sparse_dir)))
    pairs = timed("select", lambda: select_pairs(scene, PairOptions())).unique_pairs()
    context = Context(workspace, scene, RunOptions(), Keys(workspace, RunOptions()))
    partners = PartnersInFusion(context, pairs, list(scene.index_of))
    timed("fusion's partners", lambda: [partners[name] for name in partners])
    timed("order", lambda: Places(scene).sorted_pairs(pairs))
    return seconds


def reads(images: int) -> dict[str, Any]:
    """Reads of each view's maps in a block, in the order of place and in that of names."""
    folder = Path(tempfile.mkdtemp())
    try:
        write_model(make_block(images, 500), folder)
        scene = anchored(read_scene(folder))
    finally:
        shutil.rmtree(folder)
    return {
        "fusion": reads_in_fusion(scene, _PIXELS, _MEMORY),
        "check": reads_in_check(scene, _PIXELS, _MEMORY),
    }


if __name__ == "__main__":
    *what, given, target = sys.argv[1:]
    Path(target).write_text(json.dumps(reads(int(given)) if what else steps(Path(given))))
