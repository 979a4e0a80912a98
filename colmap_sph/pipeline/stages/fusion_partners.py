"""The images in which each image to fuse is looked up, and the stations that they belong to."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from colmap_sph.stereo.fusion import MAX_PARTNERS
from colmap_sph.stereo.partners.pairing import Pair, partners_of
from colmap_sph.stereo.partners.pairs import Overlap
from colmap_sph.stereo.partners.stations import OWN_STATION, Stations, by_station

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

# Images that share most points are looked at for those of different stations, as often as images to fuse.
_CANDIDATES = 4


class PartnersInFusion(Mapping[str, tuple[list[str], list[int]]]):
    """For each image to fuse the others that may see the same: those that share most points, and its pairs'.

    With them come the numbers of their stations, which ascend. Both are found when they are asked for, by any
    thread, and kept.

    Parameters
    ----------
    context : Context
    pairs : iterable of pair
        That were matched: one that the user asked for may share no point.
    names : sequence of str
        Images to fuse.
    """

    def __init__(self, context: "Context", pairs: Iterable[Pair], names: Sequence[str]) -> None:
        self._most = min(context.options.fusion.check_num_images, MAX_PARTNERS)
        self._stations = context.stations
        self._overlap = Overlap(context.scene)
        self._matched = partners_of(pairs)
        self._names = dict.fromkeys(names)
        self._found: dict[str, tuple[list[str], list[int]]] = {}

    def __getitem__(self, name: str) -> tuple[list[str], list[int]]:
        if name not in self._found:
            overlapping = self._overlap.of(name, _CANDIDATES * self._most)
            others = [o for o in dict.fromkeys([*overlapping, *self._matched.get(name, [])]) if o in self._names]
            self._found[name] = _some_of_each_station(self._stations, name, others, self._most)
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _some_of_each_station(
    stations: Stations, name: str, others: list[str], most: int
) -> tuple[list[str], list[int]]:
    """At most so many images, the first of each station before the rest, in the order of their stations."""
    numbers = stations.numbers(name, others)
    firsts = {number: k for k, number in reversed(list(enumerate(numbers))) if number != OWN_STATION}
    chosen = list(dict.fromkeys([*sorted(firsts.values()), *range(len(others))]))[:most]
    return by_station([others[k] for k in sorted(chosen)], [numbers[k] for k in sorted(chosen)])
