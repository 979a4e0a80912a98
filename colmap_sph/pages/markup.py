"""What is known of a workspace → the text of its page, in which every name is text and nothing else."""

import base64
import hashlib
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

import colmap_sph
from colmap_sph.errors import counted, printable
from colmap_sph.pages.content import Content
from colmap_sph.pages.image_markup import MOST_LINES, image_values
from colmap_sph.pages.map_markup import cloud_values, map_values
from colmap_sph.pages.run_facts import RunFacts, changed_since
from colmap_sph.pages.words import duration, percent, pixels
from colmap_sph.project.files import real_path

_FOLDER = Path(__file__).parent
_ANGLE_BARS = 24
# One for all pages of a process: templates are compiled once.
_ENVIRONMENT = Environment(
    loader=FileSystemLoader(_FOLDER),
    autoescape=True,
    undefined=StrictUndefined,
    # Names of files may hold characters that reorder or hide what stands beside them.
    finalize=lambda value: value if isinstance(value, Markup) else printable_text(value),
)


def render(content: Content) -> str:
    """Return the page's text."""
    run = content.run or RunFacts()
    values: dict[str, Any] = {
        **style_and_script("page.css", "cloud.js", "page.js"),
        "version": colmap_sph.__version__,
        **_head(content, run),
        **cloud_values(content),
        **map_values(content),
        **image_values(content, run),
        **_pairs(content, run),
        **_run(run),
        "products": content.products,
        "product_pictures": content.product_pictures,
    }
    values["data"] |= {
        "names": [printable(image.name) for image in content.images],
        "pairs": [[pair.left, pair.right, pair.angle, pair.rows] for pair in content.pairs],
    }
    return from_template("page.html", values)


def from_template(name: str, values: Mapping[str, Any]) -> str:
    """Fill in a template of this folder."""
    return _ENVIRONMENT.get_template(name).render(values)


def style_and_script(style_name: str, *script_names: str) -> dict[str, str]:
    """Values of a template for a page's own style and scripts, of files of this folder, and their digests."""
    style = (_FOLDER / style_name).read_text(encoding="utf-8")
    script = "".join((_FOLDER / name).read_text(encoding="utf-8") for name in script_names)
    return {
        "style": Markup(style),
        "style_hash": _hash(style),
        "script": Markup(script),
        "script_hash": _hash(script),
    }


def printable_text(value: object) -> object:
    """A value of the template, with what cannot be seen in it written out."""
    return "\n".join(map(printable, value.split("\n"))) if isinstance(value, str) else value


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


# ---- head --------------------------------------------------------------------------------------------------


def _head(content: Content, run: RunFacts) -> dict[str, Any]:
    notices = list(run.warnings)
    changed = changed_since(content.workspace, run, content.scene.index_of)
    changed = list(dict.fromkeys(content.scene.photograph(name).name for name in changed))
    if changed:
        some = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
        notices.insert(0, ("out of date", f"maps were made again after the run that this tells of ended: {some}."))
    if run.until == "photometric":
        words = "the run ended with depth that images have by their own pairs, and no other image confirms."
        notices.insert(0, ("photometric maps only", words))
    if content.cloud.doubt:
        notices.insert(0, ("in doubt", content.cloud.doubt))
    if content.missing:
        notices.insert(0, ("not finished", f"{content.missing[:1].upper()}{content.missing[1:]}."))
    root = real_path(content.workspace.root)
    return {
        "title": "/".join(root.parts[-2:]) if len(root.parts) > 2 else str(root),
        "headline": _headline(content, run),
        "notices": notices,
        "facts": _facts(content, run),
        "how_to_look": (_where_the_cloud_is(content) if content.cloud.total else "")
        + "Depth and normal maps are in stereo, as COLMAP has them; "
        "colmap gui and the meshers of COLMAP and OpenMVS take the whole folder as their workspace.",
    }


def _where_the_cloud_is(content: Content) -> str:
    workspace = content.workspace
    if workspace.fused_path.exists():
        return (
            f"The whole cloud is {workspace.fused_path.name}, beside the folder of this page: colmap_sph "
            "view --full shows all of it, and CloudCompare, MeshLab and Blender open it. "
        )
    return (
        f"The whole cloud is in tiles, in {workspace.tiles_dir.name} beside the folder of this page, whose "
        "index.json says where each lies; CloudCompare, MeshLab and Blender open them. "
    )


