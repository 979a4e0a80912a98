"""Frame against spherical rectification on one model: the paper's experiment, and what it does not show.

    python scripts/study_rectification.py --output /tmp/study
    python scripts/study_rectification.py --model sparse/0 --lidar lidar.laz --output /tmp/study

Without --model it takes the shared test block `penta` (COLMAP_SPH_DATA, or ../shared/data beside the repository).
Both surfaces get the same pairs, matcher and options; each is computed in a process of its own, so that the peak
memory is its own. OUTPUT gets study.md, study.json and the plots. What is already computed in OUTPUT with the same
options is measured again, not computed again. Needs matplotlib: pip install 'colmap_sph[study]'.
"""

import os
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rectification_study import clouds, pairs, plots, runs, tables

from colmap_sph.app.evaluate_command import exact_depth_views, score_depth_maps
from colmap_sph.errors import ColmapSphError, OptionError
from colmap_sph.evaluation import mean_of_depth_maps, write_json
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import Scene


@dataclass(frozen=True)
class Study:
    """Compare frame and spherical rectification on one model."""

    output: Path
    """Folder for the two workspaces and the results."""
    model: Path | None = None
    """Sparse model. Default: the shared block `penta`, with its LiDAR cloud and exact depth."""
    images: Path | None = None
    """Original images. Default: the folder `images` beside or above the model."""
    lidar: Path | None = None
    """LiDAR cloud or other reference (PLY, OBJ, LAS, LAZ) in the model's frame."""
    exact_depth: Path | None = None
    """Folder of exact depth maps at pixel centres, named as the images, which must be free of distortion."""
    depth_scale: float | None = None
    """Metres of one unit of integer depth maps."""
    gsd: float | None = None
    """Ground sampling distance, metres. Default: the median of depth / focal length of the sparse points."""
    shown_pairs: int = 3
    """Pairs whose depth maps are drawn side by side."""
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = field(default_factory=RunOptions)


def main(study: Study) -> None:
    """Compute both, measure, write."""
    study = with_shared_data(study) if study.model is None else study
    assert study.model is not None
    study.output.mkdir(parents=True, exist_ok=True)
    results = {
        name: runs.reconstruct(study.model, study.images, study.output / name, study.run, name)
        for name in runs.SURFACES
    }
    scene = read_scene(results["spherical"].workspace.sparse_dir)
    gsd = study.gsd or median_gsd(scene)
    exact = None
    if study.exact_depth is not None:
        exact = exact_depth_views(study.exact_depth, results["spherical"].workspace.sparse_dir, study.depth_scale)

    print(f"measuring: pairs (GSD {gsd:.3g})", flush=True)
    scored_pairs = pairs.score_pairs(scene, results, exact, study.run)
    content = {
        "model": str(study.model),
        "images": len(scene.views),
        "gsd_m": gsd,
        "cost": {surface: run.cost for surface, run in results.items()},
        "skipped_pairs": {surface: run.report["skipped_pairs"] for surface, run in results.items()},
        "points": {surface: run.points() for surface, run in results.items()},
        "pairs": scored_pairs,
        "by_angle": pairs.by_angle(scored_pairs),
    }
    if study.lidar is not None:
        print("measuring: distance to LiDAR", flush=True)
        content["lidar"] = clouds.against_lidar(results, study.lidar, exact, gsd)
    if exact is not None:
        print("measuring: exact depth", flush=True)
        content["exact_clouds"] = clouds.against_exact_depth(results, exact, gsd)
        content["exact_depth_maps"] = {
            surface: mean_of_depth_maps(score_depth_maps(run.workspace, exact)).as_dict()
            for surface, run in results.items()
        }

    figures = [plots.points_per_image(content, study.output), plots.pairs_by_angle(content, study.output)]
    figures += [
        plots.depth_side_by_side(scene, results, pair, exact, study.run, study.output)
        for pair in pairs.telling_pairs(scored_pairs, study.shown_pairs)
    ]
    write_json(study.output / "study.json", {**content, "options": runs.plain(study.run)})
    (study.output / "study.md").write_text(tables.markdown(content, figures), encoding="utf-8")
    print(f"{study.output / 'study.md'}\n")


def with_shared_data(study: Study) -> Study:
    """The study of the shared block `penta`."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    penta = Path(os.environ.get("COLMAP_SPH_DATA", default)) / "penta"
    if not penta.is_dir():
        raise OptionError(f"the shared block is not at {penta}: set COLMAP_SPH_DATA, or give --model.")
    given = asdict(study) | {"run": study.run, "model": penta / "sparse" / "0"}
    given |= {"lidar": study.lidar or penta / "lidar.laz", "exact_depth": study.exact_depth or penta / "depth"}
    return Study(**(given | {"depth_scale": study.depth_scale or 0.005}))


def median_gsd(scene: Scene) -> float:
    """Median over the images of the median depth of their sparse points over the focal length."""
    depths = [np.median((scene.points[v.point_indices] - v.center) @ v.viewing_direction) for v in scene.views]
    return float(np.nanmedian([depth / view.K[0, 0] for depth, view in zip(depths, scene.views, strict=True)]))


if __name__ == "__main__":
    try:
        main(tyro.cli(Study, config=(tyro.conf.FlagConversionOff,)))
    except ColmapSphError as error:
        sys.exit(f"error: {error}")
