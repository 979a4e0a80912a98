"""Options that ask for more images than there are: told before hours of work."""

import logging
from collections.abc import Mapping, Sequence

from colmap_sph.errors import OptionError
from colmap_sph.pipeline.context import Context
from colmap_sph.stereo.fusion import MAX_PARTNERS
from colmap_sph.stereo.partners.pairing import Pair, partners_of

logger = logging.getLogger(__name__)


def check_numbers(context: Context, pairs: Sequence[Pair]) -> None:
    """Raise `OptionError` where no pixel could ever satisfy an option; warn where none but the best one could.

    Parameters
    ----------
    context : Context
    pairs : sequence of (str, str)
        That will be matched.
    """
    check_fusion(context)
    support = context.options.vote.min_support
    most = _most_places(context, partners_of(pairs), max(support, context.options.confirm.min_consistent))
    if support > most:
        raise OptionError(
            f"vote.min_support is {support}, but no image has partners at more than {most} places: no pixel would "
            "get a depth. Lower it, or raise pairs.num_pairs.",
            "vote.min_support",
            "pairs.num_pairs",
        )
    consistent = context.options.confirm.min_consistent
    if consistent > most:
        logger.warning(
            "--confirm.min-consistent is %d, but no image has partners at more than %d places: only depths stay "
            "that all partners confirm which have them in view.",
            consistent,
            most,
        )


def _most_places(context: Context, partners: Mapping[str, list[str]], enough: int) -> int:
    """At how many places an image has partners at most; or at least, where one has enough."""
    most = 0
    for name, others in partners.items():
        if len(others) > most:
            most = max(most, len(set(context.stations.elsewhere(name, others)[1])))
        if most >= enough:
            break
    return most


def check_fusion(context: Context) -> None:
    """Raise `OptionError` where no point can have as many images that agree as are asked for.

    COLMAP's fusion counts several pixels of one image, too.
    """
    options = context.options.fusion
    images = len(context.scene.photographs)
    if options.method == "colmap":
        return
    if options.min_num_pixels > images:
        raise OptionError(
            f"fusion.min_num_pixels is {options.min_num_pixels}, but there are {images} images: no point can have "
            "so many that agree. Lower it.",
            "fusion.min_num_pixels",
        )
    looked_at = 1 + min(options.check_num_images, MAX_PARTNERS)
    if options.min_num_pixels > looked_at:
        raise OptionError(
            f"fusion.min_num_pixels is {options.min_num_pixels}, but a point is looked for in {looked_at} images "
            f"at most (fusion.check_num_images, no more than {MAX_PARTNERS}, and its own). Lower the first.",
            "fusion.min_num_pixels",
            "fusion.check_num_images",
        )