def _headline(content: Content, run: RunFacts) -> str:
    with_depth = sum(covered > 0 for covered in _coverage(content, run))
    words = f"{with_depth:,} of {counted(len(content.images), 'image')} with depth maps"
    if content.cloud.total:
        words += f", {content.cloud.total:,} points"
    seconds = run.total_seconds or sum(run.seconds.values())  # earlier versions knew the stages' alone
    return f"{words}, in {duration(seconds)}." if seconds else f"{words}."


def _coverage(content: Content, run: RunFacts) -> list[float]:
    """Share of pixels of each image with a depth of the kind with which the run ended."""
    return [image.coverage if run.last_maps == "geometric" else image.found for image in content.images]


def _facts(content: Content, run: RunFacts) -> list[tuple[str, str, str]]:
    # The run counted all pixels, as its summary says it, the page some.
    counts = zip(content.images, _coverage(content, run), strict=True)
    coverage = [run.coverage.get(image.name, share) for image, share in counts if share > 0]
    gsd = [image.gsd for image in content.images if image.gsd is not None]
    angles = [pair.angle for pair in content.pairs if pair.angle is not None]
    facts = [
        (
            "coverage",
            percent(sum(coverage) / len(coverage)) if coverage else "–",
            "Mean share of pixels with a depth" + (", of those that show the region" if run.region else ""),
        ),
        ("points", f"{content.cloud.total:,}", "Of the fused cloud"),
        (
            "GSD",
            f"{median(gsd):.3g} units" if gsd else "–",
            "What a pixel covers of the surface, model units (median)",
        ),
        ("agreement", percent(run.overall_agreement), "Sparse points that agree with the depth maps"),
        (
            "pairs",
            f"{run.pairs or len(content.pairs):,}",
            f"Matched; chosen by {run.pair_source or 'unknown means'}",
        ),
        ("parallax", f"{median(angles):.1f}°" if angles else "–", "Median of the pairs' angles"),
        (
            "rows disagree",
            pixels(run.row_residual),
            "Rows of rectified pairs; more than 0.4: imprecise poses or lenses",
        ),
        ("peak memory", f"{run.peak_memory / 2**30:.2f} GiB" if run.peak_memory else "–", "Of the whole process"),
    ]
    if run.polishing:
        facts.append(("poses", run.polishing, "What polishing came to"))
    if run.stretched:
        facts.append(("values", run.stretched, "What became black and white"))
    return facts


# ---- pairs and run -----------------------------------------------------------------------------------------


def _pairs(content: Content, run: RunFacts) -> dict[str, Any]:
    pairs = content.pairs
    words = f"{counted(len(pairs), 'pair')} matched" if pairs else "It is not known which pairs were matched"
    angles = [pair.angle for pair in pairs if pair.angle is not None]
    if angles:
        words += f", with a parallax of {min(angles):.1f}° to {max(angles):.1f}° (median {median(angles):.1f}°)"
    skipped = list(run.skipped_pairs.items())
    return {
        "pair_words": f"{words}.",
        "angle_bars": _angle_bars(angles),
        "pairs_listed": bool(pairs),
        "skipped_pairs": skipped[:MOST_LINES],
        "skipped_pairs_more": max(len(skipped) - MOST_LINES, 0),
    }


def _angle_bars(angles: list[float]) -> list[dict[str, Any]]:
    if len(angles) < 2:
        return []
    counts, edges = np.histogram(angles, bins=_ANGLE_BARS, range=(0, max(max(angles), 1.0)))
    return [
        {
            "height": round(58 * int(count) / max(int(counts.max()), 1), 1),
            "words": f"{low:.1f}° to {high:.1f}°: {counted(int(count), 'pair')}",
            "from": f"{low:.0f}",
            "to": f"{high:.0f}",
        }
        for count, low, high in zip(counts, edges[:-1], edges[1:], strict=True)
    ]


def _run(run: RunFacts) -> dict[str, Any]:
    longest = max(run.seconds.values(), default=0.0)
    stages = [
        {
            "name": name,
            "seconds": f"{seconds:,.1f}",
            "share": round(100 * seconds / longest, 1) if longest > 0 else 0,
            "made": run.made.get(name, ""),
            "reused": run.reused.get(name, ""),
        }
        for name, seconds in run.seconds.items()
    ]
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    return {"stages": stages, "command": run.command, "drawn_region": run.drawn_region, "versions": versions}
