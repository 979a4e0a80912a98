"""What pairs find of what both images see, frame against sphere, by angle and by parallax."""

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarking import table

from rectification_study.found import COUNTED, shares
from rectification_study.runs import SURFACES

Row = Mapping[str, Any]
_WORDS = ("found", "within 1 % of depth", "within 1 GSD", "within 1 px")


def sections(content: Mapping[str, Any]) -> str:
    """All of it, as Markdown."""
    angles, parallaxes = content["by_angle"], content["by_parallax"]
    parts = [
        lost(angles[-1]),
        "All pairs, in which a surface that cannot rectify a pair finds nothing:",
        _table("angle between views [deg]", angles, "found"),
        _table("parallax [deg]", parallaxes, "found"),
    ]
    if 0 < angles[-1]["common_pairs"] < angles[-1]["pairs"]:
        parts += [
            "Only the pairs that both surfaces can rectify:",
            _table("angle between views [deg]", angles, "found_common"),
            _table("parallax [deg]", parallaxes, "found_common"),
        ]
    parts.append(
        "Shares of the pixels of the original images whose exact surface both images of a pair see. Found: with a "
        "depth from the pair alone; right: with one within 1 % of the exact depth, within 1 GSD (depth / focal "
        "length), or whose place in the other image is within a pixel. Each cell: frame, then spherical."
    )
    return "\n\n".join(parts)


def lost(every: Row) -> str:
    """How many pairs each surface cannot rectify, and how much of what both images see is in the others."""
    counts = [f"{one} cannot rectify {every[one]['skipped']} of {every['pairs']} pairs" for one in SURFACES]
    share = every["found_common"]["spherical"]["seen"] / max(every["found"]["spherical"]["seen"], 1)
    kept = f"The {every['common_pairs']} pairs that both rectify hold {share:.0%} of all that pairs see."
    return f"**{'; '.join(counts)}.** {kept if every['common_pairs'] else 'No pair can be rectified on both.'}"


def _table(label: str, rows: Sequence[Row], key: str) -> str:
    header = [label, "pairs", "frame fails", *_WORDS, "frame's pixels / spherical's"]
    lines = []
    for row in rows:
        of_surface = [shares(row[key][surface]) for surface in SURFACES]
        count = row["pairs"] if key == "found" else row["common_pairs"]
        fails = str(row["frame"]["skipped"]) if key == "found" else "-"
        cells = [" / ".join(f"{share[name]:.3f}" for share in of_surface) for name in COUNTED[1:]]
        frame, spherical = (
            (row["frame"]["warped"], row["spherical"]["warped"]) if key == "found" else row["warped_common"]
        )
        ratio = f"{frame / spherical:.2f}" if spherical else "-"
        cells = cells if count else ["-"] * len(cells)
        lines.append([f"{row['from']:g} to {row['to']:g}", str(count), fails, *cells, ratio])
    return table(header, lines)
