"""Scores as text for people and as JSON for programs."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from math import inf, nan
from pathlib import Path

import numpy as np

from colmap_sph.errors import NoResultError, percent, printable, unwritable
from colmap_sph.evaluation.cloud_scores import CloudScores
from colmap_sph.evaluation.depth_maps import DepthMapScores
from colmap_sph.platforms.files import move_into_place, write_text


def format_clouds(scores: Sequence[CloudScores], width: int | None = None) -> str:
    """A plain-text report of clouds against one reference: a table, and the registrations below it.

    Parameters
    ----------
    scores : sequence of CloudScores
    width : int, optional
        Most columns of text; where a table has more, what is told of each distance goes below the rest.

    Returns
    -------
    str
    """
    if not scores:
        return ""
    header = ["cloud", "points", "judged", "mean [m]", "std [m]"]
    groups = [len(header) - 1, *(3 for _ in scores[0].thresholds)]
    for threshold in scores[0].thresholds:
        label = _tau_label(threshold.tau, scores[0].gsd)
        header += [f"acc {label}", f"comp {label}", f"F {label}"]
    rows = [header, *(_cloud_row(cloud) for cloud in scores)]
    first = scores[0]
    samples = f"{first.reference_count:,} samples; shares counted as {first.definition}"
    lines = [f"reference: {printable(first.reference)}, {samples}"]
    if first.cloud_to_reference.cap is not None:
        lines.append(f"distances above {first.cloud_to_reference.cap:g} m count as that")
    return "\n".join(
        [*lines, "", _aligned(rows, width, groups), "", *(_registration_line(cloud) for cloud in scores)]
    )


def format_depth_maps(scores: Mapping[str, DepthMapScores], width: int | None = None) -> str:
    """A plain-text table of depth maps, one row per image and their mean; see `format_clouds`."""
    if not scores:
        return ""
    first = next(iter(scores.values()))
    header = ["image", "coverage", *(f"<= {bound:g} GSD" for bound in first.thresholds), "median [GSD]"]
    with_normals = first.median_normal_angle is not None
    rows = [header + (["normals [deg]"] if with_normals else [])]
    means = mean_of_depth_maps(scores)
    for name, one in [*scores.items(), ("mean", means)]:
        row = [
            name,
            percent(one.coverage, 2),
            *(percent(share, 2) for share in one.within),
            f"{one.median_error:.3f}",
        ]
        if with_normals:
            angle = one.median_normal_angle
            row.append("-" if angle is None else f"{angle:.2f}")
        rows.append(row)
    return _aligned(rows, width)


def mean_of_depth_maps(scores: Mapping[str, DepthMapScores]) -> DepthMapScores:
    """Mean over images of every score; pixel counts are summed.

    Raises
    ------
    NoResultError
        No image.
    """
    if not scores:
        raise NoResultError("no depth map was compared")
    every = list(scores.values())
    median = _mean_of_known([one.median_error for one in every])
    return DepthMapScores(
        truth_pixels=sum(one.truth_pixels for one in every),
        compared_pixels=sum(one.compared_pixels for one in every),
        coverage=float(np.mean([one.coverage for one in every])),
        thresholds=every[0].thresholds,
        within=tuple(float(value) for value in np.mean([one.within for one in every], axis=0)),
        median_error=nan if median is None else median,
        median_normal_angle=_mean_of_known([one.median_normal_angle for one in every]),
        normal_coverage=_mean_of_known([one.normal_coverage for one in every]),
    )


def write_json(path: Path, content: object) -> None:
    """Write plain values as JSON, through a temporary name in the same folder.

    Raises
    ------
    OutputError
    """
    temporary = path.with_name(path.name + ".part")
    try:
        write_text(temporary, json.dumps(content, indent=2, allow_nan=False) + "\n")
        move_into_place(temporary, path)
    except OSError as error:
        raise unwritable(path, error) from error


def _mean_of_known(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.mean(known)) if known else None


def _cloud_row(scores: CloudScores) -> list[str]:
    distance = scores.cloud_to_reference
    row = [
        Path(scores.cloud).name,
        f"{scores.point_count:,}",
        f"{scores.judged_count:,}",
        f"{distance.mean:.4f}",
        f"{distance.standard_deviation:.4f}",
    ]
    for threshold in scores.thresholds:
        row += [percent(threshold.accuracy, 2), percent(threshold.completeness, 2), percent(threshold.f_score, 2)]
    return row


def _registration_line(scores: CloudScores) -> str:
    registration = scores.registration
    name = printable(Path(scores.cloud).name)
    if registration is None:
        return f"{name}: not registered"
    shift = ", ".join(f"{value:.3f}" for value in registration.shift)
    return (
        f"{name}: {'registered' if registration.applied else 'registration NOT applied'}, "
        f"rotation {registration.rotation_degrees:.4f} deg, shift ({shift}) m, "
        f"rms {registration.rms_before:.4f} -> {registration.rms_after:.4f} m, "
        f"{percent(registration.inlier_share, 2)} of the points paired"
    )


def _tau_label(tau: float, gsd: float | None) -> str:
    return f"{tau:g} m" if gsd is None else f"{tau / gsd:g} GSD"


def _aligned(rows: Sequence[Sequence[str]], width: int | None = None, groups: Sequence[int] | None = None) -> str:
    """Columns to the right, the first to the left; where they need more than `width`, groups below each other.

    Groups are of so many columns, all but the first; without them each column is one.
    """
    texts = list(zip(*([printable(cell) for cell in row] for row in rows), strict=True))
    widths = [max(map(len, column)) for column in texts]
    columns = [
        [cell.rjust(each) if number else cell.ljust(each) for cell in column]
        for number, (column, each) in enumerate(zip(texts, widths, strict=True))
    ]
    parts = []
    for numbers in _parts(widths, inf if width is None else width, groups or [1] * (len(widths) - 1)):
        chosen = [columns[0], *(columns[number] for number in numbers)]
        parts.append("\n".join("  ".join(cells).rstrip() for cells in zip(*chosen, strict=True)))
    return "\n\n".join(parts)


def _parts(widths: Sequence[int], width: float, groups: Sequence[int]) -> list[list[int]]:
    """Which columns stand side by side, behind the first one."""
    parts: list[list[int]] = [[]]
    taken = widths[0]
    for first, size in zip(itertools.accumulate(groups, initial=1), groups, strict=False):
        group = [*range(first, first + size)]
        is_too_wide = widths[0] + _needed(widths, group) > width
        for numbers in [[number] for number in group] if is_too_wide else [group]:
            needed = _needed(widths, numbers)
            if parts[-1] and taken + needed > width:
                parts.append([])
                taken = widths[0]
            parts[-1] += numbers
            taken += needed
    return parts


def _needed(widths: Sequence[int], numbers: Sequence[int]) -> int:
    return sum(2 + widths[number] for number in numbers)
