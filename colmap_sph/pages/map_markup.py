"""Cloud and map of a page: their drawing, and what is said of it."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.pages.block_map import Frame, looks_towards
from colmap_sph.pages.content import Content
from colmap_sph.pages.image_facts import ImageFacts
from colmap_sph.pages.pictures import colour_of, layer_uri
from colmap_sph.pages.reasons import WORDS, Reason
from colmap_sph.pages.small_cloud import STEPS
from colmap_sph.pages.words import percent
from colmap_sph.scene import Photograph, View

# Of the map: units of its drawing along the longer side, and a camera's size.
_MAP_UNITS = 1000
_CAMERA_UNITS = 22.0
# More cameras than these are drawn smaller.
_FULL_SIZE = 150
# Sine of the angle from straight down below which a camera has no direction on the map.
_LOOKS_DOWN = 0.2
# More footprints than these hide what they lie on.
_MOST_FOOTPRINTS = 80


def cloud_values(content: Content) -> dict[str, Any]:
    """Values of the template for the cloud."""
    sample = content.cloud
    if content.drawing is None:
        return {"cloud": None, "no_cloud": sample.lack, "data": {"cloud": None}}
    small = content.drawing.small
    data = {
        "count": len(small.places),
        "middle": (small.middle / STEPS).round(5).tolist(),
        "reach": round(small.reach / STEPS, 5),
        "text": small.as_text(),
    }
    shown = {"shown": f"{len(small.places):,}", "total": f"{sample.total:,}"}
    return {"cloud": shown, "no_cloud": "", "data": {"cloud": data}}


def map_values(content: Content) -> dict[str, Any]:
    """Values of the template for the map, but for what belongs to each image."""
    frame = content.frame
    width, height = (max(round(side), 1) for side in _drawing_size(frame))
    return {
        "map_width": width,
        "map_height": height,
        "layers": _layers(content),
        "footprints_shown": len(content.images) <= _MOST_FOOTPRINTS,
        "map_words": f"The map is {frame.width:.4g} units wide. "
        + (
            "North is up. "
            if content.scene.origin.any()
            else "Up is as the rows of the images and the surface tell. "
        )
        + "A triangle is a camera, and points where it looks, a diamond one that looks down or all around; "
        + "choose one to see its pictures.",
        "reasons": [
            _reason(reason, content.images)
            for reason in Reason
            if reason != Reason.OUTSIDE or (content.run is not None and content.run.region is not None)
        ],
    }


def _layers(content: Content) -> list[dict[str, Any]]:
    ground, drawing = content.ground, content.drawing
    layers = []
    if drawing is not None:
        layers.append(_layer("colours", drawing.colours, "The cloud from above."))
        layers.append(_layer("height", drawing.heights, "Height of the cloud, units:", drawing.height_ends))
    counts, ends = ground.count_layer()
    layers.append(_layer("images", layer_uri(counts), "Images with a confirmed depth of each place:", ends))
    gsds, gsd_ends = ground.gsd_layer()
    layers.append(
        _layer(
            "GSD",
            layer_uri(gsds),
            "What a pixel of the finest image covers, units:",
            gsd_ends,
            is_reversed=True,
        )
    )
    weak, shares = ground.weak_layer()
    named = ", ".join(f"{WORDS[reason][0]} {percent(share)}" for reason, share in shares.items())
    words = (
        f"Places of which more pixels were lost than confirmed: {named} of what any image sees."
        if named
        else ("There is no place of which more pixels were lost than confirmed.")
    )
    layers.append(_layer("weak areas", layer_uri(weak, exact=True), words, on_colours=True))
    return layers


def _layer(
    name: str,
    uri: str,
    text: str,
    ends: tuple[float, float] | None = None,
    *,
    is_reversed: bool = False,
    on_colours: bool = False,
) -> dict[str, Any]:
    return {
        "name": name,
        "uri": uri,
        "text": text,
        "ends": None if ends is None else [f"{end:.4g}" for end in ends],
        "reversed": is_reversed,
        "on_colours": on_colours,
    }


def _reason(reason: Reason, images: list[ImageFacts]) -> dict[str, str]:
    shares = [image.shares[reason] for image in images if image.has_maps]
    name, meaning = WORDS[reason]
    return {
        "name": name,
        "meaning": meaning,
        "colour": colour_of(reason),
        "share": percent(sum(shares) / len(shares)) if any(shares) else "",
    }


def camera_path(view: View | Photograph, frame: Frame, among: int) -> str:
    """One of so many cameras: a triangle that points to where it looks; a diamond: down, up or all around."""
    middle = frame.place(view.center[None])[0] * _drawing_size(frame)
    ahead = looks_towards(view, frame)
    length = float(np.hypot(*ahead))
    if length < _LOOKS_DOWN:
        corners = np.array([[0.0, -0.5], [0.4, 0.0], [0.0, 0.5], [-0.4, 0.0]])
    else:
        x, y = ahead / length
        corners = np.array([[0.6, 0.0], [-0.4, 0.4], [-0.4, -0.4]]) @ [[x, y], [-y, x]]
    size = _CAMERA_UNITS * min(1.0, math.sqrt(_FULL_SIZE / among))
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in middle + size * corners) + "Z"


def _drawing_size(frame: Frame) -> NDArray[np.float64]:
    """Width and height of the map's drawing."""
    size = np.array([frame.width, frame.height])
    return np.asarray(size * (_MAP_UNITS / size.max()))


def outline(corners: NDArray[np.float64], frame: Frame) -> str:
    """Places of corners on a map, as SVG wants them; nothing of a footprint that goes to the horizon."""
    corners = corners * _drawing_size(frame)
    if not np.isfinite(corners).all() or np.abs(corners).max() > 10 * _MAP_UNITS:
        return ""
    return " ".join(f"{x:.0f},{y:.0f}" for x, y in corners)
