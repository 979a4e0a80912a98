"""The images in which each image to fuse is looked up, and the stations that they belong to."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from colmap_sph.stereo.fusion import MAX_PARTNERS
from colmap_sph.stereo.partners.pairing import Pair, partners_of
from colmap_sph.stereo.partners.pairs import overlapping_views
from colmap_sph.stereo.partners.stations import OWN_STATION, Stations, by_station

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

# Images that share most points are looked at for those of different stations, as often as images to fuse.
_CANDIDATES = 4


def partners_in_fusion(
    context: "Context", pair_keys: Mapping[Pair, str], names: Sequence[str]
) -> dict[str, tuple[list[str], list[int]]]:
    """For each image to fuse the others that may see the same: those that share most points, and its pairs'.

    With them come the numbers of their stations, which ascend.
    """
    most = min(context.options.fusion.check_num_images, MAX_PARTNERS)
    overlapping = overlapping_views(context.scene, _CANDIDATES * most)
    matched = partners_of(pair_keys)  # a pair that the user asked for may share no point
    fused = set(names)
    partners = {}
    for name in names:
        others = [o for o in dict.fromkeys([*overlapping[name], *matched.get(name, [])]) if o in fused]
        partners[name] = _some_of_each_station(context.stations, name, others, most)
    return partners


def _some_of_each_station(
    stations: Stations, name: str, others: list[str], most: int
) -> tuple[list[str], list[int]]:
    """At most so many images, the first of each station before the rest, in the order of their stations."""
    numbers = stations.numbers(name, others)
    firsts = {number: k for k, number in reversed(list(enumerate(numbers))) if number != OWN_STATION}
    chosen = list(dict.fromkeys([*sorted(firsts.values()), *range(len(others))]))[:most]
    return by_station([others[k] for k in sorted(chosen)], [numbers[k] for k in sorted(chosen)])
