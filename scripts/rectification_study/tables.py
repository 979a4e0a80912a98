"""The study's results as Markdown."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from benchmarking import table

from rectification_study import found_tables
from rectification_study.pairs import SLOPE_EDGES
from rectification_study.runs import SURFACES

_EMPTY = "-"
_LISTED = 10


def markdown(content: Mapping[str, Any], figures: Sequence[Path]) -> str:
    """The whole report."""
    parts = [
        f"# Frame against spherical rectification: {content['model']}",
        f"{content['images']} images, ground sampling distance {content['gsd_m']:.3g} (units of the model). "
        "The same pairs, matcher and options; differences are spherical against frame.",
        *_comparison(content),
    ]
    if "same_pixels" in content:
        again = content["same_pixels"]
        changed = f"{again['scaled']} with sampling {again['sampling']:.3f}"
        parts += [f"# With as many rectified pixels: {changed}", *_comparison(again)]
    pictures = "\n".join(f"![{figure.stem}]({figure.name})" for figure in figures)
    return "\n\n".join([*parts, "# Pictures", pictures]) + "\n"


def _comparison(content: Mapping[str, Any]) -> list[str]:
    """The sections of one comparison of the two surfaces."""
    parts = [f"**{surface}: no result.** {failure}" for surface, failure in content["failures"].items()]
    parts += ["## Points (the paper's Figure 5)", _points(content["points"])]
    if "lidar" in content:
        parts += ["## Distance to LiDAR (the paper's Table 2)", _lidar(content["lidar"])]
    if "exact_clouds" in content:
        parts += ["## Exact depth", _exact(content["exact_clouds"], content["exact_depth_maps"])]
    if "found" in content["by_angle"][-1]:
        parts += ["## Found of what both images see", found_tables.sections(content)]
    parts += [
        "## By angle between the viewing directions",
        _by_angle(content["by_angle"]),
        *_by_slope(content["by_angle"]),
        "## Pairs that differ most",
        _pairs(content["pairs"]),
        "## Pairs that could not be rectified",
        _skipped(content["skipped_pairs"]),
        "## Cost",
        _cost(content),
    ]
    return parts


def change(frame: float, spherical: float) -> str:
    """Spherical against frame in percent."""
    return f"{100 * (spherical / frame - 1):+.2f} %" if frame else _EMPTY


def _points(points: Mapping[str, Any]) -> str:
    frame, spherical = (points[m]["pixels_per_image"] for m in ("frame", "spherical"))
    ratios = [spherical[name] / frame[name] - 1 for name in frame if frame[name] and name in spherical]
    rows = [
        ["pixels with a geometric depth, all images", *_counts(sum(frame.values()), sum(spherical.values()))],
        ["points of the fused cloud", *_counts(points["frame"]["fused"], points["spherical"]["fused"])],
    ]
    per_image = [
        [name, *_counts(frame.get(name, 0), spherical.get(name, 0))] for name in sorted({*frame, *spherical})
    ]
    header = ["", "frame", "spherical", "difference"]
    mean = "An image's points are its pixels with a geometric depth (confirmed by other views)."
    if ratios:
        mean += (
            f" On average over the images the difference is {100 * np.mean(ratios):+.2f} % (from "
            f"{100 * min(ratios):+.2f} to {100 * max(ratios):+.2f} %)."
        )
    return "\n\n".join([table(header, rows), mean, table(["image", *header[1:]], per_image)])


def _counts(frame: int, spherical: int) -> list[str]:
    return [f"{frame:,}", f"{spherical:,}", change(frame, spherical)]


def _lidar(lidar: Mapping[str, Any]) -> str:
    statistics = {"mean [m]": "mean_m", "standard deviation [m]": "standard_deviation_m", "median [m]": "median_m"}
    has_floor = "floor" in lidar["frame"]
    header = ["", "frame", "spherical", "difference", *(["floor, frame", "floor, spherical"] if has_floor else [])]
    rows = []
    for suffix, words in (("", ""), ("_seen_by_lidar", ", where LiDAR saw the surface")):
        if f"cloud{suffix}" not in lidar["frame"]:
            continue
        for label, key in statistics.items():
            values = [
                lidar[surface][f"cloud{suffix}"]["cloud_to_reference"][key] for surface in ("frame", "spherical")
            ]
            row = [label + words, *(f"{value:.4f}" for value in values), change(*values)]
            if has_floor:
                floors = [lidar[m][f"floor{suffix}"]["cloud_to_reference"][key] for m in ("frame", "spherical")]
                row += [f"{value:.4f}" for value in floors]
            rows.append(row)
    lines = [table(header, rows)]
    if has_floor:
        shares = [f"{lidar[surface]['share_seen_by_lidar']:.1%} ({surface})" for surface in ("frame", "spherical")]
        lines.append(
            "The floor is the same statistic of the exact surface at the places of the cloud's points: what a "
            "perfect cloud would have, for LiDAR's own spacing and for what it did not see. It saw the surface of "
            f"{' and '.join(shares)} of the points."
        )
    return "\n\n".join(lines)


def _exact(clouds: Mapping[str, Any], depth_maps: Mapping[str, Any]) -> str:
    one = clouds["spherical"]
    rows = []
    for place, threshold in enumerate(one["thresholds"]):
        tau = f"{threshold['tau_m'] / one['gsd_m']:g} GSD"
        for key in ("accuracy", "completeness", "f_score"):
            values = [clouds[m]["thresholds"][place][key] if m in clouds else None for m in SURFACES]
            rows.append([f"cloud: {key.replace('_', '-')}, {tau}", *_shares(*values)])

    def of_maps(key: str, place: int | None = None) -> list[float | None]:
        found = [depth_maps[m][key] if m in depth_maps else None for m in SURFACES]
        return [value if value is None or place is None else value[place] for value in found]

    rows.append(["geometric depth maps: coverage", *_shares(*of_maps("coverage"))])
    for place, bound in enumerate(depth_maps["spherical"]["thresholds_gsd"]):
        label = f"geometric depth maps: share of truth pixels within {bound:g} GSD"
        rows.append([label, *_shares(*of_maps("complete_within", place))])
    for key, label in (("median_error_gsd", "median error [GSD]"), ("median_normal_angle_deg", "normals [deg]")):
        frame, spherical = of_maps(key)
        if frame is not None and spherical is not None:
            cells = [f"{frame:.4f}", f"{spherical:.4f}", change(frame, spherical)]
            rows.append([f"geometric depth maps: {label}", *cells])
    return table(["", "frame", "spherical", "difference"], rows)


def _shares(frame: float | None, spherical: float | None) -> list[str]:
    values = [_EMPTY if value is None else f"{value:.2%}" for value in (frame, spherical)]
    if frame is None or spherical is None:
        return [*values, _EMPTY]
    return [*values, f"{100 * (spherical - frame):+.2f} points"]


def _by_angle(rows: Sequence[Mapping[str, Any]]) -> str:
    header = ["angle [deg]", "pairs", "frame fails", "matched pixels: frame", "spherical", "difference"]
    has_truth = "correct" in rows[-1]["spherical"]
    if has_truth:
        header += ["correct pixels: frame", "spherical", "difference"]
        header += ["median error [GSD]: frame", "spherical", "on pixels of both: frame", "spherical"]
    header += ["warped pixels: frame", "spherical", "ratio"]
    lines = []
    for row in rows:
        frame, spherical = row["frame"], row["spherical"]
        line = [f"{row['from']:g} to {row['to']:g}", str(row["pairs"]), str(frame["skipped"])]
        line += _counts(frame["matched"], spherical["matched"])
        if has_truth:
            line += _counts(frame["correct"], spherical["correct"])
            for key in ("median_error_gsd", "median_error_common_gsd"):
                line += [_EMPTY if one[key] is None else f"{one[key]:.3f}" for one in (frame, spherical)]
        ratio = frame["warped"] / spherical["warped"] if spherical["warped"] else 0
        lines.append([*line, f"{frame['warped']:,}", f"{spherical['warped']:,}", f"{ratio:.2f}"])
    notes = "Matched: pixels of the two original images that the pair alone gives a depth. "
    if has_truth:
        notes += (
            "Correct: of these, within 2 GSD (depth / focal length) of the exact depth. Errors are the median "
            "over the pairs of each pair's median."
        )
    return f"{table(header, lines)}\n\n{notes}"


def _by_slope(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Correct pixels by the slope of the surface, for every class of angles; nothing without exact depth."""
    rows = [row for row in rows if all("correct_by_slope" in row[surface] for surface in ("frame", "spherical"))]
    if not rows:
        return []
    header = ["angle [deg]"]
    for low, high in pairwise(SLOPE_EDGES):
        header += [f"{low:g} to {high:g}: frame", "spherical", "difference"]
    lines = []
    for row in rows:
        counts = zip(row["frame"]["correct_by_slope"], row["spherical"]["correct_by_slope"], strict=True)
        lines.append([f"{row['from']:g} to {row['to']:g}", *(cell for pair in counts for cell in _counts(*pair))])
    return [
        "## By slope of the surface",
        f"{table(header, lines)}\n\nCorrect pixels of the pairs matched on both surfaces, by the angle in degrees "
        "of the exact surface against the plane that frame rectification uses.",
    ]


