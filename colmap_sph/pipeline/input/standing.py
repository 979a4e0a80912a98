"""Do parts of the images stand still while the camera turns? They are not of the scene, and are not matched."""

import logging
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, percent
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.memory import MemoryGate
from colmap_sph.pipeline.stages.photo import read_small_grey
from colmap_sph.project.masks import read_view_mask
from colmap_sph.scene import View
from colmap_sph.stereo.poses.standstill import slightly_turned_views, still_pixels, turned_views

logger = logging.getLogger(__name__)

# Images are looked at with so many pixels along their longest side.
_LOOKED_AT = 320
# Largest bytes in use, per pixel of its own, while an image is read.
_READ_BYTES = 25
# Side of what is left out around masked pixels: windows there show these, too.
_SIDE = 9
# A smaller share of a camera's images may look alike by chance.
_LEAST_STILL = 0.015


def with_still_pixels(context: Context, names: Collection[str]) -> Context:
    """Look which cameras show something that stands still: reported, and known to the context that is returned.

    Of each camera the images that are turned most are compared with each other. Where these have next to nothing
    in common, the others are not looked at. Nor are they where this is not in images that are turned a little, or
    where there are none: an object with eight equal sides looks alike at eight turns. Where such pixels are to be
    matched all the same, they matter to models without points: features there tell nothing of the poses.

    Parameters
    ----------
    context : Context
    names : collection of str
        Images that are there.
    """
    keep = context.options.matching.keep_blank
    if keep and context.scene.has_tracks:
        return context
    views = [context.scene.view(name) for name in sorted(names)]
    turned = turned_views(views)
    shares = _still_shares(context, views, turned)
    still = {}
    for name, others in turned.items():
        known = [shares[other] for other in others if other in shares]
        if known and np.mean(known) >= _LEAST_STILL:
            still[name] = others
    if still:
        looked_at = [shares[name] for name in still if name in shares]
        context.report.still = _words(len(still), float(np.mean(looked_at)), keep=keep)
        logger.warning("%s", context.report.still)
    return replace(context, still=still)


def _still_shares(
    context: Context, views: Sequence[View], turned: Mapping[str, tuple[str, ...]]
) -> dict[str, float]:
    """Share of what is not masked that stands still, in images that others are compared with."""
    compared = {other for others in turned.values() for other in others}
    beside = slightly_turned_views(views, compared)
    small: dict[str, NDArray[np.uint8]] = {}

    def read(name: str) -> None:
        with suppress(InputError):  # told by the stage that needs it
            small[name] = read_small_grey(context.workspace.image_path(name), _LOOKED_AT)

    def share(name: str) -> float | None:
        if beside[name] not in small:
            return None
        still = still_pixels(small[name], [small[other] for other in turned[name] if other in small])
        still &= still_pixels(small[name], [small[beside[name]]])
        with suppress(InputError):
            wanted = _wanted(context, name, still.shape)
            if wanted.any():
                return float(still[wanted].mean())
        return None

    looked_at = sorted({*compared, *beside.values()})
    with ThreadPoolExecutor(_readers(context, looked_at)) as pool:
        list(pool.map(read, looked_at))
        names = sorted(turned.keys() & beside.keys() & small.keys())
        shares = dict(zip(names, pool.map(share, names), strict=True))
    return {name: found for name, found in shares.items() if found is not None}


def _readers(context: Context, names: Sequence[str]) -> int:
    """How many threads read images at a time: as many as memory allows."""
    options = context.options
    sizes = [context.scene.view(name).file_size for name in names]
    largest = max((_READ_BYTES * width * height for width, height in sizes), default=1)
    free = MemoryGate(options.memory_budget, options.num_threads).free
    return max(min(options.num_threads, free // largest), 1)


def _wanted(context: Context, name: str, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    mask = read_view_mask(context.workspace.mask_path(name), context.scene.view(name))
    if mask is None:
        return np.ones(shape, bool)
    small = cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.erode(small, np.ones((_SIDE, _SIDE), np.uint8))) > 0


def _words(images: int, share: float, *, keep: bool) -> str:
    ignored = (
        "ignored. Masks (--masks) are more exact; --matching.keep-blank True matches these pixels all the same."
    )
    kept = (
        "matched all the same, as --matching.keep-blank asks. They have no part in the check of the poses; masks "
        "(--masks) would leave them out."
    )
    return (
        f"{percent(share, 0)} of the pixels of {images} images stand still while the camera turns, as a backdrop, "
        f"a time stamp or a part of the vehicle would: they are not of the scene, and are "
        f"{kept if keep else ignored}"
    )
