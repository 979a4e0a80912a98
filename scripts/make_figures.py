"""The figures of docs/algorithm.md, made from the built-in example.

    colmap_sph demo --output /tmp/demo
    python scripts/make_figures.py /tmp/demo docs/figures [FIGURE ...]

The same demo gives the same figures. Needs matplotlib: pip install 'colmap_sph[study]'.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from algorithm_figures import depth, matching, surface, views
from algorithm_figures.demo import Demo

FIGURES: dict[str, Callable[[Demo, Path], None]] = {
    "sparse_model": views.sparse_model,
    "partners": views.partners,
    "rectification": views.rectification,
    "plane": views.plane,
    "matching": matching.matching,
    "search_ranges": matching.search_ranges,
    "warping": matching.warping,
    "vote": depth.vote,
    "confirmation": depth.confirmation,
    "normals": surface.normals,
    "refinement": surface.refinement,
    "fusion": surface.fusion,
}


def main() -> None:
    """Make all figures, or those named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="output folder of `colmap_sph demo`")
    parser.add_argument("folder", type=Path, help="where the PNGs go")
    parser.add_argument("figures", nargs="*", help=f"which of {', '.join(FIGURES)}; default: all")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.figures) - set(FIGURES))
    if unknown:
        parser.error(f"there is no figure {', '.join(unknown)}")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    demo = Demo(arguments.demo)
    for name in arguments.figures or FIGURES:
        FIGURES[name](demo, arguments.folder / f"{name}.png")


if __name__ == "__main__":
    main()
