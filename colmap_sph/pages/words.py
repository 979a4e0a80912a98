"""Numbers → words, as a page shows them."""

from typing import Any

from colmap_sph import errors


def cell(value: float | None, text: str) -> dict[str, Any]:
    """Text of a cell, and what its column is sorted by."""
    return {"value": None if value is None else f"{value:.6g}", "text": text}


def percent(share: float | None, nothing: str = "–") -> str:
    """Such as 12.3 %."""
    return nothing if share is None else errors.percent(share)


def plain(value: float | None, form: str) -> str:
    """A number in a format of Python's; nothing for None."""
    return "" if value is None else format(value, form)


def pixels(value: float | None) -> str:
    """Such as 0.12 px."""
    return "–" if value is None else f"{value:.2f} px"


def duration(seconds: float) -> str:
    """Such as 5 minutes."""
    if seconds < 120:
        return f"{seconds:.0f} seconds"
    minutes = round(seconds / 60)
    return f"{minutes} minutes" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"