def _pairs(pairs: Sequence[Mapping[str, Any]]) -> str:
    usable = [pair for pair in pairs if "matched" in pair["frame"] and "matched" in pair["spherical"]]
    key = "correct" if all("correct" in pair["spherical"] for pair in usable) else "matched"
    usable.sort(key=lambda pair: pair["spherical"][key] - pair["frame"][key])
    worst, best = usable[: _LISTED // 2], usable[-_LISTED // 2 :]
    rows = [
        [
            f"{pair['left']} - {pair['right']}",
            f"{pair['view_angle_deg']:.0f}",
            *_counts(pair["frame"][key], pair["spherical"][key]),
        ]
        for pair in [*worst, *(pair for pair in best if pair not in worst)]
    ]
    return table(["pair", "angle [deg]", f"{key} pixels: frame", "spherical", "difference"], rows)


def _skipped(skipped: Mapping[str, Mapping[str, str]]) -> str:
    rows = [[pair, surface, reason] for surface, pairs in skipped.items() for pair, reason in pairs.items()]
    return table(["pair", "surface", "why"], rows) if rows else "None, on either surface."


def _cost(content: Mapping[str, Any]) -> str:
    costs = content["cost"]
    rows = []
    for stage in costs["spherical"]:
        row = [stage]
        for key, scale in (("seconds", 1), ("cpu_seconds", 1), ("peak_bytes", 2**30)):
            row += [
                f"{costs[surface].get(stage, {}).get(key, 0) / scale:.2f}" for surface in ("frame", "spherical")
            ]
        rows.append(row)
    totals = {m: np.sum([[c["seconds"], c["cpu_seconds"]] for c in costs[m].values()], axis=0) for m in costs}
    peaks = {m: max(c["peak_bytes"] for c in costs[m].values()) / 2**30 for m in costs}
    pairs = [f"{value:.2f}" for place in (0, 1) for value in (totals["frame"][place], totals["spherical"][place])]
    rows.append(["all", *pairs, f"{peaks['frame']:.2f}", f"{peaks['spherical']:.2f}"])
    header = ["stage", "seconds: frame", "spherical", "processor seconds: frame", "spherical"]
    warped = content["by_angle"][-1]
    frame, spherical = warped["frame"]["warped"], warped["spherical"]["warped"]
    ratio = frame / max(spherical, 1)
    note = f"Pixels warped: {frame:,} (frame) and {spherical:,} (spherical), {ratio:.2f} times as many."
    return f"{table([*header, 'peak GiB: frame', 'spherical'], rows)}\n\n{note}"
