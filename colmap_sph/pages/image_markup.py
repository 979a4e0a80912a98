"""Images of a page: the table, and what belongs to each picture."""

from dataclasses import dataclass
from typing import Any

from colmap_sph.errors import counted
from colmap_sph.pages.content import Content
from colmap_sph.pages.image_facts import ImageFacts
from colmap_sph.pages.map_markup import camera_path, outline
from colmap_sph.pages.pair_facts import PairFacts
from colmap_sph.pages.pictures import colour_of
from colmap_sph.pages.reasons import WORDS, Reason
from colmap_sph.pages.run_facts import RunFacts
from colmap_sph.pages.words import cell, percent, plain
from colmap_sph.project.wide.naming import by_originals
from colmap_sph.scene import Photograph

MOST_LINES = 100
"""Lines of what was left out."""

_COLUMNS = [
    ("image", "Name of the image"),
    ("coverage", "Share of pixels with a confirmed depth; of a region, of those that show it"),
    ("matched", "Share of pixels with a depth by its own pairs, confirmed or not; of a region likewise"),
    ("agreement", "Sparse points that agree with its depth map"),
    ("rows, px", "How far rows of its pairs disagree"),
    ("GSD", "What a pixel covers, model units (median)"),
    ("points", "Points of the cloud that this image made; where others see finer, they do"),
    ("partners", "Images that it was matched with"),
    ("lost most", "Why most of the other pixels have no depth"),
]


def image_values(content: Content, run: RunFacts) -> dict[str, Any]:
    """Values of the template for the images, and for the cameras and footprints on the map."""
    partners: list[list[PairFacts]] = [[] for _ in content.images]
    for pair in content.pairs:
        for place in (pair.left, pair.right):
            partners[place].append(pair)
    left_out = [
        *by_originals(run.skipped_images, run.views).items(),
        *((name, f"incomplete: {why}") for name, why in by_originals(run.incomplete, run.views).items()),
        *by_originals(run.out_of_region, run.views).items(),
    ]
    shown = sum(bool(image.pictures) for image in content.images)
    words = ""
    if shown < len(content.images):
        words = f"Pictures of {shown:,} images: the least covered, and an even choice of the others."
    rows = [_image_row(place, content, run, partners[place]) for place in range(len(content.images))]
    return {
        "columns": _COLUMNS,
        "images": rows,
        "left_out": left_out[:MOST_LINES],
        "left_out_more": max(len(left_out) - MOST_LINES, 0),
        "pictures_left_out": words,
    }


@dataclass(frozen=True)
class _Told:
    """What the run's report says of an image, None where it says nothing."""

    coverage: float
    agreement: float | None
    row_residual: float | None
    points: int | None


def _told(image: ImageFacts, photograph: Photograph, run: RunFacts) -> _Told:
    if not image.cut_into:
        name = image.name
        coverage = run.coverage.get(name, image.coverage)
        return _Told(coverage, run.agreement.get(name), run.row_residuals.get(name), run.points_of.get(name))
    points = [run.points_of[view.name] for view in photograph.views if view.name in run.points_of]
    seen, agreed = 0, 0.0
    for view in photograph.views:
        share = run.agreement.get(view.name)
        if share is not None:
            seen += len(view.point_indices)
            agreed += share * len(view.point_indices)
    counted = image.coverage if run.last_maps == "geometric" else image.found
    return _Told(
        # Of a region the report knows no share of the image's own pixels.
        run.originals.get(image.name, counted) if run.region is None else counted,
        agreed / seen if seen else None,
        run.row_residuals.get(photograph.lead.name),
        sum(points) if points else None,
    )


def _image_row(place: int, content: Content, run: RunFacts, pairs: list[PairFacts]) -> dict[str, Any]:
    image = content.images[place]
    photograph = content.photographs[place]
    told = _told(image, photograph, run)
    lost = max(
        (share, reason) for reason, share in zip(Reason, image.shares, strict=True) if reason > Reason.OUTSIDE
    )
    cells = [
        cell(told.coverage, percent(told.coverage)),
        cell(image.found, percent(image.found)),
        cell(told.agreement, percent(told.agreement, "")),
        cell(told.row_residual, plain(told.row_residual, ".2f")),
        cell(image.gsd, plain(image.gsd, "#.3g").rstrip(".")),
        cell(told.points, plain(told.points, ",")),
        cell(len(pairs), str(len(pairs))),
        {"value": None, "text": f"{WORDS[lost[1]][0]} {percent(lost[0])}" if lost[0] > 0 else ""},
    ]
    return {
        "number": place,
        "name": image.name,
        "cells": cells,
        "camera": camera_path(photograph, content.frame, len(content.images)),
        "footprint": "" if image.footprint is None else outline(image.footprint, content.frame),
        "pictures": image.pictures,
        "words": _image_words(image, pairs, told.points),
        **_bar(image),
    }


def _bar(image: ImageFacts) -> dict[str, Any]:
    """The image's pixels by what became of them, from left to right."""
    pieces = []
    start = 0.0
    for reason, share in zip(Reason, image.shares, strict=True):
        if share > 0:
            pieces.append({"start": f"{start:.1f}", "width": f"{100 * share:.1f}", "colour": colour_of(reason)})
        start += 100 * share
    named = [
        f"{WORDS[reason][0]} {percent(share)}"
        for reason, share in zip(Reason, image.shares, strict=True)
        if share > 0
    ]
    return {"bar": pieces, "bar_words": ", ".join(named)}


def _image_words(image: ImageFacts, pairs: list[PairFacts], points: int | None) -> str:
    named = [
        f"{WORDS[reason][0]} {percent(share)}"
        for reason, share in zip(Reason, image.shares, strict=True)
        if share >= 0.0005
    ]
    words = f"{image.width} × {image.height} pixels: {', '.join(named)}."
    if points is not None:
        words += f" {counted(points, 'point')} of the cloud."
    angles = sorted(pair.angle for pair in pairs if pair.angle is not None)
    if angles:
        words += f" {counted(len(pairs), 'partner')}, {angles[0]:.1f}° to {angles[-1]:.1f}°."
    if image.cut_into:
        words += f" Its maps are those of {counted(len(image.cut_into), 'view')}: {', '.join(image.cut_into)}."
    return words
