"""Frame against spherical rectification on one model: the paper's experiment, and what it does not show.

    python scripts/study_rectification.py --output /tmp/study
    python scripts/study_rectification.py --scene drive --same-pixels spherical --output /tmp/study
    python scripts/study_rectification.py --model sparse/0 --lidar lidar.laz --output /tmp/study

Without --model it takes a scene that it renders.
Both surfaces get the same pairs, matcher and options; each is computed in a process of its own, so that the peak
memory is its own. OUTPUT gets study.md, study.json and the plots. What is already computed in OUTPUT with the same
options is measured again, not computed again. Needs matplotlib: pip install 'colmap_sph[study]'.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rectification_study import clouds, pairs, plots, runs, scenes, tables

from colmap_sph.app.evaluate_command import exact_depth_views, score_depth_maps
from colmap_sph.errors import ColmapSphError
from colmap_sph.evaluation import DepthView, mean_of_depth_maps, write_json
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import Scene
from colmap_sph.stereo.rectified_pair import Surface


@dataclass(frozen=True)
class Study:
    """Compare frame and spherical rectification on one model."""

    output: Path
    """Folder for the workspaces, the results, and what is rendered."""
    scene: scenes.SceneName = "town"
    """Scene to render: a street walked or driven along, an oblique block of a town."""
    width: int = 960
    """Width of rendered images, pixels."""
    model: Path | None = None
    """Sparse model, instead of a scene."""
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
    same_pixels: Surface | None = None
    """Compare again, with the sampling of this surface such that the pairs that both can rectify have as many
    rectified pixels."""
    shown_pairs: int = 3
    """Pairs whose depth maps are drawn side by side."""
    run: Annotated[RunOptions, tyro.conf.arg(name="")] = field(default_factory=RunOptions)


def main(study: Study) -> None:
    """Compute both, measure, write."""
    study = with_scene(study) if study.model is None else study
    study.output.mkdir(parents=True, exist_ok=True)
    results = {name: reconstructed(study, name, name, study.run) for name in runs.SURFACES}
    model_dir = results["spherical"].workspace.sparse_dir
    scene = read_scene(model_dir)
    exact = None
    if study.exact_depth is not None:
        exact = exact_depth_views(study.exact_depth, model_dir, study.depth_scale)
    gsd = study.gsd or median_gsd(scene)
    content = {
        "model": str(study.model),
        "images": len(scene.views),
        "gsd_m": gsd,
        **measured(study, scene, results, exact, gsd),
    }
    if study.same_pixels is not None and content["by_angle"][-1]["common_pairs"]:
        options = with_as_many_pixels(study.run, study.same_pixels, content["by_angle"][-1]["warped_common"])
        again = reconstructed(study, study.same_pixels, f"{study.same_pixels}_same_pixels", options)
        content["same_pixels"] = {
            "scaled": study.same_pixels,
            "sampling": options.rectification.sampling,
            **measured(study, scene, results | {study.same_pixels: again}, exact, gsd),
        }
    figures = [plots.points_per_image(content, study.output), plots.pairs_by_angle(content, study.output)]
    figures += [
        plots.depth_side_by_side(scene, results, pair, exact, study.run, study.output)
        for pair in pairs.telling_pairs(content["pairs"], study.shown_pairs)
    ]
    write_json(study.output / "study.json", {**content, "options": runs.plain(study.run)})
    (study.output / "study.md").write_text(tables.markdown(content, figures), encoding="utf-8")
    print(f"{study.output / 'study.md'}\n")


def with_scene(study: Study) -> Study:
    """The study of a rendered scene."""
    folder = study.output / f"{study.scene}-{study.width}"
    files = scenes.find_scene(study.scene, folder, study.width, study.run.num_threads)
    given = {one.name: getattr(study, one.name) for one in fields(study)}
    known = {one.name: getattr(files, one.name) for one in fields(files)}
    return Study(**(given | {name: value for name, value in known.items() if given[name] is None}))


def reconstructed(study: Study, surface: Surface, folder: str, options: RunOptions) -> runs.Run:
    """The study's model on one surface."""
    assert study.model is not None
    return runs.reconstruct(study.model, study.images, study.output / folder, options, surface)


def with_as_many_pixels(options: RunOptions, surface: Surface, pixels: tuple[int, int]) -> RunOptions:
    """Options with the sampling at which one surface has as many rectified pixels as the other now has.

    `pixels` are those of frame and sphere in the pairs that both have; rows and columns grow with the sampling.
    """
    frame, spherical = pixels
    ratio = spherical / frame if surface == "frame" else frame / spherical
    sampling = options.rectification.sampling * float(np.sqrt(ratio))
    return replace(options, rectification=replace(options.rectification, sampling=sampling))


def measured(
    study: Study, scene: Scene, results: Mapping[Surface, runs.Run], exact: list[DepthView] | None, gsd: float
) -> dict[str, Any]:
    """What is known of two runs, one per surface."""
    print(f"measuring: pairs (GSD {gsd:.3g})", flush=True)
    scored = pairs.score_pairs(scene, results, exact, study.run)
    content: dict[str, Any] = {
        "cost": {surface: run.cost for surface, run in results.items()},
        "failures": {surface: run.failure for surface, run in results.items() if run.failure},
        "skipped_pairs": {surface: run.report["skipped_pairs"] for surface, run in results.items()},
        "points": {surface: run.points() for surface, run in results.items()},
        "pairs": scored,
        "by_angle": pairs.by_angle(scored),
        "by_parallax": pairs.by_parallax(scored),
    }
    done = {surface: run for surface, run in results.items() if not run.failure}
    if study.lidar is not None and len(done) == len(results):
        print("measuring: distance to LiDAR", flush=True)
        content["lidar"] = clouds.against_lidar(results, study.lidar, exact, gsd)
    if exact is not None:
        print("measuring: exact depth", flush=True)
        content["exact_clouds"] = clouds.against_exact_depth(done, exact, gsd)
        content["exact_depth_maps"] = {
            surface: mean_of_depth_maps(score_depth_maps(run.workspace, exact)).as_dict()
            for surface, run in done.items()
        }
    return content


def median_gsd(scene: Scene) -> float:
    """Median over the images of the median depth of their sparse points over the focal length."""
    depths = [np.median((scene.points[v.point_indices] - v.center) @ v.viewing_direction) for v in scene.views]
    return float(np.nanmedian([depth / view.K[0, 0] for depth, view in zip(depths, scene.views, strict=True)]))


if __name__ == "__main__":
    try:
        main(tyro.cli(Study, config=(tyro.conf.FlagConversionOff,)))
    except ColmapSphError as error:
        sys.exit(f"error: {error}")
